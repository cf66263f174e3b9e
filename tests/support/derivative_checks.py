"""Derivatives three ways: forward mode, reverse mode, and differences of a tighter solution.

A triple is a parameter, a machine and an output. Of a scene that holds several machines which do not touch each other,
one run moves a parameter of each at once, so that few runs check many triples.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from compiling import jit_quickly

import jaxmb as mb

# Forward mode against reverse mode, and both against differences; relative to the derivative itself, and to the
# largest one of the same output times the second number.
SAME, NEAR, SMALL = 1e-6, 1e-4, 1e-3
# Changes of parameters, in their own sizes, in units of which derivatives are compared.
STEP = 2e-3


@dataclasses.dataclass
class Machine:
    """What is derived with respect to what, of one machine.

    `parameters` and `outputs` are the names to draw from; those of parameters in `always` are taken in any case.
    """

    name: str
    parameters: Sequence[str]
    outputs: Sequence[str]
    always: Sequence[str] = ()


@dataclasses.dataclass
class Case:
    """A system, and how its outputs by name follow from values of its parameters.

    `observe(system, extra, rtol)` returns the outputs; `extra` has the numbers that are no parameters of the
    system, such as an initial rate, under their names.
    """

    system: Any
    machines: Sequence[Machine]
    observe: Callable[..., Mapping[str, Any]]
    extra: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    parameters: int = 4
    outputs: int = 4
    rtol: float = 1e-9
    tighter: float = 1e-11


@dataclasses.dataclass
class Programs:
    """The outputs as a function of changes of parameters, (machines, parameters) → (machines, outputs)."""

    names: list[list[str]]
    labels: list[list[str]]
    forward: Callable
    reverse: Callable


def sized_direction(rng, value):
    """A random change of a parameter of its own size; of a matrix a symmetric one."""
    value = np.asarray(value)
    change = rng.normal(size=value.shape)
    if value.ndim == 2 and value.shape[0] == value.shape[1]:
        change = (change + change.T) / 4
    return change / np.linalg.norm(change) * max(float(np.max(np.abs(value))), 0.1)


def _admissible(system, name, change):
    """Whether a parameter may change to either side: a damping of zero may not become negative."""
    try:
        for sign in (-1.0, 1.0):
            mb.with_parameters(system, {name: np.asarray(mb.parameters(system)[name]) + sign * 4 * STEP * change})
    except ValueError:
        return False
    return True


def programs(case: Case, seed: int) -> Programs:
    rng = np.random.default_rng(seed)
    known = mb.parameters(case.system) | {name: jnp.asarray(value) for name, value in case.extra.items()}
    directions = {name: sized_direction(rng, value) for name, value in known.items()}
    free = {name for name in known if name in case.extra or _admissible(case.system, name, directions[name])}
    names = []
    for machine in case.machines:
        drawn = [name for name in rng.permutation(list(machine.parameters)) if name not in machine.always]
        own = [str(name) for name in [*machine.always, *drawn] if name in free]
        names.append(own[: case.parameters])

    def observe(changes, rtol):
        values = {
            name: known[name] + changes[i, k] * directions[name]
            for i, own in enumerate(names)
            for k, name in enumerate(own)
        }
        extra = {name: values.pop(name, known[name]) for name in case.extra}
        return case.observe(mb.with_parameters(case.system, values), extra, rtol)

    still = jnp.zeros((len(names), case.parameters))
    shapes = jax.eval_shape(lambda x: observe(x, case.rtol), still)
    # Single numbers of the outputs, drawn without repetition.
    chosen = []
    for machine in case.machines:
        entries = [(name, k) for name in machine.outputs for k in range(shapes[name].size)]
        chosen.append([entries[k] for k in rng.permutation(len(entries))[: case.outputs]])

    def vector(changes, rtol):
        outputs = observe(changes, rtol)
        return jnp.stack([jnp.stack([outputs[name].ravel()[k] for name, k in own]) for own in chosen])

    return Programs(
        names,
        [[f"{name}{list(map(int, np.unravel_index(k, shapes[name].shape)))}" for name, k in own] for own in chosen],
        jit_quickly(lambda x, along, rtol: jax.jvp(lambda x: vector(x, rtol), (x,), (along,))),
        jit_quickly(lambda x, weight, rtol: jax.vjp(lambda x: vector(x, rtol), x)[1](weight)[0]),
    )


def check(title: str, case: Case, seed: int = 0) -> int:
    """The number of triples that agree, all of them; derivatives that vanish are compared and not counted."""
    own = programs(case, seed)
    still = np.zeros((len(own.names), case.parameters))
    shape = (len(own.names), len(own.labels[0]), case.parameters)
    forward, reverse, difference = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for k in range(case.parameters):
        along = np.zeros_like(still)
        along[:, k] = 1.0
        forward[:, :, k] = own.forward(still, along, case.rtol)[1]
        value = lambda s, along=along: np.asarray(own.forward(s * STEP * along, along, case.tighter)[0])
        difference[:, :, k] = (8 * (value(1) - value(-1)) - (value(2) - value(-2))) / (12 * STEP)
    for m in range(shape[1]):
        weight = np.zeros(shape[:2])
        weight[:, m] = 1.0
        reverse[:, m, :] = own.reverse(still, weight, case.rtol)

    size = np.abs(forward) + SMALL * np.max(np.abs(forward), axis=2, keepdims=True) + 1e-6
    # A derivative that is not finite is not near.
    wrong = ~(np.abs(forward - reverse) <= SAME * size) | ~(np.abs(forward - difference) <= NEAR * size)
    wrong |= ~(np.abs(reverse - difference) <= NEAR * size)
    told = [
        f"{title}: d {own.labels[i][m]} / d {own.names[i][k] if k < len(own.names[i]) else 'nothing'}: "
        f"forward {forward[i, m, k]:.12g}, reverse {reverse[i, m, k]:.12g}, differences {difference[i, m, k]:.12g}"
        for i, m, k in np.argwhere(wrong)
    ]
    assert not told, "\n".join(told)
    return int(np.sum(np.abs(forward) > 1e-6))


def in_both_modes(function: Callable, at, many=None):
    """The value and the derivative of a function of a vector by forward mode, which is that by reverse mode.

    With `many` vectors in the place of one, of which `at` is the first, forward mode is that of the batch.
    """
    own = lambda x: (function(x),) * 2
    forward = jax.jacfwd(own, has_aux=True)
    batched = many is not None
    derivative, value = jit_quickly(jax.vmap(forward) if batched else forward)(many if batched else at)
    reverse, _ = jit_quickly(jax.jacrev(own, has_aux=True))(at)
    first = derivative[0] if batched else derivative
    # Rows are of one output each.
    size = np.abs(first).max(axis=1, keepdims=True)
    np.testing.assert_array_less(np.abs(first - reverse) / np.where(size > 0, size, 1.0), 1e-9)
    return value, derivative


def central_differences(function: Callable, at, step: float = 1e-3):
    """Of a function of NumPy's, of fourth order; the step is relative to each number."""
    at = np.asarray(at, float)
    columns = []
    for along in np.diag(step * np.abs(at)):
        near, far = (np.asarray(function(at + m * along)) - np.asarray(function(at - m * along)) for m in (1, 2))
        columns.append((8 * near - far) / (12 * along.max()))
    return np.stack(columns, axis=-1)
