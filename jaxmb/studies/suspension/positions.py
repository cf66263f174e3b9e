"""Positions of a suspension whose wheel travel and steering are prescribed.

The rows R are the constraints, the height of the wheel's centre and the steering. Where these determine the position,
it follows from R = 0 alone. Otherwise it is a static equilibrium,

    F(q) + Rᵤᵀ λ + load = 0,    R(q) = 0

The vertical force that holds the travel acts at the wheel's centre. Newton's method starts from the guess and meets
travel, steering and load in steps. The positions are differentiated by the implicit function theorem.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..._types import Coordinates
from ...linalg.elimination import full_pivot, solve
from ...linalg.newton import root
from ...linalg.rotations import norm
from ...states.closest import tolerance
from ...system import with_parameters
from ...system.instant import Instant
from ...system.parameters import parameters
from ..linear.pseudoinverse import pseudoinverse
from .wheel import Wheel

# The number of steps from the guess to a position, and the largest number of corrections in each. Corrections have a
# largest size in units of the system's size and radians, a size from which they are not shortened, and a least share.
_STEPS, _CORRECTIONS, _LONGEST, _SMALL, _LEAST = 6, 40, 0.5, 1e-6, 1e-9
# Singular values and stiffnesses below this part of the largest are rounding errors.
_NEGLIGIBLE, _UNRESISTED = 1e-12, 1e-10


class Steering(NamedTuple):
    """A number that steers, static: its `name`; `of`: whether it is a "coordinate" of the system, with the index
    `where` in q, a "joint" coordinate, or a "parameter", with the index `where` of its component.
    """

    name: str
    of: str
    where: Any


class Inputs(NamedTuple):
    """The `travel` [m] and the `steer` displacement; the `load` at the contact patch: forces along x and y [N], the
    moment about z [N m].
    """

    travel: Float[Array, ""]
    steer: Float[Array, ""]
    load: Float[Array, "3"]


class Rig(eqx.Module):
    """A suspension on a rig.

    **Fields:** the `system`, the time `t` [s], the `guess` q, from which travel and steering count, and the `wheel`;
    `steering`, or None; `chosen`: the independent rows, or None for all rows; `stiffness`: the unit of forces in scaled
    velocities.
    """

    system: Any
    t: Array
    guess: Coordinates
    wheel: Wheel
    steering: Steering | None = eqx.field(static=True)
    chosen: Int[Array, "r"] | None = None
    stiffness: Float[Array, ""] | None = None

    @property
    def prescribed(self) -> int:
        """The number of prescribed numbers that are rows."""
        return 1 if self.steering is None or self.steering.of == "parameter" else 2

    @property
    def rank(self) -> int:
        """The number of independent rows."""
        return self.system.velocity_rank + self.prescribed

    @property
    def freedoms(self) -> int:
        """The number of freedoms that the rows leave to forces."""
        return self.system.nu - self.rank

    def steered(self, inputs: Inputs) -> Any:
        """The system with the parameter that steers."""
        if self.steering is None or self.steering.of != "parameter":
            return self.system
        name, where = self.steering.name.split("[")[0], self.steering.where
        value = parameters(self.system)[name]
        return with_parameters(self.system, {name: value.at[where].add(inputs.steer)})

    def rows(self, inputs: Inputs, q: Coordinates) -> Float[Array, "r"]:
        """The independent rows of R, in units of the system's size."""
        length = lax.stop_gradient(self.system.length)
        return jnp.concatenate([self.independent(self.constraints(inputs, q)), self.held(inputs, q)]) / length

    def constraints(self, inputs: Inputs, q: Coordinates) -> Float[Array, "m"]:
        """The residuals of the constraints."""
        return self.steered(inputs).position_residual(self.t, q)

    def independent(self, rows: Float[Array, "m"]) -> Float[Array, "r"]:
        """The rows of the constraints that do not follow from others."""
        return rows if self.chosen is None else rows[self.chosen]

    def held(self, inputs: Inputs, q: Coordinates) -> Float[Array, "k"]:
        """The residuals of the prescribed travel and coordinate."""
        rise = self.wheel.height(self.system, q) - self.wheel.height(self.system, self.guess) - inputs.travel
        if self.prescribed == 1:
            return rise[None]
        return jnp.stack([rise, self._steering(q) - self._steering(self.guess) - inputs.steer])

    def _steering(self, q):
        of, where = self.steering.of, self.steering.where  # pyright: ignore[reportOptionalMemberAccess]
        if of == "coordinate":
            return q[where]
        return self.system.catalogue.joint_coordinate(where, self.t, q)

    def moved(self, q: Coordinates, step: Float[Array, "nu"]) -> Coordinates:
        """The position after a small displacement in scaled velocities."""
        rest = jnp.zeros(self.system.nu, q.dtype)
        return Instant(self.system, self.t, q, rest).moved(self.system.velocity_scale() * step).q

    def prepared(self) -> "Rig":
        """The rig with its independent rows and its stiffness at the guess."""
        rig, q, rest = lax.stop_gradient(self), self.guess, jnp.zeros(self.system.nu, self.guess.dtype)
        system, chosen, stiffness = rig.system, None, None
        if system.velocity_rank < system.position_rows:
            rows = lambda step: system.position_residual(rig.t, rig.moved(q, step))
            chosen = full_pivot(jax.jacfwd(rows)(rest)).order.rows[: system.velocity_rank]
        if self.freedoms:
            forces = lambda step: system.velocity_scale() * system.force(rig.t, rig.moved(q, step), rest)
            largest = jnp.max(jnp.abs(jax.jacfwd(forces)(rest)))
            stiffness = jnp.where(largest > 0, largest, 1.0)
        return dataclasses.replace(self, chosen=chosen, stiffness=stiffness)

    def balance(self, at: "Position", inputs: Inputs, x: Float[Array, "n"]) -> Float[Array, "n"]:
        """All equations of a position, for x: a small displacement from it, and with freedoms changes of λ.

        Forces are in units of the stiffness.
        """
        at = at.shifted(self, x)
        rows = self.rows(inputs, at.q)
        unit = self.stiffness
        if unit is None:
            return rows
        system, rest = self.steered(inputs), jnp.zeros(self.system.nu, at.q.dtype)
        rank, length = self.system.velocity_rank, lax.stop_gradient(self.system.length)
        multipliers = at.multipliers * unit / length
        of_rows = multipliers[:rank]
        if self.chosen is not None:
            of_rows = jnp.zeros(self.system.position_rows, rest.dtype).at[self.chosen].set(of_rows)
        force = system.force(self.t, at.q, rest) + system.constraint_force(self.t, at.q, rest, of_rows)
        force += self.wheel.load(system, at.q, inputs.load, multipliers[rank])
        force = system.velocity_scale() * force
        if self.prescribed == 2:
            _, pull = jax.vjp(lambda step: self._steering(self.moved(at.q, step)), rest)
            force += pull(multipliers[-1])[0]
        return jnp.concatenate([force / unit, rows])


