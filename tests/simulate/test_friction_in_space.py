"""Dry friction of contacts in space, which slips in any direction and sticks, against closed forms."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from scipy.integrate import quad

import jaxmb as mb
from jaxmb import spatial
from jaxmb.manifold import Projection
from jaxmb.parts import terrain
from jaxmb.solvers import Hermite

pytestmark = pytest.mark.slow

G, MASS, RADIUS, TOP = 9.81, 0.17, 0.03, 0.5
DOWN = mb.Gravity((0.0, 0.0, -G))
INERTIA = spatial.sphere(MASS, RADIUS)
SPIN = jnp.array([5.0, -30.0])


def ball(height=RADIUS, restitution=0.0):
    """A ball that flies or rolls on a floor, with a spin about all three axes."""
    body = spatial.Body(
        "ball",
        mass=MASS,
        inertia=INERTIA,
        position=(0.0, 0.0, height),
        velocity=(1.0, 0.3, 0.0),
        angular_velocity=(*SPIN, 8.0),
    )
    floor = mb.RigidContact("floor", "ball", terrain=terrain.Flat(), radius=RADIUS, restitution=restitution)
    rub = mb.DryFriction("rub", "floor", coefficient=0.2)
    return mb.Scene([body], joints=[floor], forces=[DOWN, rub]).compile()


BOUNCING = ball(TOP, 0.6)


def slip_of(velocity, spin):
    """Of the lowest point of a ball."""
    return velocity + RADIUS * jnp.stack([-spin[1], spin[0]])


def test_a_ball_rolls_after_slipping():
    """The direction of slip stays, and slip ends when two sevenths of it have gone into the motion of the ball."""
    velocity = np.array([1.0, 0.3])
    slip = np.asarray(slip_of(velocity, SPIN))
    stops, along = np.linalg.norm(slip) * 2 / (7 * 0.2 * G), slip / np.linalg.norm(slip)
    ts = np.array([0.5 * stops, 1.0])
    system = ball()
    motion = mb.simulate(system, mb.assemble(system), t1=1.0, saveat=ts, rtol=1e-10)
    (event,) = motion.events
    assert (event.part, event.kind) == ("rub", "stick")
    np.testing.assert_allclose(event.time, stops, rtol=1e-10)
    slides = np.minimum(ts, stops)[:, None]
    exact = velocity * ts[:, None] - 0.2 * G * along * (slides**2 / 2 + (ts[:, None] - slides) * slides)
    np.testing.assert_allclose(motion["ball"].position[:, :2], exact, atol=1e-10)
    np.testing.assert_allclose(
        motion.reactions["rub"].force, [[*(-0.2 * MASS * G * along), 0.0], [0.0, 0.0, 0.0]], atol=1e-9
    )


def bounced(p):
    """Where a ball is that has bounced once and twice, in closed form."""
    time = jnp.sqrt(2 * (TOP - RADIUS) / G)
    velocity, spin, down = jnp.array([1.0, 0.3]), SPIN, G * time
    ends = [time]
    velocities = [velocity]
    for _ in range(2):
        slip = slip_of(velocity, spin)
        speed = jnp.linalg.norm(slip)
        impulse = jnp.minimum(p[0] * MASS * down * (1 + p[1]), 2 / 7 * MASS * speed) * -slip / speed
        velocity = velocity + impulse / MASS
        spin = spin + RADIUS * jnp.stack([impulse[1], -impulse[0]]) / INERTIA[0, 0]
        down = p[1] * down
        ends.append(ends[-1] + 2 * down / G)
        velocities.append(velocity)
    at = lambda t: sum(v * (jnp.clip(t, a, b) - a) for v, a, b in zip(velocities, [0.0, *ends], ends, strict=False))
    return jnp.concatenate([at(0.5), at(0.9)])


def bounces(p):
    system = mb.with_parameters(BOUNCING, {"rub.coefficient": p[0], "floor.restitution": p[1]})
    motion = mb.simulate(system, mb.assemble(system), t1=0.9, saveat=[0.5, 0.9], rtol=1e-10)
    return motion["ball"].position[:, :2].reshape(-1)


@pytest.mark.parametrize("friction", [0.05, 0.2])
def test_derivatives_through_bounces_with_spin(friction):
    """Slip remains in both bounces, or ends in them."""
    p = jnp.array([friction, 0.6])
    np.testing.assert_allclose(jit_quickly(bounces)(p), bounced(p), atol=1e-10)
    exact = jax.jacfwd(bounced)(p)
    forward = jit_quickly(jax.jacfwd(bounces))(p)
    np.testing.assert_allclose(forward, exact, atol=1e-8)
    np.testing.assert_allclose(jit_quickly(jax.jacrev(bounces))(p), forward, atol=1e-12)


def incline(angle=0.3, velocity=(-0.5, 1.0)):
    """A particle on an incline, downhill along x."""
    body = spatial.PointMass("particle", mass=2.0, position=(0.0, 0.0, 0.0), velocity=(*velocity, 0.0))
    floor = mb.RigidContact("floor", "particle", terrain=terrain.Flat())
    rub = mb.DryFriction("rub", "floor", coefficient=0.5)
    gravity = mb.Gravity((G * np.sin(angle), 0.0, -G * np.cos(angle)))
    return mb.Scene([body], joints=[floor], forces=[gravity, rub]).compile()


INCLINE = incline()


def comes_to_rest(friction, angle=0.3, velocity=(-0.5, 1.0)):
    """When and where a particle on an incline comes to rest, by the tangent z of half the angle of its path downhill:
    its speed is `c z^(k − 1) (1 + z²) / 2`, with k the friction over the slope.
    """
    k, z = friction / np.tan(angle), np.tan(0.5 * np.arctan2(velocity[1], velocity[0]))
    c = 2 * np.hypot(*velocity) / (z ** (k - 1) * (1 + z**2))
    speed = lambda z: 0.5 * c * z ** (k - 1) * (1 + z**2)
    slows = lambda z: 0.5 * c / (G * np.sin(angle)) * z ** (k - 2) * (1 + z**2)
    cosine, sine = lambda z: (1 - z**2) / (1 + z**2), lambda z: 2 * z / (1 + z**2)
    over = lambda part: quad(lambda z: part(z) * slows(z), 0.0, z, epsabs=1e-13, epsrel=1e-12)[0]
    return [over(lambda z: 1.0), over(lambda z: speed(z) * cosine(z)), over(lambda z: speed(z) * sine(z))]


SOLVERS = {
    "Adams": {},
    "Hermite": {"solver": Hermite()},
    "Tsit5": {"solver": diffrax.Tsit5()},
    "Projection": {"manifold": Projection()},
}


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_particle_turns_downhill_and_stops(solver):
    """Towards the stop its direction changes ever faster; with friction just above the slope it is stiff there."""
    for friction in (0.35, 0.5, 0.9):
        time, x, y = comes_to_rest(friction)
        system = mb.with_parameters(INCLINE, {"rub.coefficient": friction})
        motion = mb.simulate(system, mb.assemble(system), t1=1.5, saveat=[1.5], rtol=1e-9, **SOLVERS[solver])
        (event,) = motion.events
        assert event.kind == "stick"
        np.testing.assert_allclose(event.time, time, rtol=1e-7)
        np.testing.assert_allclose(motion["particle"].position[-1], [x, y, 0.0], atol=2e-9)


def test_derivatives_towards_a_stop():
    def rests(p):
        system = mb.with_parameters(INCLINE, {"rub.coefficient": p})
        motion = mb.simulate(system, mb.assemble(system), t1=1.5, saveat=[1.5], rtol=1e-9)
        return jnp.append(motion["particle"].position[-1, :2], motion.events.times[0])

    step = 1e-5
    ahead, back = (np.array(comes_to_rest(0.5 + s)) for s in (step, -step))
    exact = np.roll(ahead - back, -1) / (2 * step)
    forward = jit_quickly(jax.jacfwd(rests))(0.5)
    np.testing.assert_allclose(forward, exact, rtol=1e-6)
    np.testing.assert_allclose(jit_quickly(jax.jacrev(rests))(0.5), forward, rtol=1e-10)


def test_stick_slip_along_a_diagonal():
    """A block on a plate that moves, on a spring: the times are those of the motion along a line."""
    mass, stiffness, speed, slip, stick = 2.0, 80.0, 0.2, 0.2, 0.35
    along = np.array([np.cos(0.5), np.sin(0.5), 0.0])
    bodies = [
        spatial.Body("plate", mass=1.0, inertia=(1.0, 1.0, 1.0), velocity=speed * along),
        spatial.PointMass("block", mass=mass, velocity=speed * along),
    ]
    joints = [
        spatial.Prismatic("rail", "ground", "plate", axis=along, point=(0.0, 0.0, 0.0)),
        mb.JointDriver("drive", "rail.displacement", rate=speed),
        mb.RigidPlaneContact("top", "plate", "block", normal=(0.0, 0.0, 1.0)),
    ]
    spring = spatial.SpringDamper("spring", "ground", "block", stiffness=stiffness, free_length=0.0)
    rub = mb.DryFriction("rub", "top", coefficient=slip, static_coefficient=stick)
    system = mb.Scene(bodies, joints=joints, forces=[DOWN, spring, rub]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=3.0, rtol=1e-9)
    further, w = (stick - slip) * mass * G / stiffness, np.sqrt(stiffness / mass)
    first = stick * mass * G / stiffness / speed
    period = 2 * further / speed + (2 * np.pi - 2 * np.arctan(further * w / speed)) / w
    kinds, times = [event.kind for event in motion.events], [event.time for event in motion.events]
    begins = [time for time, kind in zip(times, kinds, strict=True) if kind == "slip"]
    assert kinds == ["slip", "stick"] * (len(begins) - 1) + ["slip"]
    assert len(begins) > 2
    np.testing.assert_allclose(begins, first + period * np.arange(len(begins)), rtol=1e-7)


@pytest.mark.parametrize("friction", [0.05, 0.6])
def test_two_balls_strike_each_other(friction):
    """In any direction: the impulse along the line of the centres is that of restitution; across it, at most that of
    friction, and what ends the slip.
    """
    normal, radius, restitution = np.array([0.48, -0.6, 0.64]), 0.1, 0.7
    velocities, spins = np.array([[1.0, 0.2, 0.1], [-0.3, 0.9, -0.6]]), np.array([[1.0, 4.0, -2.0], [0.5, -3.0, 6.0]])
    apart = 0.05
    # They are as far from each other that they touch when the line of their centres is the normal.
    relative = velocities[1] - velocities[0]
    time = apart / -np.dot(relative, normal)
    start = 2 * radius * normal - relative * time
    bodies = [
        spatial.Body(name, mass=1.0, inertia=spatial.sphere(1.0, radius), position=at, velocity=v, angular_velocity=w)
        for name, at, v, w in zip("ab", (np.zeros(3), start), velocities, spins, strict=True)
    ]
    pair = mb.RigidBallContact("pair", "a", "b", radius_a=radius, radius_b=radius, restitution=restitution)
    rub = mb.DryFriction("rub", "pair", coefficient=friction)
    system = mb.Scene(bodies, joints=[pair], forces=[rub]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=2 * time, saveat=[2 * time], rtol=1e-10)
    of_a, of_b = (v + np.cross(w, s * radius * normal) for v, w, s in zip(velocities, spins, (1, -1), strict=True))
    slip = (of_b - of_a) - np.dot(of_b - of_a, normal) * normal
    push = -0.5 * (1 + restitution) * np.dot(relative, normal)
    size = min(friction * push, np.linalg.norm(slip) / 7)
    impulse = push * normal - size * slip / np.linalg.norm(slip)
    inertia = 0.4 * radius**2
    np.testing.assert_allclose(motion["b"].velocity[-1], velocities[1] + impulse, atol=1e-9)
    np.testing.assert_allclose(motion["a"].velocity[-1], velocities[0] - impulse, atol=1e-9)
    turned = [mb.rotations.rotate(motion[k].orientation[-1], motion[k].angular_velocity[-1]) for k in "ab"]
    np.testing.assert_allclose(turned[0], spins[0] - np.cross(radius * normal, impulse) / inertia, atol=1e-8)
    np.testing.assert_allclose(turned[1], spins[1] - np.cross(radius * normal, impulse) / inertia, atol=1e-8)
    np.testing.assert_allclose([event.impulse for event in motion.events], [push, size], rtol=1e-9)


def feet(count):
    """A table on a slope, whose feet share forces that are not determined."""
    turns = 2 * np.pi * np.arange(count) / count
    feet = {f"foot{k}": (0.5 * np.cos(a), 0.5 * np.sin(a), -0.4) for k, a in enumerate(turns)}
    body = spatial.Body("table", mass=10.0, inertia=(1.0, 1.0, 1.0), position=(0.0, 0.0, 0.4))
    floors = [mb.RigidContact(k, "table", terrain=terrain.Flat(), centre=at) for k, at in feet.items()]
    rubs = [mb.DryFriction(f"rub {k}", k, coefficient=0.3) for k in feet]
    gravity = mb.Gravity((G * np.sin(0.2), 0.0, -G * np.cos(0.2)))
    return mb.Scene([body], joints=floors, forces=[gravity, *rubs]).compile()


def test_a_table_on_three_feet():
    """It stands up to the slope of the friction, though some of its feet, which carry less, cannot hold their share,
    and slides beyond.
    """
    system = feet(3)
    for friction in (0.1, 0.19, 0.204, 0.21, 0.3):
        own = mb.with_parameters(system, {f"rub foot{k}.coefficient": friction for k in range(3)})
        motion = mb.simulate(own, mb.assemble(own), t1=0.5, saveat=[0.5], rtol=1e-8)
        slides = 0.125 * G * max(np.sin(0.2) - friction * np.cos(0.2), 0.0)
        np.testing.assert_allclose(motion["table"].position[-1], [slides, 0.0, 0.4], atol=1e-8)


def test_energy_falls_while_a_table_turns_and_slides():
    system = feet(3)
    start = mb.assemble(system)
    start = mb.State(start.q, start.u.at[0].set(0.5).at[5].set(2.0))
    motion = mb.simulate(system, start, t1=1.0, saveat=np.linspace(0.0, 1.0, 201), rtol=1e-8)
    energy = np.asarray(motion.energy)
    assert np.all(np.diff(energy) <= 1e-7 * energy[0])
    assert motion.events[-1].kind == "stick"


def test_a_batch_whose_members_stop_at_other_times():
    frictions = jnp.array([0.4, 0.5, 0.9])

    def rests(p):
        system = mb.with_parameters(INCLINE, {"rub.coefficient": p})
        motion = mb.simulate(system, mb.assemble(system), t1=1.5, saveat=[1.5], rtol=1e-9)
        return jnp.append(motion["particle"].position[-1, :2], motion.events.times[0])

    exact = [np.roll(comes_to_rest(float(p)), -1) for p in frictions]
    np.testing.assert_allclose(jit_quickly(jax.vmap(rests))(frictions), exact, atol=1e-8)
