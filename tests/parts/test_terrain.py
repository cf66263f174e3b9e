"""Heights and slopes of terrain."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import BUMP, TERRAINS
from oracles import tracked_vehicle as oracle

from jaxmb.parts import terrain


@pytest.mark.slow("bump", "spline")
@pytest.mark.parametrize("name", TERRAINS)
def test_heights_and_slopes_are_continuous(name):
    """And curvatures but for those of the bump at its ends."""
    of = TERRAINS[name]
    height = lambda x: of.height(x[None])
    slope = jax.grad(height)
    x = jnp.linspace(2.5, 6.5, 4001)
    values = [np.asarray(jax.vmap(f)(x)) for f in (height, slope, jax.grad(slope))]
    h = float(x[1] - x[0])
    # Jumps would show as differences that do not become small with the distance.
    curvature = np.max(np.abs(values[2])) + 1.0
    assert np.max(np.abs(np.diff(values[1]))) <= 1.1 * h * curvature
    if name != "bump":
        assert np.max(np.abs(np.diff(values[2]))) <= 100 * h * curvature
    np.testing.assert_allclose(
        np.diff(values[0]) / h, 0.5 * (values[1][1:] + values[1][:-1]), rtol=0, atol=h * curvature
    )


@pytest.mark.parametrize("name", TERRAINS)
def test_the_outward_normal_is_normal_to_the_slope_and_upward(name):
    for x in (2.7, 4.1, 5.3):
        slope = float(jax.grad(lambda x: TERRAINS[name].height(x[None]))(x))
        normal = np.asarray(terrain.outward(TERRAINS[name], jnp.array([x, 0.0])))
        np.testing.assert_allclose(normal, np.array([-slope, 1.0]) / np.hypot(slope, 1.0), rtol=0, atol=1e-14)


def test_bump_is_that_of_the_vehicle():
    x = np.linspace(3.5, 6.0, 101)
    height, slope = oracle.bump(x)
    np.testing.assert_allclose(jax.vmap(BUMP.height)(x[:, None]), height, rtol=0, atol=1e-15)
    np.testing.assert_allclose(jax.vmap(jax.grad(BUMP.height))(x[:, None])[:, 0], slope, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_spline_goes_through_its_points_and_follows_parabolas():
    x = np.array([-1.0, 0.0, 0.3, 1.0, 1.5, 2.5])
    at = lambda part, x: jax.vmap(part.height)(jnp.asarray(x)[:, None])
    wild = np.sin(7 * x)
    spline = terrain.Spline(x=x, heights=wild)
    np.testing.assert_allclose(at(spline, x), wild, rtol=0, atol=1e-14)
    np.testing.assert_allclose(at(spline, [-3.0, 4.5])[0], wild[0] - 2 * (wild[1] - wild[0]), rtol=1e-13)
    parabola = lambda x: 0.3 - 0.2 * x + 0.5 * x**2
    between = np.linspace(0.0, 1.5, 31)
    np.testing.assert_allclose(
        at(terrain.Spline(x=x, heights=parabola(x)), between), parabola(between), rtol=0, atol=1e-14
    )
    with pytest.raises(ValueError, match="must ascend"):
        terrain.Spline(x=[0.0, 0.0, 1.0], heights=[0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match="same length"):
        terrain.Spline(x=[0.0, 1.0], heights=[0.0, 0.0])
    with pytest.raises(ValueError, match="length must be positive"):
        terrain.Bump(start=0.0, length=0.0, peak=0.1)
