"""Imports run downward only, and optional packages are imported at first use."""

import ast
import subprocess
import sys
from pathlib import Path

import jaxmb

ROOT = Path(jaxmb.__file__).parent

# Lowest first; a layer may import from those before it, and from itself.
LAYERS = [
    ["_types", "_space", "_names", "_namespace", "_results", "rotations"],
    ["_smooth", "elimination", "orthogonal", "block_tridiagonal"],
    ["_parts", "_resolve"],
    ["_forces", "_friction", "_servo", "_user", "terrain", "contact", "planar", "spatial"],
    ["system"],
    ["_chain_assembly"],
    ["assembly", "statics"],
    ["_structure"],
    ["scene", "lagrangian"],
    ["formulations"],
    ["solvers"],
    ["manifold"],
    ["reactions", "trajectory"],
    ["simulate"],
    ["_free", "_minimise", "_figure", "_quantities", "mechanisms", "viz"],
    ["identify", "report"],
    ["cli", "__main__"],
]


def imports(path: Path):
    """Layers that a file imports from."""
    package = path.relative_to(ROOT).parts[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - (node.level - 1)]
            if base:
                yield base[0]
            elif node.module:
                yield node.module.split(".")[0]
            else:
                yield from (alias.name for alias in node.names)


def test_imports_run_downward():
    level = {name: k for k, layer in enumerate(LAYERS) for name in layer}
    files = [p for p in ROOT.rglob("*.py") if p.name != "__init__.py" or p.parent != ROOT]
    for path in files:
        parts = path.relative_to(ROOT).with_suffix("").parts
        own = parts[0]
        assert own in level, f"{own} has no layer"
        for other in imports(path):
            assert level[other] <= level[own], f"{'/'.join(parts)} imports {other}"


def test_solvers_know_nothing_of_mechanics():
    for path in (ROOT / "solvers").glob("*.py"):
        assert set(imports(path)) <= {"solvers"}, path.name


def test_optional_packages_are_not_imported():
    code = "import sys, jaxmb; print([m for m in ('matplotlib', 'IPython', 'tqdm') if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_double_precision_is_left_to_the_user():
    code = "import jax, jaxmb; print(jax.config.jax_enable_x64)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "False"
