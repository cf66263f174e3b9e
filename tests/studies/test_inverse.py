"""Inverse dynamics: the forces of actuators from a motion."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import four_bar_forces
from trajectories import motion_of

import jaxmb as mb
from jaxmb import mechanisms, planar, spatial

LENGTHS, BASE, MASSES, GRAVITY = (1.0, 3.0, 2.5), 2.5, (1.0, 3.0, 2.5), 9.81
TS = np.linspace(0.0, 1.0, 5)


def crank(t):
    return 0.4 + 2.0 * t + 0.3 * jnp.sin(3.0 * t)


CRANK = 0.4 + 2.0 * TS + 0.3 * np.sin(3.0 * TS), 2.0 + 0.9 * np.cos(3.0 * TS), -2.7 * np.sin(3.0 * TS)


@functools.cache
def four_bar():
    """The linkage with a motor on the crank."""
    scene = mechanisms.four_bar(lengths=LENGTHS, base=BASE, masses=MASSES, gravity=GRAVITY).scene
    return scene.extended(forces=[mb.JointForce("motor", "A.angle", force=3.0)]).compile()


@functools.cache
def needed(*by):
    return mb.required_forces(four_bar(), {"crank.angle": crank}, ts=TS, by=by)


def by_hand(driven):
    torques, pins = zip(
        *(four_bar_forces.forces(LENGTHS, BASE, MASSES, GRAVITY, *at, driven) for at in zip(*CRANK, strict=True)),
        strict=True,
    )
    return np.array(torques), np.array(pins)


def test_a_crank_and_its_pins_as_by_newton_and_euler():
    torques, pins = by_hand("crank")
    found = needed("motor")
    np.testing.assert_allclose(found["motor"], torques, rtol=1e-12)
    np.testing.assert_allclose(found.power["motor"], torques * CRANK[1], rtol=1e-12)
    for k, name in enumerate("ABCD"):
        np.testing.assert_allclose(found.reaction(name).force, pins[:, k], rtol=1e-11, atol=1e-11)


def test_a_rocker_that_drives_has_the_same_power():
    torques, _ = by_hand("rocker")
    # The motor on the crank stays, with its torque of 3 N m.
    rates = np.array([four_bar_forces.motion(LENGTHS, BASE, *at)[1] for at in zip(*CRANK, strict=True)])
    expected = torques - 3.0 * rates[:, 0] / rates[:, 2]
    np.testing.assert_allclose(needed("D.angle")["D.angle"], expected, rtol=1e-12)
    work = needed("motor").power["motor"] - 3.0 * CRANK[1]
    np.testing.assert_allclose(needed("D.angle").power["D.angle"], work, rtol=1e-12)


def test_a_coordinate_adds_to_the_forces_of_the_machine():
    np.testing.assert_allclose(needed("A.angle")["A.angle"], needed("motor")["motor"] - 3.0, rtol=1e-12)
    np.testing.assert_allclose(needed("crank.angle")["crank.angle"], needed("A.angle")["A.angle"], rtol=1e-12)
    np.testing.assert_allclose(needed("motor.force")["motor.force"], needed("motor")["motor"], rtol=1e-12)


def test_weights_choose_the_least_of_more_forces():
    weights = {"motor": 1.0, "D.angle": 4.0}
    found = mb.required_forces(four_bar(), {"crank.angle": crank}, ts=TS, by=["motor", "D.angle"], weights=weights)
    rates = np.array([four_bar_forces.motion(LENGTHS, BASE, *at)[1] for at in zip(*CRANK, strict=True)])
    # The least norm with one freedom: each force as its rate over its weight.
    power = by_hand("crank")[0] * CRANK[1]
    share = power / (rates[:, 0] ** 2 + rates[:, 2] ** 2 / 4.0)
    np.testing.assert_allclose(found["motor"], share * rates[:, 0], rtol=1e-11)
    np.testing.assert_allclose(found["D.angle"], share * rates[:, 2] / 4.0, rtol=1e-11)


@pytest.mark.slow
def test_measured_positions_and_series():
    """A cubic spline has second derivatives with errors of the square of the interval."""
    errors = []
    for count in (41, 81):
        ts = np.linspace(0.0, 1.0, count)
        measured = mb.Measurements(ts, {"A.angle": np.asarray(crank(ts))})
        found = mb.required_forces(four_bar(), measured, by=["motor"])
        at = np.searchsorted(ts, TS[1:-1])
        errors.append(np.max(np.abs(found["motor"][at] - by_hand("crank")[0][1:-1])))
        series = {"A.angle": mb.Series(ts, crank(ts), "cubic")}
        same = mb.required_forces(four_bar(), series, by=["motor"])
        np.testing.assert_allclose(same["motor"], found["motor"], rtol=1e-12)
    assert 3.5 < errors[0] / errors[1] < 4.5 and errors[1] < 0.05


def swung(system, speed=2.0):
    """A trajectory through a state with some velocities, whose accelerations are those of the system."""
    u = jnp.asarray(np.random.default_rng(0).normal(size=system.nu) * speed)
    state = mb.assemble(system, mb.State(system.guess.q, u, system.guess.z), throw=False)
    return motion_of(system, [0.0], state.q[None], state.u[None], None if state.z is None else state.z[None])


def with_motor(name, coordinate, **parameters):
    scene = mechanisms.get(name, **parameters).scene
    return scene.extended(forces=[mb.JointForce("motor", coordinate, force=3.0)]).compile()


def rolling_disc():
    """Three freedoms, two of which are free of forces."""
    engine = spatial.Torque("engine", "disc", torque=(0.0, 2.0, 0.0), frame="body")
    return mechanisms.rolling_disc().scene.extended(forces=[engine]).compile()


def rough_slider():
    """A hinge and a slide that rub."""
    scene = mechanisms.slider_crank().scene
    rub = [planar.Friction("rub", "A", coefficient=0.3, radius=0.05, transition_speed=0.01)]
    return scene.extended(forces=[*rub, mb.JointForce("motor", "A.angle", force=3.0)]).compile()


# Machines, and the forces of their actuators, with weights of all that are more than the freedoms.
DRIVEN = {
    "rockers": (lambda: with_motor("parallelogram", "foot1.angle"), {"motor": 3.0}),
    "rolling": (rolling_disc, {"engine.torque": (0.0, 2.0, 0.0)}),
    "rolling by coordinates": (rolling_disc, {"disc.wx": 0.0, "disc.wy": 0.0, "disc.wz": 0.0}),
    "rough": (rough_slider, {"motor": 3.0}),
}
LONG = {
    "slider_crank": (lambda: with_motor("slider_crank", "A.angle"), {"motor": 3.0}),
    "slider_crank by the slide": (
        lambda: with_motor("slider_crank", "A.angle", angle=1.0),
        {"slide.displacement": 0.0},
    ),
    "andrews": (lambda: mechanisms.andrews().system, {"drive.torque": 0.033}),
    "bricard": (lambda: with_motor("bricard", "P2.angle"), {"motor": 3.0}),
    "bennett": (lambda: with_motor("bennett", "hinge3.angle"), {"motor": 3.0}),
    "swash_plate": (lambda: with_motor("swash_plate", "bearing.angle"), {"motor": 3.0}),
    "spherical_four_bar": (
        lambda: mechanisms.spherical_four_bar(model="rigid_bodies", torque=2.0).system,
        {"drive.torque": (0.0, 0.0, 2.0)},
    ),
}


@pytest.mark.parametrize("name", [*DRIVEN, *(pytest.param(name, marks=pytest.mark.slow) for name in LONG)])
def test_forces_come_back(name):
    make, expected = (DRIVEN | LONG)[name]
    system = make()
    motion = swung(system)
    several = sum(np.size(force) for force in expected.values()) > system.nu - system.acceleration_rank
    weights = dict.fromkeys(expected, 1.0) if several else None
    found = mb.required_forces(system, motion, by=list(expected), weights=weights)
    for actuator, force in expected.items():
        np.testing.assert_allclose(found[actuator][0], force, rtol=1e-9, atol=1e-9)


def test_a_lagrangian_system_with_rolling():
    machine = mechanisms.roller_racer()
    motion = motion_of(machine.system, [0.0], machine.state.q[None], machine.state.u[None])
    found = mb.required_forces(machine.system, motion, by=["u0", "u1"])
    np.testing.assert_allclose([found["u0"][0], found["u1"][0]], [0.0, 0.0], atol=1e-11)


def driven_bar(*drives, **forces):
    bar = spatial.Body("bar", mass=2.0, inertia=(0.1, 1.0 / 6.0, 1.0 / 6.0), position=(0.5, 0.0, 0.0))
    pin = spatial.Revolute("pin", "ground", "bar", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    return mb.Scene([bar], joints=[pin, *drives], forces=[mb.Gravity((0.0, 0.0, -9.81)), *forces.values()]).compile()


RAMP = {"motion": lambda t, p: p["rate"] * t**2, "parameters": {"rate": 0.5}}
DRIVERS = {
    "Driver": lambda: spatial.Driver("turn", "ground", "bar", quantity="angle", axis=(0.0, 1.0, 0.0), **RAMP),
    "JointDriver": lambda: mb.JointDriver("turn", "pin.angle"),
    "Servo": lambda: mb.Servo(
        spatial.Driver("turn", "ground", "bar", quantity="angle", axis=(0.0, 1.0, 0.0), **RAMP), 3.0, 40.0
    ),
}


@pytest.mark.parametrize("kind", DRIVERS)
def test_force_and_rate_of_a_drive_are_its_power(kind):
    """Also of a servo that is off its program: there the force along the angle is less than its multiplier."""
    system = driven_bar(DRIVERS[kind]())
    if kind == "JointDriver":
        system = mb.with_inputs(system, {"turn.value": lambda t: 0.5 * t**2})
    free = {"fix": {"pin.angle": 0.9}, "rates": {"pin.angle": 0.4}} if kind == "Servo" else {}
    state = mb.assemble(system, t=0.3, **free)
    motion = motion_of(system, [0.3], state.q[None], state.u[None])
    rate, acceleration = motion["pin"].angle_rate[0], motion["pin"].angle_acceleration[0]
    angle = motion["pin"].angle[0]
    # About the axis y a positive turn lowers the bar.
    torque = 2.0 / 3.0 * acceleration - 2.0 * 9.81 * 0.5 * jnp.cos(angle)
    np.testing.assert_allclose(motion["turn"].drive_force, [torque], rtol=1e-10)
    found = mb.required_forces(system, motion, by=["turn"])
    np.testing.assert_allclose(found["turn"], [torque], rtol=1e-10)
    np.testing.assert_allclose(found.power["turn"], [torque * rate], rtol=1e-10)


@pytest.mark.slow
def test_a_motor_and_its_force():
    motor = mb.Motor("motor", "pin.angle", command=2.0, lag=0.1, force=1.5)
    system = driven_bar(motor=motor)
    motion = swung(system)
    np.testing.assert_allclose(motion["motor"].drive_force, [1.5])
    np.testing.assert_allclose(mb.required_forces(system, motion, by=["motor"])["motor"], [1.5], rtol=1e-10)
    # Without its motor the bar has no internal states, so positions are enough.
    still = mb.required_forces(system, {"pin.angle": lambda t: 0.2 + 0.0 * t}, ts=[0.0, 1.0], by=["motor"])
    np.testing.assert_allclose(still["motor"], -9.81 * np.cos(0.2) * np.ones(2), rtol=1e-10)
    with pytest.raises(ValueError, match="do not determine motor"):
        mb.required_forces(system, {"pin.angle": lambda t: 0.2}, ts=[0.0, 1.0], by=["pin.angle"])


@pytest.mark.slow
def test_an_input_that_is_sought():
    """The parameter of a force that drove the motion as a function of time."""
    engine = spatial.Torque("engine", "bar", torque=(0.0, 0.0, 0.0))
    system = mb.with_inputs(driven_bar(engine=engine), {"engine.torque": lambda t: jnp.sin(t) * jnp.eye(3)[1]})
    state = mb.assemble(system, rates={"pin.angle": 0.4}, t=0.7)
    motion = motion_of(system, [0.7], state.q[None], state.u[None])
    weights = {"engine.torque": 1.0}
    found = mb.required_forces(system, motion, by=["engine.torque"], weights=weights)
    np.testing.assert_allclose(found["engine.torque"], [[0.0, np.sin(0.7), 0.0]], atol=1e-10)


def torque_of(parameters, values):
    system = mb.with_parameters(four_bar(), parameters)
    motion = {"crank.angle": mb.Series(np.linspace(0.0, 1.0, 9), values, "cubic")}
    return jnp.sum(mb.required_forces(system, motion, by=["motor"], ts=TS)["motor"] ** 2)


@pytest.mark.slow
def test_derivatives_by_parameters_and_motion():
    four_bar()  # compiled before JAX traces
    numbers = {"coupler.mass": jnp.asarray(3.0), "B.point_b": jnp.asarray([-1.5, 0.0])}
    values = jnp.asarray(crank(np.linspace(0.0, 1.0, 9)))
    along = {"coupler.mass": jnp.asarray(0.3), "B.point_b": jnp.asarray([0.2, -0.1])}
    move = jnp.asarray(0.1 * np.random.default_rng(0).normal(size=9))
    loss = jax.jit(torque_of)
    slopes = jax.jit(jax.grad(torque_of, argnums=(0, 1)))(numbers, values)
    reverse = sum(jnp.vdot(slopes[0][name], along[name]) for name in along) + jnp.vdot(slopes[1], move)
    _, forward = jax.jit(lambda a, b: jax.jvp(torque_of, (numbers, values), (a, b)))(along, move)
    np.testing.assert_allclose(reverse, forward, rtol=1e-11)
    at = lambda h: loss({name: numbers[name] + h * along[name] for name in along}, values + h * move)
    differences = (8 * (at(1e-3) - at(-1e-3)) - (at(2e-3) - at(-2e-3))) / 12e-3
    np.testing.assert_allclose(forward, differences, rtol=1e-7)


@pytest.mark.slow
def test_batches_are_their_members():
    masses = jnp.array([1.0, 2.0, 4.0])
    torque = lambda mass: torque_of({"coupler.mass": mass}, crank(jnp.linspace(0.0, 1.0, 9)))
    np.testing.assert_allclose(jax.vmap(torque)(masses), [jax.jit(torque)(mass) for mass in masses], rtol=1e-12)


# Blades and rolling


BEHIND, SPEED, ANGLE, INERTIA = 0.4, 1.5, 0.8, 0.3


@functools.cache
def sleigh():
    """A body on a blade behind its mass centre."""
    body = planar.Body("body", mass=2.0, inertia=INERTIA, angle=ANGLE)
    return mb.Scene([body], joints=[planar.KnifeEdge("blade", "body", point=(-BEHIND, 0.0))]).compile()


def pulled(ts, behind=BEHIND, speed=SPEED, angle=ANGLE):
    """The mass centre of the sleigh is pulled along the axis x: heading and forces."""
    system = mb.with_parameters(sleigh(), {"blade.point": jnp.stack([-behind, jnp.zeros_like(behind)])})
    start = mb.State(jnp.stack([jnp.zeros_like(angle), jnp.zeros_like(angle), angle]), jnp.zeros(3))
    path = {"body.x": lambda t: speed * (t - ts[0]), "body.y": lambda t: 0.0 * t}
    found = mb.required_forces(system, path, ts=ts, by=["body.x", "body.y"], guess=start)
    return jnp.stack([found.quantity("body.angle"), found["body.x"], found["body.y"]])


def tractrix(ts):
    """The same by `θ' = −(v / b) sin θ` and the blade's force `−J θ'' / b`."""
    angle = 2 * np.arctan(np.tan(ANGLE / 2) * np.exp(-SPEED / BEHIND * (ts - ts[0])))
    turning = -SPEED / BEHIND * np.sin(angle)
    blade = INERTIA * SPEED / BEHIND**2 * np.cos(angle) * turning
    return np.stack([angle, blade * np.sin(angle), -blade * np.cos(angle)])


