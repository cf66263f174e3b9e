"""Dry friction that sticks and slips, against closed forms: times, motions, impulses, derivatives."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from scipy.integrate import quad, solve_ivp

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.contacts.impact import impact
from jaxmb.contacts.tolerance import ContactTolerance
from jaxmb.manifold import Projection
from jaxmb.parts import terrain
from jaxmb.solvers import Adams, Hermite

G = 9.81
DOWN = mb.Gravity((0.0, -G))


def slider(angle=0.0, velocity=3.0, **coefficients):
    """A block on an incline, along which it moves."""
    along = np.array([np.cos(angle), np.sin(angle)])
    rail = planar.Prismatic("rail", "ground", "block", axis=along, point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    return mb.Scene(
        [planar.Body("block", mass=2.0, inertia=0.1, velocity=velocity * along)],
        joints=[rail],
        forces=[DOWN, mb.DryFriction("rub", "rail", **coefficients)],
    ).compile()


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, diffrax.Dopri8()], ids=["Adams", "Dopri8"])
def test_a_block_that_is_pushed_to_and_fro_slips_at_each_peak(solver):
    """While it sticks nothing moves, so that no error estimate asks for short steps."""
    rail = planar.Prismatic("rail", "ground", "block", axis=(1.0, 0.0), point=(0.0, 0.0))
    push = mb.JointForce("push", "rail.displacement", force=0.0)
    system = mb.Scene(
        [planar.Body("block", mass=1.0, inertia=0.1)],
        joints=[rail],
        forces=[mb.Gravity((0.0, -10.0)), mb.DryFriction("rub", "rail", coefficient=0.5), push],
    ).compile()
    inputs = {"push.force": lambda t: 5.2 * jnp.sin(2 * jnp.pi * t)}
    motion = mb.simulate(system, mb.assemble(system), t1=3.0, inputs=inputs, solver=solver)
    slips = np.array([event.time for event in motion.events if event.kind == "slip"])
    np.testing.assert_allclose(slips, np.arcsin(5.0 / 5.2) / (2 * np.pi) + 0.5 * np.arange(6), rtol=1e-8)
    assert [event.kind for event in motion.events] == 6 * ["slip", "stick"]
    # It comes back where it was.
    np.testing.assert_allclose(motion["block"].position[-1, 0], 0.0, atol=1e-8)


def test_a_block_slides_stops_and_stays():
    system = slider(coefficient=0.3)
    motion = mb.simulate(system, mb.assemble(system), t1=2.0, saveat=[0.5, 2.0], rtol=1e-10)
    (stop,) = motion.events
    np.testing.assert_allclose(stop.time, 3.0 / (0.3 * G), rtol=1e-11)
    assert (stop.part, stop.kind, stop.impulse, stop.kinetic_energy_lost) == ("rub", "stick", 0.0, 0.0)
    # The first step after it is short, has no error, and the next one takes the rest.
    assert motion.stats["num_steps"] <= 18
    x = [3.0 * 0.5 - 0.15 * G * 0.25, 9.0 / (0.6 * G)]
    np.testing.assert_allclose(motion["block"].position[:, 0], x, rtol=1e-11)
    np.testing.assert_array_equal(motion["block"].velocity[1], [0.0, 0.0])
    np.testing.assert_allclose(motion.reactions["rub"].force, [[-0.6 * G, 0.0], [0.0, 0.0]], atol=1e-12)
    # A motion goes on from where another one ended.
    end = jax.tree.map(lambda y: y[-1], motion.ys)
    after = mb.simulate(system, end, t0=2.0, t1=3.0, saveat=[2.5, 3.0], rtol=1e-10)
    np.testing.assert_array_equal(after["block"].position[:, 0], end.q[0])
    assert len(after.events) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"manifold": Projection(), "solver": diffrax.Tsit5()},
        {"manifold": Projection()},
        {"solver": Hermite()},
    ],
    ids=["Tsit5", "Projection", "Hermite"],
)
def test_other_solvers_and_manifolds(options):
    system = slider(coefficient=0.3)
    motion = mb.simulate(system, mb.assemble(system), t1=2.0, saveat=[0.5, 2.0], rtol=1e-9, **options)
    np.testing.assert_allclose([event.time for event in motion.events], [3.0 / (0.3 * G)], rtol=1e-9)
    x = [3.0 * 0.5 - 0.15 * G * 0.25, 9.0 / (0.6 * G)]
    np.testing.assert_allclose(motion["block"].position[:, 0], x, rtol=1e-9)


@pytest.mark.slow
def test_a_batch_whose_members_stop_at_other_times():
    """One of them does not move at all, one does not stop; values and derivatives are those of each alone."""
    system = slider(coefficient=0.3)
    state = mb.assemble(system)

    def end(speed):
        start = mb.State(state.q, state.u.at[0].set(speed))
        return mb.simulate(system, start, t1=1.0, saveat=[1.0], rtol=1e-9)["block"].position[-1, 0]

    speeds = jnp.array([0.0, 1.0, -2.0, 5.0])
    slow = 0.3 * G
    exact = [0.0, 1.0 / (2 * slow), -4.0 / (2 * slow), 5.0 - slow / 2]
    found, slopes = jit_quickly(jax.vmap(lambda v: jax.jvp(end, (v,), (jnp.ones_like(v),))))(speeds)
    np.testing.assert_allclose(found, exact, rtol=1e-9, atol=1e-12)
    # At rest the displacement grows with the square of the speed.
    np.testing.assert_allclose(slopes, [0.0, 1.0 / slow, 2.0 / slow, 1.0], rtol=1e-8, atol=1e-12)
    reverse = jit_quickly(jax.vmap(jax.grad(end)))(speeds)
    np.testing.assert_allclose(reverse, slopes, rtol=1e-10, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("tan, time", [(0.29, None), (0.31, 0.7)])
def test_a_block_stays_on_an_incline_within_the_cone(tan, time):
    """Below the angle of friction nothing moves, above it the block slides down; forces are those of statics."""
    angle = np.arctan(tan)
    system = slider(angle, 0.0, coefficient=0.3)
    motion = mb.simulate(system, mb.assemble(system), t1=1.0, saveat=[0.5, 1.0], rtol=1e-10)
    along = motion["block"].position @ np.array([np.cos(angle), np.sin(angle)])
    slides = 0.0 if time is None else G * (np.sin(angle) - 0.3 * np.cos(angle))
    np.testing.assert_allclose(along, -0.5 * slides * np.array([0.25, 1.0]), rtol=1e-9, atol=1e-15)
    held = 2.0 * G * (np.sin(angle) if time is None else 0.3 * np.cos(angle))
    np.testing.assert_allclose(np.linalg.norm(motion.reactions["rub"].force, axis=1), held, rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("space", ["planar", "spatial"])
def test_a_wheel_on_a_pin_stops(space):
    if space == "planar":
        wheel = planar.Body("wheel", mass=2.0, inertia=0.3, angular_velocity=4.0)
        pin = planar.Revolute("pin", "ground", "wheel", point=(0.0, 0.0))
        gravity = DOWN
    else:
        wheel = spatial.Body("wheel", mass=2.0, inertia=(0.2, 0.3, 0.2), angular_velocity=(0.0, 4.0, 0.0))
        pin = spatial.Revolute("pin", "ground", "wheel", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
        gravity = mb.Gravity((0.0, 0.0, -G))
    rub = mb.DryFriction("rub", "pin", coefficient=0.4, radius=0.05)
    system = mb.Scene([wheel], joints=[pin], forces=[gravity, rub]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=4.0, rtol=1e-9)
    (stop,) = motion.events
    np.testing.assert_allclose(stop.time, 0.3 * 4.0 / (0.4 * 2.0 * G * 0.05), rtol=1e-9)


MASS, STIFFNESS, SPEED, SLIP, STICK = 2.0, 50.0, 0.5, 0.2, 0.35


def belt():
    """A block on a spring, on a belt that moves: it sticks and slips by turns."""
    bodies = [planar.Body(name, mass=MASS, inertia=0.1, velocity=(SPEED, 0.0)) for name in ("belt", "block")]
    joints = [
        planar.Prismatic("rail", "ground", "belt", axis=(1.0, 0.0), point_a=(0.0, 0.0), point_b=(0.0, 0.0)),
        planar.Prismatic("slide", "belt", "block", axis=(1.0, 0.0), point_a=(0.0, 0.0), point_b=(0.0, 0.0)),
        mb.JointDriver("drive", "rail.displacement", rate=SPEED),
    ]
    spring = planar.SpringDamper("spring", "ground", "block", stiffness=STIFFNESS, free_length=0.0)
    rub = mb.DryFriction("rub", "slide", coefficient=SLIP, static_coefficient=STICK)
    return mb.Scene(bodies, joints=joints, forces=[DOWN, spring, rub]).compile()


@pytest.mark.slow
def test_discs_that_roll_side_by_side():
    """They come nearer by rounding errors, which neither close their contact nor end the run."""
    discs = [
        planar.Body(
            f"disc{k}", mass=1.0, inertia=0.02, position=(0.4 * k, 0.2), velocity=(v, 0), angular_velocity=-5 * v
        )
        for k, v in enumerate((0.5, 0.5 - 5e-12))
    ]
    contacts = [mb.RigidContact(f"floor{k}", f"disc{k}", terrain=terrain.Flat(), radius=0.2) for k in range(2)]
    contacts.append(mb.RigidBallContact("pair", "disc0", "disc1", radius_a=0.2, radius_b=0.2))
    rubs = [mb.DryFriction(f"rub {part.name}", part.name, coefficient=0.3) for part in contacts]
    system = mb.Scene(discs, joints=contacts, forces=[DOWN, *rubs]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=1.0, rtol=1e-8, max_events=10)
    assert len(motion.events) == 0
    for k in range(2):
        np.testing.assert_allclose(motion[f"disc{k}"].position[-1], [0.5 + 0.4 * k, 0.2], atol=1e-10)


@pytest.mark.slow
def test_stick_slip_on_a_belt():
    system = belt()
    motion = mb.simulate(system, mb.assemble(system), t1=6.0, rtol=1e-10)
    further, w = (STICK - SLIP) * MASS * G / STIFFNESS, np.sqrt(STIFFNESS / MASS)
    first = STICK * MASS * G / STIFFNESS / SPEED
    period = 2 * further / SPEED + (2 * np.pi - 2 * np.arctan(further * w / SPEED)) / w
    assert [event.kind for event in motion.events] == ["slip", "stick"] * 4 + ["slip"]
    np.testing.assert_allclose(
        [event.time for event in motion.events][::2], first + period * np.arange(5.0), rtol=1e-10
    )


def ramp():
    """A block that slides to a stop, and is set in motion again by a force that grows."""
    push = mb.Force(
        "push", ["block"], lambda x, v, t, p: jnp.stack([p["rate"] * t, 0 * t, 0 * t])[None], parameters={"rate": 4.0}
    )
    rail = planar.Prismatic("rail", "ground", "block", axis=(1.0, 0.0), point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    block = planar.Body("block", mass=2.0, inertia=0.1, velocity=(1.0, 0.0))
    rub = mb.DryFriction("rub", "rail", coefficient=0.3, static_coefficient=0.4)
    return mb.Scene([block], joints=[rail], forces=[DOWN, rub, push]).compile()


RAMP = ramp()
RAMPED = {
    name: mb.parameters(RAMP)[name] for name in ("rub.coefficient", "rub.static_coefficient", "block.mass", "push.rate")
}


def ramped(p):
    """Its displacement after 3 s, and the times at which it stops and begins to move again, in closed form."""
    rate, slow = p["push.rate"] / p["block.mass"], p["rub.coefficient"] * G
    stops = (slow - jnp.sqrt(slow**2 - 2 * rate)) / rate
    first = stops + rate * stops**3 / 6 - slow * stops**2 / 2
    begins = p["rub.static_coefficient"] * G / rate
    further = rate * ((3.0**3 - begins**3) / 6 - begins**2 * (3.0 - begins) / 2)
    return first + further - slow * (3.0 - begins) ** 2 / 2, jnp.stack([stops, begins])


@pytest.mark.slow
def test_derivatives_through_stick_and_slip():
    """In reverse and forwards, against the closed form; the times of both events depend on the parameters."""

    def block(p):
        system = mb.with_parameters(RAMP, p)
        motion = mb.simulate(system, mb.assemble(system), t1=3.0, saveat=[3.0], rtol=1e-10)
        return motion["block"].position[-1, 0], motion.events.times[:2]

    (value, times), exact = jax.value_and_grad(ramped, has_aux=True)(RAMPED)
    (found, at), gradient = jit_quickly(jax.value_and_grad(block, has_aux=True))(RAMPED)
    np.testing.assert_allclose(found, value, rtol=1e-9)
    np.testing.assert_allclose(at, times, rtol=1e-9)
    for name in RAMPED:
        np.testing.assert_allclose(gradient[name], exact[name], rtol=1e-7, err_msg=name)
    ahead = {name: jnp.ones_like(value) for name, value in RAMPED.items()}
    along, later = jit_quickly(lambda p: jax.jvp(block, (p,), (ahead,))[1])(RAMPED)
    np.testing.assert_allclose(along, sum(gradient.values()), rtol=1e-9)
    np.testing.assert_allclose(later, jax.jvp(ramped, (RAMPED,), (ahead,))[1][1], rtol=1e-7)


RADIUS = 0.2


def disc(coefficient=0.2, height=RADIUS, velocity=3.0, spin=0.0, restitution=0.0):
    body = planar.Body(
        "disc",
        mass=1.5,
        inertia=0.5 * 1.5 * RADIUS**2,
        position=(0.0, height),
        velocity=(velocity, 0.0),
        angular_velocity=spin,
    )
    floor = mb.RigidContact("floor", "disc", terrain=terrain.Flat(), radius=RADIUS, restitution=restitution)
    rub = mb.DryFriction("rub", "floor", coefficient=coefficient)
    return mb.Scene([body], joints=[floor], forces=[DOWN, rub]).compile()


DISC = disc()


@pytest.mark.slow
def test_a_disc_rolls_after_slipping():
    motion = mb.simulate(DISC, mb.assemble(DISC), t1=1.0, saveat=[0.3, 1.0], rtol=1e-10)
    stick = motion.events[-1]
    np.testing.assert_allclose(stick.time, 3.0 / (3 * 0.2 * G), rtol=1e-10)
    assert stick.kind == "stick"
    np.testing.assert_allclose(motion["disc"].velocity[:, 0], [3.0 - 0.2 * G * 0.3, 2.0], rtol=1e-10)
    np.testing.assert_allclose(
        motion["disc"].angular_velocity, [-2 * 0.2 * G * 0.3 / RADIUS, -2.0 / RADIUS], rtol=1e-10
    )
    np.testing.assert_allclose(motion.reactions["rub"].force, [[-0.2 * 1.5 * G, 0.0], [0.0, 0.0]], atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("coefficient, spin", [(0.2, 0.0), (0.05, 0.0), (0.2, -40.0)])
def test_friction_has_an_impulse(coefficient, spin):
    """That of a disc that bounces: in the cone, against the slip that remains, or such that none remains."""
    system = disc(coefficient, 1.0, 2.0, spin, 0.5)
    motion = mb.simulate(system, mb.assemble(system), t1=0.5, saveat=[0.5], rtol=1e-10)
    falls = np.sqrt(2 * (1.0 - RADIUS) * G)
    normal = 1.5 * 1.5 * falls
    # The slip of the rim is that of the disc and of its spin, and changes by 3 / m for each unit of impulse.
    slip = 2.0 + RADIUS * spin
    impulse = np.clip(-1.5 * slip / 3, -coefficient * normal, coefficient * normal)
    floor, rub = motion.events
    assert (floor.kind, rub.kind, rub.part) == ("impact", "impact", "rub")
    np.testing.assert_allclose([floor.impulse, rub.impulse], [normal, impulse], rtol=1e-9)
    np.testing.assert_allclose(motion["disc"].velocity[-1, 0], 2.0 + impulse / 1.5, rtol=1e-9)
    np.testing.assert_allclose(motion["disc"].angular_velocity[-1], spin + 2 * impulse / 1.5 / RADIUS, rtol=1e-9)


@pytest.mark.slow
def test_derivatives_through_an_impact_with_friction():
    """Of a bounce whose slip remains, and of one whose slip ends, and of rolling after slipping."""

    bouncing = disc(0.1, 1.0, 2.0, 0.0, 0.5)

    def after(p):
        system = mb.with_parameters(bouncing, {"rub.coefficient": p[0], "floor.restitution": p[1]})
        motion = mb.simulate(system, mb.assemble(system), t1=1.0, saveat=[0.7, 1.0], rtol=1e-10)
        return motion["disc"].position[:, 0]

    def exact(p):
        time = jnp.sqrt(2 * (1.0 - RADIUS) / G)
        first = p[0] * G * time * (1 + p[1])
        # The second change of velocity is less where slip ends.
        second = jnp.minimum(first * p[1], (2.0 - 3 * first) / 3)
        again = time * (1 + 2 * p[1])
        return jnp.stack([2.0 * t - first * (t - time) - second * jnp.maximum(t - again, 0.0) for t in (0.7, 1.0)])

    p = jnp.array([0.05, 0.5])
    np.testing.assert_allclose(jit_quickly(after)(p), exact(p), rtol=1e-9)
    reverse, forward = jit_quickly(jax.jacrev(after))(p), jit_quickly(jax.jacfwd(after))(p)
    np.testing.assert_allclose(reverse, jax.jacobian(exact)(p), rtol=1e-7)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)


HALF, TALL = 0.1, 0.4


@pytest.mark.slow
@pytest.mark.parametrize("spin", [0.0, -40.0])
def test_impulses_and_energies_change_as_their_differences(spin):
    """Of an impact with friction that slips to its end, or whose slip ends in it; and the time of it."""
    system = disc(coefficient=0.2, height=RADIUS, velocity=1.0, spin=spin, restitution=0.4)
    state = mb.assemble(system)
    method = mb.simulate(system, state, t1=1e-3).formulation

    def event(x):
        changed = mb.with_parameters(system, {"rub.coefficient": x[0], "floor.restitution": x[1], "disc.mass": x[2]})
        y = mb.State(state.q.at[1].add(x[3]), state.u.at[:3].set(jnp.stack([x[4], -2.0, x[5]])))
        found = impact(changed, method, ContactTolerance(jnp.asarray(1e-3)), jnp.zeros(()), y, dated=True)
        return jnp.concatenate([found.impulses, jnp.stack([found.energy, found.late])])

    at, h = jnp.array([0.2, 0.4, 1.5, 0.0, 1.0, spin]), 1e-6
    forward, reverse = (jax.jit(mode(event))(at) for mode in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)
    value = jax.jit(jax.vmap(event))
    differences = (value(at[None] + h * jnp.eye(6)) - value(at[None] - h * jnp.eye(6))) / (2 * h)
    np.testing.assert_allclose(forward, differences.T, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_a_rocking_block():
    """Housner's: between impacts a pendulum about a corner, and at each impact the angular velocity falls by
    `1 - 1.5 sin² α`. Source: G. W. Housner, Bull. Seism. Soc. Am. 53, 1963.
    """
    reach, alpha, mass = np.hypot(HALF, TALL), np.arctan(HALF / TALL), 2.0
    own = mass * (HALF**2 + TALL**2) / 3
    about = own + mass * reach**2

    def quarter(angle):
        rate = lambda now: np.sqrt(2 * mass * G * reach / about * (np.cos(alpha - angle) - np.cos(alpha - now)))
        return quad(lambda r: 2 * r / rate(angle - r * r), 0.0, np.sqrt(angle), epsabs=1e-13, epsrel=1e-13)[0]

    start = angle = 0.5 * alpha
    times, now = [], 0.0
    for _ in range(4):
        times.append(now + quarter(angle))
        kinetic = (np.cos(alpha - angle) - np.cos(alpha)) * (1 - 1.5 * np.sin(alpha) ** 2) ** 2
        angle = alpha - np.arccos(np.cos(alpha) + kinetic)
        now = times[-1] + quarter(angle)

    c, s = np.cos(start), np.sin(start)
    position = (c * HALF - s * TALL, s * HALF + c * TALL)
    corners = {"left": (-HALF, -TALL), "right": (HALF, -TALL)}
    floors = [mb.RigidContact(own, "block", terrain=terrain.Flat(), centre=at) for own, at in corners.items()]
    rubs = [mb.DryFriction(f"rub {own}", own, coefficient=0.8) for own in corners]
    block = planar.Body("block", mass=mass, inertia=own, position=position, angle=start)
    system = mb.Scene([block], joints=floors, forces=[DOWN, *rubs]).compile()
    state = mb.assemble(system, fix={"left.mode": 1})
    motion = mb.simulate(system, state, t1=now, saveat=[now], rtol=1e-10)
    closes = [event for event in motion.events if event.kind == "close"]
    np.testing.assert_allclose([event.time for event in closes], times, rtol=1e-9)
    assert [event.part for event in closes] == ["right", "left"] * 2
    np.testing.assert_allclose(motion["block"].angle[-1], angle, rtol=1e-9)


def painleve(angle, velocity, coefficient):
    """A rod whose end slides on the ground."""
    centre = (-np.cos(angle), np.sin(angle))
    rod = planar.Body("rod", mass=1.0, inertia=1 / 3, position=centre, angle=-angle, velocity=(velocity, 0.0))
    tip = mb.RigidContact("tip", "rod", terrain=terrain.Flat(), centre=(1.0, 0.0))
    rub = mb.DryFriction("rub", "tip", coefficient=coefficient)
    return mb.Scene([rod], joints=[tip], forces=[DOWN, rub]).compile()


@pytest.mark.slow
def test_a_rod_that_jams():
    """Painlevé's: pushed along its lean it has no solution with much friction; pulled it has one."""
    system = painleve(1.2, 5.0, 2.0)
    with pytest.raises(RuntimeError, match=r"Painlevé's paradox.* These are 'tip', 'rub', at t = 0\."):
        mb.simulate(system, mb.assemble(system, fix={"tip.mode": 1}), t1=0.2)
    state = mb.assemble(painleve(1.2, -5.0, 2.0), fix={"tip.mode": 1})
    motion = mb.simulate(system, state, t1=0.1, saveat=[0.1], rtol=1e-10, solver=Adams())
    # Newton's and Euler's equations of the rod by themselves, with the force at the tip in its cone.
    reaction, angle = motion.reactions["tip"].force[0, 1], -motion["rod"].angle[0]
    assert reaction > 0
    np.testing.assert_allclose(motion.reactions["rub"].force[0], [2.0 * reaction, 0.0], rtol=1e-9, atol=1e-12)
    turn = reaction * np.cos(angle) + 2.0 * reaction * np.sin(angle)
    np.testing.assert_allclose(motion.accelerations[0, 2], 3.0 * turn, rtol=1e-8)


