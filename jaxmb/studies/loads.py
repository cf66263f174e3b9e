"""Loads of a body along a motion: all forces on it in body axes, for strength and fatigue."""

import csv
import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._arguments import check_kind, package_for_tables
from .._pictured import picture
from .._printed import Printed
from ..linalg.arrays import add_up, is_traced
from ..linalg.jitted import jitted
from ..linalg.rotations import norm
from ..parts.base import AbstractTendon
from ..parts.coordinate_parts import AbstractCoordinatePart
from ..parts.names import unknown
from ..system import with_parameters
from ..system.instant import Instant
from ..trajectory import Trajectory
from .inverse.drives import Drive, drives_of
from .inverse.required import RequiredForces

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Forces that differ by this part of them are equal.
_ROUNDING = 1e-9
_COLUMNS = ("time", "part", *(f"{what}_{axis}" for what in ("point", "force", "moment") for axis in "xyz"))


class Load(NamedTuple):
    """A force on a body along a motion, in body axes, each of shape (times, 3).

    **Fields:** the `point` of application [m], in the body's frame; the `force` [N]; the `moment` [N m] about the
    point.
    """

    point: Float[Array, "times 3"]
    force: Float[Array, "times 3"]
    moment: Float[Array, "times 3"]


class Loads(Printed, eqx.Module):
    """All forces on a body along a motion, from `loads`; `print` shows a table.

    ```python
    on_bar = jaxmb.loads(motion, "bar")
    pin = on_bar["pin"]
    largest = jnp.max(jaxmb.rotations.norm(pin.force))
    worst = on_bar.worst(lambda on_bar: jaxmb.rotations.norm(on_bar["pin"].force), count=3)
    worst.to_csv("bar.csv")
    on_bar.plot().savefig("bar.png")
    ```

    **Fields:** the `body`; `names` and `kinds` of its loads: "joint", also of a rigid stop or rope, "contact" of bodies
    that touch and of a tyre, "friction", "force", "gravity" and "inertia"; `undetermined`: names of joints and contacts
    that share forces which the equations leave open; `ts` [s], shape (times,); `points` [m], `forces` [N] and
    `moments` [N m] about the points, in body axes, shape
    (times, loads, 3); the `mass_centre` [m] in the body's frame, shape (3,). The plane is z = 0.
    """

    body: str = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[str, ...] = eqx.field(static=True)
    undetermined: tuple[str, ...] = eqx.field(static=True)
    ts: Float[Array, "times"]
    points: Float[Array, "times loads 3"]
    forces: Float[Array, "times loads 3"]
    moments: Float[Array, "times loads 3"]
    mass_centre: Float[Array, "3"]

    def __getitem__(self, name: str) -> Load:
        if name not in self.names:
            raise unknown("load", name, self.names)
        k = self.names.index(name)
        return Load(self.points[:, k], self.forces[:, k], self.moments[:, k])

    @property
    def balance(self) -> tuple[Float[Array, "times 3"], Float[Array, "times 3"]]:
        """The sums of all forces [N], and of all moments about the mass centre [N m]: zero up to rounding errors."""
        arms = self.points - self.mass_centre[None, None]
        return jnp.sum(self.forces, axis=1), jnp.sum(self.moments + jnp.cross(arms, self.forces), axis=1)

    def worst(self, measure: "Callable[[Loads], Array] | None" = None, count: int = 1) -> "Loads":
        """The loads at the worst instants, the worst first.

        **Arguments:** `measure(loads)`: a number at each time, shape (times,), the larger the worse; default the
        largest force but for gravity and inertia; `count` of instants.
        """
        values = jnp.asarray(self._largest() if measure is None else measure(self))
        if values.shape != self.ts.shape:
            raise ValueError(
                f"The measure must return shape {self.ts.shape}, a number at each time; got {values.shape}."
            )
        chosen = jnp.argsort(-values)[:count]
        at = lambda loads: (loads.ts, loads.points, loads.forces, loads.moments)
        return eqx.tree_at(at, self, tuple(x[chosen] for x in at(self)))

    def _largest(self):
        acting = np.array([kind not in ("gravity", "inertia") for kind in self.kinds])
        return jnp.max(jnp.where(acting, norm(self.forces), 0.0), axis=1)

    def plot(self, *names: str, t: float | None = None) -> "Figure":
        """Draw the loads on the body, in its axes, as arrows with their sizes, and plot the sizes against time.

        The moments beside the arrows are about the points of application; in the plane they are positive to the left,
        as bent arrows show.
        Loads that act at a single point are bars.

        **Arguments:** `names` of loads, default the eight largest; `t`: the time of the arrows [s], default the time of
        the largest force but for gravity and inertia.

        **Returns:** a matplotlib `Figure`; large forces are in kN.

        **Raises:** `ValueError` for an unknown name, a time outside of the motion and a batch; `ImportError` without
        matplotlib.
        """
        return picture("loads.plot", self, names, t)

    def to_pandas(self) -> Any:
        """A `pandas.DataFrame` with a row for each time and load, and the columns of `to_csv`.

        **Raises:** `ImportError` without pandas.
        """
        return package_for_tables("pandas", "pandas").DataFrame(self._table(), columns=list(_COLUMNS))

    def _table(self) -> list[list[Any]]:
        """The rows of a table, one for each time and load."""
        numbers = np.concatenate([self.points, self.forces, self.moments], axis=2)
        return [
            [float(t), name, *map(float, row)]
            for t, of_time in zip(np.asarray(self.ts), numbers, strict=True)
            for name, row in zip(self.names, of_time, strict=True)
        ]

    def to_csv(self, file: str | Path) -> None:
        """Write a CSV file, as finite-element programs read it, with a row for each time and load.

        The columns are time [s], part, point_x, point_y, point_z [m], force_x, force_y, force_z [N], moment_x, moment_y
        and moment_z [N m]. All vectors are in body axes; points are in the body's frame, and moments about the point.
        """
        with Path(file).open("w", newline="", encoding="utf-8") as opened:
            writer = csv.writer(opened)
            writer.writerow(_COLUMNS)
            writer.writerows(self._table())

    def __str__(self) -> str:
        if is_traced((self.ts, self.forces)) or not self.ts.size:
            return f"Loads of {self.body!r}: {', '.join(self.names)}"
        sizes, turns = np.asarray(norm(self.forces)), np.asarray(norm(self.moments))
        lines = [("load", "kind", "largest force [N]", "at t [s]", "largest moment [N m]")]
        for k, (name, kind) in enumerate(zip(self.names, self.kinds, strict=True)):
            # The first of several, up to rounding.
            worst = int(np.argmax(sizes[:, k] >= (1 - _ROUNDING) * np.max(sizes[:, k])))
            numbers = f"{sizes[worst, k]:.5g}", f"{float(self.ts[worst]):.5g}", f"{np.max(turns[:, k]):.5g}"
            lines.append((name, kind, *numbers))
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        cell = lambda text, width, k: text.ljust(width) if k < 2 else text.rjust(width)
        table = ["  ".join(cell(x, w, k) for k, (x, w) in enumerate(zip(line, widths, strict=True))) for line in lines]
        title = f"Loads of {self.body!r} at {self.ts.size} times, moments about the points of application"
        shared = f"Shares are not determined, since rows are redundant: {', '.join(self.undetermined)}."
        return "\n".join([title, *table, *([shared] if self.undetermined else [])])


