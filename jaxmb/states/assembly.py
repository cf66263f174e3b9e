"""Consistent initial states: the closest configuration and velocities that satisfy every constraint.

The first step finds the configuration closest to the guess that satisfies `Φ(t, q) = 0` and the coordinates fixed by
name, the second the velocities closest to the guess that satisfy `ψ(t, q, u) = 0` and the rates fixed by name; see
`states/closest.py`.
"""

import warnings
from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._types import Coordinates, Scalar, State, VectorLike
from ..linalg.arrays import is_traced
from ..linalg.failure import nan_where
from ..linalg.jitted import jitted
from ..parts.names import names_arguments
from ..system import AbstractSystem
from ..system.gaps import CLOSED, OPEN
from ..system.quantities import directions, rates_of
from .arguments import (
    check_system,
    checked_guess,
    checked_time,
    holding,
    prescribe,
    split_coordinates,
    split_internal_states,
    split_rates,
)
from .closest import closest_configuration, closest_velocities
from .consistency import listed

# Rounding errors of residuals, in units of the machine's precision and the coordinates' size.
_ROUNDING = 4.0
# Velocities that were given count as changed by more than this fraction; this many of them are named.
_CHANGED, _NAMED = 0.01, 3
# Singular values, of rows of unit length, that count as zero.
_DEPENDENT = 1e-8


@names_arguments
def assemble(
    system: AbstractSystem,
    guess: State | None = None,
    *,
    fix: Mapping[str, VectorLike] | None = None,
    rates: Mapping[str, VectorLike] | None = None,
    t: Scalar = 0.0,
    throw: bool | None = None,
) -> State:
    """Find a consistent state near a guess.

    ```python
    state = jaxmb.assemble(system, fix={"bar.angle": 0.5}, rates={"pin.angle": 2.0})
    ```

    **Arguments:**

    - `system`: a compiled scene, or another system.
    - `guess`: where to start, default the poses and velocities given with the bodies; those that were not given are
        zero there, so that a lone `angular_velocity` of a body that a joint holds is changed, with a warning:
        prescribe it by `rates`.
    - `fix`: coordinates that must have these values, by name: `{"crank.angle": 0.3}` of a body, or `{"hip.angle": 0.3}`
        of a joint's own; `{"floor.mode": 1}` closes a contact, 0 opens it; and values of internal states,
        `{"motor.torque": 2.0}`. Other internal states are those of the guess.
    - `rates`: rates that must have these values, by their names or those of their coordinates: `{"crank.angle": 2.0}`
        is `{"crank.angle_rate": 2.0}`, also of a joint's own coordinates, `"hip.angle_rate"`; in space
        `"body.angular_velocity"` (body frame) and `"body.velocity"`; of a `LagrangianSystem` `"theta_rate"`, or the
        quasi-velocities `u0`, `u1`, ….
    - `t`: the time, for driven mechanisms [s].
    - `throw`: whether a mechanism that cannot be assembled is an error. By default it is, but under `jit`, `vmap` or
        a derivative the state is NaN instead, so that one member of a batch does not spoil the others, as it is with
        `False` everywhere; `assembly_gap` says how far it is from closing. With `True` it is an error under `jit` as
        well, by a call of Python from the program, which JAX then does not keep on disk.

    **Returns:** a `State`, differentiable with respect to the parameters, the guess and the prescribed values. It is
    the closest one: the sum of the squares of all changes is the least, of positions and velocities in units of the
    system's size, of angles in radians. Where a parameter moves the mechanism, coordinates that
    `fix` does not hold change as well, and a derivative by the parameter contains that.

    **Raises:** `ValueError` naming the joints with their residuals if the mechanism cannot be assembled, the
    coordinates that cannot be fixed together, or rates that contradict each other; consistent rates may outnumber the
    degrees of freedom. With `throw=True` under `jit`, a run-time error without the names.
    """
    check_system("assemble", system)
    of_bodies = guess is None and rates is None
    guess = checked_guess("assemble", system, guess)
    t = checked_time("assemble", t, guess.q.dtype)
    z, fix = split_internal_states(system, guess.z, fix)
    fix, of_joints = split_coordinates(system, fix)
    rates, rates_of_joints = split_rates(system, rates)
    u, fixed_rates = prescribe("rate", rates_of(system.rate_names()) if rates else {}, rates, guess.u)
    if not is_traced(u):
        _check_finite(u, "rates")
    raises = throw is not False
    q, _, ok = configuration(holding(system, of_joints, {}, t), guess.q, fix, t, raises)
    if rates_of_joints:
        known = system.joint_coordinates()
        here = {name: system.joint_coordinate(known[name], t, q) for name in rates_of_joints}
        system = holding(system, here, rates_of_joints, t)
    # A scleronomic mechanism at rest needs no solve for velocities, so nothing is compiled.
    known = not is_traced((system, guess, fix, u, t))
    at_rest = known and system.drift_free and not np.any(np.asarray(u)) and not np.any(fixed_rates)
    u, ok_rates = (u, True) if at_rest else closest_velocities(system, t, q, u, tuple(fixed_rates.tolist()))
    # Under a trace, results of concrete numbers are traced as well.
    if raises and not is_traced((ok, ok_rates)):
        if not ok_rates:
            raise ValueError(_cannot_move(system, t, q, u, fixed_rates))
        if of_bodies and not is_traced((system, u)):
            _warn_of_changed_velocities(system, guess.u, u)
        return State(q, u, z)
    ok = ok & ok_rates
    if throw:
        q = eqx.error_if(
            q, ~ok, "The mechanism cannot be assembled; call assemble outside jit to see which joints are violated."
        )
    state = State(q, u, z)
    return state if throw else nan_where(jnp.logical_not(ok), state, (system, guess, fix, rates, t))


