"""Inverse dynamics: the forces of actuators that make a machine follow a motion."""

import dataclasses
import warnings
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._arguments import package_for_tables
from ..._pictured import picture
from ..._types import State, VectorLike
from ...bodies.units import effort
from ...linalg.arrays import is_traced
from ...linalg.failure import nan_where
from ...parts.names import names_arguments, unknown
from ...states.arguments import check_system, checked_guess
from ...states.assembly import configuration
from ...states.consistency import listed
from ...system import AbstractSystem
from ...system.description import counted
from ...system.instant import Instant
from ...system.quantities import Reaction, Solved, component_names
from ...trajectory import Trajectory
from .balance import Drives, Found, balanced, searched
from .course import Course, free_names, planned, recorded
from .drives import drives_of, released, without_drives, without_limits

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Beyond a range by this share of it is a rounding error.
_ROUNDING = 1e-9
# How near a position is at which actuators are tried, as a part of the scales of the coordinates.
_NEAR = 1e-3


class RequiredForces(eqx.Module):
    """The forces of actuators along a motion, from `required_forces`.

    ```python
    needed = jaxmb.required_forces(system, motion, by=["pin.angle"])
    needed["pin.angle"], needed.power["pin.angle"], needed.reaction("pin").force
    needed.quantity("bar.position"), jaxmb.loads(needed, "bar")
    needed.plot().savefig("forces.png")
    ```

    **Fields:** `ts` [s], shape (times,); `forces` by the names of the actuators, shape (times,), or (times, components)
    of a vector [N, of an angle N m, of a parameter in its unit]; `power` [W] by the same names, shape (times,): the
    power that each actuator puts into the machine; `ys`, the states of the motion; `accelerations` u̇; `multipliers` of
    the rows of `system`, the `machine` without its named drives and forces.
    """

    ts: Float[Array, "times"]
    forces: dict[str, Array]
    power: dict[str, Float[Array, "times"]]
    ys: State
    accelerations: Float[Array, "times nu"]
    multipliers: Float[Array, "times rows"]
    system: Any
    machine: Any

    def __getitem__(self, name: str) -> Array:
        if name not in self.forces:
            raise unknown("actuator", name, self.forces)
        return self.forces[name]

    def reaction(self, name: str) -> Reaction:
        """The forces of a joint in the motion, as in `Trajectory.reactions`."""
        names = self.system.catalogue.joint_names()
        if name not in names:
            raise unknown("joint", name, names)
        return self.system.catalogue.reaction(name, self.ts, self.ys, self.multipliers)

    def quantity(self, name: str) -> Array:
        """A quantity of the motion by its name, as in `Trajectory.quantity`: `"pin.angle"`, `"bar.position"`."""
        quantities = self.system.quantities()
        if name not in quantities:
            raise unknown("quantity", name, quantities)
        return quantities[name].value(self.ts, self.ys, Solved(self.accelerations, self.multipliers))

    def plot(self, *names: str) -> "Figure":
        """Plot the forces and the powers of actuators against time; default of all.

        **Returns:** a matplotlib `Figure` with a panel for each unit, and one for the powers.

        **Raises:** `ValueError` for an unknown name and a batch; `ImportError` without matplotlib.
        """
        return picture("required_forces.plot", self, names)

    def to_pandas(self) -> Any:
        """A `pandas.DataFrame` with the column `t` [s], the force of each actuator by its name, of a vector
        `"push.force[0]"`, and its power [W], `"pin.angle power"`.

        **Raises:** `ImportError` without pandas; `ValueError` for a batch.
        """
        if self.ts.ndim != 1:
            raise ValueError("A table shows the forces of a single motion, and this is a batch.")
        columns = {"t": np.asarray(self.ts)}
        for name, force in self.forces.items():
            table = np.asarray(force).reshape(self.ts.size, -1)
            columns |= dict(zip(component_names(name, force.shape[1:]), table.T, strict=True))
        columns |= {f"{name} power": np.asarray(power) for name, power in self.power.items()}
        return package_for_tables("pandas", "pandas").DataFrame(columns)

    def __repr__(self) -> str:
        if is_traced((self.ts, self.forces)):
            return super().__repr__()
        rows = [f"RequiredForces at {self.ts.size} times"]
        for name, force in self.forces.items() if self.ts.size else ():
            least, most, power = np.min(force), np.max(force), np.max(np.abs(self.power[name]))
            span = f"  {name}: {least:.4g} to {most:.4g} {effort(self.machine, name)[1]}".rstrip()
            rows.append(f"{span}; power at most {power:.4g} W")
        return "\n".join(rows)


