"""A motion, with views by name."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Int

from ._arguments import package_for_tables
from ._compat import changed, steps_of
from ._pictured import picture
from ._results import RESULTS
from ._types import Scalar, State
from .contacts.events import ContactEvents, FoundEvents, contact_events
from .formulations import AbstractFormulation
from .formulations.laws import accelerations_at
from .formulations.shares import least_multipliers
from .linalg.arrays import ARRAYS, is_traced
from .linalg.jitted import jitted
from .linalg.members import vmap_states
from .manifold.default import default_manifold
from .manifold.impulse import after_jumps
from .manifold.orthogonal_projection import project_normalized
from .parts.names import UnknownNameError, unknown
from .solvers import Adams
from .solvers.directed import next_number
from .system import AbstractSystem
from .system.instant import Instant
from .system.picture import Picture, joined_pictures
from .system.quantities import Reaction, Solved, with_shapes

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class ConstraintViolation(NamedTuple):
    """Largest residuals, shape (times,), in units that do not depend on the form of the constraints.

    **Fields:** `position`: the changes of coordinates that satisfy the constraints, in units of the system's size and
    radians; `velocity`: the changes of velocities, in these units per second.
    """

    position: Float[Array, "times"]
    velocity: Float[Array, "times"]

    def __repr__(self) -> str:
        if is_traced(self) or not all(isinstance(values, ARRAYS) for values in self):
            return f"ConstraintViolation: {with_shapes(self._asdict(), {})}"
        position, velocity = (np.max(values, initial=0.0) for values in self)
        return f"ConstraintViolation: at most {position:.2g} of positions, {velocity:.2g} 1/s of velocities"


# The default solver of a motion.
_ADAMS = Adams()
# The attribute of a motion from which it can be continued.
CONTINUATION = "_continuation"
# A later motion may begin this power of the precision from where the first ends, in units of coordinates.
_MOVED = 0.375
# The number of names that `print` of a motion shows.
_SHOWN = 12


def _listed(names: Sequence[str]) -> str:
    rest_of_names = f", … ({len(names)} in all)" if len(names) > _SHOWN else ""
    return f"{', '.join(names[:_SHOWN])}{rest_of_names}"


class _ByName(Mapping[str, Any]):
    """A lazy mapping from the names of parts to values."""

    def __init__(self, kind: str, names: tuple[str, ...], value: Callable[[str], Any]):
        self._kind, self._names, self._value = kind, names, value

    def __getitem__(self, name: str) -> Any:
        if name not in self._names:
            raise unknown(self._kind, name, self._names)
        return self._value(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __repr__(self) -> str:
        return f"<of each {self._kind}: {', '.join(self._names)}>"


def _of_each_member(view: Callable[..., Any]) -> Callable[..., Any]:
    """A view of any batch of motions, from a view of one motion; its arrays have the batch's axes first."""

    @functools.wraps(view)
    def of_all(trajectory, *arguments):
        if trajectory.ts.ndim <= 1:
            return view(trajectory, *arguments)
        return eqx.filter_vmap(lambda member: of_all(member, *arguments))(trajectory)

    return of_all


def _of_each_stage(view: Callable[..., Any]) -> Callable[..., Any]:
    """A view of any motion, from a view of a run: the values in its stages, one after the other along time."""

    @functools.wraps(view)
    def of_all(trajectory, *arguments):
        if not trajectory.stages:
            return view(trajectory, *arguments)
        return _along_time(trajectory, [view(stage, *arguments) for stage in trajectory.stages])

    return of_all


def _along_time(trajectory, values):
    """Values of stages, one after the other along the axis of time."""
    return jax.tree.map(lambda *x: jnp.concatenate(x, trajectory.ts.ndim - 1), *values)


def _view(view: Callable[["Trajectory"], Any]) -> Callable[["Trajectory"], Any]:
    """A view of any batch of motions, from a view of one run, compiled once for all runs of a system."""
    compiled = jitted(_of_each_member(view))

    @functools.wraps(view)
    def of_motion(trajectory):
        states_of(trajectory)
        # The end of a run is not part of the program.
        unused = ("interpolation", "event_mask", "found_events", "closer")
        return compiled(changed(trajectory, stats={}, result=None, **dict.fromkeys(unused)))

    return _of_each_stage(of_motion)


def states_of(trajectory: "Trajectory") -> State:
    """The saved states.

    **Raises:** `ValueError` if the run saved something else, or nothing.
    """
    if not isinstance(trajectory.ys, State):
        saved = "nothing" if trajectory.ys is None else "the values of SaveAt(fn=…) in motion.ys"
        raise ValueError(
            f"This motion has no states, since it saved {saved}: let saveat be times, or a diffrax.SaveAt without fn."
        )
    return trajectory.ys


