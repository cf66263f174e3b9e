"""Friction of ropes on pulleys against Euler's and Eytelwein's formula: stick and slip, their times, derivatives."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from at_instants import instant, point

import jaxmb as mb
from jaxmb import planar, spatial

G, R = 9.81, 0.1
GRAVITY = mb.Gravity((0.0, -G))
# Compiled sooner than the default.
METHOD = {"solver": diffrax.Dopri8(), "manifold": mb.manifold.Projection()}


def wheel(inertia, *position, name="wheel", **state):
    return planar.Body(name, mass=1.0, inertia=inertia, position=position, **state)


def axle(body, *at):
    return planar.Revolute(f"{body} axle", "ground", body, point=at)


def hoist(left=1.0, right=3.0, *, friction=0.2, turns=0.0, dimension=2):
    """Two loads on a rope over a drum that stands still."""
    if dimension == 2:
        loads = [point("left", left, -R, -1.0), point("right", right, R, -1.2)]
        over, gravity = {}, GRAVITY
    else:
        loads = [
            spatial.PointMass("left", mass=left, position=(-R, 0.0, -1.0)),
            spatial.PointMass("right", mass=right, position=(R, 0.0, -1.2)),
        ]
        over, gravity = {"axis": (0.0, -1.0, 0.0)}, mb.Gravity((0.0, 0.0, -G))
    drum = mb.Pulley("ground", R, "right", turns=turns, friction=friction, **over)
    path = [("left", np.zeros(dimension)), drum, ("right", np.zeros(dimension))]
    return mb.Scene(loads, joints=[mb.Rope("rope", path)], forces=[gravity]).compile()


def slips(system, mode, **fix):
    return instant(system, mb.assemble(system, fix={"rope.mode": mode, **fix}))


# Euler's and Eytelwein's formula


@pytest.mark.parametrize("mode", [1, -1])
@pytest.mark.parametrize("dimension, turns", [(2, 0.0), (2, 2.0), (3, 3.0)])
def test_the_capstan_equation(dimension, turns, mode):
    """Half a turn and some full turns on the drum: `T₂ = T₁ e^(μ φ)`, against the slip."""
    system = hoist(turns=turns, dimension=dimension)
    own, growth = slips(system, mode), np.exp(mode * 0.2 * np.pi * (1 + 2 * turns))
    a = G * (3.0 - growth) / (3.0 + growth)
    np.testing.assert_allclose(own("rope.wrap"), [np.pi * (1 + 2 * turns)], rtol=1e-12)
    np.testing.assert_allclose(own("rope.length"), 2.2 + R * np.pi * (1 + 2 * turns), rtol=1e-12)
    np.testing.assert_allclose(own("right.acceleration")[-1], -a, rtol=1e-10)
    np.testing.assert_allclose(own("left.acceleration")[-1], a, rtol=1e-10)
    np.testing.assert_allclose(own("rope.tension"), (G + a) * np.array([1.0, growth]), rtol=1e-10)


@pytest.mark.parametrize("mode", [2, 0])
def test_stick_holds_the_loads(mode):
    """Before the start of a motion there is no friction."""
    own = slips(hoist(), mode)
    a = 0.0 if mode else 0.5 * G
    np.testing.assert_allclose(own("left.acceleration")[1], a, atol=1e-12)
    tensions = G * np.array([1.0, 3.0]) if mode else np.full(2, 1.5 * G)
    np.testing.assert_allclose(own("rope.tension"), tensions, rtol=1e-12)


def over_two(first=0.2, second=0.3, grips=None, mass=4.0):
    """A rope over two drums, the second below a ceiling; one of them may turn."""
    bodies = [point("left", 1.0, -R, -1.0), point("right", mass, 1.0 + R, -1.2), wheel(0.02, 0.5, -0.6)]
    spin = {"grips": True} if grips else {}
    path = [
        ("left", (0.0, 0.0)),
        mb.Pulley("ground", R, "right", friction=first),
        mb.Pulley("wheel", R, "left", **spin),
        mb.Pulley("ground", R, "right", (1.0, 0.0), friction=second),
        ("right", (0.0, 0.0)),
    ]
    return mb.Scene(bodies, joints=[axle("wheel", 0.5, -0.6), mb.Rope("rope", path)], forces=[GRAVITY]).compile()


@pytest.mark.parametrize("modes", [(1, 1), (-1, -1), (0, 0)])
def test_a_rope_that_rubs_on_two_pulleys(modes):
    system = over_two()
    own = instant(system, mb.assemble(system, fix={"rope.mode_1": modes[0], "rope.mode_2": modes[1]}))
    wraps, mu = own("rope.wrap"), np.array([0.2, 0.3])
    growth = np.exp(np.array(modes) * mu * wraps[[0, 2]])
    total = np.prod(growth)
    a = G * (4.0 - total) / (4.0 + total)
    np.testing.assert_allclose(own("right.acceleration")[1], -a, rtol=1e-10)
    np.testing.assert_allclose(own("rope.tension"), (G + a) * np.array([1.0, growth[0], total]), rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("mass", [2.0, 4.0])
def test_two_pulleys_hold_the_loads_or_let_them_go(mass):
    """Between two pulleys that stick the tension is undetermined, outside it is not."""
    system = over_two(mass=mass)
    motion = mb.simulate(system, mb.assemble(system), t1=0.1, rtol=1e-9)
    wraps = np.asarray(motion["rope"].wrap[-1])
    total = np.exp(0.2 * wraps[0] + 0.3 * wraps[2])
    a = max(G * (mass - total) / (mass + total), 0.0)
    np.testing.assert_allclose(motion["right"].velocity[-1, 1], -0.1 * a, rtol=1e-6, atol=1e-9)
    tension = motion["rope"].tension[-1]
    np.testing.assert_allclose(tension[jnp.array([0, 2])], [G + a, mass * (G - a)], rtol=1e-6)


@pytest.mark.slow
def test_a_rope_between_a_pulley_that_grips_and_its_drum():
    """Spans before and after a pulley that grips have tensions of their own; friction is in the second span alone."""
    bodies = [point("left", 1.0, -R, -1.0), point("right", 3.0, 1.0 + R, -1.2), wheel(0.02, 0.0, 0.0)]
    grip, rub = mb.Pulley("wheel", R, "right", grips=True), mb.Pulley("ground", R, "right", (1.0, 0.0), friction=0.4)
    rope = mb.Rope("rope", [("left", (0.0, 0.0)), grip, rub, ("right", (0.0, 0.0))])
    own = slips(mb.Scene(bodies, joints=[axle("wheel", 0.0, 0.0), rope], forces=[GRAVITY]).compile(), 1)
    growth = np.exp(0.2 * np.pi)
    # With the growth in force and inertia: T₂ = growth T₁, T₁ − T₀ = I a / R².
    a = G * (3.0 - growth) / (3.0 + growth * (1.0 + 2.0))
    first = G + a
    np.testing.assert_allclose(own("right.acceleration")[1], -a, rtol=1e-10)
    np.testing.assert_allclose(own("rope.tension"), [first, first + 2.0 * a, growth * (first + 2.0 * a)], rtol=1e-10)


# Motions


@pytest.mark.slow
def test_loads_stick_up_to_the_limit():
    """Half a turn holds loads in a ratio below `e^(μ π)`, in both directions; beyond it they fall at `a t² / 2`."""
    system, limit = hoist(), np.exp(0.2 * np.pi)

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


def test_a_length_that_is_an_input():
    """The rope is paid out at the start of its path, and slips over all pulleys; a winch hoists against friction."""
    load = point("load", 2.0, R, -1.0)
    path = [("ground", (-R, -0.5)), mb.Pulley("ground", R, "right", friction=0.2), ("load", (0.0, 0.0))]
    system = mb.Scene([load], joints=[mb.Rope("rope", path)], forces=[GRAVITY]).compile()
    length = float(mb.parameters(system)["rope.length"])
    system = mb.with_inputs(system, {"rope.length": lambda t: length - 0.5 * t})
    state = mb.assemble(system, fix={"rope.mode": -1})
    own = instant(system, state)
    np.testing.assert_allclose(own("load.velocity"), [0.0, 0.5], atol=1e-12)
    np.testing.assert_allclose(own("rope.tension"), 2.0 * G * np.array([np.exp(0.2 * np.pi), 1.0]), rtol=1e-10)
    slip = system.contacts.rates(system, jnp.zeros(()), state.q, state.u)
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


MESSAGES = {
    "a drum": ([("ground", (0.0, 0.0)), mb.Pulley("wheel", R, "left", friction=0.1)], {}, r"path\[1\] is a drum"),
    "grips": ({"friction": 0.1, "grips": True}, {}, r"path\[1\] grips, .* leave grips or friction out"),
    "elastic": ({"friction": 0.1}, {"stiffness": 1e3}, "friction of pulleys needs a rope of constant length"),
    "slack": ({"friction": 0.1}, {"slack": True}, "with slack it has no friction of pulleys"),
    "negative": ({"friction": -0.1}, {}, "friction must be non-negative"),
}


@pytest.mark.parametrize("name", MESSAGES)
def test_bad_input(name):
    path, rope, message = MESSAGES[name]
    if isinstance(path, dict):
        path = [("ground", (0.0, 0.0)), mb.Pulley("wheel", R, "left", **path), ("ground", (2.0, 0.0))]
    with pytest.raises(ValueError, match=f"Rope 'rope': .*{message}"):
        mb.Scene([wheel(1.0, 1.0, 0.0)], joints=[mb.Rope("rope", path, **rope)]).compile()


@pytest.mark.slow
def test_a_pulley_on_a_point_mass():
    path = [("ground", (0.0, 0.0)), mb.Pulley("wheel", R, "left", friction=0.1), ("ground", (2.0, 0.0))]
    with pytest.raises(ValueError, match="Rope 'rope' acts on the rotation of a PointMass"):
        mb.Scene([point("wheel", 1.0, 1.0, 0.0)], joints=[mb.Rope("rope", path)]).compile()
