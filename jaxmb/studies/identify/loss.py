"""Loss functions of residuals: the square, or less for large residuals.

A fit minimises `½ Σ ρ(r²)` of the residuals r, which are in units of the standard deviation σ of the noise. The names
and the functions ρ are as in `scipy.optimize.least_squares`.

Source: B. Triggs, P. F. McLauchlan, R. I. Hartley and A. W. Fitzgibbon, "Bundle Adjustment — A Modern Synthesis", in:
Vision Algorithms: Theory and Practice, Springer 2000; P. J. Huber, "Robust Statistics", Wiley 1981, chapter 7.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# The least fraction of a residual's weight that replaces its second derivative. The exact derivative vanishes beyond σ
# for Huber's loss, and without it steps would have no length if all residuals are large.
_LEAST_CURVATURE = 0.1


class Loss(NamedTuple):
    """A loss ρ of squared residuals.

    **Fields:** `name`; `rho`, for JAX; its first and second derivative `slope` and `curvature`, for NumPy.
    """

    name: str
    rho: Callable[[Array], Array]
    slope: Callable[[np.ndarray], np.ndarray]
    curvature: Callable[[np.ndarray], np.ndarray]

    @property
    def robust(self) -> bool:
        """Whether large residuals weigh less than their squares."""
        return self.name != "linear"

    def weighted(
        self, residuals: Float[np.ndarray, "rows"], jacobian: Float[np.ndarray, "rows n"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Residuals and Jacobian such that `Jᵀ r` is the gradient and `Jᵀ J` approximates the second derivatives."""
        if not self.robust:
            return residuals, jacobian
        # After a failed simulation, residuals are infinite, and their objective rejects them.
        with np.errstate(invalid="ignore", divide="ignore"):
            slope = self.slope(residuals**2)
            size = np.sqrt(np.maximum(self.influence(residuals)[1], _LEAST_CURVATURE * slope))
            return slope / size * residuals, size[:, None] * jacobian

    def influence(self, residuals: Float[np.ndarray, "rows"]) -> tuple[np.ndarray, np.ndarray]:
        """`ψ = r ρ'(r²)`, the influence of each residual on the estimates, and its derivative."""
        squares = residuals**2
        slope = self.slope(squares)
        return residuals * slope, slope + 2 * squares * self.curvature(squares)


def _huber(squares):
    large = squares > 1
    return jnp.where(large, 2 * jnp.sqrt(jnp.where(large, squares, jnp.ones_like(squares))) - 1, squares)


def _soft_l1(squares):
    # `2 (√(1 + z) − 1)`, without cancellation at small z.
    return 2 * squares / (1 + jnp.sqrt(1 + squares))


LOSSES = {
    loss.name: loss
    for loss in (
        Loss("linear", lambda z: z, np.ones_like, np.zeros_like),
        Loss("soft_l1", _soft_l1, lambda z: (1 + z) ** -0.5, lambda z: -0.5 * (1 + z) ** -1.5),
        Loss(
            "huber",
            _huber,
            lambda z: np.maximum(z, 1.0) ** -0.5,
            lambda z: np.where(z > 1, -0.5 * np.maximum(z, 1.0) ** -1.5, 0.0),
        ),
    )
}


def loss_named(name: str) -> Loss:
    """The loss of a name, or a `ValueError`."""
    if name not in LOSSES:
        raise ValueError(f"loss must be one of {', '.join(map(repr, LOSSES))}, got {name!r}.")
    return LOSSES[name]