def test_positions_that_a_blade_leaves_do_not_depend_on_the_times_asked_for():
    numbers = jnp.asarray(BEHIND), jnp.asarray(SPEED), jnp.asarray(ANGLE)
    fine, coarse = jnp.linspace(0.0, 1.0, 5), jnp.array([0.0, 0.25, 0.3, 0.9, 1.0])
    for ts in (fine, coarse):
        np.testing.assert_allclose(pulled(ts, *numbers), tractrix(np.asarray(ts)), rtol=0, atol=1e-8)


def sum_of_pull(ts, numbers):
    """A number of the motion that weighs the sleigh's heading and forces."""
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(3, ts.size)))
    return jnp.vdot(weights, pulled(ts, *numbers))


@pytest.mark.slow
def test_derivatives_through_positions_that_a_blade_leaves():
    """By the blade's place, the speed, the heading at the start, and the times; under `jit` and `vmap`."""
    sleigh()  # Compiled outside of traces.
    numbers, ts = jnp.array([BEHIND, SPEED, ANGLE]), jnp.linspace(0.0, 1.0, 5)
    directions = [(ts * 0.0, row) for row in jnp.eye(3)] + [(jnp.array([0.3, -0.2, 0.1, 0.2, -0.4]), jnp.zeros(3))]
    along = lambda move, step: sum_of_pull(ts + step * move[0], numbers + step * move[1])
    slopes = jax.jit(jax.grad(sum_of_pull, argnums=(0, 1)))(ts, numbers)
    moves = tuple(jnp.stack(rows) for rows in zip(*directions, strict=True))
    both = lambda move, step: jax.jvp(lambda step: along(move, step), (step,), (jnp.ones_like(step),))
    steps = 1e-3 * jnp.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    values, forward = jax.jit(jax.vmap(jax.vmap(both, (None, 0)), (0, None)))(moves, steps)
    reverse = [jnp.vdot(slopes[0], a) + jnp.vdot(slopes[1], b) for a, b in directions]
    np.testing.assert_allclose(reverse, forward[:, 2], rtol=1e-10)
    differences = (8 * (values[:, 3] - values[:, 1]) - (values[:, 4] - values[:, 0])) / 12e-3
    np.testing.assert_allclose(forward[:, 2], differences, rtol=1e-6)


