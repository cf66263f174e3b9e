"""A plan as a nonlinear program: multiple shooting in the charts of its nodes.

The variables are the coordinates of each node in its chart, the numbers of the controls, the designed parameters, and
the times. Equations join the end of each interval to the next node.

Source: H. G. Bock and K. J. Plitt, "A Multiple Shooting Algorithm for Direct Solution of Optimal Control Problems",
IFAC Proceedings Volumes 17(2), 1984.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse

from ..._types import State
from ...linalg.jitted import jitted
from ...manifold import Chart
from ...system import AbstractSystem
from ..constraint_branches import signs_like
from .guess import Guess, with_turns
from .lanes import AbstractLane, Arrival, Block, Look, Model, Strike, in_lanes
from .problem import Evaluated, Problem, Term
from .task import Limits, Named, Task

# Bounds of the lengths of moving arcs, relative to the guess.
_SHORTEST, _LONGEST = 0.05, 5.0


class Nodes(NamedTuple):
    """The charts at the nodes, without their system: fields of `Chart` stacked along axis 0; the coordinates there, and
    typical changes of them.
    """

    charts: Any
    coordinates: np.ndarray
    scales: np.ndarray


@jitted
def _charts(shared, ts, states):
    system, duration = shared
    scales = jnp.concatenate(
        [system.coordinate_scale(), system.velocity_scale() * (3.0 / duration), jnp.ones(system.nz)]
    )

    def of_one(t, state):
        chart = Chart.at(system, t, state)
        origin = State(chart.origin.q, chart.origin.u, chart.origin.z, state.angles)
        return (origin, chart.indices, chart.split, chart.fresh), chart.coordinates(chart.origin), scales[chart.indices]

    return jax.vmap(of_one)(ts, states)


def nodes_at(system: AbstractSystem, ts: np.ndarray, states: State) -> Nodes:
    """Charts at states."""
    return Nodes(*in_lanes(_charts, (system, np.asarray(ts[-1] - ts[0])), ts, states))


class _Entries:
    """Entries of a sparse matrix, added in blocks."""

    def __init__(self):
        self.parts: list[Any] = []

    def add(self, rows: Any, columns: Any, values: Any = 1.0) -> None:
        rows, columns, values = np.broadcast_arrays(rows, columns, np.asarray(values, float))
        self.parts.append((rows.reshape(-1), columns.reshape(-1), values.reshape(-1)))

    def add_matrix(self, rows: np.ndarray, columns: np.ndarray, matrix: np.ndarray) -> None:
        """Add the entries of a matrix that are not zero."""
        i, j = np.nonzero(matrix)
        self.add(rows[i], columns[j], matrix[i, j])

    def matrix(self, shape: tuple[int, int]) -> sparse.csr_array:
        rows, columns, values = (
            np.concatenate([np.zeros(0, kind), *(p[k] for p in self.parts)]) for k, kind in enumerate((int, int, float))
        )
        return sparse.csr_array((values, (rows, columns)), shape=shape)


@dataclasses.dataclass(frozen=True)
class Places:
    """The places of variables: `x`, shape (nodes, coordinates); `times`: the lengths of arcs, or nothing; `controls`,
    one array of shape (numbers, components) for each; `design`.
    """

    x: np.ndarray
    times: np.ndarray
    controls: tuple[np.ndarray, ...]
    design: np.ndarray

    @property
    def size(self) -> int:
        """The number of variables."""
        return self.x.size + self.times.size + sum(c.size for c in self.controls) + self.design.size


def _places(task: Task, coordinates: int) -> Places:
    counter = iter(range(10**9))
    some = lambda *shape: np.array([next(counter) for _ in range(int(np.prod(shape)))], int).reshape(shape)
    x = some(task.intervals + 1, coordinates)
    times = some(len(task.arcs) - 1 if task.timed else 0)
    controls = tuple(some(c.course.count(task.intervals), c.size) for c in task.controls)
    return Places(x, times, controls, some(sum(int(np.prod(shape, dtype=int)) for _, shape in task.design)))


@dataclasses.dataclass(frozen=True)
class Transcription:
    """A task as a program near a guess.

    **Fields:** the `task`; the `nodes`, charts at the guess; `places` of the variables; the `problem`, and its `start`;
    `rows_of`: rows of `"gaps"`, which join intervals, `"start"`, `"end"`, `"path"`, `"period"` and `"duration"`, and of
    cubic controls with bounds by name; `scales` of controls without bounds.
    """

    task: Task
    nodes: Nodes
    places: Places
    problem: Problem
    start: np.ndarray
    rows_of: dict[str, np.ndarray]
    scales: Sequence[np.ndarray] | None

    @classmethod
    def of(
        cls,
        task: Task,
        guess: Guess,
        steps: int,
        scales: Sequence[np.ndarray] | None = None,
        nodes: Nodes | None = None,
        before: "Transcription | None" = None,
    ) -> "Transcription":
        """**Arguments:** `steps` of each interval; `scales` of controls without bounds; `nodes`, default charts at the
        guess; `before`: the phase before, whose last node is the first.
        """
        model = Model(task.system, task.controls, task.design)
        nodes = nodes_at(model.designed(jnp.asarray(guess.design)), guess.ts, guess.states) if nodes is None else nodes
        return _Transcriber(task, guess, nodes, model).transcribed(steps, scales, before)

    def names_at(self, node: int) -> tuple[str, ...]:
        """The names of a node's coordinates and rates."""
        chart = Chart(self.task.system, *jax.tree.map(lambda x: x[node], self.nodes.charts))
        return chart.names

    def read(self, z: np.ndarray) -> Guess:
        """The states, times, controls and parameters of the variables."""
        task, places = self.task, self.places
        design = z[places.design]
        ts = _times(task, z, places)
        system = Model(task.system, task.controls, task.design).designed(jnp.asarray(design))
        states = in_lanes(_states, system, self.nodes.charts, ts, z[places.x])
        states = with_turns(system, ts, states, self.nodes.charts[0].angles)
        return Guess(states, ts, tuple(z[c] for c in places.controls), design)