class Trajectory(eqx.Module):
    """The motion that `simulate` returns, or a batch of them.

    ```python
    motion = jaxmb.simulate(system, state, t1=1.0, saveat=np.linspace(0.0, 1.0, 11))
    motion["bar"].angle, motion["pin"].angle_rate, motion.energy, motion.constraint_violation
    ```

    **Fields:**

    - `ts` [s], shape (times,).
    - `ys`: a `State` with a leading axis of time.
    - `result`: how the motion ended.
    - `closer`: the same motion at tighter tolerances, after `error=True`.
    - `stats`: counts of the integration, by name.
    - `stages`: the runs that were joined by `motion + later`, each with its own `system`; empty for a single run.

    **Counts:**

    - `num_steps`, `num_rejected_steps`, `num_evaluations`, `newton_iterations`, `charts`.
    - `orders`: accepted steps at order 1, 2, ….
    - `linearised_steps`: whether derivatives use one linearisation of the equations at each step, or the derivative of
        each step as it is, which costs more.
    - `interpreted`: whether NumPy computed any of it, after `setup(compile="later")`.
    - With `solver="auto"` or `"switch"` also `stiff` and `stiff_steps`.
    - With `Hermite`, `num_evaluations` of f with its time derivative, `num_matrices` made, `past_points`: accepted
        steps with 1, 2, … points of the past, and `wrong_derivative`: whether differences of f contradict its
        derivative.
    - With contacts or dry friction, `num_events`: the number of times of `events`.

    `trajectory["crank"]` is a `BodyMotion`, the motion of a body. `trajectory["hip"]` is a `PartMotion`, the motion of
    a joint, a frame or a part with internal states. In generalized coordinates `trajectory["theta"]` is a
    coordinate and `trajectory["theta_rate"]` its rate, shape (times,). `events` are the events of contacts and dry
    friction, as a table. `evaluate` has the same quantities at one state.

    **Batches:** `jax.vmap` of a simulation returns a batch. Every field and every view has the batch's axes before the
    axes given here. `batch[3]` is a member, `batch[2:5]` a smaller batch, `len(batch)` the number of members, and a
    loop over the batch gets them one by one.

    **Stages:** `motion + later` joins two runs of one system in a motion for tables, pictures and views, such as runs
    before and after a change of parameters. `simulate(system, motion.end, t0=1.0, t1=2.0)` begins where a motion ended.
    """

    system: Any
    formulation: AbstractFormulation
    ts: Float[Array, "times"]
    ys: Any
    stats: dict[str, Any]
    result: RESULTS
    interpolation: diffrax.AbstractPath | None
    event_mask: Any
    found_events: FoundEvents | None = None
    closer: "Trajectory | None" = None
    stages: tuple["Trajectory", ...] = ()

    def _is_known(self) -> bool:
        """Whether there are numbers to print."""
        has_numbers = isinstance(self.ts, jax.Array | np.ndarray) and "num_steps" in self.stats
        return has_numbers and not is_traced((self.ts, self.result, self.stats))

    def __repr__(self) -> str:
        if not self._is_known():
            return super().__repr__()
        ts, steps, ended = (np.asarray(x) for x in (self.ts, self.stats["num_steps"], self.result._value))
        finite, names = ts[np.isfinite(ts)], self._names()
        span = f"t = {finite.min():.6g} to {finite.max():.6g}" if finite.size else "no time"
        if ended.ndim:
            good = np.sum(ended == RESULTS.successful._value)
            text = f"Trajectories of {ended.size} runs of shape {ended.shape}, {good} successful: {span}"
        else:
            text = f"Trajectory: {finite.size} saved from {span} in {steps} steps; {RESULTS[self.result]}"
        forces = self._force_names()
        force_line = f"\nForces, in motion.forces: {_listed(forces)}" if forces else ""
        return f"{text}\nNames: {_listed(names)}{force_line}"

    def __getitem__(self, name: Any) -> Any:
        if not isinstance(name, str):
            return self._members(name)
        if name in self.system.catalogue.motion_names():
            return self.system.catalogue.motion(name, states_of(self))
        if name in self:
            states_of(self)
            return self.quantity(name) if name in self.system.quantities() else PartMotion(self, name)
        if name in self._force_names():
            raise UnknownNameError(f"{name!r} is a force: motion.forces[{name!r}] is what it exerts.")
        raise unknown("body, joint or frame" if self.system.body_names else "coordinate", name, self._names())

    def __getattr__(self, name: str) -> Any:
        # JAX and notebooks look for private names; fields are missing while an object is made.
        if not name.startswith("_") and "system" in vars(self):
            for view, names in (("motion", self._names()), ("motion.forces", self._force_names())):
                if name in names:
                    raise AttributeError(f"A motion has its parts by their names: {view}[{name!r}].")
        # Python's own error, or the error raised by the property of this name.
        return super().__getattribute__(name)

    def _force_names(self) -> tuple[str, ...]:
        return self.system.catalogue.force_names() if self.system.body_names else ()

    def _names(self) -> tuple[str, ...]:
        """The names that `trajectory[name]` takes."""
        parts = (quantity.split(".")[0] for quantity in self.system.quantities())
        return tuple(dict.fromkeys((*self.system.catalogue.motion_names(), *parts)))

    def __contains__(self, name: object) -> bool:
        return name in self._names()

    @property
    def _batch(self) -> tuple[int, ...]:
        """The lengths of the batch's axes."""
        return np.shape(self.result._value) if self.ts is None else self.ts.shape[:-1]

    def __iter__(self) -> Iterator[Any]:
        """The names that `trajectory[name]` takes; of a batch, its members."""
        return (self._members(k) for k in range(self._batch[0])) if self._batch else iter(self._names())

    def __len__(self) -> int:
        return self._batch[0] if self._batch else len(self._names())

    def _members(self, index) -> "Trajectory":
        """The members of a batch at an index of its axes, as of an array."""
        if not self._batch:
            raise IndexError(
                f"This is a single motion, which has parts by their names, such as motion[{self._names()[0]!r}]; only "
                f"a batch has members. Got {index!r}; states at saved times are in motion.ys, the last is motion.end."
            )
        if not is_traced(index):
            # JAX takes the nearest index in place of one outside of an array.
            np.broadcast_to(False, self._batch)[index]
        return jax.tree.map(lambda x: _entries(x, index) if isinstance(x, ARRAYS) else x, self)

    def __add__(self, later: "Trajectory") -> "Trajectory":
        """The motion of both, where the later begins where this one ends: for tables, pictures and views by name.

        Where they meet, the values of the later count. `stats` are sums, and views of each stage are computed with its
        own system. `at` finds states in the stage of each time, and there is no `error` estimate.

        **Raises:** `ValueError` if the later is not saved where this one ends, begins in another configuration, or has
        other parts. Under `jit`, where this is unknown, its states are NaN then.
        """
        return joined(self, later) if hasattr(later, "stages") else NotImplemented

    def get(self, name: str, default: Any = None) -> Any:
        """`trajectory[name]`, or the default if there is no such name."""
        if name not in self:
            return default
        return self[name]

    def quantity(self, name: str) -> Array:
        """A quantity by its name in `identify`, axis 0 is time: `"rod.position"` or `"rod.acceleration"` of a body,
        `"A.force"` of a joint; in generalized coordinates `"theta"`, `"theta_rate"`, and `"A.force"` of a constraint.
        """
        quantities = self.system.quantities()
        if name not in quantities:
            raise unknown("quantity", name, quantities)
        return self._measured((name,))[name]

    @property
    def events(self) -> ContactEvents:
        """Impacts, contacts that close and open, friction that sticks and slips: `print` shows a table of times, parts,
        kinds, impulses and energies lost.

        ```python
        for event in motion.events:
            print(event.time, event.part, event.kind, event.impulse)
        ```
        """
        if self.found_events is None:
            raise ValueError(
                "There are no events, since the system has neither contacts such as jaxmb.Stop nor dry friction."
            )
        # Not a field, so that a copy with other fields does not have it.
        attributes: Any = vars(self)
        if "_events" not in attributes:
            events = self._events_of_run()
            if is_traced(events):
                return events
            attributes["_events"] = events
        return attributes["_events"]

    @_of_each_stage
    def _events_of_run(self):
        record: Any = self.found_events
        return contact_events(self.system, self.formulation, record)

    @property
    def error(self) -> "GlobalError":
        """An estimate of the global error of this motion, after `simulate(..., error=True)`."""
        if self.closer is None:
            raise ValueError("error needs simulate(..., error=True).")
        result = self.closer.result
        if not isinstance(self.ts, Tracer) and self.closer.ts.shape != self.ts.shape:
            raise ValueError(
                f"There is no error estimate, since the run at tighter tolerances failed: {RESULTS[result]}"
            )
        return GlobalError(self, self.closer)

    @_of_each_stage
    def _measured(self, names):
        states_of(self)
        quantities = self.system.quantities()
        chosen = {name: quantities[name] for name in names}
        solved = Solved(*self._solved) if any(quantity.of_forces for quantity in chosen.values()) else None
        states = lambda quantity: self.bearing if quantity.of_forces else self.ys
        return {name: quantity.value(self.ts, states(quantity), solved) for name, quantity in chosen.items()}

    def at(self, t: ArrayLike) -> State:
        """The state at any time or times [s] of a run with `SaveAt(dense=True)`, on the constraints; in a batch, at the
        same times of every member.

        At the time t of an announced jump, velocities are taken after it, as in saved states; at `numpy.nextafter(t,
        -numpy.inf)` before it. The state is NaN outside of the run, and where Newton's method finds no state on the
        constraints, as within steps that are too long.
        """
        if any(run.interpolation is None for run in self.stages or (self,)):
            raise ValueError("at(t) needs simulate(..., saveat=diffrax.SaveAt(dense=True)).")
        return self._at(t)

    @property
    def end(self) -> State:
        """The state at the last saved time, from which a further run begins; where a run ended early, the last state
        that it reached.

        ```python
        later = jaxmb.simulate(system, motion.end, t0=1.0, t1=2.0)
        ```
        """
        states, numbers = states_of(self), jnp if is_traced(self.ts) else np
        reached = numbers.isfinite(numbers.asarray(self.ts))
        if numbers is np and reached[..., -1].all():
            return _saved(self, -1)[1]
        last = numbers.maximum(numbers.sum(reached, axis=-1) - 1, 0)[..., None, None]
        return jax.tree.map(lambda x: jnp.squeeze(jnp.take_along_axis(x, last, -2), -2), states)

    def continued(self, *, t1: Scalar, saveat: diffrax.SaveAt | ArrayLike | None = None) -> "Trajectory":
        """The motion from the end of this one to `t1` [s], by the same system, method and tolerances.

        ```python
        motion = jaxmb.simulate(system, state, t1=1.0, saveat=[0.0, 1.0])
        later = motion.continued(t1=2.0, saveat=[1.0, 2.0])
        whole = motion + later
        ```

        The method goes on as if the motion had not ended: with its history, orders and steps. It starts anew where
        drivers or inputs have kinks, jumps or turns. `saveat` is as in `simulate`.

        **Raises:** `ValueError` for a motion that ended early, and for one that was joined, loaded, copied or taken
        from a batch: for those `simulate(system, motion.end, t0=…, t1=…)`.
        """
        going_on = vars(self).get(CONTINUATION)
        if going_on is None:
            raise ValueError(
                "Only a motion as simulate returns it can be continued, not one that was joined, loaded, copied, "
                "traced or taken from a batch: simulate(system, motion.end, t0=..., t1=...) begins where it ended."
            )
        return going_on(t1, saveat)

    @_of_each_member
    def _at(self, t):
        t = jnp.asarray(t, self.system.guess.q.dtype)
        runs, flat = self.stages or (self,), t.reshape(-1)
        # The axis of time points forward along the motion.
        sign = jnp.sign(self.ts[-1] - self.ts[0]) if self.stages else 1
        starts = [sign * run.ts[0] for run in runs[1:]]
        out = None
        for run, start, next_start in zip(runs, [None, *starts], [*starts, None], strict=True):
            # Derivatives would be NaN if a stage were asked beyond its ends.
            inside = flat if next_start is None else sign * jnp.minimum(sign * flat, next_start)
            inside = inside if start is None else sign * jnp.maximum(sign * inside, start)
            states = _between(run.system, run.interpolation, inside)
            begun = True if start is None else (sign * flat >= start)[:, None]
            out = states if out is None else jax.tree.map(functools.partial(jnp.where, begun), states, out)
        return jax.tree.map(lambda y: y.reshape(t.shape + y.shape[1:]), out)

    @property
    @_view
    def kinetic_energy(self) -> Float[Array, "times"]:
        """Kinetic energy [J]."""
        return jax.vmap(lambda t, y: self.system.kinetic_energy(t, y.q, y.u))(self.ts, self.ys)

    @property
    @_view
    def potential_energy(self) -> Float[Array, "times"]:
        """Potential energy [J] of gravity and conservative forces."""
        return jax.vmap(lambda t, y: self.system.at(y).energy_in_motion(t, y.q, y.u))(self.ts, self.ys)

    @property
    def energy(self) -> Float[Array, "times"]:
        """Kinetic and potential energy [J]."""
        return self.kinetic_energy + self.potential_energy

    @property
    @_view
    def linear_momentum(self) -> Float[Array, "times d"]:
        """`Σ m v` [kg m/s], world axes."""
        return jax.vmap(lambda y: self.system.linear_momentum(y.q, y.u))(self.ys)

    @property
    @_view
    def angular_momentum(self) -> Float[Array, "times *d"]:
        """Moment of momentum about the world origin [kg m²/s]."""
        return jax.vmap(lambda y: self.system.angular_momentum(y.q, y.u))(self.ys)

    @property
    @_of_each_stage
    def rates(self) -> Float[Array, "times nq"]:
        """q̇ of every coordinate."""
        return self.system.catalogue.rates_along(self.ts, states_of(self))

    @property
    def accelerations(self) -> Float[Array, "times nu"]:
        """u̇ of every velocity."""
        return self._solved[0]

    @property
    def multipliers(self) -> Float[Array, "times rows"]:
        """Multipliers λ of every row, `M u̇ = F + Aᵀλ`; of redundant rows the least ones."""
        return self._solved[1]

    @property
    @_view
    def _solved(self):
        def single(t, y):
            at = Instant.of(self.system, t, y)
            udot, multipliers = accelerations_at(at, self.formulation)
            return udot, least_multipliers(at, multipliers)

        return vmap_states(single, self.system.acceleration_rows * self.system.nu)(self.ts, self.ys)

    @property
    def bearing(self) -> State:
        """The states to which the `multipliers` belong, in which implied contacts bear their shares of forces."""
        contacts = self.system.contacts
        return contacts.sharing.bearing(contacts, states_of(self))

    @property
    def reactions(self) -> Mapping[str, Reaction]:
        """Forces of the joints of rigid bodies by name, each a `Reaction`.

        `reactions["A"].force` [N], shape (times, d), in world axes, acts on the last of the joint's bodies that is not
        the ground; `.moment` [N m] about the joint's point; `.multipliers`. Redundant joints have the shares of least
        norm, smooth in time; `motion.undetermined_reactions` names them.
        """
        return _ByName("joint", self.system.catalogue.joint_names(), self._reaction)

    @property
    def undetermined_reactions(self) -> tuple[str, ...]:
        """Names of the joints and contacts whose shares of a force the equations leave open.

        Each row counts by its constraint force, with forces multiplied by the system's size. The shares of redundant
        joints have the least sum of squares of these, and so have the shares of closed contacts, none of which pulls.
        """
        if self.ts.ndim != 1:
            raise ValueError("undetermined_reactions is of a single motion, not of a batch.")
        states_of(self)
        if self.stages:
            return tuple(sorted({name for stage in self.stages for name in stage.undetermined_reactions}))
        motion = self.trimmed()
        return self.system.catalogue.undetermined(motion.ts, motion.ys)

    @_of_each_stage
    def _reaction(self, name):
        return self.system.catalogue.reaction(name, self.ts, self.bearing, self.multipliers)

    @property
    def constraint_forces(self) -> Mapping[str, Array]:
        """Generalized forces `Aᵀ λ` of the constraints by name, shape (times, nu)."""
        return _ByName("joint", self.system.catalogue.constraint_names(), self._constraint_force)

    @_of_each_stage
    def _constraint_force(self, name):
        return self.system.catalogue.constraint_force(name, self.ts, self.bearing, self.multipliers)

    @property
    def forces(self) -> Mapping[str, Array]:
        """Wrenches of the applied forces by name, on each of the part's bodies in order, shape (times, bodies, 3) or
        (times, bodies, 6): force [N] in world axes; moment [N m] about the mass centre, in body axes in space.

        Friction in a joint is among them under its own name, on the bodies of the joint; the reaction of the joint
        excludes it.
        """
        return _ByName("force", self.system.catalogue.force_names(), self._wrenches)

    @_of_each_stage
    def _wrenches(self, name):
        multipliers = None if self.system.ideal else self.multipliers
        return self.system.catalogue.applied_wrenches(name, self.ts, self.bearing, multipliers)

    @property
    @_view
    def constraint_violation(self) -> ConstraintViolation:
        """Largest scaled residuals of position and velocity constraints at every saved time."""

        def at(t, y):
            rows, at = self.system.position_rows, Instant.of(self.system, t, y)
            position, velocity = jnp.abs(at.coordinate_residual), jnp.abs(at.velocity_residual)
            if velocity.size:
                sizes = at.row_sizes()
                position, velocity = position.at[:rows].divide(sizes[:rows]), velocity / sizes
            return ConstraintViolation(jnp.max(position, initial=0.0), jnp.max(velocity, initial=0.0))

        return jax.vmap(at)(self.ts, self.ys)

    def trimmed(self) -> "Trajectory":
        """Without the padding of `SaveAt(steps=True)` and of runs ended early; unchanged under `jit` and `vmap`."""
        if isinstance(self.ts, Tracer) or self.ts is None or self.ts.ndim != 1:
            return self
        finite = np.isfinite(np.asarray(self.ts))
        return self if finite.all() else at_rows(self, np.flatnonzero(finite))

    def to_dict(self) -> dict[str, np.ndarray]:
        """Arrays by name: `t`, `q`, `u`, `energy`, `"crank.angle"`, …, and `stats.…`."""
        states = states_of(self)
        out = {"t": np.asarray(self.ts), "q": np.asarray(states.q), "u": np.asarray(states.u)}
        if states.z is not None:
            out["z"] = np.asarray(states.z)
        free = [name for name, quantity in self.system.quantities().items() if not quantity.of_forces]
        out |= {name: np.asarray(value) for name, value in self._measured(free).items()}
        out["energy"] = np.asarray(self.energy)
        for name, value in self.stats.items():
            if value is not None:
                out[f"stats.{name}"] = np.asarray(value)
        return out

    def to_xarray(self, names: Sequence[str] | None = None) -> Any:
        """An `xarray.Dataset` with the dimension `t` [s] and a variable for each quantity.

        Vectors have the dimension `axis` as well, with the coordinates x, y and z; Euler parameters have the dimension
        `euler_parameter`. `read_measurements` reads such a Dataset of a single motion.

        A batch has the dimension `member` before them, or `member_0`, `member_1`, … If its members are saved at
        different times, the dimension of time is `save`, and `t` is a coordinate along members and saves.

        **Arguments:** `names` of quantities, as `quantity` takes them, and `"energy"`; default the energy and all
        quantities but forces and accelerations.

        **Raises:** `ImportError` without xarray, which `jaxmb[studies]` installs.
        """
        xarray, values = package_for_tables("xarray", "jaxmb[studies]"), self._table(names)
        ts, batch = np.asarray(self.ts), len(self._batch)
        members = ("member",) if batch == 1 else tuple(f"member_{k}" for k in range(batch))
        times = ts.reshape(-1, ts.shape[-1])
        # Members that ended early have infinite times there.
        longest = times[np.argmax(np.sum(np.isfinite(times), axis=1))]
        shared = bool(np.all(~np.isfinite(times) | (times == longest)))
        along = (*members, "t" if shared else "save")
        components = _components(values, batch + 1)
        variables = {
            name: ((*along, *(components[size][0] for size in value.shape[batch + 1 :])), value)
            for name, value in values.items()
        }
        t = ("t", longest) if shared else (along, ts)
        out = xarray.Dataset(variables, {"t": t, **dict(components.values())})
        out["t"].attrs["units"] = "s"
        return out

    def to_pandas(self, names: Sequence[str] | None = None) -> Any:
        """A `pandas.DataFrame` with the column `t` [s] and a column for each component of each quantity:
        `"crank.angle"`, `"crank.position.x"`, of Euler parameters `"rotor.orientation.0"`.

        **Arguments:** `names` as in `to_xarray`.

        **Raises:** `ImportError` without pandas; `ValueError` for a batch.
        """
        if self._batch:
            raise ValueError(
                f"A table shows a single motion, and this is a batch of shape {self._batch}; choose a member, such as "
                "batch[0], or take batch.to_xarray()."
            )
        pandas, values = package_for_tables("pandas", "pandas"), self._table(names)
        components, columns = _components(values, 1), {"t": np.asarray(self.ts)}
        for name, value in values.items():
            if value.ndim == 1:
                columns[name] = value
            else:
                _, labels = components[value.shape[1]]
                columns |= {f"{name}.{label}": column for label, column in zip(labels, value.T, strict=True)}
        return pandas.DataFrame(columns)

    def _table(self, names: Sequence[str] | None) -> dict[str, np.ndarray]:
        """Quantities by name, shape (times,) or (times, components), after the batch's axes."""
        quantities = self.system.quantities()
        if names is None:
            names = ["energy", *(name for name, quantity in quantities.items() if not quantity.of_forces)]
        names = (names,) if isinstance(names, str) else names
        for name in names:
            if name not in quantities and name != "energy":
                raise unknown("quantity", name, ("energy", *quantities))
        values = dict(self._measured(tuple(name for name in names if name in quantities)))
        if "energy" in names:
            values["energy"] = self.energy
        return {name: np.asarray(values[name]) for name in names}

    def plot(self, *names: str) -> "Figure":
        """Plot quantities by name against time, as `viz.plot_motion`; without names the energy and what moves most.

        ```python
        motion.plot("bar.angle", "pin.force", "energy")
        ```

        **Returns:** a matplotlib `Figure` with a panel for each unit.

        **Raises:** `ValueError` for an unknown name, a batch or fewer than two times; `ImportError` without matplotlib.
        """
        return picture("motion.plot_motion", self, names or None)

    def save(self, path: str | Path) -> None:
        """Write `to_dict` as a compressed `.npz`.

        **Raises:** `ValueError` for a path with another suffix; `to_pandas` has tables for other files.
        """
        if Path(path).suffix not in ("", ".npz"):
            raise ValueError(
                f"Trajectory.save writes .npz, got {str(path)!r}; to_pandas() and to_xarray() are for other files."
            )
        np.savez_compressed(path, allow_pickle=False, **self.to_dict())  # pyright: ignore[reportArgumentType]