@names_arguments
def required_forces(
    system: AbstractSystem,
    motion: Trajectory | Mapping[str, Any] | Any,
    *,
    by: Iterable[str],
    ts: VectorLike | None = None,
    weights: Mapping[str, VectorLike] | None = None,
    guess: State | None = None,
    tolerance: float = 1e-5,
    throw: bool | None = None,
) -> RequiredForces:
    """Find the forces of actuators that make a machine follow a motion: inverse dynamics.

    ```python
    ts = np.linspace(0.0, 1.0, 41)
    swing = {"pin.angle": jaxmb.Series(ts, 0.2 * np.sin(3.0 * ts), "cubic")}
    torque = jaxmb.required_forces(system, swing, by=["pin.angle"])["pin.angle"]
    ```

    The machine may have closed loops, redundant joints and rolling. It needs as many forces as it has freedoms without
    its named drives; of more forces `weights` chooses the solution.

    Coordinates as functions of time determine velocities. Positions that rolling or a blade leaves are integrated with
    error control from the first time on, where `guess` gives them; so they do not depend on the other times. No step is
    longer than the longest interval of `ts`.

    Rigid contacts, stops and ropes are open along a motion: it may touch them at the times `ts`, not pass through them,
    and they bear no force.

    **Arguments:**

    - `motion`: a `Trajectory`; or by the names of coordinates, `"pin.angle"` of a joint or `"crank.angle"` of a body,
        cubic `Series`, functions of time, or positions measured at the times `ts`, which a cubic `Series` interpolates;
        or `Measurements` of coordinates. They must determine the motion. Noise in positions grows in their second
        derivatives: smooth measured positions first.
    - `by`: names of actuators. A `Driver`, `JointDriver` or `Servo` exerts its `drive_force`; its prescribed motion is
        ignored. A force on a coordinate, such as a `Motor` or `JointForce`, is replaced by the sought force. On a
        coordinate of a joint, a body or a `LagrangianSystem`, `"pin.angle"`, `"hull.x"`, `"theta"`, a force is added;
        on `"lift.length"` of a `Cylinder`, the force of its rod. A parameter that forces are proportional to,
        `"engine.torque"` of a `Torque`, `"push.force"`, `"lift.pressure"` or `"servo.control"`, has the sought value,
        also in place of an input, and beyond a `control_range` with a warning.
    - `ts` [s]: ascending times, default the times of the first `Series`; not with a `Trajectory`.
    - `weights` > 0, by all names of `by`: the solution has the least sum of `weight × force²`.
    - `guess`: a state near the first position of a motion by coordinates, default that of the system; positions that
        rolling leaves begin there.
    - `tolerance`: the largest violation of constraints by the motion, relative to the system's size, to the speeds and
        to the accelerations.
    - `throw`: whether to raise an error without a solution. By default an error is raised, except under `jit`, `vmap`
        or a derivative. There, and with `False` everywhere, forces are NaN. `True` raises under `jit` as well, by a
        callback to Python.

    **Returns:** `RequiredForces`, differentiable by parameters and by the motion. Force × rate is the power that an
    actuator puts into the machine.

    **Raises:** `ValueError` naming freedoms without a force, coordinates that the constraints hold, actuators that
    cannot produce the motion anywhere or at a singular position, joints that the motion violates, with residuals and
    time, contacts that it passes through, and closed contacts of a `Trajectory`.
    """
    check_system("required_forces", system)
    drives = drives_of(system, by)
    system, ranges = without_limits(released(system, drives), drives)
    rest = without_drives(system, drives)
    spread = _spread(drives, weights, rest.guess.q.dtype)
    # A concrete class: a trajectory has states, and other motions have coordinates.
    if isinstance(motion, Trajectory):
        if ts is not None or guess is not None:
            raise ValueError("required_forces: a Trajectory has times and states; leave out ts and guess.")
        path = recorded(rest, motion)
    else:
        path = planned(rest, motion, ts, _start(system, guess))
    _check_count(system, rest, drives, path, weights)
    *values, found = balanced(system, rest, drives, spread, path)
    values, powers, multipliers = _checked(values, found, (system, rest, drives, path), tolerance, throw)
    ends = np.cumsum([drive.size for drive in drives])
    of_each = lambda x: zip(drives, jnp.split(x, ends[:-1], axis=1), strict=True)
    forces = {drive.name: force.reshape(-1, *drive.shape) for drive, force in of_each(values)}
    _warn_of_excess(path.ts, forces, ranges)
    power = {drive.name: jnp.sum(parts, axis=1) for drive, parts in of_each(powers)}
    return RequiredForces(path.ts, forces, power, path.ys, path.accelerations, multipliers, rest, system)


