"""Intervals and nodes of a plan, computed side by side: values, first and second derivatives by their inputs."""

import abc
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ..._types import State
from ...linalg.jitted import jitted
from ...manifold import Chart
from ...manifold.impulse import after_impulse
from ...system import AbstractSystem, with_inputs, with_parameters
from ..evaluate import Reading
from .courses import AbstractCourse, Piece

# The number of lanes of one program, whatever the number of intervals.
_TOGETHER = 8
# The quality of a chart beyond which its states are refused: steps of a method then stay within it.
_BORDER = 20.0
# The step of differences of first derivatives, in units of the scales of the inputs.
_ASIDE = 1e-6


def _tableau() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The stages of a Runge–Kutta method of order eight: their times, the matrix of their weights, and the weights of
    the result.
    """
    tableau: Any = diffrax.Dopri8.tableau
    stages = len(tableau.c) + 1
    matrix = np.zeros((stages, stages))
    for k, row in enumerate(tableau.a_lower):
        matrix[k + 1, : len(row)] = row
    used: Any = np.flatnonzero(np.any(matrix != 0, axis=0) | (np.asarray(tableau.b_sol) != 0))
    return np.append(0.0, tableau.c)[used], matrix[used][:, used], np.asarray(tableau.b_sol)[used]


class Control(NamedTuple):
    """A control: the parameter's `name` and `shape`, and its `course` between nodes."""

    name: str
    shape: tuple[int, ...]
    course: AbstractCourse

    @property
    def size(self) -> int:
        """The count of components."""
        return int(np.prod(self.shape, dtype=int))


class Model(eqx.Module):
    """A system with controls and designed parameters.

    **Fields:** the `system`; its `controls`; `design`: the names and shapes of designed parameters.
    """

    system: AbstractSystem
    controls: tuple[Control, ...] = eqx.field(static=True)
    design: tuple[tuple[str, tuple[int, ...]], ...] = eqx.field(static=True)

    def designed(self, numbers: Float[Array, "design"]) -> AbstractSystem:
        """The system with these values of designed parameters."""
        if not self.design:
            return self.system
        return with_parameters(self.system, by_name(self.design, numbers))

    def given(self, controls: dict[str, Array], numbers: Any) -> dict[str, Array]:
        """The controls and designed parameters by name, for functions of an instant."""
        return {**controls, **by_name(self.design, numbers)}


def by_name(shapes: Iterable[tuple[str, tuple[int, ...]]], numbers: Any) -> dict[str, Any]:
    """Arrays by name from their numbers, one after the other along axis 0; `shapes`: names and shapes."""
    out, begin = {}, 0
    for name, shape in shapes:
        size = int(np.prod(shape, dtype=int))
        out[name] = numbers[begin : begin + size].reshape((*shape, *numbers.shape[1:]))
        begin += size
    return out


class AbstractLane(eqx.Module):
    """A function of the inputs of one interval or node, near the state where its chart was made."""

    model: eqx.AbstractVar[Model]

    @abc.abstractmethod
    def __call__(self, chart: Any, inputs: Float[Array, "inputs"], steps: Int[Array, ""]) -> Float[Array, "outputs"]:
        """**Arguments:** `chart`: all fields of a `Chart` but its system; `steps` of an interval."""


class Arrival(AbstractLane):
    """The state at the end of an interval, and the integral over it.

    The inputs are the coordinates of the start in its chart, the time of the start and the length [s], the numbers of
    the controls, and the designed parameters. The outputs are all coordinates, velocities and internal states at the
    end; the quality of the chart at the start; and the integral of `running(at)` over the interval. Near the border of
    a chart all are NaN.
    """

    model: Model
    running: Callable[[Reading], Any] | None = eqx.field(static=True)

    def __call__(self, chart, inputs, steps):
        model = self.model
        n, sizes = chart[1].size, [control.size * control.course.local for control in model.controls]
        x, (t0, h), *numbers, design = jnp.split(inputs, np.cumsum([n, 2, *sizes]))
        pieces = {}
        for control, own in zip(model.controls, numbers, strict=True):
            own = own.reshape(control.course.local, *control.shape)
            pieces[control.name] = Piece(control.course.powers(own, h), t0, h, control.course.smooth)
        system = with_inputs(model.designed(design), pieces) if pieces else model.designed(design)
        here = Chart(system, *chart)
        times, matrix, weights = (jnp.asarray(array, x.dtype) for array in _tableau())
        step = h / steps.astype(h.dtype)

        def stage(k, carry):
            y, near, slopes = carry
            number, count = k % times.size, k // times.size
            t = t0 + step * (count.astype(h.dtype) + times[number])
            inner = y + step * (matrix[number] @ slopes)
            state, rates = here.moving(t, inner[:n], near)
            cost = self._cost(system, state, t, pieces, design)
            slopes = slopes.at[number].set(jnp.append(rates, cost))
            y = jnp.where(number == times.size - 1, y + step * (weights @ slopes), y)
            return y, lax.stop_gradient(state), slopes

        start = jnp.append(x, 0.0), State(*jax.tree.map(jnp.asarray, _plain(chart[0]))), jnp.zeros((times.size, n + 1))
        y, near, _ = lax.fori_loop(0, steps * times.size, stage, start)
        end = here.state(t0 + h, y[:n], near)
        quality = lax.stop_gradient(here.quality(t0, here.state(t0, x)))
        outputs = jnp.concatenate([*jax.tree.leaves(_plain(end)), quality[None], y[n:]])
        return outputs * jnp.where(quality <= _BORDER, 1.0, jnp.nan)

    def _cost(self, system, state, t, pieces, design):
        if self.running is None:
            return jnp.zeros(())
        given = self.model.given({name: piece(t) for name, piece in pieces.items()}, design)
        return jnp.asarray(self.running(Reading(system, state, t, given)))


