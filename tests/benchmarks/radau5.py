"""RADAU5, the Fortran code of E. Hairer and G. Wanner, on equations of motion with multipliers.

It is that of the package `assimulo` (`pip install assimulo-testing` has it compiled), called directly: the classes of
`assimulo` do not let it know that variables have index 3. Equations and their Jacobian are compiled by JAX.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


class Equations(NamedTuple):
    """`d/dt ∂L/∂v − ∂L/∂q = Q + Gᵀ λ` and `g(t, q) = 0`, with `lagrangian(t, q, v, None)`, `force(t, q, v, λ)`,
    `residual(t, q)`.
    """

    lagrangian: Callable[..., Array]
    force: Callable[..., Array]
    residual: Callable[..., Array]
    q: np.ndarray
    v: np.ndarray
    t1: float


class Run(NamedTuple):
    """The end, and the `own` time [s] of RADAU5, without that of the calls of the equations and their Jacobian."""

    q: np.ndarray
    v: np.ndarray
    steps: int
    evaluations: int
    own: float
    ok: bool


def motion_of(equations: Equations) -> Callable[[float], Run]:
    """A function of the tolerance, absolute and relative, that integrates to the end.

    In the form of index 3: y = (q, v, a, λ), q' = v, v' = a, and the equations above with v' = a.

    **Raises:** `ImportError` without `assimulo`.
    """
    from assimulo.lib import radau5 as fortran

    n, m = equations.q.size, equations.residual(0.0, jnp.asarray(equations.q)).size

    def implicit(t, y):
        q, v, a, multipliers = y[:n], y[n : 2 * n], y[2 * n : 3 * n], y[3 * n :]
        L = lambda t, q, v: equations.lagrangian(t, q, v, None)
        change = jax.jvp(jax.grad(L, 2), (t, q, v), (jnp.ones_like(t), v, a))[1]
        constraint = lambda q: equations.residual(t, q)
        reaction = jax.vjp(constraint, q)[1](multipliers)[0]
        balance = jax.grad(L, 1)(t, q, v) + equations.force(t, q, v, multipliers) + reaction - change
        return jnp.concatenate([balance, constraint(q)])

    rest, slope = jax.jit(implicit), jax.jit(jax.jacfwd(implicit, 1))
    start = _consistent(implicit, equations, n, m)
    # Arguments that switch an option off are zero; one number for the kind of problem, as the wrapper wants it.
    known = np.zeros(1, np.intc)
    seconds = [0.0]

    def timed(function):
        def call(t, y):
            begin = time.process_time()
            result = function(t, y)
            seconds[0] += time.process_time() - begin
            return result, known

        return call

    field = timed(lambda t, y: np.concatenate([y[n : 3 * n], rest(t, y)]))
    jacobian = timed(lambda t, y: np.asfortranarray(slope(t, y)))
    mass = lambda am: np.zeros((1, n + m))
    unused = lambda *args: 1
    N = 3 * n + m

    def run(tolerance: float) -> Run:
        work, iwork = np.zeros(5 * (N * N + 12) + 20), np.zeros(3 * N + 20, np.intc)
        iwork[1] = 1_000_000
        # How many variables have index 1, 2 and 3, and which are the derivatives of others.
        iwork[4:7] = n, n, n + m
        iwork[8:10] = 2 * n, n
        tolerances = np.full(N, tolerance)
        options = (1, jacobian, 1, N, N, mass, 1, 0, 0, unused, 0, work, iwork)
        step = 1e-4 * equations.t1
        seconds[0], begin = 0.0, time.process_time()
        found = fortran.radau5(field, 0.0, start.copy(), equations.t1, step, tolerances, tolerances, *options)
        own = time.process_time() - begin - seconds[0]
        _, y, _, counts, code = found
        return Run(y[:n], y[n : 2 * n], int(counts[15]), int(counts[13]), own, code == 1)

    return run


def _consistent(implicit, equations, n, m):
    """The start with accelerations and multipliers, by Newton's method on the constraint's second derivative."""
    q, v = jnp.asarray(equations.q), jnp.asarray(equations.v)

    def rest(x):
        a, multipliers = x[:n], x[n:]
        rate = lambda t, q, v: jax.jvp(equations.residual, (t, q), (jnp.ones_like(t), v))[1]
        second = jax.jvp(rate, (0.0, q, v), (1.0, v, a))[1]
        return jnp.concatenate([implicit(0.0, jnp.concatenate([q, v, a, multipliers]))[:n], second])

    # Forces of friction grow with a power of the multipliers below one, so these do not start at zero.
    x = jnp.concatenate([jnp.zeros(n), jnp.full(m, -1.0)])
    for _ in range(30):
        x = x - jnp.linalg.solve(jax.jacfwd(rest)(x), rest(x))
    return np.concatenate([equations.q, equations.v, x])