def _warn_of_excess(ts, forces, ranges) -> None:
    """Warn about sought parameters beyond the ranges to which their parts clip them."""
    if is_traced((ts, forces, ranges)):
        return
    for name, (low, high) in ranges.items():
        values = np.asarray(forces[name])
        excess = np.maximum(float(low) - values, values - float(high))
        if np.any(excess > _ROUNDING * (high - low)):
            k = int(np.nanargmax(excess))
            warnings.warn(
                f"required_forces: {name} needs {np.nanmin(values):.4g} to {np.nanmax(values):.4g}, beyond its range "
                f"from {low:g} to {high:g}, most of all at t = {float(ts[k]):g}.",
                stacklevel=4,
            )


def _start(system, guess) -> State:
    """The coordinates and velocities of the guess."""
    guess = checked_guess("required_forces", system, guess)
    return State(guess.q, guess.u)


def _spread(drives: Drives, weights, dtype) -> Float[Array, "k"]:
    """The inverse roots of the weights of all components."""
    if weights is None:
        return jnp.ones(sum(drive.size for drive in drives), dtype)
    names = [drive.name for drive in drives]
    for name in weights:
        if name not in names:
            raise unknown("actuator", name, names, "required_forces: weights")
    missing = [name for name in names if name not in weights]
    if missing:
        raise ValueError(f"required_forces: weights are missing for {', '.join(missing)}.")
    out = []
    for drive in drives:
        value = jnp.asarray(weights[drive.name], dtype)
        if not is_traced(value) and not np.all(np.asarray(value) > 0):
            raise ValueError(f"required_forces: the weight of {drive.name!r} must be positive, got {value}.")
        out.append(jnp.broadcast_to(1 / jnp.sqrt(value), drive.shape).reshape(-1))
    return jnp.concatenate(out)


def _check_count(system, rest, drives: Drives, path: Course, weights):
    """Raise a `ValueError` unless there are as many forces as freedoms, or weights for more forces."""
    freedoms, forces = rest.nu - rest.acceleration_rank, sum(drive.size for drive in drives)
    names = ", ".join(drive.name for drive in drives)
    if freedoms == 0:
        raise ValueError(f"required_forces: the machine has no freedom without {names}, so their forces do nothing.")
    count = f"the machine has {counted(freedoms, 'freedom')} and {counted(forces, 'force')}, {names}"
    if forces > freedoms and weights is None:
        raise ValueError(
            f"required_forces: {count}, so they are not determined. Leave some out, or ask for the least forces by "
            "weights={'name': 1.0, …}."
        )
    if forces < freedoms:
        free = ""
        if not is_traced((system, path)):
            y = jax.tree.map(lambda x: x[0], path.ys)
            bound = np.asarray(searched(system, rest, drives, path.ts[0], y).bound)
            free = f", so {free_names(rest, np.logical_not(bound))} is free"
        raise ValueError(f"required_forces: {count}{free}. Name an actuator or a coordinate for each freedom.")


