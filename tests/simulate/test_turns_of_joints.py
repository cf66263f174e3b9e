"""Angles of joints in space count full turns along the run, whatever times are saved."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from compiling import jit_quickly

import jaxmb as mb
from jaxmb import spatial

INERTIA, MASS, PITCH = 0.25, 2.0, 0.3
AXIS = {"point": (0.0, 0.0, 0.0), "axis": (0.0, 0.0, 1.0)}
ACROSS = {"axis_a_W": (1.0, 0.0, 0.0), "axis_b_W": (0.0, 1.0, 0.0)}
JOINTS = {
    "hinge": spatial.Revolute("hinge", "ground", "rotor0", **AXIS),
    "sleeve": spatial.Cylindrical("sleeve", "ground", "rotor1", **AXIS),
    "screw": spatial.Screw("screw", "ground", "rotor2", **AXIS, pitch=PITCH),
    "cross": spatial.Universal("cross", "ground", "rotor3", point=(0.0, 0.0, 0.0), **ACROSS),
    "table": spatial.Planar("table", "ground", "rotor4", **AXIS),
}
ANGLES = ("hinge.angle", "sleeve.angle", "screw.angle", "cross.angle_a", "cross.angle_b", "table.angle")
# Moments of inertia about the angles: of a sphere on a universal joint both are the sphere's.
INERTIAS = np.full(6, INERTIA) + np.array([0, 0, MASS * (PITCH / (2 * np.pi)) ** 2, 0, 0, 0])


def rotor(name):
    return spatial.Body(name, mass=MASS, inertia=(INERTIA,) * 3)


@pytest.fixture(scope="module")
def wheel():
    """A rotor on a hinge with a motor: its angle is 4 t²."""
    motor = mb.JointForce("motor", "hinge.angle", force=2.0)
    return mb.Scene([rotor("rotor0")], joints=[JOINTS["hinge"]], forces=[motor]).compile()


@pytest.fixture(scope="module")
def rotors():
    """A rotor on each kind of joint with angles, with a motor on each angle."""
    motors = [mb.JointForce(f"motor{k}", name, force=1.0) for k, name in enumerate(ANGLES)]
    return mb.Scene([rotor(f"rotor{k}") for k in range(5)], joints=list(JOINTS.values()), forces=motors).compile()


@pytest.mark.slow
def test_hinge_saved_at_the_end_only_counts_its_turns(wheel):
    """By 4 rad, by 64 turns on from there, and back: the state at the end carries the turns."""

    @jit_quickly
    def run(state, t0, t1):
        motion = mb.simulate(wheel, state, t0=t0, t1=t1, rtol=1e-9)
        return motion["hinge"].angle[-1], motion.end

    state = mb.State(wheel.guess.q, jnp.zeros(wheel.nu), None, jnp.zeros(1))
    for t0, t1, known in ((0.0, 1.0, 4.0), (1.0, 10.0, 400.0), (10.0, 0.0, 0.0)):
        angle, state = run(state, t0, t1)
        np.testing.assert_allclose(angle, known, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_turns_of_a_state():
    """An angle that is given beyond half a turn; the screw's displacement tells its turns."""
    joints = [JOINTS["hinge"], JOINTS["screw"]]
    system = mb.Scene([rotor("rotor0"), rotor("rotor2")], joints=joints).compile()
    assert system.wrapped_angle_names() == ("hinge.angle",)
    state = mb.assemble(system, fix={"hinge.angle": 4.0, "screw.angle": -9.0})
    np.testing.assert_array_equal(state.angles, [4.0])
    np.testing.assert_allclose(state.q[9], -9.0 * PITCH / (2 * np.pi), rtol=0, atol=1e-12)
    assert mb.assemble(system, fix={"hinge.angle": 3.0, "screw.angle": -9.0}).angles is None
    with pytest.raises(ValueError, match=r"has 1 angles known up to full turns, got state.angles of shape \(2,\)"):
        mb.simulate(system, mb.State(state.q, state.u, None, jnp.zeros(2)), t1=1.0)


