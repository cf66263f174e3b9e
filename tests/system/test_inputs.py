"""Parameters as functions of time: series and functions."""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivative_checks import central_differences, in_both_modes
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.system.inputs import turning_times

MOST_PROGRAMS = 110

G, LENGTH, MASS = 9.81, 0.7, 1.3
INERTIA = MASS * LENGTH**2 / 3
TS = np.linspace(0.0, 1.0, 6)
TORQUES = np.array([0.0, 4.0, -3.0, 5.0, 1.0, -2.0])


@pytest.fixture(scope="module")
def pendulum():
    """A rod on a pin, horizontal at the start, with a motor."""
    rod = planar.Body("rod", mass=MASS, inertia=planar.rod(MASS, LENGTH), position=(LENGTH / 2, 0.0))
    pin = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    motor = planar.Torque("motor", body="rod", torque=0.0)
    return mb.Scene([rod], joints=[pin], forces=[mb.Gravity((0.0, -G)), motor]).compile()


def angle_under(torque, breaks=()):
    """The rod's angle and rate after one second."""
    rates = lambda t, y: [y[1], (torque(t) - MASS * G * LENGTH / 2 * np.cos(y[0])) / INERTIA]
    y, ends = np.zeros(2), [0.0, *breaks, 1.0]
    for a, b in itertools.pairwise(ends):
        y = solve_ivp(rates, (a, np.nextafter(b, a)), y, rtol=1e-12, atol=1e-13).y[:, -1]
    return y


TORQUE = {
    "linear": lambda t: np.interp(t, TS, TORQUES),
    "cubic": CubicSpline(TS, TORQUES),
    "held": lambda t: TORQUES[np.searchsorted(TS, t, side="right") - 1],
}


@pytest.mark.slow
@pytest.mark.parametrize("interpolation", TORQUE)
def test_series_of_a_torque_moves_as_its_own_equations(pendulum, interpolation):
    torque = TORQUE[interpolation]
    inputs = {"motor.torque": mb.Series(TS, TORQUES, interpolation)}
    motion = mb.simulate(pendulum, pendulum.guess, t1=1.0, rtol=1e-11, inputs=inputs)
    found = motion["rod"].angle[-1], motion["rod"].angular_velocity[-1]
    np.testing.assert_allclose(found, angle_under(torque, TS[1:-1]), rtol=0, atol=1e-8)
    # The views know the input, too.
    np.testing.assert_allclose(motion.forces["motor"][-1, 1, 2], torque(1.0), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_series_is_a_spline_without_knots_at_the_second_and_the_last_but_one():
    for count in (2, 3, 4, 9):
        random = np.random.default_rng(count)
        ts, values = np.sort(random.uniform(-1.0, 2.0, count)), random.normal(size=(count, 2))
        spline, series = CubicSpline(ts, values), mb.Series(ts, values, "cubic")
        at = np.concatenate([ts, np.linspace(ts[0], ts[-1], 23)])
        np.testing.assert_allclose(jax.vmap(series)(at), spline(at), rtol=0, atol=1e-11 * np.abs(spline(at)).max())
        # At the first and the last time as well, the derivative is that of the polynomial.
        found = jax.vmap(jax.jacfwd(series))(at[:-1])
        np.testing.assert_allclose(found, spline(at[:-1], 1), rtol=0, atol=1e-11 * np.abs(spline(at, 1)).max())
        outside = jnp.array([ts[0] - 1.0, ts[-1] + 1.0])
        np.testing.assert_array_equal(jax.vmap(series)(outside), values[[0, -1]])


@pytest.mark.slow
def test_series_that_is_shorter_than_a_motion_whose_end_is_traced(pendulum):
    @jax.jit
    def ended(t1):
        inputs = {"motor.torque": mb.Series(TS, TORQUES)}
        return mb.simulate(pendulum, pendulum.guess, t1=t1, inputs=inputs).result._value

    assert ended(TS[-1]) == mb.RESULTS.successful._value
    assert ended(1.1 * TS[-1]) == mb.RESULTS.input_ended._value


@pytest.mark.slow
def test_series_of_a_driver_moves_with_its_rates(pendulum):
    rod = planar.Body("rod", mass=MASS, inertia=planar.rod(MASS, LENGTH), position=(LENGTH / 2, 0.0))
    drive = planar.Driver(
        "drive", "ground", "rod", quantity="angle", motion=lambda t, p: p["angle"], parameters={"angle": 0.0}
    )
    pin = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    system = mb.Scene([rod], joints=[pin, drive]).compile()
    angles = 0.3 * np.sin(3 * TS)
    driven = mb.with_inputs(system, {"drive.angle": mb.Series(TS, angles, "cubic")})
    motion = mb.simulate(driven, mb.assemble(driven), t1=1.0, saveat=np.linspace(0.0, 1.0, 7))
    spline = CubicSpline(TS, angles)
    np.testing.assert_allclose(motion["rod"].angle, spline(motion.ts), rtol=0, atol=1e-12)
    np.testing.assert_allclose(motion["rod"].angular_velocity, spline(motion.ts, 1), rtol=0, atol=1e-12)
    np.testing.assert_allclose(motion.accelerations[:, 2], spline(motion.ts, 2), rtol=0, atol=1e-11)


@pytest.mark.slow
def test_series_with_a_kink_of_a_driven_angle_comes_with_its_impulse():
    def arm(motion, parameters):
        bodies = [
            planar.Body("arm", mass=1.0, inertia=0.1, position=(0.4, 0.0)),
            planar.Body("rod", mass=1.5, inertia=0.2, position=(1.3, 0.0)),
        ]
        joints = [
            planar.Revolute("pin", "ground", "arm", point=(0.0, 0.0)),
            planar.Revolute("elbow", "arm", "rod", point=(0.8, 0.0)),
            planar.Driver("drive", "ground", "arm", quantity="angle", motion=motion, parameters=parameters),
        ]
        return mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, -G))]).compile()

    kinked = arm(lambda t, p: jnp.where(t < 0.6, 0.4 * t, 0.24 + 2.5 * (t - 0.6)), {})
    expected = mb.simulate(kinked, mb.assemble(kinked, rates={"rod.angle": 0.0}), t1=1.1, rtol=1e-10, jumps=[0.6])
    series = mb.Series([0.0, 0.6, 1.1], [0.0, 0.24, 1.49])
    driven = mb.with_inputs(arm(lambda t, p: p["angle"], {"angle": 0.0}), {"drive.angle": series})
    found = mb.simulate(driven, mb.assemble(driven, rates={"rod.angle": 0.0}), t1=1.1, rtol=1e-10)
    np.testing.assert_allclose(found.ys.u, expected.ys.u, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_series_of_a_lagrangian_system():
    system = mb.lagrangian.LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * INERTIA * v[0] ** 2,
        potential=lambda t, q, p: MASS * G * LENGTH / 2 * jnp.sin(q[0]),
        force=lambda t, q, v, p: p["torque"][None],
        q=[0.0],
        parameters={"torque": 0.0},
        coordinates=["angle"],
    )
    inputs = {"torque": mb.Series(TS, TORQUES, "cubic")}
    motion = mb.simulate(system, system.guess, t1=1.0, rtol=1e-10, inputs=inputs)
    np.testing.assert_allclose(motion["angle"][-1], angle_under(CubicSpline(TS, TORQUES))[0], rtol=0, atol=1e-8)


