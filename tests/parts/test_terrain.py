"""Heights and slopes of terrain."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import TERRAINS
from oracles import tracked_vehicle as oracle

import jaxmb as mb
from jaxmb import planar
from jaxmb.parts import terrain


def smooth_step(s):
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


# A spline has the heights of its points.
HEIGHTS = {
    "flat": lambda x: np.full_like(x, 0.3),
    "bump": lambda x: oracle.bump(x)[0],
    "sinusoid": lambda x: 0.1 * np.sin(np.pi * x + 0.4),
    "slope": lambda x: 1.0 - 0.2 * x,
    "ramp": lambda x: -0.5 * smooth_step((x - 3.0) / 2.0),
    "surface": lambda x: 0.2 * np.cos(x),
}
X = np.linspace(2.5, 6.5, 4001)


@pytest.fixture(scope="module")
def seen():
    """At many places the height, slope and curvature, the outward normal, and the distance of a point at height 1."""

    def at(of, x):
        height = lambda x: of.height(x[None])
        point = jnp.stack([x, jnp.ones_like(x)])
        derivatives = height(x), jax.grad(height)(x), jax.grad(jax.grad(height))(x)
        return *derivatives, terrain.outward(of, point), terrain.distance(of, point)

    every = jax.jit(jax.vmap(lambda x: {name: at(of, x) for name, of in TERRAINS.items()}))
    return jax.tree.map(np.asarray, every(X))


@pytest.mark.parametrize("name", TERRAINS)
def test_terrain_height_and_slope(seen, name):
    """They are those of the formula, and continuous, as curvatures are but for those of the bump at its ends."""
    height, slope, curvature, normal, distance = seen[name]
    if name in HEIGHTS:
        np.testing.assert_allclose(height, HEIGHTS[name](X), rtol=0, atol=1e-14)
    h, largest = X[1] - X[0], np.max(np.abs(curvature)) + 1.0
    # Jumps would show as differences that do not become small with the distance.
    assert np.max(np.abs(np.diff(slope))) <= 1.1 * h * largest
    if name != "bump":
        assert np.max(np.abs(np.diff(curvature))) <= 100 * h * largest
    np.testing.assert_allclose(np.diff(height) / h, 0.5 * (slope[1:] + slope[:-1]), rtol=0, atol=h * largest)
    size = np.hypot(slope, 1.0)
    np.testing.assert_allclose(normal, np.stack([-slope / size, 1.0 / size], axis=1), rtol=0, atol=1e-14)
    np.testing.assert_allclose(distance, (1.0 - height) / size, rtol=0, atol=1e-14)


def test_bump_slope_is_that_of_the_vehicle(seen):
    np.testing.assert_allclose(seen["bump"][1], oracle.bump(X)[1], rtol=0, atol=1e-14)


def test_spline_goes_through_its_points_and_follows_parabolas():
    x, between = np.array([-1.0, 0.0, 0.3, 1.0, 1.5, 2.5]), np.linspace(0.0, 1.5, 31)
    parabola = lambda x: 0.3 - 0.2 * x + 0.5 * x**2
    wild, beyond = np.sin(7 * x), np.array([-3.0, 4.5])
    splines = terrain.Spline(x=x, heights=wild), terrain.Spline(x=x, heights=parabola(x))
    of = lambda heights, x: jax.vmap(terrain.Spline(x=splines[0].x, heights=heights).height)(x[:, None])
    at = np.concatenate([x, beyond, between])
    found = np.asarray(jax.jit(jax.vmap(of, (0, None)))(jnp.stack([s.heights for s in splines]), at))
    np.testing.assert_allclose(found[0, :6], wild, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found[0, 6], wild[0] - 2 * (wild[1] - wild[0]), rtol=1e-13)
    np.testing.assert_allclose(found[1, 8:], parabola(between), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: terrain.Spline(x=[0.0, 0.0, 1.0], heights=[0.0, 0.0, 1.0]), "must ascend"),
        (lambda: terrain.Spline(x=[0.0, 1.0], heights=[0.0, 0.0]), "same length"),
        (lambda: terrain.Bump(start=0.0, length=0.0, peak=0.1), "length must be positive"),
    ],
)
def test_terrain_that_is_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_velocity_over_ground_that_rises():
    """A body that rises with the ground is at rest over it."""
    floor = mb.RigidContact("floor", "body", terrain=terrain.Slope(0.2, level=np.array(-0.3)), radius=0.1)
    level = lambda part: part.terrain.level
    rates = eqx.tree_at(level, eqx.filter(floor, False), np.array(0.4), is_leaf=lambda x: x is None)
    floor = floor.with_fields(drift=rates)
    over = jax.jit(lambda point, velocity: floor.over_ground(point, velocity))
    np.testing.assert_allclose(over(np.array([1.0, 0.2]), np.array([0.6, 0.9])), [0.6, 0.5], rtol=1e-14)


@pytest.mark.slow(but=("flies over rigid ground",))
@pytest.mark.parametrize(
    "case",
    ["flies over rigid ground", "flies over rigid ground by Dopri8", "rolls on rigid ground", "flies over soft ground"],
)
def test_motion_ends_where_terrain_does(case):
    """It does not pass over ground that has no height, and the message says which."""
    ground = terrain.Surface(lambda place, p: jnp.where(place[0] < 1.0, p["h"], jnp.nan), parameters={"h": 0.0})
    disc = planar.Body("disc", mass=1.0, inertia=0.02, position=(0.0, 0.5 if "flies" in case else 0.2), velocity=(4, 0))
    soft = planar.Contact("floor", "disc", terrain=ground, radius=0.2, normal=mb.contact.Linear(1e4))
    rigid, down = mb.RigidContact("floor", "disc", terrain=ground, radius=0.2), mb.Gravity((0.0, -9.81))
    joints, forces = ([], [down, soft]) if "soft" in case else ([rigid], [down])
    system = mb.Scene([disc], joints=joints, forces=forces).compile()
    with pytest.raises(
        RuntimeError, match=r"came to t = 0.25 of 1.*Contact 'floor' .* its Surface .* not finite at 1\."
    ):
        mb.simulate(system, mb.assemble(system), t1=1.0, solver=diffrax.Dopri8() if "Dopri8" in case else None)