@jitted
def _states(system, charts, ts, coordinates):
    return jax.vmap(lambda chart, t, x: Chart(system, *chart).state(t, x))(charts, ts, coordinates)


def _times(task: Task, z: np.ndarray, places: Places) -> np.ndarray:
    return task.t0 + (task.passed @ z[places.times] if task.timed else task.shares * task.duration[0])


@dataclasses.dataclass(frozen=True)
class Program:
    """Phases as one program: the last node of each is the first node of the next.

    **Fields:** `parts`, the phases; the `problem`.
    """

    parts: tuple[Transcription, ...]
    problem: Problem

    @classmethod
    def of(cls, tasks: Sequence[Task], guesses: Sequence[Guess], steps: Sequence[int], scales: Any) -> "Program":
        """**Arguments:** of `Transcription.of`, for each phase; `scales` None for all."""
        parts: list[Transcription] = []
        for k, task in enumerate(tasks):
            before = parts[-1] if parts else None
            own = None if scales is None else scales[k]
            parts.append(Transcription.of(task, guesses[k], steps[k], own, before=before))
        return cls(tuple(parts), parts[0].problem if len(parts) == 1 else _joined(parts))

    @property
    def start(self) -> np.ndarray:
        """The variables of the guess."""
        return np.concatenate([part.start for part in self.parts])

    def variables(self, z: np.ndarray) -> list[np.ndarray]:
        """The variables of each phase."""
        return np.split(z, np.cumsum([part.places.size for part in self.parts])[:-1])

    def rows(self, rows: np.ndarray) -> list[np.ndarray]:
        """The rows after the first, of each phase."""
        return np.split(rows, np.cumsum([part.problem.row_low.size for part in self.parts])[:-1])

    def intervals(self) -> list[Evaluated]:
        """The intervals of each phase at the last point: terms of one."""
        last, first, out = self.problem.last, 0, []
        for part in self.parts:
            if last is not None:
                inputs, outputs, jacobians = (x[first : first + 1] for x in last[1:4])
                out.append(Evaluated(last.z, inputs, outputs, jacobians, last.rows))
            first += len(part.problem.terms)
        return out

    def quality(self) -> float:
        """The largest quality of the charts of intervals at the last point; infinite where a state is lost."""
        quality = max((float(np.max(at.outputs[0][:, -2])) for at in self.intervals()), default=np.inf)
        return quality if np.isfinite(quality) else np.inf