def _warn_of_changed_velocities(system, given, found):
    """Warn where velocities that were given with bodies contradict the constraints."""
    given, found = np.asarray(given), np.asarray(found)
    least = np.min(np.abs(given[given != 0]), initial=np.inf)
    if not np.any(given) or np.max(np.abs(found - given)) <= 0.5 * _CHANGED * least:
        return
    changed = []
    for name, index in rates_of(system.rate_names()).items():
        size = np.linalg.norm(given[index])
        if name.endswith("velocity") and np.linalg.norm(found[index] - given[index]) > _CHANGED * size > 0:
            before, after = (", ".join(f"{value:.4g}" for value in x[index]) for x in (given, found))
            changed.append(f"{name} is {after} instead of {before}")
    if changed:
        more = f", and {len(changed) - _NAMED} more" if len(changed) > _NAMED else ""
        first = changed[0].split(" is ")[0]
        warnings.warn(
            "The velocities given with the bodies, of which those left out are zero, contradict the constraints. Of "
            f"the closest ones that do not, {'; '.join(changed[:_NAMED])}{more}. "
            f"assemble(system, rates={{{first!r}: …}}) prescribes a rate, from which the others follow.",
            stacklevel=4,
        )


def configuration(
    system: AbstractSystem, guess: Coordinates, fix: Mapping[str, VectorLike] | None, t: Scalar, throw: bool
) -> tuple[Float[Array, "nq"], Bool[np.ndarray, "nq"], Bool[Array, ""]]:
    """The first half of `assemble`: the coordinates, a mask of those that were prescribed, and whether the constraints
    hold; an error if not, with `throw` and outside `jit`.
    """
    q, fixed = prescribe("coordinate", system.coordinate_names() if fix else {}, {} if fix is None else fix, guess)
    if system.contacts is not None:
        if not is_traced(q):
            _check_modes(system, q, fixed)
        # A contact that is open determines its own mode.
        fixed[np.array(system.contacts.modes, int)] = False
    if not is_traced(q):
        _check_finite(q, "coordinates")
    q, whole = system.normalize_fixed(q, fixed) if fixed.any() else (q, 0)
    # The poses that a system was compiled at are often their own closest configuration; then nothing is compiled.
    if guess is system.guess.q and not fixed.any() and not is_traced((system, q, t)):
        met = _is_met(system, t, q)
        # Under a trace, results of concrete numbers are traced as well.
        if not is_traced(met) and met:
            return q, fixed, jnp.array(True)
    q, ok = closest_configuration(system, t, q, tuple(fixed.tolist()), system.coordinate_rank - whole)
    if throw and not is_traced(ok) and not ok:
        raise ValueError(_cannot_assemble(system, t, q, fixed))
    return q, fixed, ok


def _check_modes(system, q, fixed):
    for name, k in zip(system.contacts.names, system.contacts.modes, strict=True):
        if fixed[k] and q[k] not in (OPEN, CLOSED):
            raise ValueError(f"Coordinate '{name}.mode' is 1 to close the contact, or 0 to open it; got {q[k]:g}.")


