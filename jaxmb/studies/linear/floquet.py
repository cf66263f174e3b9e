"""The stability of periodic motions by Floquet's multipliers."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..._arguments import real_array
from ..._pictured import picture
from ..._printed import preformatted
from ..._types import Scalar, State
from ...linalg.arrays import is_traced
from ...linalg.failure import nan_where
from ...parts.names import names_arguments, unknown
from ...simulate import simulate
from ...states.arguments import check_no_states, check_system, checked_guess, checked_time
from ...states.consistency import consistent
from ...system import AbstractSystem
from ...system.quantities import directions
from .eigen import eigen
from .linearise import state_labels
from .perturbations import check_state_names, perturbations
from .quantities import checked_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The largest distance between the ends of a periodic motion, in units of the system's size, radians and the period; or,
# if larger, the second number times the tolerance of integration.
_CLOSED, _OF_TOLERANCE = 1e-6, 1e4


class Floquet(eqx.Module):
    """The linear map of small perturbations over one period of a periodic motion. `print` shows its multipliers.

    ```python
    print(periodic)  # Its multipliers, for `periodic` from `floquet`.
    periodic.multipliers, periodic.monodromy, periodic.states
    periodic.plot().savefig("multipliers.png")
    ```

    **Fields:** `monodromy` (k, k): the map of perturbations over a period; `states`: names of the perturbations, first
    `coordinates` coordinates, then rates; `basis` (nq + nu, k): the changes of all coordinates and velocities with each
    of `states`; `period` [s].
    """

    monodromy: Float[Array, "k k"]
    states: tuple[str, ...] = eqx.field(static=True)
    coordinates: int = eqx.field(static=True)
    basis: Float[Array, "n k"]
    period: Array

    @property
    def multipliers(self) -> Complex[Array, "k"]:
        """Eigenvalues of the monodromy matrix, the largest first: the motion is unstable if one exceeds 1 in size. The
        multiplier of the motion itself is 1 for an autonomous system. Simple multipliers are differentiable.
        """
        kept = jnp.ones(len(self.states), bool)
        return eigen(self.monodromy, kept)[0][::-1]

    @property
    def exponents(self) -> Complex[Array, "k"]:
        """`log(multiplier) / period` [1/s], up to multiples of `2πi / period`."""
        values = self.multipliers
        return jnp.log(values) / self.period.astype(values.dtype)

    def plot(self) -> "Figure":
        """Draw the multipliers beside the unit circle, within which motions are stable, as a matplotlib `Figure`.

        **Raises:** `ValueError` for a batch; `ImportError` without matplotlib.
        """
        return picture("small_motions.floquet", self)

    def __repr__(self) -> str:
        return f"Floquet: {len(self.states)} states over one period"

    def _repr_html_(self) -> str:
        return preformatted(self)

    def __str__(self) -> str:
        if is_traced(self.monodromy) or self.monodromy.ndim != 2:
            return repr(self)
        lines = [f"period {float(self.period):.6g} s", f"{'multiplier':>26}  {'size':>10}  {'growth [1/s]':>12}"]
        for value, exponent in zip(np.asarray(self.multipliers), np.asarray(self.exponents), strict=True):
            text = f"{value.real:.6g} {'-' if value.imag < 0 else '+'} {abs(value.imag):.6g}i"
            lines.append(f"{text:>26}  {abs(value):>10.6g}  {exponent.real:>12.5g}")
        return "\n".join(lines)


@names_arguments
def floquet(
    system: AbstractSystem,
    state: State,
    period: Scalar,
    *,
    t: Scalar = 0.0,
    coordinates: Sequence[str] | None = None,
    rates: Sequence[str] | None = None,
    ignorable: Sequence[str] = (),
    rtol: Scalar = 1e-10,
    solver: diffrax.AbstractSolver | None = None,
) -> Floquet:
    """Find Floquet's multipliers of a periodic motion, in independent coordinates.

    ```python
    free = jaxmb.Scene([bar], joints=[pin]).compile()
    turning = jaxmb.assemble(free, rates={"pin.angle": 3.0})
    periodic = jaxmb.floquet(free, turning, 2 * np.pi / 3.0)
    periodic.multipliers  # Both are 1: the bar turns uniformly.
    ```

    The motion and its derivatives with respect to all independent perturbations of its start are integrated over one
    period, on the constraints. With contacts and friction they pass through impacts and changes between slip and stick,
    whose times and jumps move with the perturbations. Where a perturbation adds or removes an event, as at a contact
    that only touches, there is no derivative.

    **Arguments:**

    - `system`, `state`: a compiled scene, or another system, and a consistent state of the motion at the time `t` [s].
    - `period` [s], positive.
    - `coordinates`, `rates`: names of states, as in `linearise`.
    - `ignorable`: names of cyclic coordinates, which may advance in a period, such as the place of a vehicle. Angles of
        bodies may make whole turns.
    - `rtol`, `solver`: as in `simulate`.

    **Returns:** a `Floquet`; differentiable with respect to the parameters, the state and the period in forward mode.

    **Raises:** `ValueError` for unknown names, a period that is not positive, a state that violates the constraints,
    and a motion that does not return after the period; the message lists the coordinates that differ. Under a trace the
    result is NaN instead.
    """
    check_system("floquet", system)
    check_no_states("floquet", system)
    state = checked_guess("floquet", system, state)
    t = jnp.asarray(checked_time("floquet", t, state.q.dtype))
    length: Any = real_array("floquet: period", period, state.q.dtype)
    if not is_traced(length) and not 0 < length < np.inf:
        raise ValueError(f"floquet: period must be positive and finite, got {period}.")
    period = jnp.asarray(length)
    rtol = real_array("floquet: rtol", rtol, state.q.dtype)
    names = check_state_names(system, t, state, coordinates, rates)
    free = [_indices(system, name) for name in checked_names("coordinate", ignorable)]
    state = consistent(system, t, State(system.normalize(t, state.q), state.u))
    perturbed = eqx.filter_jit(perturbations)(system, t, state, names)
    if not is_traced((system, state, perturbed.regular)) and not np.all(np.asarray(perturbed.regular)):
        raise ValueError("The state is singular, or the named coordinates or rates are not independent in it.")
    end, pushed = _flow(system, state, perturbed.basis, t, period, rtol, solver)
    distance, pushed = _return(system, state, end, pushed, np.concatenate([np.zeros(0, int), *free]))
    sizes = jnp.concatenate([system.coordinate_scale(), system.velocity_scale() * 2 * np.pi / period])
    far = jnp.abs(distance) / sizes > jnp.maximum(_CLOSED, _OF_TOLERANCE * jnp.asarray(rtol))
    bad = jnp.any(far) | ~jnp.all(perturbed.regular) | ~jnp.all(jnp.isfinite(pushed))
    monodromy = perturbed.reading @ pushed
    if is_traced((monodromy, bad)):
        monodromy = nan_where(bad, monodromy, (system, state, t, period))
    elif not bool(jnp.all(jnp.isfinite(pushed))):
        raise RuntimeError(
            "The motion or its derivatives could not be integrated over the period; simulate the motion to see why."
        )
    elif bad:
        raise ValueError(_open(system, period, np.asarray(distance), np.asarray(far)))
    return Floquet(monodromy, state_labels(system, names, perturbed), perturbed.coordinates, perturbed.basis, period)


def _indices(system, name):
    names = system.coordinate_names()
    if name not in names:
        raise unknown("coordinate", name, names)
    return np.array(names[name], int)


@eqx.filter_jit
def _flow(system, state, basis, t, period, rtol, solver):
    """The state after the period, and its derivatives along the perturbations."""
    nq = system.nq

    def run(z):
        start = State(state.q + basis[:nq] @ z, state.u + basis[nq:] @ z)
        motion = simulate(system, start, t0=t, t1=t + period, rtol=rtol, solver=solver, throw=False)
        end = jnp.concatenate([motion.ys.q[-1], motion.ys.u[-1]])
        return end, end

    pushed, end = jax.jacfwd(run, has_aux=True)(jnp.zeros(basis.shape[1], basis.dtype))
    return end, pushed


def _return(system, state, end, pushed, free):
    """The difference between the end of a motion and its start, and its derivatives; whole turns of bodies and the sign
    of their Euler parameters do not count.
    """
    q, nq = end[: system.nq], system.nq
    names = system.coordinate_names()
    sign = jnp.ones(end.size, end.dtype)
    distance = jnp.concatenate([q - state.q, end[nq:] - state.u])
    for body in system.body_names:
        if (attitude := names.get(f"{body}.orientation")) is not None:
            index = np.array(attitude)
            sign = sign.at[index].set(jnp.where(jnp.dot(q[index], state.q[index]) < 0, -1.0, 1.0))
        elif (angle := names.get(f"{body}.angle")) is not None:
            index = np.array(angle)
            turn = 2 * np.pi * jnp.round(distance[index] / (2 * np.pi))
            distance = distance.at[index].add(-turn)
    # p and −p are the same attitude.
    back = sign * end - jnp.concatenate([state.q, state.u])
    distance = jnp.where(sign < 0, back, distance).at[free].set(0.0)
    return distance, sign[:, None] * pushed


def _open(system, period, distance, far):
    labels = {index[0]: name for name, index in system.coordinate_names().items() if len(index) == 1}
    rates = directions(system.rate_names())
    name = lambda k: labels.get(k, "a count of turns") if k < system.nq else f"the rate of {rates[k - system.nq]}"
    worst = [k for k in np.argsort(-np.abs(distance)) if far[k]][:4]
    listed = ", ".join(f"{name(k)} ({distance[k]:.3g})" for k in worst)
    return (
        f"The motion does not return after {float(period):.6g} s: it differs in {listed}. Give its period and a state "
        "on it; cyclic coordinates may be named as ignorable."
    )
