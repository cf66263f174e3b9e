"""The linear-quadratic regulator: feedback with the least cost at an equilibrium, or along a plan."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..._arguments import check_kind, real_array
from ...linalg.arrays import is_traced
from ...linalg.failure import nan_where
from ...parts.names import names_arguments, unknown
from ...system import parameters
from ..linear.linearisation import Linearisation
from ..linear.quantities import components
from ..plan import Plan
from .algebraic import algebraic, reason
from .along import along
from .regulator import Regulator, measured_as, values_of


@names_arguments
def lqr(
    about: Linearisation | Plan,
    *,
    states: Mapping[str, Any],
    inputs: Mapping[str, Any],
    final: Mapping[str, Any] | None = None,
) -> Regulator:
    """Find the linear-quadratic regulator, which holds a machine at an equilibrium or brings it back to a plan.

    ```python
    weight, push = jaxmb.Gravity((0.0, -9.81)), jaxmb.JointForce("push", "pin.angle", force=0.0)
    pushed = jaxmb.Scene([bar], joints=[pin], forces=[weight, push]).compile()
    upright = jaxmb.equilibrium(pushed, jaxmb.assemble(pushed, fix={"bar.angle": 1.5}), stable=False)
    about = jaxmb.linearise(pushed, upright, inputs=["push.force"], coordinates=["pin.angle"])
    regulator = jaxmb.lqr(about, states={"pin.angle": 10.0, "pin.angle_rate": 1.0}, inputs={"push.force": 0.1})
    hold = regulator.controller("hold", {"push.force": "pin.angle"})
    held = jaxmb.Scene([bar], joints=[pin], forces=[weight, hold]).compile()
    ```

    The inputs change by `−K z` for small changes z of the states. The gains K minimise the integral over time of the
    sum of `weight × change²` of all states and inputs.

    At an equilibrium the gains are constant and have derivatives of any order by all parameters and weights, also under
    `jit` and `vmap`. Along a plan they follow from the Riccati differential equation, backward from the end.

    **Arguments:**

    - `about`: a `Linearisation` with inputs, or a `Plan`.
    - `states`: weights ≥ 0 by name, `{"pin.angle": 10.0, "pin.angle_rate": 1.0}`. Of a linearisation, names of its
        states (under `jit` and `vmap`, of the `coordinates` and `rates` in `linearise`); states without a name have
        weight zero. Along a plan the names must be as many independent coordinates
        as the machine has, with weight zero if need be; their rates are added where rates are missing.
    - `inputs`: weights > 0 by name: inputs of the linearisation, or controls of the plan, `"push.force[0]"` of a
        vector. Inputs without a name do not change.
    - `final`: weights of `weight × change²` at the end of a plan, by name; by default the least cost after the end with
        the linear equations there as they are, or where it does not exist, the numbers in `states`.

    **Returns:** a `Regulator`. Under a trace its gains are NaN if there is no regulator.

    **Raises:** `ValueError` for unknown names and weights of the wrong sign; if the inputs cannot stabilise a state, or
    the weights do not tell that it drifts; along a plan for names that are too few, too many or dependent.

    Source: B. D. O. Anderson and J. B. Moore, "Optimal Control: Linear Quadratic Methods", Prentice Hall, 1990.
    """
    check_kind("lqr: about", about, Linearisation | Plan, "a Linearisation or a Plan", "see linearise and plan")
    given = _checked("states", states, False), _checked("inputs", inputs, True)
    if not given[1]:
        raise ValueError("lqr: inputs names no input; give a weight by name, {'push.force': 1.0}.")
    # A concrete class: a plan has its equations at all its times, a linearisation at one state.
    if isinstance(about, Plan):
        return along(about, *given, None if final is None else _checked("final", final, False))
    if final is not None:
        raise ValueError("lqr: final is for plans; a linearisation has no end.")
    return _at_equilibrium(about, *given)


def _checked(argument: str, weights: Any, positive: bool) -> dict[str, Any]:
    """Weights by name as numbers, of the right sign."""
    if not isinstance(weights, Mapping):
        raise ValueError(f"lqr: {argument} must be weights by name, {{'pin.angle': 1.0}}, got {weights!r}.")
    out = {name: real_array(f"lqr: {argument}[{name!r}]", value, float) for name, value in weights.items()}
    for name, value in out.items():
        if not is_traced(value) and not (np.isfinite(value) and (value > 0 or (value == 0 and not positive))):
            wanted = "positive" if positive else "at least zero"
            raise ValueError(f"lqr: the weight of {name!r} in {argument} must be {wanted}, got {float(value):g}.")
    return out


def _at_equilibrium(about: Linearisation, states: dict[str, Any], inputs: dict[str, Any]) -> Regulator:
    if about.A.ndim != 2:
        raise ValueError("lqr: the linearisation is a batch; call lqr within jax.vmap, as linearise.")
    for kind, given, known in (("state", states, about.states), ("input", inputs, about.inputs)):
        for name in given:
            if name in known:
                continue
            if kind == "state" and is_traced(about.basis):
                raise ValueError(
                    f"lqr: Unknown state {name!r}. Under jit and vmap name it in linearise(…, coordinates=, rates=); "
                    f"here the states are {', '.join(known)}."
                )
            raise unknown(kind, name, known, "lqr")
    chosen = np.array([about.inputs.index(name) for name in inputs])
    A, B, dtype = about.A, about.B[:, chosen], about.A.dtype
    q = jnp.stack([jnp.asarray(states.get(name, 0.0), dtype) for name in about.states])
    r = jnp.stack([jnp.asarray(weight, dtype) for weight in inputs.values()])
    found = algebraic(A, B, q, r)
    arrays = found.gains, found.cost, found.closed
    if is_traced((A, B, q, r)):
        arrays = nan_where(~found.ok, arrays, (A, B, q, r))
    elif not found.ok:
        numbers = np.asarray(A), np.asarray(B), np.asarray(q)
        raise ValueError(reason(*numbers, about.states, tuple(inputs)))
    system, existing = about.system, parameters(about.system)
    places = components("input", tuple(inputs), {name: value.shape for name, value in existing.items()})
    return Regulator(
        *arrays,
        reference_states=values_of(system, about.t, about.state, about.states),
        reference_inputs=jnp.stack([jnp.ravel(existing[name])[k] for name, k in places]),
        ts=None,
        states=about.states,
        inputs=tuple(inputs),
        measured=tuple(measured_as(system, name) for name in about.states),
    )