@jitted
def _is_met(system, t, q):
    """Whether the constraints hold up to the rounding errors of their terms."""
    size = jnp.max(jnp.abs(q), initial=0.0) + jnp.max(system.coordinate_scale(), initial=0.0)
    return jnp.max(jnp.abs(system.coordinate_residual(t, q)), initial=0.0) <= _ROUNDING * jnp.finfo(q.dtype).eps * size


def _check_finite(vector, what):
    if not np.all(np.isfinite(vector)):
        raise ValueError(f"The guess or the fixed {what} are not finite: {np.asarray(vector)}.")


def violated_joints(system: AbstractSystem, t: Scalar, q: Coordinates, least: float = 1e-9) -> str:
    """The joints that a configuration violates with their largest residuals, the largest first, for messages.

    `least`: residuals below it, relative to the system's size, do not count.
    """
    residual = np.nan_to_num(np.abs(np.asarray(system.position_residual(t, q))), nan=np.inf)
    return listed(system, residual >= least * float(system.length), residual)


def _cannot_assemble(system, t, q, fixed):
    names = system.coordinate_names()
    text = "The mechanism cannot be assembled"
    of_bodies = [name for name, index in names.items() if len(index) == 1 and fixed[index[0]]]
    # Coordinates of joints that are held are rows of their names.
    rows = [k for k, (name, _) in enumerate(system.rows) if name in system.joint_coordinates()]
    held = [*of_bodies, *(system.rows[k][0] for k in rows)]
    if held:
        text += f" with {', '.join(dict.fromkeys(held))} fixed"
    dependent = _dependent(system, t, q, held, [names[name][0] for name in of_bodies], rows)
    violated = violated_joints(system, t, q)
    units = " [m, rad]" if system.body_names else ""
    remain = f"residuals{units} remain in {violated}"
    if dependent:
        return f"{text}: {dependent}{f'; {remain}' if violated else ''}. Fix fewer of them."
    if violated:
        return f"{text}: {remain}. Check lengths, points and axes, or give a better guess."
    if held:
        return f"{text}: these coordinates are not independent of each other. Fix fewer of them, or others."
    return (
        f"{text}: the configuration that is closest to the guess is singular, or not the only one. Give another guess "
        "of the positions."
    )


def _dependent(system, t, q, held, places, rows):
    """Which fixed coordinates the constraints determine, alone or from each other, in a configuration; empty for none.

    **Arguments:** `held`: their names; `places` in q of the first of them, and `rows` that hold the others, which are
    coordinates of joints.

    A motion that the constraints admit changes the fixed coordinates by the rows of a basis of such motions. Rows that
    depend on each other, or vanish, belong to coordinates that cannot be chosen together.
    """
    scale = np.asarray(system.coordinate_scale())
    jacobian = np.asarray(system.coordinate_jacobian(t, q)) * scale
    jacobian /= np.maximum(np.linalg.norm(jacobian, axis=1, keepdims=True), 1e-300)
    _, sizes, right = np.linalg.svd(np.delete(jacobian, rows, axis=0))
    motions = right[np.sum(sizes > _DEPENDENT) :].T
    of_held = np.concatenate([motions[places], jacobian[rows] @ motions])
    left, sizes, _ = np.linalg.svd(of_held)
    combinations = left[:, np.sum(sizes > _DEPENDENT) :]
    sizes = np.max(np.abs(combinations), axis=1, initial=0.0)
    together = [name for name, size in zip(held, sizes, strict=True) if size > 1e-6]
    if not together:
        return ""
    if len(together) == 1:
        return f"the constraints determine {together[0]} already"
    free = len(together) - combinations.shape[1]
    chosen = f"of these {len(together)} coordinates only {free} can be chosen" if free else "none of them can be chosen"
    return f"{', '.join(together[:-1])} and {together[-1]} depend on each other: {chosen}"


def _cannot_move(system, t, q, u, fixed):
    held = [name for k, name in directions(system.rate_names()).items() if fixed[k]]
    residual = np.nan_to_num(np.abs(np.asarray(system.velocity_residual(t, q, u))), nan=np.inf)
    own = system.rows[: system.velocity_rows]
    least = 1e-6 * np.max(residual)
    rows = sorted({name for (name, _), r in zip(own, residual, strict=True) if r >= least})
    if not held:
        return (
            f"No velocities satisfy {', '.join(rows)}: the constraint rows are not independent in this configuration. "
            "Assemble another configuration, with fix or a guess."
        )
    return (
        f"No velocities satisfy {', '.join(rows)} with the rates {', '.join(held)} fixed: these contradict each other. "
        "Fix fewer rates, or others."
    )
