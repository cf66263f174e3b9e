"""Consistent initial states: the closest configuration and velocities that satisfy every constraint.

The first step finds the configuration closest to the guess with `Φ(t, q) = 0` and the coordinates fixed by name. The
second step finds the velocities closest to the guess with `ψ(t, q, u) = 0` and the rates fixed by name. See
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
from ..parts.modes import CLOSED, OPEN
from ..parts.names import names_arguments
from ..system import AbstractSystem
from ..system.instant import Instant
from ..system.quantities import rates_of
from .arguments import (
    check_system,
    checked_guess,
    checked_time,
    counted_angles,
    holding,
    prescribe,
    split_coordinates,
    split_internal_states,
    split_rates,
)
from .consistency import not_finite
from .headings import check_headings
from .nearest import Configuration, Velocities
from .refusals import cannot_assemble, cannot_move

# Rounding errors of residuals, in units of the machine's precision and the coordinates' size.
_ROUNDING = 4.0
# The fraction by which given velocities must change for a warning, and the largest number of names in it.
_CHANGED, _NAMED = 0.01, 3


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
    - `guess`: the start, default the poses and velocities given with the bodies; velocities that were not given are
        zero. So a lone `angular_velocity` of a body that a joint holds is changed, with a warning: prescribe it by
        `rates`.
    - `fix`: coordinates that must have these values, by name: `{"crank.angle": 0.3}` of a body, `{"hip.angle": 0.3}` of
        a joint. `{"floor.mode": 1}` closes a contact, 0 opens it. `{"motor.torque": 2.0}` sets an internal state; other
        internal states are taken from the guess.
    - `rates`: rates that must have these values, by the names of rates or of coordinates: `{"crank.angle": 2.0}` is
        `{"crank.angle_rate": 2.0}`. Other names are `"hip.angle_rate"` of a joint; `"body.angular_velocity"` (body
        frame) and `"body.velocity"` in space; and for a `LagrangianSystem` `"theta_rate"`, or the quasi-velocities
        `u0`, `u1`, ….
    - `t`: the time, for driven mechanisms [s].
    - `throw`: whether to raise an error if the mechanism cannot be assembled. By default an error is raised, except
        under `jit`, `vmap` or a derivative. There, and with `False` everywhere, the state is NaN, so that one member of
        a batch does not spoil the others; `assembly_gap` measures the remaining gap. `True` raises under `jit` as well,
        by a callback to Python; JAX does not cache such programs on disk.

    **Returns:** a `State`, differentiable by the parameters, the guess and the prescribed values. It is the closest
    state to the guess: the sum of the squares of all changes is the least, with positions and velocities in units of
    the system's size and angles in radians. Coordinates that `fix` does not hold may depend on a parameter, and a
    derivative by the parameter contains their change.

    **Raises:** `ValueError` if the mechanism cannot be assembled, coordinates cannot be fixed together, or rates
    contradict each other; the message names the joints with their residuals, the coordinates or the rates. Consistent
    rates may outnumber the degrees of freedom. With `throw=True` under `jit`, a run-time error without the names.
    """
    check_system("assemble", system)
    of_bodies = guess is None and rates is None
    guess = checked_guess("assemble", system, guess)
    t = checked_time("assemble", t, guess.q.dtype)
    z, fix = split_internal_states(system, guess.z, fix)
    fix, of_joints = split_coordinates(system, fix)
    angles = counted_angles(system, guess, of_joints)
    rates, rates_of_joints = split_rates(system, rates)
    u, fixed_rates = prescribe("rate", rates_of(system.rate_names()) if rates else {}, rates, guess.u)
    if not is_traced(u):
        _check_finite(system, "rates", u=u)
    raises = throw is not False
    q, _, ok = configuration(holding(system, of_joints, {}, t), guess.q, fix, t, raises)
    if rates_of_joints:
        joint_coordinates = system.joint_coordinates()
        values = {name: _joint_coordinate(system, joint_coordinates[name], t, q) for name in rates_of_joints}
        system = holding(system, values, rates_of_joints, t)
    # A scleronomic mechanism at rest needs no solve for velocities, so nothing is compiled for it.
    is_concrete = not is_traced((system, guess, fix, u, t))
    at_rest = is_concrete and system.drift_free and not np.any(np.asarray(u)) and not np.any(fixed_rates)
    at = Instant(system, t, q, u)
    free = at_rest or not system.velocity_rows
    u, ok_rates = (u, True) if free else Velocities(at, tuple(fixed_rates.tolist())).found()
    # Under a derivative `ok` and `ok_rates` may be concrete although the state is traced.
    traced = is_traced((system, q, u, t))
    # Within a trace, results from concrete numbers are traced too.
    if raises and not is_traced((ok, ok_rates)):
        if not ok_rates and not traced:
            raise ValueError(cannot_move(at.with_(u=u), fixed_rates))
        if ok and ok_rates:
            if not traced:
                check_headings(system, t, q, "the assembled pose")
            if of_bodies and not is_traced((system, u)):
                _warn_of_changed_velocities(system, guess.u, u)
            return State(q, u, z, angles)
    ok = ok & ok_rates
    if throw:
        q = eqx.error_if(
            q, ~ok, "The mechanism cannot be assembled; call assemble outside jit to see which joints are violated."
        )
    state = State(q, u, z, angles)
    return state if throw else nan_where(jnp.logical_not(ok), state, (system, guess, fix, rates, t))


