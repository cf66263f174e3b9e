"""The linear equations of small motions about an equilibrium or a steady motion, with named states."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._types import Scalar, State
from ...linalg.arrays import is_traced
from ...linalg.failure import nan_where
from ...parts.names import names_arguments
from ...states.arguments import check_system, checked_guess, checked_time
from ...states.consistency import consistent
from ...system import AbstractSystem, parameters
from ...system.quantities import component_names, directions
from .linear_equations import LinearEquations, linear_equations
from .linearisation import Linearisation
from .perturbations import (
    Perturbations,
    StateNames,
    check_state_names,
    displacement_names,
    internal_names,
    rate_candidates,
)
from .quantities import components


@names_arguments
def linearise(
    system: AbstractSystem,
    state: State,
    *,
    t: Scalar = 0.0,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    coordinates: Sequence[str] | None = None,
    rates: Sequence[str] | None = None,
) -> Linearisation:
    """Linearise the equations of motion about an equilibrium or a steady motion, in independent coordinates.

    ```python
    about_rest = jaxmb.linearise(system, jaxmb.equilibrium(system), outputs=["bar.angle"])
    about_rest.eigenvalues, about_rest.states
    ```

    `ż = A z + B w` and `y = C z + D w` for small changes z of the states, w of the inputs and y of the outputs. The
    states are independent coordinates and velocities (with rolling, fewer velocities than coordinates) and internal
    states, so no eigenvalue is spurious. Eigenvalues of zero belong to ignorable states, such as the place of a vehicle
    on level ground.

    In a steady motion bodies travel and turn together, uniformly, and wheels may spin in addition. States are then seen
    from a frame that moves with each body, in which A is constant; a comparison a little later along the motion
    verifies this.

    **Arguments:**

    - `system`, `state`: a compiled scene, or another system, and a consistent state of it, from `equilibrium`,
        `steady_motion` or `assemble`.
    - `t`: the time, for drivers [s].
    - `inputs`: names of parameters, `"motor.torque"`, or of their components, `"push.force[0]"`.
    - `outputs`: names of quantities of `Trajectory.quantity`, `"rod.position"`, `"A.force"`, or components.
    - `coordinates`: names of coordinates as states: entries of q, `"crank.angle"`; displacements of spatial bodies and
        small turns about body axes, `"frame.y"`, `"frame.rotation_x"`; any scalar quantity that is a smooth function of
        q. Pivoting chooses further states if they are too few.
    - `rates`: likewise names of rates, `"crank.angle_rate"`, `"hip.angle_rate"`, `"frame.wx"`, or of coordinates, for
        their rates; default the rates of `coordinates`, as far as these rates are independent.

    **Returns:** a `Linearisation`. Under `jit` and `vmap` chosen states have numbers instead of names, since the choice
    depends on values; name `coordinates` and `rates` there to know their meaning. Derivatives with respect to
    parameters and the state are exact; derivatives of A hold the choice of states fixed.

    **Raises:** `ValueError` for unknown, too many or dependent names; for a state that violates the constraints, is
    singular, or is not an equilibrium or steady motion, with the remaining accelerations; for a motion whose linear
    equations change with time; for closed contacts and dry friction; and for inputs that move joints. Under a trace the
    result is NaN instead.
    """
    check_system("linearise", system)
    state = checked_guess("linearise", system, state)
    t = jnp.asarray(checked_time("linearise", t, state.q.dtype))
    names = check_state_names(system, t, state, coordinates, rates)
    shapes = {name: value.shape for name, value in parameters(system).items()} if len(tuple(inputs)) else {}
    seen = {name: value.shape for name, value in system.quantities().items()}
    chosen, observed = components("input", inputs, shapes), components("output", outputs, seen)
    state = consistent(system, t, dataclasses.replace(state, q=system.normalize(t, state.q)))
    opens = check_contacts("linearise", system, state.q)
    equations = linear_equations(system, t, state, names, chosen, observed)
    labels = tuple(_label(item, shapes) for item in chosen), tuple(_label(item, seen) for item in observed)
    matrices = equations.A, equations.B, equations.C, equations.D
    if is_traced((matrices, equations.ok)):
        matrices = nan_where(~(equations.ok & jnp.all(opens)), matrices, (system, state, t))
    elif not equations.ok:
        raise ValueError(_refusal(system, t, state, names, equations, labels))
    return Linearisation(
        *matrices,
        states=state_labels(system, names, equations.perturbations),
        inputs=labels[0],
        outputs=labels[1],
        coordinates=equations.perturbations.coordinates,
        basis=equations.perturbations.basis,
        system=system,
        state=state,
        t=t,
    )


def check_contacts(function: str, system: AbstractSystem, q: Any) -> Array:
    """Whether contacts are open at coordinates, or at all of several along axis 0.

    **Raises:** `ValueError` for dry friction, and for closed contacts unless they are traced.
    """
    if system.contacts.m:
        names = ", ".join(system.contacts.friction_names)
        raise ValueError(
            f"{function}: {names} may stick or slip, which no linear equation describes. Remove the friction."
        )
    open_at = lambda q: system.contacts.modes(q).open
    opens = open_at(q) if np.ndim(q) == 1 else jnp.all(jax.vmap(open_at)(q), axis=0)
    if not is_traced(opens) and not np.all(opens):
        closed = [name for name, is_open in zip(system.contacts.contact_names, opens, strict=True) if not is_open]
        raise ValueError(
            f"{function}: {', '.join(closed)} may open, which no linear equation describes. Replace closed contacts by "
            "joints."
        )
    return opens


def state_labels(system: AbstractSystem, names: StateNames, perturbed: Perturbations) -> tuple[str, ...]:
    """The names of the states; numbers for chosen states under a trace, where the choice is unknown."""
    coordinates, rates = perturbed.picked
    named_rates = [_rate_label(system, name) for name in names.rates or ()]
    if is_traced(perturbed.picked):
        chosen = [f"coordinate {k}" for k in range(coordinates.size)], [f"rate {k}" for k in range(rates.size)]
    else:
        lists = displacement_names(system), rate_candidates(system, names)
        chosen = tuple(
            [candidates[int(k)] for k in picked] for candidates, picked in zip(lists, perturbed.picked, strict=True)
        )
    return (*names.coordinates, *chosen[0], *named_rates, *chosen[1], *internal_names(system))


def _rate_label(system, name):
    """The name of a rate as a state, different from its coordinate's."""
    return f"{name}_rate" if name in {**system.coordinate_names(), **system.joint_coordinates()} else name


