"""Scenes whose joints are not all ideal, and servo constraints."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rough_machines import GRAVITY, SCENES, manipulator

import jaxmb as mb
from jaxmb import formulations, planar
from jaxmb.formulations import accelerations
from jaxmb.linalg.rotations import rotate

pytestmark = pytest.mark.slow


def random_state(system, seed):
    rng = np.random.default_rng(seed)
    guess = system.guess.q + 0.2 * rng.normal(size=system.nq)
    state = mb.assemble(system, guess=mb.State(guess, jnp.asarray(rng.normal(size=system.nu))))
    return state.q, state.u


def test_program_is_reached_as_its_gains_say():
    """Started off the program, the deviation decays as φ̈ + 6 φ̇ + 9 φ = 0: (φ0 + (φ̇0 + 3 φ0) t) e^(−3t)."""
    system = manipulator()
    start = mb.assemble(system)
    times = np.linspace(0.0, 1.5, 7)
    motion = mb.simulate(system, start, t1=1.5, rtol=1e-10, saveat=jnp.asarray(times))
    lower = motion["lower"]
    phi = np.asarray(lower.position[:, 1]) - 0.2 * np.sin(times)
    rate = float(lower.velocity[0, 1]) - 0.2
    expected = (phi[0] + (rate + 3 * phi[0]) * times) * np.exp(-3 * times)
    assert abs(phi[0]) > 0.1
    np.testing.assert_allclose(phi, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", SCENES)
def test_every_formulation(name):
    """The same accelerations and reactions on every road; friction works against the slip, and as a force of the
    user's function.
    """
    system = SCENES[name]()
    roads = [
        formulations.Partitioned(),
        formulations.Multipliers(),
        formulations.NullSpace(),
        formulations.Poincare(),
        *map(formulations.UdwadiaKalaba, ("moore_penrose", "inverses", "singular_mass")),
    ]

    @jax.jit
    def every(q, u):
        return [accelerations(system, road, jnp.array(0.3), q, u) for road in roads]

    for seed in range(3):
        q, u = random_state(system, seed)
        (first, multipliers), *others = every(q, u)
        residual = system.acceleration_residual(0.3, q, u, first)
        np.testing.assert_allclose(residual, 0.0, atol=1e-10 * np.max(np.abs(first)))
        power = u @ system.nonideal_force(0.3, q, u, multipliers)
        assert power < 0
        for udot, own in others:
            np.testing.assert_allclose(udot, first, rtol=1e-10, atol=1e-10 * np.max(np.abs(first)))
            np.testing.assert_allclose(own, multipliers, rtol=1e-9, atol=1e-9 * np.max(np.abs(multipliers)))


# The bodies of joints, with the field of the point on the second, and those of the friction laws.
JOINTS = {
    "rail": ("ground", "carriage", "point_b"),
    "hinge": ("carriage", "arm", "point_b"),
    "swing": ("ground", "arm", None),
}
LAWS = {"rub": ("ground", "carriage"), "pin": ("carriage", "arm")}


def test_the_laws_of_newton_and_euler_close_for_every_body():
    """With the applied forces, friction among them, and the reactions."""
    system = SCENES["carriage"]()
    states = [random_state(system, seed) for seed in range(2)]
    ys, road = mb.State(*(jnp.stack(own) for own in zip(*states, strict=True))), formulations.Partitioned()
    motion = mb.Trajectory(system, road, jnp.full(2, 0.3), ys, {}, mb.RESULTS.successful, None, None)
    parameters = {name: np.asarray(own) for name, own in mb.parameters(system).items()}
    turn = lambda name, v: np.asarray(jax.vmap(rotate)(motion[name].orientation, v))
    left = {}
    for k, name in enumerate(system.body_names):
        udot = np.asarray(motion.accelerations).reshape(2, -1, 6)[:, k]
        mass, inertia = parameters[f"{name}.mass"], parameters[f"{name}.inertia"]
        w = np.asarray(motion[name].angular_velocity)
        spin = turn(name, udot[:, 3:] @ inertia + np.cross(w, w @ inertia))
        left[name] = [mass * (udot[:, :3] - parameters["gravity.acceleration"]), spin]

    def act(name, force, moment):
        if name != "ground":
            left[name] = [left[name][0] - force, left[name][1] - moment]

    for joint, (body_a, body_b, field) in JOINTS.items():
        place = np.zeros(3) if field is None else parameters[f"{joint}.{field}"]
        point = np.asarray(motion[body_b].position) + turn(body_b, jnp.broadcast_to(place, (2, 3)))
        force, moment, _ = map(np.asarray, motion.reactions[joint])
        for name, sign in ((body_a, -1), (body_b, 1)):
            arm = 0.0 if name == "ground" else np.cross(point - np.asarray(motion[name].position), force)
            act(name, sign * force, sign * (moment + arm))
    for law, bodies in LAWS.items():
        wrenches = np.asarray(motion.forces[law])
        assert wrenches.shape[1] == 2 and np.max(np.abs(wrenches)) > 1e-3
        for j, name in enumerate(bodies):
            act(name, wrenches[:, j, :3], 0.0 if name == "ground" else turn(name, wrenches[:, j, 3:]))
    for force, moment in left.values():
        np.testing.assert_allclose(force, 0.0, atol=1e-9)
        np.testing.assert_allclose(moment, 0.0, atol=1e-9)


def test_function_of_the_reactions():
    """`NonIdeal` with the law of `Friction`, and with forces along the joint's own, which the reaction balances."""
    rail = planar.Prismatic("rail", "ground", "block", point=(0.0, 0.0), axis=(1.0, 0.0))
    block = planar.Body("block", mass=2.0, inertia=1.0, position=(0.0, 0.0))

    def rub(poses, velocities, reactions, t, p):
        normal, slip = jnp.abs(reactions[-1, 1]), velocities[-1, 0]
        along = -p["coefficient"] * normal * jnp.tanh(slip / 1e-4) + 0.0 * t
        wrench = jnp.stack([along, p["lift"], 2.0 * p["lift"]])
        return jnp.stack([-wrench, wrench])

    laws = [
        planar.Friction("rub", "rail", coefficient=0.3),
        mb.NonIdeal("rub", "rail", rub, parameters={"coefficient": 0.3, "lift": 0.0}),
        mb.NonIdeal("rub", "rail", rub, parameters={"coefficient": 0.3, "lift": 5.0}),
    ]
    systems = [mb.Scene([block], joints=[rail], forces=[GRAVITY, law]).compile() for law in laws]
    q, u = jnp.array([0.4, 0.0, 0.0]), jnp.array([-0.7, 0.0, 0.0])
    results = [accelerations(s, formulations.Multipliers(), jnp.array(0.0), q, u)[0] for s in systems]
    np.testing.assert_allclose(results[0], results[1], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(results[0][0], 0.3 * 9.81, rtol=1e-14)
    np.testing.assert_allclose(results[2][0], 0.3 * (9.81 - 5.0 / 2.0), rtol=1e-14)
    assert mb.parameters(systems[1])["rub.coefficient"] == 0.3


def test_derivatives_of_a_motion():
    """With a program and with friction: forward, reverse and central differences, compiled and in a batch."""
    system = manipulator()
    names = ["rub.coefficient", "rub.radius", "tip.amplitude", "tip.damping", "tip.stiffness", "lower.mass"]
    start = jnp.array([float(mb.parameters(system)[name]) for name in names])

    def loss(x, rtol):
        changed = mb.with_parameters(system, dict(zip(names, x, strict=True)))
        state = mb.assemble(changed, rates={"lower.angle": 2.0, "upper.angle": -1.0}, throw=False)
        motion = mb.simulate(changed, state, t1=0.2, rtol=rtol, max_steps=512, throw=False)
        return jnp.sum(jnp.cos(jnp.arange(float(system.nq))) * motion.ys.q[-1])

    batch = lambda f: jax.jit(jax.vmap(f, in_axes=(0, None)))
    twice = lambda x, rtol: (loss(x, rtol),) * 2
    forward_and_value = batch(jax.jacfwd(twice, has_aux=True))
    forward = forward_and_value(start[None], 1e-9)[0][0]
    reverse = batch(jax.grad(loss))(start[None], 1e-9)[0]
    scale = np.max(np.abs(forward))
    assert np.all(np.abs(forward) > 1e-6 * scale)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-9 * scale)
    h = 1e-3 * np.abs(start)
    value = lambda k: np.array([forward_and_value((start + k * step)[None], 1e-12)[1][0] for step in np.diag(h)])
    central = (8 * (value(1.0) - value(-1.0)) - (value(2.0) - value(-2.0))) / (12 * h)
    np.testing.assert_allclose(forward, central, rtol=1e-5, atol=1e-7 * scale)


