"""The import of the package: what it loads at once, and what at its first use, as if it had been there."""

import ast
import importlib
import inspect
import pickle
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxmb as mb

ROOT = Path(mb.__file__).parent
LATE = {"importers", "lagrangian", "mechanisms", "planar", "report", "spatial", "viz"}


def printed(code):
    """What a process of its own prints, as a Python value."""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return ast.literal_eval(run.stdout)


def stub():
    """The names in the stub, with the modules that they are imported from."""
    tree = ast.parse((ROOT / "__init__.pyi").read_text())
    nodes = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    found = {alias.name: node.module for node in nodes for alias in node.names}
    # The form that makes a name public for type checkers, of names in this package.
    assert all(node.level == 1 and alias.name == alias.asname for node in nodes for alias in node.names)
    assert len(found) == sum(len(node.names) for node in nodes)
    return found


@pytest.mark.slow
def test_nothing_is_loaded_at_once():
    """But for what looks for names; what most motions need loads little besides JAX and diffrax."""
    code = "import sys, jax, diffrax; b = set(sys.modules); import jaxmb; {}; print(sorted(set(sys.modules) - b))"
    own = {name for name in printed(code.format("pass")) if name.split(".")[0] == "jaxmb"}
    assert own == {"jaxmb", *(f"jaxmb._{name}" for name in ("faulty_versions", "moved", "pickled", "version"))}
    new = printed(code.format("jaxmb.simulate, jaxmb.Scene"))
    own = [name for name in new if name.split(".")[0] == "jaxmb"]
    assert not LATE & {name.split(".")[1] for name in own if "." in name}
    # Less than half of the package, and little of the standard library and of NumPy.
    assert len(own) < len(list(ROOT.rglob("*.py"))) / 2 and len(new) - len(own) < 40
    assert not {"optax", "scipy", "matplotlib", "xml", "pandas", "xarray", "zarr"} & {n.split(".")[0] for n in new}


def test_the_stub_has_all_names():
    assert set(mb.__all__) == set(dir(mb)) == stub().keys()
    for name, source in stub().items():
        module = mb if source is None else importlib.import_module(f"jaxmb.{source}")
        assert getattr(mb, name) is getattr(module, name)


@pytest.mark.slow
def test_names_may_be_used_first_in_a_function_that_jax_traces():
    """No array of a module is one of the trace."""
    code = """
import jax, jaxmb
with jax.checking_leaks():
    jax.make_jaxpr(lambda x: [getattr(jaxmb, name) for name in jaxmb.__all__] and x)(1.0)
machine = jaxmb.mechanisms.pendulum()
print(bool(jaxmb.simulate(machine.system, machine.state, t1=1e-3).result == jaxmb.RESULTS.successful))
"""
    assert printed(code)


@pytest.mark.slow
@pytest.mark.parametrize("first", ["import jaxmb", "import jaxmb.report", "from jaxmb.studies.sweep import sweep"])
def test_every_name_is_found_whatever_is_imported_first(first):
    """`simulate` and others are functions with the names of modules."""
    code = f"""
{first}
import inspect, jaxmb
found = {{name: inspect.ismodule(getattr(jaxmb, name)) for name in jaxmb.__all__}}
space = {{}}
exec("from jaxmb import *", space)
assert all(space[name] is getattr(jaxmb, name) for name in found)
print(found)
"""
    modules = {name for name, is_module in printed(code).items() if is_module}
    assert modules > LATE
    assert not modules & {"bodies", "contacts", "linalg", "states"}
    assert not modules & {"simulate", "identify", "linearise", "optimise", "robust", "root_locus", "sweep", "floquet"}


def test_names_that_are_loaded_later_can_be_pickled():
    for name in stub():
        if inspect.isclass(getattr(mb, name)):
            assert pickle.loads(pickle.dumps(getattr(mb, name))) is getattr(mb, name)


def test_a_name_that_does_not_exist():
    with pytest.raises(AttributeError, match="module 'jaxmb' has no attribute 'identfy'") as raised:
        mb.identfy  # noqa: B018
    # What Python's "Did you mean: 'identify'?" is made of.
    assert raised.value.name == "identfy" and "identify" in dir(raised.value.obj)


@pytest.mark.parametrize(
    "module, name, message",
    [
        (mb, "linearize", "jaxmb.linearize is now jaxmb.linearise."),
        (mb.solvers, "intended_step", "not export 'intended_step'; it stands in jaxmb.solvers.controller."),
        (mb.system, "Solved", "it stands in jaxmb.system.quantities."),
        (mb.report, "left_out", "tests/benchmarks/left_out.py of the checkout"),
        (mb.lagrangian, "kinetostatic_forces", "is now the multipliers of Nonholonomic"),
    ],
)
def test_names_that_went_tell_where_they_are(module, name, message):
    with pytest.raises(AttributeError, match=re.escape(message)):
        getattr(module, name)
