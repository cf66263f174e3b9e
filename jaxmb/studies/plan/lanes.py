"""Intervals and nodes of a plan, computed side by side: values, first and second derivatives by their inputs."""

import abc
from collections.abc import Callable, Iterable
from typing import Any, ClassVar, NamedTuple

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
# The most steps of an interval, and the number up to which one program serves.
MOST_STEPS, _FEW_STEPS = 256, 8
# From so many inputs of an interval on its second derivatives are exact. For fewer, differences of first derivatives
# need no further program. (Seconds of a core for eight intervals of a four-bar linkage with 4 inputs: 0.0056 instead of
# 0.0054, and 13 to compile; of a Stewart platform with 24 inputs: 3.5 instead of 14.3, and 106 to compile.)
_MANY = 20
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


_TABLEAU = _tableau()
_STAGES = _TABLEAU[0].size


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
    """A function of the inputs of one interval or node, near the state where its chart was made.

    `integrates`: whether it does, so that it has `slope`, and its differences take long.
    """

    integrates: ClassVar[bool] = False
    model: eqx.AbstractVar[Model]

    @abc.abstractmethod
    def __call__(self, chart: Any, inputs: Float[Array, "inputs"], steps: Int[Array, ""]) -> Float[Array, "outputs"]:
        """**Arguments:** `chart`: all fields of a `Chart` but its system; `steps` of an interval."""


