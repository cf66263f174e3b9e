"""Impacts, contacts that close and open, and friction that sticks and slips, along a motion."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from .._arguments import package_for_tables
from .._printed import preformatted
from .._types import State
from ..formulations import AbstractFormulation
from ..linalg.arrays import is_traced
from ..linalg.jitted import jitted
from ..parts.modes import CLOSED, FREE, OPEN, STICK
from ..system import AbstractSystem
from ..system.instant import Instant
from .guards import ContactGuards
from .tolerance import REST, ContactTolerance

# Impulses of contacts that are this small relative to a simultaneous one count as zero.
_ROUNDING = 1e-12
# The number of impacts that are computed together.
_TOGETHER = 8
# The kind of an event of a contact, by whether it was open before and is open after.
_KINDS = {(True, True): "impact", (True, False): "close", (False, True): "open", (False, False): "impulse"}


class FoundEvents(NamedTuple):
    """The recorded events of a run.

    **Fields:** their `number`; buffers with the `times` of the ends of steps at which they happen, and the raveled
    `states` before them; `touch`: gaps that count as closed, in units of the system's size; the time and the raveled
    state at the `start` of the run, and its last time, `end`; None if they are not known.
    """

    number: Int[Array, ""]
    times: Float[Array, " events"]
    states: Float[Array, "events n"]
    touch: Float[Array, ""]
    start: tuple[Float[Array, ""], Float[Array, "n"]] | None = None
    end: Float[Array, ""] | None = None


class AtStart(NamedTuple):
    """Contacts and dry friction at the start of a run: the `time` [s], and the arrays of `ContactEvents` then.
    `moves`: where dry friction slips, or is about to; it may also be at its limit at rest, with a mode of slip.
    """

    time: Float[Array, ""]
    impulses: Float[Array, "parts"]
    kinetic_energy_lost: Float[Array, ""]
    before: Float[Array, "parts"]
    after: Float[Array, "parts"]
    rest: Float[Array, "parts"]
    moves: Bool[Array, "parts"]


class Event(NamedTuple):
    """An event of one contact, or of dry friction.

    ```python
    impacts = [(event.time, event.part, event.impulse) for event in motion.events if event.kind == "impact"]
    ```

    **Fields:**

    - `time` [s].
    - `part`: the name of the part.
    - `kind`: of a contact `"impact"`, after which the gap opens again, `"close"`, `"open"`, `"rest"`: the end of
        infinitely many bounces, or `"impulse"`: it stays closed while others strike. Of friction `"stick"`, `"slip"`,
        or `"impact"` for an impulse alone. In the table, and in `ContactEvents.at_start`, `"closed at start"`, `"stick
        at start"` and `"slip at start"` hold from `t0` on; `"impact at start"` is an impulse then.
    - `impulse` [N s, N m s].
    - `kinetic_energy_lost` [J]: the kinetic energy that all bodies together lose at this time, the same for each part.
        It is negative if a driver, whose speed is given, does more work at the impact than the impact dissipates.
        `ContactEvents.kinetic_energy_lost` has one value for each time.
    """

    time: float
    part: str
    kind: str
    impulse: float
    kinetic_energy_lost: float


class ContactEvents(eqx.Module):
    """The events of contacts and dry friction along a motion, in the order of time; `print(motion.events)` shows a
    table, and `list(motion.events)` has an `Event` for each part that takes part in one.

    ```python
    print(motion.events)  # A table, of a motion with contacts such as `RigidContact`.
    motion.events.times, motion.events.impulses, motion.events.kinetic_energy_lost
    slips = [event.part for event in motion.events.at_start if event.kind == "slip at start"]
    ```

    Parts that change at the same time share an event. Its time has the derivative of the first of them; impulses and
    energies have those of their own times.

    The table begins with contacts that are closed, and friction that sticks or slips, from `t0` on: `at_start`, with
    arrays in `start`. The other arrays have the events on the way only, and so have `list` and `len`. What changes at a
    jump of an input, as where a brake is let go, or at announced `jumps` is an event just after the jump; its time has
    the derivative of the jump's time. A state that is saved just at an event may be the state before it or after it.
    Times, impulses and energies have first derivatives; `rest` counts as a constant.

    **Fields:**

    - `names` of the parts, contacts first; twice for friction in space, which has two directions.
    - `contacts`: the number of contacts among `names`.
    - `times` [s], shape (events,). Under `jit` or in a batch there are as many events as `max_events`, with infinite
        times after the last.
    - `impulses` [N s, of angles N m s], shape (events, parts).
    - `kinetic_energy_lost` [J], shape (events,): by all bodies at the impact, negative if a driver gave more.
    - `before` and `after`: modes, shape (events, parts). A contact has 0 if it is open, 1 if it is closed, 2 if others
        imply it. Friction has 1 and -1 if it slips forwards and backwards, in space 1; 2 if it sticks, 3 if it sticks
        and other friction implies it, 0 if it does not act.
    - `rest` [s], shape (events, parts): the time from an event to the end of infinitely many bounces too low to be
        resolved, after which the contact is at rest; zero without such bounces.
    - `start`: `t0` as `time`, and the other arrays at that time, without the axis of events.
    - `end` [s]: the last time of the motion.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    contacts: int = eqx.field(static=True)
    times: Float[Array, "events"]
    impulses: Float[Array, "events parts"]
    kinetic_energy_lost: Float[Array, "events"]
    before: Float[Array, "events parts"]
    after: Float[Array, "events parts"]
    rest: Float[Array, "events parts"]
    start: AtStart | None = None
    end: Float[Array, ""] | None = None

    def __len__(self) -> int:
        return len(self._rows())

    def __iter__(self):
        return iter(self._rows())

    def __getitem__(self, k: int) -> Event:
        return self._rows()[k]

    def __repr__(self) -> str:
        if isinstance(self.times, Tracer) or self.times.ndim != 1:
            return f"ContactEvents: of {', '.join(dict.fromkeys(self.names))}, times of shape {self.times.shape}"
        return f"ContactEvents: {int(np.sum(np.isfinite(self.times)))} of {', '.join(dict.fromkeys(self.names))}"

    def _repr_html_(self) -> str:
        return preformatted(self)

    def __str__(self) -> str:
        if isinstance(self.times, Tracer) or self.times.ndim != 1:
            return repr(self)
        events = [*self.at_start, *self._rows()]
        # The energy that parts lose together is shown at the first of them.
        first = [k == 0 or event.time != events[k - 1].time for k, event in enumerate(events)]
        rows = [
            (f"{e.time:.9g}", e.part, e.kind, f"{e.impulse:.6g}", f"{e.kinetic_energy_lost:.6g}" if shown else "")
            for e, shown in zip(events, first, strict=True)
        ]
        table = [("time [s]", "part", "kind", "impulse [N s]", "kinetic energy lost [J]"), *rows]
        widths = [max(len(row[k]) for row in table) for k in range(5)]
        return "\n".join(
            "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in table
        )

    def to_pandas(self) -> Any:
        """A `pandas.DataFrame` with a row for each `Event` of the table.

        **Raises:** `ImportError` without pandas; `ValueError` for a batch.
        """
        rows = [*self.at_start, *self._rows()]
        return package_for_tables("pandas", "pandas").DataFrame(rows, columns=list(Event._fields))

    @property
    def at_start(self) -> list[Event]:
        """What holds from `t0` on: an `Event` for each contact that is closed, and for friction that sticks or slips.

        **Raises:** `ValueError` for a batch, and under `jit`.
        """
        concrete = self._concrete()
        return [] if concrete.start is None else list(concrete._from_start(concrete.start))

    def _rows(self) -> list[Event]:
        concrete = self._concrete()
        rows = [row for k in np.flatnonzero(np.isfinite(concrete.times)) for row in concrete._at(k)]
        return sorted(rows, key=lambda event: event.time)

    def _concrete(self):
        if isinstance(self.times, Tracer) or self.times.ndim != 1:
            raise ValueError(
                "The events of one motion are a table; in a batch or under jit they are arrays: see the fields of "
                "ContactEvents."
            )
        return jax.tree.map(np.asarray, self)

    def _from_start(self, start: AtStart) -> Iterator[Event]:
        """The parts that act from the start on, with concrete numbers."""
        time, lost = float(start.time), float(start.kinetic_energy_lost)
        for i, name in enumerate(self.names[: self.contacts]):
            impulse = float(start.impulses[i])
            if start.after[i] > OPEN or impulse > 0:
                kind = "closed at start" if start.after[i] > OPEN else "impact at start"
                yield Event(time, name, kind, impulse, lost)
            yield from self._rest(time, name, start.rest[i], start.after[i])
        for name, i, impulse in self._frictions(start.impulses):
            after, slips = start.after[i], np.any(start.moves[i:][: self.names.count(name)])
            if impulse != 0 or after != FREE:
                kind = "impact" if after == FREE else "slip" if after < STICK and slips else "stick"
                yield Event(time, name, f"{kind} at start", impulse, lost)

    def _rest(self, time, name, rest, after) -> Iterator[Event]:
        """The end of infinitely many bounces, if it is within the motion."""
        if rest > 0 and after == CLOSED and (self.end is None or time + rest <= self.end):
            yield Event(time + float(rest), name, "rest", 0.0, 0.0)

    def _frictions(self, impulses) -> Iterator[tuple[str, int, float]]:
        """Friction by name, with the index of its first row, and its impulse."""
        for name in dict.fromkeys(self.names[self.contacts :]):
            # Friction in two directions has two rows.
            i = self.names.index(name)
            of_both = impulses[i:][: self.names.count(name)]
            yield name, i, float(np.linalg.norm(of_both) if of_both.size > 1 else of_both[0])

    def _at(self, k: int) -> Iterator[Event]:
        """The parts that take part in one event, with concrete numbers."""
        time, lost = float(self.times[k]), float(self.kinetic_energy_lost[k])
        impulses, were_open, are_open = self.impulses[k], self.before[k] == OPEN, self.after[k] == OPEN
        of_contacts = impulses[: self.contacts]
        strikes = np.any(of_contacts[were_open[: self.contacts]] > 0)
        # Impulses of contacts that stay closed may be rounding errors.
        least = _ROUNDING * np.max(of_contacts, initial=0.0) if strikes else np.inf
        for i, name in enumerate(self.names[: self.contacts]):
            was_open, is_open = bool(were_open[i]), bool(are_open[i])
            if impulses[i] > (0.0 if was_open else least) or was_open != is_open:
                yield Event(time, name, _KINDS[was_open, is_open], float(impulses[i]), lost)
            yield from self._rest(time, name, self.rest[k, i], self.after[k, i])
        for name, i, impulse in self._frictions(impulses):
            before, after = self.before[k, i], self.after[k, i]
            # Friction that sticks goes on sticking when other friction begins or ceases to imply it.
            changed = before != after and min(before, after) < STICK
            if impulse != 0 or (changed and after != FREE):
                kind = "stick" if after >= STICK else "slip" if after != FREE else "impact"
                yield Event(time, name, kind if changed else "impact", impulse, lost)


