"""The import of the package: what it loads at once, and what at its first use, as if it had been there."""

import ast
import importlib
import inspect
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

import jaxmb as mb

ROOT = Path(mb.__file__).parent
MODULES = {"importers", "lagrangian", "mechanisms", "planar", "report", "spatial", "studies", "viz"}


def printed(code):
    """What a process of its own prints, as a Python value."""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return ast.literal_eval(run.stdout)


def for_type_checkers():
    """The names that stand under `if TYPE_CHECKING`, with the modules that they are imported from."""
    tree = ast.parse(inspect.getsource(mb))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    found = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom) and node.level == 1
        for alias in node.names:
            # The form that makes a name public for type checkers.
            assert alias.name == alias.asname
            found[alias.name] = node.module
    return found


def test_little_is_loaded_at_once():
    """What imports JAX and diffrax has loaded most of what jaxmb needs."""
    code = "import sys, jax, diffrax; before = set(sys.modules); import jaxmb; print(sorted(set(sys.modules) - before))"
    new = printed(code)
    own = [name for name in new if name.split(".")[0] == "jaxmb"]
    assert not MODULES & {name.split(".")[1] for name in own if "." in name}
    # Less than half of the package, and little of the standard library and of NumPy.
    assert len(own) < len(list(ROOT.rglob("*.py"))) / 2 and len(new) - len(own) < 40
    assert not {"optax", "scipy", "matplotlib", "xml", "pandas", "xarray", "zarr"} & {n.split(".")[0] for n in new}


def test_type_checkers_see_the_names_that_are_loaded_later():
    code = "import jaxmb; print([name for name in dir(jaxmb) if name not in vars(jaxmb)])"
    assert set(printed(code)) == for_type_checkers().keys()
    for name, source in for_type_checkers().items():
        module = mb if source is None else importlib.import_module(f"jaxmb.{source}")
        assert getattr(mb, name) is getattr(module, name)


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
    assert modules > MODULES
    assert not modules & {"bodies", "contacts", "linalg", "states"}
    assert not modules & {"simulate", "identify", "linearise", "optimise", "robust", "root_locus", "sweep", "floquet"}


def test_names_that_are_loaded_later_can_be_pickled():
    for name in for_type_checkers():
        if inspect.isclass(getattr(mb, name)):
            assert pickle.loads(pickle.dumps(getattr(mb, name))) is getattr(mb, name)


def test_a_name_that_does_not_exist():
    with pytest.raises(AttributeError, match="module 'jaxmb' has no attribute 'identfy'") as raised:
        mb.identfy  # noqa: B018
    # What Python's "Did you mean: 'identify'?" is made of.
    assert raised.value.name == "identfy" and "identify" in dir(raised.value.obj)
