"""Sparse elimination of joints against dense matrices: mechanisms of the library, bodies of many joints, and random
graphs with loops, redundant or not.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.bodies.independence import JointBlocks, JointRows
from jaxmb.bodies.joint_graph import joint_order
from jaxmb.bodies.layout import Layout
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.formulations.formulation import pivoted_jacobian
from jaxmb.linalg.graphs import components
from jaxmb.manifold import Partition
from jaxmb.parts.spatial.kinematics import SPACE


def by_blocks(system):
    """The system with sparse elimination of the independent rows, also where a dense matrix is faster."""
    rows = {row: k for k, row in enumerate(system.rows)}
    return dataclasses.replace(
        system, elimination=joint_order(system, tuple(sorted(rows[own.name, own.row] for own in system.implied)))
    )


def compare(system, q, u, *, atol=1e-10):
    """Accelerations, constraint forces and projections at a state, with sparse and dense matrices."""

    @jax.jit
    def evaluate(q, u):
        out = []
        for own in (by_blocks(system), system):
            udot, multipliers = accelerations(own, Multipliers(), 0.0, q, u)
            jacobian = own.structured_jacobian(0.0, q, u) if own.elimination else pivoted_jacobian(own, 0.0, q, u)
            projector = jacobian.projector(own.inertia(0.0, q, u))
            displacement = projector.cancel(jacobian.product(jnp.cos(jnp.arange(own.nu, dtype=float))))
            force = own.constraint_force(0.0, q, u, multipliers)
            out.append((udot, force, displacement, jacobian.product(u), jacobian.dense().matrix))
        return out

    for found, expected in zip(*evaluate(q, u), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=atol * (1.0 + np.max(np.abs(expected))))


SCENES = ["bricard", "double_wishbone", "flyball", "n_four_bar", "rolling_disc", "swash_plate", "tracked_vehicle"]


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_joint_order_of_mechanisms_of_the_library(name):
    mechanism = mb.mechanisms.get(name)
    system, rng = mechanism.system, np.random.default_rng(0)
    start = mechanism.state
    guess = mb.State(start.q + 0.01 * jnp.asarray(rng.normal(size=system.nq)), start.u)
    state = mb.assemble(system, guess)
    # The masses of the governor differ by 10⁶.
    compare(system, state.q, state.u, atol=1e-8 if name == "flyball" else 1e-10)


def star(branches, links, *, ground=False):
    """Chains of rods on pins at the rim of one body."""
    bodies = [planar.Body("hub", mass=3.0, inertia=2.0)]
    joints = [planar.Revolute("axle", "ground", "hub", point=(0.0, 0.0))] if ground else []
    for b in range(branches):
        angle = 2 * np.pi * b / branches + 0.1
        along = np.array([np.cos(angle), np.sin(angle)])
        for k in range(links):
            bodies.append(
                planar.Body(f"r{b}{k}", mass=1.0 + 0.1 * k, inertia=0.1, position=tuple((1.5 + k) * along), angle=angle)
            )
            above = f"r{b}{k - 1}" if k else "hub"
            joints.append(planar.Revolute(f"p{b}{k}", above, f"r{b}{k}", point=tuple((1.0 + k) * along)))
    return mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, -9.81))]).compile()


def two_stars():
    """Two bodies of many joints that a chain connects, in space, with a loop on one of them."""
    bodies, joints = [], []
    for side, x in (("left", 0.0), ("right", 4.0)):
        bodies.append(spatial.Body(side, mass=5.0, inertia=(1.0, 2.0, 3.0), position=(x, 0.0, 0.0)))
        for k in range(7):
            angle = 2 * np.pi * k / 7
            at = np.array([x, np.cos(angle), np.sin(angle)])
            name = f"{side}{k}"
            bodies.append(
                spatial.Body(name, mass=1.0, inertia=(0.1, 0.12, 0.15), position=tuple(1.5 * at - [x / 2, 0, 0]))
            )
            joints.append(spatial.Revolute(f"h{name}", side, name, point=tuple(at), axis=(1.0, 0.0, 0.0)))
    bodies.append(spatial.Body("between", mass=1.0, inertia=(0.1, 0.12, 0.15), position=(2.0, 0.0, 0.0)))
    joints += [
        spatial.Spherical("a", "left", "between", point=(1.0, 0.0, 0.0)),
        spatial.Spherical("b", "between", "right", point=(3.0, 0.0, 0.0)),
        spatial.Distance("tie", "left0", "left1"),
    ]
    return mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, 0.0, -9.81))]).compile()


@pytest.mark.slow
@pytest.mark.parametrize(("build", "hubs"), [(lambda: star(9, 2), 1), (two_stars, 2)])
def test_joint_order_of_bodies_of_many_joints(build, hubs):
    system = build()
    order = joint_order(system)
    assert order.hubs.size == hubs
    # No more blocks than the graph has edges: nothing couples all joints of a body with each other.
    assert order.nodes.blocks <= order.nodes.nodes + 2 * len(order.kept) + 10
    rng = np.random.default_rng(0)
    state = mb.assemble(system, mb.State(system.guess.q, jnp.asarray(rng.normal(size=system.nu))))
    compare(system, state.q, state.u)


def ladder(n=10):
    """Rectangles on hinges in space, side by side: each implies three of its own rows."""
    upright = {"mass": 1.0, "inertia": (0.1, 0.02, 0.11)}
    bodies, joints = [], []
    for k in range(n + 1):
        bodies.append(spatial.Body(f"upright{k}", position=(k, 0.0, 0.5), **upright))
        joints.append(spatial.Revolute(f"foot{k}", "ground", f"upright{k}", point=(k, 0.0, 0.0), axis=(0.0, 1.0, 0.0)))
    for k in range(n):
        bodies.append(spatial.Body(f"bar{k}", mass=1.0, inertia=(0.02, 0.1, 0.1), position=(k + 0.5, 0.0, 1.0)))
        for end in (k, k + 1):
            at = {"point": (end, 0.0, 1.0), "axis": (0.0, 1.0, 0.0)}
            joints.append(spatial.Revolute(f"pin{k}_{end}", f"bar{k}", f"upright{end}", **at))
    spring = spatial.SpringDamper("spring", "ground", "bar0", stiffness=50.0, damping=1.0, free_length=0.5)
    return mb.Scene(bodies, joints=joints, forces=[spring, mb.Gravity((0.0, 0.0, -9.81))]).compile()


def hanging_cable():
    """A cable in space."""
    return mb.mechanisms.get("cable", n=12).system


@pytest.mark.slow
@pytest.mark.parametrize(
    ("build", "varied", "implied"),
    [
        (lambda: star(8, 2, ground=True), {"r30.mass": 1.0, "p31.point_a": np.array([0.1, 0.0])}, 0),
        (ladder, {"bar3.mass": 1.0, "spring.stiffness": 20.0}, 30),
        (hanging_cable, {"rod3.mass": 0.1, "rod7.inertia": 1e-5 * np.eye(3)}, 0),
    ],
    ids=["star", "ladder", "cable"],
)
def test_joint_order_in_a_motion_and_its_derivatives(build, varied, implied):
    """A motion as by partitioning, with forward, reverse and central differences."""
    system = build()
    assert system.elimination is not None and system.velocity_rows - system.velocity_rank == implied
    state = mb.assemble(system, mb.State(system.guess.q, jnp.asarray(np.random.default_rng(0).normal(size=system.nu))))
    start = mb.parameters(system)

    def tip(h, manifold, rtol, **options):
        own = mb.with_parameters(system, {name: start[name] + h * step for name, step in varied.items()})
        at_start = mb.manifold.project(own, 0.0, state)
        y = mb.simulate(own, at_start, t1=0.5, rtol=rtol, atol=rtol, manifold=manifold, throw=False, **options).ys
        return jnp.sum(jnp.cos(y.q[-1])) + jnp.sum(y.u[-1]) * 0.1

    forward = jax.jit(lambda h, rtol: jax.jvp(lambda h: tip(h, None, rtol), (h,), (1.0,)))
    value, push = forward(0.0, 1e-10)
    np.testing.assert_allclose(value, jax.jit(lambda: tip(0.0, Partition(), 1e-10))(), rtol=0, atol=1e-7)
    np.testing.assert_allclose(jax.jit(jax.grad(lambda h: tip(h, None, 1e-10)))(0.0), push, rtol=1e-8)
    h = 1e-3
    at = lambda h: forward(h, 1e-12)[0]
    difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
    np.testing.assert_allclose(push, difference, rtol=1e-6)


# Random graphs


def random_parts(rng, bodies, loops):
    """A random tree of hinges in space with more hinges that close loops, as rows on velocities: the row of a hinge
    depends on the relative motion of its bodies alone.
    """
    ends = [(int(rng.integers(-1, k)) % (bodies + 1), k) for k in range(bodies)]
    ends += [tuple(rng.choice(bodies + 1, 2, replace=False).tolist()) for _ in range(loops)]
    position = np.append(rng.normal(size=(bodies, 3)), np.zeros((1, 3)), axis=0)
    parts, blocks, first = [], [], 0
    for own in ends:
        point, axis = rng.normal(size=3), rng.normal(size=3)
        across = np.linalg.svd(axis[None])[2][1:]
        rows = np.concatenate([np.hstack([np.eye(3), np.zeros((3, 3))]), np.hstack([np.zeros((2, 3)), across])])
        block = np.zeros((5, 2, 6))
        for side, (body, sign) in enumerate(zip(own, (-1.0, 1.0), strict=True)):
            # Velocity of a point of the body, and its angular velocity.
            x, y, z = point - position[body]
            lever = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
            block[:, side] = sign * rows @ np.block([[np.eye(3), lever], [np.zeros((3, 3)), np.eye(3)]])
            if body == bodies:
                block[:, side] *= np.nan
        parts.append(JointRows(own, first, 5))
        blocks.append(block)
        first += 5
    return parts, blocks


def test_ranks_of_random_graphs():
    """The sum of the ranks of components is that of the whole; kept rows are independent and imply the others. By
    sparse elimination, and by a dense one.
    """
    for seed in range(60):
        check_ranks(np.random.default_rng(seed))


def check_ranks(rng):
    bodies, loops = int(rng.integers(1, 12)), int(rng.integers(0, 4))
    parts, blocks = random_parts(rng, bodies, loops)
    layout = Layout(SPACE, (True,) * bodies)
    whole = np.zeros((5 * len(parts), 6 * bodies))
    for part, block in zip(parts, blocks, strict=True):
        for side, body in enumerate(part.bodies):
            if body < bodies:
                whole[part.first : part.first + 5, 6 * body : 6 * body + 6] += block[:, side]
    level = np.sort(rng.integers(0, 3, 5 * len(parts)))
    found, by_dense = (
        JointBlocks(parts, blocks, layout, np.ones(6 * bodies)).subsets(level, frozenset(), most) for most in (-1, 100)
    )
    for own, expected in zip(found, by_dense, strict=True):
        np.testing.assert_array_equal(np.bincount(level[own.kept]), np.bincount(level[expected.kept]))
    kept = np.concatenate([own.kept for own in found])
    rank = np.linalg.matrix_rank(whole, tol=1e-9)
    assert kept.size == rank == np.linalg.matrix_rank(whole[kept], tol=1e-9)
    assert sorted(np.concatenate([own.rows for own in found])) == list(range(5 * len(parts)))


def test_components_of_a_graph():
    """Two loops that share a body, one of them with the ground, and a bridge."""
    joints = [(6, 0), (0, 1), (1, 6), (1, 2), (2, 3), (3, 1), (3, 4), (5,)]
    found = {(own.joints, own.top) for own in components(joints, 6)}
    assert found == {((0, 1, 2), 6), ((3, 4, 5), 1), ((6,), 3), ((7,), 5)}


def random_scene(seed):
    """A tree of bodies on pins or hinges with loops: pins at random points that hold at the given poses."""
    rng = np.random.default_rng(seed)
    in_space = bool(seed % 2)
    n = int(rng.integers(3, 9))
    d = 3 if in_space else 2
    positions = rng.normal(size=(n, d))
    module = spatial if in_space else planar
    inertia = (0.3, 0.4, 0.5) if in_space else 0.3
    turned = [
        ({"orientation": (p := rng.normal(size=4)) / np.linalg.norm(p)} if in_space else {"angle": rng.normal()})
        for _ in range(n)
    ]
    bodies = [
        module.Body(f"b{k}", mass=rng.uniform(0.5, 2.0), inertia=inertia, position=positions[k], **turned[k])
        for k in range(n)
    ]
    name = lambda k: "ground" if k < 0 else f"b{k}"
    joints = []
    for k in range(n):
        above = int(rng.integers(-1, k)) if k else -1
        point = rng.normal(size=d)
        kinds = [spatial.Spherical, spatial.Revolute] if in_space else [planar.Revolute]
        kind = kinds[rng.integers(len(kinds))]
        axis = rng.normal(size=3)
        axes = {"axis": axis / np.linalg.norm(axis)} if kind is spatial.Revolute else {}
        joints.append(kind(f"j{k}", name(above), name(k), point=point, **axes))
    for k in range(int(rng.integers(0, 3))):
        a, b = rng.choice(n, 2, replace=False)
        joints.append(module.Distance(f"loop{k}", name(a), name(b), point_a=rng.normal(size=d)))
    if rng.random() < 0.4:
        # A rod that is there twice.
        joints.append(
            dataclasses.replace(joints[-1], name="twin")
            if joints[-1].name[0] == "l"
            else module.Distance("own", name(0), name(n - 1), point_a=rng.normal(size=d))
        )
    gravity = mb.Gravity((0.0, 0.0, -9.81) if in_space else (0.0, -9.81))
    return mb.Scene(bodies, joints=joints, forces=[gravity])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_joint_order_of_random_scenes(seed):
    system = random_scene(seed).compile()
    rng = np.random.default_rng(seed)
    guess = mb.State(system.guess.q, jnp.asarray(rng.normal(size=system.nu)))
    state = mb.assemble(system, guess)
    compare(system, state.q, state.u, atol=1e-9)
    own = by_blocks(system)
    y = mb.State(state.q + 1e-3 * jnp.asarray(rng.normal(size=system.nq)), state.u)
    y = jax.jit(lambda y: mb.manifold.project(own, 0.0, mb.State(own.normalize(0.0, y.q), y.u)))(y)
    assert np.max(np.abs(system.coordinate_residual(0.0, y.q))) <= 1e-12
    assert np.max(np.abs(system.velocity_residual(0.0, y.q, y.u))) <= 1e-11