METHODS = {
    "Adams": (40, 3, {}),
    "Hermite": (10, 1, {"solver": mb.solvers.Hermite()}),
    "Tsit5": (10, 1, {"solver": diffrax.Tsit5()}),
    "coarse": (10, 1, {"rtol": 1e-4}),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_random_spins_of_all_joints(rotors, method):
    """The same at random times, few or many."""
    count, times, options = METHODS[method]
    rng, near = np.random.default_rng(8), 1e-6 if method == "Adams" else 1e-2
    rest = mb.assemble(rotors)
    spins = jnp.stack([mb.assemble(rotors, rates={name: 1.0}).u for name in ANGLES])

    @jax.jit
    def run(rates, forces, ts):
        system, state = mb.with_parameters(rotors, {f"motor{k}.force": forces[k] for k in range(6)}), rest.q
        own = {"rtol": 1e-8, "max_steps": 4096} | options
        motion = mb.simulate(system, mb.State(state, rates @ spins), t1=ts[-1], saveat=ts, **own)
        return jnp.stack([motion.quantity(name) for name in ANGLES], axis=1), motion["screw"].displacement

    for _ in range(count):
        rates, forces = rng.normal(size=6) * rng.choice([3.0, 60.0]), rng.normal(size=6)
        ts = np.sort(rng.uniform(0.0, 3.0, times))
        angles, shift = run(rates, forces, ts)
        known = rates * ts[:, None] + 0.5 * forces / INERTIAS * ts[:, None] ** 2
        assert np.max(np.abs(angles - known) / (1 + np.abs(known))) < near
        np.testing.assert_allclose(shift, known[:, 2] * PITCH / (2 * np.pi), rtol=0, atol=1e-3)


@pytest.mark.slow
def test_turns_are_counted_in_all_ways_to_save(wheel):
    start, at = mb.assemble(wheel), diffrax.SaveAt
    error = lambda motion: np.asarray(motion["hinge"].angle - 4.0 * motion.ts**2)
    event = diffrax.Event(lambda t, y, args, **_: t - 2.3, optx.Newton(1e-10, 1e-10))
    fixed = {"solver": diffrax.Tsit5(), "stepsize_controller": diffrax.ConstantStepSize(), "dt0": 0.02}
    for options in (
        {"saveat": np.array([0.0, 3.0])},
        {"saveat": at(steps=True)},
        {"saveat": at(steps=7)},
        {"saveat": at(ts=jnp.array([1.1, 2.9]), dense=True)},
        {"event": event},
        fixed,
    ):
        np.testing.assert_allclose(error(mb.simulate(wheel, start, t1=3.0, **options)), 0.0, rtol=0, atol=1e-6)
    turned = mb.assemble(wheel, mb.assemble(wheel, fix={"hinge.angle": 4.0}), rates={"hinge.angle": 1.0})
    np.testing.assert_array_equal(turned.angles, [4.0])
    seen = mb.simulate(wheel, start, t1=3.0, saveat=at(t1=True, fn=lambda t, y, args: y.q[3:7]))
    assert seen.ys.shape == (1, 4)


@pytest.mark.slow
def test_derivatives_beyond_half_a_turn(wheel):
    """Of the angle at the end: forward mode, reverse mode, a batch; it is 2 f t²."""
    start = mb.assemble(wheel)

    def loss(force):
        own = mb.with_parameters(wheel, {"motor.force": force})
        return -(mb.simulate(own, start, t1=1.0, rtol=1e-9)["hinge"].angle[-1] ** 2)

    forces = jnp.array([1.0, 2.0, 30.0])
    for mode in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(jax.vmap(mode(loss)))(forces), -8.0 * forces, rtol=1e-7)


@pytest.mark.slow
def test_torsion_bar_winds_up_and_back():
    """The angle `A sin(Ω t)` of a rotor on a bar, 33 rad to either side, saved at the end only."""
    bar = mb.FixedTendon("bar", ("hinge.angle",), coefficients=(1.0,))
    spring = mb.JointSpring("spring", "bar.length", stiffness=9 * INERTIA, free=0.0)
    system = mb.Scene([rotor("rotor0")], joints=[JOINTS["hinge"], bar], forces=[spring]).compile()
    state = mb.assemble(system, rates={"hinge.angle": 100.0})
    run = jax.jit(lambda t1: mb.simulate(system, state, t1=t1)["hinge"].angle[-1])
    for t1 in (0.4, 0.9, 1.6, 2.2, 3.0):
        assert run(t1) == pytest.approx(100 / 3 * np.sin(3 * t1), abs=1e-4)


@pytest.mark.slow
def test_driver_that_stops_at_once():
    """From 300 rad/s to rest: the rate before a jump says nothing of the step after it."""
    drive = mb.JointDriver("drive", "hinge.angle", value=0.0)
    system = mb.Scene([rotor("rotor0")], joints=[JOINTS["hinge"], drive]).compile()
    given = {"drive.value": mb.Series(np.array([0.0, 1.0, 9.0]), np.array([0.0, 300.0, 300.0]))}
    start = mb.assemble(mb.with_inputs(system, given))
    motion = mb.simulate(system, start, t1=9.0, inputs=given)
    assert motion["hinge"].angle[-1] == pytest.approx(300.0, abs=1e-6)


@pytest.mark.slow
def test_spring_that_is_turned_beyond_its_half_turn_warns():
    """Its moment jumps there; within the half turn about `middle` it does not, and a damper never does."""
    motor = mb.JointForce("motor", "hinge.angle", force=2.0)
    stiff, soft = {"stiffness": 1e-6}, {"stiffness": 0.0, "damping": 1e-6}
    for options, warns in ((stiff, True), (stiff | {"middle": 2.0}, False), (soft, False)):
        spring = mb.JointSpring("coil", "hinge.angle", free=0.5, **options)
        system = mb.Scene([rotor("rotor0")], joints=[JOINTS["hinge"]], forces=[motor, spring]).compile()
        run = lambda system=system: mb.simulate(system, mb.assemble(system), t1=1.0)
        if warns:
            with pytest.warns(UserWarning, match=r"'coil' jumps where 'hinge.angle' is half a turn from 0.5 rad.*to 4"):
                run()
        else:
            run()