@pytest.mark.slow
def test_painleves_paradox_is_where_it_was_found():
    """Beyond a friction of 4/3, where `tan θ` is between `(3 μ ± √(9 μ² − 16)) / 2`, the force at the end of a rod that
    is pushed has no value, or two where the rod turns so fast that it may also lift off (F. Génot and B. Brogliato,
    "New results on Painlevé paradoxes", European Journal of Mechanics A/Solids 18, 1999).
    """
    coefficient = 1.6
    angle, turn = (x.ravel() for x in np.meshgrid(np.linspace(0.2, 1.4, 13), np.linspace(0.0, 6.0, 7)))
    system = painleve(1.0, 0.0, coefficient)
    state = mb.assemble(system, fix={"tip.mode": 1})

    def run(angle, turn):
        sin, cos = jnp.sin(angle), jnp.cos(angle)
        q = state.q.at[:3].set(jnp.stack([-cos, sin, -angle]))
        u = state.u.at[:3].set(jnp.stack([5.0 + turn * sin, turn * cos, -turn]))
        motion = mb.simulate(system, mb.State(q, u), t1=1e-4, rtol=1e-8, throw=False)
        return motion.result == mb.RESULTS.contacts_undetermined

    root = np.sqrt(9 * coefficient**2 - 16)
    paradox = np.abs(2 * np.tan(angle) - 3 * coefficient) < root
    lifts = turn**2 * np.sin(angle) > G
    assert all(np.any(paradox & own) and np.any(~paradox & own) for own in (lifts, ~lifts))
    np.testing.assert_array_equal(jit_quickly(jax.vmap(run))(jnp.array(angle), jnp.array(turn)), paradox)