def contact_events(system: AbstractSystem, formulation: AbstractFormulation, record: FoundEvents) -> ContactEvents:
    """The events of a run, or of a batch of runs, from their records."""
    (most, axis), contacts, start = (record.times.shape[-1], record.times.ndim - 1), system.contacts, None
    if record.start is None:
        *rows, _ = _of_records(system, formulation, record)
    else:
        # The start is the first record, so that one program serves all.
        xp: Any = jnp if is_traced((system, formulation, record)) else np
        with_start = lambda first, rest: xp.concatenate([xp.expand_dims(first, axis), rest], axis)
        times, states = map(with_start, record.start, (record.times, record.states))
        number = xp.asarray(record.number) + 1
        rows = _of_records(system, formulation, record._replace(number=number, times=times, states=states))
        parted = [_parted(x, axis) for x in rows]
        start, rows = AtStart(record.start[0], *(x for x, _ in parted[1:])), [x for _, x in parted[:-1]]
    return ContactEvents(contacts.names, contacts.n, *_in_order(rows, axis, most), start=start, end=record.end)


def _parted(x: Any, axis: int) -> tuple[Any, Any]:
    """The first entry along an axis, and the others."""
    if isinstance(x, np.ndarray):
        first, rest = np.split(x, [1], axis)
        return np.squeeze(first, axis), rest
    return lax.index_in_dim(x, 0, axis, False), lax.slice_in_dim(x, 1, None, axis=axis)


