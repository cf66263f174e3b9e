"""Impacts, contacts that close and open, against closed forms: times, heights, forces, energies, derivatives."""

import dataclasses
import importlib
import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from compiling import jit_quickly
from derivative_checks import central_differences, in_both_modes
from scipy.optimize import brentq

import jaxmb as mb
from jaxmb import manifold, planar, spatial, terrain
from jaxmb.manifold import Projection
from jaxmb.solvers import Hermite, restarts

G = 9.81


def ball(restitution, lower=0.0, **options):
    return mb.Scene(
        [planar.Body("ball", mass=2.0, inertia=0.1, position=(0.0, 1.0))],
        joints=[
            planar.Prismatic("slide", "ground", "ball", axis=(0.0, 1.0), point_a=(0.0, 0.0), point_b=(0.0, 0.0)),
            mb.Stop("floor", "slide.displacement", lower=lower, restitution=restitution, **options),
        ],
        forces=[mb.Gravity((0.0, -G))],
    ).compile()


BALL = ball(0.5)
FALL = np.sqrt(2 / G)


@pytest.mark.slow
def test_a_time_that_is_too_coarse_for_contacts_is_named():
    """Seconds since 1970: the next number is a quarter of a microsecond away."""
    with pytest.raises(RuntimeError, match=r"numbers next to t = 1.7e\+09 are 2.4e-07 s away.*begin at zero"):
        mb.simulate(BALL, mb.assemble(BALL), t0=1.7e9, t1=1.7e9 + 1)


def test_bouncing_ball_comes_to_rest():
    """Twenty impacts, and the sum of all that follow."""
    saveat = diffrax.SaveAt(ts=np.array([0.4, 1.0, 1.5, 2.0]), dense=True)
    motion = mb.simulate(BALL, mb.assemble(BALL), t1=2.0, saveat=saveat, rtol=1e-12)
    events = list(motion.events)
    impacts = [event for event in events if event.kind != "rest"]
    k = np.arange(len(impacts))
    assert len(impacts) >= 18
    times = FALL * (1 + 2 * np.cumsum(np.append(0.0, 0.5 ** k[1:])))
    np.testing.assert_allclose([event.time for event in impacts], times, atol=1e-9)
    # The last one closes the contact without a rebound.
    size = np.append(np.full(len(k) - 1, 1.5), 1.0)
    np.testing.assert_allclose([event.impulse for event in impacts], 2 * size * G * FALL * 0.5**k, atol=1e-8)
    heights = [motion.at(t).q[1] for t in (times[1:] + times[:-1]) / 2]
    np.testing.assert_allclose(heights, 0.25 ** k[1:], atol=1e-12)
    np.testing.assert_allclose(sum(event.kinetic_energy_lost for event in impacts), 2 * G, rtol=1e-9)
    assert [event.kind for event in events[-2:]] == ["close", "rest"]
    np.testing.assert_allclose(events[-1].time, 3 * FALL, atol=2e-8)
    s = 1.0 - 2 * FALL
    np.testing.assert_allclose(
        motion["ball"].position[:, 1], [1 - G * 0.4**2 / 2, 0.25 * G * FALL * s - G * s * s / 2, 0.0, 0.0], atol=1e-9
    )
    np.testing.assert_allclose(motion.reactions["floor"].force[-1], [0.0, 2 * G], atol=1e-9)
    assert motion.stats["num_events"] == len(impacts)
    assert "impact" in str(motion.events)


def height(t, restitution, lower, impacts):
    """Of the ball after a number of impacts."""
    time, speed = jnp.sqrt(2 * (1 - lower) / G), jnp.sqrt(2 * G * (1 - lower))
    for k in range(impacts):
        speed = restitution * speed
        time = time + (2 * speed / G if k + 1 < impacts else 0.0)
    return lower + speed * (t - time) - G * (t - time) ** 2 / 2


def end(values, t1, **options):
    system = mb.with_parameters(BALL, {"floor.restitution": values[0], "floor.lower": values[1]})
    # A run of few steps, of which all are kept, compiles faster.
    motion = mb.simulate(system, mb.assemble(BALL), t1=t1, rtol=1e-9, max_steps=300, max_events=16, **options)
    return motion["ball"].position[-1, 1]


def test_derivatives_through_impacts():
    at, t1 = jnp.array([0.8, 0.1]), jnp.array(1.9)
    exact = lambda values, t1: height(t1, *values, 3)
    reverse = jit_quickly(jax.value_and_grad(end, argnums=(0, 1)))
    value, derivatives = reverse(at, t1)
    np.testing.assert_allclose(value, exact(at, t1), atol=1e-9)
    for got, known in zip(derivatives, jax.grad(exact, argnums=(0, 1))(at, t1), strict=True):
        np.testing.assert_allclose(got, known, rtol=1e-7)


@pytest.mark.slow
def test_the_saltation_matrix_of_an_impact():
    """How height and speed after an impact change with those at the start, by the formula for a hybrid system.

    Source: R. I. Leine and H. Nijmeijer, "Dynamics and Bifurcations of Non-Smooth Mechanical Systems", Springer, 2004.
    """
    start, e, t1 = mb.assemble(BALL), 0.5, 0.7

    def end(at):
        state = dataclasses.replace(start, q=start.q.at[1].set(at[0]), u=start.u.at[1].set(at[1]))
        last = mb.simulate(BALL, state, t1=t1, rtol=1e-12, max_steps=300, max_events=4).ys
        return jnp.stack([last.q[-1, 1], last.u[-1, 1]])

    at = jnp.array([1.0, -0.4])
    before = -np.sqrt(0.4**2 + 2 * G)
    impact = (-0.4 - before) / G
    flow = lambda t: np.array([[1.0, t], [0.0, 1.0]])
    # The jump, and the times by which fields before and after it act longer or shorter.
    field = lambda v: np.array([v, -G])
    reset = np.diag([1.0, -e])
    saltation = reset + np.outer(field(-e * before) - reset @ field(before), [1.0, 0.0]) / before
    exact = flow(t1 - impact) @ saltation @ flow(impact)
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jit_quickly(mode(end))(at), exact, rtol=1e-9)


@pytest.mark.slow
def test_forward_mode_is_reverse_mode_through_impacts():
    at = jnp.array([0.7, 0.05])
    forward, reverse = (jit_quickly(mode(lambda at: end(at, 2.0)))(at) for mode in (jax.jacfwd, jax.grad))
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)


def particle_on_a_sphere(x, y):
    """Of radius 1, or above it, without friction."""
    return mb.Scene(
        [planar.PointMass("p", mass=0.7, position=(x, y))],
        joints=[mb.RigidBallContact("sphere", "ground", "p", radius_a=1.0, radius_b=0.0)],
        forces=[mb.Gravity((0.0, -G))],
    ).compile()


