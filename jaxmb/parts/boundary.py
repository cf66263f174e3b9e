"""What happens to a part's functions when it enters a scene: kernels are checked by abstract evaluation, and functions
are kept as JAX traces them then. Nothing is computed or compiled.
"""

import dataclasses
import sys
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._captured import Captured
from .._compat import used_inputs, with_values
from .._dataflow import depends, shaken
from .._traced_functions import NEED_NUMBERS, is_installed, note_of, traced_by_jax, with_note
from ..linalg.jitted import on_host
from .base import (
    AbstractBody,
    AbstractConstraint,
    AbstractDynamicPart,
    AbstractFlexibleBody,
    AbstractForce,
    AbstractLink,
    AbstractNonIdeal,
    AbstractPotentialForce,
    AbstractVelocityConstraint,
)
from .contact_laws import AbstractImpactLaw, AbstractSlipLaw
from .dry_friction import AbstractStickSlip
from .fields import declarations, entry, internal_states
from .space import AbstractSpace
from .unilateral import AbstractUnilateralConstraint

T = TypeVar("T")
# The kernels in whose values a step must not pass over a pulse.
_IN_TIME = ("given_in_time", "residual", "wrenches", "state_rates", "gaps")


def check_kernels(part: Any, space: AbstractSpace, bodies: int) -> None:
    """Raise a `ValueError` that names the part if a kernel returns a wrong shape or dtype, or indexes out of bounds.

    Without this check, a wrench of the wrong shape would act on another body.

    **Arguments:** `part`: with every number filled in; `bodies`: number of bodies that it acts on.
    """
    check_states(part, space, bodies)
    for name, shape, given in _kernels(part, space, bodies):
        kernel = lambda *arguments, name=name: getattr(part, name)(space, *arguments)
        if name == "gaps":
            _check_gaps(part, kernel, given)
        elif shape is not None:
            check_returns(part.label, name, shape, kernel, *given)
    if isinstance(part, AbstractConstraint) and part.declares("elements"):
        rows = sum(element.rows(space.dimension) for element in part.elements)
        if rows != part.rows:
            raise ValueError(f"{part.label}: its elements have {rows} rows, but rows = {part.rows}.")
    _check_declared(part, space, bodies)
    if isinstance(part, AbstractStickSlip | AbstractUnilateralConstraint) and is_of_user(part):
        _check_contact_law(part)
    if isinstance(part, AbstractForce) and not isinstance(part, AbstractPotentialForce) and hasattr(part, "energy"):
        raise ValueError(f"{part.label} defines an energy that is never used; derive it from AbstractPotentialForce.")


def check_states(part: Any, space: AbstractSpace, bodies: int) -> None:
    """Refuse internal states without rates, rates of another shape, and constraints that depend on the states."""
    states = internal_states(part)
    if states and not isinstance(part, AbstractDynamicPart):
        kind = "AbstractDynamicForce" if isinstance(part, AbstractForce) else "AbstractDynamicPart"
        raise ValueError(f"{part.label} has internal states; derive it from {kind}, which declares their rates.")
    where = lambda part: [entry(part, keys) for keys in states.values()]
    for name, _, given in _kernels(part, space, bodies) if states else ():
        if name == "state_rates":
            _check_state_rates(part, lambda *arguments: part.state_rates(space, *arguments), given)
        row = lambda values, given, name=name: getattr(eqx.tree_at(where, part, values), name)(space, *given)
        if name in ("residual", "gap", "slips") and depends(row, (where(part), given), 0):
            raise ValueError(f"{part.label}: its {name} must not depend on its internal states.")


def _check_contact_law(part: Any) -> None:
    """Refuse a contact law of a user's class that is none, or that does not return numbers."""
    law, kind = part.contact_law, AbstractSlipLaw if isinstance(part, AbstractStickSlip) else AbstractImpactLaw
    if not isinstance(law, kind):
        raise ValueError(f"{part.label}: contact_law must be a parts.{kind.__name__}, got {type(law).__name__}.")
    if isinstance(law, AbstractSlipLaw) and law.resists and part.needs == "normal":
        raise ValueError(f"{part.label}: a contact has no friction without a normal force; leave out resists=True.")
    one = np.ones((), np.dtype(jnp.result_type(float)))
    for name, count in law.asked.items():
        answer = lambda *numbers, name=name, count=count: getattr(law, name)(*numbers[:count])
        check_returns(part.label, f"contact_law.{name}", (), answer, *[one] * max(count, 1))


