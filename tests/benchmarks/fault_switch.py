"""Faults in the code of the running package: its functions get the code of a changed source, in this process alone.

Nothing is written, so that many faults can be tried in forked processes of one that has imported everything.
"""

import ast
import builtins
import functools
import gc
import importlib
import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

PACKAGE = Path(__file__).parents[2] / "jaxmb"
# The name of the function by which a function notes that it is called.
MARK = "_reached_in_jaxmb"


class Fault(NamedTuple):
    """`code` of a `file` in the package, and the `wrong` code in its place."""

    file: str
    code: str
    wrong: str

    def __str__(self) -> str:
        return f"{self.file}: {self.code} → {self.wrong}"

    def source(self) -> str:
        """The text of the file, which has the code once."""
        text = (PACKAGE / self.file).read_text()
        if text.count(self.code) != 1:
            raise ValueError(f"{self.file} has {self.code!r} {text.count(self.code)} times, not once")
        if self.code.count("\n") != self.wrong.count("\n"):
            raise ValueError(f"{self}: the wrong code has another number of lines, so that all code below it changes")
        return text

    def change(self) -> tuple[CodeType, CodeType]:
        """The code of the module, and with the fault."""
        text, path = self.source(), str(PACKAGE / self.file)
        return _compiled(text, path), _compiled(text.replace(self.code, self.wrong), path)

    def place(self) -> str | None:
        """The innermost function with the fault, as `reached` names it; None for a fault outside functions."""
        names = [old.co_qualname for old, _ in _changed(*self.change()) if _is_written(old)]
        return f"{self.file}:{names[-1]}" if names else None


def switch_on(fault: Fault) -> None:
    """Put the fault into the package. Raises ValueError where nothing that exists would have it."""
    module, changed = _module(fault.file), list(_changed(*fault.change()))
    if not changed:
        _assign(fault, module)
    # Inner functions that exist already, such as those of decorators, are changed along with the outermost.
    elif not _replace(changed, changed[0][0]):
        raise ValueError(f"{fault}: no function that exists has this code")


def note_functions(fault: Fault | None) -> set[str]:
    """Put the fault into the package, or nothing. Returns a set that grows by each function of the package that is
    called from now on, as `parts/forces.py:Motor.force`.
    """
    reached: set[str] = set()
    setattr(builtins, MARK, reached.add)
    pairs, first = [], None
    for file in _files():
        if fault is not None and file == fault.file:
            changed = list(_changed(*fault.change()))
            first = changed[0][0] if changed else _assign(fault, _module(file))
            pairs += _with_marks(file, fault)
        else:
            pairs += _with_marks(file)
    if not _replace(pairs, first):
        raise ValueError(f"{fault}: no function that exists has this code")
    return reached


@functools.cache
def _with_marks(file: str, fault: Fault | None = None) -> list[tuple[CodeType, CodeType]]:
    """The functions of a file, and the same with the fault and with marks."""
    path = PACKAGE / file
    text = path.read_text()
    marked = ast.parse(text if fault is None else text.replace(fault.code, fault.wrong))
    marked = ast.fix_missing_locations(_Marks(file).visit(marked))
    return list(_changed(_compiled(text, str(path)), _compiled(marked, str(path))))


def prepare() -> None:
    """What all forks share: import all modules of the package, and compile them with marks."""
    for file in _files():
        if Path(file).name != "__main__.py":
            _module(file)
        _with_marks(file)