def still(system: AbstractSystem, state: State, t: Any = 0.0) -> Trajectory:
    """One state as a motion that is saved at one time, for its views."""
    ts, ys = jax.tree.map(lambda y: _entries(y, None), (jnp.asarray(t, state.q.dtype), state))
    formulation = default_manifold(system, _ADAMS, None).default_formulation(system)
    successful: Any = RESULTS.successful
    return Trajectory(system, formulation, ts, ys, {}, successful, None, None)


def at_rows(trajectory: Trajectory, rows: Int[np.ndarray, "n"]) -> Trajectory:
    """A single motion at some of its saved times, in the order of time or against it."""
    ts, ys = jax.tree.map(lambda x: _entries(x, rows), (trajectory.ts, trajectory.ys))
    ends = np.cumsum([0, *(stage.ts.size for stage in trajectory.stages)])
    of_stages = [rows[(rows >= first) & (rows < last)] - first for first, last in itertools.pairwise(ends)]
    stages = [at_rows(stage, own) for stage, own in zip(trajectory.stages, of_stages, strict=True)]
    backward = rows.size > 1 and rows[0] > rows[-1]
    return changed(trajectory, ts=ts, ys=ys, stages=tuple(reversed(stages) if backward else stages))


def picture_of(trajectory: Trajectory, deformation: float = 1.0) -> Picture:
    """The bodies and parts of a single motion, for a picture; `deformation` magnifies that of flexible bodies."""
    stages = trajectory.stages or (trajectory,)
    pictures = [run.system.catalogue.picture(run.ts, states_of(run), deformation) for run in stages]
    return pictures[0] if len(pictures) == 1 else joined_pictures(pictures)