def _check_declared(part: Any, space: AbstractSpace, bodies: int) -> None:
    """Refuse a constraint from a user's function or class that is not what it declares."""
    is_constraint = isinstance(part, AbstractConstraint | AbstractVelocityConstraint)
    if not is_constraint or not (is_of_user(part) or with_captured(part)[1]):
        return
    poses, velocities, t = _arguments(space, bodies)
    if isinstance(part, AbstractConstraint):
        if not part.rheonomic and depends(lambda x, t: part.residual(space, x, t), (poses, t), 1):
            raise ValueError(f"{part.label}: its residual depends on t; declare rheonomic=True.")
        return
    residual = lambda x, v, t: part.residual(space, x, v, t)
    if part.linear and depends(jax.jacfwd(residual, 1), (poses, velocities, t), 1):
        raise ValueError(
            f"{part.label}: the derivative of its residual by the velocities depends on the velocities; declare "
            "linear=False."
        )
    at_rest = _at_rest(shaken(part, 0), space, *shaken((poses, t), 1)) if part.homogeneous else np.zeros(1)
    if np.any(np.isfinite(at_rest) & (at_rest != 0)):
        raise ValueError(f"{part.label}: its residual is not zero at rest; declare homogeneous=False.")


@on_host
def _at_rest(part, space, poses, t):
    return part.residual(space, poses, jnp.zeros((poses.shape[0], space.velocity_size), poses.dtype), t)


def captured(part: T, space: AbstractSpace, bodies: int) -> tuple[T, dict[str, Captured], tuple[str, ...]]:
    """A part whose kernels have been checked, with its functions as JAX traces them now.

    **Returns:** the part; for a part of a user's class its kernels by name, as functions of the part and of the
    kernel's arguments after `space`; and names of kernels that depend on time through functions of the user.
    """
    part, functions = with_captured(part)
    kernels = dict(_traced_kernels(part, space, bodies)) if functions or is_of_user(part) else {}
    of_time = [name for name, traced in kernels.items() if _depends_on_time(part, *traced) and name in _IN_TIME]
    # A part's own account of its function of time counts in place of its kernels.
    of_time = of_time[-1:] if "given_in_time" in of_time else of_time
    for function in functions:
        function.keep()
    out = {}
    for name, (kernel, given) in kernels.items() if is_of_user(part) else ():
        out[name] = Captured(kernel)
        out[name].trace(part, *given)
        out[name].keep()
    return part, out, tuple(of_time)


def _depends_on_time(part: Any, kernel: Callable[..., Any], given: list[Any]) -> bool:
    """Whether the data flow of a kernel, which this traces, leads from the time, its last argument, to its values."""
    used = used_inputs(lambda given: kernel(part, *given), given)
    return bool(given) and used[-1]


