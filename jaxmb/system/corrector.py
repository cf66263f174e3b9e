"""Corrections of a state along `M⁻¹ Aᵀ`, joint by joint."""

import equinox as eqx
from jaxtyping import Array, Float

from .._types import Scalar, State
from ..linalg.block_tridiagonal import BlockFactor
from .chain import BlockJacobian, block_jacobian
from .equation import AbstractSystem
from .inertia import AbstractInertia


class Corrector(eqx.Module):
    """What moves a state along `M⁻¹ Aᵀ` by as much as rows ask for.

    **Fields:** `jacobian` A; the `metric` M; the `factor` of `A M⁻¹ Aᵀ`.
    """

    jacobian: BlockJacobian
    metric: AbstractInertia
    factor: BlockFactor

    def solve(self, of_rows: Float[Array, "m"]) -> Float[Array, "m"]:
        """Multipliers `(A M⁻¹ Aᵀ)⁻¹ x`."""
        return self.jacobian.ravel(self.factor.solve(self.jacobian.blocks(of_rows)))

    def along(self, multipliers: Float[Array, "m"]) -> Float[Array, "nu"]:
        """`M⁻¹ Aᵀ λ`."""
        return self.metric.solve(self.jacobian.transpose_product(multipliers))

    def remove(self, residual: Float[Array, "m"]) -> Float[Array, "nu"]:
        """The smallest displacement that changes the rows by `−residual`."""
        return -self.along(self.solve(residual))


def corrector(
    system: AbstractSystem, t: Scalar, y: State, metric: AbstractInertia, factor: BlockFactor | None = None
) -> Corrector:
    """The corrector at a state. `factor`: where there is one of the same value already."""
    jacobian = block_jacobian(system, t, y.q, y.u)
    gram = jacobian.gram(metric)
    return Corrector(jacobian, metric, gram.factor() if factor is None else factor.of(gram))
