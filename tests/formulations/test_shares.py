"""Shares of redundant rows: the least ones, smooth in time, named as open; forces that are determined stay."""

import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from derivative_checks import central_differences, in_both_modes

import jaxmb as mb
from jaxmb import planar, spatial, terrain
from jaxmb.formulations import Multipliers, accelerations


def linkage():
    """A four-bar of spatial hinges: of twenty rows three are implied."""
    body = lambda name, x, y: spatial.Body(name, mass=1.0, inertia=(0.1, 0.1, 0.1), position=(x, y, 0.0))
    hinge = lambda name, a, b, x, y: spatial.Revolute(name, a, b, point=(x, y, 0.0), axis=(0.0, 0.0, 1.0))
    joints = [
        hinge("A", "ground", "crank", 0, 0),
        hinge("B", "crank", "coupler", 0, 1),
        hinge("C", "coupler", "rocker", 2, 1),
        hinge("D", "ground", "rocker", 2, 0),
    ]
    load = mb.Force("load", "coupler", lambda x, v, t, p: jnp.array([0.0, 0.0, 30.0, 10.0, 20.0, 0.0]))
    bodies = [body("crank", 0, 0.5), body("coupler", 1, 1), body("rocker", 2, 0.5)]
    return mb.Scene(bodies, joints=joints, forces=[load]).compile()


LINKAGE = linkage()


@pytest.fixture(scope="module")
def motion():
    state = mb.assemble(LINKAGE, rates={"A.angle": 5.0})
    return mb.simulate(LINKAGE, state, t1=0.1, saveat=np.linspace(0.0, 0.1, 101))


def least(system, t, q, u):
    """The least multipliers, by a singular value decomposition, and their constraint force."""
    A = np.asarray(system.jacobian(t, q, u))
    sizes = np.linalg.norm(A * np.asarray(system.velocity_scale()), axis=1)
    force = A.T @ np.asarray(accelerations(system, Multipliers(), t, q, u)[1])
    return np.linalg.pinv((A / sizes[:, None]).T, rcond=1e-10) @ force / sizes, force


@pytest.mark.slow
def test_shares_are_least_and_smooth(motion):
    multipliers = np.asarray(motion.multipliers)
    for k in (0, 37, 100):
        q, u = motion.ys.q[k], motion.ys.u[k]
        expected, force = least(LINKAGE, motion.ts[k], q, u)
        np.testing.assert_allclose(multipliers[k], expected, atol=1e-10)
        np.testing.assert_allclose(LINKAGE.constraint_force(motion.ts[k], q, u, multipliers[k]), force, atol=1e-10)
    # A step is a third of a degree of the crank.
    assert np.max(np.abs(np.diff(multipliers, axis=0))) < 0.3
    assert motion.undetermined_reactions == ("A", "B", "C", "D")
    assert mb.loads(motion, "crank").undetermined == ("A", "B")


@pytest.mark.slow
def test_shares_do_not_depend_on_units_and_on_the_order_of_joints():
    """In millimetres and tonnes, with the joints from last to first, forces and moments are the same."""
    state = mb.assemble(LINKAGE, rates={"A.angle": 5.0})
    expected = mb.simulate(LINKAGE, state, t1=0.1).reactions

    def other(length, mass):
        force, moment = mass * length, mass * length**2
        body = lambda name, x, y: spatial.Body(
            name, mass=mass, inertia=(0.1 * moment,) * 3, position=(x * length, y * length, 0.0)
        )
        hinge = lambda name, a, b, x, y: spatial.Revolute(
            name, a, b, point=(x * length, y * length, 0.0), axis=(0.0, 0.0, 1.0)
        )
        joints = [
            hinge("D", "ground", "rocker", 2, 0),
            hinge("C", "coupler", "rocker", 2, 1),
            hinge("B", "crank", "coupler", 0, 1),
            hinge("A", "ground", "crank", 0, 0),
        ]
        wrench = np.array([0.0, 0.0, 30.0 * force, 10.0 * moment, 20.0 * moment, 0.0])
        load = mb.Force("load", "coupler", lambda x, v, t, p: jnp.asarray(wrench))
        bodies = [body("crank", 0, 0.5), body("coupler", 1, 1), body("rocker", 2, 0.5)]
        system = mb.Scene(bodies, joints=joints, forces=[load]).compile()
        reactions = mb.simulate(system, mb.assemble(system, rates={"A.angle": 5.0}), t1=0.1).reactions
        return {name: (reactions[name].force / force, reactions[name].moment / moment) for name in "ABCD"}

    for name, (force, moment) in other(1000.0, 1e-3).items():
        np.testing.assert_allclose(force, expected[name].force, atol=1e-6)
        np.testing.assert_allclose(moment, expected[name].moment, atol=1e-6)