def _joined(parts: Sequence[Transcription]) -> Problem:
    problems = [part.problem for part in parts]
    begins = np.cumsum([0, *(problem.scale.size for problem in problems)])
    rows = np.cumsum([1, *(problem.row_low.size for problem in problems)])
    shape = int(rows[-1]), int(begins[-1])

    def whole(matrices):
        first = sparse.hstack([matrix[:1] for matrix in matrices])
        return sparse.csr_array(sparse.vstack([first, sparse.block_diag([matrix[1:] for matrix in matrices])]))

    links, strikes, struck, terms = _Entries(), _Entries(), [], []
    for k in range(1, len(parts)):
        before, after = parts[k - 1], parts[k]
        row, last = after.rows_of["link"] + rows[k] - 1, before.places.x[-1] + begins[k - 1]
        links.add(row, last[: row.size], -1.0 / before.nodes.scales[-1][: row.size])
        if "strike" in after.rows_of:
            indices, scales = after.nodes.charts[1][0], after.nodes.scales[0]
            moving, row = np.flatnonzero(indices >= after.task.system.nq), after.rows_of["strike"] + rows[k] - 1
            strikes.add(row, sum(term.outputs for term in struck) + indices[moving], 1.0 / scales[moving])
            links.add(row, after.places.x[0][moving] + begins[k], -1.0 / scales[moving])
            struck.append(_strike(before, after, last, shape[1]))
    for problem, begin in zip(problems, begins[:-1], strict=True):
        for term in problem.terms:
            entries = sparse.coo_array(term.inputs)
            inputs = (entries.data, (entries.row, entries.col + begin))
            wide = sparse.csr_array(inputs, shape=(term.offset.size, shape[1]))
            terms.append(Term(term.block, wide, term.offset, term.outputs))
    of_outputs, count = whole([problem.of_outputs for problem in problems]), sum(term.outputs for term in struck)
    return Problem(
        scale=np.concatenate([problem.scale for problem in problems]),
        low=np.concatenate([problem.low for problem in problems]),
        high=np.concatenate([problem.high for problem in problems]),
        terms=[*terms, *struck],
        of_outputs=sparse.csr_array(sparse.hstack([of_outputs, strikes.matrix((shape[0], count))])),
        of_variables=sparse.csr_array(whole([problem.of_variables for problem in problems]) + links.matrix(shape)),
        row_low=np.concatenate([problem.row_low for problem in problems]),
        row_high=np.concatenate([problem.row_high for problem in problems]),
        names=[name for problem in problems for name in problem.names],
    )


def _strike(before: Transcription, after: Transcription, last: np.ndarray, variables: int) -> Term:
    """The impulse between two phases, by the coordinates of the last node of the first, at the places `last`."""
    task, charts = before.task, jax.tree.map(lambda x: x[-1:], before.nodes.charts)
    model, ends = Model(task.system, (), ()), jnp.asarray(task.t0)
    lane = Strike(model, after.task.system, ends)
    inputs = sparse.csr_array((np.ones(last.size), (np.arange(last.size), last)), shape=(last.size, variables))
    block = Block(lane, charts, tuple(range(last.size)))
    state = charts[0]
    return Term(block, inputs, np.zeros(last.size), state.q.size + state.u.size + task.system.nz)