@pytest.mark.slow
def test_inputs_of_a_lagrangian_constraint_take_their_rates_along():
    """A point on a string that is drawn in, beside the same length as a function of time."""

    def system(length):
        return mb.lagrangian.LagrangianSystem(
            kinetic=lambda t, q, v, p: 0.5 * jnp.sum(v**2),
            potential=lambda t, q, p: G * q[1],
            constraints=[mb.lagrangian.Holonomic("string", lambda t, q, p: jnp.sum(q**2) - length(t, p) ** 2)],
            q=[1.0, 0.0],
            parameters={"length": 1.0},
        )

    inputs = {"length": lambda t: 1.0 - 0.3 * t**2}
    own = mb.with_inputs(system(lambda t, p: p["length"]), inputs)
    other = system(lambda t, p: p["length"] - 0.3 * t**2)
    found, expected = (mb.simulate(s, mb.assemble(s), t1=1.0, rtol=1e-10) for s in (own, other))
    assert not own.drift_free
    np.testing.assert_allclose(found.ys.u, expected.ys.u, rtol=0, atol=1e-9)


def test_inputs_that_are_not_there_trace_nothing(pendulum):
    state, t = pendulum.guess, jnp.zeros(())
    text = lambda system: str(jax.make_jaxpr(lambda q, u: system.force(t, q, u))(state.q, state.u))
    driven = mb.with_inputs(pendulum, {"motor.torque": mb.Series(TS, TORQUES)})
    assert "searchsorted" in text(driven) and "searchsorted" not in text(pendulum)


REFUSED = [
    ({"motor.torqe": mb.Series(TS, TORQUES)}, "'motor.torque'"),
    ({"motor.torque": 3.0}, "The input 'motor.torque' must be a jaxmb.Series or a function of time"),
    ({"motor.torque": mb.Series(TS, np.ones((6, 2)))}, r"'motor.torque' must have shape \(\)"),
    ({"rod.mass": mb.Series(TS, TORQUES)}, "'rod.mass' must be constant"),
    ({"gravity.acceleration": lambda t: jnp.zeros(2)}, "'gravity.acceleration' must be constant"),
    ({"pin.point_a": mb.Series(TS, np.ones((6, 2)), "held")}, "'pin.point_a', so it must not jump"),
    ({"motor.torque": mb.Series(TS / 2, TORQUES)}, "'motor.torque' is known from 0 to 0.5 s"),
    ([1.0], "inputs must be a dictionary"),
]
SERIES_REFUSED = [
    (([0.0, 1.0, 0.5], [1.0, 2.0, 3.0]), "ts must ascend, got 1 before 0.5"),
    (([0.0, 1.0], [1.0, np.nan]), "values must be finite, got a non-finite value at t = 1"),
    (([0.0, np.inf], [1.0, 2.0]), "ts must be finite"),
    (([0.0], [1.0]), "at least two times"),
    (([0.0, 1.0], [1.0, 2.0, 3.0]), r"got shapes \(2,\) and \(3,\)"),
    (([0.0, 1.0], ["a", "b"]), "expected a real number"),
    (([0.0, 1.0], [1.0, 2.0], "spline"), "'linear', 'cubic', 'clamped' or 'held'"),
]


