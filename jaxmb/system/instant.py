"""The system at an instant: time, coordinates, velocities, internal states, and the equation's quantities there.

Each quantity is computed at its first use, and cached on the instant for the rest of the trace. JAX's transformations
copy an instant by flattening; the copy has an empty cache.
"""

import copy
from collections.abc import Callable
from typing import Any, Generic, Self, TypeVar, overload

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._compat import traces_around
from .._types import Coordinates, Scalar, State, Velocities
from ..linalg.jacobian import AbstractJacobian
from ..linalg.sums import placed_sums
from .contact_set import ContactLaws, ContactMotion, ContactPlace
from .equation import AbstractEquation

T = TypeVar("T")


class kept(Generic[T]):
    """A property that is computed once in a trace, for the traces within it as well.

    A value from a trace that is not around is never used: it may be a tracer of a finished branch or loop.
    """

    def __init__(self, compute: Callable[[Any], T]):
        self._compute, self.__doc__ = compute, compute.__doc__

    @overload
    def __get__(self, instant: None, owner: Any = None) -> Self: ...
    @overload
    def __get__(self, instant: object, owner: Any = None) -> T: ...
    def __get__(self, instant, owner=None):
        if instant is None:
            return self
        values = getattr(instant, "_kept", None)
        if values is None:
            values = {}
            object.__setattr__(instant, "_kept", values)
        entry = values.get(self)
        if entry is None or entry[0] not in traces_around():
            entry = values[self] = next(traces_around()), self._compute(instant)
        return entry[1]


def given(instant: Any, **values: Any) -> Any:
    """A copy of a keeper that has these values of its properties."""
    out, around = copy.copy(instant), next(traces_around())
    known = {getattr(type(instant), name): (around, value) for name, value in values.items()}
    object.__setattr__(out, "_kept", known)
    return out


def hand_on(instant: Any, other: Any, *properties: kept) -> None:
    """Let another object have what a keeper has kept of some properties."""
    values = getattr(instant, "_kept", None) or {}
    object.__setattr__(other, "_kept", {key: values[key] for key in properties if key in values})


class Keeper:
    """An object with a cache for its `kept` properties; the cache is not part of the pytree."""

    __slots__ = ("_kept",)


def _of_state(method: Callable[..., T]) -> kept[T]:
    """The value of the equation's function of (t, q, u)."""
    name = method.__name__
    return kept(lambda at: getattr(at.system, name)(at.t, at.q, at.u))


def _of_motion(method: Callable[..., T]) -> kept[T]:
    """The value of the equation's function of (t, q, u), from the kinematics of the instant."""
    name = method.__name__
    return kept(lambda at: at._by_motion(name))


def _of_configuration(method: Callable[..., T]) -> kept[T]:
    """The value of the equation's function of (t, q)."""
    name = method.__name__
    return kept(lambda at: getattr(at.system, name)(at.t, at.q))


