"""What a store of a sweep knows it by: its program, in which every number counts, and words do not."""

import functools
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import swept_functions
from swept_functions import CHANGES

import jaxmb as mb
from jaxmb import planar
from jaxmb.studies.sweep.outputs import declared

CASES = mb.cases.table(k=[1.0, 2.0])


def identity(function, name="k"):
    _, digest = declared(function, {name: np.array(1.0)})
    assert digest.unknown == ()
    return digest.value.hex()


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_is_another_sweep_and_the_same_made_again_is_not(change):
    before, after = CHANGES[change]
    assert identity(before()) == identity(before())
    assert identity(after()) == identity(after())
    assert identity(before()) != identity(after())


def test_words_make_no_difference():
    assert identity(swept_functions.plain) == identity(swept_functions.told, "speed")
    assert identity(swept_functions.plain) == identity(functools.partial(lambda f, k: {"y": f * k}, 2))


@pytest.mark.slow
def test_another_process_with_other_hashes_knows_all_of_them():
    code = (
        "import json, numpy as np, swept_functions as s\n"
        "from jaxmb.studies.sweep.outputs import declared\n"
        "of = lambda make: declared(make(), {'k': np.array(1.0)})[1].value.hex()\n"
        "print(json.dumps({name: list(map(of, both)) for name, both in s.CHANGES.items()}))"
    )
    paths = os.pathsep.join([str(Path(swept_functions.__file__).parent), str(Path(mb.__file__).parents[1])])
    environment = os.environ | {"PYTHONPATH": paths, "PYTHONHASHSEED": "123", "JAX_ENABLE_X64": "1"}
    environment |= {"JAX_NUMPY_DTYPE_PROMOTION": "strict", "JAX_NUMPY_RANK_PROMOTION": "raise"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == {name: [identity(make()) for make in both] for name, both in CHANGES.items()}


def _driven(motion):
    ball = planar.Body("ball", mass=1.0, inertia=1.0)
    driver = planar.Driver("d", "ground", "ball", quantity="angle", motion=motion)
    return mb.Scene([ball], joints=[driver]).compile()


def test_a_machine_under_another_driver_does_not_get_the_results_of_the_first(tmp_path):
    cases, store = mb.cases.table(t=[0.1, 0.2]), tmp_path / "runs.zarr"

    def error(motion):
        system = _driven(motion)
        return lambda t: {"error": system.position_residual(t, jnp.zeros(3))}

    found = mb.sweep(error(lambda t, p: jnp.sin(t)), cases, store, progress=False)
    np.testing.assert_allclose(found["error"][:, 0], -np.sin([0.1, 0.2]), rtol=1e-12)
    with pytest.raises(ValueError, match=r"another sweep: it differs in the function\."):
        mb.sweep(error(lambda t, p: jnp.sin(5 * t)), cases, store, progress=False)
    # Built anew, it goes on; that the first has been traced and computed makes no difference.
    (store / "status" / "c" / "0").unlink()
    again = mb.sweep(error(lambda t, p: jnp.sin(t)), cases, store, progress=False)
    assert again.identical(found)


@pytest.mark.slow
def test_sweeps_of_motions_and_of_their_gradients_are_known_again():
    def runs(speed):
        scene = mb.mechanisms.pendulum().scene
        pushed = scene.extended(
            forces=[mb.Force("push", scene.bodies[0].name, lambda x, v, t, p: -speed * v.at[:, 2].set(0.0))]
        )
        system = pushed.compile()

        def motion(k):
            changed = mb.with_parameters(system, {"gravity.acceleration": jnp.array([0.0, -1.0]) * k})
            return mb.simulate(changed, mb.assemble(changed, throw=False), t1=0.1, throw=False).ys.q[-1]

        slope = jax.grad(lambda k: jnp.sum(motion(k)))
        return lambda k: {"q": motion(jnp.asarray(k, float))}, lambda k: {"q": slope(jnp.asarray(k, float))}

    for first, again, other in zip(runs(1.0), runs(1.0), runs(2.0), strict=True):
        assert identity(first) == identity(again) != identity(other)


def test_what_calls_python_needs_a_version(tmp_path):
    def busy(k):
        return {"x": jax.pure_callback(lambda k: np.asarray(k), jax.ShapeDtypeStruct((), k.dtype), k)}

    with pytest.raises(ValueError, match=r"calls .*busy.*lambda.* from Python, .*Give version="):
        mb.sweep(busy, CASES, tmp_path / "runs.zarr", progress=False)
    assert not (tmp_path / "runs.zarr").exists()
    with pytest.raises(ValueError, match="version must be a text or an integer, got"):
        mb.sweep(busy, CASES, tmp_path / "runs.zarr", version=1.5, progress=False)
    store, plain = tmp_path / "plain.zarr", swept_functions.plain
    for _ in range(2):
        mb.sweep(plain, CASES, store, version="open", progress=False)
    with pytest.raises(ValueError, match="differs in the argument version"):
        mb.sweep(plain, CASES, store, version="closed", progress=False)


def test_a_store_of_an_older_version_is_read_and_not_continued(tmp_path):
    store = tmp_path / "runs.zarr"
    found = mb.sweep(swept_functions.plain, CASES, store, progress=False)
    metadata = json.loads((store / "zarr.json").read_text())
    metadata["attributes"]["python"] = metadata["attributes"].pop("jax_version")
    (store / "zarr.json").write_text(json.dumps(metadata))
    with pytest.raises(ValueError, match=r"another sweep: it was made by jaxmb .* by other marks .*load_sweep"):
        mb.sweep(swept_functions.plain, CASES, store, progress=False)
    np.testing.assert_array_equal(mb.load_sweep(store)["x"], found["x"])
    assert mb.sweep(swept_functions.plain, CASES, store, overwrite=True, progress=False)["x"].identical(found["x"])
