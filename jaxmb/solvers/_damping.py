"""The choice of formulas that treat stiff components correctly, by the eigenvalues of the Jacobian.

Formulas that are not A-stable amplify lightly damped vibrations of stiff springs: an eigenvalue λ near the imaginary
axis with `|h λ|` of order one to ten. An error estimate detects such oscillations only when they are as large as the
tolerance, and then steps become as short as with an explicit method. The eigenvalues predict them.

If `h λ` is large, A-stable formulas damp components that should grow, and also the error estimates of these components.
The equation of such a step has several solutions, and Newton's method may find the wrong one.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float
from numpy.typing import NDArray

from .._compat import sequential_vmap
from ._formulas import FAMILIES
from .stability import boundary_locus, formula, spectral_radius

# Harmless growth in one step.
_GROWTH = 1.001
# Sizes of `h λ`, four to an octave. Useful formulas are stable in the left half-plane for smaller and larger sizes.
_PER_OCTAVE = 4
_SIZES = 2.0 ** np.arange(-7, 14, 1 / _PER_OCTAVE)
_THETA = np.geomspace(1e-3, np.pi, 4000)
# Eigenvalues within this distance to the right of the imaginary axis, relative to their size, are undamped vibrations
# with rounding errors. Further to the right the motion itself grows.
_RIGHT = 1e-3
# The power of e by which a component may grow in a step.
_FOLDS = 2.0


@functools.cache
def sectors(family: str) -> NDArray[np.float64]:
    """The angle from the negative real axis within which solutions do not grow; infinite for the whole left half-plane.

    Rows are the numbers of points k, from zero; columns are the sizes of `h λ`.
    """
    highest = FAMILIES[family].highest
    out = np.full((highest + 1, _SIZES.size), np.inf)
    for k in range(1, highest + 1):
        rule = formula(family, k)
        # Roots of this modulus lie on the boundary locus of the recurrence for the scaled solution.
        falling = _GROWTH ** -np.arange(len(rule.a), dtype=float)
        a, b, c = (tuple(np.array(x, float) * falling) for x in (rule.a, rule.b, rule.c))
        scaled = rule._replace(a=a, b=b, c=c)
        locus = boundary_locus(scaled, _THETA).ravel()
        locus = locus[np.isfinite(locus) & (locus.real < 0)]
        bins = np.round(np.log2(np.abs(locus) / _SIZES[0]) * _PER_OCTAVE).astype(int)
        for neighbour in (-1, 0, 1):
            inside = (bins + neighbour >= 0) & (bins + neighbour < _SIZES.size)
            angles = np.pi - np.abs(np.angle(locus[inside]))
            np.minimum.at(out[k], bins[inside] + neighbour, angles)
        out[k, spectral_radius(rule, -_SIZES) > _GROWTH] = 0.0
    return out


# Members of a batch are computed one after the other; see `jaxmb.linalg`.
@sequential_vmap
def _lapack_eigenvalues(matrix):
    return jnp.linalg.eigvals(matrix)


@jax.custom_jvp
def eigenvalues(matrix: Float[Array, "n n"]) -> Complex[Array, " n"]:
    """The eigenvalues of a matrix, without derivatives."""
    return _lapack_eigenvalues(matrix)


@eigenvalues.defjvp
def _eigenvalues_jvp(primals, tangents):
    out = eigenvalues(*primals)
    return out, jnp.zeros_like(out)


def are_damped(
    family: str, points: Any, steps: Float[Array, " formulas"], spectrum: Complex[Array, " n"]
) -> Bool[Array, " formulas"]:
    """Whether the formulas with these numbers of points, each with its step, amplify no decaying component."""
    dtype = steps.dtype
    sizes = jnp.abs(steps)[:, None] * jnp.abs(spectrum)[None]
    bins = jnp.round(jnp.log2(sizes / jnp.asarray(_SIZES[0], dtype)) * _PER_OCTAVE)
    bins = jnp.clip(bins, 0, _SIZES.size - 1).astype(jnp.int32)
    # Angles from the negative real axis; undamped vibrations are at a right angle.
    angle = jnp.abs(jnp.angle(-spectrum))
    limits = jnp.asarray(sectors(family), dtype)[jnp.asarray(points)[:, None], bins]
    grows = jnp.real(spectrum) > jnp.asarray(_RIGHT, dtype) * jnp.abs(spectrum)
    return jnp.all(grows[None] | (angle[None] <= limits), axis=1)


def is_resolved(step: Float[Array, ""], spectrum: Complex[Array, " n"]) -> Bool[Array, ""]:
    """Whether a step of this length follows growing components instead of damping them."""
    growth, size = jnp.real(spectrum), jnp.max(jnp.abs(spectrum))
    # Smaller values are rounding errors of the eigenvalue 0.
    grows = growth > jnp.asarray(jnp.finfo(growth.dtype).eps ** 0.5, growth.dtype) * size
    return jnp.all(~grows | (jnp.abs(step) * growth <= _FOLDS))