def _files() -> list[str]:
    return sorted(str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py"))


def _module(file: str) -> ModuleType:
    parts = Path(PACKAGE.name, file).with_suffix("").parts
    return importlib.import_module(".".join(parts[:-1] if parts[-1] == "__init__" else parts))


def _compiled(source: Any, path: str) -> CodeType:
    return compile(source, path, "exec", dont_inherit=True)


def _changed(old: CodeType, new: CodeType) -> Iterator[tuple[CodeType, CodeType]]:
    """The functions that differ between two sources of one module, outer ones before inner ones."""
    if old.co_flags & inspect.CO_OPTIMIZED and old != new:
        yield old, new
    inner, others = ([const for const in code.co_consts if isinstance(const, CodeType)] for code in (old, new))
    # A fault with one comprehension more changes the whole function only.
    if len(inner) == len(others):
        for pair in zip(inner, others, strict=True):
            yield from _changed(*pair)


def _is_written(code: CodeType) -> bool:
    """Whether it is of a function or lambda, not of a comprehension."""
    return code.co_name == "<lambda>" or not code.co_name.startswith("<")


def _replace(pairs: list[tuple[CodeType, CodeType]], first: CodeType | None) -> int:
    """Give all functions that have the old code the new one; the number of those with the first code, or of all."""
    by_code: dict[tuple[str, CodeType], CodeType] = {}
    for old, new in pairs:
        if by_code.setdefault((old.co_filename, old), new) != new:
            raise ValueError(f"{old.co_qualname} has twice the same code, of which one would change")
    count = 0
    for item in gc.get_objects():
        if isinstance(item, FunctionType):
            code = item.__code__
            new = by_code.get((code.co_filename, code))
            if new is not None:
                count += first is None or code == first
                item.__code__ = new
    return count


def _assign(fault: Fault, module: ModuleType) -> None:
    """Carry out the changed assignment, of a module or a class."""
    text = fault.source()
    before = ast.parse(text).body
    after = ast.parse(text.replace(fault.code, fault.wrong)).body
    place: Any = module
    while True:
        ((old, new),) = ((a, b) for a, b in zip(before, after, strict=True) if ast.dump(a) != ast.dump(b))
        if not isinstance(new, ast.ClassDef) or ast.dump(old) == ast.dump(new):
            break
        place, before, after = getattr(place, new.name), old.body, new.body  # pyright: ignore[reportAttributeAccessIssue]
    is_field = isinstance(new, ast.AnnAssign) and place is not module and "ClassVar" not in ast.unparse(new.annotation)
    if not isinstance(new, ast.Assign | ast.AnnAssign) or is_field:
        raise ValueError(f"{fault}: outside functions only assignments can be changed, other than of fields")
    names = dict(vars(place))
    exec(_compiled(ast.Module([new], []), module.__file__ or ""), vars(module), names)
    targets = new.targets if isinstance(new, ast.Assign) else [new.target]
    for name in (node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)):
        _hand_out(name, vars(place)[name], names[name], place)


def _hand_out(name: str, old: object, new: object, place: Any) -> None:
    """Set it in its place, and in the modules that have imported it."""
    setattr(place, name, new)
    for module in list(sys.modules.values()):
        if getattr(module, "__name__", "").split(".")[0] == PACKAGE.name and vars(module).get(name) is old:
            setattr(module, name, new)


class _Marks(ast.NodeTransformer):
    """Lets each function note its name first."""

    def __init__(self, file: str):
        self._file, self._names = file, [""]

    def _inside(self, node: Any, name: str, after: str) -> Any:
        self._names.append(f"{self._names[-1]}{name}")
        call = ast.parse(f"{MARK}({f'{self._file}:{self._names[-1]}'!r})").body[0]
        self._names[-1] += after
        node = self.generic_visit(node)
        self._names.pop()
        return node, call

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        return self._inside(node, node.name, ".")[0]

    def visit_Lambda(self, node: ast.Lambda) -> ast.AST:
        node, call = self._inside(node, "<lambda>", ".<locals>.")
        node.body = ast.BoolOp(ast.Or(), [call.value, node.body])
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node, call = self._inside(node, node.name, ".<locals>.")
        node.body.insert(int(ast.get_docstring(node) is not None), call)
        return node

    visit_AsyncFunctionDef = visit_FunctionDef  # type: ignore[assignment]