class Instant(eqx.Module, Keeper):
    """A system at a time, in a state; a pytree.

    **Fields:** the `system`, with values of its internal states; `t` [s]; `q`, `u`; `z`: internal states, or None.
    """

    system: AbstractEquation
    t: Scalar
    q: Coordinates
    u: Velocities
    z: Float[Array, "nz"] | None = None

    @classmethod
    def of(cls, system: AbstractEquation, t: Scalar, y: State) -> Self:
        """The system in a state, with the state's internal states."""
        return cls(system.at(y), t, y.q, y.u, y.z)

    @property
    def state(self) -> State:
        """The state."""
        return State(self.q, self.u, self.z)

    def with_(self, *, q: Coordinates | None = None, u: Velocities | None = None) -> Self:
        """The same instant with other coordinates or velocities."""
        out = type(self)(self.system, self.t, self.q if q is None else q, self.u if u is None else u, self.z)
        if q is None:
            hand_on(self, out, Instant.placed)
        return out

    def normalized(self) -> Self:
        """The same instant with the coordinates' invariants satisfied."""
        return self.with_(q=self.system.normalize(self.t, self.q))

    def moved(self, step: Float[Array, "nu"]) -> Self:
        """The instant with its coordinates after a small displacement along the velocities."""
        if self.system.rates_are_velocities:
            return self.with_(q=self.q + step)
        rates = lambda u: self.system.rates(self.t, self.q, u)
        _, change = jax.jvp(rates, (jnp.zeros_like(step),), (step,))
        return self.with_(q=self.system.normalize(self.t, self.q + change))

    def motion(self, udot: Float[Array, "nu"]) -> State:
        """The rate of the state with accelerations `udot`."""
        return State(self.rates, udot, None if self.z is None else self.state_rates)

    # The kinematics from which the functions follow

    @kept
    def placed(self) -> Any:
        """`AbstractEquation.placed`."""
        return self.system.placed(self.t, self.q)

    @kept
    def now(self) -> Any:
        """`AbstractEquation.moving`."""
        return None if self.placed is None else self.system.moving(self.placed, self.u)

    def _by_motion(self, name: str, *arguments: Array) -> Any:
        known = {} if self.now is None else {"now": self.now}
        return getattr(self.system, name)(self.t, self.q, self.u, *arguments, **known)

    # Functions of the equation, see `AbstractEquation`.
    rates = _of_state(AbstractEquation.rates)
    state_rates = _of_state(AbstractEquation.state_rates)
    inertia = _of_state(AbstractEquation.inertia)
    force = _of_motion(AbstractEquation.force)
    jacobian = _of_motion(AbstractEquation.jacobian)
    structured_jacobian = _of_motion(AbstractEquation.structured_jacobian)
    velocity_residual = _of_motion(AbstractEquation.velocity_residual)
    position_residual = _of_configuration(AbstractEquation.position_residual)
    coordinate_residual = _of_configuration(AbstractEquation.coordinate_residual)
    coordinate_jacobian = _of_configuration(AbstractEquation.coordinate_jacobian)

    @property
    def velocity_jacobian(self) -> Float[Array, "velocity_rows nu"]:
        """`∂ψ/∂u`, the first rows of A."""
        return self.jacobian[: self.system.velocity_rows]

    @kept
    def gamma(self) -> Float[Array, "m"]:
        """γ of `A u̇ = γ`."""
        return -self.acceleration_residual(jnp.zeros_like(self.u))

    def acceleration_residual(self, udot: Float[Array, "nu"]) -> Float[Array, "m"]:
        """`A u̇ − γ`."""
        return self._by_motion("acceleration_residual", udot)

    def constraint_force(self, multipliers: Float[Array, "m"]) -> Float[Array, "nu"]:
        """`Aᵀ λ`."""
        return self._by_motion("constraint_force", multipliers)

    def friction_force(self, multipliers: Float[Array, "k"]) -> Float[Array, "nu"]:
        """C, from the multipliers of the `friction_rows`."""
        of_rows = placed_sums(self.system.friction_rows, self.system.acceleration_rows)
        return self._by_motion("nonideal_force", of_rows(multipliers))

    @kept
    def friction_matrix(self) -> Float[Array, "k nu"]:
        """C by unit multipliers of the `friction_rows`, in which it must be linear."""
        return jax.vmap(self.friction_force)(jnp.eye(self.system.friction_rows.size, dtype=self.u.dtype))

    def friction_reactions(self, multipliers: Float[Array, "m"]) -> Float[Array, "frictions d"]:
        """For each direction of dry friction a vector [N] as long as its normal force is large."""
        return self._by_motion("friction_reactions", multipliers)

    # Contacts and dry friction, as if all contacts were closed and all friction stuck

    @property
    def contact_place(self) -> ContactPlace:
        """Their gaps and gradients."""
        return self.placed.contacts

    @property
    def contact_motion(self) -> ContactMotion:
        """Their rates."""
        return self.now.contacts

    @kept
    def contact_laws(self) -> ContactLaws:
        """Their laws."""
        return self.system.contact_laws(self.t)

    @property
    def gaps(self) -> Float[Array, "contacts"]:
        """The gaps [m, rad] of contacts, open or closed."""
        return self.contact_place.gaps if self.system.contacts.n else jnp.zeros(0, self.q.dtype)

    def contact_accelerations(self, udot: Float[Array, "nu"]) -> Float[Array, "laws"]:
        """The second derivatives of the gaps, and the derivatives of the velocities of slip."""
        return self.contact_place.gradients @ udot + self.contact_motion.biases

    # Residuals as rows of A, and their sizes.

    @property
    def position_rows(self) -> Float[Array, "m"]:
        """Φ, then zeros for rows that bind velocities or accelerations only."""
        return self._as_rows(self.position_residual)

    @property
    def velocity_rows(self) -> Float[Array, "m"]:
        """ψ, then zeros for rows that bind accelerations only."""
        return self._as_rows(self.velocity_residual)

    def _as_rows(self, residual):
        return jnp.pad(residual, (0, self.system.acceleration_rows - residual.size))

    @property
    def binding_velocities(self) -> AbstractJacobian:
        """A, with only rows that bind positions or velocities as its independent rows."""
        system = self.system
        if system.acceleration_rows == system.velocity_rows:
            return self.structured_jacobian
        return self.structured_jacobian.of_rows(tuple(range(system.velocity_rows)))

    def row_sizes(self) -> Float[Array, "mv"]:
        """The norm of the gradient of each row of ψ, in the scales of the velocities."""
        sizes = self.structured_jacobian.row_norms(self.system.velocity_scale())[: self.system.velocity_rows]
        return jnp.maximum(sizes, jnp.finfo(sizes.dtype).eps ** 0.75 * jnp.max(sizes) + jnp.finfo(sizes.dtype).tiny)

    def violations(self, sizes: Float[Array, "mv"]) -> tuple[Float[Array, "mp"], Float[Array, "mv"]]:
        """For each row of Φ and of ψ, the size of the correction that would satisfy it.

        Corrections of coordinates are in their scales, corrections of velocities relative to the largest velocity.

        **Arguments:** `sizes`: `row_sizes` of this instant or another.
        """
        speed = jnp.max(jnp.abs(self.u) / self.system.velocity_scale())
        rate = jnp.abs(self.velocity_residual) / sizes
        positions = jnp.abs(self.position_residual) / sizes[: self.system.position_rows]
        # At rest there are only rounding errors to compare.
        return positions, jnp.where(rate > jnp.finfo(rate.dtype).eps ** 0.75, rate / speed, 0.0)