def _label(item, shapes):
    name, place = item
    return component_names(name, shapes[name])[place]


def _refusal(system, t, state, names, equations: LinearEquations, labels):
    """The reason why there are no linear equations."""
    full, coordinates, rates = map(bool, equations.perturbations.regular)
    if not full:
        return "The state is singular: fewer constraint rows are independent than elsewhere. Choose another state."
    for kind, good, given in (("coordinates", coordinates, names.coordinates), ("rates", rates, names.rates or ())):
        if not good:
            return f"The {kind} {', '.join(given)} are not independent in this state. Name fewer of them, or others."
    if not equations.steady:
        return _not_steady(system, equations)
    constant = np.asarray(equations.constant)
    if not constant[0]:
        return (
            "The linear equations change along this motion, or with time: it is not a steady motion, since moving "
            f"bodies ({', '.join(_moving(system, t, state))}) do not carry their surroundings along. For a periodic "
            "motion use jaxmb.floquet."
        )
    changing = [name for name, same in zip([*labels[0], *labels[1]], constant[1:], strict=True) if not same]
    if changing:
        return (
            f"The effects of {', '.join(changing)} change along this motion, since their directions do not turn with "
            "it. Choose quantities or forces whose directions are fixed in a body that is carried along."
        )
    moves = [name for name, is_bound in zip(labels[0], np.asarray(equations.bound), strict=True) if is_bound]
    return (
        f"{', '.join(moves)} cannot be an input: it moves the constraints, and the state would have to follow. Use a "
        "force, a torque, or a parameter of either."
    )


def remaining(system: AbstractSystem, residual) -> str:
    """The remaining accelerations that should be zero, for messages."""
    left = np.asarray(residual)
    rates, accelerations, of_states = np.split(left, [system.nq, system.nq + system.nu])
    labels = directions(system.rate_names())
    worst = [k for k in np.argsort(-np.abs(accelerations))[:4] if abs(accelerations[k]) > 1e-6 * np.abs(left).max()]
    listed = ", ".join(f"{labels[k]} ({accelerations[k]:.3g})" for k in worst)
    states = {name: np.abs(of_states[index]).max() for name, index in system.state_names().items()}
    changing = [f"{name} ({rate:.3g} per second)" for name, rate in states.items() if rate > 1e-6 * np.abs(left).max()]
    if changing:
        return f"internal states change, {', '.join(changing)}" + (
            f"; and accelerations remain along {listed}" * bool(listed)
        )
    if listed:
        return f"accelerations remain along {listed}, in m/s² and rad/s²"
    return f"rates differ by {np.abs(rates).max():.3g}, in m/s or 1/s, from the rates of a uniform motion"


def _not_steady(system, equations):
    left = remaining(system, equations.residual)
    if equations.moving:
        return (
            f"The state is not a steady motion: {left}, unlike in any uniform motion of all bodies. "
            "jaxmb.steady_motion finds a steady motion near it; about a periodic motion use jaxmb.floquet."
        )
    return f"The state is not an equilibrium: {left}. jaxmb.equilibrium(system, state) finds an equilibrium near it."


def _moving(system, t, state):
    """Names of the bodies or coordinates that move."""
    speeds = np.abs(np.asarray(system.rates(t, state.q, state.u)))
    names = system.coordinate_names()
    index = {name: names.get(f"{name}.position", names.get(name, [])) for name in system.catalogue.motion_names()}
    turning = lambda name: names.get(f"{name}.orientation", names.get(f"{name}.angle", []))
    index = {name: [*indices, *turning(name)] for name, indices in index.items()}
    return [name for name, indices in index.items() if np.any(speeds[indices] > 0)] or ["none"]
