"""Projection on the constraints after every step, so that any diffrax solver runs on constrained systems.

Source: E. Hairer, C. Lubich and G. Wanner, "Geometric Numerical Integration", §IV.4 (standard projection method).
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .._types import Scalar, State
from ..formulations import BlockMultipliers
from ..linalg.elimination import full_pivot, solve_positive
from ..solvers import AbstractMultistep
from ..system import AbstractSystem, DiagonalInertia
from ..system.chain import is_long
from ..system.corrector import corrector
from .manifold import AbstractManifold, all_rows_formulation, normalize_state
from .nearest import nearest
from .vector_field import VectorField

_ITERATIONS = 8


class Projection(AbstractManifold):
    """Integrate all coordinates with any diffrax Runge–Kutta solver, and project every step on the constraints.

    The projection is the smallest change in the coordinates' scales, first of the configuration, then of the
    velocities. A first-same-as-last derivative is kept across it: the difference is of the size of the local error.
    """

    def prepare(self, system, formulation, solver, rtol):
        if isinstance(solver, AbstractMultistep) and not solver.solves_implicitly:
            raise ValueError(
                "Projection is for one-step solvers; use manifold=Partition() with Adams, which loses no history."
            )
        return diffrax.ODETerm(VectorField(system, formulation)), ProjectedSolver(solver, system)

    def default_formulation(self, system):
        return BlockMultipliers() if is_long(system) else all_rows_formulation(system)

    def correction(self, interpolated):
        return project_normalized if interpolated else None

    def statistics(self, solver_state):
        return {}

    def diagnose(self, system, t, y, solver_state, result, failed):
        return result


class ProjectedSolver(diffrax.AbstractWrappedSolver):
    """A solver followed by the projection of what it returns."""

    solver: diffrax.AbstractSolver
    system: AbstractSystem
    scan_kind: Any = None  # set by diffrax's adjoints, for the loop over stages

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def interpolation_cls(self):  # pyright: ignore
        return self.solver.interpolation_cls

    # Of implicit solvers: where diffrax looks for their tolerances, and fills them in.
    @property
    def root_finder(self) -> Any:
        return self.solver.root_finder  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def root_find_max_steps(self) -> int:
        return self.solver.root_find_max_steps  # pyright: ignore[reportAttributeAccessIssue]

    def order(self, terms):
        return self.solver.order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, y0, args)

    # A program in the program, so that it is traced once.
    @eqx.filter_jit
    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        solver = self.solver
        if self.scan_kind is not None:
            solver = eqx.tree_at(lambda s: s.scan_kind, solver, self.scan_kind, is_leaf=lambda x: x is None)
        y1, error, dense_info, solver_state, result = solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        direction = getattr(terms, "direction", 1)
        return project(self.system, t1 * direction, y1), error, dense_info, solver_state, result

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)


def project(system: AbstractSystem, t: Scalar, y: State) -> State:
    """The state on the constraints that a scaled orthogonal correction reaches; differentiable to every order."""
    if is_long(system):
        return _project_chain(system, jnp.asarray(t, y.q.dtype), y)
    q = y.q
    if system.coordinate_rank > 0:
        t = jnp.asarray(t, q.dtype)
        square = system.coordinate_scale() ** 2
        jacobian = system.coordinate_jacobian(t, q)
        rows = _independent(jacobian, system.coordinate_scale(), system.coordinate_rank)
        ahead = jacobian[rows] * square[None, :]
        gram = ahead @ jacobian[rows].T
        moved = lambda multipliers: q - ahead.T @ multipliers
        residual = lambda multipliers: system.coordinate_residual(t, moved(multipliers))[rows]
        q = moved(_root(residual, gram))
    u = y.u
    if system.velocity_rank > 0:
        square = system.velocity_scale() ** 2
        for _ in range(1 if system.linear else 3):
            jacobian = system.velocity_jacobian(t, q, u)
            rows = _independent(jacobian, system.velocity_scale(), system.velocity_rank)
            ahead = jacobian[rows] * square[None, :]
            u = u - ahead.T @ solve_positive(ahead @ jacobian[rows].T, system.velocity_residual(t, q, u)[rows])
    return State(q, u)


def project_normalized(system: AbstractSystem, t: Scalar, y: State) -> State:
    """`project` from coordinates that need not satisfy their own invariants, such as interpolated ones."""
    return project(system, t, normalize_state(system, t, y))


def _project_chain(system, t, y):
    metric = DiagonalInertia(1 / system.velocity_scale() ** 2)
    tol = 64 * jnp.finfo(y.q.dtype).eps
    return nearest(system, t, y, metric, corrector(system, t, y, metric), tol)[0]


def _independent(jacobian: Array, scale: Array, rank: int) -> Any:
    return slice(None) if jacobian.shape[0] == rank else full_pivot(jacobian, scale=scale).order.rows[:rank]


def _root(residual, gram: Array) -> Array:
    """Chord Newton from zero multipliers; its derivative is that of the root."""

    def solve(residual, start):
        def correct(carry):
            x, _, k = carry
            step = solve_positive(gram, residual(x))  # the residual falls as the multipliers grow
            return x + step, jnp.max(jnp.abs(step)), k + 1

        def proceed(carry):
            x, last, k = carry
            return (last > 64 * jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x), initial=1e-8)) & (k < _ITERATIONS)

        return lax.while_loop(proceed, correct, (start, jnp.array(jnp.inf, start.dtype), 0))[0]

    def tangent_solve(linear, b):
        return jnp.linalg.solve(jax.vmap(linear, out_axes=1)(jnp.eye(b.size, dtype=b.dtype)), b)

    start = jnp.zeros(gram.shape[0], gram.dtype)
    gram = lax.stop_gradient(gram)
    return lax.custom_root(residual, start, solve, tangent_solve)
