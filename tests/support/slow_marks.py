"""Which tests are slow, as their marks say."""


def is_slow(item):
    """`slow` marks a test or a case, `slow("a", "b")` two cases of a test, `slow(but=("c",))` all cases but one."""
    return any(
        (case_of(item) in mark.args if mark.args else case_of(item) not in mark.kwargs.get("but", ()))
        for mark in item.iter_markers("slow")
    )


def case_of(item):
    """The name of a case of a test, as pytest prints it in brackets."""
    return item.callspec.id if hasattr(item, "callspec") else None
