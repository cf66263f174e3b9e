"""Which formulas treat the stiff components of a problem as they should, by the eigenvalues of its Jacobian.

Formulas that are not A-stable make oscillations grow whose eigenvalue λ is near the imaginary axis, where `|h λ|` is of
order one to ten: lightly damped vibrations of stiff springs. An error estimate shows such oscillations only when they
are as large as the tolerance; then it keeps steps as short as those of an explicit method. The eigenvalues tell before.

The formulas that are A-stable make components small that should grow, where `h λ` is large, and error estimates with
them. The equation of such a step has other solutions than the near one, and what Newton's method found may be one.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float
from numpy.typing import NDArray

from ._formulas import FAMILIES
from .stability import boundary_locus, formula, spectral_radius

# Growth in a step that does no harm.
_GROWTH = 1.001
# Sizes of `h λ`, four to an octave. Formulas of use are stable in the left half-plane for smaller and for larger ones.
_PER_OCTAVE = 4
_SIZES = 2.0 ** np.arange(-7, 14, 1 / _PER_OCTAVE)
_THETA = np.geomspace(1e-3, np.pi, 4000)
# Eigenvalues this much to the right of the imaginary axis, as a part of their size, are on it: what rounding makes of
# undamped vibrations. Beyond, the motion itself grows.
_RIGHT = 1e-3
# By which power of e a component may grow in a step.
_FOLDS = 2.0


@functools.cache
def sectors(family: str) -> NDArray[np.float64]:
    """For each number of points k, from none on, and each of the sizes of `h λ`: within which angle of the negative
    real axis solutions do not grow; infinite where they do not in the whole left half-plane.
    """
    highest = FAMILIES[family].highest
    out = np.full((highest + 1, _SIZES.size), np.inf)
    for k in range(1, highest + 1):
        own = formula(family, k)
        # The locus of roots of this modulus is the boundary locus of the recurrence for the solution divided by it.
        falling = _GROWTH ** -np.arange(len(own.a), dtype=float)
        scaled = own._replace(**{name: tuple(np.array(getattr(own, name), float) * falling) for name in "abc"})
        locus = boundary_locus(scaled, _THETA).ravel()
        locus = locus[np.isfinite(locus) & (locus.real < 0)]
        bins = np.round(np.log2(np.abs(locus) / _SIZES[0]) * _PER_OCTAVE).astype(int)
        for neighbour in (-1, 0, 1):
            inside = (bins + neighbour >= 0) & (bins + neighbour < _SIZES.size)
            angles = np.pi - np.abs(np.angle(locus[inside]))
            np.minimum.at(out[k], bins[inside] + neighbour, angles)
        out[k, spectral_radius(own, -_SIZES) > _GROWTH] = 0.0
    return out


# One member of a batch after the other; see `jaxmb.linalg`.
@jax.custom_batching.sequential_vmap
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
    """Whether the formulas with these numbers of points, each with its step, let no component grow that should not."""
    dtype = steps.dtype
    sizes = jnp.abs(steps)[:, None] * jnp.abs(spectrum)[None]
    bins = jnp.round(jnp.log2(sizes / jnp.asarray(_SIZES[0], dtype)) * _PER_OCTAVE)
    bins = jnp.clip(bins, 0, _SIZES.size - 1).astype(jnp.int32)
    # From the negative real axis; undamped vibrations are at a right angle.
    angle = jnp.abs(jnp.angle(-spectrum))
    limits = jnp.asarray(sectors(family), dtype)[jnp.asarray(points)[:, None], bins]
    grows = jnp.real(spectrum) > jnp.asarray(_RIGHT, dtype) * jnp.abs(spectrum)
    return jnp.all(grows[None] | (angle[None] <= limits), axis=1)


def is_resolved(step: Float[Array, ""], spectrum: Complex[Array, " n"]) -> Bool[Array, ""]:
    """Whether what grows is followed by a step of this length, rather than damped."""
    growth, size = jnp.real(spectrum), jnp.max(jnp.abs(spectrum))
    # Less is what rounding makes of the eigenvalue 0.
    grows = growth > jnp.asarray(jnp.finfo(growth.dtype).eps ** 0.5, growth.dtype) * size
    return jnp.all(~grows | (jnp.abs(step) * growth <= _FOLDS))