def _traced_kernels(part: Any, space: AbstractSpace, bodies: int) -> Iterator[tuple[str, tuple[Any, list[Any]]]]:
    """The kernels of a part by name, each with its arguments besides the part."""
    if isinstance(part, AbstractBody):
        yield "mass", (lambda part: part.mass, [])
        yield "inertia", (lambda part: part.inertia, [])
    if isinstance(part, AbstractFlexibleBody):
        zeta = np.zeros(len(part.modes), np.dtype(jnp.result_type(float)))
        for name, given in (("mass_matrix", [zeta]), ("energy", [zeta]), ("internal_force", [zeta, zeta])):
            yield name, (lambda part, *arguments, name=name: getattr(part, name)(space, *arguments), given)
    if isinstance(part, AbstractStickSlip | AbstractUnilateralConstraint):
        one = np.ones((), np.dtype(jnp.result_type(float)))
        for name, count in getattr(part.contact_law, "asked", {}).items():
            ask = lambda part, *numbers, name=name: getattr(part.contact_law, name)(*numbers)
            yield name, (ask, [one] * count)
    for name, _, given in _kernels(part, space, bodies):
        yield name, (lambda part, *arguments, name=name: getattr(part, name)(space, *arguments), given)
    if isinstance(part, AbstractConstraint) and part.declares("elements"):
        yield "elements", (lambda part: part.elements, [])
    if isinstance(part, AbstractForce):
        observables = lambda part, *arguments: part.observables(space, *arguments)
        yield "observables", (observables, [*_arguments(space, bodies)])
    if isinstance(part, AbstractLink):
        poses, velocities, t = _arguments(space, bodies)
        yield "coordinates", (lambda part, poses: part.coordinates(space, poses), [poses])
        if part.of_time:
            moving = lambda part, *arguments: part.given_in_time(space, *arguments)
            yield "given_in_time", (moving, [poses, velocities, t])


def is_of_user(value: Any) -> bool:
    """Whether a part, or a collection of modules, contains a module of a class that no installed package defines.

    Modules whose weights are a parameter do not count: the part's functions call them.
    """
    if isinstance(value, dict):
        return any(map(is_of_user, value.values()))
    if isinstance(value, tuple):
        return any(map(is_of_user, value))
    if not isinstance(value, eqx.Module):
        return False
    kinds = [kind for kind in type(value).__mro__ if kind is not object]
    of_packages = all(is_installed(getattr(sys.modules.get(kind.__module__), "__file__", None)) for kind in kinds)
    return not of_packages or any(is_of_user(held) for held, _ in _held(value).values())


def with_captured(module: T) -> tuple[T, list[Captured]]:
    """A module with all functions in its fields captured, also in inner modules; and these functions.

    Modules whose weights are a parameter stay: other functions call them.
    """
    functions: list[Captured] = []

    def convert(value: Any, is_static: bool) -> Any:
        if isinstance(value, eqx.Module) and not is_static:
            return with_values(type(value), vars(value) | {name: convert(*held) for name, held in _held(value).items()})
        if isinstance(value, dict):
            return {name: convert(x, is_static) for name, x in value.items()}
        if type(value) is tuple:
            return tuple(convert(x, is_static) for x in value)
        if callable(value) and not isinstance(value, type):
            functions.append(Captured(value))
            return functions[-1]
        return value

    new = convert(module, False)
    return (new if functions else module), functions


def _held(module: eqx.Module) -> dict[str, tuple[Any, bool]]:
    """The values of a module's fields that are not its parameters, by name, and whether they are static."""
    static = {field.name: field.metadata.get("static", False) for field in dataclasses.fields(module)}
    numbers = {
        name for name, declaration in declarations(type(module)).items() if declaration.kind in ("numbers", "module")
    }
    return {name: (value, static.get(name, False)) for name, value in vars(module).items() if name not in numbers}


def _kernels(part: Any, space: AbstractSpace, bodies: int) -> Iterator[tuple[str, tuple[int, ...] | None, list[Any]]]:
    """The name of each kernel of a part, the shape that it must return (None for any), and its arguments."""
    poses, velocities, t = _arguments(space, bodies)
    if isinstance(part, AbstractStickSlip):
        yield "slips", (part.rows,), [poses, velocities]
    if isinstance(part, AbstractUnilateralConstraint):
        yield "gap", (), [poses[: -part.rows]]
    if isinstance(part, AbstractVelocityConstraint):
        yield "residual", (part.rows,), [poses, velocities, t]
    elif hasattr(part, "residual"):
        yield "residual", (part.rows,), [poses, t]
    elif isinstance(part, AbstractNonIdeal):
        yield "wrenches", velocities.shape, [poses, velocities, velocities, t]
    elif isinstance(part, AbstractForce):
        yield "wrenches", velocities.shape, [poses, velocities, t]
        if part.has_gaps:
            yield "gaps", None, [poses, t]
            yield "gap_pace", (), [poses, velocities, t]
        if isinstance(part, AbstractPotentialForce) and part.conservative:
            yield "energy", (), [poses, t]
            if part.stores_by_speed:
                yield "energy_in_motion", (), [poses, velocities, t]
    if isinstance(part, AbstractDynamicPart):
        yield "state_rates", None, [poses, velocities, t]
    if isinstance(part, AbstractLink) and part.lost_heading is not None:
        yield "heading", (space.dimension,), [poses]