class Arrival(AbstractLane):
    """The state at the end of an interval, and the integral over it.

    The inputs are the coordinates of the start in its chart, the time of the start and the length [s], the weighted
    numbers of the controls, and the designed parameters. The outputs are all coordinates, velocities and internal
    states at the end; the quality of the chart at the start; and the integral of `running(at)` over the interval. Near
    the border of a chart all are NaN.
    """

    integrates = True
    model: Model
    running: Callable[[Reading], Any] | None = eqx.field(static=True)

    def __call__(self, chart, inputs, steps):
        def forth(number, carry):
            y, near, slopes = carry
            _, y, near, slopes = self._stage(chart, inputs, steps, number, y, near, slopes)
            return y, near, slopes

        y, near, _ = lax.fori_loop(0, steps * _STAGES, forth, self._started(chart, inputs))
        return self._arrived(chart, inputs, y, near)

    def slope(self, chart, inputs, steps, weights, room):
        """The derivatives of the weighted sum of outputs by the inputs, in reverse; `room`: the most steps, static."""

        # JAX loses derivatives of custom rules in derivatives of the reverse of a loop, so the loop back is written.
        def forth(number, carry):
            y, near, slopes, stages, before = carry
            before = before.at[number].set(near.q)
            inner, y, near, slopes = self._stage(chart, inputs, steps, number, y, near, slopes)
            return y, near, slopes, stages.at[number].set(inner), before

        def back(number, carry):
            of_y, of_stages, of_inputs = carry
            number = steps * _STAGES - 1 - number
            k = number % _STAGES
            near = State(before[number], chart[0].u, chart[0].z)
            of_slope = result[k] * of_y + matrix[:, k] @ of_stages
            slope = lambda inputs, inner: self._slope(chart, inputs, steps, number, inner, near)[0]
            of_more, of_inner = jax.vjp(slope, inputs, stages[number])[1](of_slope)
            of_stages = of_stages.at[k].set(of_inner)
            is_first = k == 0
            of_y = jnp.where(is_first, of_y + jnp.sum(of_stages, axis=0), of_y)
            return of_y, jnp.where(is_first, 0.0, of_stages), of_inputs + of_more

        _, matrix, result = (jnp.asarray(array, inputs.dtype) for array in _TABLEAU)
        begin = y, near, slopes = self._started(chart, inputs)
        rooms = (jnp.zeros((room * _STAGES, x.size), x.dtype) for x in (y, near.q))
        y, near, _, stages, before = lax.fori_loop(0, steps * _STAGES, forth, (*begin, *rooms))
        arrived = lambda inputs, y: jnp.dot(weights, self._arrived(chart, inputs, y, near))
        of_inputs, of_y = jax.grad(arrived, (0, 1))(inputs, y)
        start = of_y, jnp.zeros_like(slopes), of_inputs
        of_y, _, of_inputs = lax.fori_loop(0, steps * _STAGES, back, start)
        return of_inputs.at[: chart[1].size].add(of_y[:-1])

    def _read(self, chart, inputs):
        """The chart with the controls, their pieces, the coordinates, the time and the length, and the parameters."""
        model = self.model
        n, sizes = chart[1].size, [control.size * control.course.local for control in model.controls]
        x, (t0, h), *numbers, design = jnp.split(inputs, np.cumsum([n, 2, *sizes]))
        pieces = {}
        for control, own in zip(model.controls, numbers, strict=True):
            own = own.reshape(control.course.local, *control.shape)
            pieces[control.name] = Piece(control.course.powers(own), t0, h, control.course.smooth)
        system = with_inputs(model.designed(design), pieces) if pieces else model.designed(design)
        return Chart(system, *chart), pieces, x, (t0, h), design

    def _started(self, chart, inputs):
        y = jnp.append(inputs[: chart[1].size], 0.0)
        return y, State(*jax.tree.map(jnp.asarray, _plain(chart[0]))), jnp.zeros((_STAGES, y.size))

    def _stage(self, chart, inputs, steps, number, y, near, slopes):
        """The coordinates and the cost at a stage, and then those at its step's begin or end, the state, and slopes."""
        _, matrix, result = (jnp.asarray(array, y.dtype) for array in _TABLEAU)
        k = number % _STAGES
        inner = y + matrix[k] @ slopes
        slope, near = self._slope(chart, inputs, steps, number, inner, near)
        slopes = slopes.at[k].set(slope)
        return inner, jnp.where(k == _STAGES - 1, y + result @ slopes, y), near, slopes

    def _slope(self, chart, inputs, steps, number, inner, near):
        """The change of coordinates and cost in a step at the rates of a stage, and the state there."""
        here, pieces, _, (t0, h), design = self._read(chart, inputs)
        step, times = h / steps.astype(h.dtype), jnp.asarray(_TABLEAU[0], h.dtype)
        t = t0 + step * ((number // _STAGES).astype(h.dtype) + times[number % _STAGES])
        state, rates = here.moving(t, inner[:-1], near)
        cost = self._cost(here, state, t, pieces, design)
        return step * jnp.append(rates, cost), lax.stop_gradient(state)

    def _arrived(self, chart, inputs, y, near):
        here, _, x, (t0, h), _ = self._read(chart, inputs)
        end = here.state(t0 + h, y[:-1], near)
        quality = lax.stop_gradient(here.quality(t0, here.state(t0, x)))
        outputs = jnp.concatenate([*jax.tree.leaves(_plain(end)), quality[None], y[-1:]])
        return outputs * jnp.where(quality <= _BORDER, 1.0, jnp.nan)

    def _cost(self, here, state, t, pieces, design):
        if self.running is None:
            return jnp.zeros(())
        given = self.model.given({name: piece(t) for name, piece in pieces.items()}, design)
        return jnp.asarray(self.running(Reading(here.system, _turned(state, here.origin), t, given)))


def _plain(state):
    return state.q, state.u, state.z


def _turned(state, near):
    """The state, whose angles have the turns that bring them next to those of another state."""
    return State(*_plain(state), near.angles)


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
        state = _turned(Chart(system, *chart).state(t, x), chart[0])
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
def _bends(shared, charts, inputs, weights):
    """The second derivatives of weighted sums of intervals' outputs by the active inputs."""
    lane, steps, room, active = shared
    where = np.array(active, int)

    def of_one(chart, whole, weights):
        slope = lambda part: lane.slope(chart, whole.at[where].set(part), steps, weights, room)[where]
        return jax.jacfwd(slope)(whole[where])

    return jax.vmap(of_one)(charts, inputs, weights)


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
        """The second derivatives of each lane's weighted sum of outputs.

        **Arguments:** `first` derivatives, of which differences are taken; `scales` of the inputs; `central`: whether
        differences are.
        """
        active = np.array(self.active, int)
        if self.lane.integrates and active.size >= _MANY:
            room = next(room for room in (_FEW_STEPS, MOST_STEPS) if self.steps <= room)
            shared = self.lane, np.asarray(self.steps), room, self.active
            return in_lanes(_bends, shared, self.charts, inputs, weights)
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