@pytest.mark.slow
def test_inputs_that_cannot_be_are_refused(pendulum):
    for inputs, message in REFUSED:
        with pytest.raises(ValueError, match=message):
            mb.simulate(pendulum, pendulum.guess, t1=1.0, inputs=inputs)
    for arguments, message in SERIES_REFUSED:
        with pytest.raises(ValueError, match=message):
            mb.Series(*arguments)
    driven = mb.with_inputs(pendulum, {"motor.torque": mb.Series(TS, TORQUES)})
    with pytest.raises(ValueError, match="is an input of this system"):
        mb.with_parameters(driven, {"motor.torque": 1.0})
    on = planar.Contact("on", "block", terrain=mb.terrain.Flat(), normal=mb.contact.Linear(1e4))
    rub = planar.Friction("rub", "rail", coefficient=0.1)
    for part, name in ((on, "on.centres"), (rub, "rail.point_a")):
        with pytest.raises(ValueError, match=f"'{name}' cannot be an input"):
            mb.with_inputs(sliding([part]), {name: MOVING})


def sliding(forces=(), joints=()):
    """A block of 2 kg on a rail along x, at 0.7 m, and its state at 0.3 m/s."""
    block = planar.Body("block", mass=2.0, inertia=0.1, position=(0.7, 0.0))
    rail = planar.Prismatic("rail", "ground", "block", point_a=(0.0, 0.0), point_b=(0.0, 0.0), axis_a=(1.0, 0.0))
    return mb.Scene([block], joints=[rail, *joints], forces=forces).compile()


# All that is fixed in the ground moves along x at this rate.
SPEED = 0.5
MOVING = lambda t: jnp.stack([SPEED * t, 0.0 * t])


@pytest.mark.slow
def test_inputs_that_move_points_give_their_rates_to_forces():
    """Each damps the rate at which the block moves away from what moves, with a coefficient of its own."""
    control = lambda t, measured, states, parameters: (-8.0 * measured["rate"], {})
    forces = [
        planar.SpringDamper("pair", "ground", "block", stiffness=0.0, damping=1.0, free_length=0.0),
        mb.JointSpring("spring", "rail.displacement", stiffness=0.0, damping=2.0),
        planar.Bushing("bush", "ground", "block", stiffness=(0.0,) * 3, damping=(4.0,) * 3, point=(0.0, 0.0)),
        mb.Controller("control", control, {"rate": "rail.displacement_rate"}, "rail.displacement"),
        mb.Actuator("drive", "rail.displacement", gain=(0.0,) * 3, bias=(0.0, 0.0, -16.0)),
        mb.JointFriction("rub", "rail.displacement", force=32.0, transition_speed=1.0),
        mb.JointStop("stop", "rail.displacement", lower=0.8, upper=2.0, stiffness=0.0, damping=64.0, smoothing=1e-9),
        mb.JointSpring("winch", "cord.length", stiffness=0.0, damping=128.0),
        planar.Damper("oil", "ground", "block", damping=256.0),
        mb.Motor("motor", "rail.displacement", mode="speed", command=0.0, gain=512.0, lag=1.0),
    ]
    cord = mb.Tendon("cord", [("ground", (0.0, 0.0)), ("block", (0.0, 0.0))])
    inputs = dict.fromkeys(("pair.point_a", "bush.point_a", "oil.point_a", "rail.point_a"), MOVING)
    inputs |= {"cord.points": lambda t: jnp.stack([MOVING(t), 0.0 * MOVING(t)])}
    system = mb.with_inputs(sliding(forces, [cord]), inputs)
    state = mb.assemble(system, rates={"block.x": 0.3})
    system, time = system.with_states(state.z), jnp.array(0.0)
    found = mb.formulations.accelerations(system, mb.formulations.Multipliers(), time, state.q, state.u)[0]
    rate = 0.3 - SPEED
    damped = -(1 + 2 + 4 + 8 + 16 + 64 + 128 + 256) * rate - 32 * np.tanh(rate)
    np.testing.assert_allclose(found[0], damped / 2.0, rtol=1e-8)
    np.testing.assert_allclose(system.state_rates(time, state.q, state.u), [-512 * rate])