@pytest.mark.slow
def test_derivatives_through_closing_sliding_and_opening():
    """A particle falls on a sphere, slides down and leaves it: both modes, and differences of a tighter solution."""
    system = particle_on_a_sphere(0.3, 1.3)
    start = mb.assemble(system)

    def run(at, rtol=1e-10):
        changed = mb.with_parameters(system, {"sphere.radius_a": at[0]})
        state = dataclasses.replace(start, q=start.q.at[0].set(at[1]))
        motion = mb.simulate(changed, state, t1=0.9, rtol=rtol, max_steps=400, max_events=16)
        return motion.ys.q[-1, 0] + 2 * motion.ys.q[-1, 1]

    at, h = jnp.array([1.0, 0.3]), 1e-4
    reverse, forward = (jit_quickly(mode(run))(at) for mode in (jax.grad, jax.jacfwd))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    value = jit_quickly(lambda at: run(at, 1e-12))
    for k, step in enumerate(h * jnp.eye(2)):
        near, far = (value(at + m * step) - value(at - m * step) for m in (1, 2))
        np.testing.assert_allclose(reverse[k], (8 * near - far) / (12 * h), rtol=1e-6)


@pytest.mark.slow
def test_events_have_derivatives():
    """Times, impulses and energies lost, in both modes, against closed forms."""

    def events(at):
        system = mb.with_parameters(BALL, {"floor.restitution": at[0], "floor.lower": at[1]})
        found = mb.simulate(system, mb.assemble(BALL), t1=2.0, rtol=1e-9, max_steps=300, max_events=16).events
        return found.times[:3], found.impulses[:3, 0], found.kinetic_energy_lost[:3]

    def exact(at):
        speed, time, out = jnp.sqrt(2 * G * (1 - at[1])), jnp.sqrt(2 * (1 - at[1]) / G), []
        for _ in range(3):
            out.append((time, 2.0 * (1 + at[0]) * speed, speed**2 * (1 - at[0] ** 2)))
            speed = at[0] * speed
            time = time + 2 * speed / G
        return jax.tree.map(lambda *x: jnp.stack(x), *out)

    at = jnp.array([0.8, 0.1])
    forward, reverse = (jit_quickly(mode(events))(at) for mode in (jax.jacfwd, jax.jacrev))
    for one, other, known in zip(forward, reverse, jax.jacfwd(exact)(at), strict=True):
        np.testing.assert_allclose(one, known, rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14)


@pytest.mark.slow
def test_a_member_without_events_has_finite_derivatives_of_them():
    """In space, where zeros are no attitude; one member of the batch meets the floor, the other does not."""
    system = mb.Scene(
        [spatial.Body("ball", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(0.0, 0.0, 1.0))],
        joints=[mb.RigidContact("floor", "ball", terrain=mb.terrain.Flat(), restitution=0.8)],
        forces=[mb.Gravity((0.0, 0.0, -G))],
    ).compile()
    state = mb.assemble(system)

    def first(height):
        start = mb.State(state.q.at[2].set(height), state.u)
        times = mb.simulate(system, start, t1=0.6, rtol=1e-9, max_steps=200, max_events=8).events.times
        return jnp.where(jnp.isfinite(times[0]), times[0], 0.0)

    times, slopes = jit_quickly(jax.vmap(jax.value_and_grad(first)))(jnp.array([1.0, 5.0]))
    fall = np.sqrt(2 / G)
    np.testing.assert_allclose(times, [fall, 0.0], rtol=1e-9)
    np.testing.assert_allclose(slopes, [fall / 2, 0.0], rtol=1e-7)


@pytest.mark.slow
def test_the_time_of_opening_has_a_derivative():
    """A particle that slides down a sphere from rest leaves it at a time with constant `t² g`."""
    system = particle_on_a_sphere(0.6, 0.8)

    def opens(strength):
        changed = mb.with_parameters(system, {"gravity.acceleration": jnp.stack([0.0 * strength, -strength])})
        return mb.simulate(changed, mb.assemble(system), t1=1.0, rtol=1e-9, max_steps=300, max_events=8).events.times[0]

    time, slope = jit_quickly(lambda x: jax.jvp(opens, (x,), (jnp.ones_like(x),)))(jnp.array(G))
    np.testing.assert_allclose(slope, -time / (2 * G), rtol=1e-7)


@pytest.mark.slow
def test_the_time_of_opening_where_forces_balance():
    """A particle on a floor that is pushed upwards by more and more leaves it when nothing acts on it altogether."""
    system = mb.Scene(
        [planar.PointMass("ball", mass=1.0, position=(0.0, 0.0))],
        joints=[mb.RigidContact("floor", "ball", terrain=terrain.Flat())],
        forces=[mb.Gravity((0.0, -10.0)), planar.PointForce("push", "ball", force=(0.0, 0.0))],
    ).compile()
    state = mb.assemble(system)

    def opens(time):
        push = {"push.force": lambda t: jnp.stack([0.0 * t, 10.0 * t / time])}
        motion = mb.simulate(system, state, t1=2.0, inputs=push, rtol=1e-9, max_steps=300, max_events=8)
        return motion.events.times[0]

    found = jit_quickly(lambda x: jax.jvp(opens, (x,), (jnp.ones_like(x),)))(jnp.array(1.0))
    np.testing.assert_allclose(found, [1.0, 1.0], rtol=1e-8)


@pytest.mark.slow
def test_the_time_of_a_jump_beside_a_contact():
    """Neither the start of the run nor an impact is a jump: the ball bounces, and a pull sets in later."""
    system = mb.Scene(
        [planar.PointMass("ball", mass=1.0, position=(0.0, 0.2))],
        joints=[mb.RigidContact("floor", "ball", terrain=terrain.Flat(), restitution=0.5)],
        forces=[mb.Gravity((0.0, -10.0)), planar.PointForce("pull", "ball", force=(0.0, 0.0))],
    ).compile()
    state = mb.assemble(system)

    def height(time):
        pull = {"pull.force": lambda t: jnp.where(t < time, 0.0, 1.0) * jnp.array([0.0, 4.0])}
        motion = mb.simulate(system, state, t1=0.38, inputs=pull, jumps=time[None], rtol=1e-10, max_events=8)
        return motion["ball"].position[-1, 1]

    # The impact is at 0.2 s, with 1 m/s after it.
    found, slope = jit_quickly(jax.value_and_grad(height))(jnp.array(0.3))
    np.testing.assert_allclose(found, 0.18 - 5.0 * 0.18**2 + 2.0 * 0.08**2, rtol=1e-9)
    np.testing.assert_allclose(slope, -4.0 * 0.08, rtol=1e-8)