def joined(first: Trajectory, later: Trajectory) -> Trajectory:
    """The motion of two runs, as `first + later`."""
    first, later = (motion.trimmed() for motion in (first, later))
    _check_parts(first, later)
    apart = _apart(first.system, _saved(first, -1), _saved(later, 0))
    if is_traced(apart):
        # Under `jit` nothing can be raised.
        meets = functools.reduce(jnp.logical_and, [jnp.all(x <= 1, axis=-1) for x in apart])[..., None, None]
        later = changed(later, ys=jax.tree.map(lambda y: jnp.where(meets, y, jnp.nan), later.ys))
    else:
        _check_meeting(first, later, *(np.asarray(x) for x in apart))
    *before, last = first.stages or (first,)
    # At the time of a change, the values after it are saved.
    before_end = lambda y: _entries(y, (..., slice(None, -1), slice(None)))
    last = changed(last, ts=_entries(last.ts, (..., slice(None, -1))), ys=jax.tree.map(before_end, last.ys))
    runs = tuple(changed(run, closer=None) for run in (*before, last, *(later.stages or (later,))))
    ts, ys = jax.tree.map(lambda *x: jnp.concatenate(x, first.ts.ndim - 1), *((run.ts, run.ys) for run in runs))
    return changed(
        later,
        ts=ts,
        ys=ys,
        stats=_sums(first.stats, later.stats),
        result=_first_failure(first.result, later.result),
        closer=None,
        interpolation=None,
        stages=runs,
    )


