"""Every part by itself, in the plane and in space: identities of what its kernel returns for random poses. And every
part in a scene: it compiles, moves on its constraints, has derivatives, finds its equilibrium, and is known when it
stands twice. Every method of integration gives the same motion. Gravity and a spring move it.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivative_checks import central_differences
from every_part import EXAMPLES, METHOD, METHODS, compiled
from exports import PARTS, missing
from part_cases import (
    DRIVEN,
    IN_THE_WORLD,
    JOINTS,
    POINTS,
    ROLLING,
    SPACES,
    driven,
    forces,
    joint,
    net_wrench,
    pairs,
    push,
    random_poses,
    rolling,
    rotated,
    springs,
)

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.parts import AbstractCompound, AbstractConstraint, AbstractVelocityConstraint, fields
from jaxmb.parts.base import AbstractInertialConstraint

MOST_PROGRAMS = 160

CONSTRAINTS = (AbstractConstraint, AbstractVelocityConstraint, AbstractCompound)
# Inertias of one coordinate add up.
CONSTRAINED = [
    name
    for name, example in EXAMPLES.items()
    if isinstance(example.part, CONSTRAINTS) and not isinstance(example.part, AbstractInertialConstraint)
]
AT_REST = [name for name, example in EXAMPLES.items() if example.rests and example.ideal]
T1 = 0.2


# Kernels: what parts return for poses and velocities of their bodies


def cases(*tables, slow=()):
    """Spaces with the names of their parts."""
    both = [(space, key) for table in tables for space in SPACES for key in table(space)]
    own = [(f"{space}: {key}", space, key) for space, key in both]
    return [pytest.param(space, key, id=name, marks=[pytest.mark.slow] * (name in slow)) for name, space, key in own]


of_joints = pytest.mark.parametrize("space, key", cases(JOINTS.get, slow=("spatial: Composite",)))
# The parts of both spaces share most of their code.
LONG = ("planar: PlateContact", "planar: Track", "spatial: Bushing", "spatial: Contact", "spatial: Tyre")
of = lambda table: pytest.mark.parametrize("space, key", cases(table, slow=LONG))


@of_joints
def test_joint_holds_along_admissible_motions(space, key):
    own = joint(space, key)
    part, rows = own.rows.part, own.case.rows
    assert part.rows == rows
    assert len(part.bodies) == own.case.bodies
    assert not part.rheonomic
    for poses in (own.poses, own.rows.moved):
        found = own.rows.residual(part, poses)
        assert found.shape == (rows,)
        np.testing.assert_allclose(found, 0.0, atol=1e-13)
    assert np.max(np.abs(own.rows.residual(part, own.rows.elsewhere))) > 1e-2


@of_joints
def test_joint_rank_and_freedoms(space, key):
    """Each of two bodies alone bears every row, so that the other may be the ground. What the rows leave free is what
    the motions use, all of it.
    """
    own, v = joint(space, key), SPACES[space].velocity_size
    jacobian, rows = own.rows.jacobian, own.case.rows
    rank = lambda matrix: np.linalg.matrix_rank(matrix, tol=1e-6)
    assert jacobian.shape == (rows, v * own.case.bodies)
    assert rank(jacobian) == rank(jacobian[:, :v]) == rank(jacobian[:, v : 2 * v]) == rows
    if own.freedoms:
        motions = central_differences(lambda x: own.motion(x).ravel(), own.x)
        assert rank(motions) == own.freedoms


@of_joints
def test_joint_reaction_has_no_net_wrench(space, key):
    own = joint(space, key)
    for row in own.rows.jacobian.reshape(-1, own.case.bodies, SPACES[space].velocity_size):
        np.testing.assert_allclose(net_wrench(own.rows.moved, row), 0.0, atol=1e-12)
        if key == "Distance":
            # Its multiplier is the force of the rod.
            np.testing.assert_allclose(np.linalg.norm(row[1, : SPACES[space].dimension]), 1.0, rtol=1e-12)


@of_joints
def test_joint_resolves_to_body_fixed_form(space, key):
    """Given again with the body-fixed numbers of the resolved part, at other poses, it is the same joint."""
    own = joint(space, key).rows
    part, poses = own.part, joint(space, key).poses
    given = {f.name: getattr(part, f.name) for f in dataclasses.fields(part) if f.init}
    assert all(given.get(name) is None for name in IN_THE_WORLD)
    again = type(part)(**given).resolve(own.space, own.elsewhere)
    moved = own.residual(again, own.moved), own.residual(part, own.moved)
    np.testing.assert_allclose(*moved, rtol=0, atol=1e-13)
    if space == "spatial" and key not in ("Distance", "InextensibleBeam"):
        ends = [
            own.space.point(q, np.asarray(point)) for q, point in zip(poses, (part.point_a, part.point_b), strict=True)
        ]
        np.testing.assert_allclose(*ends, rtol=0, atol=1e-13)


@pytest.mark.parametrize("space, key", cases(DRIVEN.get))
def test_driver_of_a_quantity(space, key):
    """Its row is the error of the quantity, and its reaction a pair of wrenches."""
    rows, poses, expected = driven(space, key)
    part = rows.part
    assert part.rheonomic
    np.testing.assert_allclose(part.measured(rows.space, poses), [expected], rtol=1e-13)
    np.testing.assert_allclose(part.residual(rows.space, poses, expected / 3.0), [0.0], rtol=0, atol=1e-14)
    (row,) = rows.jacobian
    assert np.max(np.abs(row)) > 0.1
    np.testing.assert_allclose(net_wrench(poses, row.reshape(2, -1)), 0.0, atol=1e-13)
    if key == "distance":
        # Its multiplier is the force along the line.
        d = rows.space.dimension
        np.testing.assert_allclose(np.linalg.norm(row.reshape(2, -1)[1, :d]), 1.0, rtol=1e-12)


ROWS = {
    "joint": lambda space, key: joint(space, key).rows,
    "driver": lambda space, key: driven(space, key)[0],
    "rolling": rolling,
}


@pytest.mark.parametrize(
    "kind, space, key",
    [
        pytest.param(kind, *case.values, id=f"{kind}, {case.id}", marks=case.marks)
        for kind, table in (("joint", JOINTS), ("driver", DRIVEN), ("rolling", ROLLING))
        for case in cases(table.get, slow=("spatial: Composite",))
    ],
)
def test_constraint_of_other_numbers(kind, space, key):
    """Derivatives along a change of all its numbers are differences; in a batch with another one it is itself."""
    own = ROWS[kind](space, key)
    np.testing.assert_allclose(own.slope, own.differences(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(own.value, own.residual(own.other, own.elsewhere), rtol=0, atol=1e-13)


@pytest.mark.slow("spatial: Beam")
@of(lambda space: springs(space, 0.0))
def test_spring_power_is_loss_of_energy(space, key):
    own = push(space, key)
    power = [np.sum(wrenches * own.velocities) for wrenches in (own.given, own.lossless)]
    energies, rates = own.energies
    assert np.all(np.asarray(energies) > 0)
    np.testing.assert_allclose(power[1], -rates[1], rtol=1e-12)
    assert power[0] + rates[0] < -1e-3


@of(pairs)
def test_force_has_an_equal_reaction(space, key):
    own = push(space, key)
    assert own.given.shape == (2, SPACES[space].velocity_size)
    assert np.max(np.abs(own.given)) > 0.1
    np.testing.assert_allclose(net_wrench(own.poses, own.given), 0.0, atol=1e-12)


@of(pairs)
def test_force_is_carried_along(space, key):
    """With all bodies, whose velocities turn with them: its components in their axes stay. The sign of Euler parameters
    does not matter.
    """
    own, d = push(space, key), SPACES[space].dimension
    forces = np.linalg.norm(np.stack([own.given, own.carried])[:, :, :d], axis=2)
    np.testing.assert_allclose(forces[1], forces[0], rtol=0, atol=1e-12)
    if "orque" not in key or key == "body Torque":
        np.testing.assert_allclose(own.carried[:, d:], own.given[:, d:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(own.same, own.given, rtol=0, atol=1e-13)


@of(forces)
def test_force_of_other_numbers(space, key):
    own = push(space, key)
    np.testing.assert_allclose(own.slope, own.difference, rtol=0, atol=1e-8)


@pytest.mark.parametrize("space", SPACES)
def test_damper_loses_by_the_speed_of_its_points(space):
    own, of = push(space, "Damper"), SPACES[space]
    ends = [
        of.point_velocity(q, v, np.array(point))
        for q, v, point in zip(own.poses, own.velocities, POINTS[of.dimension], strict=True)
    ]
    slip = np.asarray(ends[1]) - np.asarray(ends[0])
    np.testing.assert_allclose(np.sum(own.given * own.velocities), -2.0 * slip @ slip, rtol=1e-12)
    np.testing.assert_allclose(np.sum(own.given[:, : of.dimension], axis=0), 0.0, atol=1e-13)


@pytest.mark.parametrize("frame", ["", "body "])
@pytest.mark.parametrize("space", SPACES)
def test_point_force_acts_at_its_point(space, frame):
    """In world axes or in those of its body."""
    own, of = push(space, f"{frame}PointForce"), SPACES[space]
    force = np.arange(1.0, 1.0 + of.dimension)
    force = of.direction(own.poses[0], force) if frame else force
    velocity = of.point_velocity(own.poses[0], own.velocities[0], np.array(POINTS[of.dimension][0]))
    np.testing.assert_allclose(own.given[0, : of.dimension], force, rtol=1e-13)
    np.testing.assert_allclose(own.given[0] @ own.velocities[0], np.dot(force, velocity), rtol=1e-12)


def test_torque_acts_on_its_body_and_back():
    for key, moment in (("Torque", (1.0, 2.0, 3.0)), ("body Torque", (1.0, 2.0, 3.0))):
        own = push("spatial", key)
        found = own.given[1, 3:] if key == "body Torque" else rotated(own.poses[1, 3:], own.given[1, 3:])
        np.testing.assert_allclose(found, moment, rtol=1e-12)
    np.testing.assert_allclose(push("planar", "Torque").given, [[0.0, 0.0, -2.0], [0.0, 0.0, 2.0]], atol=1e-15)


@pytest.mark.parametrize("space", SPACES)
def test_springs_rest_at_the_given_poses(space):
    module, of = (planar if space == "planar" else spatial), SPACES[space]
    given = random_poses(np.random.default_rng(9), of)
    point, numbers = np.ones(of.dimension), np.arange(1.0, 1.0 + of.velocity_size)
    parts = [
        module.SpringDamper("F", "a", "b", stiffness=30.0),
        module.Bushing("F", "a", "b", stiffness=numbers, point=point),
    ]
    parts += [planar.TorsionalSpringDamper("F", "a", "b", stiffness=30.0)] if space == "planar" else []
    parts = [part.resolve(of, given) for part in parts]
    still = np.zeros((2, of.velocity_size))
    for wrenches in jax.jit(lambda q: [part.wrenches(of, q, still, 0.0) for part in parts])(given):
        np.testing.assert_allclose(wrenches, 0.0, atol=1e-13)


@pytest.mark.parametrize("free_length", [0.0, 0.5])
@pytest.mark.parametrize("space", [*SPACES])
def test_spring_of_zero_length(space, free_length):
    """It has no force, and the derivatives of one without a free length."""
    module, of = (planar if space == "planar" else spatial), SPACES[space]
    d, poses, velocities = of.dimension, np.stack([of.ground] * 2), np.ones((2, of.velocity_size))
    part = module.SpringDamper("F", "a", "b", stiffness=30.0, damping=2.0, free_length=free_length)
    part = part.resolve(of, poses)
    law = lambda q, v: (part.wrenches(of, q, v, 0.0),) * 2

    @jax.jit
    def seen(q, v):
        return jax.grad(lambda q: part.energy(of, q, 0.0))(q), jax.jacfwd(law, (0, 1), has_aux=True)(q, v)

    slope, ((by_pose, by_velocity), wrenches) = jax.tree.map(np.asarray, seen(poses, velocities))
    np.testing.assert_allclose(wrenches, 0.0, atol=1e-15)
    np.testing.assert_allclose(slope, 0.0, atol=1e-15)
    np.testing.assert_allclose(by_pose[1, :d, 1, :d], -30.0 * np.eye(d), rtol=0, atol=1e-13)
    np.testing.assert_allclose(by_velocity[1, :d, 1, :d], -2.0 * np.eye(d), rtol=0, atol=1e-13)


def test_every_part_has_a_case():
    """Friction, cylinders and elastic bodies stand in scenes alone."""
    for space, module in (("planar", planar), ("spatial", spatial)):
        bodies = (
            module.Body("a", mass=1.0, inertia=1.0 if space == "planar" else np.eye(3)),
            module.PointMass("b", mass=1.0),
        )
        # A tyre by the Magic Formula has a file of its own, too.
        others = ["Driver", "Friction", "Cylinder", "ElasticBar", "ElasticBody", "MagicFormulaTyre"]
        tables = JOINTS[space], ROLLING[space].values(), forces(space).values(), bodies, others
        assert not missing(module, PARTS, *tables)
        (known,) = (own.of for own in fields.declarations(module.Driver).values() if own.kind == "choice")
        assert {"angle", *DRIVEN["planar"], *DRIVEN["spatial"]} == set(known)


# Scenes


def in_groups(names, size=5):
    """Examples that stand side by side in one scene, of one dimension."""
    of_plane = lambda name: EXAMPLES[name].bodies[0].dimension == 2
    kinds = [[name for name in names if of_plane(name) == plane] for plane in (True, False)]
    groups = [own[k : k + size] for own in kinds for k in range(0, len(own), size)]
    return pytest.mark.parametrize("names", [pytest.param(own, id=own[0]) for own in groups])


def twin(part):
    return part.named(f"{part.name} twin")


@pytest.mark.slow(
    but=(
        "planar: Revolute",
        "planar: Prismatic",
        "planar: KnifeEdge",
        "functions: JointCoupling",
        "spatial: Universal",
        "spatial: Gimbal",
    )
)
@pytest.mark.parametrize("name", CONSTRAINED)
def test_a_part_that_stands_twice_is_named(name):
    """As many rows are implied as the part has, each by its twin."""
    part = EXAMPLES[name].part
    once, twice = compiled(EXAMPLES[name]), compiled(EXAMPLES[name], more=[twin(part)])
    names = {part.name, twin(part).name}
    assert len(twice.implied) == len([own for own, _ in once.rows if own == part.name])
    for item in twice.implied:
        assert item.name in names and names - {item.name} <= set(item.by)
    assert once.velocity_rank == twice.velocity_rank


# Bodies are given velocities that some of the constraints contradict.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The velocities given with the bodies")
@in_groups(CONSTRAINED)
def test_parts_that_stand_twice_move_as_once(names):
    """On their constraints; elastic parts would be twice as stiff."""
    ends, examples = [], [EXAMPLES[name] for name in names if not name.endswith("InextensibleBeam")]
    for more in ((), [twin(example.part) for example in examples]):
        system = compiled(*examples, more=more)
        end = jax.tree.map(lambda x: x[-1], mb.simulate(system, mb.assemble(system), t1=T1, rtol=1e-10, **METHOD).ys)
        broken = jax.jit(lambda q, u, of=system: (of.position_residual(T1, q), of.velocity_residual(T1, q, u)))
        for residual in broken(end.q, end.u):
            np.testing.assert_allclose(residual, 0.0, atol=1e-9)
        ends.append((end.q, end.u))
    # Coordinates of the twins themselves, such as angles of rope, are the last.
    for once, twice in zip(*ends, strict=True):
        np.testing.assert_allclose(twice[: once.size], once, rtol=0, atol=1e-8)


@pytest.mark.slow
@in_groups(AT_REST)
def test_equilibrium(names):
    """Nothing starts to move from it."""
    system = compiled(*(EXAMPLES[name] for name in names))
    state = mb.equilibrium(system)
    still = jnp.zeros(system.nu)
    udot, broken = jax.jit(
        lambda q: (accelerations(system.at(state), Multipliers(), 0.0, q, still)[0], system.position_residual(0.0, q))
    )(state.q)
    # In m/s² and rad/s², where weights accelerate by ten.
    np.testing.assert_allclose(udot, 0.0, atol=1e-8)
    np.testing.assert_allclose(broken, 0.0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_method_gives_the_same_motion(method):
    system = compiled(EXAMPLES["planar: Body" if method == "without constraints" else "planar: Revolute"])
    start = mb.assemble(system)
    ends = [mb.simulate(system, start, t1=T1, rtol=1e-10, **own).ys for own in (METHOD, METHODS[method])]
    np.testing.assert_allclose(ends[1].q, ends[0].q, rtol=0, atol=1e-8)
    np.testing.assert_allclose(ends[1].u, ends[0].u, rtol=0, atol=1e-7)