@pytest.mark.slow
def test_derivatives_by_known_jumps_beside_a_stop():
    """A pull sets in while a ball falls onto a stop, and ends after the impact: by its size and both times."""
    system = mb.Scene(
        [planar.Body("ball", mass=2.0, inertia=0.1, position=(0.0, 0.2))],
        joints=[
            planar.Prismatic("slide", "ground", "ball", axis=(0.0, 1.0), point_a=(0.0, 0.0), point_b=(0.0, 0.0)),
            mb.Stop("floor", "slide.displacement", lower=0.0, restitution=0.5),
        ],
        forces=[mb.Gravity((0.0, -10.0)), mb.JointForce("pull", "slide.displacement", force=0.0)],
    ).compile()
    state = mb.assemble(system)

    def end(x):
        pull = {"pull.force": lambda t: jnp.where((t < x[1]) | (t >= x[2]), 0.0, x[0])}
        changed = mb.with_parameters(system, {"floor.restitution": x[3]})
        motion = mb.simulate(changed, state, t1=0.4, inputs=pull, jumps=x[1:3], rtol=1e-10, max_steps=400, max_events=8)
        own = motion["ball"]
        return jnp.concatenate([own.position[-1, 1:], own.velocity[-1, 1:], motion.events.times[:1]])

    def exact(x):
        less = 10.0 - x[0] / 2.0
        y, v = 0.2 - 5.0 * x[1] ** 2, -10.0 * x[1]
        falls = (v + jnp.sqrt(v**2 + 2 * less * y)) / less
        v, back = x[3] * (less * falls - v), x[2] - x[1] - falls
        y, v, left = v * back - less / 2 * back**2, v - less * back, 0.4 - x[2]
        return jnp.stack([y + v * left - 5.0 * left**2, v - 10.0 * left, x[1] + falls])

    at = jnp.array([8.0, 0.1, 0.3, 0.5])
    value, derivative = in_both_modes(end, at)
    np.testing.assert_allclose(value, exact(at), rtol=0, atol=1e-9)
    np.testing.assert_allclose(derivative, jax.jacfwd(exact)(at), rtol=0, atol=1e-7)


@pytest.mark.slow
def test_a_ball_on_a_floor_that_vibrates():
    """It lands without a rebound, rides, and lifts off where the floor falls as gravity does."""
    system = mb.Scene(
        [planar.PointMass("ball", mass=1.3, position=(0.0, 0.25))],
        joints=[mb.RigidContact("floor", "ball", terrain=terrain.Flat())],
        forces=[mb.Gravity((0.0, -G))],
    ).compile()
    start = mb.assemble(system)

    def end(x):
        amplitude, frequency, gravity = x
        wave = {"floor.terrain.level": lambda t: amplitude * jnp.sin(frequency * t)}
        changed = mb.with_parameters(system, {"gravity.acceleration": jnp.stack([0.0 * gravity, -gravity])})
        motion = mb.simulate(changed, start, t1=0.5, inputs=wave, rtol=1e-10, max_steps=400, max_events=8)
        events = motion.events
        return jnp.concatenate([motion.ys.q[-1, 1:2], motion.ys.u[-1, 1:2], events.times[:2], events.impulses[:1, 0]])

    def exact(x):
        amplitude, frequency, gravity = x
        gap = lambda t: 0.25 - gravity / 2 * t**2 - amplitude * np.sin(frequency * t)
        lands = brentq(gap, 0.2, 0.27, xtol=1e-15, rtol=1e-14)
        leaves = (2 * np.pi + np.arcsin(gravity / (amplitude * frequency**2))) / frequency
        impulse = 1.3 * (amplitude * frequency * np.cos(frequency * lands) + gravity * lands)
        v, left = amplitude * frequency * np.cos(frequency * leaves), 0.5 - leaves
        y = amplitude * np.sin(frequency * leaves) + v * left - gravity / 2 * left**2
        return np.array([y, v - gravity * left, lands, leaves, impulse])

    at = jnp.array([0.05, 18.0, G])
    value, derivative = in_both_modes(end, at)
    np.testing.assert_allclose(value, exact(at), rtol=1e-8)
    np.testing.assert_allclose(derivative, central_differences(exact, at), rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_derivatives_of_a_particle_that_slides_on_a_slope_that_rises():
    """Dry friction on it is that under a gravity which is larger by the acceleration of the ground."""
    gradient = 0.6
    system = mb.Scene(
        [planar.PointMass("p", mass=1.3, position=(0.0, 0.0))],
        joints=[mb.RigidContact("floor", "p", terrain=terrain.Slope(-gradient))],
        forces=[mb.Gravity((0.0, -G)), mb.DryFriction("rub", "floor", coefficient=0.3)],
    ).compile()
    start = mb.assemble(system, fix={"floor.mode": 1})

    def end(x):
        amplitude, frequency, coefficient = x
        wave = {"floor.terrain.level": lambda t: amplitude * (1 - jnp.cos(frequency * t))}
        changed = mb.with_parameters(system, {"rub.coefficient": coefficient})
        motion = mb.simulate(changed, start, t1=0.5, inputs=wave, rtol=1e-10, max_steps=400, max_events=8)
        return jnp.concatenate([motion.ys.q[-1, :2], motion.ys.u[-1, :2]])

    def exact(x):
        amplitude, frequency, coefficient = x
        level = lambda t: amplitude * (1 - jnp.cos(frequency * t))
        height, rate = jax.jvp(level, (0.5,), (1.0,))
        cos, sin = np.array([1.0, gradient]) / np.hypot(1.0, gradient)
        share = sin - coefficient * cos
        way, speed = share * (G * 0.5**2 / 2 + height), share * (G * 0.5 + rate)
        return jnp.stack([way * cos, height - way * sin, speed * cos, rate - speed * sin])

    at = jnp.array([0.02, 9.0, 0.3])
    value, derivative = in_both_modes(end, at)
    np.testing.assert_allclose(value, exact(at), rtol=0, atol=1e-8)
    np.testing.assert_allclose(derivative, jax.jacfwd(exact)(at), rtol=0, atol=1e-7)


@pytest.mark.slow
def test_derivatives_of_a_block_between_stops_that_move():
    """Each impact is with the stop as fast as it moves; members of a batch as one run."""
    block = planar.Body("block", mass=2.0, inertia=0.1, velocity=(1.5, 0.0))
    rail = planar.Prismatic("rail", "ground", "block", point=(0.0, 0.0), axis=(1.0, 0.0))
    stops = mb.Stop("stops", "rail.displacement", lower=-0.2, upper=0.3, restitution=0.6)
    system = mb.Scene([block], joints=[rail, stops]).compile()
    start = mb.assemble(system)

    def end(x):
        amplitude, frequency, restitution = x
        wave = lambda t: amplitude * jnp.sin(frequency * t)
        inputs = {"stops.lower": lambda t: -0.2 + wave(t), "stops.upper": lambda t: 0.3 - 0.5 * wave(t)}
        changed = mb.with_parameters(system, {"stops.restitution": restitution})
        motion = mb.simulate(changed, start, t1=0.8, inputs=inputs, rtol=1e-10, max_steps=400, max_events=8)
        events = motion.events
        return jnp.concatenate([motion.ys.q[-1, :1], motion.ys.u[-1, :1], events.times[:2], events.impulses[:2, 0]])

    def exact(x):
        amplitude, frequency, restitution = x
        wave = lambda t: (amplitude * np.sin(frequency * t), amplitude * frequency * np.cos(frequency * t))
        gap = lambda t, start, speed, middle, share: middle + share * wave(t)[0] - start - speed * t
        time, place, speed, found = 0.0, 0.0, 1.5, []
        for middle, share in ((0.3, -0.5), (-0.2, 1.0)):
            own = place - speed * time, speed, middle, share
            fine = np.linspace(time + 1e-6, 0.8, 1000)
            first = np.flatnonzero(np.diff(np.sign(gap(fine, *own))))[0]
            hit = brentq(gap, fine[first], fine[first + 1], own, xtol=1e-15, rtol=1e-14)
            rate = share * wave(hit)[1]
            after = rate - restitution * (speed - rate)
            found.append((hit, 2.0 * abs(after - speed)))
            time, place, speed = hit, middle + share * wave(hit)[0], after
        left = 0.8 - time
        return np.array([place + speed * left, speed, found[0][0], found[1][0], found[0][1], found[1][1]])

    many = jnp.array([[0.04, 6.0, 0.6], [0.02, 11.0, 0.8]])
    values, derivatives = in_both_modes(end, many[0], many)
    for at, value, derivative in zip(many, values, derivatives, strict=True):
        np.testing.assert_allclose(value, exact(at), rtol=1e-8)
        np.testing.assert_allclose(derivative, central_differences(exact, at), rtol=1e-6, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, diffrax.Dopri8()], ids=["Adams", "Dopri8"])
