"""Dry friction of constant size that sticks exactly, against closed forms and SciPy."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from scipy.integrate import solve_ivp

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.parts import terrain
from jaxmb.solvers import Hermite

RAMP, END = 4.0, 2.0
RAIL = planar.Prismatic("rail", "ground", "block", axis=(1.0, 0.0), point=(0.0, 0.0))
BLOCK = planar.Body("block", mass=2.0, inertia=0.1)
SLIDING = planar.Body("block", mass=2.0, inertia=0.1, velocity=(3.0, 0.0))
RUB = mb.JointFriction("rub", "rail.displacement", force=2.0, static_force=3.0, exact=True)
PULLED = mb.Scene([BLOCK], joints=[RAIL], forces=[RUB, mb.JointForce("pull", "rail.displacement", force=0.0)]).compile()


def pulled(system, saveat):
    ramp = {"pull.force": lambda t: RAMP * t}
    return mb.simulate(system, mb.assemble(system), t1=END, inputs=ramp, saveat=saveat, rtol=1e-10)


def pulled_to(force, static_force, mass, t=END):
    """Where the block is at a time after it has begun to slip: m ẍ = RAMP t − force."""
    t0 = static_force / RAMP
    speed = lambda t: RAMP * t**2 / 2 - force * t
    return (RAMP * (t**3 - t0**3) / 6 - force * (t**2 - t0**2) / 2 - speed(t0) * (t - t0)) / mass


@pytest.mark.slow
def test_a_block_pulled_by_a_ramp_sticks_until_the_force_breaks_it_away():
    motion = pulled(PULLED, [0.5, 1.5, END])
    (slip,) = motion.events
    assert (slip.part, slip.kind, slip.impulse) == ("rub", "slip", 0.0)
    np.testing.assert_allclose(slip.time, 3.0 / RAMP, rtol=1e-10)
    x = [0.0, pulled_to(2.0, 3.0, 2.0, 1.5), pulled_to(2.0, 3.0, 2.0)]
    np.testing.assert_allclose(motion["block"].position[:, 0], x, rtol=1e-9)
    # In stick it answers the pull, in slip it has its size.
    np.testing.assert_allclose(motion.reactions["rub"].force[:, 0], [-0.5 * RAMP, -2.0, -2.0], rtol=1e-11)


@pytest.mark.slow
def test_derivatives_through_stick_and_slip():
    def end(p):
        system = mb.with_parameters(PULLED, dict(zip(("rub.force", "rub.static_force", "block.mass"), p, strict=True)))
        return pulled(system, [END])["block"].position[0, 0]

    p, along = jnp.array([2.0, 3.0, 2.0]), jnp.array([0.3, -0.5, 1.0])
    exact = jax.grad(lambda p: pulled_to(*p))(p)
    value, slope = jit_quickly(jax.value_and_grad(end))(p)
    np.testing.assert_allclose(value, pulled_to(*p), rtol=1e-9)
    np.testing.assert_allclose(slope, exact, rtol=1e-8)
    forward = jit_quickly(lambda p: jax.jvp(end, (p,), (along,))[1])(p)
    np.testing.assert_allclose(forward, slope @ along, rtol=1e-11)
    several = jnp.stack([p + 0.1 * k * along for k in range(3)])
    batch = jit_quickly(jax.vmap(end))(several)
    np.testing.assert_allclose(batch, [pulled_to(*p) for p in several], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("on", ["hinge.angle", "cord.length"])
def test_a_hinge_in_space_stops_after_full_turns(on):
    """The friction of a cord on a drum of the radius r takes r times its force."""
    inertia, spin, moment, radius = 0.4, 30.0, 0.5, 0.1
    wheel = spatial.Body("wheel", mass=1.0, inertia=(0.2, 0.3, inertia), angular_velocity=(0.0, 0.0, spin))
    hinge = spatial.Revolute("hinge", "ground", "wheel", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    cord = mb.FixedTendon("cord", ("hinge.angle",), coefficients=(radius,))
    brake = mb.JointFriction("brake", on, force=moment if on == "hinge.angle" else moment / radius, exact=True)
    system = mb.Scene([wheel], joints=[hinge, cord], forces=[brake]).compile()
    names = {"brake.force": brake.force, "wheel.inertia": jnp.diag(jnp.array([0.2, 0.3, inertia]))}

    def run(p, saveat):
        changed = mb.with_parameters(system, {name: scale * names[name] for name, scale in zip(names, p, strict=True)})
        return mb.simulate(changed, mb.assemble(changed), t1=30.0, saveat=saveat, rtol=1e-10)

    motion = run((1.0, 1.0), [10.0, 30.0])
    (stop,) = motion.events
    assert (stop.part, stop.kind) == ("brake", "stick")
    slow = moment / inertia
    np.testing.assert_allclose(stop.time, spin / slow, rtol=1e-9)
    turned = spin * 10.0 - 0.5 * slow * 10.0**2, 0.5 * spin**2 / slow
    np.testing.assert_allclose(motion.quantity("cord.length"), radius * np.array(turned), rtol=1e-9)
    np.testing.assert_allclose(motion.reactions["brake"].moment[:, 2], [-moment, 0.0], atol=1e-9)
    assert motion["wheel"].angular_velocity[1, 2] == 0.0

    # The angle is proportional to inertia over moment.
    end = lambda p: run(p, [30.0]).quantity("cord.length")[0]
    slope = jax.grad(end)(jnp.ones(2))
    np.testing.assert_allclose(slope, radius * turned[1] * np.array([-1.0, 1.0]), rtol=1e-7)


@pytest.mark.slow
def test_a_pendulum_with_coulomb_friction_comes_to_rest_off_its_lowest_point():
    """Against SciPy from one change of direction to the next."""
    mass, length, inertia, force, static, start, g = 1.5, 0.6, 0.59, 0.4, 0.7, 1.0, 9.81
    at = (length * np.sin(start), -length * np.cos(start))
    bar = planar.Body("bar", mass=mass, inertia=inertia - mass * length**2, position=at, angle=start)
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    rub = mb.JointFriction("rub", "pin.angle", force=force, static_force=static, exact=True)
    system = mb.Scene([bar], joints=[pin], forces=[rub, mb.Gravity((0.0, -g))]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=12.0, saveat=[12.0], rtol=1e-10)

    t, angle, turns = 0.0, start, []
    load = lambda angle: -mass * g * length * np.sin(angle)
    while abs(load(angle)) > static:
        side = np.sign(load(angle))
        rates = lambda t, y, side=side: [y[1], (load(y[0]) - side * force) / inertia]
        stops = lambda t, y: y[1]
        stops.terminal, stops.direction = True, -side
        span = solve_ivp(rates, (t, 12.0), [angle, side * 1e-300], events=stops, rtol=1e-12, atol=1e-13, max_step=0.05)
        t, angle = span.t[-1], span.y[0, -1]
        turns.append(t)
    assert len(turns) > 5 and abs(load(angle)) > 0.1
    np.testing.assert_allclose([event.time for event in motion.events], turns, rtol=1e-9)
    assert [event.kind for event in motion.events] == [*["slip"] * (len(turns) - 1), "stick"]
    np.testing.assert_allclose(motion["pin"].angle[-1], angle, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, Hermite(), diffrax.Tsit5()], ids=["Adams", "Hermite", "Tsit5"])
def test_a_block_that_rubs_in_two_ways_stops(solver):
    """Friction by its weight and friction of constant size stop it together."""
    weight = mb.DryFriction("weight", "rail", coefficient=0.1)
    system = mb.Scene([SLIDING], joints=[RAIL], forces=[weight, RUB, mb.Gravity((0.0, -10.0))]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=3.0, saveat=[3.0], rtol=1e-9, solver=solver)
    slow = (2.0 + 0.1 * 2.0 * 10.0) / 2.0
    (stop, *_) = motion.events
    np.testing.assert_allclose(stop.time, 3.0 / slow, rtol=1e-8)
    np.testing.assert_allclose(motion["block"].position[0, 0], 4.5 / slow, rtol=1e-8)
    np.testing.assert_allclose(motion["block"].velocity, 0.0, atol=1e-12)


@pytest.mark.slow
def test_a_block_rebounds_from_a_stop_and_sticks():
    """The impact turns the slip around, and has no impulse of friction."""
    stop = mb.Stop("stop", "rail.displacement", upper=0.5, restitution=0.5)
    system = mb.Scene([SLIDING], joints=[RAIL, stop], forces=[RUB]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=3.0, saveat=[3.0], rtol=1e-10)
    hits = 3.0 - np.sqrt(9.0 - 2 * 0.5)
    speed = 0.5 * (3.0 - hits)
    # It slips back from the impact on.
    events = [("stop", "impact"), ("rub", "slip"), ("rub", "stick")]
    assert [(event.part, event.kind) for event in motion.events] == events
    np.testing.assert_allclose([event.time for event in motion.events], [hits, hits, hits + speed], rtol=1e-9)
    np.testing.assert_allclose(motion["block"].position[0, 0], 0.5 - 0.5 * speed**2, rtol=1e-9)


@pytest.mark.slow
def test_friction_of_size_zero_does_nothing():
    none = mb.JointFriction("rub", "rail.displacement", force=0.0, exact=True)
    system = mb.Scene([SLIDING], joints=[RAIL], forces=[none]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=3.0, saveat=[3.0])
    np.testing.assert_allclose(motion["block"].position[0, 0], 9.0, rtol=1e-10)
    assert len(motion.events) == 0


def test_words_and_numbers():
    assert "ExactFriction  rub  of rail, where it sticks 1 row each" in str(PULLED.describe())
    assert {"rub.force", "rub.static_force"} <= set(mb.parameters(PULLED)) and not PULLED.friction_rows.size
    # Without a static force the force of slip holds in stick too.
    alone = mb.Scene(
        [BLOCK], joints=[RAIL], forces=[mb.JointFriction("rub", "rail.displacement", force=1.0, exact=True)]
    )
    assert mb.with_parameters(alone.compile(), {"rub.force": 0.5}).contact_numbers(0.0).limit == 0.5
    with pytest.raises(ValueError, match="joints must hold constraints, got JointFriction 'rub'; it belongs in force"):
        mb.Scene([BLOCK], joints=[RAIL, RUB])


BALL = spatial.Body("block", mass=1.0, inertia=(1.0, 1.0, 1.0))
BAD = {
    "a width of exact friction": (
        BLOCK,
        RAIL,
        {"force": 1.0, "transition_speed": 0.1},
        "exact friction has no transition_speed",
    ),
    "a static force of smooth friction": (
        BLOCK,
        RAIL,
        {"force": 1.0, "static_force": 2.0, "exact": False},
        "static_force needs friction that sticks; give exact=True",
    ),
    "a negative force": (BLOCK, RAIL, {"force": -1.0}, "force must be non-negative, got -1.0"),
    "a limit below it": (
        BLOCK,
        RAIL,
        {"force": 2.0, "static_force": 1.0},
        "static_force must not be less than force, got 1.0 and 2.0",
    ),
    "no such coordinate": (BLOCK, RAIL, {"coordinate": "rail.angel", "force": 1.0}, "rail.displacement"),
    "a vector": (
        BALL,
        spatial.Planar("rail", "ground", "block", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0)),
        {"force": 1.0},
        "'rail.displacement' must be a number",
    ),
    "a contact": (
        BLOCK,
        mb.RigidContact("rail", "block", terrain=terrain.Flat(), radius=0.1),
        {"coordinate": "rail.gap", "force": 1.0},
        "is not a joint; friction of bodies that touch is DryFriction",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name):
    body, joint, options, message = BAD[name]
    rub = mb.JointFriction("rub", **({"coordinate": "rail.displacement", "exact": True} | options))
    with pytest.raises(ValueError, match="JointFriction 'rub'") as caught:
        mb.Scene([body], joints=[joint], forces=[rub]).compile()
    assert message in str(caught.value)
