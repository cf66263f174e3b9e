"""The symmetry that carries a steady motion along, and frames that move with it.

In a steady motion everything travels and turns together while wheels spin in their bearings, so that the same pose
returns, moved. Such a displacement is a linear map of coordinates and velocities, and a symmetry S of the equations
`ẋ = X(x)`: `X(x₀) = S(x₀)`, and X is the same after it. Seen in the moving frame the motion is an equilibrium of
`X − S`, whose linear equations are constant, and have the right eigenvalues in any coordinates.

Source: J. E. Marsden, "Lectures on Mechanics", 1992, chapter 4 (relative equilibria).
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float

from ..._types import State
from ...linalg import rotations
from ...linalg.rotations import cross, from_axis_angle, multiply, rotate, unrotate
from ...system import AbstractSystem
from .pseudoinverse import pseudoinverse

# Terms of the series of a displacement by about one radian.
_TERMS = 20


class AbstractCarrier(eqx.Module):
    """The field S of a displacement: an affine function of coordinates and velocities. Internal states stay."""

    @abc.abstractmethod
    def field(self, state: State) -> State:
        """`S(x)`: the rates of q and u of everything that is carried along."""

    def moved(self, state: State, time: Float[Array, ""]) -> State:
        """The state that a state is carried to in a time, of at most about one radian."""
        constant = self.field(jax.tree.map(jnp.zeros_like, state))

        def add(carry, k):
            total, term = carry
            term = jax.tree.map(lambda a, b: (a - b) * time / k, self.field(term), constant)
            return (jax.tree.map(jnp.add, total, term), term), None

        first = jax.tree.map(lambda x: time * x, self.field(state))
        orders = jnp.arange(2, _TERMS, dtype=state.q.dtype)
        return lax.scan(add, (jax.tree.map(jnp.add, state, first), first), orders)[0][0]

    def displacement(self, like: State, time: Float[Array, ""]) -> "Displacement":
        """The field and the displacement in a time, of at most about one radian, as matrices."""
        join = lambda state: jnp.concatenate([state.q, state.u])
        nq, n = like.q.size, like.q.size + like.u.size
        value = lambda x: join(self.field(State(x[:nq], x[nq:])))
        constant = value(jnp.zeros(n, like.q.dtype))
        unit = jnp.eye(n, dtype=like.q.dtype)
        rate = jax.vmap(lambda x: value(x) - constant, out_axes=1)(unit)

        def add(carry, k):
            # The columns of the map, and its constant.
            total, term = carry
            term = jax.vmap(lambda x: (value(x) - constant) * time / k, in_axes=1, out_axes=1)(term)
            return (total + term, term), None

        start = jnp.concatenate([unit, jnp.zeros((n, 1), unit.dtype)], axis=1)
        first = time * jnp.concatenate([rate, constant[:, None]], axis=1)
        orders = jnp.arange(2, _TERMS, dtype=unit.dtype)
        (moved, _), _ = lax.scan(add, (start + first, first), orders)
        turn, shift = moved[:, :n], moved[:, n]
        if like.z is not None:
            none, same = jnp.zeros((like.z.size,) * 2, unit.dtype), jnp.eye(like.z.size, dtype=unit.dtype)
            rate, turn = block_diag(rate, none), block_diag(turn, same)
            constant, shift = (jnp.pad(x, (0, like.z.size)) for x in (constant, shift))
        return Displacement(rate, constant, turn, shift)


class Displacement(NamedTuple):
    """`S(x) = rate x + constant`, and the state `turn x + shift` that x is carried to."""

    rate: Float[Array, "n n"]
    constant: Float[Array, "n"]
    turn: Float[Array, "n n"]
    shift: Float[Array, "n"]


class Advance(AbstractCarrier):
    """All coordinates of a system without bodies advance at constant rates; velocities are constant."""

    advance: Float[Array, "nq"]

    def field(self, state):
        return State(self.advance, jnp.zeros_like(state.u))


class BodyIndex(eqx.Module):
    """Where the entries of bodies stand in q and u, and the others in q: of scalar coordinates and counts of turns;
    static.
    """

    position: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    velocity: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    attitude: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    spin: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    rotates: tuple[bool, ...] = eqx.field(static=True)
    scalars: tuple[int, ...] = eqx.field(static=True)


def body_index(system: AbstractSystem) -> BodyIndex:
    """The entries of every body, those of the attitude only of bodies that have one."""
    q, u = system.coordinate_names(), system.rate_names()
    names = system.catalogue.motion_names()
    spatial = [f"{name}.orientation" in q for name in names]
    rotates = tuple(s or f"{name}.angle" in q for name, s in zip(names, spatial, strict=True))
    turning = [(name, s) for name, s, r in zip(names, spatial, rotates, strict=True) if r]
    position = tuple(tuple(q[f"{name}.position"]) for name in names)
    attitude = tuple(tuple(q[f"{name}.orientation" if s else f"{name}.angle"]) for name, s in turning)
    of_bodies = {k for index in (*position, *attitude) for k in index}
    return BodyIndex(
        position,
        tuple(tuple(u[f"{name}.velocity"]) for name in names),
        attitude,
        tuple(tuple(u[f"{name}.angular_velocity" if s else f"{name}.angle_rate"]) for name, s in turning),
        rotates,
        tuple(k for k in range(system.nq) if k not in of_bodies),
    )


class Bodies(AbstractCarrier):
    """Bodies turn with `turning` Ω [rad/s] about the world's origin and travel with `travel` [m/s], both in world axes,
    (3,) and (bodies, 3), and spin in addition with `spins` [rad/s], in body axes, (bodies that rotate, 3). Scalar
    coordinates and counts of turns `advance` at constant rates.

    `ṙ = travel + Ω × r`, `ṗ = ½ (Ω p + p s)`, `v̇ = Ω × v`, `ω̇ = ω × s`.
    """

    turning: Float[Array, "3"]
    travel: Float[Array, "b 3"]
    spins: Float[Array, "r 3"]
    advance: Float[Array, "s"]
    index: BodyIndex

    def field(self, state):
        index = self.index
        position, velocity = np.array(index.position), np.array(index.velocity)
        d = position.shape[1]
        turned = jax.vmap(lambda x: cross(self.turning, _spatial(x))[:d])
        dq = jnp.zeros_like(state.q).at[position].set(self.travel[:, :d] + turned(state.q[position]))
        dq = dq.at[np.array(index.scalars, int)].set(self.advance) if index.scalars else dq
        du = jnp.zeros_like(state.u).at[velocity].set(turned(state.u[velocity]))
        if not index.attitude:
            return State(dq, du)
        attitude, spin = np.array(index.attitude), np.array(index.spin)
        if d == 2:
            return State(dq.at[attitude].set(self.turning[2] + self.spins[:, 2:]), du)
        p, omega = state.q[attitude], state.u[spin]
        whole = jnp.concatenate([jnp.zeros(1, p.dtype), self.turning])
        dp = jax.vmap(lambda p, s: 0.5 * multiply(whole, p) + rotations.rates(p, s))(p, self.spins)
        return State(dq.at[attitude].set(dp), du.at[spin].set(jax.vmap(cross)(omega, self.spins)))


def carriers(system: AbstractSystem, state: State, rates: State, length: Any) -> Any:
    """The displacements that may carry a motion along, stacked on axis 0: bodies that travel and spin on their own;
    bodies that turn together, as slowly as the motion allows, or with as little spin in addition.

    **Arguments:** `rates`: q̇ and u̇ at the state; `length`: the system's size [m].
    """
    if not system.body_names:
        return jax.tree.map(lambda x: x[None], Advance(rates.q))
    index = body_index(system)
    vectors = ((index.position, state.q), (index.velocity, state.u), (index.velocity, rates.u))
    place, speed, change = (jax.vmap(_spatial)(values[np.array(where)]) for where, values in vectors)
    attitude, spin, spin_change = _attitudes(index, state, rates)
    none = jnp.zeros(3, state.q.dtype)
    advance = rates.q[np.array(index.scalars, int)]
    own = Bodies(none, speed, spin, advance, index)
    # Rows of ṙ = V + Ω × r, v̇ = Ω × v and ω̇ = Ω × ω (all in world axes) for (Ω, V / length), in units of their sizes.
    fastest = jnp.maximum(jnp.max(jnp.abs(speed)) / length, jnp.max(jnp.abs(spin), initial=0.0))
    fastest = lax.stop_gradient(jnp.where(fastest > 0, fastest, 1.0))
    matrix = jax.vmap(lambda x: jax.vmap(lambda e: cross(e, x), out_axes=1)(jnp.eye(3, dtype=x.dtype)))
    unit = jnp.broadcast_to(jnp.eye(3, dtype=state.q.dtype), (len(index.rotates), 3, 3))
    nothing = jnp.zeros_like(unit)
    omega = jax.vmap(rotate)(attitude, spin)
    rows = [
        (matrix(place) / length, unit, speed / length),
        (matrix(speed) / (length * fastest), nothing, change / (length * fastest)),
        (matrix(omega) / fastest, nothing[: len(omega)], jax.vmap(rotate)(attitude, spin_change) / fastest),
    ]
    E = jnp.concatenate([jnp.concatenate([a, b], axis=2).reshape(-1, 6) for a, b, _ in rows])
    e = jnp.concatenate([c.reshape(-1) for *_, c in rows])
    inverse = pseudoinverse(E)
    slow = inverse @ e
    # Ω − ω of every body is least in addition, among solutions of the same rows.
    free = jnp.eye(6, dtype=e.dtype) - inverse @ E
    least = jnp.tile(jnp.eye(3, 6, dtype=e.dtype), (len(omega), 1))
    together = slow + free @ (pseudoinverse(least @ free) @ (omega.reshape(-1) - least @ slow))

    def of_twist(w):
        travel = jnp.broadcast_to(length * w[None, 3:], speed.shape)
        return Bodies(w[:3], travel, spin - jax.vmap(lambda p: unrotate(p, w[:3]))(attitude), advance, index)

    return jax.tree.map(lambda *x: jnp.stack(x), own, of_twist(slow), of_twist(together))


def _spatial(x):
    return jnp.pad(x, (0, 3 - x.shape[0]))


def _attitudes(index, state, rates):
    """Euler parameters, angular velocities and accelerations in body axes, of the bodies that rotate."""
    if not index.attitude:
        empty = jnp.zeros((0, 3), state.q.dtype)
        return jnp.zeros((0, 4), state.q.dtype), empty, empty
    attitude, spin = state.q[np.array(index.attitude)], state.u[np.array(index.spin)]
    change = rates.u[np.array(index.spin)]
    if attitude.shape[1] == 4:
        return attitude, spin, change
    axis = jnp.array([0.0, 0.0, 1.0], attitude.dtype)
    along = lambda x: x * axis[None, :]
    return jax.vmap(lambda a: from_axis_angle(axis, a[0]))(attitude), along(spin), along(change)