class _Entry(NamedTuple):
    """A part on a body: the set of its group, the numbers of the group, of the part in it and of the body in the part.

    The set is "constraints", "laws" or "forces".
    """

    of: str
    number: int
    member: int
    place: int


def loads(motion: Trajectory | RequiredForces, body: str) -> Loads:
    """All forces on a body along a motion: of joints, contacts and friction, applied forces, gravity and inertia.

    ```python
    on_bar = jaxmb.loads(motion, "bar")
    print(on_bar)
    on_bar["pin"].force, on_bar["inertia"].force, on_bar.balance
    ```

    A load acts at the point of its part on the body, or of the joint on whose coordinate its part acts; without such a
    point, as in a contact, at the mass centre. With `required_forces`, the needed forces of actuators are loads by
    their names in `by`; of a parameter, `"engine.torque"`, the load has the name of the part. A cylinder or rope is one
    load, with the forces of drivers, stops and friction along its length.

    The load of inertia is `−m a` and the moment `−(J ω̇ + ω × J ω)`, so that all loads are in balance. Redundant joints
    and closed contacts have the shares of least norm. `undetermined` names both; under a trace it names joints only.
    The loads are differentiable, so that a design can bound them.

    **Arguments:** the `motion` of bodies, from `simulate` or `required_forces`; the name of the `body`.

    **Returns:** `Loads`, in body axes.

    **Raises:** `ValueError` for an unknown body, for a system without bodies and for a batch, whose members `jax.vmap`
    takes.
    """
    kinds_of_motion, cure = "a Trajectory or RequiredForces", "jaxmb.simulate and jaxmb.required_forces return one"
    check_kind("loads: motion", motion, Trajectory | RequiredForces, kinds_of_motion, cure)
    system = motion.system
    if body not in system.body_names:
        raise unknown("body", body, system.body_names, "loads")
    if motion.ts.ndim != 1:
        raise ValueError("loads takes a single motion; jax.vmap(lambda motion: …)(motions) takes each of a batch.")
    number, (motion, machine, drives, given) = system.body_names.index(body), _actuated(motion)
    parts = _parts_on(system, number)
    acting = _drives_on(machine, drives, number, list(parts))
    points, forces, moments, centre = _along(
        (system, machine),
        (tuple(map(tuple, parts.values())), drives, acting),
        number,
        motion.ts,
        system.contacts.sharing.bearing(system.contacts, motion.ys),
        (motion.accelerations, motion.multipliers, given),
    )
    own = {} if system.forces.gravity is None else {system.forces.gravity_name: "gravity"}
    kinds = {name: _kind(system, name, entries[0]) for name, entries in parts.items()}
    kinds |= {drives[k].name: "force" for k, *_, row in acting if row is None} | own | {"inertia": "inertia"}
    shared = system.catalogue.undetermined(motion.ts, motion.ys)
    undetermined = tuple(name for name in parts if name in shared)
    values = motion.ts, points, forces, moments, centre
    return Loads(body, tuple(kinds), tuple(kinds.values()), undetermined, *values)