def _entries(x, index):
    """Entries of an array; of a concrete one by NumPy, since JAX would compile a program for each index and shape."""
    return x[index] if is_traced((x, index)) else jnp.asarray(np.asarray(x)[index])


def _saved(motion, k):
    """A saved time, and the state at it."""
    entry = lambda y: _entries(y, (..., k, slice(None)))
    return _entries(motion.ts, (..., k)), jax.tree.map(entry, states_of(motion))


def _first_failure(first, later):
    """The later result, unless the first run failed."""
    if np.ndim(first._value):
        return eqx.filter_vmap(_first_failure)(first, later)
    return RESULTS.where((first == RESULTS.successful) | (first == RESULTS.event_occurred), later, first)


def _sums(first, later):
    """The sums of the counts that both runs have."""
    both = {name: (jnp.asarray(first[name]), jnp.asarray(later[name])) for name in first if later.get(name) is not None}
    counts = lambda x, y: x.shape == y.shape and jnp.issubdtype(x.dtype, jnp.integer)
    return {name: x + y for name, (x, y) in both.items() if counts(x, y)}


def _apart(system, end, start):
    """How far a later motion begins from where the first ends, in time, coordinates and turns; at most 1 if they meet.

    A return to the constraints may have moved coordinates a little.
    """
    if end[0].ndim:
        return eqx.filter_vmap(_apart)(system, end, start)
    (t0, y0), (t1, y1) = end, start
    listed = np.unique([k for index in system.coordinate_names().values() for k in index])
    eps, largest = float(jnp.finfo(t0.dtype).eps), jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    late = jnp.where(t0 == t1, 0.0, jnp.abs(t1 - t0) / (8 * eps * largest))
    moved = (jnp.abs(y1.q - y0.q) / (eps**_MOVED * system.coordinate_scale()))[listed]
    turned = jnp.zeros(0, t0.dtype) if y0.angles is None else jnp.abs(y1.angles - y0.angles) / np.pi
    return late[None], moved, turned


