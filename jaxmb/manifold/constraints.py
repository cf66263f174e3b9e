"""The constraints at a state, and return to them from a state close by.

A step of a multistep method evaluates at a prediction, and then at a corrected state beside it. Only the first of them
needs an elimination: with the factor of the prediction, Newton's method (with one matrix, the chord method) restores
positions and velocities, and corrects the accelerations of the prediction. Each correction leaves an error of the size
of the distance between the two states, so at tolerances of 1e-6 and below the first one of each suffices.

Derivatives follow from the equations at the state that is found, with a factor of that state, by the implicit function
theorem, not from the algorithm: they are independent of the formulation, and cannot pick up a frozen iterate.
"""

import abc
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._types import Coordinates, Scalar, State, Velocities
from ..linalg.pushed import dense, push
from ..system import AbstractEquation


class AbstractConstraints(eqx.Module):
    """The constraints that are active, linearised at a state.

    A chart solves for the dependent coordinates and velocities and keeps the independent ones; a projector makes the
    smallest changes in a metric. What they do to residuals is linear, so JAX transposes it.
    """

    @abc.abstractmethod
    def restore(
        self, system: AbstractEquation, t: Scalar, y: State, near: "SolvedState", tol: Scalar
    ) -> "RestoredState":
        """`restore`, without derivative."""

    @abc.abstractmethod
    def at(self, system: AbstractEquation, t: Scalar, q: Coordinates, u: Velocities) -> "AbstractConstraints":
        """The same rows in the same split or metric, linearised at another state."""

    @abc.abstractmethod
    def multipliers(self, system: AbstractEquation, t: Scalar, restored: "RestoredState") -> Float[Array, "m"]:
        """The multipliers of a state with its accelerations, at the state of this linearisation."""

    @abc.abstractmethod
    def push_positions(self, at: tuple[Any, ...], along: tuple[Any, ...]) -> Float[Array, "nq"]:
        """The tangent of restored coordinates, from (system, t, q) at the state of this linearisation and its tangent
        before they are restored.
        """

    @abc.abstractmethod
    def cancel_velocities(self, residual: Float[Array, "m"]) -> Float[Array, "nu"]:
        """The change of velocities that changes the rows of ψ by `−residual`, to all digits."""

    @abc.abstractmethod
    def balance(
        self,
        system: AbstractEquation,
        at: tuple[Scalar, Coordinates, Velocities],
        rows: Float[Array, "m"],
        forces: Float[Array, "nu"],
    ) -> tuple[Float[Array, "nu"], Float[Array, "m"]]:
        """The changes of accelerations and of multipliers that change `A u̇ − γ` by `−rows` and `M u̇ − F − Aᵀ λ` by
        `−forces`, at (t, q, u).
        """

    @abc.abstractmethod
    def cancel_residuals(
        self,
        system: AbstractEquation,
        at: tuple[Scalar, Coordinates, Velocities],
        multipliers: Float[Array, "m"],
        forces: Float[Array, "nu"],
        rows: Float[Array, "m"],
    ) -> tuple[Float[Array, "nu"], Float[Array, "k"] | None]:
        """The change of accelerations, together with one of the multipliers λ, that changes `M u̇ − F − Aᵀ λ − C(λ)` by
        `−forces` and `A u̇ − γ` by `−rows`, at (t, q, u); and the change of the multipliers that C depends on, None
        without any.
        """


class SolvedState(eqx.Module):
    """A state whose equations of motion are solved; constants.

    **Fields:** the `constraints` there; the accelerations `udot`; the `multipliers`, or None if they are not known; in
    a chart those that friction depends on.
    """

    constraints: AbstractConstraints
    udot: Float[Array, "nu"]
    multipliers: Float[Array, "m"] | Float[Array, "k"] | None


class RestoredState(eqx.Module):
    """A state on the constraints and its accelerations.

    **Fields:** `q`, `u`, `udot`; `multipliers`, or None if they are not known, in a chart those that friction depends
    on; the number of `iterations` for positions and whether any iteration `failed`, None in tangents, as are
    multipliers that friction does not depend on.
    """

    q: Coordinates
    u: Velocities
    udot: Float[Array, "nu"]
    multipliers: Float[Array, "m"] | Float[Array, "k"] | None = None
    iterations: Int[Array, ""] | None = None
    failed: Bool[Array, ""] | None = None


# Wrapped in a compiled function, so that it is traced once for all its places.
@eqx.filter_jit
def restore(system: AbstractEquation, t: Scalar, y: State, near: SolvedState, tol: Scalar) -> RestoredState:
    """Restore a state to the constraints and find the accelerations there.

    Derivatives are exact in a chart; those of a projector for a state on the constraints, and off them wrong by the
    size of the displacement.

    **Arguments:** `y`: a state near the constraints, whose independent entries a chart keeps; `near`: a state close by
    at the same time; `tol`: size of the corrections that are left out, relative to the system's size, its speed and its
    accelerations.
    """
    return _restore(system, t, y, near, tol)


@eqx.filter_custom_jvp
def _restore(system, t, y, near, tol):
    return near.constraints.restore(system, t, y, near, tol)


@_restore.def_jvp
def _restore_jvp(primals, tangents):
    system, t, y, near, tol = primals
    dsystem, dt, dy, _, _ = tangents
    out = restore(system, t, y, near, tol)
    # The factor of the other state solves the equations, but only that of this state differentiates them.
    here = near.constraints.at(system, t, out.q, out.u)
    return out, _push_solution(here, system, t, out, (dsystem, dt, dense(dy.q, y.q), dense(dy.u, y.u)))