def test_a_ball_among_pegs(solver):
    """In one step it comes near to several of them; the one that it hits need not be the nearest at the end."""
    pegs = [(0.3 * (k - row / 2), -0.3 * row) for row in range(4) for k in range(row + 1)]
    contacts = [
        mb.RigidBallContact(f"peg{k}", "ground", "ball", radius_a=0.05, radius_b=0.05, point_a=at, restitution=0.6)
        for k, at in enumerate(pegs)
    ]
    ball = planar.PointMass("ball", mass=1.0, position=(0.0, 0.6))
    system = mb.Scene([ball], joints=contacts, forces=[mb.Gravity((0.0, -G))]).compile()
    start = mb.assemble(system)
    # From the roots of the distances, which are polynomials of degree four of the time.
    cases = {
        (-0.07344423617020886, -0.2900834186828825): (1, (-1.7390333603, -1.2669948206)),
        (0.00697999863446766, 0.2610434542726609): (2, (1.9465855, -1.4138574)),
    }
    for (x, v), (number, last) in cases.items():
        state = dataclasses.replace(start, q=start.q.at[0].set(x), u=start.u.at[0].set(v))
        motion = mb.simulate(system, state, t1=1.0, rtol=1e-10, solver=solver)
        assert len(motion.events) == number
        np.testing.assert_allclose(motion["ball"].position[-1], last, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver", [None, pytest.param(diffrax.Dopri8(), marks=pytest.mark.slow)], ids=["Adams", "Dopri8"]
)
def test_the_first_peg_that_random_flights_meet(solver):
    """Steps are long, and gaps close and open again within them, also after they rose at the start."""
    pegs = np.array([(0.3 * (k - row / 2), -0.3 * row) for row in range(4) for k in range(row + 1)])
    contacts = [
        mb.RigidBallContact(f"peg{k}", "ground", "ball", radius_a=0.05, radius_b=0.05, point_a=at, restitution=0.6)
        for k, at in enumerate(pegs)
    ]
    ball = planar.PointMass("ball", mass=1.0, position=(0.0, 0.6))
    system = mb.Scene([ball], joints=contacts, forces=[mb.Gravity((0.0, -G))]).compile()
    start = mb.assemble(system)

    @jax.jit
    def first(x, v, rtol):
        state = dataclasses.replace(start, q=start.q.at[0].set(x), u=start.u.at[0].set(v))
        motion = mb.simulate(system, state, t1=0.9, rtol=rtol, solver=solver, max_events=16, throw=False)
        return motion.events.times[0]

    def meets(x, v):
        """When it first comes to the distance of a peg, by the roots of a polynomial."""
        found = []
        for a, b in pegs:
            across, down = np.poly1d([v, x - a]), np.poly1d([-G / 2, 0.0, 0.6 - b])
            found += [t.real for t in (across**2 + down**2 - 0.01).roots if abs(t.imag) < 1e-6 and 0 < t.real < 0.9]
        return min(found, default=np.inf)

    rng = np.random.default_rng(0)
    for x, v in zip(rng.uniform(-0.3, 0.3, 60), rng.uniform(-0.5, 0.5, 60), strict=True):
        for rtol in (1e-3, 1e-6, 1e-10):
            np.testing.assert_allclose(
                first(x, v, rtol), meets(x, v), rtol=1e-6 + 10 * rtol, err_msg=f"{x}, {v}, {rtol}"
            )


@pytest.mark.slow
def test_tangents_after_impacts_by_a_matrix_and_one_at_a_time(monkeypatch):
    state = mb.assemble(BALL)

    def end(gravity):
        own = mb.with_parameters(BALL, {"gravity.acceleration": gravity})
        motion = mb.simulate(own, state, t1=0.8, rtol=1e-9, max_steps=300, max_events=8)
        return jnp.append(motion.ys.q[-1], motion.events.times[0])

    at = mb.parameters(BALL)["gravity.acceleration"]
    found = {}
    for most in (256, 0):
        monkeypatch.setattr(restarts, "_MOST_COLUMNS", most)
        jax.clear_caches()
        found[most] = jit_quickly(jax.jacfwd(end))(at), jit_quickly(jax.jacrev(end))(at)
    (forward, reverse), others = found[256], found[0]
    assert np.max(np.abs(forward)) > 0.01
    for other in (reverse, *others):
        np.testing.assert_allclose(other, forward, rtol=1e-10, atol=1e-13)


@pytest.mark.slow
def test_events_are_found_once_in_a_program():
    """Derivatives have them from the motion."""
    found = lambda function: str(jax.make_jaxpr(function)(jnp.array([0.8, 0.1]))).count("name=find_event")
    value = lambda at: end(at, 0.6)
    assert found(value) == found(jax.grad(value)) == found(jax.jacfwd(value)) == 1


@pytest.mark.slow
def test_a_stop_that_vibrates():
    """Nothing of the motion towards it asks for short steps."""
    body = planar.Body("body", mass=2.0, inertia=0.1, velocity=(1.0, 0.0))
    slide = planar.Prismatic("slide", "ground", "body", point=(0.0, 0.0), axis=(1.0, 0.0))
    stop = mb.Stop("stop", "slide.displacement", upper=2.0, restitution=0.5)
    system = mb.Scene([body], joints=[slide, stop]).compile()
    place = lambda t: 2.0 + 0.2 * np.sin(20.0 * t)
    # The motion up to there is uniform.
    fine = np.linspace(1.5, 2.5, 100_001)
    first = fine[np.argmax(fine > place(fine))]
    inputs = {"stop.upper": lambda t: 2.0 + 0.2 * jnp.sin(20.0 * t)}
    motion = mb.simulate(system, mb.assemble(system), t1=2.1, inputs=inputs)
    np.testing.assert_allclose(motion.events.times[0], first, atol=1e-5)


