"""Regulators at equilibria against SciPy, in closed loop and by differences; regulators along plans."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.studies.lqr.algebraic import algebraic, reason
from jaxmb.studies.lqr.regulator import Regulator, measured_as

MOST_PROGRAMS = 120

UP, DOWN = np.pi / 2, -np.pi / 2
PUSH = mb.JointForce("push", "slide.displacement", force=0.0)
NAMES = ["slide.displacement", "pin.angle"]
WEIGHTS = {"slide.displacement": 10.0, "pin.angle": 100.0, "pin.angle_rate": 1.0}
COST = {"states": WEIGHTS, "inputs": {"push.force": 0.1}}


def cart_pole(angle, *forces):
    """A cart of 1 kg with a point of 0.3 kg at the end of a light pole of 0.5 m."""
    cart = planar.Body("cart", mass=1.0, inertia=1.0)
    place = 0.5 * np.array([np.cos(angle), np.sin(angle)])
    bob = planar.Body("pole", mass=0.3, inertia=1e-6, position=place, angle=angle)
    slide = planar.Prismatic("slide", "ground", "cart", point=(0.0, 0.0), axis=(1.0, 0.0))
    pin = planar.Revolute("pin", "cart", "pole", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    return mb.Scene([cart, bob], joints=[slide, pin], forces=[mb.Gravity((0.0, -9.81)), *forces]).compile()


@functools.cache
def upright():
    system = cart_pole(UP, PUSH)
    return system, mb.linearise(system, mb.assemble(system), inputs=["push.force"], coordinates=NAMES)


def at_rest(system, **values):
    return mb.assemble(system, fix={name.replace("__", "."): value for name, value in values.items()})


@pytest.mark.slow
def test_algebraic_names_the_mode_that_no_input_moves():
    A, B, q = np.diag([1.0, -1.0, 2.0]), np.array([[0.0], [1.0], [1.0]]), np.ones(3)
    assert not algebraic(A, B, q, np.ones(1)).ok
    about = reason(A, B, q, ("a", "b", "c"), ("push",))
    assert about.startswith(
        "lqr: push cannot stabilise the mode with the eigenvalue 1 1/s, in which a takes part most."
    )
    # A swing without damping that no input moves does not come to rest.
    A = np.array([[0.0, 1.0, 0.0], [-4.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    B = np.array([[0.0], [0.0], [1.0]])
    assert not algebraic(A, B, q, np.ones(1)).ok
    assert "cannot stabilise" in reason(A, B, q, ("a", "b", "c"), ("push",))


def test_algebraic_names_the_drifting_state_without_cost():
    A, B, q = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([0.0, 1.0])
    assert not algebraic(A, B, q, np.ones(1)).ok
    assert reason(A, B, q, ("x", "v"), ("push",)).endswith("Give x a weight.")
    # A decaying mode without cost does no harm.
    assert algebraic(np.diag([-1.0, 1.0]), np.ones((2, 1)), np.array([0.0, 1.0]), np.ones(1)).ok


def test_controller_takes_the_shortest_way_of_angles_in_space():
    body = spatial.Body("arm", mass=1.0, inertia=np.eye(3))
    hinge = spatial.Revolute("hinge", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    system = mb.Scene([body], joints=[hinge]).compile()
    seen = tuple(measured_as(system, name) for name in ("hinge.angle", "hinge.angle_rate"))
    assert [own.quantity for own in seen] == ["hinge.angle", "hinge.angle_rate"]
    assert [own.periodic for own in seen] == [True, False]
    assert measured_as(system, "arm.rotation_x") is None
    regulator = Regulator(
        gains=jnp.array([[2.0, 0.5]]),
        cost=jnp.eye(2),
        closed=-jnp.eye(2),
        reference_states=jnp.array([3.1, 4.0]),
        reference_inputs=jnp.array([7.0]),
        ts=None,
        states=("hinge.angle", "hinge.angle_rate"),
        inputs=("motor.force",),
        measured=seen,
    )
    part = regulator.controller("hold", {"motor.force": "hinge.angle"})
    measured = {"hinge.angle": jnp.asarray(-3.1), "hinge.angle_rate": jnp.asarray(-4.0)}
    force, _ = part.function(0.0, measured, {}, part.parameters)
    np.testing.assert_allclose(force, 7.0 - 2.0 * (2 * np.pi - 6.2) + 0.5 * 8.0, rtol=1e-12)
    blind = dataclasses.replace(regulator, measured=(None, seen[1]), states=("arm.rotation_x", "hinge.angle_rate"))
    with pytest.raises(ValueError, match=r"hold: a controller cannot measure the state 'arm\.rotation_x'"):
        blind.controller("hold", {"motor.force": "hinge.angle"})


@pytest.mark.slow
def test_lqr_of_a_cart_pole_is_scipys_and_brings_it_to_rest():
    _, about = upright()
    regulator = mb.lqr(about, **COST)
    assert regulator.states == (*NAMES, "slide.displacement_rate", "pin.angle_rate")
    X = scipy.linalg.solve_continuous_are(about.A, about.B, np.diag([10.0, 100.0, 0.0, 1.0]), [[0.1]])
    np.testing.assert_allclose(regulator.gains, about.B.T @ X / 0.1, rtol=1e-10)
    np.testing.assert_allclose(regulator.cost, X, rtol=1e-10)
    np.testing.assert_allclose(regulator.reference_states, [0.0, UP, 0.0, 0.0], atol=1e-12)
    closed = np.linalg.eigvals(about.A - about.B @ regulator.gains)
    np.testing.assert_allclose(np.sort_complex(regulator.eigenvalues), np.sort_complex(closed), rtol=1e-9)
    assert np.all(closed.real < 0) and "closed loop" in str(regulator)

    held = cart_pole(UP, regulator.controller("hold", {"push.force": "slide.displacement"}))
    start = at_rest(held, pin__angle=UP + 0.2, slide__displacement=0.3)
    end = mb.simulate(held, start, t1=12.0).end
    np.testing.assert_allclose([*mb.evaluate(held, end, NAMES).values()], [0.0, UP], atol=1e-4)
    np.testing.assert_allclose(end.u, 0.0, atol=1e-4)
    parameters = mb.parameters(held)
    np.testing.assert_array_equal(parameters["hold.gains"], regulator.gains)


@pytest.mark.slow
def test_lqr_gains_have_derivatives_by_lengths_and_weights():
    system, about = upright()

    def gain(length, weight):
        longer = mb.with_parameters(system, {"pin.point_b": jnp.stack([-length, jnp.zeros(())])})
        state = mb.assemble(longer, about.state)
        linear = mb.linearise(longer, state, inputs=["push.force"], coordinates=NAMES, rates=NAMES)
        return mb.lqr(linear, states=WEIGHTS | {"pin.angle": weight}, inputs={"push.force": 0.1}).gains[0, 1]

    at, h = (jnp.asarray(0.5), jnp.asarray(100.0)), (1e-4, 1e-2)
    value, reverse, forward = (jax.jit(f(gain, (0, 1))) for f in (lambda f, _: f, jax.grad, jax.jacfwd))
    np.testing.assert_allclose(reverse(*at), forward(*at), rtol=1e-9)
    sides = [
        (value(at[0] + h[0], at[1]), value(at[0] - h[0], at[1])),
        (value(at[0], at[1] + h[1]), value(at[0], at[1] - h[1])),
    ]
    np.testing.assert_allclose(reverse(*at), [(b - a) / (2 * s) for (b, a), s in zip(sides, h, strict=True)], rtol=1e-6)


@pytest.mark.slow
def test_lqr_tells_how_states_are_named_under_a_trace():
    system, about = upright()

    def gains(state):
        linear = mb.linearise(system, state, inputs=["push.force"], coordinates=NAMES)
        return mb.lqr(linear, **COST).gains

    with pytest.raises(ValueError, match=r"Unknown state 'pin\.angle_rate'\. Under jit and vmap name it in linearise"):
        jax.eval_shape(gains, about.state)


@pytest.mark.slow
def test_lqr_holds_a_four_bar_at_an_unstable_equilibrium():
    scene = mb.mechanisms.four_bar().scene
    system = scene.extended(forces=[mb.JointForce("push", "A.angle", force=0.0)]).compile()
    lowest = mb.equilibrium(system)
    angle = mb.evaluate(system, lowest, "A.angle")
    opposite = mb.assemble(system, lowest, fix={"A.angle": angle + np.pi})
    state = mb.equilibrium(system, opposite, stable=False)
    about = mb.linearise(system, state, inputs=["push.force"], coordinates=["A.angle"])
    assert np.max(about.eigenvalues.real) > 0.1
    cost = {"states": {"A.angle": 100.0, "A.angle_rate": 10.0}, "inputs": {"push.force": 0.01}}
    regulator = mb.lqr(about, **cost)
    X = scipy.linalg.solve_continuous_are(about.A, about.B, np.diag([100.0, 10.0]), [[0.01]])
    np.testing.assert_allclose(regulator.gains, about.B.T @ X / 0.01, rtol=1e-10)
    rests = {"duration": 1.0, "start": state, "end": state, "running": "effort", "intervals": 4}
    kept = mb.lqr(mb.plan(system, controls={"push.force": None}, **rests), **cost)
    np.testing.assert_allclose(kept.gains, np.broadcast_to(regulator.gains, kept.gains.shape), rtol=1e-6)
    held = scene.extended(forces=[regulator.controller("hold", {"push.force": "A.angle"})]).compile()
    rest = float(mb.evaluate(system, state, "A.angle"))
    start = mb.assemble(held, state, fix={"A.angle": rest + 0.05})
    end = mb.simulate(held, start, t1=10.0).end
    np.testing.assert_allclose(mb.evaluate(held, end, "A.angle"), rest, atol=1e-4)
    np.testing.assert_allclose(end.u, 0.0, atol=1e-4)


@pytest.mark.slow
def test_lqr_refuses_names_and_weights():
    _, about = upright()
    push, angle = {"push.force": 1.0}, {"slide.displacement": 1.0, "pin.angle": 1.0}
    for states, inputs, message in (
        ({"pin.angl": 1.0}, push, "lqr: Unknown state 'pin.angl'; did you mean 'pin.angle'"),
        (angle, {"pull.force": 1.0}, "lqr: Unknown input 'pull.force'"),
        ({"pin.angle": -1.0}, push, "weight of 'pin.angle' in states must be at least zero, got -1"),
        (angle, {"push.force": 0.0}, "weight of 'push.force' in inputs must be positive, got 0"),
        (angle, {}, "inputs names no input"),
        ({"pin.angle": 1.0}, push, "in which slide.displacement takes part most, neither decays nor costs anything"),
    ):
        with pytest.raises(ValueError, match=message):
            mb.lqr(about, states=states, inputs=inputs)
    with pytest.raises(ValueError, match="final is for plans"):
        mb.lqr(about, states=angle, inputs=push, final=angle)
    with pytest.raises(ValueError, match="must be a Linearisation or a Plan"):
        mb.lqr(about.A, states=angle, inputs=push)
    regulator = mb.lqr(about, **COST)
    with pytest.raises(ValueError, match=r"hold: acts_on has no coordinate for the input 'push\.force'"):
        regulator.controller("hold", {})
    with pytest.raises(ValueError, match="hold: Unknown input 'push'"):
        regulator.controller("hold", {"push": "slide.displacement"})


@functools.cache
def swing_up():
    """The swing-up with the least effort: 1 kg, 0.3 kg, 0.5 m, in 2 s over 1 m."""
    system = cart_pole(DOWN, PUSH)
    still = {"slide.displacement_rate": 0.0, "pin.angle_rate": 0.0}
    start = {"slide.displacement": 0.0, "pin.angle": DOWN} | still
    end = {"slide.displacement": 1.0, "pin.angle": UP} | still
    plan = mb.plan(system, controls={"push.force": None}, duration=2.0, start=start, end=end, running="effort")
    assert plan.success
    return plan


@pytest.mark.slow
def test_lqr_along_a_swing_up_brings_a_disturbed_start_to_the_end():
    plan = swing_up()
    regulator = mb.lqr(plan, **COST)
    assert regulator.gains.shape == (len(regulator.ts), 1, 4) and "at 2 s" in str(regulator)
    free = cart_pole(DOWN, PUSH)
    held = cart_pole(DOWN, regulator.controller("hold", {"push.force": "slide.displacement"}))
    tolerance, goal = {"t1": 2.0, "rtol": 1e-8}, np.array([1.0, UP])

    def miss(system, aside, **inputs):
        end = mb.simulate(system, at_rest(system, pin__angle=DOWN + aside), **tolerance, **inputs).end
        return np.abs(np.array([*mb.evaluate(system, end, NAMES).values()]) - goal).max()

    # Without a disturbance the reference is the motion.
    assert miss(held, 0.0) < 1e-3
    assert miss(free, 0.02, inputs=plan.controls) > 0.2
    assert miss(held, 0.02) < 0.02
    # The cost of small changes.
    motion = mb.simulate(
        held, at_rest(held, pin__angle=DOWN + 0.01), t1=2.0, saveat=np.linspace(0.0, 2.0, 401), rtol=1e-10
    )
    seen = np.stack([np.asarray(motion.quantity(name)) for name in regulator.states], axis=1)
    change = seen - jax.vmap(regulator.reference_states)(motion.ts)
    gains = np.asarray(jax.vmap(mb.Series(regulator.ts, regulator.gains))(motion.ts))
    inputs = np.einsum("tik,tk->ti", gains, change)
    running = change**2 @ np.array([10.0, 100.0, 0.0, 1.0]) + 0.1 * inputs[:, 0] ** 2
    total = scipy.integrate.simpson(running, x=np.asarray(motion.ts)) + change[-1] @ regulator.cost[-1] @ change[-1]
    np.testing.assert_allclose(total, change[0] @ regulator.cost[0] @ change[0], rtol=1e-3)


@pytest.mark.slow
def test_lqr_along_a_rest_has_the_closed_form_and_the_gains_of_the_equilibrium():
    system, about = upright()
    rest = dict(zip(about.states, (0.0, UP, 0.0, 0.0), strict=True))
    plan = mb.plan(
        system, controls={"push.force": None}, duration=8.0, start=rest, end=rest, running="effort", intervals=16
    )
    constant = mb.lqr(about, **COST)
    kept = mb.lqr(plan, **COST)
    np.testing.assert_allclose(kept.gains, np.broadcast_to(constant.gains, kept.gains.shape), rtol=1e-6)
    # With other weights at the end, the flow of the Hamiltonian matrix gives the cost.
    weights = {"pin.angle": 3.0, "slide.displacement_rate": 2.0}
    ending = mb.lqr(plan, **COST, final=weights)
    np.testing.assert_allclose(ending.gains[0], constant.gains, rtol=1e-4)
    A, B, Q = np.asarray(about.A), np.asarray(about.B), np.diag([10.0, 100.0, 0.0, 1.0])
    hamiltonian = np.block([[A, -B @ B.T / 0.1], [-Q, -A.T]])
    for k in (-2, -4, -7):
        back = scipy.linalg.expm(hamiltonian * float(ending.ts[k] - ending.ts[-1]))
        right = back @ np.concatenate([np.eye(4), np.diag([0.0, 3.0, 2.0, 0.0])])
        np.testing.assert_allclose(ending.cost[k], right[4:] @ np.linalg.inv(right[:4]), rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_lqr_along_a_plan_refuses_names():
    plan, push = swing_up(), {"push.force": 1.0}
    for states, inputs, message in (
        ({"pin.angle": 1.0}, push, "must name 2 independent coordinates along a plan.*there are 1: pin.angle"),
        ({"pin.angle": 1.0, "slide.displacment": 1.0}, push, "Unknown coordinate 'slide.displacment'; did you mean"),
        ({"pin.angle": 1.0, "pole.angle": 1.0}, push, "pin.angle, pole.angle.* are not independent at t = 2 s"),
        (WEIGHTS, {"pull.force": 1.0}, "Unknown control 'pull.force'"),
    ):
        with pytest.raises(ValueError, match=message):
            mb.lqr(plan, states=states, inputs=inputs)
    with pytest.raises(ValueError, match=r"lqr: final: Unknown state 'pin\.rate'"):
        mb.lqr(plan, states=WEIGHTS, inputs=push, final={"pin.rate": 1.0})