def _check_parts(first, later):
    """Raise a `ValueError` for motions of systems with other parts, and of other batches."""
    names = lambda motion: (*motion.system.quantities(), *(f"{name}[{k}]" for name, k in motion.system.rows))
    if names(first) != names(later):
        others = sorted({*names(first)} ^ {*names(later)}) or ["the same parts in another order"]
        raise ValueError(f"Motions of one system can be joined, and one of these has {_listed(others)}.")
    forms = [jax.tree.map(lambda y: y.shape[:-2], states_of(motion)) for motion in (first, later)]
    if forms[0] != forms[1]:
        raise ValueError(f"These motions save other numbers or are batches of other shapes: {forms[0]} and {forms[1]}.")


def _check_meeting(first, later, *apart):
    """Raise a `ValueError` if a later motion does not begin where the first ends; arguments as from `_apart`."""
    late, moved, turned = (~(x <= 1) for x in apart)
    if late.ndim > 1:
        for k in range(late.shape[0]):
            _check_meeting(first[k], later[k], *(x[k] for x in apart))
        return
    (t0, y0), (t1, y1) = _saved(first, -1), _saved(later, 0)
    if np.any(late):
        raise ValueError(
            f"The first motion is saved until t = {float(t0):.6g}, and the later from t = {float(t1):.6g} on: save "
            "both at the time where they meet, as by saveat=numpy.linspace(t0, t1, 101)."
        )
    names = first.system.coordinate_names()
    if np.any(moved):
        k = np.unique([k for index in names.values() for k in index])[np.argmax(moved)]
        name = min((name for name, index in names.items() if k in index), key=lambda name: len(names[name]))
        raise ValueError(
            f"The later motion begins elsewhere: {name!r} is {float(y0.q[k]):.6g} where the first ends, and "
            f"{float(y1.q[k]):.6g} where the later begins; start it from motion.end."
        )
    if np.any(turned):
        name = first.system.wrapped_angle_names()[np.argmax(turned)]
        raise ValueError(f"The later motion counts the turns of {name!r} anew; start it from motion.end.")


