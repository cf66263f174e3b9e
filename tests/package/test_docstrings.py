"""The examples in docstrings run, one after the other for each object, on a pendulum."""

import inspect
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial

EXAMPLES = {
    "Scene": mb.Scene,
    "assemble": mb.assemble,
    "simulate": mb.simulate,
    "equilibrium": mb.equilibrium,
    "identify": mb.identify,
    "linearise": mb.linearise,
    "root_locus": mb.root_locus,
    "Trajectory": mb.Trajectory,
    "LagrangianSystem": mb.lagrangian.LagrangianSystem,
    "Force": mb.Force,
    "Series": mb.Series,
}


def example(thing):
    code = re.search(r"```python\n(.*?)```", inspect.getdoc(thing), re.DOTALL)
    assert code is not None
    return code.group(1)


@pytest.fixture(scope="module")
def names():
    """What the examples refer to: modules, and the pendulum of that of `Scene`."""
    scope = {"jax": jax, "jnp": jnp, "np": np, "jaxmb": mb, "planar": planar, "spatial": spatial}
    exec(example(mb.Scene), scope)
    scope["state"] = mb.assemble(scope["system"], fix={"bar.angle": 0.5})
    return scope


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples(name, names):
    scope = dict(names)
    exec(example(EXAMPLES[name]), scope)
    match name:
        case "equilibrium":
            np.testing.assert_allclose(np.sin(scope["hanging"].q[2]), -1.0, atol=1e-9)
            np.testing.assert_allclose(np.sin(scope["upright"].q[2]), 1.0, atol=1e-9)
        case "identify":
            assert scope["fit"].converged
            np.testing.assert_allclose(scope["fit"].parameters["bar.inertia"], 1.0 / 12.0, rtol=1e-6)
        case "linearise":
            # A bar on a pin: the square of its frequency is 3 g / 2 l.
            frequency = np.abs(scope["about_rest"].eigenvalues.imag)
            np.testing.assert_allclose(frequency, np.sqrt(1.5 * 9.81), rtol=1e-9)
        case "Trajectory":
            assert np.ptp(scope["motion"].energy) < 1e-7
