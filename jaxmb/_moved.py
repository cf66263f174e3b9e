"""Names that modules had before: where they are now."""

import sys


def tell_of_moved(package: str, **now: str) -> None:
    """Let the errors of a module for names that it had before say what to write.

    **Arguments:** `package`: name of the module; `now`: what to write, by the former name. For other names that some
    module of jaxmb defines, the error says which. A `__getattr__` of the module still finds the names in its `__all__`.
    """
    module = sys.modules[package]
    found, names = (vars(module).get(own) for own in ("__getattr__", "__all__"))

    def missing(name: str) -> object:
        if found is not None and name in (names or ()):
            return found(name)
        text = f"module {package!r} has no attribute {name!r}"
        if name in now:
            text = f"{package}.{name} is now {now[name]}."
        elif "." in package and not name.startswith("_") and (home := _home(package, name)):
            text = f"{package} does not export {name!r}; it stands in {home}."
        raise AttributeError(text, name=name, obj=module)

    vars(module)["__getattr__"] = missing


def _home(package: str, name: str) -> str | None:
    """The module that defines a class or function, in this package if it is there."""
    modules = [own for own in sys.modules if own.split(".")[0] == __package__]
    modules.sort(key=lambda own: (not own.startswith(package), own))
    return next((own for own in modules if getattr(vars(sys.modules[own]).get(name), "__module__", "") == own), None)
