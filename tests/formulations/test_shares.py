"""Shares of redundant rows: the least ones, smooth in time, named as open; forces that are determined stay."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from derivative_checks import central_differences, in_both_modes

import jaxmb as mb
from jaxmb import planar, spatial, terrain
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.formulations.shares import least_multipliers
from jaxmb.system.instant import Instant


def linkage(length=1.0, mass=1.0, names="ABCD"):
    """A four-bar of spatial hinges: of twenty rows three are implied."""
    force, moment = mass * length, mass * length**2
    body = lambda name, x, y: spatial.Body(
        name, mass=mass, inertia=(0.1 * moment,) * 3, position=(x * length, y * length, 0.0)
    )
    ends = {
        "A": ("ground", "crank", 0, 0),
        "B": ("crank", "coupler", 0, 1),
        "C": ("coupler", "rocker", 2, 1),
        "D": ("ground", "rocker", 2, 0),
    }
    hinge = lambda name, a, b, x, y: spatial.Revolute(
        name, a, b, point=(x * length, y * length, 0.0), axis=(0.0, 0.0, 1.0)
    )
    wrench = np.array([0.0, 0.0, 30.0 * force, 10.0 * moment, 20.0 * moment, 0.0])
    load = mb.Force("load", "coupler", lambda x, v, t, p: jnp.asarray(wrench))
    bodies = [body("crank", 0, 0.5), body("coupler", 1, 1), body("rocker", 2, 0.5)]
    return mb.Scene(bodies, joints=[hinge(name, *ends[name]) for name in names], forces=[load]).compile()


@pytest.fixture(scope="module")
def crank():
    return linkage()


def at_start(system, state):
    """A motion of one state."""
    ys = mb.State(*(np.asarray(x)[None] for x in (state.q, state.u)))
    return mb.Trajectory(system, Multipliers(), np.zeros(1), ys, {}, mb.RESULTS.successful, None, None)


def least(system, t, q, u, multipliers):
    """The least multipliers by a singular value decomposition, and their constraint force."""
    A = np.asarray(system.jacobian(t, q, u))
    sizes, force = np.linalg.norm(A * np.asarray(system.velocity_scale()), axis=1), A.T @ np.asarray(multipliers)
    return np.linalg.pinv((A / sizes[:, None]).T, rcond=1e-10) @ force / sizes, force


def test_shares_of_a_door_on_two_hinges():
    """Equal hinges share the weight equally; the couple of its moment is determined."""
    door = spatial.Body("door", mass=10.0, inertia=(1.0, 2.0, 1.0), position=(0.5, 0.0, 0.0))
    hinge = lambda name, z: spatial.Revolute(name, "ground", "door", point=(0.0, 0.0, z), axis=(0.0, 0.0, 1.0))
    hinges, gravity = [hinge("lower", -0.8), hinge("upper", 0.8)], mb.Gravity((0.0, 0.0, -9.81))
    system = mb.Scene([door], joints=hinges, forces=[gravity]).compile()
    q, u = (np.asarray(x) for x in (system.guess.q, system.guess.u))

    @jax.jit
    def solve(q, u):
        multipliers = accelerations(system, Multipliers(), 0.0, q, u)[1]
        at = Instant(system, jnp.zeros(()), q, u)
        return multipliers, least_multipliers(at, multipliers), at.jacobian

    multipliers, found, A = jax.device_get(solve(q, u))
    np.testing.assert_allclose(found, least(system, 0.0, q, u, multipliers)[0], atol=1e-10)
    lower, upper = A[:5].T @ found[:5], A[5:].T @ found[5:]
    np.testing.assert_allclose([lower[2], upper[2]], 49.05, rtol=1e-9)
    np.testing.assert_allclose(lower + upper, [0.0, 0.0, 98.1, 0.0, 0.0, 0.0], atol=1e-9)


@pytest.mark.slow
def test_shares_are_least_and_smooth(crank):
    state = mb.assemble(crank, rates={"A.angle": 5.0})
    motion = mb.simulate(crank, state, t1=0.1, saveat=np.linspace(0.0, 0.1, 101))
    multipliers = np.asarray(motion.multipliers)
    for k in (0, 37, 100):
        t, q, u = motion.ts[k], motion.ys.q[k], motion.ys.u[k]
        expected, force = least(crank, t, q, u, accelerations(crank, Multipliers(), t, q, u)[1])
        np.testing.assert_allclose(multipliers[k], expected, atol=1e-10)
        np.testing.assert_allclose(crank.constraint_force(t, q, u, multipliers[k]), force, atol=1e-10)
    # A step is a third of a degree of the crank.
    assert np.max(np.abs(np.diff(multipliers, axis=0))) < 0.3
    assert motion.undetermined_reactions == ("A", "B", "C", "D")
    assert mb.loads(motion, "crank").undetermined == ("A", "B")


@pytest.mark.slow
def test_shares_do_not_depend_on_units_and_on_the_order_of_joints(crank):
    """In millimetres and tonnes, with the joints from last to first, forces and moments are the same."""
    expected = at_start(crank, mb.assemble(crank, rates={"A.angle": 5.0})).reactions
    other = linkage(1000.0, 1e-3, "DCBA")
    found = at_start(other, mb.assemble(other, rates={"A.angle": 5.0})).reactions
    for name in "ABCD":
        np.testing.assert_allclose(found[name].force, expected[name].force, atol=1e-6)
        np.testing.assert_allclose(found[name].moment / 1000.0, expected[name].moment, atol=1e-6)


@pytest.mark.slow
def test_derivatives_of_shares(crank):
    """By the mass of the coupler and the speed of the crank."""

    def loss(x, rtol):
        system = mb.with_parameters(crank, {"coupler.mass": x[0]})
        state = mb.assemble(system, rates={"A.angle": x[1]})
        motion = mb.simulate(system, state, t1=0.1, saveat=np.linspace(0.0, 0.1, 5), rtol=rtol)
        forces = motion.reactions["C"].force @ jnp.array([1.0, 2.0, 3.0])
        return jnp.sum(motion.reactions["A"].moment[1:] ** 2) + jnp.sum(forces)

    x = jnp.array([1.0, 5.0])
    value, derivative = in_both_modes(lambda x: loss(x, 1e-10)[None], x)
    tight = jit_quickly(lambda x: loss(x, 1e-12)[None])
    np.testing.assert_allclose(value, tight(x), rtol=1e-8)
    np.testing.assert_allclose(derivative, central_differences(tight, x), rtol=1e-6)


@pytest.mark.slow
def test_contacts_that_share_are_named():
    """Of two equal stops, of which a third one is never reached; and of a table on four feet, not on three."""
    body = planar.Body("body", mass=2.0, inertia=0.1, position=(0.5, 0.0))
    slide = planar.Prismatic("slide", "ground", "body", point=(0.0, 0.0), axis=(1.0, 0.0))
    stops = [mb.Stop(name, "slide.displacement", upper=x) for name, x in (("one", 0.5), ("two", 0.5), ("far", 2.0))]
    push = planar.PointForce("push", "body", force=(3.0, 0.0))
    system = mb.Scene([body], joints=[slide, *stops], forces=[push]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=1.5)
    assert mb.loads(motion, "body").undetermined == ("one", "two")
    total = sum(motion.reactions[name].multipliers[-1, 0] for name in ("one", "two"))
    np.testing.assert_allclose(abs(total), 3.0, rtol=1e-9)
    assert mb.loads(mb.simulate(system, mb.assemble(system), t1=0.1), "body").undetermined == ()
    table = spatial.Body("table", mass=4.0, inertia=(1.0, 1.0, 1.0), position=(0.0, 0.0, 1.0))
    places = {"a": (1, 1), "b": (-1, 1), "c": (-1, -1), "d": (1, -1)}
    foot = lambda name: mb.RigidContact(name, "table", centre=(*places[name], -1.0), terrain=terrain.Flat())
    for names in ("abcd", "abc"):
        gravity = mb.Gravity((0.0, 0.0, -9.81))
        system = mb.Scene([table], joints=[foot(name) for name in names], forces=[gravity]).compile()
        motion = mb.simulate(system, mb.assemble(system), t1=0.1)
        assert motion.undetermined_reactions == (tuple(names) if names == "abcd" else ())
