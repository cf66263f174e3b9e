"""Imports run downward only, without circles, and optional packages are imported at first use."""

import ast
import functools
import importlib
import importlib.metadata
import os
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
        "_jaxpr_digest",
        "_kept_programs",
        "_kept_traces",
        "_machine",
        "_moved",
        "_pickled",
        "_pictured",
        "_printed",
        "_setup",
        "_traced_functions",
        "_types",
        "_results",
        "_version",
    ],
    ["_branches", "linalg", "lanes", "interpreted"],
    ["_arguments"],
    ["solvers"],
    ["_captured", "_dataflow", "_index_bounds"],
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


# Modules and attributes of other packages that only `_compat` may use.
PRIVATE_MODULES = ("equinox.internal", "jax.extend", "jax.interpreters", "jax._src", "jax.custom_batching")
PRIVATE_ATTRIBUTES = {
    *("custom_batching", "weak_type", "canonicalize_dtype", "unvmap_any", "scan_kind", "with_stepsize_controller_tols"),
    *("backends_are_initialized", "_enumeration", "_name_to_item", "_index_to_message", "_processes", "LRUCache"),
}


@functools.cache
def nodes(module: str):
    """All nodes of a module's code."""
    return list(ast.walk(ast.parse(FILES[module].read_text())))


def imports(module: str):
    """Modules of the package that a module imports, wherever the import stands in it, also for type checkers only."""
    path = FILES[module]
    package = path.relative_to(ROOT).parts[:-1]
    for node in nodes(module):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = [*package[: len(package) - (node.level - 1)], *(node.module or "").split(".")]
            source = ".".join(filter(None, base))
            for alias in node.names:
                whole = f"{source}.{alias.name}".lstrip(".")
                yield whole if whole in FILES else source


def test_imports_run_downward():
    level = {name: k for k, layer in enumerate(LAYERS) for name in layer}
    for module in FILES:
        own = module.split(".")[0]
        assert own in level, f"{own} has no layer"
        for other in imports(module):
            assert level[other.split(".")[0]] <= level[own], f"{module} imports {other}"


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
            assert all(
                other.startswith(("solvers", "_arguments", "_branches", "_compat", "_moved"))
                for other in imports(module)
            ), module


def test_the_import_switches_nothing_on_and_imports_no_optional_package():
    """Double precision is left to the user."""
    optional = "[m for m in ('matplotlib', 'IPython', 'tqdm', 'mujoco') if m in sys.modules]"
    code = f"import sys, jax, jaxmb; print(jax.config.jax_enable_x64, {optional})"
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "False []"


# Where a concrete class is looked for, whatever the number of times: a comment above says why.
CONCRETE = {
    "bodies.joint_coordinates: JointCoupling",
    "bodies.scene: Gravity",
    "bodies.scene: JointCoupling",
    "lagrangian.hamel: QuasiVelocityFrame",
    "lagrangian.voronets: Connection",
    "parts.dry_friction: JointCoupling",
    "parts.rope: Pulley",
    "solvers.controller: StepEstimate",
    "solvers.tolerances: MultistepNorm",
    "solvers.whole_steps: WithTangents",
    "studies.inverse.required: Trajectory",
    "studies.lqr.lqr: Plan",
    "studies.plan.guess: RequiredForces",
    "studies.sweep.cases: Cases",
    "system.design: Variable",
    "viz.scene: Scene",
}
# The function that they stand in says what they hold beside what others hold.
DESCRIBED = {"simulate.solve: Counted", "solvers.mesh: Counted", "solvers.order: StepEstimate"}


def test_concrete_classes_are_seldom_looked_for():
    """Behaviour is asked of objects."""
    classes = {node.name for module in FILES for node in nodes(module) if isinstance(node, ast.ClassDef)}
    concrete, found = {name for name in classes if not name.startswith("Abstract")} - {"State"}, set()
    for module, path in FILES.items():
        lines = path.read_text().splitlines()
        for node in nodes(module):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "isinstance":
                named = {own.id for own in ast.walk(node.args[1]) if isinstance(own, ast.Name)} & concrete
                found |= (here := {f"{module}: {name}" for name in named})
                above = lines[max(node.lineno - 6, 0) : node.lineno]
                reason = any("A concrete class" in line for line in above)
                assert reason or here <= DESCRIBED, f"{module}:{node.lineno} gives no reason"
    assert found == CONCRETE | DESCRIBED


def is_private(module):
    return module.startswith(PRIVATE_MODULES) or any(part.startswith("_") for part in module.split("."))


def imported(module):
    """The names of other packages that a module imports, with their modules."""
    for node in nodes(module):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield from ((node.module, alias.name) for alias in node.names)


def test_only_compat_uses_private_names_which_exist():
    for module in FILES:
        for source, name in imported(module):
            whole = f"{source}.{name}" if name else source
            if source.startswith("__future__") or not (is_private(source) or whole.startswith(PRIVATE_MODULES)):
                continue
            assert module == "_compat", f"{module} imports {whole}: private names belong in _compat.py"
            package = source.split(".")[0]
            about = f"{package} {importlib.metadata.version(package)} has no {whole}, which jaxmb._compat uses"
            try:
                found = importlib.import_module(source)
            except ImportError:
                pytest.fail(about)
            assert name is None or hasattr(found, name), about
        for node in nodes(module) if module != "_compat" else ():
            if isinstance(node, ast.Attribute):
                about = f"{module}:{node.lineno} uses .{node.attr}, which belongs in _compat.py"
                assert node.attr not in PRIVATE_ATTRIBUTES, about
                assert not (node.attr == "__new__" and getattr(node.value, "id", "") == "object"), about
