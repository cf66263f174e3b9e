"""Angles of joints in space count full turns along the run, whatever times are saved."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import jaxmb as mb
from jaxmb import spatial

INERTIA, MASS, PITCH = 0.25, 2.0, 0.3
AXIS = {"point": (0.0, 0.0, 0.0), "axis": (0.0, 0.0, 1.0)}
JOINTS = {
    "hinge": spatial.Revolute("hinge", "ground", "rotor0", **AXIS),
    "sleeve": spatial.Cylindrical("sleeve", "ground", "rotor1", **AXIS),
    "screw": spatial.Screw("screw", "ground", "rotor2", **AXIS, pitch=PITCH),
    "cross": spatial.Universal(
        "cross", "ground", "rotor3", point=(0.0, 0.0, 0.0), axis_a_W=(1.0, 0.0, 0.0), axis_b_W=(0.0, 1.0, 0.0)
    ),
    "table": spatial.Planar("table", "ground", "rotor4", **AXIS),
}
ANGLES = ("hinge.angle", "sleeve.angle", "screw.angle", "cross.angle_a", "cross.angle_b", "table.angle")
# Moments of inertia about the angles: of a sphere on a universal joint both are the sphere's.
INERTIAS = np.full(6, INERTIA) + np.array([0, 0, MASS * (PITCH / (2 * np.pi)) ** 2, 0, 0, 0])
RNG = np.random.default_rng(91)


def rotor(name):
    return spatial.Body(name, mass=MASS, inertia=(INERTIA,) * 3)


@pytest.fixture(scope="module")
def wheel():
    """A rotor on a hinge with a motor."""
    motor = mb.JointForce("motor", "hinge.angle", force=2.0)
    return mb.Scene([rotor("rotor0")], joints=[JOINTS["hinge"]], forces=[motor]).compile()


@pytest.fixture(scope="module")
def rotors():
    """A rotor on each kind of joint with angles, with a motor on each angle."""
    motors = [mb.JointForce(f"motor{k}", name, force=1.0) for k, name in enumerate(ANGLES)]
    return mb.Scene([rotor(f"rotor{k}") for k in range(5)], joints=list(JOINTS.values()), forces=motors).compile()


def turned(rates, forces, t):
    return rates * t + 0.5 * forces / INERTIAS * t**2


def test_a_hinge_saved_at_the_end_only(wheel):
    """By 4 rad, and by 64 turns on from there: the state at the end carries the turns."""
    motion = mb.simulate(wheel, mb.assemble(wheel), t1=1.0)
    assert motion["hinge"].angle[-1] == pytest.approx(4.0, abs=1e-8)
    assert motion.quantity("hinge.angle")[-1] == pytest.approx(4.0, abs=1e-8)
    on = mb.simulate(wheel, jax.tree.map(lambda x: x[-1], motion.ys), t0=1.0, t1=10.0)
    assert on["hinge"].angle[-1] == pytest.approx(400.0, abs=1e-6)
    back = mb.simulate(wheel, jax.tree.map(lambda x: x[-1], on.ys), t0=10.0, t1=0.0)
    assert back["hinge"].angle[-1] == pytest.approx(0.0, abs=1e-6)
    assert on.to_dict()["hinge.angle"][-1] == pytest.approx(400.0, abs=1e-6)


def test_a_hinge_by_steps_of_constant_length(wheel):
    fixed = {"solver": diffrax.Tsit5(), "stepsize_controller": diffrax.ConstantStepSize(), "dt0": 0.02}
    motion = mb.simulate(wheel, mb.assemble(wheel), t1=2.0, **fixed)
    assert motion["hinge"].angle[-1] == pytest.approx(16.0, abs=1e-6)


def test_turns_of_a_state():
    """An angle that is given beyond half a turn; the screw's displacement tells its turns."""
    joints = [JOINTS["hinge"], JOINTS["screw"]]
    system = mb.Scene([rotor("rotor0"), rotor("rotor2")], joints=joints).compile()
    assert system.wrapped_angle_names() == ("hinge.angle",)
    assert mb.assemble(system, fix={"hinge.angle": 3.0}).angles is None
    state = mb.assemble(system, fix={"hinge.angle": 4.0, "screw.angle": -9.0})
    np.testing.assert_array_equal(state.angles, [4.0])
    np.testing.assert_allclose(state.q[9], -9.0 * PITCH / (2 * np.pi), rtol=0, atol=1e-12)
    again = mb.assemble(system, state, rates={"hinge.angle": 1.0})
    np.testing.assert_array_equal(again.angles, [4.0])
    with pytest.raises(ValueError, match=r"has 1 angles known up to full turns, got state.angles of shape \(2,\)"):
        mb.simulate(system, mb.State(state.q, state.u, None, jnp.zeros(2)), t1=1.0)