def _warn_of_changed_velocities(system, given, assembled):
    """Warn about velocities that were given with bodies and contradict the constraints."""
    given, assembled = np.asarray(given), np.asarray(assembled)
    least = np.min(np.abs(given[given != 0]), initial=np.inf)
    if not np.any(given) or np.max(np.abs(assembled - given)) <= 0.5 * _CHANGED * least:
        return
    changed = []
    for name, index in rates_of(system.rate_names()).items():
        size = np.linalg.norm(given[index])
        if name.endswith("velocity") and np.linalg.norm(assembled[index] - given[index]) > _CHANGED * size > 0:
            before, after = (", ".join(f"{value:.4g}" for value in x[index]) for x in (given, assembled))
            changed.append(f"{name} is {after} instead of {before}")
    if changed:
        rest = f", and {len(changed) - _NAMED} more" if len(changed) > _NAMED else ""
        first = changed[0].split(" is ")[0]
        warnings.warn(
            "The velocities given with the bodies contradict the constraints; velocities left out are zero. In the "
            f"closest consistent state {'; '.join(changed[:_NAMED])}{rest}. "
            f"assemble(system, rates={{{first!r}: …}}) prescribes a rate, from which the others follow.",
            stacklevel=4,
        )


def configuration(
    system: AbstractSystem, guess: Coordinates, fix: Mapping[str, VectorLike] | None, t: Scalar, throw: bool
) -> tuple[Float[Array, "nq"], Bool[np.ndarray, "nq"], Bool[Array, ""]]:
    """The first half of `assemble`: coordinates, a mask of prescribed coordinates, and whether the constraints hold.

    With `throw` violated constraints raise a `ValueError`, unless something is traced.
    """
    q, fixed = prescribe("coordinate", system.coordinate_names() if fix else {}, {} if fix is None else fix, guess)
    if not is_traced(q):
        _check_modes(system, q, fixed)
        _check_finite(system, "coordinates", q=q)
    # The row of an open contact determines its mode.
    fixed[list(system.contacts.contact_places)] = False
    q, whole = system.normalize_fixed(q, fixed) if fixed.any() else (q, 0)
    if not system.coordinate_rows:
        return q, fixed, jnp.array(True)
    # The poses of compilation often satisfy the constraints already; then no search is compiled.
    if guess is system.guess.q and not fixed.any() and not is_traced((system, t)) and system.on_host(t) is None:
        met = _is_met(system, t, q)
        # Within a trace, results from concrete numbers are traced too.
        if not is_traced(met) and met:
            return q, fixed, jnp.array(True)
    q, ok = Configuration(system, t, q, tuple(fixed.tolist()), system.coordinate_rank - whole).found()
    if throw and not is_traced((system, t, q, ok)) and not ok:
        raise ValueError(cannot_assemble(system, t, q, fixed))
    return q, fixed, ok


def _check_modes(system, q, fixed):
    for name, k in zip(system.contacts.contact_names, system.contacts.contact_places, strict=True):
        if fixed[k] and q[k] not in (OPEN, CLOSED):
            raise ValueError(f"Coordinate '{name}.mode' is 1 to close the contact, or 0 to open it; got {q[k]:g}.")


@jitted
def _joint_coordinate(system, coordinate, t, q):
    return system.catalogue.joint_coordinate(coordinate, t, q)


@jitted
def _is_met(system, t, q):
    """Whether the constraints hold up to rounding errors of their terms."""
    size = jnp.max(jnp.abs(q), initial=0.0) + jnp.max(system.coordinate_scale(), initial=0.0)
    return jnp.max(jnp.abs(system.coordinate_residual(t, q)), initial=0.0) <= _ROUNDING * jnp.finfo(q.dtype).eps * size


def _check_finite(system, what, **vector):
    wrong = not_finite(system, **vector)
    if wrong:
        raise ValueError(f"The guess or the fixed {what} are not finite: {wrong}.")
