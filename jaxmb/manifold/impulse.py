"""The velocities after a jump of prescribed rates."""

from .._types import Scalar, State
from ..linalg.elimination import solve_positive
from ..system import AbstractSystem
from .orthogonal_projection import independent_rows


def after_impulse(system: AbstractSystem, t: Scalar, y: State) -> State:
    """The state just after a time at which prescribed rates jump: `M (u⁺ − u⁻) = Aᵀ Λ`, `ψ(t, q, u⁺) = 0`.

    Where no rate jumps the impulses Λ are zero. Constraints are taken as ideal.

    Source: L. A. Pars, "A Treatise on Analytical Dynamics", Heinemann, 1965 (impulsive motion).
    """
    u, inertia = y.u, system.inertia(t, y.q, y.u)
    for _ in range(1 if system.linear else 3):
        jacobian = system.velocity_jacobian(t, y.q, u)
        rows = independent_rows(jacobian, system.velocity_scale(), system.velocity_rank)
        per_impulse = inertia.solve(jacobian[rows].T)
        residual = system.velocity_residual(t, y.q, u)[rows]
        u = u - per_impulse @ solve_positive(jacobian[rows] @ per_impulse, residual)
    return State(y.q, u)