def _of_records(system, formulation, record):
    """The numbers of recorded events, one row each: times, infinite for rows without an event, impulses, energies,
    modes before and after, times to rest, and which friction moves.
    """
    if is_traced((system, formulation, record)):
        return _evaluated(system, formulation, record)
    most, axis = record.times.shape[-1], record.times.ndim - 1
    number, times, states = (np.asarray(x) for x in (record.number, record.times, record.states))
    number, blocks = np.minimum(number, most), []
    # Concrete also while a function is traced, if the run is not its argument.
    with jax.ensure_compile_time_eval():
        # In blocks that all use one program.
        for first in range(0, max(int(np.max(number, initial=0)), 1), _TOGETHER):
            places = np.minimum(np.arange(first, first + _TOGETHER), most - 1)
            block = record._replace(number=number - first, times=times[..., places], states=states[..., places, :])
            blocks.append(_evaluated(system, formulation, block))
    return [np.concatenate(column, axis) for column in zip(*blocks, strict=True)]


def _in_order(rows, axis, most):
    """Rows in the order of time; concrete ones of a single run without those behind its last event.

    **Arguments:** `most`: the number of rows of a batch.
    """
    if is_traced(rows):
        order = jnp.argsort(jnp.isinf(rows[0]), axis=axis, stable=True)
        return [jnp.take_along_axis(x, _along(order, x), axis) for x in rows]
    count = int(np.sum(np.isfinite(rows[0]))) if axis == 0 else most
    order = np.argsort(np.isinf(rows[0]), axis=axis, kind="stable")[..., :count]

    def placed(x, fill):
        happened = np.take_along_axis(np.asarray(x), _along(order, x), axis)
        padding = [(0, count - happened.shape[axis] if k == axis else 0) for k in range(x.ndim)]
        return jax.device_put(np.pad(happened, padding, constant_values=fill))

    return placed(rows[0], np.inf), *(placed(x, 0.0) for x in rows[1:])