@pytest.mark.slow
def test_a_particle_at_rest_lifts_off_when_it_is_pulled():
    """Where everything rests no error estimate asks for short steps, and the pull is over at the end of a long one."""
    system = mb.Scene(
        [planar.PointMass("ball", mass=1.0, position=(0.0, 0.0))],
        joints=[mb.RigidContact("floor", "ball", terrain=terrain.Flat(), restitution=0.5)],
        forces=[mb.Gravity((0.0, -10.0)), planar.PointForce("pull", "ball", force=(0.0, 0.0))],
    ).compile()
    inputs = {"pull.force": lambda t: jnp.stack([0.0 * t, 15.0 * jnp.sin(2 * jnp.pi * t)])}
    motion = mb.simulate(system, mb.assemble(system), t1=1.0, inputs=inputs)
    np.testing.assert_allclose(motion.events.times[0], np.arcsin(2 / 3) / (2 * np.pi), rtol=1e-8)


def lifted(place=0.2, level=0.0, space=planar):
    """A ball of 2 kg at rest on level ground, with its centre at this height, and a force on it."""
    up = (0.0, 1.0) if space is planar else (0.0, 0.0, 1.0)
    along = lambda size: tuple(size * x for x in up)
    inertia = 0.1 if space is planar else (0.1, 0.1, 0.1)
    floor = mb.RigidContact("floor", "ball", terrain=terrain.Flat(level), radius=place - level)
    forces = [mb.Gravity(along(-G)), space.PointForce("lift", "ball", force=along(0.0))]
    ball = space.Body("ball", mass=2.0, inertia=inertia, position=along(place))
    return mb.Scene([ball], joints=[floor], forces=forces).compile()


def risen(force, duration):
    """The height after a lift from rest, of a ball of 2 kg."""
    return 0.5 * jnp.maximum(force / 2 - G, 0.0) * duration**2


LIFTED = lifted()


def test_a_ball_that_is_lifted_from_the_start():
    """The error of the first step is larger than the height that it reaches."""
    forces = jnp.array([0.0, 19.0, 19.621, 30.0, 1000.0])

    def end(force, rtol):
        system = mb.with_parameters(LIFTED, {"lift.force": jnp.stack([0.0, force])})
        state = mb.State(LIFTED.guess.q, jnp.zeros(LIFTED.nu))
        return mb.simulate(system, state, t1=0.3, rtol=rtol, max_steps=200, max_events=2)["ball"].position[-1, 1]

    run = jit_quickly(jax.vmap(jax.value_and_grad(end), in_axes=(0, None)))
    heights, slopes = run(forces, 1e-8)
    np.testing.assert_allclose(heights, 0.2 + risen(forces, 0.3), atol=1e-8)
    np.testing.assert_allclose(slopes, jnp.where(forces > 2 * G, 0.25 * 0.09, 0.0), atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, Hermite(), diffrax.Tsit5()], ids=str)
@pytest.mark.parametrize("closed", [True, False])
def test_a_lift_from_closed_and_open_contacts(solver, closed):
    system = mb.with_parameters(LIFTED, {"lift.force": (0.0, 30.0)})
    state = mb.assemble(system, fix={"floor.mode": 1} if closed else {})
    motion = mb.simulate(system, state, t1=0.3, solver=solver, max_steps=3000)
    np.testing.assert_allclose(motion["ball"].position[-1, 1], 0.2 + risen(30.0, 0.3), atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("place", [1e-3, 7.0, 1e3, 1e6])
@pytest.mark.parametrize("space", [planar, spatial], ids=["planar", "spatial"])
@pytest.mark.parametrize("on_a_level", [False, True])
def test_lifts_at_all_places(place, space, on_a_level):
    """Errors of integration scale with the place, and rounding errors of the gap as well."""
    system = lifted(place + 0.5 * on_a_level, place if on_a_level else 0.0, space)
    up = 2 if space is spatial else 1
    for force in (19.7, 30.0, 1000.0):
        forced = mb.with_parameters(system, {"lift.force": (0.0,) * up + (force,)})
        motion = mb.simulate(forced, mb.assemble(forced), t1=0.3, max_steps=1000)
        height = motion["ball"].position[-1, up] - system.guess.q[up]
        np.testing.assert_allclose(height, risen(force, 0.3), atol=1e-8 * max(place, 1.0))


@pytest.mark.slow
def test_a_lift_after_an_event():
    """The ball falls on the ground without a rebound, rests, and is lifted by a force that jumps."""
    system = mb.Scene(
        [planar.Body("ball", mass=2.0, inertia=0.1, position=(0.0, 1.2))],
        joints=[mb.RigidContact("floor", "ball", terrain=terrain.Flat(), radius=0.2)],
        forces=[
            mb.Gravity((0.0, -G)),
            mb.Force("lift", "ball", lambda x, v, t, p: jnp.array([0.0, 30.0 * (t > 1), 0])),
        ],
    ).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=1.3, jumps=[1.0])
    np.testing.assert_allclose(motion["ball"].position[-1, 1], 0.2 + risen(30.0, 0.3), atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("place", [1e-3, 0.7, 123.4, 1e6])
def test_stops_and_ropes_that_open_at_the_start(place):
    """A slide is pulled off its stop, and a ball up to the point from which it hangs."""
    body = planar.Body("body", mass=2.0, inertia=0.1, position=(place, 0.0))
    slide = planar.Prismatic("slide", "ground", "body", point=(0.0, 0.0), axis=(1.0, 0.0))
    stop = mb.Stop("stop", "slide.displacement", lower=0.0)
    push = planar.PointForce("push", "body", force=(3.0, 0.0))
    system = mb.Scene([body], joints=[slide, stop], forces=[push]).compile()
    moved = mb.simulate(system, mb.assemble(system), t1=0.3, max_steps=1000)["body"].position[-1, 0] - place
    np.testing.assert_allclose(moved, 0.5 * 1.5 * 0.09, atol=1e-8 * max(place, 1.0))

    ball = planar.PointMass("ball", mass=2.0, position=(0.0, -place))
    rope = mb.Rope("rope", [("ground", (0.0, 0.0)), ("ball", (0.0, 0.0))], length=place, slack=True)
    lift = planar.PointForce("lift", "ball", force=(0.0, 30.0))
    system = mb.Scene([ball], joints=[rope], forces=[mb.Gravity((0.0, -G)), lift]).compile()
    t1 = min(0.3, 0.5 * np.sqrt(place))
    moved = mb.simulate(system, mb.assemble(system), t1=t1, max_steps=1000)["ball"].position[-1, 1] + place
    np.testing.assert_allclose(moved, risen(30.0, t1), atol=1e-8 * max(place, 1.0))


@pytest.mark.slow
def test_events_are_those_until_the_motion_ends():
    event = diffrax.Event(lambda t, y, args, **_: t - 0.4, optimistix.Newton(1e-10, 1e-10))
    motion = mb.simulate(BALL, mb.assemble(BALL), t1=2.0, event=event, rtol=1e-10)
    np.testing.assert_allclose(motion.ts[-1], 0.4)
    assert len(motion.events) == 0 and motion.stats["num_events"] == 0


@pytest.mark.slow
def test_impulses_of_contacts_that_stay_closed_are_events():
    """A ball strikes a block on the floor, which passes the impulse on."""
    system = mb.Scene(
        [planar.PointMass("block", mass=3.0, position=(0.0, 0.0)), planar.PointMass("ball", mass=1.0, position=(0, 1))],
        joints=[
            mb.RigidContact("floor", "block", terrain=terrain.Flat()),
            mb.RigidBallContact("hit", "block", "ball", radius_a=0.1, radius_b=0.1, restitution=0.5),
        ],
        forces=[mb.Gravity((0.0, -G))],
    ).compile()
    motion = mb.simulate(system, mb.assemble(system, fix={"floor.mode": 1}), t1=0.6, rtol=1e-10)
    assert [(event.part, event.kind) for event in motion.events] == [("floor", "impulse"), ("hit", "impact")]
    expected = 1.5 * np.sqrt(2 * G * 0.8)
    np.testing.assert_allclose([event.impulse for event in motion.events], expected, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("gap", [-1e-6, -1e-8, -1e-10])
def test_a_start_that_overlaps_by_its_last_digits(gap):
    state = mb.assemble(BALL)
    for speed in (1.0, -1.0):
        start = dataclasses.replace(state, q=state.q.at[1].set(gap), u=state.u.at[1].set(speed))
        motion = mb.simulate(BALL, start, t1=0.05, rtol=1e-8)
        rebound = 1.0 if speed > 0 else 0.5
        np.testing.assert_allclose(motion["ball"].velocity[-1, 1], rebound - 0.05 * G, atol=1e-4)


@pytest.mark.slow
def test_numbers_that_do_not_agree_where_they_are_traced():
    @jax.jit
    def run(restitution):
        system = mb.with_parameters(BALL, {"floor.restitution": restitution})
        return mb.simulate(system, mb.assemble(BALL), t1=0.1).result._value

    assert run(1.0) == mb.RESULTS.successful._value
    assert run(1.5) == mb.RESULTS.invalid_parameters._value


@pytest.mark.slow("jit")
@pytest.mark.parametrize("around", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_second_derivatives_through_impacts_are_refused(around, monkeypatch):
    if around is not jax.jit:
        # Before anything is traced.
        monkeypatch.setattr(importlib.import_module("jaxmb.simulate.run"), "solved", None)
    with pytest.raises(ValueError, match="Second derivatives through impacts are not supported"):
        jax.hessian(around(lambda at: end(at, 0.6)))(jnp.array([0.8, 0.1]))


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"solver": diffrax.Tsit5()}, {"manifold": Projection()}], ids=["Tsit5", "sparse"])
def test_other_solvers_and_manifolds(options):
    at, t1 = jnp.array([0.8, 0.1]), jnp.array(1.9)
    value, slope = jit_quickly(jax.value_and_grad(lambda at: end(at, t1, **options)))(at)
    np.testing.assert_allclose(value, height(t1, *at, 3), atol=1e-8)
    np.testing.assert_allclose(slope, jax.grad(lambda at: height(t1, *at, 3))(at), rtol=1e-6)