def _check_gaps(part: AbstractForce, kernel: Callable[..., Any], given: list[Any]) -> None:
    """As `check_returns`, for any number of gaps."""
    shape = getattr(_evaluated(part.label, "gaps", kernel, tuple(given)), "shape", ())
    if len(shape) != 1:
        raise ValueError(f"{part.label}: gaps must return a vector, got shape {shape}.")
    check_returns(part.label, "gaps", shape, kernel, *given)


def _arguments(space: AbstractSpace, bodies: int) -> tuple[Any, Any, Any]:
    """Poses, velocities and a time that kernels take."""
    dtype = np.dtype(jnp.result_type(float))
    ground: Any = np.asarray(space.ground, dtype)
    poses = np.tile(space.prepare(ground), (bodies, 1))
    return poses, np.zeros((bodies, space.velocity_size), dtype), np.zeros((), dtype)


def _check_state_rates(part: AbstractDynamicPart, kernel: Callable[..., Any], given: list[Any]) -> None:
    """As `check_returns`, for the rates of internal states: each must have the shape of its state."""
    states = internal_states(part)
    rates = _evaluated(part.label, "state_rates", kernel, tuple(given))
    if not isinstance(rates, dict) or set(rates) != set(states):
        names = ", ".join(states) or "none"
        raise ValueError(f"{part.label}: state_rates must return a dictionary of the internal states, {names}.")
    for name, keys in states.items():
        shape = np.shape(entry(part, keys))
        check_returns(
            part.label, f"state_rates[{name!r}]", shape, lambda *arguments, name=name: kernel(*arguments)[name], *given
        )


def check_returns(label: str, name: str, shape: tuple[int, ...], kernel: Callable[..., Any], *given: Any) -> None:
    """Raise a `ValueError` unless a kernel of NumPy arrays returns this shape, and the dtype of its first argument."""
    out = _evaluated(label, name, lambda *arguments: _as_array(kernel(*arguments)), given)
    if not hasattr(out, "shape") or out.shape != shape:
        got = getattr(out, "shape", type(out).__name__)
        raise ValueError(f"{label}: {name} must return shape {shape}, got {got}.")
    if out.dtype != given[0].dtype:
        raise ValueError(f"{label}: {name} must return {given[0].dtype} numbers, got {out.dtype}.")


def _evaluated(label: str, name: str, kernel: Callable[..., Any], given: tuple[Any, ...]) -> Any:
    try:
        # NumPy arrays refuse an out-of-bounds index; JAX arrays clamp it.
        of_numbers = jax.eval_shape(lambda: kernel(*given))
    except Exception as error:
        # Other errors do not count yet: NumPy arrays lack some operations, such as `.at[...]`.
        if isinstance(error, IndexError) and "out of bounds" in str(error):
            raise ValueError(f"{label}: {name} indexes out of bounds: {error}.") from error
        of_numbers = None
    what = f"{name} of {label}"
    with traced_by_jax(what, "an argument"):
        try:
            return jax.eval_shape(with_note(kernel, what), *given)
        except NEED_NUMBERS:
            raise
        except Exception as error:
            if note_of(what) in getattr(error, "__notes__", ()):
                raise
            if of_numbers is None:
                cause = str(error).strip().splitlines()[0]
                raise ValueError(f"{label}: {name} cannot be evaluated: {cause}") from error
    return of_numbers


def _as_array(value: Any) -> Any:
    return value if isinstance(value, jax.Array | np.ndarray | np.generic) else jnp.asarray(value)