@functools.singledispatch
def _actuated(motion: Any) -> tuple[Any, Any, tuple[Drive, ...], tuple[Any, ...]]:
    """The motion without padding, the machine with its actuators, these actuators and their forces.

    Only inverse dynamics has actuators apart from the system.
    """
    if motion.stages:
        raise ValueError(
            "loads takes a single run; motion.stages are the runs of a joined motion, each with its system."
        )
    return motion.trimmed(), motion.system, (), ()


@_actuated.register
def _(motion: RequiredForces):
    return motion, motion.machine, drives_of(motion.machine, motion.forces), tuple(motion.forces.values())


def _sets(system) -> dict[str, tuple[Any, ...]]:
    """The groups of all parts that act on bodies."""
    constraints = system.constraints
    return {"constraints": constraints.groups, "laws": constraints.laws, "forces": system.forces.groups}


def _parts_on(system, number: int) -> dict[str, list[_Entry]]:
    """The parts on a body by name."""
    out: dict[str, list[_Entry]] = {}
    for of, groups in _sets(system).items():
        for g, group in enumerate(groups):
            for k, (name, bodies) in enumerate(zip(group.group.names, group.group.bodies, strict=True)):
                for place, other in enumerate(bodies):
                    if other == number:
                        out.setdefault(name, []).append(_Entry(of, g, k, place))
    for groups in _sets(system).values():
        for group in groups:
            for k, name in enumerate(group.group.names):
                tendon = _tendon(group, k)
                if tendon != name and tendon in out and name in out:
                    out[tendon] += out.pop(name)
    return out


def _tendon(group, member: int) -> str | None:
    """The name of the tendon that the part is, or on whose length it acts; None for other parts."""
    part = group.group.part
    if isinstance(part, AbstractTendon):
        return group.group.names[member]
    if isinstance(part, AbstractCoordinatePart) and isinstance(part.joint, AbstractTendon):
        return dict(group.group.inner)["joints", "0"][member]
    return None


def _drives_on(machine, drives, number: int, names: list[str]) -> tuple[tuple[int, Any, int, int | None], ...]:
    """The actuators besides parameters that act on a body: their numbers; the groups of their parts, or of the joints
    on whose coordinates they act; the numbers of the parts there; and the row of `names` that contains them, or None.
    """
    out = []
    for k, drive in enumerate(drives):
        match drive.of:
            case "velocity":
                if np.isin(machine.layout.velocity_index[number], drive.where).any():
                    out.append((k, None, 0, None))
            case "joint" | "part":
                at = drive.where
                group = machine.measured[at.group] if drive.of == "joint" else at.group(machine)
                if number in group.group.bodies[int(at.member)]:
                    tendon = _tendon(group, int(at.member))
                    out.append((k, group, int(at.member), names.index(tendon) if tendon in names else None))
    return tuple(out)


def _kind(system, name: str, entry: _Entry) -> str:
    constraints, part = system.constraints, _sets(system)[entry.of][entry.number].group.part
    of_joints = (zip(group.group.names, group.joints, strict=True) for group in constraints.frictions)
    rubbing = {name for pairs in of_joints for name, joint in pairs if name != joint}
    if entry.of == "laws" or (entry.of == "constraints" and name in rubbing):
        return "friction"
    if part.touches:
        return "contact"
    return "force" if entry.of == "forces" else "joint"


