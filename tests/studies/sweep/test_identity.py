"""What a store of a sweep knows it by: every change of a machine is another sweep, and the same machine is the same."""

import json
import os
import subprocess
import sys
import threading
import types
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import swept_machines
from swept_machines import CHANGES, of_machine

import jaxmb as mb
from jaxmb import planar
from jaxmb.studies.sweep.identity import identity_of_function

CASES = mb.cases.table(k=[1.0, 2.0])


def identity(function):
    found, unknown = identity_of_function(function)
    assert unknown == {}
    return found


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_is_another_sweep_and_the_same_made_again_is_not(change):
    before, after = CHANGES[change]
    assert identity(before()) == identity(before())
    assert identity(after()) == identity(after())
    assert identity(before()) != identity(after())


@pytest.mark.long
@pytest.mark.parametrize("change", CHANGES)
def test_a_change_of_a_compiled_machine_is_another_sweep(change, monkeypatch):
    scene = swept_machines.machine
    monkeypatch.setattr(swept_machines, "machine", lambda **options: scene(**options).compile())
    before, after = CHANGES[change]
    assert identity(before()) == identity(before()) != identity(after())


def test_another_process_with_other_hashes_knows_all_of_them():
    code = (
        "import json, swept_machines as s\n"
        "from jaxmb.studies.sweep.identity import identity_of_function as identity\n"
        "print(json.dumps({name: [identity(make())[0] for make in both] for name, both in s.CHANGES.items()}))"
    )
    paths = os.pathsep.join([str(Path(swept_machines.__file__).parent), str(Path(mb.__file__).parents[1])])
    environment = os.environ | {"PYTHONPATH": paths, "PYTHONHASHSEED": "123", "JAX_ENABLE_X64": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == {name: [identity(make()) for make in both] for name, both in CHANGES.items()}


def _driven(motion):
    ball = planar.Body("ball", mass=1.0, inertia=1.0)
    return mb.Scene([ball], joints=[planar.Driver("d", "ground", "ball", quantity="angle", motion=motion)])


def _prescribed(motion):
    """What the driver of a scene prescribes."""
    scene = _driven(motion)
    return lambda t: {"angle": scene.joints[0].motion(t, {})}


def _assembled(motion):
    """The angle at which the machine is assembled."""
    system = _driven(motion).compile()
    return lambda t: {"angle": mb.assemble(system, t=t, throw=False).q[2]}


@pytest.mark.parametrize("angle", [_prescribed, pytest.param(_assembled, marks=pytest.mark.long)])
def test_a_machine_under_another_driver_does_not_get_the_results_of_the_first(angle, tmp_path):
    cases, store = mb.cases.table(t=[0.1, 0.2]), tmp_path / "runs.zarr"
    found = mb.sweep(angle(lambda t, p: jnp.sin(t)), cases, store, progress=False)
    np.testing.assert_allclose(found["angle"], np.sin([0.1, 0.2]), rtol=1e-9)
    with pytest.raises(ValueError, match="another sweep: the function differ"):
        mb.sweep(angle(lambda t, p: jnp.sin(5 * t)), cases, store, progress=False)
    # Built anew, it goes on; that the first has been traced and computed makes no difference.
    (store / "status" / "c" / "0").unlink()
    again = mb.sweep(angle(lambda t, p: jnp.sin(t)), cases, store, progress=False)
    assert again.identical(found)


def test_what_a_machine_computes_does_not_change_what_it_is():
    system = mb.mechanisms.get("pendulum").system
    function = lambda k: {"x": k * system.guess.q[0]}
    before = identity(function)
    mb.assemble(system)
    repr(system)
    assert identity(function) == before == identity(function)


def test_what_cannot_be_hashed_needs_a_version(tmp_path):
    lock = threading.Lock()

    def busy(k):
        return {"x": k + float(lock.locked())}

    with pytest.raises(ValueError, match=r"uses busy\.lock, a _thread\.lock, .*Give version="):
        mb.sweep(busy, CASES, tmp_path / "runs.zarr", progress=False)
    assert not (tmp_path / "runs.zarr").exists()
    # Without a store nothing has to be known again.
    np.testing.assert_array_equal(mb.sweep(busy, CASES, progress=False)["x"], [1.0, 2.0])
    for _ in range(2):
        mb.sweep(busy, CASES, tmp_path / "runs.zarr", version="open", progress=False)
    with pytest.raises(ValueError, match="the argument version differ"):
        mb.sweep(busy, CASES, tmp_path / "runs.zarr", version="closed", progress=False)
    with pytest.raises(ValueError, match="version must be a text or an integer, got"):
        mb.sweep(busy, CASES, tmp_path / "runs.zarr", version=1.5, progress=False)


def test_the_path_to_what_cannot_be_hashed_leads_through_the_machine():
    wind = swept_machines.Wind(1.0, {"file": threading.Lock()})
    _, unknown = identity_of_function(of_machine(wind=wind.force))
    (place,) = unknown
    assert place.startswith("<lambda>.system.") and place.endswith(".__self__.options['file']")


def test_of_a_users_module_counts_what_is_read_from_it():

    def made(source):
        module = types.ModuleType("my_parts")
        exec(source, module.__dict__)
        return module

    found = []
    for source in ("spring = lambda k: 2 * k", "spring = lambda k: 3 * k", "spring = lambda k: 2 * k\nother = 1"):
        scope = {"my_parts": made(source)}
        exec("use = lambda k: my_parts.spring(k)", scope)
        found.append(identity(scope["use"]))
    assert found[0] != found[1] and found[0] == found[2]