@pytest.mark.slow
def test_a_rod_falls_off_the_edge_of_a_table():
    """It tips about the edge, slides over it where `tan θ = μ a² / (a² + 9 b²)`, and leaves it."""
    half, beyond, coefficient = 0.5, 0.2, 0.5
    rod = planar.Body("rod", mass=1.3, inertia=1.3 * half**2 / 3, position=(beyond, 0.0))
    edge = mb.RigidPlaneContact("edge", "rod", "ground", point_a=(0.0, 0.0), point_b=(0.0, 0.0), normal=(0.0, -1.0))
    rub = mb.DryFriction("rub", "edge", coefficient=coefficient)
    system = mb.Scene([rod], joints=[edge], forces=[DOWN, rub]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=0.5, saveat=diffrax.SaveAt(dense=True), rtol=1e-11)
    slips, leaves = motion.events
    assert (slips.kind, leaves.kind) == ("slip", "open")

    # Until it slips it turns about the edge, with the acceleration `g b cos θ / (k² + b²)`.
    k2 = half**2 / 3
    at = np.arctan(coefficient * half**2 / (half**2 + 9 * beyond**2))
    np.testing.assert_allclose(-motion.at(slips.time).q[2], at, rtol=1e-9)
    # With `θ = x²` the integrand has no singularity.
    ratio = lambda x: x * x / np.sin(x * x) if x > 0 else 1.0
    time, _ = quad(lambda x: 2 * np.sqrt(ratio(x)), 0.0, np.sqrt(at), epsabs=1e-13)
    np.testing.assert_allclose(slips.time, time * np.sqrt((k2 + beyond**2) / (2 * G * beyond)), rtol=1e-9)

    def slide(t, y):
        out, angle, speed, rate = y
        normal = force(y)
        along = G * np.sin(angle) + out * rate**2 - coefficient * normal
        return speed, rate, along, normal * out / k2

    def force(y):
        out, angle, speed, rate = y
        return (G * np.cos(angle) - 2 * speed * rate) * k2 / (k2 + out**2)

    leave = lambda t, y: force(y)
    leave.terminal = True
    start = beyond, at, 0.0, np.sqrt(2 * G * beyond * np.sin(at) / (k2 + beyond**2))
    known = solve_ivp(slide, (slips.time, 0.5), start, events=leave, method="DOP853", rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(leaves.time, known.t_events[0][0], rtol=1e-9)
    np.testing.assert_allclose(-motion.at(leaves.time).q[2], known.y_events[0][0, 1], rtol=1e-9)


def falling_chain():
    """A double pendulum whose end meets the floor with much friction: Kane's and Levinson's example."""
    links = [
        planar.Body(name, mass=1.0, inertia=0.03, position=(x, 0.7)) for name, x in (("upper", 0.3), ("lower", 0.9))
    ]
    joints = [
        planar.Revolute("hip", "ground", "upper", point=(0.0, 0.7)),
        planar.Revolute("knee", "upper", "lower", point=(0.6, 0.7)),
        mb.RigidContact("floor", "lower", terrain=terrain.Flat(), centre=(0.3, 0.0), restitution=0.9),
    ]
    rub = mb.DryFriction("rub", "floor", coefficient=0.5)
    return mb.Scene(links, joints=joints, forces=[DOWN, rub]).compile()


@pytest.mark.slow
def test_an_impact_gives_no_energy_back():
    """Where the whole rebound would, it is less, and the derivative of the state after it is that of this rule."""
    system = falling_chain()
    state = mb.assemble(system, rates={"upper.angle": -1.5, "lower.angle": -3.0})
    motion = mb.simulate(system, state, t1=0.5, rtol=1e-9)
    floor, rub = list(motion.events)[:2]
    assert (floor.kind, rub.kind) == ("impact", "impact") and abs(floor.kinetic_energy_lost) < 1e-8
    found = motion.found_events
    t, flat, nq = found.times[0], found.states[0], system.nq
    q, u = flat[:nq], flat[nq : nq + system.nu]

    @jax.jit
    def after(p, step):
        own = mb.with_parameters(system, p)
        tolerance, y = ContactTolerance(found.touch), mb.State(q, u * (1 + step))
        return impact(own, motion.formulation, tolerance, t, y).after.u

    given = {name: mb.parameters(system)[name] for name in ("lower.mass", "rub.coefficient", "floor.restitution")}
    u_after = after(given, 0.0)
    rate = lambda u: system.contacts.rates(system, t, q, u)[0]
    # Less than the whole rebound, of which the energy would be more than before.
    assert 0 < rate(u_after) < 0.9 * -rate(u) * (1 - 1e-3)
    for name in given:
        along = {key: jnp.asarray(1.0 if key == name else 0.0) for key in given}
        slope = jax.jvp(lambda p: after(p, 0.0), (given,), (along,))[1]
        h = 1e-6
        ahead, back = (after(given | {name: given[name] + s * h}, 0.0) for s in (1, -1))
        np.testing.assert_allclose(slope, (ahead - back) / (2 * h), atol=1e-6 * np.max(np.abs(u_after)), err_msg=name)
    slope = jax.jvp(lambda step: after(given, step), (0.0,), (1.0,))[1]
    difference = (after(given, 1e-6) - after(given, -1e-6)) / 2e-6
    np.testing.assert_allclose(slope, difference, atol=1e-6 * np.max(np.abs(u_after)))


@pytest.mark.slow
def test_the_time_of_release_has_a_derivative_in_a_contact():
    """Of a disc that rolls until the force on it is too large for stick, also where a closed contact has a rounding
    error for a rate.
    """
    push = lambda x, v, t, p: jnp.stack([p["rate"] * t, 0 * t, 0 * t])[None]
    body = planar.Body("disc", mass=1.5, inertia=0.5 * 1.5 * RADIUS**2, position=(0.0, RADIUS))
    floor = mb.RigidContact("floor", "disc", terrain=terrain.Flat(), radius=RADIUS)
    rub = mb.DryFriction("rub", "floor", coefficient=0.2, static_coefficient=0.3)
    forces = [DOWN, rub, mb.Force("push", ["disc"], push, parameters={"rate": 10.0})]
    system = mb.Scene([body], joints=[floor], forces=forces).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=2.0, rtol=1e-10)
    (event,) = motion.events
    # Stick takes a third of the force.
    np.testing.assert_allclose(event.time, 3 * 0.3 * 1.5 * G / 10.0, rtol=1e-9)
    found = motion.found_events
    t, q, u = found.times[0], found.states[0][: system.nq], found.states[0][system.nq :]
    # Velocities before and after differ by their accelerations times the time by which it is later.
    later = 3 * 1.5 * G / 10.0
    slower = (0.3 - 0.2) * G
    for rounding in (0.0, -1e-16, 1e-16, -1e-14):

        def after(limit, rounding=rounding):
            own = mb.with_parameters(system, {"rub.static_coefficient": limit})
            tolerance, y = ContactTolerance(found.touch), mb.State(q, u.at[1].add(rounding))
            return impact(own, motion.formulation, tolerance, t, y).after.u[0]

        slope = jax.jvp(after, (jnp.asarray(0.3),), (jnp.asarray(1.0),))[1]
        np.testing.assert_allclose(slope, -slower * later, rtol=1e-7)
