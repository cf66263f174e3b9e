"""Checks of what the kernels of a part return, by abstract evaluation: nothing is computed or compiled."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._traced_functions import NEED_NUMBERS, note_of, traced_by_jax, with_note
from .base import (
    AbstractConstraint,
    AbstractDynamicForce,
    AbstractForce,
    AbstractNonIdeal,
    AbstractPotentialForce,
    AbstractVelocityConstraint,
)
from .fields import entry, internal_states
from .space import AbstractSpace


def check_kernels(part: Any, space: AbstractSpace, bodies: int) -> None:
    """Raise a `ValueError` that names the part if a kernel returns a wrong shape or dtype, or indexes out of bounds.

    Without this check, a wrench of the wrong shape would act on another body.

    **Arguments:** `part`: with every number filled in; `bodies`: number of bodies that it acts on.
    """
    dtype = np.dtype(jnp.result_type(float))
    ground: Any = np.asarray(space.ground, dtype)
    poses = np.tile(space.prepare(ground), (bodies, 1))
    velocities, t = np.zeros((bodies, space.velocity_size), dtype), np.zeros((), dtype)
    of_bodies = velocities.shape
    if internal_states(part) and not isinstance(part, AbstractDynamicForce):
        raise ValueError(
            f"{part.label} has internal states; derive it from AbstractDynamicForce, which has their rates."
        )
    if isinstance(part, AbstractConstraint):
        check_returns(part.label, "residual", (part.rows,), lambda x, t: part.residual(space, x, t), poses, t)
    elif isinstance(part, AbstractVelocityConstraint):
        check_returns(
            part.label, "residual", (part.rows,), lambda x, v, t: part.residual(space, x, v, t), poses, velocities, t
        )
    elif isinstance(part, AbstractNonIdeal):
        kernel = lambda x, v, r, t: part.wrenches(space, x, v, r, t)
        check_returns(part.label, "wrenches", of_bodies, kernel, poses, velocities, velocities, t)
    elif isinstance(part, AbstractForce):
        check_returns(
            part.label, "wrenches", of_bodies, lambda x, v, t: part.wrenches(space, x, v, t), poses, velocities, t
        )
        if part.has_gaps:
            _check_gaps(part, space, poses, t)
        if isinstance(part, AbstractDynamicForce):
            _check_state_rates(part, space, poses, velocities, t)
        if isinstance(part, AbstractPotentialForce):
            if part.conservative:
                check_returns(part.label, "energy", (), lambda x, t: part.energy(space, x, t), poses, t)
        elif hasattr(part, "energy"):
            raise ValueError(
                f"{part.label} defines an energy that is never used; derive it from AbstractPotentialForce."
            )


def _check_gaps(part: AbstractForce, space: AbstractSpace, *given: Any) -> None:
    """The same for gaps, of which there may be any number."""
    gaps = lambda x, t: part.gaps(space, x, t)
    shape = getattr(_evaluated(part.label, "gaps", gaps, given), "shape", ())
    check_returns(part.label, "gaps", shape if len(shape) == 1 else ("n",), gaps, *given)


def _check_state_rates(part: AbstractDynamicForce, space: AbstractSpace, *given: Any) -> None:
    """The same for the rates of internal states, each of which must have a rate of its shape."""
    states = internal_states(part)
    rates = lambda *given: part.state_rates(space, *given)
    found = _evaluated(part.label, "state_rates", rates, given)
    if not isinstance(found, dict) or set(found) != set(states):
        names = ", ".join(states) or "none"
        raise ValueError(f"{part.label}: state_rates must return a dictionary of the internal states, {names}.")
    for name, keys in states.items():
        shape = np.shape(entry(part, keys))
        check_returns(part.label, f"state_rates[{name!r}]", shape, lambda *own, name=name: rates(*own)[name], *given)


def check_returns(label: str, name: str, shape: tuple[int, ...], kernel: Callable[..., Any], *given: Any) -> None:
    """Raise a `ValueError` unless a kernel of NumPy arrays returns this shape, and the dtype of the first of them."""
    out = _evaluated(label, name, lambda *own: _as_array(kernel(*own)), given)
    if not hasattr(out, "shape") or out.shape != shape:
        found = getattr(out, "shape", type(out).__name__)
        raise ValueError(f"{label}: {name} must return shape {shape}, got {found}.")
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
