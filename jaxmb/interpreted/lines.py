"""Lines of source: which are used, and how they are written."""

from typing import Any, NamedTuple


class Let(NamedTuple):
    """`name = text`, which uses other names; and changes the array that it `updates` if nothing else refers to it.

    **Fields:** `about`: where the equation stands in the package.
    """

    name: str
    text: str
    uses: list[str]
    updates: str
    about: Any


class Assign(NamedTuple):
    """All `targets` at once become the `sources`."""

    targets: list[str]
    sources: list[str]


class Append(NamedTuple):
    """`rows.append(value)`."""

    rows: str
    value: str


class Break(NamedTuple):
    """The end of a loop unless `test` holds."""

    test: str


class Branch(NamedTuple):
    """The branch that the number `which` names, or the nearest; `truth`: whether it is a truth value."""

    which: str
    branches: list[list[Any]]
    truth: bool


class Loop(NamedTuple):
    """A loop, as `head` says, without a name that is used outside."""

    head: str
    body: list[Any]


Line = Let | Assign | Append | Break | Branch | Loop


class Used:
    """The lines of a program that contribute to its results.

    **Fields:** `buffers`: names of arrays that lines may update, and that must not be held by other names.
    """

    def __init__(self, lines: list[Line]):
        self.buffers: set[str] = set()
        # The names that a loop needs, so far: they become more while the loop around is looked at again.
        self._needed: dict[int, set[str]] = {}
        while self._spread(lines):
            pass

    def _spread(self, lines):
        """Find more names of arrays that are updated; whether there were more."""
        more, grows = set(), False
        for line in lines:
            match line:
                case Let(name=name, updates=updates) if updates:
                    more |= {name, updates}
                case Assign(targets=targets, sources=sources):
                    for pair in zip(targets, sources, strict=True):
                        if self.buffers & set(pair):
                            more |= set(pair)
                case Branch(branches=branches):
                    for branch in branches:
                        grows = self._spread(branch) or grows
                case Loop(body=body):
                    grows = self._spread(body) or grows
        found = more - self.buffers
        self.buffers |= found
        return bool(found) or grows

    def of(self, lines: list[Line], live: set[str], ends: set[str]) -> list[str | tuple[Line, Any]]:
        """Lines that matter, each with what is needed to write it; `live`, the names used later, becomes the names
        that the lines need.

        **Arguments:** `ends`: the names used after the loop around.
        """
        out: list[Any] = []
        for line in reversed(lines):
            match line:
                case Let(name=name, uses=uses, updates=updates):
                    if name not in live:
                        continue
                    live.discard(name)
                    # Constants have other names.
                    moved = updates.startswith("v") and updates not in live and uses.count(updates) == 1
                    live |= set(uses)
                    out.append((line, moved))
                case Assign(targets=targets, sources=sources):
                    pairs = [pair for pair in zip(targets, sources, strict=True) if pair[0] in live]
                    if not pairs:
                        continue
                    kept = set(sources) & (live - set(targets))
                    live -= set(targets)
                    live |= {source for _, source in pairs}
                    dropped = {x for _, x in pairs if x.startswith("v")} & self.buffers - kept - {x for x, _ in pairs}
                    out.append((Assign(*map(list, zip(*pairs, strict=True))), sorted(dropped)))
                case Append(rows=rows, value=value):
                    if rows not in live:
                        continue
                    live.add(value)
                    out.append((line, None))
                case Break(test=test):
                    live |= ends | {test}
                    out.append((line, None))
                case Branch(which=which, branches=branches):
                    each = [set(live) for _ in branches]
                    inner = [self.of(branch, names, ends) for branch, names in zip(branches, each, strict=True)]
                    live.clear()
                    live.update(*each)
                    if any(inner):
                        live.add(which)
                        out.append((line, inner))
                case Loop(body=body):
                    after = set(live)
                    live |= self._needed.get(id(line), set())
                    while True:
                        before = set(live)
                        inner = self.of(body, live, after)
                        live |= before
                        if live == before:
                            break
                    self._needed[id(line)] = before
                    out.append((line, inner))
        out.reverse()
        return out


def of_first(text: str, name: str, other: str) -> str:
    """A call with another first argument."""
    return text.replace(f"({name}, ", f"({other}, ", 1)


def written(lines: list[Any], said: Any, depth: int = 1) -> list[str]:
    """The text of lines from `Used.of`; `said(about)` becomes a comment, unless it is empty."""
    pad, out = " " * depth, []
    for line, more in lines:
        match line:
            case Let(name=name, text=text, updates=updates, about=about):
                if more:
                    out += [f"{pad}{name} = {updates}", f"{pad}{updates} = None"]
                if updates:
                    text = of_first(text, updates, name if more else f"{updates}.copy()")
                told = said(about)
                out.append(f"{pad}{name} = {text}" + (f"  # {told}" if told else ""))
            case Assign(targets=targets, sources=sources):
                out.append(f"{pad}{', '.join(targets)} = {', '.join(sources)}")
                out += [f"{pad}{name} = None" for name in more]
            case Append(rows=rows, value=value):
                out.append(f"{pad}{rows}.append({value})")
            case Break(test=test):
                out.append(f"{pad}if not {test}: break")
            case Branch(which=which, truth=truth):
                last = len(more) - 1
                order = (
                    [(which, more[1]), ("", more[0])]
                    if truth
                    else [
                        (f"{which} <= 0" if k == 0 else f"{which} == {k}" if k < last else "", branch)
                        for k, branch in enumerate(more)
                    ]
                )
                for k, (test, branch) in enumerate(order):
                    out.append(f"{pad}else:" if not test else f"{pad}{'elif' if k else 'if'} {test}:")
                    out += written(branch, said, depth + 1)
            case Loop(head=head):
                out.append(f"{pad}{head}:")
                out += written(more, said, depth + 1)
    return out or [f"{pad}pass"]
