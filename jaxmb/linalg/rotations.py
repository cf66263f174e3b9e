"""Rotations: Euler parameters (unit quaternions, scalar first), planar rotations, and norms that differentiate at zero.

```python
from jaxmb import rotations
p = rotations.from_axis_angle((0.0, 0.0, 1.0), np.pi / 2)  # A quarter turn about z.
q = rotations.multiply(rotations.from_axis_angle((1.0, 0.0, 0.0), 0.3), p)  # The second turn stands on the left.
R, x = rotations.rotation_matrix(p), jnp.array([1.0, 0.0, 0.0])
rotations.rotate(p, x), R @ x  # To world components, both (0, 1, 0).
rotations.unrotate(p, x), rotations.rotate(rotations.conjugate(p), x)  # Both (0, -1, 0).
rotations.from_matrix(R), rotations.from_xyzw(rotations.to_xyzw(p))  # Both p.
omega = jnp.array([0.0, 0.0, 2.0])
rotations.angular_velocity(p, rotations.rates(p, omega))  # omega.
rotations.norm(rotations.cross(x, omega))  # 2.
rotations.rotation_vector(p)  # (0, 0, π/2).
```

Euler parameters are `p = (e0, e1, e2, e3)`, `e0 = cos(angle/2)`. `rotation_matrix(p)` maps body components to world
components. All formulas are the homogeneous ones (no division by `|p|`), so they are smooth everywhere; `p` and `-p`
are the same attitude. Angular velocities are in the body frame unless a name ends in `_W`. NumPy in, NumPy out.

Source: P. E. Nikravesh and I. S. Chung, "Application of Euler Parameters to the Dynamic Analysis of Three-Dimensional
Constrained Mechanical Systems", J. Mech. Design 104(4), 1982.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._types import Scalar, VectorLike
from .arrays import add_up, as_array, is_traced, namespace
from .bilinear import BilinearMap
from .blocks import matrix_products

__all__ = [
    "angular_velocity",
    "conjugate",
    "cross",
    "from_axis_angle",
    "from_matrix",
    "from_xyzw",
    "multiply",
    "norm",
    "rates",
    "rotate",
    "rotation_matrix",
    "rotation_vector",
    "to_xyzw",
    "unrotate",
]


# Of the arc tangent below this square: its series has converged, and its formula has not lost digits.
_SMALL = 0.05
_SERIES = [(-1) ** k / (2 * k + 1) for k in range(13)]


def _tables():
    epsilon = np.zeros((3, 3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        epsilon[i, j, k], epsilon[i, k, j] = 1.0, -1.0
    product = np.zeros((4, 4, 4))  # (a b)_i = product[i, j, k] a_j b_k
    product[0, 0, 0] = 1.0
    product[0, 1:, 1:] = -np.eye(3)
    product[1:, 0, 1:] = product[1:, 1:, 0] = np.eye(3)
    product[1:, 1:, 1:] = epsilon
    conjugate = np.array([1.0, -1.0, -1.0, -1.0])
    # R v is the vector part of p v p*, quadratic in p.
    rotation = np.einsum("iam,akj,m->ijkm", product[1:], product[:, :, 1:], conjugate)
    rotation = np.triu(rotation) + np.triu(rotation.swapaxes(2, 3), 1)
    return epsilon, product, conjugate, rotation, 0.5 * product[:, :, 1:]


_EPSILON, _PRODUCT, _CONJUGATE, _OF_MATRIX, _OF_RATES = _tables()
_CROSS, _MULTIPLY, _RATES = map(BilinearMap.of, (_EPSILON, _PRODUCT, _OF_RATES))
_PULL_BACK = _RATES.transpose(2, 1, 0)
_ROTATION = BilinearMap.of(_OF_MATRIX.reshape(9, 4, 4))
_POLAR = BilinearMap.of(0.5 * (_ROTATION.table + _ROTATION.table.swapaxes(1, 2)))


def norm(x: Float[Array, "*b n"]) -> Float[Array, "*b"]:
    """Euclidean norm over the last axis, with derivative zero (not NaN) at the zero vector."""
    xp = namespace(x)
    square = add_up([x[..., k] ** 2 for k in range(x.shape[-1])]) if x.shape[-1] <= 4 else (x * x).sum(axis=-1)
    positive = square > 0
    return xp.where(positive, xp.sqrt(xp.where(positive, square, 1.0)), 0.0)


def rotate_2d(angle: Float[ArrayLike, ""], v: Float[Array, "2"]) -> Float[Array, "2"]:
    """World components of the body vector `v` in a planar frame turned by `angle` [rad]."""
    xp = namespace(angle, v)
    c, s = xp.cos(angle), xp.sin(angle)
    return xp.stack([c * v[0] - s * v[1], s * v[0] + c * v[1]])


def rotation_matrix(p: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Matrix from body to world components, `(e0² − e·e) I + 2 e eᵀ + 2 e0 ẽ`."""
    return (_ROTATION(p, p) if namespace(p) is np else _square(p)).reshape(3, 3)


