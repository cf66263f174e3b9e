"""Inverse dynamics: the forces of actuators from a motion."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled
from oracles import four_bar_forces
from trajectories import motion_of

import jaxmb as mb
from jaxmb import importers, mechanisms, planar, spatial
from jaxmb.lagrangian import LagrangianSystem

MOST_PROGRAMS = 215

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


def rates_by_hand():
    return np.array([four_bar_forces.motion(LENGTHS, BASE, *at)[1] for at in zip(*CRANK, strict=True)])


def test_required_forces_of_a_crank_and_its_pins_are_those_of_newton_and_euler():
    torques, pins = by_hand("crank")
    found = needed("motor")
    np.testing.assert_allclose(found["motor"], torques, rtol=1e-12)
    np.testing.assert_allclose(found.power["motor"], torques * CRANK[1], rtol=1e-12)
    for k, name in enumerate("ABCD"):
        np.testing.assert_allclose(found.reaction(name).force, pins[:, k], rtol=1e-11, atol=1e-11)


def test_weights_choose_the_least_of_more_forces():
    find = functools.partial(mb.required_forces, four_bar(), {"crank.angle": crank}, ts=TS, by=["motor", "D.angle"])
    with pytest.raises(ValueError, match=r"1 freedom and 2 forces, motor, D\.angle, so they are not determined"):
        find()
    found = find(weights={"motor": 1.0, "D.angle": 4.0})
    rates = rates_by_hand()
    # The least norm with one freedom: each force as its rate over its weight. The motor has no force of its own then.
    power = by_hand("crank")[0] * CRANK[1]
    share = power / (rates[:, 0] ** 2 + rates[:, 2] ** 2 / 4.0)
    np.testing.assert_allclose(found["motor"], share * rates[:, 0], rtol=1e-11)
    np.testing.assert_allclose(found["D.angle"], share * rates[:, 2] / 4.0, rtol=1e-11)


@pytest.mark.slow
def test_a_coordinate_adds_to_the_forces_of_the_machine():
    """Of a joint or a body, at the crank or at the rocker, where the power is the same."""
    torques, _ = by_hand("rocker")
    rates, motor = rates_by_hand(), needed("motor")
    # The motor on the crank stays, with its torque of 3 N m.
    np.testing.assert_allclose(needed("D.angle")["D.angle"], torques - 3.0 * rates[:, 0] / rates[:, 2], rtol=1e-12)
    np.testing.assert_allclose(needed("D.angle").power["D.angle"], motor.power["motor"] - 3.0 * CRANK[1], rtol=1e-12)
    np.testing.assert_allclose(needed("crank.angle")["crank.angle"], motor["motor"] - 3.0, rtol=1e-12)


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
    assert 3.5 < errors[0] / errors[1] < 4.5 and errors[1] < 0.05
    series = {"A.angle": mb.Series(ts, crank(ts), "cubic")}
    np.testing.assert_allclose(
        mb.required_forces(four_bar(), series, by=["motor"])["motor"], found["motor"], rtol=1e-12
    )


# Bars of 2 kg and 1 m side by side, each on a pin at its end and with an actuator of its own, by which it has a torque.

BARS = {"driver": "turn", "joint_driver": "turn_joint", "servo": "follow", "motor": "drive", "rough": "push"}
BARS |= {"added": "added.angle", "turned": "engine.torque"}
# Of bars with a control, its range, which their motion exceeds.
RANGES, CONTROL, GAIN = {"shut": (0.0, 1.0), "below": (100.0, 200.0), "free": None}, 30.0, 0.35
BARS |= {name: f"of_{name}.control" for name in RANGES}
MASS, INERTIA = 2.0, 0.5
INERTIA_AT_PIN, WEIGHT = INERTIA + MASS / 4, MASS * GRAVITY / 2


def bars():
    places = {name: (0.0, 3.0 * k) for k, name in enumerate(BARS)}
    bodies = [planar.Body(name, mass=MASS, inertia=INERTIA, position=(0.5, y)) for name, (_, y) in places.items()]
    pins = [planar.Revolute(f"pin_{name}", "ground", name, point=place) for name, place in places.items()]
    ramp = {"motion": lambda t, p: p["rate"] * t**2, "parameters": {"rate": 0.5}}
    driver = lambda name, body: planar.Driver(name, "ground", body, quantity="angle", **ramp)
    joints = [
        driver("turn", "driver"),
        mb.JointDriver("turn_joint", "pin_joint_driver.angle"),
        mb.Servo(driver("follow", "servo"), 3.0, 40.0),
    ]
    forces = [
        mb.Gravity((0.0, -GRAVITY)),
        mb.Motor("drive", "pin_motor.angle", command=2.0, lag=0.1, force=1.5),
        planar.Friction("rub", "pin_rough", coefficient=0.3, radius=0.05, transition_speed=0.01),
        mb.JointForce("push", "pin_rough.angle", force=3.0),
        mb.JointForce("push_added", "pin_added.angle", force=3.0),
        planar.Torque("engine", "turned", torque=0.0),
        *(
            mb.Actuator(f"of_{name}", f"pin_{name}.angle", gain=(GAIN, 0.0, 0.0), control_range=limits)
            for name, limits in RANGES.items()
        ),
    ]
    system = mb.Scene(bodies, joints=[*pins, *joints], forces=forces).compile()
    return mb.with_inputs(system, {"turn_joint.value": lambda t: 0.5 * t**2, "engine.torque": lambda t: jnp.sin(t)})


def test_actuators_of_every_kind_have_the_torque_of_a_bar_on_a_pin():
    """The servo is off its program, where the force along the angle is less than its multiplier.

    Controls beyond their ranges are found with a warning.
    """
    system, ts = bars(), np.array([0.3, 0.8])
    angles = np.array([0.5 * ts**2 if "driver" in name else 0.4 - 0.9 * ts for name in BARS])
    rates = np.array([ts if "driver" in name else -0.9 + 0.0 * ts for name in BARS])
    q, u = np.zeros((2, system.nq)), np.zeros((2, system.nu))
    for k, (name, angle, rate) in enumerate(zip(BARS, angles, rates, strict=True)):
        at = [system.coordinate_names()[f"{name}.{x}"][0] for x in ("x", "y", "angle")]
        q[:, at] = np.stack([0.5 * np.cos(angle), 3.0 * k + 0.5 * np.sin(angle), angle], axis=1)
        u[:, at] = rate[:, None] * np.stack([-0.5 * np.sin(angle), 0.5 * np.cos(angle), np.ones(2)], axis=1)
    wide = {f"of_{name}.control_range": (-100.0, 100.0) for name, limits in RANGES.items() if limits is not None}
    wide |= {f"of_{name}.control": CONTROL for name in RANGES}
    motion = motion_of(mb.with_parameters(system, wide), ts, q, u, np.full((2, 1), 1.5))
    with pytest.warns(UserWarning, match="beyond its range") as caught:
        found = mb.required_forces(system, motion, by=list(BARS.values()))
    said, needs = " ".join(str(warning.message) for warning in caught), f"needs {CONTROL:g} to {CONTROL:g}, beyond its"
    assert len(caught) == 2 and f"of_shut.control {needs} range from 0 to 1, most of all at t = 0." in said
    assert f"of_below.control {needs} range from 100 to 200, most of all at t = 0." in said
    accelerations = np.asarray(motion.accelerations)
    for name, angle, rate in zip(BARS, angles, rates, strict=True):
        turning = accelerations[:, system.coordinate_names()[f"{name}.angle"][0]]
        torque = INERTIA_AT_PIN * turning + WEIGHT * np.cos(angle)
        if name == "rough":
            # The pin's force, from the acceleration of the mass centre, presses.
            heading = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            swing = turning[:, None] * heading[:, ::-1] * [-1, 1] - rate[:, None] ** 2 * heading
            pull = np.linalg.norm(MASS * (0.5 * swing + [0.0, GRAVITY]), axis=1)
            torque = torque + 0.3 * 0.05 * pull * np.tanh(0.05 * rate / 0.01)
        torque = torque - 3.0 * (name == "added")
        actuator, gain = BARS[name], GAIN if name in RANGES else 1.0
        np.testing.assert_allclose(found[actuator], torque / gain, rtol=1e-9, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(found.power[actuator], torque * rate, rtol=1e-9, atol=1e-9, err_msg=name)
        if name in ("driver", "joint_driver", "servo", "motor"):
            np.testing.assert_allclose(motion[actuator].drive_force, torque, rtol=1e-9, err_msg=name)
    given = {"drive": 1.5, "push": 3.0, "added.angle": 0.0, "engine.torque": np.sin(ts)}
    given |= {f"of_{name}.control": CONTROL for name in RANGES}
    for name, force in given.items():
        np.testing.assert_allclose(found[name], force, rtol=1e-9, atol=1e-9, err_msg=name)
    with pytest.raises(ValueError, match="do not determine drive"):
        mb.required_forces(system, {"pin_motor.angle": lambda t: 0.2}, ts=[0.0, 1.0], by=["engine.torque"])


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


# Machines, and the forces of their actuators.
DRIVEN = {
    "rockers": (lambda: with_motor("parallelogram", "foot1.angle"), {"motor": 3.0}),
    "rolling": (rolling_disc, {"engine.torque": (0.0, 2.0, 0.0)}),
    "rolling by coordinates": (rolling_disc, {"disc.wx": 0.0, "disc.wy": 0.0, "disc.wz": 0.0}),
    "quasi-velocities": (lambda: mechanisms.roller_racer().system, {"u0": 0.0, "u1": 0.0}),
    "bricard": (lambda: with_motor("bricard", "P2.angle"), {"motor": 3.0}),
    "swash_plate": (lambda: with_motor("swash_plate", "bearing.angle"), {"motor": 3.0}),
    # A vector of more components than freedoms.
    "spherical_four_bar": (
        lambda: mechanisms.spherical_four_bar(model="rigid_bodies", torque=2.0).system,
        {"drive.torque": (0.0, 0.0, 2.0)},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DRIVEN)
def test_forces_of_mechanisms_come_back(name):
    make, expected = DRIVEN[name]
    system = make()
    several = sum(np.size(force) for force in expected.values()) > system.nu - system.acceleration_rank
    weights = dict.fromkeys(expected, 1.0) if several else None
    found = mb.required_forces(system, swung(system), by=list(expected), weights=weights)
    for actuator, force in expected.items():
        np.testing.assert_allclose(found[actuator][0], force, rtol=1e-9, atol=1e-9)


def test_required_forces_of_a_lagrangian_system():
    """A pendulum whose angle has a force of its own."""
    system = LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * INERTIA_AT_PIN * v @ v,
        potential=lambda t, q, p: WEIGHT * jnp.sin(q[0]),
        force=lambda t, q, v, p: -0.7 * v,
        q=[0.0],
        coordinates=("theta",),
    )
    ts = np.linspace(0.0, 1.0, 5)
    found = mb.required_forces(system, {"theta": mb.Series(ts, 0.2 + ts**2, "cubic")}, by=["theta"])
    expected = 2.0 * INERTIA_AT_PIN + WEIGHT * np.cos(0.2 + ts**2) + 0.7 * 2.0 * ts
    np.testing.assert_allclose(found["theta"], expected, rtol=1e-9)
    np.testing.assert_allclose(found.power["theta"], expected * 2.0 * ts, rtol=1e-9, atol=1e-12)


# Derivatives


def torque_of(parameters, values):
    system = mb.with_parameters(four_bar(), parameters)
    motion = {"crank.angle": mb.Series(np.linspace(0.0, 1.0, 9), values, "cubic")}
    return jnp.sum(mb.required_forces(system, motion, by=["motor"], ts=TS)["motor"] ** 2)


@pytest.mark.slow
def test_derivatives_of_required_forces_by_parameters_and_motion():
    """Forward, reverse and differences, which are a batch; of no single program more than needed."""
    four_bar()  # Compiled outside of traces.
    numbers = {"coupler.mass": jnp.asarray(3.0), "B.point_b": jnp.asarray([-1.5, 0.0])}
    values = jnp.asarray(crank(np.linspace(0.0, 1.0, 9)))
    along = {"coupler.mass": 0.3, "B.point_b": np.array([0.2, -0.1])}
    move = 0.1 * np.random.default_rng(0).normal(size=9)
    at = lambda h: torque_of({name: numbers[name] + h * along[name] for name in along}, values + h * move)
    slopes = jax.jit(jax.grad(torque_of, argnums=(0, 1)))(numbers, values)
    reverse = sum(np.vdot(slopes[0][name], along[name]) for name in along) + np.vdot(slopes[1], move)
    steps = 1e-3 * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    found, forward = jax.jit(jax.vmap(lambda h: jax.jvp(at, (h,), (jnp.ones(()),))))(steps)
    np.testing.assert_allclose(reverse, forward[2], rtol=1e-11)
    np.testing.assert_allclose(forward[2], (8 * (found[3] - found[1]) - (found[4] - found[0])) / 12e-3, rtol=1e-7)


# Blades and rolling


BEHIND, SPEED, ANGLE, INERTIA_OF_SLEIGH = 0.4, 1.5, 0.8, 0.3


@functools.cache
def sleigh():
    """A body on a blade behind its mass centre."""
    body = planar.Body("body", mass=2.0, inertia=INERTIA_OF_SLEIGH, angle=ANGLE)
    return mb.Scene([body], joints=[planar.KnifeEdge("blade", "body", point=(-BEHIND, 0.0))]).compile()


def pulled(ts, behind, speed, angle):
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
    blade = INERTIA_OF_SLEIGH * SPEED / BEHIND**2 * np.cos(angle) * turning
    return np.stack([angle, blade * np.sin(angle), -blade * np.cos(angle)])


@pytest.mark.slow
def test_positions_that_a_blade_leaves_do_not_depend_on_the_times_asked_for():
    sleigh()  # Compiled outside of traces.
    several = jax.jit(jax.vmap(lambda ts: pulled(ts, *map(jnp.asarray, (BEHIND, SPEED, ANGLE)))))
    ts = np.array([[0.0, 0.25, 0.5, 0.75, 1.0], [0.0, 0.25, 0.3, 0.9, 1.0]])
    for found, own in zip(several(ts), ts, strict=True):
        np.testing.assert_allclose(found, tractrix(own), rtol=0, atol=1e-8)


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


# Machines with fewer freedoms of velocities than of positions: coordinates that determine the velocities, and forces.
ROLLING = {
    "rolling_disc": (("disc.orientation",), ("disc.wx", "disc.wy", "disc.wz")),
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


# Contacts


# Each is closed at an angle of -0.5 rad: there the tip is at (0.878, -0.479), the distance to (0, 1) is 1.721.
LOWEST, FARTHEST = -np.sin(0.5), np.hypot(np.cos(0.5), 1 + np.sin(0.5))
BALL = np.array([np.cos(0.5) - 0.3 * np.sin(0.5), LOWEST - 0.3 * np.cos(0.5)])
# Parts of an arm on a pin at a place along y, by its name.
UNILATERAL = {
    "stop": lambda name, y: mb.Stop(name, f"pin_{name}.angle", lower=-0.5),
    "contact": lambda name, y: mb.RigidContact(
        name, f"arm_{name}", terrain=mb.terrain.Flat(y + LOWEST - 0.1), radius=0.1, centre=(0.5, 0.0)
    ),
    "balls": lambda name, y: mb.RigidBallContact(
        name, "ground", f"arm_{name}", radius_a=0.1, radius_b=0.2, point_a=(BALL[0], BALL[1] + y), point_b=(0.5, 0.0)
    ),
    "plane": lambda name, y: mb.RigidPlaneContact(
        name, "ground", f"arm_{name}", normal=(0.0, 1.0), point_a=(0.0, y + LOWEST), point_b=(0.5, 0.0)
    ),
    "slack": lambda name, y: mb.Slack(
        name, "ground", f"arm_{name}", length=FARTHEST, point_a=(0.0, y + 1.0), point_b=(0.5, 0.0)
    ),
    "rope": lambda name, y: mb.Rope(
        name, [("ground", (0.0, y + 1.0)), (f"arm_{name}", (0.5, 0.0))], length=FARTHEST, slack=True
    ),
}


def arms(names):
    """Arms of 1 kg and 1 m side by side, each with a unilateral constraint."""
    bodies, joints = [], []
    for k, name in enumerate(names):
        bodies.append(planar.Body(f"arm_{name}", mass=1.0, inertia=1.0 / 12.0, position=(0.5, 5.0 * k)))
        pin = planar.Revolute(f"pin_{name}", "ground", f"arm_{name}", point=(0.0, 5.0 * k))
        joints += [pin, UNILATERAL[name](name, 5.0 * k)]
    return mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, -GRAVITY))]).compile()


@pytest.mark.slow("few")
@pytest.mark.parametrize(
    "names",
    [
        pytest.param(("stop", "contact"), id="few"),
        pytest.param(("stop", "rope", "balls", "plane", "slack"), id="others", marks=pytest.mark.slow),
    ],
)
def test_a_motion_may_touch_contacts_and_not_pass_through_them(names):
    """It turns back where they are closed, or shortly before, and they bear nothing."""
    system, ts, by = arms(names), np.linspace(0.0, 2.0, 5), [f"pin_{name}.angle" for name in names]
    curved = lambda lowest: lowest + 0.25 * (ts - 1.0) ** 2

    def turned(**lowest):
        laws = {f"pin_{name}.angle": mb.Series(ts, curved(lowest.get(name, -0.499)), "cubic") for name in names}
        return mb.required_forces(system, laws, by=by)

    found = turned(stop=-0.5)
    for name in names:
        expected = 0.5 / 3.0 + 0.5 * GRAVITY * np.cos(curved(-0.5 if name == "stop" else -0.499))
        np.testing.assert_allclose(found[f"pin_{name}.angle"], expected, rtol=1e-10)
    # Another motion has the same programs.
    with compiled() as programs:
        turned(stop=-0.45)
    assert not programs
    for name in names:
        with pytest.raises(ValueError, match=rf"at t = 1 the motion passes through {name} by [\d.]+ \[m, rad\]"):
            turned(**{name: -0.52})
    with pytest.raises(ValueError, match=rf"at t = 0 the motion passes through (?=.*{names[1]} by).*stop by 0\.05"):
        turned(**{"stop": -0.8, names[1]: -0.8})


@pytest.mark.slow
def test_a_contact_that_bears_a_force_is_named():
    system, by = arms(("stop",)), ["pin_stop.angle"]
    closed = np.array(system.guess.q)
    closed[system.coordinate_names()["stop.mode"][0]] = 1.0
    motion = motion_of(system, [0.0, 0.25], np.stack([system.guess.q, closed]), np.zeros((2, system.nu)))
    with pytest.raises(ValueError, match=r"at t = 0\.25 stop bears a force, .*put a joint in its place"):
        mb.required_forces(system, motion, by=by)
    with pytest.raises(ValueError, match=r"at t = 0 stop bears a force"):
        resting = mb.State(jnp.asarray(closed), system.guess.u)
        mb.required_forces(system, dict.fromkeys(by, jnp.sin), by=by, ts=[0.0, 1.0], guess=resting)


# Refusals


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


SWING = {"elbow.angle": jnp.cos, "shoulder.angle": jnp.sin}
# What differs from a call that is right, and what is said.
REFUSED: list[tuple[dict, str]] = [
    ({"by": "shoulder.angle"}, "in a sequence"),
    ({"by": ["sholder.angle"]}, "did you mean 'shoulder.angle'"),
    ({"by": ["elbow.angle", "elbow.angle"]}, "each actuator once"),
    ({"by": ["elbow", "shoulder.angle"]}, "a Revolute, which drives nothing; name its coordinate 'elbow.angle'"),
    ({"by": ["wind", "shoulder.angle"]}, "PointForce.*'wind.force'"),
    ({"motion": {"elbow": jnp.cos}}, "'elbow.angle'"),
    ({"motion": {"elbow.angle": mb.Series([0.0, 1.0], [0.0, 1.0])}}, "'cubic'"),
    ({"ts": None}, "ts is missing"),
    ({"ts": [0.5, 0.0]}, "ts must be ascending"),
    ({"motion": {"elbow.angle": lambda t: jnp.ones(2) * t}}, "shape"),
    ({"weights": {"elbow.angle": 1.0}}, "missing for shoulder.angle"),
    ({"weights": {"elbow.angle": 1.0, "shoulder.angle": -1.0}}, "weight of 'shoulder.angle' must be positive"),
]
# Of these something is solved for first.
SOLVED: list[tuple[dict, str]] = [
    ({"motion": {"elbow.angle": jnp.cos}}, "leave .* free"),
    ({"motion": SWING | {"cart.x": jnp.cos}}, "cart.x is not a freedom"),
    ({"by": ["shoulder.angle"]}, r"2 freedoms and 1 force, shoulder\.angle, so .* is free"),
    ({"by": ["shoulder.angle", "cart.x"]}, "the constraints hold cart.x"),
    ({"by": ["shoulder.angle", "arm.angle"]}, "the motion of .*: arm.angle adds nothing"),
]


def refuse(cases):
    right = {"motion": SWING, "by": ["elbow.angle", "shoulder.angle"], "ts": [0.0, 0.5]}
    for changes, text in cases:
        with pytest.raises(ValueError, match=text):
            mb.required_forces(two_bars(), **(right | changes))


def test_what_required_forces_refuse():
    refuse(REFUSED)


@pytest.mark.slow
def test_actuators_that_cannot_make_a_motion():
    refuse(SOLVED)


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


@pytest.mark.slow
def test_a_singular_position_is_said_to_be_singular():
    """The lines of three legs of a plate meet in its centre, about which it turns; a crank is at its dead centre."""
    angles = np.array([0.3, 2.2, 4.4])
    legs = [
        mb.Tendon(f"leg {k}", [("ground", (2 * np.cos(a), 2 * np.sin(a))), ("plate", (np.cos(a), np.sin(a)))])
        for k, a in enumerate(angles)
    ]
    plate = mb.Scene([planar.Body("plate", mass=1.0, inertia=1.0)], joints=legs).compile()
    still = lambda angle: (
        dict.fromkeys(("plate.x", "plate.y"), lambda t: 0 * t) | {"plate.angle": lambda t: angle + 0 * t}
    )
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


TREE = """
<mujoco>
  <option gravity="0.3 -1 -9.81"><flag contact="disable"/></option>
  <default><geom type="capsule" size="0.05"/><joint damping="0.2" stiffness="1.5"/></default>
  <worldbody>
    <body name="trunk"><joint name="turn" axis="0 0 1"/><geom fromto="0 0 0 0 0.1 0.6"/>
      <body name="rod" pos="0 0.1 0.6"><joint name="slide" type="slide" axis="1 0 0.3"/><geom fromto="0 0 0 0 0.4 0"/>
      </body>
      <body name="leg" pos="0 0 0.3"><joint name="hip" axis="0 1 0.4" armature="0.1"/><geom fromto="0 0 0 0 0 -0.5"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.slow
def test_required_forces_of_a_tree_are_those_of_mujoco(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "tree.xml").write_text(TREE)
    imported = importers.mjcf(tmp_path / "tree.xml", ignore="collisions")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "tree.xml"))
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    system, names = imported.scene.compile(), [imported.coordinates[model.joint(k).name] for k in range(model.njnt)]
    for _ in range(3):
        q, v, a = random.uniform(-1.0, 1.0, (3, model.nv)) * np.array([[0.8], [2.0], [5.0]])
        data.qpos, data.qvel, data.qacc = q, v, a
        mujoco.mj_inverse(model, data)
        ts = np.linspace(0.0, 1.0, 5)
        # The polynomial of degree two through these points is its own spline.
        motion = {name: jnp.asarray(q[k] + v[k] * ts + a[k] * ts**2 / 2) for k, name in enumerate(names)}
        found = mb.required_forces(system, motion, by=names, ts=ts)
        forces = np.array([found[name][0] for name in names])
        np.testing.assert_allclose(forces, data.qfrc_inverse, rtol=0, atol=1e-12 * np.max(np.abs(forces)))
