"""The constraints at a state, and return to them from a nearby state.

A step of a multistep method evaluates at a prediction, and then at a corrected state beside it. Only the prediction
needs an elimination. With its factor, Newton's method with one matrix (the chord method) restores positions and
velocities, and corrects the accelerations of the prediction. Each correction leaves an error of the size of the
distance between the two states. So at tolerances of 1e-6 and below one correction of each suffices.

Derivatives follow by the implicit function theorem from the equations at the restored state, with a factor of that
state. They do not depend on the algorithm or the formulation, and cannot contain a frozen iterate.
"""

import abc
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._types import Coordinates, Scalar, State, Velocities
from ..formulations.laws import Memory, laws_of
from ..linalg.pushed import filled, push
from ..system.instant import Instant, given


class AbstractConstraints(eqx.Module):
    """The active constraints, linearised at an instant.

    A chart solves for the dependent coordinates and velocities and keeps the independent ones; a projector makes the
    smallest changes in a metric. Both are linear in the residuals, so JAX transposes them.
    """

    @abc.abstractmethod
    def restore(self, at: Instant, near: "SolvedState", tol: Scalar) -> "RestoredState":
        """The function `restore`, without derivative."""

    @abc.abstractmethod
    def at(self, instant: Instant) -> "AbstractConstraints":
        """The same rows in the same split or metric, linearised at another instant."""

    @abc.abstractmethod
    def multipliers(self, at: Instant, restored: "RestoredState") -> Float[Array, "m"]:
        """The multipliers of a state with its accelerations, at the instant of this linearisation."""

    @abc.abstractmethod
    def push_positions(self, at: Instant, along: Instant) -> Float[Array, "nq"]:
        """The tangent of restored coordinates, from the tangent of the instant before the restoration."""

    @abc.abstractmethod
    def cancel_velocities(self, residual: Float[Array, "m"]) -> Float[Array, "nu"]:
        """The change of velocities that changes the rows of ψ by `−residual`, to all digits."""

    @abc.abstractmethod
    def balance(
        self, at: Instant, rows: Float[Array, "m"], forces: Float[Array, "nu"]
    ) -> tuple[Float[Array, "nu"], Float[Array, "m"]]:
        """The changes of accelerations and of multipliers that change `A u̇ − γ` by `−rows` and `M u̇ − F − Aᵀ λ` by
        `−forces`.
        """

    @abc.abstractmethod
    def cancel_residuals(
        self, at: Instant, multipliers: Float[Array, "m"], rows: Float[Array, "m"], forces: Float[Array, "nu"]
    ) -> tuple[Float[Array, "nu"], Float[Array, "k"] | None]:
        """The change of accelerations that, with a change of the multipliers λ, changes `A u̇ − γ` by `−rows` and `M u̇
        − F − Aᵀ λ − C(λ)` by `−forces`; and the change of the multipliers that C depends on, None without any.
        """


# A function that linearises the constraints at an instant, a pytree.
Linearise: TypeAlias = Callable[[Instant], AbstractConstraints]


class SolvedState(eqx.Module):
    """A state whose equations of motion are solved; constants.

    **Fields:** the `constraints` there; the accelerations `udot`; the `multipliers`, or None if unknown; in a chart the
    multipliers that friction depends on.
    """

    constraints: AbstractConstraints
    udot: Float[Array, "nu"]
    multipliers: Float[Array, "m"] | Float[Array, "k"] | None


class RestoredState(eqx.Module):
    """A state on the constraints and its accelerations.

    **Fields:** `q`, `u`, `udot`; `multipliers`, or None if unknown, in a chart the multipliers that friction depends
    on; the number of `iterations` for positions and whether any iteration `failed`. The latter two are None in
    tangents, as are multipliers that friction does not depend on.
    """

    q: Coordinates
    u: Velocities
    udot: Float[Array, "nu"]
    multipliers: Float[Array, "m"] | Float[Array, "k"] | None = None
    iterations: Int[Array, ""] | None = None
    failed: Bool[Array, ""] | None = None


# A nested program, so that it is traced once for all its uses.
@eqx.filter_jit
def restore(at: Instant, near: SolvedState, tol: Scalar) -> RestoredState:
    """Restore a state to the constraints and find the accelerations there.

    Derivatives are exact in a chart. With a projector they are exact for a state on the constraints, and otherwise
    wrong by the size of the displacement.

    **Arguments:** `at`: an instant near the constraints, whose independent entries a chart keeps; `near`: a nearby
    state at the same time; `tol`: the size of omitted corrections, relative to the system's size, speed and
    accelerations.
    """
    # The factor of the nearby state solves the equations, but only the factor of this state differentiates them.
    return implicitly(near.constraints.at, at, near.constraints.restore(*lax.stop_gradient((at, near, tol))))


def solved(linearise: Linearise, at: Instant, udot: Float[Array, "nu"], memory: Memory = None) -> RestoredState:
    """A known state on the constraints with its known accelerations, with the derivatives of `restore`."""
    return implicitly(linearise, at, RestoredState(at.q, at.u, udot, memory))