# Contacts


def hung(part):
    """An arm on a pin with a unilateral constraint of its own."""
    arm = planar.Body("arm", mass=1.0, inertia=1.0 / 12.0, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "arm", point=(0.0, 0.0))
    return mb.Scene([arm], joints=[pin, part], forces=[mb.Gravity((0.0, -9.81))]).compile()


def turned(system, law, ts):
    return mb.required_forces(system, {"pin.angle": law}, by=["pin.angle"], ts=ts)["pin.angle"]


def test_a_motion_may_touch_a_stop_and_not_pass_through_it():
    system = hung(mb.Stop("stop", "pin.angle", lower=-0.5))
    # It turns back at the stop, which bears nothing.
    ts = np.array([0.0, 1.0, 2.0])
    torques = turned(system, lambda t: -0.25 + 0.25 * (t - 1.0) ** 2 - 0.25, ts)
    expected = 0.5 / 3.0 + 0.5 * 9.81 * np.cos(-0.5 + 0.25 * (ts - 1.0) ** 2)
    np.testing.assert_allclose(torques, expected, rtol=1e-10)
    with pytest.raises(ValueError, match=r"at t = 1 the motion passes through stop by 0\.2 "):
        turned(system, lambda t: -0.7 + 0.25 * (t - 1.0) ** 2, ts)
    with pytest.raises(ValueError, match=r"at t = 0 the motion passes through stop by 0\.1 "):
        turned(system, lambda t: -0.6 + 0.25 * t**2, ts)
    with pytest.raises(ValueError, match=r"at t = 0 stop bears a force"):
        resting = mb.assemble(system, fix={"stop.mode": 1})
        mb.required_forces(system, {"pin.angle": jnp.sin}, by=["pin.angle"], ts=ts, guess=resting)


