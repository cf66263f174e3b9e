"""Identities that every part satisfies, in the plane and in space."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from exports import PARTS, missing
from rough_machines import SCENES

from jaxmb.parts import fields

# A joint is given in one of these ways in the world, which `resolve` turns into numbers fixed in its bodies.
IN_THE_WORLD = ("point", "axes_W", "points_W", "axis", "axis_a_W", "axis_b_W", "axis_1_W", "axis_2_W", "axis_3_W")


def rank(matrix):
    return np.linalg.matrix_rank(np.asarray(matrix), tol=1e-6)


def perturbed(part, direction, s):
    return jtu.tree_map(lambda x, dx: x + s * dx, part, direction)


def check_parameter_derivatives(f, part, rng):
    """The derivative of `f(part)` along a random direction of all its numbers equals central differences."""
    direction = jtu.tree_map(lambda x: jnp.asarray(rng.normal(size=x.shape)), part)
    _, derivative = jax.jvp(f, (part,), (direction,))
    central = lambda h: (f(perturbed(part, direction, h)) - f(perturbed(part, direction, -h))) / (2 * h)
    difference = (4 * central(1e-4) - central(2e-4)) / 3
    scale = 1.0 + float(jnp.max(jnp.abs(difference)))
    np.testing.assert_allclose(derivative, difference, rtol=0, atol=1e-7 * scale)


def pose_rates(space, poses, velocities):
    return jnp.stack([space.rates(pose, velocity) for pose, velocity in zip(poses, velocities, strict=True)])


def velocity_jacobian(space, f, poses):
    """Derivative of `d/dt f(poses)` with respect to the velocities of all bodies, in the order of the bodies."""
    n, v = len(poses), space.velocity_size
    columns = np.eye(v * n).reshape(-1, n, v)
    return np.stack([jax.jvp(f, (poses,), (pose_rates(space, poses, u),))[1] for u in columns], axis=1)


@dataclasses.dataclass
class Case:
    """A joint that holds at given poses, and the motions of its bodies that it admits.

    `build(poses, *frame)`, with a random point and a random axis in the world; `motion(poses, *frame, x)` is a function
    of at least as many numbers as the joint leaves free.
    """

    rows: int
    build: Callable
    motion: Callable
    bodies: int = 2


@dataclasses.dataclass
class Setup:
    """A joint between bodies at random poses, at which it holds because it is given there.

    `moved` are poses after a large motion that the joint admits, and `elsewhere` poses at which it does not hold.
    """

    space: Any
    case: Case
    rng: np.random.Generator
    poses: Any
    part: Any
    motion: Callable
    x: Any
    freedoms: int
    moved: Any
    elsewhere: Any

    def residual(self, part, poses):
        return part.residual(self.space, poses, 0.0)

    def jacobian(self):
        return velocity_jacobian(self.space, lambda q: self.residual(self.part, q), self.moved)


def check_joint_holds(setup):
    part, rows = setup.part, setup.case.rows
    assert part.rows == rows
    assert len(part.bodies) == setup.case.bodies
    assert not part.rheonomic
    for poses in (setup.poses, setup.moved):
        assert setup.residual(part, poses).shape == (rows,)
        np.testing.assert_allclose(setup.residual(part, poses), 0.0, atol=1e-13)
    assert jnp.max(jnp.abs(setup.residual(part, setup.elsewhere))) > 1e-2


def check_joint_rank(setup):
    jacobian, rows, v = setup.jacobian(), setup.case.rows, setup.space.velocity_size
    assert jacobian.shape == (rows, v * setup.case.bodies)
    # Each of two bodies alone bears every row, so that the other may be the ground.
    assert rank(jacobian) == rank(jacobian[:, :v]) == rank(jacobian[:, v : 2 * v]) == rows
    # What the rows leave free is what the motions use, all of it.
    if setup.freedoms:
        motions = jax.jit(jax.jacfwd(setup.motion))(setup.x)
        assert rank(motions.reshape(-1, len(setup.x))) == setup.freedoms


def check_joint_reaction(setup, net_wrench):
    v = setup.space.velocity_size
    for row in setup.jacobian().reshape(-1, setup.case.bodies, v):
        np.testing.assert_allclose(net_wrench(setup.moved, row), 0.0, atol=1e-12)


def check_joint_resolves(setup):
    """Given again with the body-fixed numbers of the resolved part, at other poses, it is the same joint."""
    part = setup.part
    fields = {f.name: getattr(part, f.name) for f in dataclasses.fields(part) if f.init}
    assert all(fields.get(name) is None for name in IN_THE_WORLD)
    again = type(part)(**fields).resolve(setup.space, setup.elsewhere)
    expected = setup.residual(part, setup.moved)
    np.testing.assert_allclose(setup.residual(again, setup.moved), expected, rtol=0, atol=1e-13)


def check_joint_stacks(setup):
    other = perturbed(setup.part, jtu.tree_map(jnp.ones_like, setup.part), 0.1)
    stacked = jtu.tree_map(lambda *x: jnp.stack(x), setup.part, other)
    poses = jnp.stack([setup.poses, setup.elsewhere])
    batch = jax.jit(jax.vmap(setup.residual))(stacked, poses)
    for k, part in enumerate((setup.part, other)):
        np.testing.assert_allclose(batch[k], setup.residual(part, poses[k]), rtol=0, atol=1e-14)


def check_every_part_has_cases(module, quantities, *tables):
    """Every part that `planar` or `spatial` exports stands in these tables, or in a machine whose joints are rough."""
    # The cases of a driver are the quantities that it can drive.
    (known,) = (own.of for own in fields.declarations(module.Driver).values() if own.kind == "choice")
    assert set(quantities) == set(known)
    systems = [scene() for scene in SCENES.values()]
    dimension = module.Body("a", mass=1.0, inertia=1.0).dimension
    laws = [
        g.group.part for own in systems if own.layout.space.dimension == dimension for g in own.constraints.nonideal
    ]
    assert missing(module, PARTS, *tables, ["Driver"], laws) == set()
