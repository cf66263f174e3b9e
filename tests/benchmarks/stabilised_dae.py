"""A peer to compare with: implicit BDF on the stabilised equations of index 2, by SUNDIALS' IDA.

All coordinates, velocities and multipliers are unknowns, with constraints between positions and between velocities:

    q̇ = u + Φ_qᵀ μ,   M u̇ = F + Φ_qᵀ λ,   Φ = 0,   Φ_q u + Φ_t = 0

Source: C. W. Gear, B. Leimkuhler and G. K. Gupta, "Automatic integration of Euler–Lagrange equations with constraints",
J. Comput. Appl. Math. 12&13, 1985. IDA is called through `scikit-sundae`, with residual and Jacobian compiled by JAX
and called back from Python, some microseconds each.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmb import State
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.system import AbstractSystem

# Absolute tolerance of the multipliers, which follow from the other unknowns and need no error control.
_LOOSE = 1e8


class DaeRun(NamedTuple):
    """The state at the end, or None if the run failed; calls of the residual and of its Jacobian; accepted steps."""

    end: State | None
    evaluations: int
    matrices: int
    steps: int


def applies_to(system: AbstractSystem) -> bool:
    """Whether these equations hold for the system: q̇ = u, holonomic constraints, no redundant rows."""
    holonomic = 0 < system.position_rows == system.acceleration_rows == system.position_rank
    return system.rates_are_velocities and system.ideal and holonomic


def stabilised_dae(system: AbstractSystem, state: State, t1: float) -> Callable[[float], DaeRun]:
    """Runs of IDA from 0 to t1 as a function of rtol.

    **Raises:** `ImportError` if scikit-sundae is not installed.
    """
    try:
        from sksundae.ida import IDA  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError("The comparison with IDA needs scikit-sundae: pip install scikit-sundae") from error
    n, m = system.nu, system.position_rows
    counts = {"residual": 0, "jacobian": 0}

    def equations(t, y, rates):
        q, u, multipliers, stabilisers = jnp.split(y, (n, 2 * n, 2 * n + m))
        force = system.force(t, q, u) + system.constraint_force(t, q, u, multipliers)
        return jnp.concatenate(
            [
                rates[:n] - u - system.constraint_force(t, q, u, stabilisers),
                system.inertia(t, q, u).product(rates[n : 2 * n]) - force,
                system.position_residual(t, q),
                system.velocity_residual(t, q, u),
            ]
        )

    residual = jax.jit(equations)

    @jax.jit
    def matrix(t, y, rates, c):
        by_y, by_rates = jax.jacfwd(equations, (1, 2))(t, y, rates)
        return by_y + c * by_rates

    def residual_of(t, y, rates, out):
        counts["residual"] += 1
        out[:] = residual(t, y, rates)

    def jacobian_of(t, y, rates, own, c, out):
        del own
        counts["jacobian"] += 1
        out[:] = matrix(t, y, rates, c)

    udot, multipliers = accelerations(system, Multipliers(), 0.0, state.q, state.u)
    zeros = np.zeros(m)
    start = np.concatenate([state.q, state.u, multipliers, zeros])
    rates = np.concatenate([state.u, udot, zeros, zeros])

    def run(rtol: float) -> DaeRun:
        counts.update(residual=0, jacobian=0)
        atol = np.concatenate([np.full(2 * n, rtol / 100), np.full(2 * m, _LOOSE)])
        options: dict[str, Any] = {"algebraic_idx": list(range(2 * n, 2 * n + 2 * m)), "max_num_steps": 1_000_000}
        solver = IDA(residual_of, rtol=rtol, atol=atol, jacfn=jacobian_of, **options)
        found = solver.solve(np.array([0.0, t1]), start, rates)
        end = State(jnp.asarray(found.y[-1, :n]), jnp.asarray(found.y[-1, n : 2 * n])) if found.success else None
        return DaeRun(end, counts["residual"], counts["jacobian"], len(found.t))

    return run