# Each is closed at an angle of -0.5 rad: there the tip is at (0.878, -0.479), the distance to (0, 1) is 1.721.
LOWEST, FARTHEST = -np.sin(0.5), np.hypot(np.cos(0.5), 1 + np.sin(0.5))
UNILATERAL = {
    "RigidContact": lambda: mb.RigidContact(
        "closed", "arm", terrain=mb.terrain.Flat(LOWEST - 0.1), radius=0.1, centre=(0.5, 0.0)
    ),
    "RigidBallContact": lambda: mb.RigidBallContact(
        "closed",
        "ground",
        "arm",
        radius_a=0.1,
        radius_b=0.2,
        point_a=(np.cos(0.5) - 0.3 * np.sin(0.5), LOWEST - 0.3 * np.cos(0.5)),
        point_b=(0.5, 0.0),
    ),
    "RigidPlaneContact": lambda: mb.RigidPlaneContact(
        "closed", "ground", "arm", normal=(0.0, 1.0), point_a=(0.0, LOWEST), point_b=(0.5, 0.0)
    ),
    "Slack": lambda: mb.Slack("closed", "ground", "arm", length=FARTHEST, point_a=(0.0, 1.0), point_b=(0.5, 0.0)),
    "Rope": lambda: mb.Rope("closed", [("ground", (0.0, 1.0)), ("arm", (0.5, 0.0))], length=FARTHEST, slack=True),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", UNILATERAL)
def test_every_unilateral_part_bounds_a_motion(name):
    system = hung(UNILATERAL[name]())
    ts = np.array([0.0, 1.0, 2.0])
    at = lambda lowest: lambda t: lowest + 0.1 * (t - 1.0) ** 2
    expected = 0.2 / 3.0 + 0.5 * 9.81 * np.cos(-0.499 + 0.1 * (ts - 1.0) ** 2)
    np.testing.assert_allclose(turned(system, at(-0.499), ts), expected, rtol=1e-10)
    with pytest.raises(ValueError, match=r"at t = 1 the motion passes through closed by "):
        turned(system, at(-0.52), ts)
    with pytest.raises(ValueError, match=r"at t = 0 the motion passes through closed by "):
        turned(system, at(-0.7), ts)
    traced = jax.jit(lambda x: turned(system, at(x), ts))
    assert np.all(np.isnan(traced(-0.52))) and np.all(np.isfinite(traced(-0.499)))


@pytest.mark.slow
def test_a_motion_that_lands_has_a_contact_force_that_is_not_sought():
    ball = planar.Body("ball", mass=1.0, inertia=0.01, position=(0.0, 0.3))
    floor = mb.RigidContact("floor", "ball", terrain=mb.terrain.Flat(), radius=0.1)
    system = mb.Scene([ball], joints=[floor], forces=[mb.Gravity((0.0, -9.81))]).compile()
    ts = np.array([0.0, 0.1, 0.25, 0.5])
    motion = mb.simulate(system, mb.assemble(system), t1=0.5, saveat=ts)
    by = ["ball.x", "ball.y", "ball.angle"]
    with pytest.raises(ValueError, match=r"at t = 0\.25 floor bears a force, .*put a joint in its place"):
        mb.required_forces(system, motion, by=by)
    falls = mb.simulate(system, mb.assemble(system), t1=0.1, saveat=ts[:2])
    found = mb.required_forces(system, falls, by=by)
    np.testing.assert_allclose(found["ball.y"], 0.0, atol=1e-10)


# Machines with fewer freedoms of velocities than of positions: coordinates that determine the velocities, and forces.
ROLLING = {
    "chaplygin_sleigh": (("sleigh.x", "sleigh.y"), ("sleigh.x", "sleigh.y")),
    "rolling_disc": (("disc.orientation",), ("disc.wx", "disc.wy", "disc.wz")),
    "roller_racer": (("theta", "phi"), ("u0", "u1")),
    "appell_hamel": (("x", "y"), ("x", "y")),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ROLLING)
def test_rolling_by_coordinates_as_simulated(name):
    """Without forces but those of the machine, along splines through a simulated motion, at few of its times."""
    (coordinates, forces), machine, ts = ROLLING[name], mechanisms.get(name), np.linspace(0.0, 0.5, 401)
    system = machine.system
    motion = mb.simulate(system, machine.state, t1=0.5, saveat=ts, rtol=1e-11, atol=1e-13)
    index = system.coordinate_names()
    take = lambda own: np.squeeze(np.asarray(motion.ys.q)[:, np.array(index[own])])
    path = {own: mb.Series(ts, take(own), "cubic") for own in coordinates}
    few = ts[[0, 120, 160, 400]]
    found = mb.required_forces(system, path, ts=few, by=forces, guess=machine.state)
    at = np.searchsorted(ts, few)
    np.testing.assert_allclose(found.ys.q, motion.ys.q[at], rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.ys.u, motion.ys.u[at], rtol=0, atol=1e-5)
    for own in forces:
        np.testing.assert_allclose(found[own], 0.0, atol=1e-2)


@functools.cache
def two_bars():
    """An arm of two bars, and a cart that a driver holds."""
    place = {"arm": 0.5, "rod": 1.5, "cart": 5.0}
    bodies = [planar.Body(name, mass=1.0, inertia=0.1, position=(x, 0.0)) for name, x in place.items()]
    joints = [
        planar.Revolute("shoulder", "ground", "arm", point=(0.0, 0.0)),
        planar.Revolute("elbow", "arm", "rod", point=(1.0, 0.0)),
        planar.Prismatic("rail", "ground", "cart", point=(5.0, 0.0), axis=(1.0, 0.0)),
        mb.JointDriver("push", "rail.displacement"),
    ]
    spring = mb.JointSpring("spring", "elbow.angle", stiffness=2.0)
    wind = planar.PointForce("wind", "rod", force=(1.0, 0.0))
    return mb.Scene(bodies, joints=joints, forces=[spring, wind]).compile()


REFUSED: dict[str, tuple[dict, str]] = {
    "by names one actuator each": ({"by": "shoulder.angle"}, "in a sequence"),
    "unknown": ({"by": ["sholder.angle"]}, "did you mean 'shoulder.angle'"),
    "twice": ({"by": ["elbow.angle", "elbow.angle"]}, "each actuator once"),
    "a joint": (
        {"by": ["elbow", "shoulder.angle"]},
        "a Revolute, which drives nothing; name its coordinate 'elbow.angle'",
    ),
    "a force": ({"by": ["wind", "shoulder.angle"]}, "PointForce.*'wind.force'"),
    "too few": ({"by": ["shoulder.angle"]}, r"2 freedoms and 1 force, shoulder\.angle, so .* is free"),
    "too many": ({"by": ["shoulder.angle", "elbow.angle", "rod.angle"]}, "not determined"),
    "held": ({"by": ["shoulder.angle", "cart.x"]}, "the constraints hold cart.x"),
    "dependent": ({"by": ["shoulder.angle", "arm.angle"]}, "the motion of .*: arm.angle adds nothing"),
    "few coordinates": ({"motion": {"elbow.angle": jnp.cos}}, "leave .* free"),
    "held coordinate": (
        {"motion": {"elbow.angle": jnp.cos, "shoulder.angle": jnp.sin, "cart.x": jnp.cos}},
        "cart.x is not a freedom",
    ),
    "unknown coordinate": ({"motion": {"elbow": jnp.cos}}, "'elbow.angle'"),
    "linear": ({"motion": {"elbow.angle": mb.Series([0.0, 1.0], [0.0, 1.0])}}, "'cubic'"),
    "no times": ({"ts": None}, "ts is missing"),
    "times": ({"ts": [0.5, 0.0]}, "ts must be ascending"),
    "shape": ({"motion": {"elbow.angle": lambda t: jnp.ones(2) * t}}, "shape"),
    "weights": ({"weights": {"elbow.angle": 1.0}}, "missing for shoulder.angle"),
}


SOLVED = ("too few", "held", "dependent")


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.slow) if case in SOLVED else case for case in REFUSED]
)
def test_refused(case):
    given, text = REFUSED[case]
    swing = {"elbow.angle": jnp.cos, "shoulder.angle": jnp.sin}
    given = {"motion": swing, "by": ["elbow.angle", "shoulder.angle"], "ts": [0.0, 0.5]} | given
    with pytest.raises(ValueError, match=text):
        mb.required_forces(two_bars(), **given)