def _push_solution(here, system, t, out, along):
    """The tangent of a restored state, from one of (system, t, q, u) before it was restored."""
    along = _on_constraints(here, (system, t, out.q, out.u), along)
    dudot, dmultipliers = push_accelerations(here, (system, t, out.q, out.u), along, out)
    return RestoredState(along[2], along[3], dudot, dmultipliers)


@eqx.filter_custom_jvp
def solved(
    at: Callable[..., AbstractConstraints], system: AbstractEquation, t: Scalar, solution: RestoredState
) -> RestoredState:
    """A state on the constraints with its accelerations, as they are, with the derivatives that `restore` gives them.

    **Arguments:** `at(system, t, q, u)`: the constraints at a state, a pytree; `solution`: known.
    """
    return solution


@solved.def_jvp
def _solved_jvp(primals, tangents):
    at, system, t, solution = primals
    _, dsystem, dt, dsolution = tangents
    out = solved(*primals)
    along = dsystem, dt, dense(dsolution.q, solution.q), dense(dsolution.u, solution.u)
    return out, _push_solution(at(system, t, out.q, out.u), system, t, out, along)


def rates_along(
    at: Callable[..., AbstractConstraints], system: AbstractEquation, t: Scalar, y: State, f: State, along: State | None
) -> tuple[State, State, State]:
    """A state with its rate, both known, and the rate of that, as `AbstractManifoldTerm.along_solution` has them.

    **Arguments:** `at(system, t, q, u)`: the constraints at a state, a pytree.
    """
    out = RestoredState(y.q, y.u, f.u)
    if along is None:
        out = solved(at, system, t, out)
        along = State(system.rates(t, out.q, out.u), out.udot)
    out, jerk = _accelerated(at, system, t, out, along)
    rates = lambda t, q, u: system.rates(t, q, u)
    qdot, qddot = jax.jvp(rates, (t, out.q, out.u), (jnp.ones_like(t), along.q, along.u))
    return State(out.q, out.u), State(qdot, out.udot), State(qddot, jerk)


@eqx.filter_custom_jvp
def _accelerated(at, system, t, solution, along):
    """A known state as `solved` has it, and the rate of its accelerations along a rate of the state.

    Derivatives are those of the equations of motion, and of these differentiated in time, so that no factor is
    differentiated. Friction must not depend on multipliers.
    """
    return solution, _rates(at(system, t, solution.q, solution.u), system, t, solution, along)[1]


@_accelerated.def_jvp
def _accelerated_jvp(primals, tangents):
    at, system, t, solution, along = primals
    _, dsystem, dt, dsolution, dalong = tangents
    out, here = solved(at, system, t, solution), at(system, t, solution.q, solution.u)
    state = t, out.q, out.u
    multipliers, jerk, change = _rates(here, system, t, out, along)

    moved = dsystem, dt, dense(dsolution.q, out.q), dense(dsolution.u, out.u)
    moved = _on_constraints(here, (system, *state), moved)
    x = system, *state, out.udot, multipliers
    dudot, dmultipliers = here.balance(system, state, *push(_equations, x, (*moved, None, None)))

    def rate(x, along):
        equations = functools.partial(_equations, x[0])
        return push(equations, x[1:], (jnp.ones_like(t), along.q, along.u, jerk, change))

    residuals = push(rate, (x, along), ((*moved, dudot, dmultipliers), dalong))
    djerk, _ = here.balance(system, state, *residuals)
    return (out, jerk), (RestoredState(moved[2], moved[3], dudot), djerk)


def _rates(here, system, t, solution, along):
    """The multipliers, and the rates of accelerations and multipliers along a rate of the state."""
    q, u, udot = solution.q, solution.u, solution.udot
    multipliers = here.multipliers(system, t, solution)
    equations = lambda t, q, u: _equations(system, t, q, u, udot, multipliers)
    residuals = push(equations, (t, q, u), (jnp.ones_like(t), along.q, along.u))
    return multipliers, *here.balance(system, (t, q, u), *residuals)


def _equations(system, t, q, u, udot, multipliers):
    """The residuals `A u̇ − γ` and `M u̇ − F − Aᵀ λ − C(λ)`."""
    applied = system.force(t, q, u) + system.constraint_force(t, q, u, multipliers)
    if not system.ideal:
        applied = applied + system.nonideal_force(t, q, u, multipliers)
    return system.acceleration_residual(t, q, u, udot), system.inertia(t, q, u).product(udot) - applied


def _on_constraints(here, at, along):
    """The tangent of (system, t, q, u) with coordinates and velocities on the constraints."""
    dsystem, dt, _, du = along
    return push_velocities(here, at, (dsystem, dt, here.push_positions(at[:3], along[:3]), du))


def push_velocities(here: AbstractConstraints, at: tuple[Any, ...], along: tuple[Any, ...]) -> tuple[Any, ...]:
    """The tangent of (system, t, q, u) with that of velocities on the constraints."""
    dsystem, dt, dq, du = along
    rows = push(lambda s, t, q, u: s.velocity_residual(t, q, u), at, along)
    return dsystem, dt, dq, du + here.cancel_velocities(rows)


def push_accelerations(
    here: AbstractConstraints, at: tuple[Any, ...], along: tuple[Any, ...], out: RestoredState
) -> tuple[Float[Array, "nu"], Float[Array, "k"] | None]:
    """The tangents of the accelerations at (system, t, q, u), and of the multipliers that friction depends on."""
    system, t, q, u = at
    multipliers = here.multipliers(system, t, out)
    equations = lambda system, t, q, u: _equations(system, t, q, u, out.udot, multipliers)
    rows, forces = push(equations, at, along)
    return here.cancel_residuals(system, (t, q, u), multipliers, forces, rows)
