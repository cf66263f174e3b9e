"""Imports run downward only, without circles, and optional packages are imported at first use."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import jaxmb

ROOT = Path(jaxmb.__file__).parent

# Lowest first; a layer may import from those before it, and from itself.
LAYERS = [
    [
        "_compat",
        "_faulty_versions",
        "_kept_programs",
        "_machine",
        "_moved",
        "_printed",
        "_setup",
        "_types",
        "_results",
        "_version",
    ],
    ["linalg", "lanes"],
    ["_arguments"],
    ["solvers"],
    ["_captured", "_dataflow", "_index_bounds", "_jaxpr_digest", "_traced_functions"],
    ["parts"],
    ["planar", "spatial", "system"],
    ["formulations"],
    ["contacts"],
    ["manifold"],
    ["states"],
    ["bodies", "lagrangian"],
    ["trajectory"],
    ["simulate"],
    ["studies", "viz", "mechanisms", "importers"],
    ["report"],
    ["reference"],
    ["cli"],
    ["__main__"],
]
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in ROOT.rglob("*.py")
    if path != ROOT / "__init__.py"
}


def imports(module: str):
    """Modules of the package that a module imports, wherever the import stands in it, also for type checkers only."""
    path = FILES[module]
    package = path.relative_to(ROOT).parts[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = [*package[: len(package) - (node.level - 1)], *(node.module or "").split(".")]
            source = ".".join(filter(None, base))
            for alias in node.names:
                whole = f"{source}.{alias.name}".lstrip(".")
                yield whole if whole in FILES else source


@pytest.mark.slow
def test_imports_run_downward():
    level = {name: k for k, layer in enumerate(LAYERS) for name in layer}
    for module in FILES:
        own = module.split(".")[0]
        assert own in level, f"{own} has no layer"
        for other in imports(module):
            assert level[other.split(".")[0]] <= level[own], f"{module} imports {other}"


@pytest.mark.slow
def test_imports_make_no_circle():
    known, open_ = set(), []

    def visit(module):
        assert module not in open_, " -> ".join([*open_[open_.index(module) :], module])
        if module in known:
            return
        open_.append(module)
        for other in imports(module):
            visit(other)
        known.add(open_.pop())

    for module in FILES:
        visit(module)


def test_solvers_know_nothing_of_mechanics():
    for module in FILES:
        if module.startswith("solvers"):
            assert all(other.startswith(("solvers", "_arguments", "_compat", "_moved")) for other in imports(module)), (
                module
            )


@pytest.mark.slow
def test_optional_packages_are_not_imported():
    code = "import sys, jaxmb; print([m for m in ('matplotlib', 'IPython', 'tqdm', 'mujoco') if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.slow
def test_double_precision_is_left_to_the_user():
    code = "import jax, jaxmb; print(jax.config.jax_enable_x64)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "False"


@pytest.mark.slow
def test_concrete_classes_are_seldom_looked_for():
    """Behaviour is asked of objects; where a concrete class is looked for, a comment above says why."""
    trees = {module: ast.parse(path.read_text()) for module, path in FILES.items()}
    classes = {node.name for tree in trees.values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
    concrete = {name for name in classes if not name.startswith("Abstract")} - {"State"}
    found = []
    for module, tree in trees.items():
        lines = FILES[module].read_text().splitlines()
        for node in ast.walk(tree):
            if not (isinstance(node, ast.Call) and getattr(node.func, "id", "") == "isinstance"):
                continue
            named = {own.id for own in ast.walk(node.args[1]) if isinstance(own, ast.Name)}
            if named & concrete:
                found.append(f"{module}:{node.lineno}")
                above = lines[max(node.lineno - 6, 0) : node.lineno]
                assert any("A concrete class" in line for line in above), f"{found[-1]} gives no reason"
    assert len(found) <= 10, found
