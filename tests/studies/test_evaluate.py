"""Quantities at a state: by closed forms, as along a motion, with derivatives, in batches, and wrong names."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled

import jaxmb as mb
from jaxmb import planar

G, LENGTH, MASS, INERTIA, TORQUE = 9.81, 0.5, 2.0, 0.1, 0.7
ANGLE, RATE = 0.4, 1.3
NAMES = ("pin.angle", "pin.angle_rate", "pin.angle_acceleration", "pin.force", "bar.acceleration", "energy", "motor")


@pytest.fixture(scope="module")
def system():
    """A bar on a pin with a torque, and its twin."""
    bar = planar.Body("bar", mass=MASS, inertia=INERTIA, position=(LENGTH, 0.0))
    twin = planar.Body("twin", mass=MASS, inertia=INERTIA, position=(LENGTH, 3.0))
    pins = [
        planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0)),
        planar.Revolute("other", "ground", "twin", point=(0.0, 3.0)),
    ]
    forces = [mb.Gravity((0.0, -G)), planar.Torque("motor", "bar", torque=TORQUE)]
    scene = mb.Scene([bar, twin], joints=pins, forces=forces).compile()
    return mb.with_inputs(scene, {"motor.torque": lambda t: TORQUE * (1.0 + t)})


def at(angle, rate):
    """The state of the bar, and of its twin at rest."""
    bar = jnp.array([LENGTH * jnp.cos(angle), LENGTH * jnp.sin(angle), angle])
    moves = jnp.array([-LENGTH * jnp.sin(angle), LENGTH * jnp.cos(angle), 1.0]) * rate
    twin = jnp.array([LENGTH, 3.0, 0.0])
    return mb.State(jnp.concatenate([bar, twin]), jnp.concatenate([moves, jnp.zeros(3)]))


def by_hand(angle, rate, mass=MASS, t=0.0):
    """Rotation about a fixed axis: acceleration of the angle and of the mass centre, force of the pin, energy."""
    torque = TORQUE * (1.0 + t)
    inertia = INERTIA + mass * LENGTH**2
    turning = (torque - mass * G * LENGTH * np.cos(angle)) / inertia
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    acceleration = LENGTH * (turning * across - rate**2 * along)
    return {
        "pin.angle": angle,
        "pin.angle_rate": rate,
        "pin.angle_acceleration": turning,
        "bar.acceleration": acceleration,
        "pin.force": mass * acceleration + np.array([0.0, mass * G]),
        "energy": inertia * rate**2 / 2 + mass * G * LENGTH * np.sin(angle) + MASS * G * 3.0,
        "motor": np.array([[0.0, 0.0, -torque], [0.0, 0.0, torque]]),
    }


def test_coordinates_of_bodies_and_their_rates_at_a_state(system):
    values = mb.evaluate(system, at(ANGLE, RATE), ["bar.x", "bar.y_rate", "bar.angle_rate", "twin.position"])
    known = [LENGTH * np.cos(ANGLE), LENGTH * np.cos(ANGLE) * RATE, RATE, [LENGTH, 3.0]]
    for value, expected in zip(values.values(), known, strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-14)


def test_quantities_at_a_state_are_those_of_closed_forms(system):
    state = at(ANGLE, RATE)
    for t in (0.0, 0.5):
        values, known = mb.evaluate(system, state, NAMES, t=t), by_hand(ANGLE, RATE, t=t)
        assert [*values] == [*NAMES]
        for name in NAMES:
            np.testing.assert_allclose(values[name], known[name], rtol=1e-12, atol=1e-13)
    # One name has one array, and parts of one kind have one program.
    assert mb.evaluate(system, state, "pin.angle").shape == ()
    others = [name.replace("pin", "other").replace("bar", "twin") for name in NAMES[:5]]
    with compiled() as programs:
        mb.evaluate(system, at(0.3, RATE), others, t=0.5)
        mb.evaluate(mb.with_parameters(system, {"bar.mass": 3.0}), state, ["bar.acceleration", "energy"])
    assert not programs


def test_wrong_names_and_states(system):
    state = at(ANGLE, RATE)
    other = lambda **changes: {"state": state, "names": "energy"} | changes
    for changes, message in (
        (other(names="pin.angel"), r"Unknown quantity 'pin\.angel'; did you mean 'pin\.angle'"),
        (other(names="bar"), r"Unknown quantity 'bar'; 'bar' has 'bar\.position'"),
        (other(names=["energy", "enrgy"]), "did you mean 'energy'"),
        (other(names="moter"), "did you mean 'motor'"),
        (other(names=["energy", "energy"]), "named twice"),
        (other(names=3), "Give names in a sequence"),
        (other(state=mb.State(state.q[:3], state.u)), r"6 coordinates and 6 velocities, got state\.q of shape \(3,\)"),
        (other(state=mb.State(state.q[None], state.u[None])), r"got state\.q of shape \(1, 6\)"),
        (other(state=state.q), r"must be a jaxmb\.State"),
        (other(t=np.nan), "t must not be NaN"),
        (other(time=0.0), "no argument 'time'; it takes system, state, names, t"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            mb.evaluate(system, **changes)


@pytest.mark.slow
def test_derivatives_at_a_state(system):
    """By the state, a parameter and the time: forward, reverse, and of the closed form."""

    def values(x):
        own = mb.with_parameters(system, {"bar.mass": x[2]})
        out = mb.evaluate(own, at(x[0], x[1]), NAMES, t=x[3])
        return jnp.concatenate([jnp.ravel(out[name]) for name in NAMES])

    known = lambda x: np.concatenate([np.ravel(y) for y in map(by_hand(*x).get, NAMES)])
    x, h = np.array([ANGLE, RATE, 2.5, 0.3]), 1e-5
    forward, reverse = jax.jit(jax.jacfwd(values))(x), jax.jit(jax.jacrev(values))(x)
    differences = np.stack([(known(x + h * step) - known(x - h * step)) / (2 * h) for step in np.eye(4)], axis=1)
    np.testing.assert_allclose(forward, reverse, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(forward, differences, rtol=1e-8, atol=1e-8)
    # Eager, of one name.
    slope = jax.grad(lambda angle: mb.evaluate(system, at(angle, RATE), "energy"))(ANGLE)
    assert slope == pytest.approx(MASS * G * LENGTH * np.cos(ANGLE))


@pytest.mark.slow
def test_states_in_batches(system):
    angles, masses = jnp.array([0.1, 0.4, 1.0]), jnp.array([1.0, 2.0, 3.0])
    force = lambda angle, mass: mb.evaluate(
        mb.with_parameters(system, {"bar.mass": mass}), at(angle, RATE), ["pin.force", "energy"]
    )
    together = mb.batch(force)(angles, masses)
    for k in range(3):
        known = by_hand(angles[k], RATE, masses[k])
        for name, value in together.items():
            np.testing.assert_allclose(value[k], known[name], rtol=1e-12, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["double_wishbone", "rolling_disc", "benenti"])
def test_quantities_of_mechanisms_are_those_of_a_motion(name):
    """Loops, rolling, and a system of generalized coordinates."""
    model = getattr(mb.mechanisms, name)()
    end = model.t1 / 1e3
    motion = mb.simulate(model.system, model.state, t1=end, saveat=jnp.array([0.0, end]), rtol=1e-6)
    names = [*model.system.quantities()][-60:]
    values = mb.evaluate(model.system, motion.end, [*names, "energy"], t=end)
    for quantity in names:
        along = motion.quantity(quantity)[-1]
        np.testing.assert_allclose(values[quantity], along, rtol=1e-9, atol=1e-9 * (1 + np.max(np.abs(along))))
    assert values["energy"] == pytest.approx(float(motion.energy[-1]), rel=1e-9)