def _along(order, x):
    return order.reshape(order.shape + (1,) * (x.ndim - order.ndim))


@jitted
def _evaluated(system: AbstractSystem, formulation: AbstractFormulation, record: FoundEvents) -> Any:
    if record.times.ndim > 1:
        return eqx.filter_vmap(_evaluated)(system, formulation, record)
    guards = ContactGuards(system, formulation, ContactTolerance(record.touch))
    nq, nu = system.nq, system.nu
    # Entries behind the last event need a state without failure, also of derivatives.
    guess = system.guess
    still = jnp.concatenate([guess.q, guess.u, jnp.zeros(system.nz, guess.q.dtype)])
    some = record.number > 0
    first = jnp.where(some, record.states[0], still), jnp.where(some, record.times[0], 0.0)

    def single(k, t, flat):
        is_event = k < record.number
        flat = jnp.where(is_event, flat, first[0])
        y = State(flat[:nq], flat[nq : nq + nu], flat[nq + nu :] if system.nz else None)
        at = jnp.where(is_event, t, first[1])
        event = guards.event(at, y)
        out = guards.impact(at, y, dated=True, event=event)
        # Steps may also end where nothing changes.
        before, after = out.modes
        changes = jnp.any(before != after) | jnp.any(out.impulses != 0)
        is_event = is_event & (changes | ((k == 0) & (record.start is not None)))
        time = jnp.where(is_event, t + out.late, jnp.inf)
        values = out.impulses, out.energy, before, after, out.rest, _moves(guards, Instant.of(system, at, y), event)
        return time, *jax.tree.map(lambda x: jnp.where(is_event, x, jnp.zeros_like(x)), values)

    return jax.vmap(single)(jnp.arange(record.times.size), record.times, record.states)


def _moves(guards: ContactGuards, at: Instant, event: Any) -> Bool[Array, "parts"]:
    """Where dry friction slips after an event, or begins to, beyond rounding errors."""
    system, contacts, after = at.system, at.system.contacts, at.with_(u=event.u)
    gradients, rates = jnp.abs(after.contact_place.gradients), jnp.abs(after.contact_motion.rates)
    begins = jnp.abs(after.contact_accelerations(event.after))
    sizes = gradients @ jnp.abs(event.u), gradients @ jnp.abs(at.inertia.solve(at.force))
    slowest = guards.tolerance.in_metres(system).slowest
    moves = (rates > REST * sizes[0] + slowest) | (begins > REST * sizes[1] + slowest)
    return lax.stop_gradient(jnp.pad(moves[contacts.n :], (contacts.n, 0)))
