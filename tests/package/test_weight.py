"""How much there is to know in the core: long functions, many arguments, and conditions on features that few scenes
have. A new feature is an object that is chosen once, and not a condition in twenty functions.
"""

import ast
import functools
import re
from pathlib import Path

import jaxmb

ROOT = Path(jaxmb.__file__).parent
FOLDERS = ("system", "bodies", "contacts", "manifold", "states", "simulate")
MOST_LINES, MOST_ARGUMENTS = 60, 8
# Conditions on contacts, ideal laws, elimination in blocks, rows that are left out or missing, and internal states.
OPTIONAL = re.compile(
    r"\bcontacts\b|\bideal\w*|\belimination\b|\bdrops_rows\b|\.z\b|\bnz\b|split\.coordinate is|"
    r"\b\w+_(rows|rank) (==|>|!=) 0|\bfriction_rows\b"
)
MOST_CONDITIONS = 145
MOST_MEMBERS = 52


@functools.cache
def parsed(path):
    return ast.parse(path.read_text())


def trees(*folders):
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            yield path.relative_to(ROOT), parsed(path)


def statements(function):
    """The number of lines of a function's code, without its docstring, comments and empty lines."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    lines = {line for node in body for part in ast.walk(node) for line in _lines(part)}
    return len(lines)


def _lines(node):
    if not hasattr(node, "lineno") or isinstance(node, ast.Module):
        return ()
    # A compound statement spans those in it; a text in several lines counts whole.
    return range(node.lineno, node.end_lineno + 1) if isinstance(node, ast.expr) else (node.lineno,)


def functions():
    for path, tree in trees(*FOLDERS):
        for node in ast.walk(tree):
            # `simulate` passes on what a user may ask for.
            if isinstance(node, ast.FunctionDef) and node.name != "simulate":
                yield f"{path}:{node.name}", node


def test_functions_are_short():
    assert {name: statements(node) for name, node in functions() if statements(node) > MOST_LINES} == {}


def test_functions_take_few_arguments():
    def count(arguments):
        names = [x.arg for x in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
        return len([name for name in names if name not in ("self", "cls")])

    assert {name: count(node.args) for name, node in functions() if count(node.args) > MOST_ARGUMENTS} == {}


def test_few_conditions_are_on_optional_features():
    found = 0
    for _, tree in trees(*FOLDERS, "formulations", "solvers", "linalg"):
        for node in ast.walk(tree):
            match node:
                case ast.If() | ast.IfExp() | ast.While():
                    tests = [node.test]
                case ast.comprehension():
                    tests = node.ifs
                case ast.BoolOp():
                    tests = node.values
                case ast.Compare():
                    tests = [node]
                case _:
                    tests = []
            found += sum(bool(OPTIONAL.search(ast.unparse(test))) for test in tests)
    assert found <= MOST_CONDITIONS


def test_classes_of_the_system_are_narrow():
    members = {}
    for path, tree in trees("system"):
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                names = [x.name for x in node.body if isinstance(x, ast.FunctionDef)]
                names += [x.target.id for x in node.body if isinstance(x, ast.AnnAssign)]
                members[f"{path}:{node.name}"] = sum(not name.startswith("_") for name in names)
    assert {name: count for name, count in members.items() if count > MOST_MEMBERS} == {}