@pytest.mark.slow
def test_members_of_a_batch_have_their_own_events():
    at = jnp.array([[0.0, 0.0], [0.5, 0.0], [0.8, 0.1], [1.0, 0.3]])

    def run(values):
        system = mb.with_parameters(BALL, {"floor.restitution": values[0], "floor.lower": values[1]})
        motion = mb.simulate(system, mb.assemble(BALL), t1=1.9, rtol=1e-9)
        return motion["ball"].position[-1, 1], motion.stats["num_events"], motion.stats["num_steps"]

    together, alone = jit_quickly(jax.vmap(run))(at), jit_quickly(run)
    for k, values in enumerate(at):
        for got, known in zip(together, alone(values), strict=True):
            np.testing.assert_allclose(got[k], known, rtol=1e-12)
    np.testing.assert_allclose(together[0][2], height(1.9, 0.8, 0.1, 3), atol=1e-9)


@pytest.mark.slow
def test_derivatives_of_a_batch_whose_members_have_their_own_events():
    """Those of the closed form, in both modes, of members with two to six impacts."""
    at, impacts, t1 = jnp.array([[0.95, -0.5], [0.8, 0.1], [0.9, 0.3], [0.7, 0.3]]), (2, 3, 3, 6), 1.9
    exact = [jax.grad(lambda values, n=n: height(t1, *values, n))(own) for own, n in zip(at, impacts, strict=True)]
    reverse, forward = (jit_quickly(jax.vmap(mode(lambda x: end(x, t1))))(at) for mode in (jax.grad, jax.jacfwd))
    np.testing.assert_allclose(reverse, exact, rtol=1e-7)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)


@pytest.mark.slow
def test_a_mass_between_two_stops():
    """Without forces the speed is `restitution` to the number of impacts."""
    system = mb.Scene(
        [planar.Body("mass", mass=3.0, inertia=1.0, velocity=(2.0, 0.0))],
        joints=[
            planar.Prismatic("slide", "ground", "mass", axis=(1.0, 0.0), point_a=(0.0, 0.0), point_b=(0.0, 0.0)),
            mb.Stop("ends", "slide.displacement", lower=-0.5, upper=0.5, restitution=0.9),
        ],
    ).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=5.0, rtol=1e-10)
    times = 0.25 + np.cumsum(np.append(0.0, 0.5 / 0.9 ** np.arange(1, len(motion.events))))
    assert len(motion.events) > 5
    np.testing.assert_allclose(motion.events.times, times, atol=1e-9)
    np.testing.assert_allclose(abs(motion["mass"].velocity[-1, 0]), 2 * 0.9 ** len(times), rtol=1e-9)
    np.testing.assert_allclose(np.asarray(motion.events.impulses)[:, 0], 6 * 1.9 * 0.9 ** np.arange(len(times)))


@pytest.mark.slow
def test_steps_between_impacts():
    """A rattling mass takes three steps from one stop to the other, and a fourth that was too long: the step after an
    impact is as long as it could be after the last one, and one that passes the middle is not too coarse.
    """
    system = mb.Scene(
        [planar.Body("mass", mass=1.0, inertia=1.0, velocity=(10.0, 0.0))],
        joints=[
            planar.Prismatic("rail", "ground", "mass", axis=(1.0, 0.0), point=(0.0, 0.0)),
            mb.Stop("stop", "rail.displacement", lower=-0.005, upper=0.005, restitution=0.9999),
        ],
        forces=[mb.JointSpring("spring", "rail.displacement", stiffness=3.0)],
    ).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=0.03, rtol=1e-6, error=False)
    assert len(motion.events) == 30
    assert motion.stats["num_rejected_steps"] <= 32
    assert motion.stats["num_steps"] <= 4.2 * 30