def cases(rotors, count, rng, rtol=1e-8, times=3, **options):
    """Random rates, moments and times by one program, against closed forms; the largest error."""
    rest = mb.assemble(rotors)
    spins = jnp.stack([mb.assemble(rotors, rates={name: 1.0}).u for name in ANGLES])

    def run(rates, forces, ts):
        system = mb.with_parameters(rotors, {f"motor{k}.force": forces[k] for k in range(6)})
        motion = mb.simulate(
            system, mb.State(rest.q, rates @ spins), t1=ts[-1], saveat=ts, rtol=rtol, max_steps=4096, **options
        )
        return jnp.stack([motion.quantity(name) for name in ANGLES], axis=1), motion["screw"].displacement

    program, largest = jax.jit(run), 0.0
    for _ in range(count):
        rates, forces = rng.normal(size=6) * rng.choice([3.0, 60.0]), rng.normal(size=6)
        ts = np.sort(rng.uniform(0.0, 3.0, times))
        angles, shift = program(rates, forces, ts)
        expected = turned(rates[None], forces[None], ts[:, None])
        largest = max(largest, np.max(np.abs(angles - expected) / (1 + np.abs(expected))))
        np.testing.assert_allclose(shift, expected[:, 2] * PITCH / (2 * np.pi), rtol=0, atol=1e-3)
    return largest


@pytest.mark.slow
def test_random_spins(rotors):
    assert cases(rotors, 60, np.random.default_rng(8)) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hermite", "Tsit5", "coarse"])
def test_random_spins_by_methods(rotors, name):
    options = {
        "hermite": {"solver": mb.solvers.Hermite()},
        "Tsit5": {"solver": diffrax.Tsit5()},
        "coarse": {"rtol": 1e-4},
    }
    assert cases(rotors, 10, np.random.default_rng(9), times=1, **options[name]) < 1e-2


@pytest.mark.slow
def test_ways_to_save(wheel):
    start, error = mb.assemble(wheel), lambda motion: motion["hinge"].angle - 4.0 * motion.ts**2
    for saveat in (
        np.array([0.0, 3.0]),
        np.array([3.0]),
        diffrax.SaveAt(steps=True),
        diffrax.SaveAt(steps=7),
        diffrax.SaveAt(t0=True, t1=True),
        diffrax.SaveAt(ts=jnp.array([1.1, 2.9]), dense=True),
    ):
        motion = mb.simulate(wheel, start, t1=3.0, saveat=saveat)
        np.testing.assert_allclose(error(motion), 0.0, rtol=0, atol=1e-6)
    event = diffrax.Event(lambda t, y, args, **_: t - 2.3, optx.Newton(1e-10, 1e-10))
    motion = mb.simulate(wheel, start, t1=3.0, event=event)
    np.testing.assert_allclose(error(motion), 0.0, rtol=0, atol=1e-6)
    seen = mb.simulate(wheel, start, t1=3.0, saveat=diffrax.SaveAt(t1=True, fn=lambda t, y, args: y.q[3:7]))
    assert seen.ys.shape == (1, 4)


