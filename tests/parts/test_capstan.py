"""Friction of ropes on pulleys against Euler's and Eytelwein's formula: stick and slip, their times, derivatives."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from at_instants import instants, point

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.system.instant import Instant

G, R = 9.81, 0.1
GRAVITY = mb.Gravity((0.0, -G))
# Compiled sooner than the default.
METHOD = {"solver": diffrax.Dopri8(), "manifold": mb.manifold.Projection()}


def wheel(inertia, *position, name="wheel", **state):
    return planar.Body(name, mass=1.0, inertia=inertia, position=position, **state)


def axle(body, *at):
    return planar.Revolute(f"{body} axle", "ground", body, point=at)


def hoist(*turns, friction=0.2, dimension=2):
    """Two loads on a rope over a drum that stands still; as many times as there are numbers of full turns on it."""
    at = lambda x, z: (x, z) if dimension == 2 else (x, 0.0, z)
    own, axis = (planar, {}) if dimension == 2 else (spatial, {"axis": (0.0, -1.0, 0.0)})
    loads, ropes = [], []
    for number in turns:
        name = f" {number:g}" if number else ""
        loads += [own.PointMass(f"left{name}", mass=1.0, position=at(-R, -1.0))]
        loads += [own.PointMass(f"right{name}", mass=3.0, position=at(R, -1.2))]
        drum = mb.Pulley("ground", R, "right", turns=number, friction=friction, **axis)
        path = [(f"left{name}", at(0.0, 0.0)), drum, (f"right{name}", at(0.0, 0.0))]
        ropes += [mb.Rope(f"rope{name}", path)]
    gravity = GRAVITY if dimension == 2 else mb.Gravity((0.0, 0.0, -G))
    return mb.Scene(loads, joints=ropes, forces=[gravity]).compile()


def in_modes(system, *modes):
    """What there is at the initial guess in several modes of all ropes."""
    k = np.ravel([index for name, index in system.coordinate_names().items() if ".mode" in name])
    states = [mb.State(np.array(system.guess.q), np.asarray(system.guess.u)) for _ in modes]
    for state, mode in zip(states, modes, strict=True):
        state.q[k] = mode
    return instants(system, *states)


# Euler's and Eytelwein's formula


@pytest.mark.parametrize(
    "dimension, turns", [(2, (0.0, 2.0)), pytest.param(3, (3.0,), marks=pytest.mark.slow)], ids=["plane", "space"]
)
def test_the_capstan_equation(dimension, turns):
    """Half a turn and some full turns on the drum: `T₂ = T₁ e^(μ φ)`, against the slip. Stick holds the loads, and
    before the start of a motion there is no friction.
    """
    own = in_modes(hoist(*turns, dimension=dimension), 1, -1, 2, 0)
    for number in turns:
        name = f" {number:g}" if number else ""
        wrap = np.pi * (1 + 2 * number)
        growth = np.exp(np.array([0.2, -0.2, 0.0]) * wrap)
        a = np.insert(G * (3.0 - growth) / (3.0 + growth), 2, 0.0)
        tensions = np.stack([G + a, 3.0 * (G - a)], axis=1)
        np.testing.assert_allclose(own(f"rope{name}.wrap"), np.full((4, 1), wrap), rtol=1e-12)
        np.testing.assert_allclose(own(f"rope{name}.length"), 2.2 + R * wrap, rtol=1e-12)
        np.testing.assert_allclose(own(f"right{name}.acceleration")[:, -1], -a, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(own(f"left{name}.acceleration")[:, -1], a, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(own(f"rope{name}.tension"), tensions, rtol=1e-10)
        np.testing.assert_allclose(tensions[[0, 1, 3], 1], tensions[[0, 1, 3], 0] * growth, rtol=1e-12)


def over_two(first=0.2, second=0.3, mass=4.0):
    """A rope over two drums, the second below a ceiling."""
    bodies = [point("left", 1.0, -R, -1.0), point("right", mass, 1.0 + R, -1.2), wheel(0.02, 0.5, -0.6)]
    path = [
        ("left", (0.0, 0.0)),
        mb.Pulley("ground", R, "right", friction=first),
        mb.Pulley("wheel", R, "left"),
        mb.Pulley("ground", R, "right", (1.0, 0.0), friction=second),
        ("right", (0.0, 0.0)),
    ]
    return mb.Scene(bodies, joints=[axle("wheel", 0.5, -0.6), mb.Rope("rope", path)], forces=[GRAVITY])


def test_tensions_of_a_rope_that_rubs_on_two_pulleys():
    """Its multipliers are the mean tension and, where it sticks, the fall of the tension."""
    (rope,) = [part for part in over_two().joints if isinstance(part, mb.Rope)]
    poses = np.array([(-R, -1.0, 0.0), (0.0, 0.0, 0.0), (0.5, -0.6, 0.0), (1.0 + R, -1.2, 0.0)])
    *_, law = rope.resolve(PLANE, poses).components()
    modes = np.array([(1, 1), (-1, -1), (1, -1), (2, 2)])
    seen = np.array([np.concatenate([poses, np.array([(mode, 0.0, 0.0) for mode in both])]) for both in modes])
    tensions = jax.jit(jax.vmap(lambda q: law.tensions(PLANE, q, jnp.array([5.0, 0.3, -0.4]))))(seen)
    wraps = np.asarray(jax.jit(lambda q: law.coordinates(PLANE, q)["wrap"])(seen[0]))
    first, middle, last = np.array(tensions).T
    slips = modes * np.array([0.2, 0.3]) * wraps[[0, 2]]
    np.testing.assert_allclose(0.5 * (first + last), 5.0, rtol=1e-13)
    np.testing.assert_allclose(middle[:3] / first[:3], np.exp(slips[:3, 0]), rtol=1e-13)
    np.testing.assert_allclose(last[:3] / middle[:3], np.exp(slips[:3, 1]), rtol=1e-13)
    np.testing.assert_allclose([middle[3] - first[3], last[3] - middle[3]], [-0.3, 0.4], rtol=1e-12)


@pytest.mark.slow
def test_two_pulleys_hold_the_loads_or_let_them_go():
    """Between two pulleys that stick the tension is undetermined, outside it is not."""
    system = over_two().compile()
    for mass in (2.0, 4.0):
        changed = mb.with_parameters(system, {"right.mass": mass})
        motion = mb.simulate(changed, mb.assemble(changed), t1=0.1, rtol=1e-9)
        wraps = np.asarray(motion["rope"].wrap[-1])
        total = np.exp(0.2 * wraps[0] + 0.3 * wraps[2])
        a = max(G * (mass - total) / (mass + total), 0.0)
        np.testing.assert_allclose(motion["right"].velocity[-1, 1], -0.1 * a, rtol=1e-6, atol=1e-9)
        tension = np.asarray(motion["rope"].tension[-1])
        np.testing.assert_allclose(tension[[0, 2]], [G + a, mass * (G - a)], rtol=1e-6)


@pytest.mark.slow
def test_a_rope_between_a_pulley_that_grips_and_its_drum():
    """Spans before and after a pulley that grips have tensions of their own; friction is in the second span alone."""
    bodies = [point("left", 1.0, -R, -1.0), point("right", 3.0, 1.0 + R, -1.2), wheel(0.02, 0.0, 0.0)]
    grip, rub = mb.Pulley("wheel", R, "right", grips=True), mb.Pulley("ground", R, "right", (1.0, 0.0), friction=0.4)
    rope = mb.Rope("rope", [("left", (0.0, 0.0)), grip, rub, ("right", (0.0, 0.0))])
    own = in_modes(mb.Scene(bodies, joints=[axle("wheel", 0.0, 0.0), rope], forces=[GRAVITY]).compile(), 1)
    growth = np.exp(0.2 * np.pi)
    # With the growth in force and inertia: T₂ = growth T₁, T₁ − T₀ = I a / R².
    a = G * (3.0 - growth) / (3.0 + growth * (1.0 + 2.0))
    first = G + a
    np.testing.assert_allclose(own("right.acceleration")[0, 1], -a, rtol=1e-10)
    np.testing.assert_allclose(own("rope.tension")[0], [first, first + 2.0 * a, growth * (first + 2.0 * a)], rtol=1e-10)


# Motions


@pytest.mark.slow
def test_loads_stick_up_to_the_limit():
    """Half a turn holds loads in a ratio below `e^(μ π)`, in both directions; beyond it they fall at `a t² / 2`."""
    system, limit = hoist(0.0), np.exp(0.2 * np.pi)

    def fallen(load):
        changed = mb.with_parameters(system, {"right.mass": load})
        motion = mb.simulate(changed, mb.assemble(changed), t1=0.3, rtol=1e-10)
        return motion["right"].position[-1, -1] + 1.2, motion["rope"].tension[-1]

    loads = np.array([1.0001 / limit, 0.9999 / limit, 1.0, 0.9999 * limit, 1.0001 * limit, 2.5])
    heights, tensions = jax.jit(jax.vmap(fallen))(jnp.asarray(loads))
    growth = np.array([1.0, 1.0 / limit, 1.0, 1.0, limit, limit])
    sticks = np.array([1, 0, 1, 1, 0, 0], bool)
    a = np.where(sticks, 0.0, G * (loads - growth) / (loads + growth))
    np.testing.assert_allclose(heights, -0.045 * a, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(tensions, np.stack([G + a, loads * (G - a)], axis=1), rtol=1e-9)


RATE, LOAD = 8.0, 2.0


def band_brake(dimension=2):
    """A wheel with a motor under a rope, which is fastened before it and bears a load behind it."""
    own, up = (planar, 1) if dimension == 2 else (spatial, 2)
    at = lambda x, z: (x, z) if dimension == 2 else (x, 0.0, z)
    axis = {} if dimension == 2 else {"axis": (0.0, -1.0, 0.0)}
    inertia = 0.05 if dimension == 2 else (0.03, 0.05, 0.03)
    bodies = [own.Body("wheel", mass=1.0, inertia=inertia), own.PointMass("load", mass=LOAD, position=at(R, -1.0))]
    rub = mb.Pulley("wheel", R, "right", friction=0.3, **axis)
    rope = mb.Rope("rope", [("ground", at(-R, -0.8)), rub, ("load", at(0.0, 0.0))])
    pin = own.Revolute("axle", "ground", "wheel", point=at(0.0, 0.0), **axis)
    motor = mb.JointForce("motor", "axle.angle", force=0.0)
    gravity = mb.Gravity(tuple(-G * np.eye(dimension)[up]) if dimension == 3 else (0.0, -G))
    return mb.Scene(bodies, joints=[pin, rope], forces=[gravity, motor]).compile()


def braked(values, t1=0.8):
    """The closed form for the motor's moment `−RATE t`: when the wheel slips in the rope, its angle at the end, and the
    tension before it.

    The rope rests, T₂ = m g. It slips where T₁ = m g + M / R reaches T₂ e^(μ φ), with φ = π.
    """
    friction, radius, load, inertia = (jnp.sum(values[name]) for name in NAMES)
    tension = load * G * jnp.exp(friction * np.pi)
    start = radius * (tension - load * G) / RATE
    turned = RATE * jnp.maximum(t1 - start, 0.0) ** 3 / (6.0 * inertia)
    return jnp.stack([start, -turned, jnp.minimum(tension, load * G + RATE * t1 / radius)])


NAMES = "rope.friction", "rope.radii", "load.mass", "wheel.inertia"
MOTOR = {"motor.force": lambda t: -RATE * t}


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_wheel_that_begins_to_slip_in_a_rope(dimension):
    """The time of slip, the motion after it, and the energy: work of the motor less the heat of friction."""
    system, ts = band_brake(dimension), np.linspace(0.0, 0.8, 17)
    motion = mb.simulate(system, mb.assemble(system), t1=0.8, inputs=MOTOR, saveat=ts, rtol=1e-10)
    start, angle, _ = np.asarray(braked(dict(zip(NAMES, (0.3, R, LOAD, 0.05), strict=True))))
    (slip,) = motion.events
    assert (slip.part, slip.kind) == ("rope", "slip")
    np.testing.assert_allclose(slip.time, start, rtol=1e-9)
    np.testing.assert_allclose(motion["axle"].angle[-1], angle, rtol=1e-8)
    np.testing.assert_array_less(np.abs(motion["axle"].angle[ts < start]), 1e-15)
    np.testing.assert_allclose(motion["load"].velocity, 0.0, atol=1e-12)
    taut, brake = motion["rope"].tension, (np.exp(0.3 * np.pi) - 1.0) * LOAD * G
    np.testing.assert_allclose(taut[:, 0], LOAD * G + np.minimum(RATE * ts / R, brake), rtol=1e-9)
    np.testing.assert_allclose(taut[:, 1], LOAD * G, rtol=1e-9)
    # The rate is −RATE τ² / 2 I at the time τ after slip began.
    after = 0.8 - start
    work = RATE**2 / (2 * 0.05) * (after**4 / 4.0 + start * after**3 / 3.0)
    heat = -R * brake * motion["axle"].angle[-1]
    np.testing.assert_allclose(motion.energy[-1] - motion.energy[0], work - heat, rtol=1e-8)


@pytest.mark.slow
def test_derivatives_through_the_begin_of_slip():
    """Forwards, backwards, and as the closed form, in a batch of which one member sticks. With another radius the rope
    is not vertical: then as differences.
    """
    system = band_brake()
    known = mb.parameters(system)
    values = {name: jnp.stack([known[name]] * 2) for name in NAMES}
    values["rope.friction"] = values["rope.friction"].at[1].set(1.2)

    def end(values, rtol=1e-9):
        changed = mb.with_parameters(system, values)
        motion = mb.simulate(changed, mb.assemble(changed), t1=0.8, inputs=MOTOR, rtol=rtol, **METHOD)
        return jnp.stack([motion["axle"].angle[-1], motion["rope"].tension[-1, 0]])

    expected = jax.vmap(jax.jacfwd(lambda values: braked(values)[1:]))(values)
    tight = jax.jit(jax.vmap(lambda values: end(values, rtol=1e-12)))
    moved = [tight(values | {"rope.radii": values["rope.radii"] + h}) for h in (1e-4, -1e-4)]
    expected["rope.radii"] = ((moved[0] - moved[1]) / 2e-4)[..., None]
    for derivative in (jax.jacfwd, jax.jacrev):
        found = jax.jit(jax.vmap(derivative(end)))(values)
        for name in NAMES:
            close = {"rtol": 1e-5, "atol": 1e-6} if name == "rope.radii" else {"rtol": 1e-7, "atol": 1e-9}
            np.testing.assert_allclose(found[name], expected[name], **close)


def atwood(**pulley):
    """Two loads on a wheel that may turn."""
    bodies = [wheel(0.02, 0.0, 0.0), point("left", 1.0, -R, -1.0), point("right", 2.0, R, -1.2)]
    path = [("left", (0.0, 0.0)), mb.Pulley("wheel", R, "right", **pulley), ("right", (0.0, 0.0))]
    return mb.Scene(bodies, joints=[axle("wheel", 0.0, 0.0), mb.Rope("rope", path)], forces=[GRAVITY]).compile()


@pytest.mark.slow
@pytest.mark.parametrize("friction, same", [(0.0, {}), (50.0, {"grips": True})], ids=["none", "much"])
def test_the_limits_of_friction(friction, same):
    """Without friction the wheel rests; with very much of it the rope turns the wheel as if it gripped."""
    found = []
    for pulley in (same, {"friction": friction}):
        system = atwood(**pulley)
        motion = mb.simulate(system, mb.assemble(system), t1=0.3, rtol=1e-10)
        found.append((motion["left"].position[-1], motion["wheel"].angle[-1], motion["rope"].tension[-1]))
        assert "friction" not in pulley or len(motion.events) == 0
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(np.broadcast_to(a, np.shape(b)), b, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_slip_that_ends():
    """A wheel that turns under a rope at rest drives it, until the rope turns with it; then both go on together."""
    system = mb.with_parameters(atwood(friction=0.1), {"right.mass": 1.0})
    start = mb.assemble(system, rates={"wheel.angle": -5.0, "left.y": 0.0})
    motion = mb.simulate(system, start, t1=1.0, rtol=1e-10)
    # The wheel turns the rope along its path, and slip is backwards: T₁ = T₂ e^(μ π).
    growth = np.exp(0.1 * np.pi)
    up = G * (growth - 1.0) / (growth + 1.0)
    stick = 5.0 / (2.0 * up * R / 0.02 + up / R)
    (event,) = motion.events
    assert (event.part, event.kind) == ("rope", "stick")
    np.testing.assert_allclose(event.time, stick, rtol=1e-9)
    np.testing.assert_allclose(motion["left"].velocity[-1, 1], up * stick, rtol=1e-8)
    np.testing.assert_allclose(motion["wheel"].angular_velocity[-1], -up * stick / R, rtol=1e-8)
    np.testing.assert_allclose(motion["rope"].tension[-1], [G, G], rtol=1e-9)
    assert motion.ys.q[-1, -1] == 2


@pytest.mark.slow
def test_a_length_that_is_an_input():
    """The rope is paid out at the start of its path, and slips over all pulleys; a winch hoists against friction."""
    path = [("ground", (-R, -0.5)), mb.Pulley("ground", R, "right", friction=0.2), ("load", (0.0, 0.0))]
    system = mb.Scene([point("load", 2.0, R, -1.0)], joints=[mb.Rope("rope", path)], forces=[GRAVITY]).compile()
    length = float(mb.parameters(system)["rope.length"])
    system = mb.with_inputs(system, {"rope.length": lambda t: length - 0.5 * t})
    state = mb.assemble(system, fix={"rope.mode": -1})
    np.testing.assert_allclose(state.u[:2], [0.0, 0.5], atol=1e-12)
    tensions = instants(system, state)("rope.tension")[0]
    np.testing.assert_allclose(tensions, 2.0 * G * np.array([np.exp(0.2 * np.pi), 1.0]), rtol=1e-10)
    slip = Instant(system, jnp.zeros(()), state.q, state.u).contact_motion.rates
    np.testing.assert_allclose(slip, -0.5, rtol=1e-12)


# Studies, and bad input


@pytest.mark.slow
def test_loads_and_required_forces():
    """Loads on the wheel balance; a trajectory gives back its motor, and coordinates alone do not."""
    system = band_brake()
    motion = mb.simulate(system, mb.assemble(system), t1=0.8, inputs=MOTOR, saveat=[0.5, 0.65, 0.8], rtol=1e-9)
    on_wheel = mb.loads(motion, "wheel")
    assert dict(zip(on_wheel.names, on_wheel.kinds, strict=True))["rope"] == "joint"
    for total in on_wheel.balance:
        np.testing.assert_allclose(total, 0.0, atol=1e-9)
    taut = motion["rope"].tension
    np.testing.assert_allclose(on_wheel["rope"].moment[:, 2], R * (taut[:, 0] - taut[:, 1]), rtol=1e-9)
    needed = mb.required_forces(system, motion, by=["motor", "load.x"])
    np.testing.assert_allclose(needed["motor"], -RATE * motion.ts, rtol=1e-7)
    np.testing.assert_allclose(needed["load.x"], 0.0, atol=1e-7)
    with pytest.raises(ValueError, match="do not determine whether rope sticks"):
        mb.required_forces(system, {"axle.angle": lambda t: t**2, "load.x": lambda t: R}, by=["motor"], ts=[0.1])


REFUSED = {
    "a drum": ([("ground", (0.0, 0.0)), mb.Pulley("wheel", R, "left", friction=0.1)], {}, r"path\[1\] is a drum"),
    "grips": ({"friction": 0.1, "grips": True}, {}, r"path\[1\] grips, .* leave grips or friction out"),
    "elastic": ({"friction": 0.1}, {"stiffness": 1e3}, "friction of pulleys needs a rope of constant length"),
    "slack": ({"friction": 0.1}, {"slack": True}, "with slack it has no friction of pulleys"),
    "negative": ({"friction": -0.1}, {}, "friction must be non-negative"),
    "a point mass": ({"friction": 0.1}, {"body": point("wheel", 1.0, 1.0, 0.0)}, "acts on the rotation of a PointMass"),
}


@pytest.mark.parametrize("path, rope, message", REFUSED.values(), ids=REFUSED)
def test_friction_that_is_refused(path, rope, message):
    body = rope.get("body", wheel(1.0, 1.0, 0.0))
    options = {name: value for name, value in rope.items() if name != "body"}
    if isinstance(path, dict):
        path = [("ground", (0.0, 0.0)), mb.Pulley("wheel", R, "left", **path), ("ground", (2.0, 0.0))]
    with pytest.raises(ValueError, match=f"Rope 'rope'.*{message}"):
        mb.Scene([body], joints=[mb.Rope("rope", path, **options)]).compile()
