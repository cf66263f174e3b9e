"""Rotations: Euler parameters (unit quaternions, scalar first), planar rotations, and norms that differentiate at zero.

Euler parameters are `p = (e0, e1, e2, e3)`, `e0 = cos(angle/2)`. `rotation_matrix(p)` maps body components to world
components. All formulas are the homogeneous ones (no division by `|p|`), so they are smooth everywhere; `p` and `-p` are
the same attitude. Angular velocities are in the body frame unless a name ends in `_W`.

Source: P. E. Nikravesh and I. S. Chung, "Application of Euler Parameters to the Dynamic Analysis of Three-Dimensional
Constrained Mechanical Systems", J. Mech. Design 104(4), 1982.
"""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float


def norm(x: Float[Array, "*b n"]) -> Float[Array, "*b"]:
    """Euclidean norm over the last axis, with derivative zero (not NaN) at the zero vector."""
    square = jnp.sum(x * x, axis=-1)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def rotation_2d(angle: Float[ArrayLike, ""]) -> Float[Array, "2 2"]:
    """Matrix from body to world components of a planar frame turned by `angle` [rad]."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])


def rotate_2d(angle: Float[ArrayLike, ""], v: Float[Array, "2"]) -> Float[Array, "2"]:
    """World components of the body vector `v` in a planar frame turned by `angle` [rad]."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * v[0] - s * v[1], s * v[0] + c * v[1]])


def rotation_matrix(p: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Matrix from body to world components, `(e0² − e·e) I + 2 e eᵀ + 2 e0 ẽ`."""
    return jnp.stack([rotate(p, axis) for axis in jnp.eye(3, dtype=p.dtype)], axis=-1)


def rotate(p: Float[Array, "4"], v: Float[Array, "3"]) -> Float[Array, "3"]:
    """World components of the body vector `v`."""
    e0, e = p[0], p[1:]
    return (e0 * e0 - jnp.dot(e, e)) * v + 2.0 * jnp.dot(e, v) * e + 2.0 * e0 * cross(e, v)


def unrotate(p: Float[Array, "4"], v_W: Float[Array, "3"]) -> Float[Array, "3"]:
    """Body components of the world vector `v_W`."""
    return rotate(conjugate(p), v_W)


def cross(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
    """Vector product."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def conjugate(p: Float[Array, "4"]) -> Float[Array, "4"]:
    """Euler parameters of the inverse rotation."""
    return jnp.concatenate([p[:1], -p[1:]])


def multiply(a: Float[Array, "4"], b: Float[Array, "4"]) -> Float[Array, "4"]:
    """Euler parameters of rotation `b` followed, in the world, by rotation `a`: R(a b) = R(a) R(b)."""
    scalar = a[0] * b[0] - jnp.dot(a[1:], b[1:])
    return jnp.concatenate([scalar[None], a[0] * b[1:] + b[0] * a[1:] + cross(a[1:], b[1:])])


def rates(p: Float[Array, "4"], omega: Float[Array, "3"]) -> Float[Array, "4"]:
    """`ṗ = ½ Lᵀ ω′` [1/s] for the angular velocity `omega` [rad/s] in the body frame."""
    e0, e = p[0], p[1:]
    return 0.5 * jnp.concatenate([-jnp.dot(e, omega)[None], e0 * omega + cross(e, omega)])


def pull_back(p: Float[Array, "4"], gradient: Float[Array, "4"]) -> Float[Array, "3"]:
    """`½ L g`: the body torque that does the work of the gradient `g` with respect to Euler parameters (adjoint of `rates`)."""
    e0, e = p[0], p[1:]
    return 0.5 * (e0 * gradient[1:] - gradient[0] * e - cross(e, gradient[1:]))


def angular_velocity(p: Float[Array, "4"], pdot: Float[Array, "4"]) -> Float[Array, "3"]:
    """`ω′ = 2 L ṗ` [rad/s], in the body frame."""
    return 4.0 * pull_back(p, pdot)


def normalize(p: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    """The nearest unit Euler parameters."""
    return p / norm(p)[..., None]


def from_axis_angle(axis: Float[ArrayLike, "3"], angle: Float[ArrayLike, ""]) -> Float[Array, "4"]:
    """Euler parameters of a turn by `angle` [rad] about the unit vector `axis`."""
    axis, half = jnp.asarray(axis, float), jnp.asarray(angle, float) / 2
    return jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis])


def from_matrix(R: Float[ArrayLike, "3 3"]) -> Float[Array, "4"]:
    """Euler parameters of a rotation matrix (body to world), with the best conditioned of the four formulas."""
    R = jnp.asarray(R, float)
    t = jnp.trace(R)
    squares = jnp.concatenate([(1.0 + t)[None], 1.0 + 2.0 * jnp.diag(R) - t])  # 4 e_k²
    antisymmetric = jnp.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    symmetric = R + R.T
    columns = jnp.zeros((4, 4), R.dtype)  # columns[k] = 4 e_k (e0, e1, e2, e3)
    columns = columns.at[0, 1:].set(antisymmetric).at[1:, 0].set(antisymmetric)
    columns = columns.at[1:, 1:].set(symmetric - jnp.diag(jnp.diag(symmetric)))
    columns = columns + jnp.diag(squares)
    k = jnp.argmax(squares)
    return normalize(columns[k])


def to_xyzw(p: Float[ArrayLike, "... 4"]) -> Float[Array, "... 4"]:
    """Scalar last, as SciPy, ROS and pinocchio write quaternions."""
    return jnp.roll(jnp.asarray(p), -1, axis=-1)


def from_xyzw(p: Float[ArrayLike, "... 4"]) -> Float[Array, "... 4"]:
    """Scalar first, from the order of SciPy, ROS and pinocchio."""
    return jnp.roll(jnp.asarray(p), 1, axis=-1)