def test_a_door_on_two_hinges():
    """Equal hinges share the weight equally; the couple of its moment is determined."""
    door = spatial.Body("door", mass=10.0, inertia=(1.0, 2.0, 1.0), position=(0.5, 0.0, 0.0))
    hinges = [
        spatial.Revolute(name, "ground", "door", point=(0.0, 0.0, z), axis=(0.0, 0.0, 1.0))
        for name, z in (("lower", -0.8), ("upper", 0.8))
    ]
    gravity = mb.Gravity((0.0, 0.0, -9.81))
    system = mb.Scene([door], joints=hinges, forces=[gravity]).compile()
    lower, upper = (mb.simulate(system, mb.assemble(system), t1=0.01).reactions[name] for name in ("lower", "upper"))
    np.testing.assert_allclose(lower.force[-1, 2], 49.05, rtol=1e-9)
    np.testing.assert_allclose(upper.force[-1, 2], 49.05, rtol=1e-9)
    np.testing.assert_allclose(lower.force[-1] + upper.force[-1], [0.0, 0.0, 98.1], atol=1e-9)


@pytest.mark.slow
def test_reactions_that_are_determined_stay():
    """A pendulum on one hinge beside the linkage, and the same pendulum alone."""
    bob = spatial.Body("bob", mass=2.0, inertia=(0.1, 0.1, 0.1), position=(5.5, 0.0, 0.0))
    pin = spatial.Revolute("pin", "ground", "bob", point=(5.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    body = lambda name, x, y: spatial.Body(name, mass=1.0, inertia=(0.1, 0.1, 0.1), position=(x, y, 0.0))
    hinge = lambda name, a, b, x, y: spatial.Revolute(name, a, b, point=(x, y, 0.0), axis=(0.0, 0.0, 1.0))
    joints = [hinge("A", "ground", "bar", 0, 0), hinge("B", "bar", "ground", 0, 0), pin]
    options = {"forces": [mb.Gravity((0.0, -9.81, 0.0))]}
    both = mb.Scene([body("bar", 0.5, 0), bob], joints=joints, **options).compile()
    alone = mb.Scene([bob], joints=[pin], **options).compile()
    ends = [mb.simulate(s, mb.assemble(s), t1=0.3, rtol=1e-11).reactions["pin"] for s in (both, alone)]
    np.testing.assert_allclose(ends[0].force, ends[1].force, atol=1e-8)
    np.testing.assert_allclose(ends[0].moment, ends[1].moment, atol=1e-8)


@pytest.mark.slow
def test_derivatives_of_shares():
    """By the mass of the coupler and the speed of the crank."""

    def loss(x, rtol):
        system = mb.with_parameters(LINKAGE, {"coupler.mass": x[0]})
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
    """Two equal stops; a third one is never reached."""
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


@pytest.mark.slow
def test_a_table_on_four_feet():
    """Three feet carry it, and the fourth follows; a table on three feet is determined."""
    table = spatial.Body("table", mass=4.0, inertia=(1.0, 1.0, 1.0), position=(0.0, 0.0, 1.0))
    places = {"a": (1, 1), "b": (-1, 1), "c": (-1, -1), "d": (1, -1)}
    foot = lambda name: mb.RigidContact(name, "table", centre=(*places[name], -1.0), terrain=terrain.Flat())
    for names in ("abcd", "abc"):
        feet = [foot(name) for name in names]
        system = mb.Scene([table], joints=feet, forces=[mb.Gravity((0.0, 0.0, -9.81))]).compile()
        motion = mb.simulate(system, mb.assemble(system), t1=0.1)
        assert motion.undetermined_reactions == (tuple(names) if names == "abcd" else ())