def drive(name, motion=lambda t, p: t, **gains):
    return mb.Servo(planar.Driver(name, "ground", "arm", quantity="angle", motion=motion, parameters={}), **gains)


TWIN = planar.Revolute("twin", "ground", "arm", point=(0.0, 0.0))
rub = functools.partial(planar.Friction, "rub", coefficient=0.1, radius=0.1)
REFUSED = [
    (lambda: ((), [rub("pim")]), r"'pim'.*pin"),
    (lambda: ((), [planar.Friction("rub", "pin", coefficient=0.1)]), "radius"),
    (lambda: ((), [rub("pin", coefficient=-0.1)]), "coefficient must be non-negative"),
    (lambda: ([TWIN], [rub("pin")]), r"not determined.*pin, twin"),
    (lambda: ([mb.Servo(planar.KnifeEdge("blade", "arm"))], ()), "constraint between positions"),
    (lambda: ([drive("turn", stiffness=-1.0)], ()), "stiffness must be non-negative"),
    (lambda: ([drive("turn")], [rub("turn")]), "Unknown joint 'turn'"),
    (
        lambda: ([drive("turn", lambda t, p: t**2), drive("other", lambda t, p: 2 * t**2)], ()),
        r"accelerations prescribed by.*turn.*contradict",
    ),
]


def test_refused():
    body = planar.Body("arm", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "arm", point=(0.0, 0.0))
    for parts, message in REFUSED:
        with pytest.raises(ValueError, match=message):
            joints, forces = parts()
            mb.Scene([body], joints=[pin, *joints], forces=forces).compile()