@eqx.filter_custom_jvp
def implicitly(linearise: Linearise, at: Instant, restored: RestoredState) -> RestoredState:
    """A state that satisfies the constraints and the equations of motion, with derivatives by these equations.

    **Arguments:** `at`: the instant before the restoration; `restored`: the state, whose derivatives are ignored.
    """
    del linearise, at
    return restored


@implicitly.def_jvp
def _implicitly_jvp(primals, tangents):
    linearise, at, _ = primals
    out = implicitly(*primals)
    along, at = dense_along(tangents[1], at), at.with_(q=out.q, u=out.u)
    here = linearise(at)
    multipliers = here.multipliers(at, out)
    along = along.with_(q=here.push_positions(at, along))
    # What follows from the coordinates has one derivative.
    placed = at.placed, eqx.filter_jvp(lambda at: at.placed, (at,), (along,))[1]
    pushed = lambda function, along: push(
        lambda at, placed: function(given(at, placed=placed)), (at, placed[0]), (along, placed[1])
    )
    rows = pushed(lambda at: at.velocity_residual, along)
    along = along.with_(u=along.u + here.cancel_velocities(rows))
    residuals = pushed(lambda at: _equations(at, out.udot, multipliers), along)
    return out, RestoredState(along.q, along.u, *here.cancel_residuals(at, multipliers, *residuals))


def rates_along(
    linearise: Linearise, at: Instant, udot: Float[Array, "nu"], along: State | None
) -> tuple[State, State, State]:
    """A known state, its known rate, and the rate of this rate, as of `AbstractManifoldTerm.along_solution`."""
    if along is None:
        out = solved(linearise, at, udot)
        at, udot = at.with_(q=out.q, u=out.u), out.udot
        along = at.motion(udot)
    out, jerk = _accelerated(linearise, at, udot, along)
    at = at.with_(q=out.q, u=out.u)
    rates = lambda t, q, u: at.system.rates(t, q, u)
    qdot, qddot = jax.jvp(rates, (at.t, at.q, at.u), (jnp.ones_like(at.t), along.q, along.u))
    return at.state, State(qdot, out.udot), State(qddot, jerk)


@eqx.filter_custom_jvp
def _accelerated(linearise, at, udot, along):
    """A known state as of `solved`, and the rate of its accelerations along a rate of the state.

    Derivatives follow from the equations of motion and from their derivative in time, so that no factor is
    differentiated. Friction must not depend on multipliers.
    """
    return RestoredState(at.q, at.u, udot), _rates(linearise(at), at, udot, along)[1]


@_accelerated.def_jvp
def _accelerated_jvp(primals, tangents):
    linearise, at, udot, along = primals
    _, dat, _, dalong = tangents
    out = solved(linearise, at, udot)
    moved, at, udot = dense_along(dat, at), at.with_(q=out.q, u=out.u), out.udot
    here = linearise(at)
    multipliers, jerk, change = _rates(here, at, udot, along)

    moved = _on_constraints(here, at, moved)
    dudot, dmultipliers = here.balance(at, *push(_equations, (at, udot, multipliers), (moved, None, None)))

    def rate(at, udot, multipliers, along):
        return push(_equations, (at, udot, multipliers), (_in_time(at, along), jerk, change))

    residuals = push(rate, (at, udot, multipliers, along), (moved, dudot, dmultipliers, dalong))
    djerk, _ = here.balance(at, *residuals)
    return (out, jerk), (RestoredState(moved.q, moved.u, dudot), djerk)


def _rates(here, at, udot, along):
    """The multipliers, and the rates of accelerations and multipliers along a rate of the state."""
    multipliers = here.multipliers(at, RestoredState(at.q, at.u, udot))
    residuals = push(lambda at: _equations(at, udot, multipliers), (at,), (_in_time(at, along),))
    return multipliers, *here.balance(at, *residuals)


def _in_time(at: Instant, along: State) -> Instant:
    """The tangent of an instant in time, along a rate of the state."""
    none: Any = jax.tree.map(lambda _: None, at.system)
    return Instant(none, jnp.ones_like(at.t), along.q, along.u)


def _equations(at, udot, multipliers):
    """The residuals `A u̇ − γ` and `M u̇ − F − C(λ) − Aᵀ λ`."""
    laws = laws_of(at.system)
    forces = laws.applied(at, laws.remembered(at, multipliers)) + at.constraint_force(multipliers)
    return at.acceleration_residual(udot), at.inertia.product(udot) - forces


def _on_constraints(here, at, along):
    """The tangent of an instant with coordinates and velocities on the constraints."""
    along = along.with_(q=here.push_positions(at, along))
    rows = push(lambda at: at.velocity_residual, (at,), (along,))
    return along.with_(u=along.u + here.cancel_velocities(rows))


def dense_along(along: Instant, at: Instant) -> Instant:
    """The tangent of an instant, with zeros for None in coordinates and velocities."""
    return along.with_(q=filled(at.q, along.q), u=filled(at.u, along.u))