@pytest.mark.slow
def test_derivatives(wheel):
    """Of the angle at the end beyond half a turn: forward mode, reverse mode, a batch, differences."""
    start = mb.assemble(wheel)

    def angle(force, rtol=1e-9):
        return mb.simulate(mb.with_parameters(wheel, {"motor.force": force}), start, t1=1.0, rtol=rtol)["hinge"].angle[
            -1
        ]

    loss = lambda force: -(angle(force) ** 2)
    reverse = float(jax.jit(jax.grad(loss))(2.0))
    assert reverse == pytest.approx(-16.0, rel=1e-7)
    assert jax.jit(lambda x: jax.jvp(loss, (x,), (1.0,)))(2.0)[1] == pytest.approx(reverse, rel=1e-10)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(loss)))(jnp.array([1.0, 3.0])), [-8.0, -24.0], rtol=1e-7)
    np.testing.assert_allclose(mb.batch(angle)(jnp.array([1.0, 30.0])), [2.0, 60.0], rtol=1e-7)
    closer = [float(angle(2.0 + h, 1e-12)) for h in (-1e-3, 1e-3)]
    assert (closer[1] - closer[0]) / 2e-3 == pytest.approx(2.0, rel=1e-7)


@pytest.mark.slow
def test_a_torsion_bar_winds_up_and_back():
    """The angle `A sin(Ω t)` of a rotor on a bar, 33 rad to either side, saved at the end only."""
    bar = mb.FixedTendon("bar", ("hinge.angle",), coefficients=(1.0,))
    spring = mb.JointSpring("spring", "bar.length", stiffness=9 * INERTIA, free=0.0)
    system = mb.Scene([rotor("rotor0")], joints=[JOINTS["hinge"], bar], forces=[spring]).compile()
    state = mb.assemble(system, rates={"hinge.angle": 100.0})
    run = jax.jit(lambda t1: mb.simulate(system, state, t1=t1)["hinge"].angle[-1])
    for t1 in (0.4, 0.9, 1.6, 2.2, 3.0):
        assert run(t1) == pytest.approx(100 / 3 * np.sin(3 * t1), abs=1e-4)


@pytest.mark.slow
def test_a_driver_that_stops_at_once():
    """From 300 rad/s to rest: the rate before a jump says nothing of the step after it."""
    drive = mb.JointDriver("drive", "hinge.angle", value=0.0)
    system = mb.Scene([rotor("rotor0")], joints=[JOINTS["hinge"], drive]).compile()
    given = {"drive.value": mb.Series(np.array([0.0, 1.0, 9.0]), np.array([0.0, 300.0, 300.0]))}
    start = mb.assemble(mb.with_inputs(system, given))
    motion = mb.simulate(system, start, t1=9.0, inputs=given)
    assert motion["hinge"].angle[-1] == pytest.approx(300.0, abs=1e-6)


@pytest.mark.slow
def test_identification_from_few_samples(wheel):
    """Of a moment of inertia from two angles beyond a turn."""
    ts = np.array([1.0, 3.0])
    fit = mb.identify(wheel, {"hinge.angle": 3.2 * ts**2}, ts=ts, free={"motor.force": 2.0})
    assert fit.parameters["motor.force"] == pytest.approx(1.6, rel=1e-6)


@pytest.mark.slow
def test_a_spring_that_is_turned_beyond_its_half_turn(wheel):
    """Its moment jumps there, of which the run warns; within the half turn about `middle` it does not."""
    middle = mb.JointSpring("coil", "hinge.angle", stiffness=1e-6, free=0.5, middle=2.0)
    near = mb.JointSpring("coil", "hinge.angle", stiffness=1e-6, free=0.5)
    motor = mb.JointForce("motor", "hinge.angle", force=2.0)
    for spring, warns in ((near, True), (middle, False)):
        system = mb.Scene([rotor("rotor0")], joints=[JOINTS["hinge"]], forces=[motor, spring]).compile()
        start = mb.assemble(system)
        if warns:
            with pytest.warns(UserWarning, match=r"'coil' jumps where 'hinge.angle' is half a turn from 0.5 rad.*to 4"):
                mb.simulate(system, start, t1=1.0)
        else:
            mb.simulate(system, start, t1=1.0)
