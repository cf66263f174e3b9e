"""Charts: the equations of motion in independent coordinates, against simulations; derivatives; refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxmb as mb
from jaxmb import planar
from jaxmb.manifold import Chart

MOST_PROGRAMS = 130
FOUR_BAR = mb.mechanisms.four_bar()
# With Euler parameters, redundant rows, rolling, constraints that are not linear in velocities, quasi-velocities.
MACHINES = {
    "double_wishbone": 0.05,
    "bennett": 0.2,
    "parallelogram": 0.3,
    "flyball": 0.05,
    "rolling_disc": 0.2,
    "appell_hamel": 0.2,
    "roller_racer": 0.3,
    "chaplygin_sleigh": 0.2,
}


def by_scipy(chart, x, t1):
    solution = solve_ivp(chart.field, (0.0, t1), x, "DOP853", rtol=1e-12, atol=1e-12)
    return solution.success, chart.state(t1, solution.y[:, -1])


def check_motion(built, t1):
    system, start = built.system, built.state
    chart = Chart.at(system, 0.0, start)
    _, end = by_scipy(chart, np.asarray(chart.coordinates(start)), t1)
    motion = mb.simulate(system, start, t1=t1, rtol=1e-12)
    for found, expected in ((end.q, motion.end.q), (end.u, motion.end.u)):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.max(np.abs(expected)))
    np.testing.assert_allclose(system.position_residual(t1, end.q), 0.0, rtol=0, atol=1e-13)


def test_chart_of_a_four_bar_has_the_motion_of_a_simulation():
    chart = Chart.at(FOUR_BAR.system, 0.0, FOUR_BAR.state)
    assert chart.names == ("crank.angle", "crank.angle_rate")
    assert chart.quality(0.0, FOUR_BAR.state) == 1.0
    check_motion(FOUR_BAR, 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("name", MACHINES)
def test_charts_of_machines_have_the_motions_of_simulations(name):
    check_motion(mb.mechanisms.get(name), MACHINES[name])


def test_chart_has_derivatives_by_its_coordinates_and_parameters():
    """Forward and reverse, of a state and of the field; in a batch too."""
    system, start = FOUR_BAR.system, FOUR_BAR.state
    chart, point = Chart.at(system, 0.0, start), mb.parameters(system)["A.point_b"]

    @jax.jit
    def both(z):
        own = chart.on(mb.with_parameters(system, {"A.point_b": point * z[0]}))
        state = own.state(0.1, z[1:])
        return jnp.concatenate([state.q, state.u, own.field(0.1, z[1:])])

    z = jnp.concatenate([jnp.ones(1), chart.coordinates(start) + 0.01])
    forward, reverse = jax.jacfwd(both)(z), jax.jacrev(both)(z)
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=1e-11 * np.max(np.abs(forward)))
    for k, unit in enumerate(np.eye(z.size)):
        near, far = ((both(z + n * 1e-3 * unit) - both(z - n * 1e-3 * unit)) / (2e-3 * n) for n in (1, 2))
        np.testing.assert_allclose(forward[:, k], (4 * near - far) / 3, rtol=1e-7, atol=1e-7)
    several = jnp.stack([z, z + 1e-3])
    np.testing.assert_allclose(jax.vmap(both)(several), [both(z) for z in several], rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_chart_with_named_coordinates():
    """A coordinate that the search for pivots would make dependent."""
    system, start = FOUR_BAR.system, FOUR_BAR.state
    chart = Chart.at(system, 0.0, start, independent=["rocker.angle"])
    assert chart.names == ("rocker.angle", "rocker.angle_rate")
    x = chart.coordinates(start) + np.array([0.05, 0.3])
    state = chart.state(0.0, x)
    np.testing.assert_allclose(chart.coordinates(state), x, rtol=1e-15)
    np.testing.assert_allclose(system.position_residual(0.0, state.q), 0.0, rtol=0, atol=1e-14)
    np.testing.assert_allclose(system.velocity_residual(0.0, state.q, state.u), 0.0, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_chart_includes_internal_states():
    """Velocity and memory of a cart that a controller with an integrating part holds."""
    cart = planar.Body("cart", mass=2.0, inertia=1.0)
    slide = planar.Prismatic("slide", "ground", "cart", point=(0.0, 0.0), axis=(1.0, 0.0))
    held = mb.Controller(
        "held",
        lambda t, seen, states, p: (-4.0 * seen["place"] - states["integral"], {"integral": seen["place"]}),
        measures={"place": "slide.displacement"},
        acts_on="slide.displacement",
        states={"integral": 0.3},
    )
    system = mb.Scene([cart], joints=[slide], forces=[held]).compile()
    start = mb.assemble(system, fix={"cart.x": 1.0})
    chart = Chart.at(system, 0.0, start)
    assert chart.names == ("cart.x", "cart.x_rate", "held.integral")
    np.testing.assert_allclose(chart.field(0.0, chart.coordinates(start)), [0.0, -4.3 / 2.0, 1.0], atol=1e-14)


@pytest.mark.slow
def test_motion_beyond_the_border_of_a_chart_fails():
    """It would come back on another branch of the constraints."""
    built = mb.mechanisms.heavy_top()
    chart = Chart.at(built.system, 0.0, built.state)
    success, _ = by_scipy(chart, np.asarray(chart.coordinates(built.state)), 0.1)
    assert not success
    assert np.isnan(chart.state(0.0, chart.coordinates(built.state).at[:3].add(10.0)).q).all()


@pytest.mark.slow
def test_chart_has_no_state_where_implied_rows_are_violated():
    """A linkage that moves for one ratio of its lengths only."""
    built = mb.mechanisms.bennett()
    chart, known = Chart.at(built.system, 0.0, built.state), mb.parameters(built.system)
    name = next(key for key in known if key.endswith("point_a") and np.any(np.asarray(known[key]) != 0))
    x = chart.coordinates(built.state)
    assert np.all(np.isfinite(chart.state(0.0, x).q))
    longer = chart.on(mb.with_parameters(built.system, {name: 1.01 * known[name]}))
    assert np.all(np.isnan(longer.state(0.0, x).q)) and np.all(np.isnan(longer.field(0.0, x)))


def test_chart_refuses_states_and_names_that_it_cannot_take():
    system, start = FOUR_BAR.system, FOUR_BAR.state
    with pytest.raises(ValueError, match=r"violates the constraints by 0\.\d+, relative .* jaxmb\.assemble"):
        Chart.at(system, 0.0, mb.State(start.q + 0.1, start.u))
    with pytest.raises(ValueError, match=r"of another system: it has .* coordinates"):
        Chart.at(system, 0.0, mb.State(start.q[:-1], start.u))
    with pytest.raises(ValueError, match=r"Unknown coordinate 'krank\.angle'"):
        Chart.at(system, 0.0, start, independent=["krank.angle"])
    with pytest.raises(ValueError, match=r"takes a list of names: \['crank\.angle'\]"):
        Chart.at(system, 0.0, start, independent="crank.angle")
    with pytest.raises(ValueError, match=r"are not independent\. The system has 2 independent coordinates and veloc"):
        Chart.at(system, 0.0, start, independent=["crank.angle", "rocker.angle"])


@pytest.mark.slow
def test_chart_refuses_a_singular_position():
    """A parallelogram that lies flat."""
    built = mb.mechanisms.four_bar(lengths=(1.0, 2.0, 1.0), base=2.0, angle=0.5)
    q = np.array(built.state.q).reshape(3, 3)
    q[:, :2], q[::2, 2] = [(0.5, 0.0), (2.0, 0.0), (2.5, 0.0)], q[::2, 2] - 0.5
    with pytest.raises(ValueError, match=r"lose rank at the state, at t = 0: a singular position"):
        Chart.at(built.system, 0.0, mb.State(q.ravel(), np.zeros(9)))