@pytest.mark.slow
def test_a_motion_that_the_machine_cannot_make():
    system = four_bar()
    (q,), (u,) = (x for x in (needed("motor").ys.q[:1], needed("motor").ys.u[:1]))
    bent = motion_of(system, [0.0, 1.0], jnp.stack([q, q.at[1].add(1e-3)]), jnp.stack([u, u]))
    with pytest.raises(ValueError, match=r"at t = 1 .* its positions violate [A-D] .*"):
        mb.required_forces(system, bent, by=["motor"])
    fast = motion_of(system, [0.0, 1.0], jnp.stack([q, q]), jnp.stack([u, u.at[0].add(1e-3)]))
    with pytest.raises(ValueError, match=r"at t = 1 .* its velocities violate [A-D] .*"):
        mb.required_forces(system, fast, by=["motor"])
    with pytest.raises(ValueError, match=r"cannot reach the position.*D.angle"):
        mb.required_forces(system, {"D.angle": lambda t: 3.0 * t}, ts=[0.0, 1.0], by=["motor"])
    traced = jax.jit(lambda y: mb.required_forces(system, motion_of(system, [0.0, 1.0], *y), by=["motor"])["motor"])
    assert np.all(np.isnan(traced((bent.ys.q, bent.ys.u))))
    assert np.all(np.isfinite(mb.required_forces(system, bent, by=["motor"], tolerance=0.1)["motor"]))