class PartMotion:
    """The measurable quantities of a joint or a frame along a motion, as attributes: of a hinge `.angle`,
    `.angle_rate`, `.angle_acceleration`, `.force`, …, of a frame `.position`, `.specific_force`, …; `dir` lists them,
    and the classes of joints and frames describe them. Axis 0 is time, after the batch's axes.

    An angle of a joint counts the full turns since the start of the run, whatever times are saved. At the start it is
    in (−π, π] unless the state carries turns, as after another run, or after `assemble(fix={"pin.angle": 4.0})`.
    """

    def __init__(self, trajectory: Trajectory, name: str):
        self._trajectory, self._name = trajectory, name

    def __repr__(self) -> str:
        return f"Motion of {self._name!r}: {', '.join(dir(self))}"

    def __dir__(self) -> list[str]:
        parts = (name.partition(".") for name in self._trajectory.system.quantities())
        return [field for part, _, field in parts if part == self._name]

    def __getattr__(self, field: str) -> Array:
        if field.startswith("_") or field not in dir(self):
            raise AttributeError(f"{self._name!r} has {', '.join(dir(self))}; got {field!r}.")
        return self._trajectory.quantity(f"{self._name}.{field}")


class GlobalError(NamedTuple):
    """The estimated global error of a motion: its distance from the same motion at tighter tolerances.

    Steps of the closer motion may err a hundredth as much; near rounding, or with a method of a fixed order, a tenth.
    So the distance is nearly the error itself. It does not contain errors of the model, nor rounding errors that both
    motions share. In derivatives it is a constant.
    """

    motion: Trajectory
    closer: Trajectory

    def __repr__(self) -> str:
        if not self.motion._is_known() or not isinstance(self.motion.ys, State):
            return f"GlobalError of a {type(self.motion).__name__}"
        largest = np.asarray(self.largest)
        of_batch = f", in {largest.size} runs" if largest.ndim else ""
        return f"GlobalError: at most {np.max(largest):.2g} of the largest coordinate or velocity{of_batch}"

    @property
    def largest(self) -> Array:
        """The largest error of the saved coordinates, velocities and internal states, relative to the largest value of
        each kind. Units are the system's size or a state's typical size, so that metres and radians compare.
        """
        return _largest_error(self.motion)

    @property
    def ys(self) -> Any:
        """The error of every saved state, in the units of each coordinate and velocity."""
        return _distance(self.motion.ys, self.closer.ys)

    def quantity(self, name: str) -> Array:
        """The error of a quantity, by its name in `Trajectory.quantity`."""
        return self.of(lambda trajectory: trajectory.quantity(name))

    def of(self, observed: Callable[[Trajectory], Any]) -> Any:
        """The error of any function of a trajectory: `error.of(lambda trajectory: trajectory.energy)`."""
        return _distance(observed(self.motion), observed(self.closer))