@pytest.mark.slow
def test_inputs_of_numbers_that_move_nothing():
    """A radius of friction and a free angle only scale and shift; a stop that moves pushes as fast as it comes."""
    bar = planar.Body("bar", mass=1.0, inertia=0.1, angle=0.5)
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    forces = [
        mb.DryFriction("rub", "pin", coefficient=0.3, radius=0.1),
        planar.Bushing("bush", "ground", "bar", stiffness=(0.0,) * 3, damping=(4.0,) * 3, point=(0.0, 0.0)),
        mb.JointStop("stop", "pin.angle", lower=0.6, upper=2.0, stiffness=0.0, damping=64.0, smoothing=1e-9),
    ]
    system = mb.Scene([bar], joints=[pin], forces=forces).compile()
    inputs = {"rub.radius": lambda t: 0.1 + 0.05 * t, "bush.free_angle": lambda t: 0.5 * t}
    still, moving = mb.with_inputs(system, inputs), mb.with_inputs(system, {"stop.lower": lambda t: 0.6 + 0.4 * t})
    time, q = jnp.array(0.0), system.guess.q
    u, seen = jnp.array([0.0, 0.0, 0.3, 0.0]), jnp.array([0.0, 0.0, -0.1, 0.0])
    slip = lambda system: system.velocity_residual(time, q.at[-1].set(2.0), u)[-1]
    np.testing.assert_allclose(slip(still), 0.1 * 0.3, rtol=1e-12)
    force = lambda system, u: system.force(time, q, u)[2]
    np.testing.assert_allclose(force(still, u), force(system, u), rtol=1e-12)
    pin_only = lambda u: force(system, u) + 4.0 * u[2]
    np.testing.assert_allclose(force(moving, u) + 4.0 * 0.3, pin_only(seen), rtol=1e-9)


def test_inputs_have_a_rate_where_any_part_takes_it():
    """A tendon's points are its own, whose rate counts for nothing, and those of a spring that damps."""
    cord = mb.Tendon("cord", [("ground", (0.0, 0.0)), ("block", (0.0, 0.0))])
    winch = mb.JointSpring("winch", "cord.length", stiffness=0.0, damping=1.0)
    points = mb.Series(TS, np.array([[[SPEED * t, 0.0], [0.0, 0.0]] for t in TS]))
    moving = mb.with_inputs(sliding([winch], [cord]), {"cord.points": points})
    (counts,) = (of_rates for _, of_rates in moving.parameter_table.signals.values())
    assert counts


@pytest.mark.slow
def test_inputs_that_move_a_point_of_a_joint_count_in_its_rate():
    system = mb.with_inputs(sliding(), {"rail.point_a": MOVING})
    state = mb.assemble(system, t=2.0, fix={"rail.displacement": 0.3}, rates={"rail.displacement": 0.2})
    np.testing.assert_allclose([state.q[0], state.u[0]], [0.3 + 2.0 * SPEED, 0.2 + SPEED], rtol=1e-12)


@pytest.mark.slow
def test_inputs_that_raise_the_ground_of_contacts():
    """Forces are those on ground at rest of a body that moves downwards as fast, against friction as well."""
    laws = {"normal": mb.contact.Linear(1e4), "friction": mb.contact.Coulomb(0.5, transition_speed=0.1)}
    slope = mb.terrain.Slope(0.3)
    tyre = {"slip_stiffness": 5.0, "coefficient": 0.8, "relaxation_length": 0.2, "damping": 300.0}
    wheel = planar.Body("wheel", mass=1.0, inertia=0.1, position=(0.0, 0.25))
    forces = [
        planar.Contact("contact", "wheel", terrain=slope, radius=0.3, damping=500.0, **laws),
        planar.Tyre("tyre", "wheel", terrain=slope, radius=0.3, normal=laws["normal"], **tyre),
    ]
    still = mb.Scene([wheel], forces=forces).compile()
    levels = {f"{name}.terrain.level": lambda t: SPEED * t for name in ("contact", "tyre")}
    rising = mb.with_inputs(still, levels)
    state = mb.assemble(still)
    u = jnp.array([0.4, -0.2, 1.0])

    def accelerations(system, u):
        system = system.with_states(jnp.array([0.01]))
        return mb.formulations.accelerations(system, mb.formulations.Multipliers(), jnp.array(0.0), state.q, u)[0]

    expected = accelerations(still, u - jnp.array([0.0, SPEED, 0.0]))
    np.testing.assert_allclose(accelerations(rising, u), expected, rtol=1e-12)
    assert np.abs(expected - accelerations(still, u)).max() > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["RollingSphere", "RollingDisc"])