class _Transcriber:
    """Makes a `Transcription`."""

    def __init__(self, task: Task, guess: Guess, nodes: Nodes, model: Model):
        self.task, self.guess, self.nodes, self.model = task, guess, nodes, model
        self.places = _places(task, nodes.coordinates.shape[1])
        self.terms: list[Term] = []
        self.of_outputs, self.of_variables = _Entries(), _Entries()
        self.low, self.high, self.names = [np.zeros(0)], [np.zeros(0)], []
        self.outputs, self.rows_of = 0, {}

    def transcribed(self, steps: int, control_scales: Any, before: Transcription | None) -> Transcription:
        task, places, nodes = self.task, self.places, self.nodes
        start, scale, low, high = self._variables(control_scales)
        self._join(self._arrival(steps))
        ends = {"start": (task.start, [0]), "end": (task.end, [task.intervals])}
        for where, (limits, at) in ends.items():
            if not isinstance(limits, State) and limits.names:
                self._limit(where, limits, at)
        if task.path.names:
            self._limit("path", task.path, list(range(task.intervals + 1)))
        self._within()
        if task.final is not None:
            first = self._look(task.final, [task.intervals], 1)
            self.of_outputs.add(0, first)
        if task.of_time and task.timed:
            self.of_variables.add(0, places.times, task.of_time)
        if task.moving:
            row = self._rows("duration", ["duration"], [task.duration[0]], [task.duration[1]])
            self.of_variables.add(row, places.times)
        if task.periodic:
            self._close()
        if before is not None:
            self._follow(before)
        shape = 1 + sum(x.size for x in self.low), self.outputs
        problem = Problem(
            scale=scale,
            low=low,
            high=high,
            terms=self.terms,
            of_outputs=self.of_outputs.matrix(shape),
            of_variables=self.of_variables.matrix((shape[0], places.size)),
            row_low=np.concatenate(self.low),
            row_high=np.concatenate(self.high),
            names=self.names,
        )
        return Transcription(task, nodes, places, problem, start, self.rows_of, control_scales)

    def _variables(self, control_scales):
        task, guess, nodes, places = self.task, self.guess, self.nodes, self.places
        start, scale = np.zeros(places.size), np.ones(places.size)
        low, high = np.full(places.size, -np.inf), np.full(places.size, np.inf)
        start[places.x], scale[places.x] = nodes.coordinates, nodes.scales
        for end, k in ((task.start, 0), (task.end, -1)):
            if isinstance(end, State):
                low[places.x[k]] = high[places.x[k]] = nodes.coordinates[k]
        if task.timed:
            lengths = np.diff(guess.ts[list(task.arcs)])
            start[places.times] = scale[places.times] = lengths
            ends = (_SHORTEST * lengths, _LONGEST * lengths) if task.moving else task.duration
            low[places.times], high[places.times] = ends
        for number, (control, where) in enumerate(zip(task.controls, places.controls, strict=True)):
            ends = [np.ravel(side) for side in task.control_bounds[number]]
            start[where] = guess.controls[number]
            count = control.course.count(task.intervals)
            values = where[: task.intervals + 1] if control.course.smooth else where
            low[values], high[values] = ends
            if control.course.smooth:
                # Bounds between nodes imply those at inner nodes; a held component has no rates.
                held = ends[0] == ends[1]
                inner, rates = where[1 : task.intervals][:, ~held], where[task.intervals + 1 :][:, held]
                low[inner], high[inner], low[rates], high[rates] = -np.inf, np.inf, 0.0, 0.0
            bounded = np.isfinite(ends[0]) & np.isfinite(ends[1]) & (ends[0] < ends[1])
            usual = np.ones(control.size) if control_scales is None else control_scales[number]
            scale[where] = np.where(
                bounded, 0.5 * (np.where(bounded, ends[1], 1) - np.where(bounded, ends[0], 0)), usual
            )
            scale[where[task.intervals + 1 : count]] *= task.intervals
        k = 0
        for (_, shape), bounds in zip(task.design, task.design_bounds, strict=True):
            where = places.design[k : k + int(np.prod(shape, dtype=int))]
            k += where.size
            low[where], high[where] = (np.ravel(side) for side in bounds)
            values = guess.design[k - where.size : k]
            width = high[where] - low[where]
            scale[where] = np.where(np.isfinite(width) & (width > 0), width, np.maximum(np.abs(values), 1e-3))
            start[where] = values
        return start, scale, low, high

    def _arrival(self, steps: int) -> int:
        """Add the intervals; the place of their first output."""
        task, places, n = self.task, self.places, self.places.x.shape[1]
        intervals = np.arange(task.intervals)
        sizes = [n, 2, *(c.size * c.course.local for c in task.controls), places.design.size]
        begins = np.cumsum([0, *sizes])
        width = int(begins[-1])
        entries, offset = _Entries(), np.zeros((task.intervals, width))
        at = lambda begin, count: intervals[:, None] * width + begin + np.arange(count)
        entries.add(at(0, n), places.x[:-1])
        self._add_times(entries, offset, at(n, 2), n)
        for control, where, begin in zip(task.controls, places.controls, begins[2:], strict=False):
            local = where[control.course.places(task.intervals)].reshape(task.intervals, -1)
            weights = np.repeat(control.course.weights(task.shares), control.size, axis=1)
            entries.add(at(begin, local.shape[1]), local, weights)
        entries.add(at(begins[-2], places.design.size), places.design)
        outputs = self.nodes.charts[0].q.shape[1] + self.nodes.charts[0].u.shape[1] + (task.system.nz or 0) + 2
        charts = jax.tree.map(lambda x: x[:-1], self.nodes.charts)
        inputs = entries.matrix((task.intervals * width, places.size))
        return self._term(Arrival(self.model, task.running), charts, inputs, offset, outputs, steps)

    def _add_times(self, entries, offset, at, n):
        task, places = self.task, self.places
        if task.timed:
            entries.add_matrix(at[:, 0], places.times, task.passed[:-1])
            entries.add_matrix(at[:, 1], places.times, np.diff(task.passed, axis=0))
            offset[:, n] = task.t0
        else:
            offset[:, n] = task.t0 + task.duration[0] * task.shares[:-1]
            offset[:, n + 1] = task.duration[0] * np.diff(task.shares)

    def _look(self, function: Any, at: list[int], outputs: int) -> int:
        """Add nodes at which a function of the instant is computed; the place of their first output."""
        task, places, n = self.task, self.places, self.places.x.shape[1]
        nodes = np.array(at)
        width = n + 1 + sum(c.size for c in task.controls) + places.design.size
        entries, offset = _Entries(), np.zeros((nodes.size, width))
        rows = np.arange(nodes.size)[:, None] * width
        entries.add(rows + np.arange(n), places.x[nodes])
        if task.timed:
            entries.add_matrix(rows[:, 0] + n, places.times, task.passed[nodes])
        offset[:, n] = task.t0 + (0.0 if task.timed else task.duration[0]) * task.shares[nodes]
        begin = n + 1
        for control, where in zip(task.controls, places.controls, strict=True):
            values = where[control.course.values(task.intervals)[nodes]]
            entries.add(rows + begin + np.arange(control.size), values)
            begin += control.size
        entries.add(rows + begin + np.arange(places.design.size), places.design)
        charts = jax.tree.map(lambda x: x[nodes], self.nodes.charts)
        inputs = entries.matrix((nodes.size * width, places.size))
        return self._term(Look(self.model, function), charts, inputs, offset, outputs, 1)

    def _term(self, lane: AbstractLane, charts, inputs, offset, outputs, steps) -> int:
        lanes = len(charts[1])
        used = np.flatnonzero(np.any(np.diff(inputs.indptr).reshape(lanes, -1) > 0, axis=0))
        block = Block(lane, charts, tuple(used.tolist()), steps)
        self.terms.append(Term(block, inputs, offset.reshape(-1), outputs))
        first, self.outputs = self.outputs, self.outputs + lanes * outputs
        return first

    def _rows(self, where: str, names: Sequence[str], low: Any, high: Any) -> np.ndarray:
        """Add rows with bounds; their numbers, the objective's being zero."""
        first = 1 + sum(x.size for x in self.low)
        self.low.append(np.asarray(low, float))
        self.high.append(np.asarray(high, float))
        self.names += names
        rows = first + np.arange(len(names))
        self.rows_of[where] = rows
        return rows

    def _join(self, first: int) -> None:
        task, places, nodes = self.task, self.places, self.nodes
        outputs, indices = self.terms[0].outputs, nodes.charts[1][1:]
        scales = nodes.scales[1:].reshape(-1)
        names = [f"node {k + 1}" for k in range(task.intervals) for _ in range(indices.shape[1])]
        rows = self._rows("gaps", names, np.zeros(scales.size), np.zeros(scales.size))
        arrived = first + np.arange(task.intervals)[:, None] * outputs + indices
        self.of_outputs.add(rows, arrived.reshape(-1), 1.0 / scales)
        self.of_variables.add(rows, places.x[1:].reshape(-1), -1.0 / scales)
        if task.running is not None:
            self.of_outputs.add(0, first + np.arange(1, task.intervals + 1) * outputs - 1)

    def _limit(self, where: str, limits: Limits, at: list[int]) -> None:
        count = len(limits.components)
        first = self._look(Named(limits.names), at, count)
        names = [f"{name} at node {k}" for k in at for name in limits.components]
        sizes = np.tile(limits.sizes, len(at))
        rows = self._rows(where, names, np.tile(limits.low, len(at)) / sizes, np.tile(limits.high, len(at)) / sizes)
        self.of_outputs.add(rows, first + np.arange(len(at) * count), 1.0 / sizes)

    def _within(self) -> None:
        """Cubic controls are within their bounds between nodes, as the convex hull of Bézier points is."""
        task = self.task
        for control, where, ends in zip(task.controls, self.places.controls, task.control_bounds, strict=True):
            low, high = (np.ravel(side) for side in ends)
            chosen = np.flatnonzero((np.isfinite(low) | np.isfinite(high)) & (low < high))
            if not (control.course.smooth and chosen.size):
                continue
            limits = Limits((control.name,), (chosen.shape,), low[chosen], high[chosen])
            sizes = np.tile(limits.sizes, 2 * task.intervals)
            names = [f"{control.name} in interval {k}" for k in range(task.intervals) for _ in range(2 * chosen.size)]
            ends = (np.tile(side, 2 * task.intervals) / sizes for side in (limits.low, limits.high))
            own = self._rows(control.name, names, *ends)
            places = where[control.course.places(task.intervals)][:, :, chosen]
            thirds = control.course.weights(task.shares)[:, 2:, None] * np.array([[1.0], [-1.0]]) / 3
            thirds = np.broadcast_to(thirds, places[:, 2:].shape)
            self.of_variables.add(own, places[:, :2].reshape(-1), 1.0 / sizes)
            self.of_variables.add(own, places[:, 2:].reshape(-1), thirds.reshape(-1) / sizes)

    def _follow(self, before: Transcription) -> None:
        """Rows of the first node as the last node of the phase before, which are completed where phases are joined:
        all coordinates by name, and if both phases have the same bodies, velocities after the impulse of constraints.
        """
        names, system = before.names_at(-1), self.task.system
        if strikes := system.coordinate_names() == before.task.system.coordinate_names():
            names = names[: np.count_nonzero(before.nodes.charts[1][-1] < system.nq)]
        first, zeros = self._look(Named(names), [0], len(names)), np.zeros(len(names))
        rows = self._rows("link", [f"joint {name}" for name in names], zeros, zeros)
        self.of_outputs.add(rows, first + np.arange(len(names)), 1.0 / before.nodes.scales[-1][: len(names)])
        if strikes:
            zeros = np.zeros(np.count_nonzero(self.nodes.charts[1][0] >= system.nq))
            self._rows("strike", ["joint velocity"] * zeros.size, zeros, zeros)

    def _close(self) -> None:
        """The end is the start, up to turns of angles and the signs of Euler parameters, which the guess tells."""
        system, places, indices, scales = self.task.system, self.places, self.nodes.charts[1][0], self.nodes.scales[0]
        q, further = self.guess.states.q, np.zeros(system.nu + system.nz)
        signs = signs_like(system, q[-1], q[0])
        shift = np.append(full_turns(system, self.guess.states), further)[indices] / scales
        rows = self._rows("period", ["period"] * scales.size, shift, shift)
        last = (self.task.intervals - 1) * self.terms[0].outputs
        self.of_outputs.add(rows, last + indices, np.append(signs, further + 1.0)[indices] / scales)
        self.of_variables.add(rows, places.x[0], -1.0 / scales)


def full_turns(system: AbstractSystem, states: State) -> np.ndarray:
    """The full turns of angles from the first state to the last [rad], in the places of the coordinates."""
    q, turns = np.asarray(states.q), np.zeros(system.nq)
    for name, where in system.coordinate_names().items():
        if name.endswith(".angle") or not (name.endswith(".orientation") or system.body_names):
            turns[where] = 2 * np.pi * np.round((q[-1, where] - q[0, where]) / (2 * np.pi))
    return turns