class Position(NamedTuple):
    """A position: `q`; the `multipliers` λ of the independent rows, in units of the stiffness; whether it is a solution
    (`ok`); `free`: a displacement that no force resists, or along which forces lead away, in scaled velocities, else
    zero.
    """

    q: Coordinates
    multipliers: Float[Array, "r"]
    ok: Bool[Array, ""]
    free: Float[Array, "nu"]

    def shifted(self, rig: Rig, x: Float[Array, "n"]) -> "Position":
        """The position after a displacement and a change of multipliers."""
        nu = rig.system.nu
        return self._replace(q=rig.moved(self.q, x[:nu]), multipliers=self.multipliers + x[nu:])


class _Search(NamedTuple):
    """A search for a position: the position and the size of its residuals; the matrix of the equations; the next
    `step`, a `share` of a step of Newton's method, and its largest displacement; whether the position was reached by a
    negligible step; the number of steps.
    """

    at: Position
    residual: Float[Array, ""]
    matrix: Float[Array, "n n"]
    step: Float[Array, "n"]
    share: Float[Array, ""]
    longest: Float[Array, ""]
    done: Bool[Array, ""]
    k: Int[Array, ""]


def _corrected(rig: Rig, inputs: Inputs, at: Position) -> tuple[Position, Float[Array, "n n"]]:
    """The position by Newton's method from another, with shorter steps where residuals grow; and the matrix there."""
    n, dtype = rig.system.nu + at.multipliers.size, at.q.dtype
    still, none, close = jnp.zeros(n, dtype), jnp.zeros((), dtype), float(jnp.finfo(dtype).eps) ** 0.5

    def advance(search):
        trial = search.at.shifted(rig, search.step)
        equations = lambda x: (rig.balance(trial, inputs, x),) * 2
        matrix, value = jax.jacfwd(equations, has_aux=True)(still)
        residual = norm(value)
        # The last steps change the residuals by rounding errors only.
        good = (residual < search.residual) | ((search.longest < _SMALL) & jnp.isfinite(residual))
        # Freedoms that neither rows nor forces bind do not move.
        step = -(pseudoinverse(matrix, _NEGLIGIBLE) @ value if rig.freedoms else solve(matrix, value))
        longest = jnp.max(jnp.abs(step[: rig.system.nu]))
        limited = jnp.where(longest > _LONGEST, _LONGEST / longest, 1.0)
        # After a whole step below the root of eps the error is of the order of eps.
        done = good & (search.longest <= close) & (search.share == 1.0) & (search.k > 0)
        fresh = _Search(trial, residual, matrix, limited * step, limited, limited * longest, done, search.k + 1)
        shorter = search._replace(
            step=0.25 * search.step, share=0.25 * search.share, longest=0.25 * search.longest, k=search.k + 1
        )
        return jax.tree.map(lambda new, old: jnp.where(good, new, old), fresh, shorter)

    def proceed(search):
        return ~search.done & (search.k < _CORRECTIONS) & (search.share > _LEAST)

    start = _Search(
        at, none + jnp.inf, jnp.eye(n, dtype=dtype), still, none + 1.0, none, jnp.array(False), jnp.array(0)
    )
    search = lax.while_loop(proceed, advance, start)
    unmet = jnp.max(jnp.abs(rig.constraints(inputs, search.at.q)), initial=0.0) / rig.system.length
    return search.at._replace(ok=search.done & (unmet <= tolerance(dtype))), search.matrix