@pytest.mark.slow
def test_cradle():
    """Five balls almost touch: the last one takes all of the velocity of the first."""
    at = [-0.2, *(0.1 * k + 1e-6 * k for k in range(1, 5))]
    bodies = [
        planar.Body(f"b{k}", mass=1.0, inertia=1e-3, position=(x, 0.0), velocity=(float(k == 0), 0.0))
        for k, x in enumerate(at)
    ]
    contacts = [
        mb.RigidBallContact(f"c{k}", f"b{k}", f"b{k + 1}", radius_a=0.05, radius_b=0.05, restitution=1.0)
        for k in range(4)
    ]
    system = mb.Scene(bodies, joints=contacts).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=1.0, rtol=1e-10)
    assert [event.part for event in motion.events] == ["c0", "c1", "c2", "c3"]
    np.testing.assert_allclose([motion[f"b{k}"].velocity[-1, 0] for k in range(5)], [0, 0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(motion["b4"].position[-1, 0], at[4] + 1.0 - (0.2 + 4e-6), atol=1e-9)


@pytest.mark.slow
def test_a_particle_leaves_a_sphere():
    """It slides from the top without friction and leaves the sphere at two thirds of its radius above the centre."""
    start = 0.1
    system = particle_on_a_sphere(np.sin(start), np.cos(start))
    state = mb.assemble(system)
    motion = mb.simulate(system, state, t1=2.0, saveat=diffrax.SaveAt(dense=True), rtol=1e-10)
    (event,) = motion.events
    assert event.kind == "open"
    at = motion.at(event.time)
    np.testing.assert_allclose(at.q[1], 2 / 3 * np.cos(start), atol=1e-9)
    # Then it is in free flight.
    late = motion.at(event.time + 0.2)
    flight = np.asarray(at.q[:2] + 0.2 * at.u[:2]) + np.array([0.0, -G * 0.02])
    np.testing.assert_allclose(late.q[:2], flight, atol=1e-9)


@pytest.mark.slow
def test_redundant_contacts_of_a_table():
    """A table falls flat on four legs: three of the reactions carry it, or two, and the fourth is implied."""
    table = spatial.Body("table", mass=2.0, inertia=np.diag([0.1, 0.1, 0.15]), position=(0.0, 0.0, 0.5))
    legs = [(x, y, -0.4) for x in (-0.3, 0.3) for y in (-0.2, 0.2)]
    contacts = [
        mb.RigidContact(f"leg{k}", "table", terrain=mb.terrain.Flat(), centre=leg) for k, leg in enumerate(legs)
    ]
    system = mb.Scene([table], joints=contacts, forces=[mb.Gravity((0.0, 0.0, -G))]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=1.0)
    assert {event.kind for event in motion.events} == {"close"}
    np.testing.assert_allclose(motion["table"].position[-1], [0.0, 0.0, 0.4], atol=1e-12)
    forces = [motion.reactions[f"leg{k}"].force[-1, 2] for k in range(4)]
    assert np.all(np.array(forces) >= -1e-12)
    np.testing.assert_allclose(sum(forces), 2 * G, rtol=1e-12)
    np.testing.assert_allclose(sum(f * leg[0] for f, leg in zip(forces, legs, strict=True)), 0.0, atol=1e-12)


@pytest.mark.slow
def test_a_block_comes_to_rest_on_its_corners():
    """Its corners strike in turn, infinitely often in a short time; energy is never gained."""
    block = planar.Body("block", mass=2.0, inertia=0.3, position=(0.0, 0.6), angle=0.05)
    corners = [
        mb.RigidContact(name, "block", terrain=mb.terrain.Flat(), centre=(x, -0.4))
        for name, x in (("left", -0.2), ("right", 0.2))
    ]
    system = mb.Scene([block], joints=corners, forces=[mb.Gravity((0.0, -G))]).compile()
    saveat = np.linspace(0.0, 1.0, 41)
    motion = mb.simulate(system, mb.assemble(system), t1=1.0, saveat=saveat, rtol=1e-8)
    np.testing.assert_allclose(motion["block"].position[-1], [0.0, 0.4], atol=1e-10)
    assert np.all(np.diff(motion.energy) <= 1e-7) and np.all(np.asarray(motion.events.kinetic_energy_lost) >= 0)
    gaps = np.stack([motion[name].gap for name in ("left", "right")])
    assert np.min(gaps) >= -1e-10
    forces = [motion.reactions[name].force[-1, 1] for name in ("left", "right")]
    np.testing.assert_allclose(forces, [G, G], rtol=1e-9)


@pytest.mark.slow
def test_a_ball_bounces_off_the_edge_of_a_box():
    """It is reflected along the line from the edge to its centre."""
    radius, beyond, restitution = 0.1, 0.06, 0.7
    system = mb.Scene(
        [planar.Body("ball", mass=1.3, inertia=0.01, position=(0.5 + beyond, 1.0))],
        joints=[mb.RigidBoxContact("c", "ground", "ball", size=(1.0, 0.4), radius=radius, restitution=restitution)],
        forces=[mb.Gravity((0.0, -G))],
    ).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=0.5, saveat=[0.5], rtol=1e-10)
    height = 0.2 + np.sqrt(radius**2 - beyond**2)
    time, normal = np.sqrt(2 * (1.0 - height) / G), np.array([beyond, height - 0.2]) / radius
    (event,) = motion.events
    np.testing.assert_allclose(event.time, time, rtol=1e-10)
    before, left = np.array([0.0, -G * time]), 0.5 - time
    after = before - (1 + restitution) * (before @ normal) * normal
    end = np.array([0.5 + beyond, height]) + after * left - np.array([0.0, G / 2]) * left**2
    np.testing.assert_allclose(motion["ball"].position[-1], end, rtol=1e-9)


@pytest.mark.slow
def test_a_rope_tightens():
    """A free fall until the rope is tight, with the impulse along it."""
    system = mb.Scene(
        [planar.PointMass("p", mass=1.5, position=(0.6, 0.0))],
        joints=[mb.Slack("rope", "ground", "p", length=1.0, restitution=1.0)],
        forces=[mb.Gravity((0.0, -G))],
    ).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=0.5, rtol=1e-10)
    (event,) = motion.events
    np.testing.assert_allclose(event.time, np.sqrt(2 * 0.8 / G), atol=1e-10)
    speed = 0.8 * np.sqrt(2 * G * 0.8)
    np.testing.assert_allclose(event.impulse, 2 * 1.5 * speed, rtol=1e-9)
    np.testing.assert_allclose(motion.energy[-1], 0.0, atol=1e-8)