@pytest.mark.parametrize(("limits", "size"), [((0.0, 1.0), 2.0), ((0.0, 1.0), -2.0), ((0.2, 0.3), 2.0), (None, 2.0)])
def test_a_control_beyond_its_range_is_found_with_a_warning(limits, size):
    """An arm of 1 kg turns by ½ size t²; its moment of inertia about the pin is 0.35 kg m², the gain 0.35 N m."""
    arm = planar.Body("arm", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "arm", point=(0.0, 0.0))
    servo = mb.Actuator("servo", "pin.angle", gain=(0.35, 0.0, 0.0), control_range=limits)
    system = mb.Scene([arm], joints=[pin], forces=[servo]).compile()
    turn = {"pin.angle": lambda t: 0.5 * size * t**2}
    find = lambda: mb.required_forces(system, turn, ts=[0.0, 0.5, 1.0], by=["servo.control"])
    if limits is None:
        found = find()
    else:
        low, high = limits
        text = (
            rf"servo\.control needs {size:g} to {size:g}, beyond its range from {low:g} to {high:g}, most of all at t"
        )
        with pytest.warns(UserWarning, match=text):
            found = find()
    np.testing.assert_allclose(found["servo.control"], size, rtol=1e-9)


@pytest.mark.slow
def test_a_singular_position_is_said_to_be_singular():
    """The lines of three legs of a plate meet in its centre, about which it turns; a crank is at its dead centre."""
    angles = np.array([0.3, 2.2, 4.4])
    legs = [
        mb.Tendon(f"leg {k}", [("ground", (2 * np.cos(a), 2 * np.sin(a))), ("plate", (np.cos(a), np.sin(a)))])
        for k, a in enumerate(angles)
    ]
    plate = mb.Scene([planar.Body("plate", mass=1.0, inertia=1.0)], joints=legs).compile()
    names = ["plate.x", "plate.y", "plate.angle"]
    still = lambda angle: dict(zip(names, (lambda t: 0 * t, lambda t: 0 * t, lambda t: angle + 0 * t), strict=True))
    by = [f"{leg.name}.length" for leg in legs]
    with pytest.raises(ValueError, match=r"t = 0 the position is singular: .* can move while leg 0\.length, leg 1"):
        mb.required_forces(plate, still(0.0), by=by, ts=[0.0])
    forces = mb.required_forces(plate, still(0.2), by=by, ts=[0.0])
    np.testing.assert_allclose(forces["leg 0.length"], 0.0, atol=1e-12)

    crank = planar.Body("crank", mass=1.0, inertia=0.1)
    rod = planar.Body("rod", mass=1.0, inertia=0.1, position=(2.0, 0.0))
    joints = [
        planar.Revolute("bearing", "ground", "crank", point=(0.0, 0.0)),
        planar.Revolute("pin", "crank", "rod", point=(1.0, 0.0)),
        planar.PointOnLine("slot", "ground", "rod", axis=(1.0, 0.0), point_a=(0.0, 0.0), point_b=(1.0, 0.0)),
    ]
    machine = mb.Scene([crank, rod], joints=joints).compile()
    with pytest.raises(ValueError, match=r"the position is singular: .* can move while slot\.displacement stand still"):
        mb.required_forces(machine, {"bearing.angle": lambda t: 0 * t}, by=["slot.displacement"], ts=[0.0])
