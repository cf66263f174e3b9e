"""Functions of scripts and notebooks that name the package are sent to other processes."""

import pickle
import subprocess
import sys
import types

import cloudpickle
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb._pickled import pickled_by_name

SCRIPT = """
import sys
import jax.numpy as jnp
import numpy as np
import jaxmb as mb
from jaxmb import planar

mb.setup()


def size(x, y):
    pendulum = planar.Body("b", mass=2.0, inertia=planar.rod(2.0, 1.0))
    return {"size": mb.rotations.norm(jnp.stack([x, y])), "mass": pendulum.mass}


def run(**how):
    cases = {"x": np.array([3.0, 5.0, 8.0]), "y": np.array([4.0, 12.0, 15.0])}
    found = mb.sweep(size, cases, progress=False, chunk=2, **how)
    np.testing.assert_allclose(found["size"], [5.0, 13.0, 17.0], rtol=1e-14)
    np.testing.assert_array_equal(found["mass"], 2.0)
"""
WAYS = {
    "processes": "run(processes=2)",
    "dask": """
from distributed import Client, LocalCluster
with LocalCluster(n_workers=1, processes=True, dashboard_address=None) as cluster, Client(cluster) as client:
    run(executor=client.get_executor())
    assert float(client.submit(lambda: mb.rotations.norm(np.array([3.0, 4.0]))).result()) == 5.0
""",
}


def of_a_script(x):
    return mb.rotations.norm(x), planar.rod(2.0, 1.0)


def test_a_function_that_names_the_package_is_sent_by_value():
    function = types.FunctionType(of_a_script.__code__, {"mb": mb, "planar": planar, "__name__": "__main__"})
    size, inertia = cloudpickle.loads(cloudpickle.dumps(function))(np.array([3.0, 4.0]))
    assert float(size) == 5.0 and float(inertia) == pytest.approx(2.0 / 12)
    assert pickle.loads(pickle.dumps(mb)) is mb


@pytest.mark.parametrize("kind", [types.ModuleType, type("Own", (types.ModuleType,), {})])
def test_a_package_of_any_class_is_pickled_by_name(kind, monkeypatch):
    module = kind("some_package")
    monkeypatch.setitem(sys.modules, "some_package", module)
    pickled_by_name("some_package")
    assert cloudpickle.loads(cloudpickle.dumps(module)) is module


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_a_sweep_of_a_script(way, tmp_path):
    script = tmp_path / "script.py"
    body = WAYS[way].strip().replace("\n", "\n    ")
    script.write_text(f"{SCRIPT}\n\nif __name__ == '__main__':\n    {body}\n")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_sweep_of_a_notebook():
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    cells = [nbformat.v4.new_code_cell(source) for source in (SCRIPT, WAYS["processes"])]
    nbclient.NotebookClient(nbformat.v4.new_notebook(cells=cells), timeout=300, kernel_name="python3").execute()