def _plain(state):
    return state.q, state.u, state.z


class Look(AbstractLane):
    """Quantities at a node, by the numbers of a function of the instant.

    The inputs are the coordinates in the chart, the time, the values of the controls, and the designed parameters.
    """

    model: Model
    function: Callable[[Reading], Any] = eqx.field(static=True)

    def __call__(self, chart, inputs, steps):
        del steps
        model = self.model
        sizes = [control.size for control in model.controls]
        x, (t,), *values, design = jnp.split(inputs, np.cumsum([chart[1].size, 1, *sizes]))
        each = zip(model.controls, values, strict=True)
        controls = {control.name: value.reshape(control.shape) for control, value in each}
        system = model.designed(design)
        system = with_parameters(system, controls) if controls else system
        state = Chart(system, *chart).state(t, x)
        numbers = self.function(Reading(system, state, t, model.given(controls, design)))
        return jnp.concatenate([jnp.ravel(jnp.asarray(number, x.dtype)) for number in jax.tree.leaves(numbers)])


class Strike(AbstractLane):
    """The state just after the constraints of the `next` system take hold at a node, by their ideal impulses.

    The inputs are the coordinates in the chart. The outputs are all coordinates, velocities and internal states.
    """

    model: Model
    next: AbstractSystem
    t: Array

    def __call__(self, chart, inputs, steps):
        del steps
        state = Chart(self.model.system, *chart).state(self.t, inputs)
        after = after_impulse(self.next, jnp.zeros_like(self.t), state)
        return jnp.concatenate(jax.tree.leaves(_plain(after)))


@jitted
def _linearised(shared, charts, inputs):
    """The outputs of lanes, and their derivatives by the active inputs."""
    lane, steps, active = shared

    def of_one(chart, whole):
        def outputs(part):
            y = lane(chart, whole.at[np.array(active, int)].set(part), steps)
            return y, y

        jacobian, y = jax.jacfwd(outputs, has_aux=True)(whole[np.array(active, int)])
        return y, jacobian

    return jax.vmap(of_one)(charts, inputs)


def in_lanes(program: Callable[..., Any], shared: Any, *members: Any) -> Any:
    """`program(shared, *members)` of members along axis 0, so many at a time that one program serves any number."""
    count = len(jax.tree.leaves(members)[0])
    order = np.minimum(np.arange(-(-count // _TOGETHER) * _TOGETHER), count - 1).reshape(-1, _TOGETHER)
    blocks = [program(shared, *jax.tree.map(lambda x, these=these: np.asarray(x)[these], members)) for these in order]
    return jax.tree.map(lambda *parts: np.concatenate([np.asarray(part) for part in parts])[:count], *blocks)


class Block:
    """Lanes of one kind with all their charts.

    **Fields:** the `lane`; `charts`: stacked along axis 0; `active`: the inputs that are variables; `steps` of each
    interval.
    """

    def __init__(self, lane: AbstractLane, charts: Any, active: tuple[int, ...], steps: int = 1):
        self.lane, self.charts, self.active, self.steps = lane, charts, active, steps

    def linearised(self, inputs: np.ndarray, steps: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The outputs, and their derivatives by the active inputs; axis 0 is the lane.

        **Arguments:** `steps` of each interval, default the block's.
        """
        lane = self.lane, np.asarray(self.steps if steps is None else steps), self.active
        return in_lanes(_linearised, lane, self.charts, inputs)

    def curvature(
        self, inputs: np.ndarray, first: np.ndarray, weights: np.ndarray, scales: np.ndarray, central: bool = False
    ) -> np.ndarray:
        """The second derivatives of each lane's weighted sum of outputs, by differences of `first` derivatives."""
        active = np.array(self.active, int)
        sides = np.array((1.0, -1.0) if central else (1.0,))
        # Inputs of a lane that depend on no variable have no scale.
        aside = _ASIDE * np.where(scales > 0, scales, 1.0)[:, active]
        moved = np.broadcast_to(inputs, (sides.size, active.size, *inputs.shape)).copy()
        for k, place in enumerate(active):
            moved[:, k, :, place] += sides[:, None] * aside[:, k]
        charts = jax.tree.map(lambda x: np.concatenate([x] * (sides.size * active.size)), self.charts)
        slopes = in_lanes(
            _linearised, (self.lane, np.asarray(self.steps), self.active), charts, moved.reshape(-1, inputs.shape[1])
        )[1]
        slopes = slopes.reshape(sides.size, active.size, *first.shape)
        change, width = (slopes[0] - slopes[1], 2 * aside) if central else (slopes[0] - first, aside)
        second = np.einsum("kloj,lo->lkj", change, weights) / width[:, :, None]
        return 0.5 * (second + second.transpose(0, 2, 1))