@pytest.mark.slow
def test_a_stop_that_is_only_just_reached():
    """Steps are long where a spring turns round: the stop is in the middle of one."""
    system = mb.Scene(
        [planar.Body("mass", mass=1.0, inertia=1.0, position=(1.0, 0.0))],
        joints=[
            planar.Prismatic("slide", "ground", "mass", axis=(1.0, 0.0), point_a=(0.0, 0.0), point_b=(0.0, 0.0)),
            mb.Stop("end", "slide.displacement", lower=-0.9999, restitution=1.0),
        ],
        forces=[mb.JointSpring("spring", "slide.displacement", stiffness=1.0, free=0.0)],
    ).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=4.0, rtol=1e-6)
    (event,) = motion.events
    np.testing.assert_allclose(event.time, np.arccos(-0.9999), atol=1e-5)


@pytest.mark.slow
def test_motions_that_start_in_contact():
    closed = mb.assemble(BALL, fix={"floor.mode": 1})
    np.testing.assert_allclose(closed.q[1], 0.0, atol=1e-15)
    motion = mb.simulate(BALL, closed, t1=0.1, saveat=[0.0, 0.1])
    np.testing.assert_allclose(motion.reactions["floor"].force[:, 1], 2 * G)
    # A motion goes on from a state with its modes.
    np.testing.assert_allclose(motion["floor"].mode, 1.0)
    upwards = mb.assemble(BALL, closed, fix={"floor.mode": 0}, rates={"ball.y": 1.0})
    motion = mb.simulate(BALL, upwards, t1=0.1)
    np.testing.assert_allclose(motion["ball"].position[-1, 1], 0.1 - G * 0.005, atol=1e-9)


@pytest.mark.slow
def test_refusals():
    state = mb.assemble(BALL)
    inside = mb.assemble(BALL, fix={"ball.y": -0.1})
    with pytest.raises(ValueError, match=r"beyond contacts, .* at t0 = 0: floor by 0\.1"):
        mb.simulate(BALL, inside, t1=1.0)
    with pytest.raises(ValueError, match=r"'floor\.mode' is 1 to close the contact, or 0 to open it; got 3"):
        mb.assemble(BALL, fix={"floor.mode": 3})
    with pytest.raises(ValueError, match="Impacts cannot be undone"):
        mb.simulate(BALL, state, t1=-1.0)
    with pytest.raises(ValueError, match="max_events must be an integer of at least 1"):
        mb.simulate(BALL, state, t1=1.0, max_events=0)
    with pytest.raises(RuntimeError, match=r"came to t = 1\.12.* more impacts and other events of contacts than"):
        mb.simulate(BALL, state, t1=2.0, max_events=2)
    with pytest.raises(ValueError, match=r"Partition\(\) or Projection\(\)"):
        mb.simulate(BALL, state, t1=1.0, manifold=mb.manifold.Baumgarte())
    pendulum = mb.mechanisms.pendulum()
    with pytest.raises(ValueError, match="has neither contacts"):
        _ = mb.simulate(pendulum.system, pendulum.state, t1=0.1).events


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"lower": None}, "give lower, upper or both"),
        ({"upper": -1.0}, "lower must be less than upper"),
        ({"restitution": 1.5}, "restitution must lie between 0 and 1, got 1.5"),
        ({"restitution": -0.5}, "restitution must be non-negative"),
    ],
)
def test_bad_stops(wrong, message):
    with pytest.raises(ValueError, match=message):
        ball(**({"restitution": 0.5} | wrong))


def touch(policy, solver, system, rtol):
    """The gaps that count as closed."""
    term, prepared = policy.prepare(system, policy.default_formulation(system), solver, np.float64(rtol))
    guards = term.guards if isinstance(solver, mb.solvers.Adams) else prepared.guards
    return float(guards.touch)


@pytest.mark.slow
def test_gaps_that_count_as_closed():
    """A thousandth of the tolerance with every manifold, and no less than positions are found to."""
    ways = [
        (manifold.Partition, mb.solvers.Adams()),
        (manifold.Projection, mb.solvers.Adams()),
        (manifold.Projection, diffrax.Dopri8()),
    ]
    for (policy, solver), rtol in itertools.product(ways, (1e-3, 1e-6, 1e-9)):
        for newton_tol in (None, 1e-13):
            np.testing.assert_allclose(touch(policy(newton_tol=newton_tol), solver, BALL, rtol), 1e-3 * rtol)
        np.testing.assert_allclose(touch(policy(newton_tol=1e-5), solver, BALL, rtol), 1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("rtol", [1e-3, 1e-6])
def test_what_counts_as_closed_does_not_depend_on_the_size_of_a_scene(rtol):
    """A ball beside bars whose rows are eliminated along the joints, with the steps of a dense matrix."""
    lone = planar.Body("ball", mass=1.0, inertia=planar.disc(1.0, 0.1), position=(-3.0, 0.5))
    floor = mb.RigidContact("floor", "ball", terrain=terrain.Flat(), radius=0.1, restitution=0.5)
    bars = [planar.Body(f"bar{k}", mass=1.0, inertia=0.1, position=(3.0 * k, 2.0)) for k in range(15)]
    pins = [planar.Revolute(f"pin{k}", "ground", f"bar{k}", point=(3.0 * k, 3.0)) for k in range(15)]
    system = mb.Scene([lone, *bars], joints=[floor, *pins], forces=[mb.Gravity((0.0, -G))]).compile()
    assert system.elimination is not None
    start = mb.assemble(system)
    runs = [mb.simulate(system, start, t1=1.2, rtol=rtol, manifold=own) for own in (None, manifold.Partition())]
    several = [[(event.kind, event.part) for event in motion.events] for motion in runs]
    assert several[0] == several[1]
    assert len(several[0]) == {1e-3: 3, 1e-6: 8}[rtol]
    for event, other in zip(runs[0].events, runs[1].events, strict=True):
        np.testing.assert_allclose(event.time, other.time, atol=10 * rtol)


@pytest.mark.slow
def test_an_impact_of_a_driven_hammer_gives_energy():
    """The driver keeps the hammer at its speed v, and the ball leaves at (1 + e) v: a loss below zero."""
    bodies = [
        planar.Body(name, mass=2.0, inertia=1.0, position=(x, 0.0)) for name, x in (("hammer", 0.0), ("ball", 0.3))
    ]
    joints = [
        planar.Prismatic("slide", "ground", "hammer", point=(0.0, 0.0), axis=(1.0, 0.0)),
        mb.JointDriver("drive", "slide.displacement", rate=2.0),
        mb.RigidBallContact("meet", "hammer", "ball", radius_a=0.1, radius_b=0.1, restitution=0.5),
    ]
    system = mb.Scene(bodies, joints=joints).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=0.1)
    (event,) = motion.events
    np.testing.assert_allclose([event.time, event.impulse, event.kinetic_energy_lost], [0.05, 6.0, -9.0], rtol=1e-9)