def _components(values: Mapping[str, np.ndarray], axis: int) -> dict[int, tuple[str, list[Any]]]:
    """For each number of components of a quantity along an axis, the name of the dimension and the labels along it."""
    sizes = sorted({value.shape[axis] for value in values.values() if value.ndim > axis})
    # The number of components of vectors is the dimension of space.
    names = {4: "euler_parameter", 3 if 3 in sizes else 2: "axis"}
    labels = lambda size: list("xyz"[:size]) if names.get(size) == "axis" else list(range(size))
    return {size: (names.get(size, f"component_of_{size}"), labels(size)) for size in sizes}


@eqx.filter_jit
@_of_each_member
def _largest_error(motion):
    system, errors = motion.system, dataclasses.replace(_distance(motion.ys, motion.closer.ys), angles=None)
    scales = State(system.coordinate_scale(), system.velocity_scale(), system.state_scale() if system.nz else None)
    values = State(motion.ys.q, motion.ys.u, motion.ys.z)

    def relative(error, values, scale):
        error, size = (jnp.max(jnp.abs(x) / scale[None], initial=0.0) for x in (error, values))
        return error / jnp.where(size > 0, size, 1.0)

    errors = jax.tree.leaves(jax.tree.map(relative, errors, values, scales))
    return lax.stop_gradient(jnp.max(jnp.stack(errors)))


def _distance(a, b):
    # The closer motion has no derivatives, so the difference would have the derivative of the motion.
    return lax.stop_gradient(jax.tree.map(lambda a, b: jnp.abs(a - b), a, b))


@eqx.filter_jit
def _between(system, interpolation, ts):
    # A step ends at the number before a jump, and the next step starts at the number after it.
    (starts, direction), fixed = lax.stop_gradient((steps_of(interpolation), ts))
    beyond = direction * next_number(fixed, direction)
    jumps = jnp.where(jnp.isin(beyond, starts, method="binary_search"), ts, jnp.inf)
    ts = after_jumps(ts, jumps, interpolation.t0, interpolation.t1)
    single = lambda t: project_normalized(system, t, interpolation.evaluate(t, left=False))
    return vmap_states(single, system.coordinate_rows * system.nq)(ts)


def load(path: str | Path) -> dict[str, np.ndarray]:
    """Read a file written by `Trajectory.save`, as a dictionary of arrays.

    ```python
    motion.save("motion.npz")
    jaxmb.load("motion.npz")["bar.angle"]
    ```
    """
    with np.load(path) as data:
        return {name: data[name] for name in data.files}