@jitted
def _along(systems, parts, number, ts, ys, solved):
    """Points, forces and moments in body axes along a motion, and the mass centre.

    **Arguments:** `systems`: the system, and that of the actuators; `parts`: entries of parts by name, all actuators,
    and those that act on the body; `solved`: accelerations, multipliers, and the forces of actuators.
    """
    (system, machine), (parts, drives, acting) = systems, parts
    space = system.layout.space
    centre = space.in_space(mass_centre(system, number))

    def single(t, y, udot, multipliers, given):
        sought = {drive.where: x for drive, x in zip(drives, given, strict=True) if drive.of == "parameter"}
        here = (with_parameters(system, sought) if sought else system).at(y)
        now = here.kinematics(t, y.q, y.u)
        wrenches = _wrenches(here, parts, now, multipliers)
        points = [_point(here, entries, now) for entries in parts]
        for k, group, member, row in acting:
            of_drive = _of_drive(machine, drives[k], number, Instant.of(here, t, y), given[k])
            if row is None:
                wrenches.append(of_drive)
                points.append(_point_of(group, member, number, now))
            else:
                wrenches[row] += of_drive
        own = _of_body(here, number, now, y, udot)
        turns = [_in_body_axes(space, now.poses[number], wrench) for wrench in (*wrenches, *own)]
        forces, moments = (jnp.stack(x) for x in zip(*turns, strict=True))
        if not system.layout.rotates[number]:
            moments = jnp.zeros_like(moments)
        none = jnp.zeros_like(centre)
        points = jnp.stack([*(none if x is None else space.in_space(x) for x in points), *(none for _ in own)])
        return points + centre[None], forces, moments - jnp.cross(points, forces)

    return *jax.vmap(single)(ts, ys, *solved), centre


def _of_drive(machine, drive: Drive, number: int, at: Instant, force) -> Array:
    """The wrench of an actuator on the body: the components of its generalized force along the body's velocities."""
    generalized = jnp.append(force.reshape(-1) @ drive.rows(machine, at), 0.0)
    return generalized[machine.layout.velocity_index[number]]


def _point_of(group, member: int, number: int, now) -> Array | None:
    """The point of a part on a body, in the axes at its mass centre; None without one."""
    return None if group is None else _anchor(group.group, member, group.group.bodies[member].index(number), now)


def _anchor(group, member: int, place: int, now) -> Array | None:
    """The point of a part, or of the joint on whose coordinate it acts, on a body."""
    part, space, poses = group.single(member, now.t), group.layout.space, now.poses[group.body_index[member]]
    point = part.anchor(space, place, poses)
    if point is None and isinstance(part, AbstractCoordinatePart) and place in part.places[0]:
        at = part.places[0]
        return part.joint.anchor(space, at.index(place), poses[np.array(at)])
    return point


def _wrenches(system, parts, now, multipliers) -> list[Array]:
    """The wrenches of parts on the body, about the mass centre."""
    constraints, found = system.constraints, {}
    of_groups = constraints.of_groups(multipliers)

    def of_group(of, number):
        if (of, number) not in found:
            if of == "constraints":
                group, values = of_groups[number]
                wrenches = group.wrenches(now, values)
            elif of == "laws":
                ((wrenches, _),) = constraints.nonideal_wrenches([constraints.laws[number]], now, multipliers)
            else:
                wrenches = system.forces.groups[number].wrenches(now)
            found[of, number] = wrenches
        return found[of, number]

    on_body = lambda entry: of_group(entry.of, entry.number)[entry.member, entry.place]
    return [add_up(map(on_body, entries)) for entries in parts]


def _point(system, entries, now) -> Array | None:
    """The point of a part on the body, in the axes at its mass centre; of friction the point of the joint."""
    sets = _sets(system)
    for of, number, member, place in entries:
        group = sets[of][number]
        holders = [(group, member)]
        if of == "laws":
            joint = group.joints[member]
            holders = [(g, g.group.names.index(joint)) for g in sets["constraints"] if joint in g.group.names]
        for holder, k in holders:
            point = _anchor(holder.group, k, place, now)
            if point is not None:
                return point
    return None


def _of_body(system, number: int, now, y, udot) -> list[Array]:
    """The wrenches of gravity, if any, and of inertia."""
    bodies, gravity = system.bodies, system.forces.gravity
    on_body = lambda force: jnp.append(force, jnp.zeros((), force.dtype))[system.layout.velocity_index[number]]
    total = lambda gravity: bodies.generalized_force(bodies.wrenches(now, gravity), udot)
    without = total(None)
    inertia = on_body(without - system.inertia(now.t, y.q, y.u).product(udot))
    return [inertia] if gravity is None else [on_body(total(gravity) - without), inertia]


def _in_body_axes(space, pose, wrench) -> tuple[Array, Array]:
    """Force and moment about the mass centre, from a wrench with the force in world axes."""
    d, force = space.dimension, space.in_space(space.body_direction(pose, wrench[: space.dimension]))
    return force, jnp.pad(wrench[d:], (3 - wrench[d:].size, 0))


def mass_centre(system, number: int) -> Array:
    """The mass centre in the body's frame."""
    for group in system.bodies.groups:
        places = np.flatnonzero(group.group.body_index[:, 0] == number)
        if places.size and group.group.part.mass_centre is not None:
            return group.group.part.mass_centre[places[0]]
    return jnp.zeros(system.layout.space.dimension, system.length.dtype)