@jax.custom_jvp
def _square(p):
    """The nine entries of the matrix, a quadratic form: its derivative is one product, not two."""
    return _ROTATION(p, p)


@_square.defjvp
def _square_jvp(primals, tangents):
    (p,), (dp,) = primals, tangents
    return _square(p), _POLAR(2.0 * p, dp)


def rotate(p: Float[Array, "4"], v: Float[Array, "3"]) -> Float[Array, "3"]:
    """World components of the body vector `v`."""
    return turned(rotation_matrix(p), v)


def unrotate(p: Float[Array, "4"], v_W: Float[Array, "3"]) -> Float[Array, "3"]:
    """Body components of the world vector `v_W`."""
    return turned_back(rotation_matrix(p), v_W)


def turned(matrix: Float[Array, "3 3"], v: Float[Array, "3"]) -> Float[Array, "3"]:
    """World components of the body vector `v`, by the rotation matrix."""
    return matrix_products(matrix, v[:, None])[:, 0]


def turned_back(matrix: Float[Array, "3 3"], v_W: Float[Array, "3"]) -> Float[Array, "3"]:
    """Body components of the world vector `v_W`, by the rotation matrix."""
    return matrix_products(v_W[None], matrix)[0]


def cross(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
    """Vector product."""
    return _CROSS(a, b)


def dot(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, ""]:
    """Scalar product, as a sum that XLA fuses with its terms."""
    return (a * b).sum()


def conjugate(p: Float[Array, "4"]) -> Float[Array, "4"]:
    """Euler parameters of the inverse rotation."""
    return p * _CONJUGATE.astype(p.dtype, copy=False)


def multiply(a: Float[Array, "4"], b: Float[Array, "4"]) -> Float[Array, "4"]:
    """Euler parameters of rotation `b` followed, in the world, by rotation `a`: R(a b) = R(a) R(b)."""
    return _MULTIPLY(a, b)


def rates(p: Float[Array, "4"], omega: Float[Array, "3"]) -> Float[Array, "4"]:
    """`ṗ = ½ Lᵀ ω′` [1/s] for the angular velocity `omega` [rad/s] in the body frame."""
    return _RATES(p, omega)


def pull_back(p: Float[Array, "4"], gradient: Float[Array, "4"]) -> Float[Array, "3"]:
    """`½ L g`: the body torque that does the work of the gradient `g` with respect to Euler parameters.

    This is the adjoint of `rates`.
    """
    return _PULL_BACK(p, gradient)


def matrix_rates(R: Float[Array, "3 3"], omega: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """`Ṙ = R ω̃′` [1/s] for the angular velocity `omega` [rad/s] in the body frame."""
    xp = namespace(R, omega)
    return _CROSS(R, xp.broadcast_to(omega, R.shape))


def pull_back_matrix(R: Float[Array, "3 3"], gradient: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The body torque that does the work of the gradient with respect to a rotation matrix.

    This is the adjoint of `matrix_rates`.
    """
    of_rows = _CROSS(gradient, R)
    return of_rows[0] + of_rows[1] + of_rows[2]


def angular_velocity(p: Float[Array, "4"], pdot: Float[Array, "4"]) -> Float[Array, "3"]:
    """`ω′ = 2 L ṗ` [rad/s], in the body frame."""
    return 4.0 * pull_back(p, pdot)


def normalize(p: Float[Array, "... n"]) -> Float[Array, "... n"]:
    """The vector of length one in the same direction; of Euler parameters, the nearest unit ones."""
    return p / norm(p)[..., None]


def from_axis_angle(axis: VectorLike, angle: Scalar) -> Float[Array, "4"]:
    """Unit Euler parameters of a turn by `angle` [rad] about the vector `axis` of any length but zero.

    **Raises:** `ValueError` for the zero vector; under a trace the result is NaN.
    """
    dtype = jnp.result_type(float)
    way, half = as_array(axis, dtype), as_array(angle, dtype) / 2
    xp = namespace(way, half)
    if not is_traced(way) and not np.any(way):
        raise ValueError("from_axis_angle: the axis is the zero vector, which has no direction.")
    return jax.device_put(xp.concatenate([xp.cos(half)[None], xp.sin(half) * normalize(way)]))


def from_matrix(R: Float[ArrayLike, "3 3"]) -> Float[Array, "4"]:
    """Euler parameters of a rotation matrix (body to world), with the best conditioned of the four formulas."""
    matrix: Any = as_array(R, jnp.result_type(float))
    xp, t = namespace(matrix), matrix.trace()
    squares = xp.concatenate([(1.0 + t)[None], 1.0 + 2.0 * xp.diag(matrix) - t])  # 4 e_k²
    difference = matrix - matrix.T
    antisymmetric = xp.stack([difference[2, 1], difference[0, 2], difference[1, 0]])
    symmetric = matrix + matrix.T
    symmetric = symmetric + xp.diag(squares[1:] - xp.diag(symmetric))
    # columns[k] = 4 e_k (e0, e1, e2, e3)
    columns = xp.concatenate([antisymmetric[:, None], symmetric], axis=1)
    columns = xp.concatenate([xp.concatenate([squares[:1], antisymmetric])[None], columns])
    return jax.device_put(normalize(columns[xp.argmax(squares)]))


def half_turn(p: Float[Array, "4"]) -> Float[Array, "4"]:
    """Unit Euler parameters of half the shortest turn, smooth below half a turn."""
    xp = namespace(p)
    near, length = xp.where(p[0] < 0, -p, p), norm(p)
    # The length of the numerator, by its square.
    return (near + length * np.eye(4, dtype=p.dtype)[0]) / xp.sqrt(2.0 * length * (length + near[0]))


def rotation_vector(p: Float[Array, "4"]) -> Float[Array, "3"]:
    """The rotation vector [rad] of the shortest turn, the inverse of `from_axis_angle`.

    It is smooth below half a turn, where it changes its sign. Derivatives of any order are also correct at zero.
    """
    return doubled(half_turn(p))


def doubled(half: Float[Array, "4"]) -> Float[Array, "3"]:
    """The rotation vector [rad] of twice a turn, below a quarter turn."""
    tangent = half[1:] / half[0]
    return 4.0 * _arc_tangent_ratio(dot(tangent, tangent)) * tangent


def _arc_tangent_ratio(square):
    """`arctan(x) / x`, a smooth function of `x²` in [0, 1]."""
    xp = namespace(square)
    small = square < _SMALL
    root, near = xp.sqrt(xp.where(small, 1.0, square)), xp.where(small, square, 0.0)
    series = functools.reduce(lambda total, term: total * near + term, reversed(_SERIES), 0.0)
    return xp.where(small, series, xp.arctan(root) / root)


def to_xyzw(p: Float[ArrayLike, "... 4"]) -> Float[Array, "... 4"]:
    """Scalar last, as SciPy, ROS and pinocchio write quaternions."""
    return jnp.roll(jnp.asarray(p), -1, axis=-1)


def from_xyzw(p: Float[ArrayLike, "... 4"]) -> Float[Array, "... 4"]:
    """Scalar first, from the order of SciPy, ROS and pinocchio."""
    return jnp.roll(jnp.asarray(p), 1, axis=-1)