def approached(rig: Rig, inputs: Inputs) -> tuple[Position, Float[Array, "n n"]]:
    """The position in steps from the guess, and the matrix of its equations, without derivative."""
    rig, inputs = lax.stop_gradient((rig, inputs))

    def advance(carry, share):
        return _corrected(rig, jax.tree.map(lambda x: share * x, inputs), carry[0]), None

    nu, dtype = rig.system.nu, rig.guess.dtype
    none = jnp.zeros(rig.rank if rig.freedoms else 0, dtype)
    start = Position(rig.guess, none, jnp.array(True), jnp.zeros(nu, dtype)), jnp.eye(nu + none.size, dtype=dtype)
    shares = jnp.linspace(0.0 if rig.freedoms else 1 / _STEPS, 1.0, _STEPS + bool(rig.freedoms), dtype=dtype)
    at, matrix = lax.scan(advance, start, shares)[0]
    if rig.freedoms:
        free = _unresisted(rig, at, matrix)
        at = at._replace(free=free, ok=at.ok & ~jnp.any(free))
    return at, matrix


def _unresisted(rig: Rig, at: Position, matrix: Float[Array, "n n"]) -> Float[Array, "nu"]:
    """A displacement that the rows allow, if forces lead away along it, or if it moves the wheel and no force resists;
    else zero.
    """
    nu = rig.system.nu
    motions = jnp.linalg.svd(matrix[nu:, :nu], full_matrices=True)[2][rig.rank :]
    stiffness = -motions @ matrix[:nu, :nu] @ motions.T
    values, vectors = jnp.linalg.eigh(0.5 * (stiffness + stiffness.T))
    along = vectors.T @ motions
    pose = lambda step: rig.wheel.pose(rig.system, rig.moved(at.q, step))
    moves = norm(along @ jax.jacfwd(pose)(jnp.zeros(nu, at.q.dtype)).T) > _UNRESISTED**0.5
    loose = (jnp.abs(values) <= _UNRESISTED) & moves
    bad = (values < -_UNRESISTED) | loose
    return jnp.where(jnp.any(bad), along[jnp.argmax(bad)], 0.0)


class Solved(NamedTuple):
    """A position with derivatives: `x`, zero but for derivatives, as in `Rig.balance`; and `tangents`, the derivatives
    of x by the inputs, one after the other.
    """

    at: Position
    x: Float[Array, "n"]
    tangents: Float[Array, "n inputs"]


def solved(rig: Rig, inputs: Inputs) -> Solved:
    """The position for travel, steering and load."""
    at, matrix = approached(rig, inputs)
    still = jnp.zeros(matrix.shape[0], matrix.dtype)
    equations = lambda x, w: rig.balance(at, as_inputs(w), x)
    if rig.freedoms:
        # Freedoms that neither rows nor forces bind do not move.
        inverse = pseudoinverse(matrix, _NEGLIGIBLE)
        loose = jnp.eye(still.size, dtype=still.dtype) - inverse @ matrix
        equations = lambda x, w: inverse @ rig.balance(at, as_inputs(w), x) + loose @ x
    # Without a position, equations with a solution replace these, so that derivatives stay finite.
    closed = lambda x, w: jnp.where(at.ok, equations(x, w), x)
    # JAX 0.10 derives a vectorised root only if its start depends on all that is vectorised.
    w = as_vector(inputs)
    start = jnp.where(at.ok & jnp.all(jnp.isfinite(w)), still, -still)
    x = root(lambda x: closed(x, w), start, lambda _, x: x)
    by_x, by_inputs = jax.jacfwd(closed, (0, 1))(x, w)
    return Solved(at, x, -solve(by_x, by_inputs))


def as_vector(inputs: Inputs) -> Float[Array, "5"]:
    """Travel, steering and load, one after the other."""
    return jnp.concatenate([inputs.travel[None], inputs.steer[None], inputs.load])


def as_inputs(w: Float[Array, "5"]) -> Inputs:
    """The inverse of `as_vector`."""
    return Inputs(w[0], w[1], w[2:])