def _checked(values, found: Found, given, tolerance, throw):
    """The values, after a check that they are a solution."""
    system, _, _, path = given
    bad = found.against(path, tolerance)
    if is_traced((given, bad)):
        if throw:
            text = "required_forces: the machine cannot make the motion; call it outside jit to see the reason."
            return eqx.error_if(values, jnp.any(bad), text)
        return nan_where(jnp.any(bad), values, (system, path))
    if throw is not False and np.any(bad):
        raise ValueError(_refusal(given, found, int(np.argmax(bad)), tolerance))
    return [jnp.where(bad[:, None], jnp.nan, x) for x in values]


def _refusal(given, found: Found, k: int, tolerance: float) -> str:
    """The reason why there is no solution at a time; `given` as in `_checked`."""
    _, rest, drives, path = given
    here: Found = jax.tree.map(lambda x: np.asarray(x[k]), found)
    lead = f"required_forces: at t = {float(path.ts[k]):g}"
    off = np.abs(np.asarray(path.off[k]))
    if not path.met[k] and not np.any(off > tolerance):
        return f"{lead} the velocities are not determined, or positions that rolling leaves could not be integrated."
    if not path.met[k] or np.any(~(off <= tolerance)):
        names = ", ".join(f"{name} ({value:.3g})" for name, value in zip(path.names, off, strict=True))
        return f"{lead} the machine cannot reach the position. Distances from the given coordinates remain: {names}."
    for kind in ("positions", "velocities", "accelerations"):
        residual = getattr(here, kind)
        violated = ~(np.abs(residual) <= tolerance)
        if violated.any():
            return (
                f"{lead} the machine cannot make the motion: its {kind} violate {listed(rest, violated, residual)}, "
                "relative to its size, speed or accelerations. Correct the motion, or raise tolerance."
            )
    beyond = here.gaps < -tolerance
    if beyond.any():
        at = Instant(rest, path.ts[k], path.ys.q[k], path.ys.u[k])
        gaps = np.asarray(at.normalized().gaps)
        named = zip(rest.contacts.contact_names, gaps, beyond, strict=True)
        through = ", ".join(f"{name} by {-gap:.3g}" for name, gap, bad in named if bad)
        return f"{lead} the motion passes through {through} [m, rad]. Correct the motion, or raise tolerance."
    if not here.regular:
        return f"{lead} the position is singular: fewer constraint rows are independent than elsewhere."
    labels = [drive.name for drive in drives for _ in range(drive.size)]
    named = lambda mask: ", ".join(dict.fromkeys(name for name, bad in zip(labels, mask, strict=True) if bad))
    if not here.bound.all():
        free = free_names(rest, ~here.bound)
        if _drive_nearby(given, k):
            return (
                f"{lead} the position is singular: {free} can move while {', '.join(dict.fromkeys(labels))} stand "
                "still, which nearby cannot happen. Avoid the position, or add an actuator with weights=."
            )
        reason = (
            f"the constraints hold {named(here.held)}" if here.held.any() else f"{named(~here.drives)} adds nothing"
        )
        return f"{lead} the actuators cannot produce the motion of {free}: {reason}. Name other actuators."
    if here.failed:
        return f"{lead} friction does not determine the reactions of the joints."
    names = ", ".join(drive.name for drive in drives if drive.of == "parameter")
    return f"{lead} the forces are not proportional to {names}, such as beyond a limit. Name a coordinate instead."


def _drive_nearby(given, k: int) -> bool:
    """Whether the actuators produce all motions at a position near the position at a time."""
    system, rest, drives, path = given
    t, y = path.ts[k], jax.tree.map(lambda x: x[k], path.ys)
    # In no particular direction.
    moved = y.q + _NEAR * rest.coordinate_scale() * np.cos(1.0 + np.arange(y.q.size))
    q, _, met = configuration(rest, rest.normalize(t, moved), {}, t, False)
    there = searched(system, rest, drives, t, dataclasses.replace(y, q=q))
    return bool(met) and bool(there.regular) and bool(np.all(there.bound))