def test_inputs_that_move_a_plane_of_rolling(kind):
    """As on a plane at rest, seen from the plane."""
    ball = spatial.Body("ball", mass=1.0, inertia=spatial.sphere(1.0, 0.1), position=(0.0, 0.0, 0.1))
    axis = {"axis": (0.0, 1.0, 0.0)} if kind == "RollingDisc" else {}
    still = mb.Scene([ball], joints=[getattr(spatial, kind)("rolling", "ball", radius=0.1, **axis)]).compile()
    moving = mb.with_inputs(still, {"rolling.point": lambda t: jnp.stack([SPEED * t, 2 * SPEED * t, 0.0 * t])})
    u = np.array([0.3, 0.1, 0.0, 0.2, -0.5, 0.7])
    residual = jax.jit(lambda system, u: system.velocity_residual(jnp.array(0.0), still.guess.q, u))
    seen = residual(still, u - np.array([SPEED, 2 * SPEED, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(residual(moving, u), seen, atol=1e-12)


@pytest.mark.slow
def test_inputs_that_move_a_rail_with_dry_friction():
    """It drags the block until that moves as the rail does."""
    rub = mb.DryFriction("rub", "rail", coefficient=0.3)
    system = mb.with_inputs(sliding([rub, mb.Gravity((0.0, -G))]), {"rail.point_a": MOVING})
    motion = mb.simulate(system, mb.assemble(system, rates={"block.x": 0.0}), t1=1.0, saveat=[0.1, 1.0], rtol=1e-10)
    drag, stuck = 0.3 * G, SPEED / (0.3 * G)
    np.testing.assert_allclose(motion.ys.q[0, 0], 0.7 + drag * 0.1**2 / 2, rtol=1e-9)
    np.testing.assert_allclose(motion.ys.q[1, 0], 0.7 + SPEED * (1.0 - stuck / 2), rtol=1e-9)


def integrated(rates, y, t1):
    """The end of a motion by SciPy."""
    return solve_ivp(rates, (0.0, t1), y, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


def ramp(d, width):
    """A smooth depth beyond a limit, and its derivative."""
    root = np.sqrt(d * d + width * width)
    return 0.5 * (d + root), 0.5 * (1 + d / root)


@pytest.mark.slow
def test_inputs_that_raise_the_ground_derivatives_of_contacts():
    """A ball on a spring and damper of the ground, and a tyre that slips, by how the ground moves and its stiffness."""
    springs, radius, smoothing, grip = 2000.0, 0.3, 1e-3, {"slip_stiffness": 5.0, "relaxation_length": 0.2}
    common = {"terrain": mb.terrain.Flat(), "normal": mb.contact.Linear(springs), "radius": radius}
    common |= {"damping": 30.0, "damping_depth": 0.02, "smoothing": smoothing}
    bodies = [
        planar.Body("ball", mass=2.0, inertia=0.1, position=(0.0, 0.29)),
        planar.Body("wheel", mass=1.5, inertia=0.1, position=(2.0, 0.295), velocity=(1.0, 0.0), angular_velocity=-5.0),
    ]
    forces = [
        planar.Contact("contact", "ball", **common),
        planar.Tyre("tyre", "wheel", coefficient=0.8, transition_speed=0.1, **grip, **common),
        mb.Gravity((0.0, -G)),
    ]
    system = mb.Scene(bodies, forces=forces).compile()
    start = mb.assemble(system)

    def end(x):
        amplitude, frequency, stiffness = x
        level = lambda t: amplitude * jnp.sin(frequency * t)
        inputs = {f"{name}.terrain.level": level for name in ("contact", "tyre")}
        changed = mb.with_parameters(system, {f"{name}.normal.stiffness": stiffness for name in ("contact", "tyre")})
        motion = mb.simulate(changed, start, t1=0.5, inputs=inputs, rtol=1e-10, max_steps=400)
        y = motion.ys
        return jnp.stack([y.q[-1, 1], y.u[-1, 1], y.q[-1, 3], y.q[-1, 4], y.u[-1, 3], y.u[-1, 5], y.z[-1, 0]])

    def exact(x):
        amplitude, frequency, stiffness = x

        def upwards(t, y, v):
            level, rate = amplitude * np.sin(frequency * t), amplitude * frequency * np.cos(frequency * t)
            depth, slope = ramp(level - y + radius, smoothing)
            s = np.clip(depth / 0.02, 0.0, 1.0)
            engaged = s**3 * (10 + s * (6 * s - 15))
            return stiffness * depth, stiffness * depth * slope - 30.0 * engaged * (v - rate)

        def rates(t, state):
            y, v, _, height, vx, vy, spin, tread = state
            load, push = upwards(t, height, vy)
            friction = 0.8 * load * np.tanh(5.0 * tread / (0.2 * 0.8))
            bends = -(vx + radius * spin) - np.sqrt(vx**2 + 0.1**2) / 0.2 * tread
            own = upwards(t, y, v)[1] / 2.0 - G
            return [v, own, vx, vy, friction / 1.5, push / 1.5 - G, radius * friction / 0.1, bends]

        return integrated(rates, [0.29, 0.0, 2.0, 0.295, 1.0, 0.0, -5.0, 0.0], 0.5)[[0, 1, 2, 3, 4, 6, 7]]

    at = jnp.array([0.02, 12.0, springs])
    value, derivative = in_both_modes(end, at)
    np.testing.assert_allclose(value, exact(at), rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(derivative, central_differences(exact, at), rtol=1e-5, atol=1e-9)


@pytest.mark.slow
def test_inputs_that_shake_a_plate_derivatives_of_rolling():
    """It is taken along by the share `I / (I + m r²)` of the plate's motion, and rises with it."""
    radius, inertia = 0.1, 0.003
    ball = spatial.Body("ball", mass=0.5, inertia=(inertia,) * 3, position=(0.0, 0.0, radius))
    system = mb.Scene([ball], joints=[spatial.RollingSphere("rolling", "ball", radius=radius)]).compile()
    # The plate starts at rest.
    start = mb.assemble(system, rates={"ball.velocity": (0.3, 0.0, 0.0), "ball.angular_velocity": (0.0, 3.0, 0.0)})

    def end(x):
        amplitude, frequency, mass = x
        inputs = {"rolling.point": lambda t: amplitude * (1 - jnp.cos(frequency * t)) * jnp.array([1.0, 2.0, 0.5])}
        changed = mb.with_parameters(system, {"ball.mass": mass})
        motion = mb.simulate(changed, start, t1=1.0, inputs=inputs, rtol=1e-10, max_steps=400)["ball"]
        # Of a turning ball the angular velocity in the world is simple.
        return jnp.concatenate([motion.position[-1], motion.velocity[-1]])

    def exact(x):
        amplitude, frequency, mass = x
        share = inertia / (inertia + mass * radius**2)
        place = amplitude * (1 - jnp.cos(frequency)) * jnp.stack([share, 2 * share, 0.5 + 0 * share])
        rate = amplitude * frequency * jnp.sin(frequency) * jnp.stack([share, 2 * share, 0.5 + 0 * share])
        return jnp.concatenate([place + jnp.array([0.3, 0.0, radius]), rate + jnp.array([0.3, 0.0, 0.0])])

    at = jnp.array([0.2, 4.0, 0.5])
    value, derivative = in_both_modes(end, at)
    np.testing.assert_allclose(value, exact(at), rtol=0, atol=1e-8)
    np.testing.assert_allclose(derivative, jax.jacfwd(exact)(at), rtol=0, atol=1e-7)


@pytest.mark.slow
def test_inputs_that_move_the_point_of_a_knife_edge():
    """A sled with a skate that moves along and across it, against the equations in velocities that turn with it."""
    inertia = 0.2
    sled = planar.Body("sled", mass=1.5, inertia=inertia)
    system = mb.Scene([sled], joints=[planar.KnifeEdge("blade", "sled", point=(0.3, 0.0))]).compile()
    # At the start the skate moves along the sled only.
    start = mb.assemble(system, rates={"sled.x": 1.0, "sled.y": -0.12, "sled.angle": 0.4})

    def end(x):
        amplitude, frequency, mass = x
        point = lambda t: jnp.stack(
            [0.3 + amplitude * jnp.sin(frequency * t), amplitude * (1 - jnp.cos(frequency * t))]
        )
        changed = mb.with_parameters(system, {"sled.mass": mass})
        motion = mb.simulate(changed, start, t1=0.8, inputs={"blade.point": point}, rtol=1e-10, max_steps=400)["sled"]
        return jnp.concatenate([motion.position[-1], motion.velocity[-1], motion.angular_velocity[-1:]])

    def exact(x):
        amplitude, frequency, mass = x
        wave = lambda t: (amplitude * np.sin(frequency * t), amplitude * np.cos(frequency * t))

        def across(t, turning):
            """The velocity of the mass centre across the sled."""
            return -(0.3 + wave(t)[0]) * turning - frequency * wave(t)[0]

        def rates(t, state):
            _, _, angle, ahead, turning = state
            s, c = wave(t)
            arm = 0.3 + s
            push = arm * (ahead * turning - frequency * c * turning - frequency**2 * c)
            aside, (cos, sin) = across(t, turning), (np.cos(angle), np.sin(angle))
            turns = mass * push / (inertia + mass * arm**2)
            return [cos * ahead - sin * aside, sin * ahead + cos * aside, turning, turning * aside, turns]

        x, y, angle, ahead, turning = integrated(rates, [0.0, 0.0, 0.0, 1.0, 0.4], 0.8)
        aside, (cos, sin) = across(0.8, turning), (np.cos(angle), np.sin(angle))
        return np.array([x, y, cos * ahead - sin * aside, sin * ahead + cos * aside, turning])

    at = jnp.array([0.1, 5.0, 1.5])
    value, derivative = in_both_modes(end, at)
    np.testing.assert_allclose(value, exact(at), rtol=0, atol=1e-8)
    np.testing.assert_allclose(derivative, central_differences(exact, at), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_inputs_that_move_a_joint_derivatives_of_its_rate():
    """A rail that travels and turns: by how it does, by the prescribed coordinate and rate, and by the time."""
    system = sliding()

    def start(x):
        amplitude, frequency, place, rate, time = x
        turn = lambda t: amplitude * jnp.sin(frequency * t)
        inputs = {
            "rail.point_a": lambda t: jnp.stack([amplitude * t**2, frequency * t]),
            "rail.axis_a": lambda t: jnp.stack([jnp.cos(turn(t)), jnp.sin(turn(t))]),
            "rail.angle": turn,
        }
        given = {"fix": {"rail.displacement": place}, "rates": {"rail.displacement": rate}}
        state = mb.assemble(mb.with_inputs(system, inputs), t=time, **given)
        return jnp.concatenate([state.q, state.u])

    def exact(x):
        amplitude, frequency, place, rate, time = x

        def pose(time, place):
            turn = amplitude * jnp.sin(frequency * time)
            along, across = amplitude * time**2 + place * jnp.cos(turn), frequency * time + place * jnp.sin(turn)
            return jnp.stack([along, across, turn])

        return jnp.concatenate(jax.jvp(pose, (time, place), (jnp.ones_like(time), rate)))

    many = jnp.array([[0.3, 2.0, 0.4, 0.2, 0.6], [0.2, 3.0, -0.5, 0.7, 0.9]])
    values, derivatives = in_both_modes(start, many[0], many)
    for at, value, derivative in zip(many, values, derivatives, strict=True):
        np.testing.assert_allclose(value, exact(at), rtol=0, atol=1e-11)
        np.testing.assert_allclose(derivative, jax.jacfwd(exact)(at), rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("t0", [0.7, 1.0])
def test_series_held_in_a_run_backward_that_starts_at_a_jump(pendulum, t0):
    """At the last time the value does not jump, but its derivative by the values does."""
    times, values = np.array([0.0, 0.3, 0.7, 1.0]), np.array([1.0, -2.0, 3.0, 3.0])
    rates = lambda t, y, torque: [y[1], (torque - MASS * G * LENGTH / 2 * np.cos(y[0])) / INERTIA]
    y, pieces = np.zeros(2), [(0.7, 0.3, -2.0), (0.3, 0.0, 1.0)]
    for since, until, torque in [(1.0, 0.7, 3.0), *pieces] if t0 == 1.0 else pieces:
        y = solve_ivp(rates, (since, until), y, "DOP853", args=(torque,), rtol=1e-12, atol=1e-13).y[:, -1]

    def motion(values, rtol=1e-11, **options):
        inputs = {"motor.torque": mb.Series(times, values, "held")}
        return mb.simulate(pendulum, pendulum.guess, t0=t0, t1=0.0, rtol=rtol, inputs=inputs, **options)

    saveat = diffrax.SaveAt(t0=True, ts=[t0, 0.5, 0.0], dense=True)
    found = motion(values, saveat=saveat)
    np.testing.assert_allclose(found["rod"].angle[-1], y[0], atol=1e-9)
    np.testing.assert_array_equal(found.ts, [t0, t0, 0.5, 0.0])
    np.testing.assert_allclose(found.at(np.array([t0, 0.5])).q, found.ys.q[1:3], atol=1e-9)
    last = lambda values: motion(values)["rod"].angle[-1]
    forward, reverse = jax.jacfwd(last)(values), jax.jacrev(last)(values)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        forward, central_differences(lambda v: motion(v, 1e-12)["rod"].angle[-1], values), atol=1e-7
    )


# Motors of one kind, each with a series of its own.

MOTORS = 24
SERIES = np.random.default_rng(0).normal(size=(MOTORS, len(TS)))


@pytest.fixture(scope="module")
def driven():
    """Rods side by side with a motor each."""
    bodies = [planar.Body(f"rod{k}", mass=MASS + k, inertia=INERTIA, position=(k + 0.5, 0.0)) for k in range(MOTORS)]
    motors = [planar.Torque(f"motor{k}", body=f"rod{k}", torque=0.1 * k) for k in range(MOTORS)]
    return mb.Scene(bodies, forces=[mb.Gravity((0.0, -G)), *motors]).compile()


def torques(system, ts):
    """The moments on all rods at some times, shape (times, rods)."""
    q, u = system.guess.q, system.guess.u
    force = jax.jit(jax.vmap(lambda system, t: system.force(t, q, u), in_axes=(None, 0)))
    return np.asarray(force(system, ts)).reshape(len(ts), -1, 3)[:, :, 2]


def by_motor(count, interpolation="linear"):
    return {f"motor{k}.torque": mb.Series(TS, SERIES[k], interpolation) for k in range(count)}


def lines(function, *arguments):
    return jax.jit(function).lower(*arguments).as_text().count("\n")


@pytest.mark.slow("cubic")
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_series_of_one_kind_are_one_part_of_the_program(driven, interpolation):
    q, u = driven.guess.q, driven.guess.u
    of = lambda count: mb.with_inputs(driven, by_motor(count, interpolation))
    one, all_ = (lines(lambda s, t: s.force(t, q, u), of(count), 0.3) for count in (1, MOTORS))
    assert one < all_ <= 1.3 * one


@pytest.mark.slow
def test_inputs_of_all_kinds_side_by_side(driven):
    """Each motor has the torque of its own input, and the others their constants."""
    kinds = [
        *(mb.Series(TS, SERIES[k], ("linear", "cubic", "held")[k % 3]) for k in range(9)),
        *(mb.Series(2.0 * TS[:4], SERIES[k][:4]) for k in (9, 10)),
        lambda t: jnp.sin(3.0 * t),
        lambda t: jnp.asarray(7.0),
        mb.Series([0.0, 1.0], SERIES[13][:2], "held"),
    ]
    # In another order than that of the motors.
    names = np.random.default_rng(1).permutation(MOTORS)[: len(kinds)]
    inputs = {f"motor{name}.torque": own for name, own in zip(names, kinds, strict=True)}
    at = np.sort([*np.linspace(-0.1, 1.2, 14), *TS])
    found = torques(mb.with_inputs(driven, inputs), at)
    for k in range(MOTORS):
        own = inputs.get(f"motor{k}.torque")
        expected = np.full(at.shape, 0.1 * k) if own is None else jax.jit(jax.vmap(own))(at)
        np.testing.assert_allclose(found[:, k], expected, rtol=2e-15)


def test_inputs_in_place_of_one_of_several(driven):
    first = mb.with_inputs(driven, by_motor(4))
    again = mb.with_inputs(first, {"motor2.torque": mb.Series(TS, -SERIES[2]), "motor9.torque": mb.Series(TS, TORQUES)})
    assert list(again.parameter_table.signals) == [f"motor{k}.torque" for k in (0, 1, 3, 2, 9)]
    found = torques(again, TS)
    for k, values in {0: SERIES[0], 1: SERIES[1], 2: -SERIES[2], 3: SERIES[3], 9: TORQUES}.items():
        np.testing.assert_allclose(found[:, k], values, rtol=2e-15)
        np.testing.assert_array_equal(again.parameter_table.signals[f"motor{k}.torque"][0].values, values)
    with pytest.raises(ValueError, match=r"The series of 'motor0.torque' is known from 0 to 1 s"):
        mb.simulate(again, again.guess, t1=1.5)
    with pytest.raises(ValueError, match=r"'motor3.torque' is an input of this system"):
        mb.with_parameters(again, {"motor3.torque": 1.0})


def test_series_of_a_batch_and_traced_ones(driven):
    scales = jnp.array([1.0, -2.0])

    @jax.jit
    def moments(scale):
        inputs = {name: mb.Series(own.ts, scale * own.values) for name, own in by_motor(5).items()}
        system = mb.with_inputs(driven, inputs)
        return jax.vmap(lambda t: system.force(t, driven.guess.q, driven.guess.u))(TS)

    found = np.asarray(jax.vmap(moments)(scales)).reshape(2, len(TS), MOTORS, 3)[..., :5, 2]
    np.testing.assert_allclose(found, np.asarray(scales)[:, None, None] * SERIES[:5].T, rtol=2e-15)


@pytest.mark.slow
def test_series_that_pulse_are_passed_by_no_step(driven):
    """Steps end where each of the series turns, as with each of them alone."""
    q, u = driven.guess.q, driven.guess.u
    pulses = {f"motor{k}.torque": mb.Series(TS, np.eye(len(TS))[k + 1]) for k in range(3)}
    finite = lambda inputs: [
        time
        for time in np.asarray(turning_times(mb.with_inputs(driven, inputs), mb.State(q, u), 0.0, 1.0))
        if time < 1.0
    ]
    alone = [time for name, own in pulses.items() for time in finite({name: own})]
    np.testing.assert_array_equal(finite(pulses), np.sort(alone))
    np.testing.assert_allclose(alone, TS[1:4])


@pytest.fixture(scope="module")
def two_motors():
    """Two rods, one on the other, each with a motor; and a pin that a series moves."""
    bodies = [planar.Body(f"rod{k}", mass=MASS, inertia=INERTIA, position=(k + 0.5, 0.0)) for k in range(2)]
    pins = [planar.Revolute("pin0", "ground", "rod0", point=(0.0, 0.0))]
    pins.append(planar.Revolute("pin1", "rod0", "rod1", point=(1.0, 0.0)))
    motors = [planar.Torque(f"motor{k}", body=f"rod{k}", torque=0.0) for k in range(2)]
    return mb.Scene(bodies, joints=pins, forces=[mb.Gravity((0.0, -G)), *motors]).compile()


@pytest.mark.slow
def test_series_derivatives_by_values_and_times(two_motors):
    def angle(x, rtol):
        values, shift = x[:-1].reshape(2, -1), x[-1]
        ts = [TS, TS * (1.0 + 0.1 * shift)]
        series = [mb.Series(t, own, "cubic") for t, own in zip(ts, values, strict=True)]
        inputs = {f"motor{k}.torque": own for k, own in enumerate(series)}
        return mb.simulate(two_motors, two_motors.guess, t1=0.8, rtol=rtol, inputs=inputs, max_steps=512)["rod1"].angle[
            -1
        ]

    x = jnp.append(jnp.asarray(SERIES[:2].ravel()), 0.1)
    forward = jax.jit(jax.jacfwd(lambda x: angle(x, 1e-9)))(x)
    reverse = jax.jit(jax.grad(lambda x: angle(x, 1e-9)))(x)
    np.testing.assert_allclose(forward, reverse, rtol=1e-7, atol=1e-10)
    changes = 1e-3 * np.eye(len(x))
    moved = np.asarray(x)[None] + np.concatenate([changes, -changes])
    both = jax.jit(jax.vmap(lambda x: angle(x, 1e-11)))(moved)
    differences = (both[: len(x)] - both[len(x) :]) / 2e-3
    np.testing.assert_allclose(forward, differences, rtol=0, atol=1e-6)
