"""The linear equations about a state: derivatives of the equations of motion along its independent perturbations.

Small perturbations of a motion `ẋ = X(x)` on the constraints are tangent to them, and to first order `δẋ = DX δx` does
not depend on values of X off the constraints. So A follows from derivatives of the full equations along a basis of the
tangent space, without multipliers among the unknowns. Forces on dependent coordinates count to second order, since the
accelerations belong to the constrained system.

About a steady motion, perturbations are seen from a co-moving frame (`comoving`), in which the equations are constant.
A comparison with the equations a little later verifies this.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ..._types import Scalar, State
from ...formulations import Partitioned
from ...formulations.laws import accelerations_at
from ...system import AbstractSystem, parameters, with_parameters
from ...system.instant import Instant
from ...system.quantities import Solved
from .comoving import carriers
from .perturbations import Perturbations, StateNames, joined, parted, perturbations
from .quantities import measured

# Largest remaining accelerations, as a fraction of accelerations by the applied forces alone, and of accelerations by
# displacements of the system's size: the accuracy of assembled states.
_UNBALANCED, _ROUNDING = 1e-6, 1e-9
# Negligible relative change of the equations along a steady motion.
_SAME = 1e-6


def vector_field(system: AbstractSystem, t: Scalar, state: State) -> tuple[State, Array]:
    """q̇, u̇ and ż of a state, and the multipliers.

    The unknowns are independent accelerations. With multipliers, derivatives for light and heavy bodies together would
    lose as many digits as the ratio of their masses has.
    """
    at = Instant.of(system, t, state)
    udot, multipliers = accelerations_at(at, Partitioned())
    return at.motion(udot), multipliers


class LinearEquations(NamedTuple):
    """The linear equations and their tests.

    `residual`: X − S at the state, (n,); `steady`: whether the residual vanishes; `moving`: whether the state has
    velocities; `constant`: whether A, B of every input and C, D of every output are the same a little later, (1 +
    inputs + outputs,); `bound`: the mask of inputs that move constraints.
    """

    A: Float[Array, "k k"]
    B: Float[Array, "k i"]
    C: Float[Array, "o k"]
    D: Float[Array, "o i"]
    perturbations: Perturbations
    residual: Float[Array, "n"]
    steady: Bool[Array, ""]
    moving: Bool[Array, ""]
    constant: Bool[Array, "all"]
    bound: Bool[Array, "i"]
    ok: Bool[Array, ""]


class _Local(NamedTuple):
    """Values and derivatives along the states (k) and the inputs (i) at one state."""

    rates: Float[Array, "n"]
    by_states: Float[Array, "n k"]
    by_inputs: Float[Array, "n i"]
    outputs_by_states: Float[Array, "o k"]
    outputs_by_inputs: Float[Array, "o i"]
    rows_by_inputs: Float[Array, "m i"]


@eqx.filter_jit
def linear_equations(
    system: AbstractSystem,
    t: Array,
    state: State,
    names: StateNames,
    inputs: tuple[tuple[str, int], ...],
    outputs: tuple[tuple[str, int], ...],
) -> LinearEquations:
    directions = perturbations(system, t, state, names)
    field, _ = vector_field(system, t, state)
    rate = fastest(system, state, field)
    moving = rate > 0
    later = jnp.where(moving, 0.4 / jnp.where(moving, rate, 1.0), 1.0)

    # The state, and the state after each displacement, with the same perturbations.
    moves = jax.vmap(lambda carrier: carrier.displacement(state, later))(carriers(system, state, field, system.length))
    at = joined(state)
    points = jnp.concatenate([at[None], jax.vmap(lambda move: move.turn @ at + move.shift)(moves)])
    bases = jnp.concatenate([directions.basis[None], jax.vmap(lambda move: move.turn @ directions.basis)(moves)])
    times = jnp.concatenate([t[None], jnp.broadcast_to(t + later, (len(points) - 1,))])
    local = jax.vmap(lambda t, x, basis: _local(system, t, x, basis, inputs, outputs))
    values = local(times, points, bases)
    here = jax.tree.map(lambda x: x[0], values)

    # The residuals in the frame of each displacement, in units of the states' sizes and the fastest rate.
    scales = State(system.coordinate_scale(), system.velocity_scale(), system.state_scale() if system.nz else None)
    sizes, kq, last = joined(scales), directions.coordinates, directions.basis.shape[1] - system.nz
    widths = jnp.max(jnp.abs(directions.basis) / sizes[:, None], axis=0)
    entries = jnp.abs(parted(system, here.by_states).u) / (scales.u[:, None] * widths[None, :])
    omega = rate + jnp.max(entries[:, kq:last], initial=0.0) + jnp.sqrt(jnp.max(entries[:, :kq], initial=0.0))
    omega = jnp.where(omega > 0, omega, 1.0)
    units = joined(dataclasses.replace(scales, u=omega * scales.u))
    widths = jnp.max(jnp.abs(directions.basis) / units[:, None], axis=0)
    single = jnp.finfo(at.dtype).eps > 1e-10
    unbalanced, rounding, same = (3e-4, 1e-5, 1e-3) if single else (_UNBALANCED, _ROUNDING, _SAME)
    allowed = unbalanced * (_applied(system, t, state) + rate**2) / omega**2 + rounding

    def judge(move, after):
        residual = here.rates - (move.rate @ at + move.constant)
        largest = jnp.max(jnp.abs(residual) / units) / omega
        rows = units[:, None]
        pairs = (
            (after.by_states / (rows * widths[None, :]), move.turn @ here.by_states / (rows * widths[None, :])),
            (after.rates / units, move.turn @ here.rates / units),
        )
        states = jnp.stack([jnp.max(jnp.abs(a - b)) <= (same + allowed) * omega for a, b in pairs])
        inputs = _unchanged(after.by_inputs.T / units[None, :], (move.turn @ here.by_inputs).T / units[None, :], same)
        outputs = _unchanged(after.outputs_by_states / widths[None, :], here.outputs_by_states / widths[None, :], same)
        through = _unchanged(after.outputs_by_inputs, here.outputs_by_inputs, same)
        constant = jnp.concatenate([jnp.all(states)[None], inputs, outputs & through])
        return residual, largest, largest <= allowed, constant

    residuals, largest, steady, constant = jax.vmap(judge)(moves, jax.tree.map(lambda x: x[1:], values))
    # The first displacement whose field is the motion's and that leaves the equations unchanged; otherwise the nearest.
    good = steady & constant[:, 0]
    nearest = jnp.where(jnp.any(steady), jnp.argmax(steady), jnp.argmin(largest))
    best = jnp.where(jnp.any(good), jnp.argmax(good), nearest)
    bound = jnp.max(jnp.abs(here.rows_by_inputs), axis=0, initial=0.0) > 0
    ok = jnp.all(directions.regular) & steady[best] & jnp.all(constant[best]) & ~jnp.any(bound)
    return LinearEquations(
        directions.reading @ (here.by_states - moves.rate[best] @ directions.basis),
        directions.reading @ here.by_inputs,
        here.outputs_by_states,
        here.outputs_by_inputs,
        directions,
        residuals[best],
        steady[best],
        moving,
        constant[best],
        bound,
        ok,
    )


def _local(system, t, x, basis, inputs, outputs):
    """Values and derivatives at a state, by one forward derivative."""
    k = basis.shape[1]
    names = tuple(dict.fromkeys(name for name, _ in inputs))
    numbers = parameters(system) if names else {}

    def evaluate(changes):
        values = {name: numbers[name] for name in names}
        for (name, place), change in zip(inputs, changes[k:], strict=True):
            value = values[name]
            values[name] = jnp.ravel(value).at[place].add(change.astype(value.dtype)).reshape(value.shape)
        changed = with_parameters(system, values) if names else system
        state = parted(system, x + basis @ changes[:k])
        field, multipliers = vector_field(changed, t, state)
        rates = joined(field)
        seen = measured(changed, outputs, t, state, Solved(field.u, multipliers))
        rows = jnp.zeros(0, x.dtype)
        if names:
            residuals = changed.position_residual(t, state.q), changed.velocity_residual(t, state.q, state.u)
            rows = jnp.concatenate(residuals)
        return (rates, seen, rows), rates

    (field, seen, rows), rates = jax.jacfwd(evaluate, has_aux=True)(jnp.zeros(k + len(inputs), x.dtype))
    return _Local(rates, field[:, :k], field[:, k:], seen[:, :k], seen[:, k:], rows[:, k:])


def _unchanged(after, before, same):
    """Whether each row of a matrix is unchanged."""
    size = jnp.max(jnp.abs(before), axis=1, initial=0.0)
    rounding = 1e-6 * same * jnp.max(size, initial=0.0)
    return jnp.max(jnp.abs(after - before), axis=1, initial=0.0) <= same * size + rounding


def fastest(system, state, field):
    """The largest rate of the motion [1/s], lengths in units of the system's size."""
    speeds = jnp.max(jnp.abs(state.u) / system.velocity_scale(), initial=0.0)
    return lax.stop_gradient(jnp.maximum(speeds, jnp.max(jnp.abs(field.q) / system.coordinate_scale())))


def _applied(system, t, state):
    """The largest acceleration by applied forces without constraints [1/s²], lengths in units of the system's size."""
    if not system.positive_definite_mass:
        return jnp.zeros((), state.q.dtype)
    at = Instant.of(system, t, state)
    free = at.inertia.solve(at.force)
    return jnp.max(jnp.abs(free) / system.velocity_scale())
