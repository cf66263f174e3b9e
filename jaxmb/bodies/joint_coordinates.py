"""Coordinates of joints by name, `"hip.angle"`, `"slide.displacement"`, with rates and accelerations."""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .._compat import canonical
from .._types import Scalar
from ..parts.combinations import JointCoupling
from ..parts.coordinate_parts import AbstractCoordinatePart, JointDriver
from ..solvers.turning import nearest_turn
from ..system.quantities import Measure, view_of_motion
from .groups import BodyPoses, ConstraintGroup, CoordinateGroup, Group
from .layout import Layout

# Ends of the names of a coordinate, of its rate and of its acceleration.
ORDERS = ("", "_rate", "_acceleration")


class JointCoordinate(NamedTuple):
    """A coordinate of a joint.

    **Fields:** `group`: the index of the joint's group; `member`: the joint's index in the group; `field`: the name
    within the joint; the `shape`; `periodic`: whether the coordinate is an angle known up to full turns; `place`: the
    index of such a number among the `wrapped_angles`, None for other coordinates.
    """

    group: int
    member: Any
    field: str
    shape: tuple[int, ...]
    periodic: bool
    place: Any = None


def joint_coordinates(
    groups: Sequence[ConstraintGroup | CoordinateGroup], layout: Layout
) -> dict[str, JointCoordinate]:
    """The coordinates of all joints, by name."""
    space, out, dtype, places = layout.space, {}, canonical(), itertools.count()
    ground = np.asarray(space.ground, dtype)
    # Only shapes are evaluated.
    poses = jax.eval_shape(lambda ground: jnp.tile(space.prepare(ground), (layout.ground + 1, 1)), ground)
    time = jax.ShapeDtypeStruct((), dtype)
    for g, group in enumerate(groups):
        coordinates = jax.eval_shape(lambda group, t, poses: group.coordinates(t, poses), group, time, poses)
        for field, values in coordinates.items():
            shape, periodic = values.shape[1:], field in group.group.part.periodic
            for k, name in enumerate(group.group.names):
                place = next(places) if periodic and not shape else None
                out[f"{name}.{field}"] = JointCoordinate(g, k, field, shape, periodic, place)
    return out


def wrapped_angles(groups: Sequence[ConstraintGroup | CoordinateGroup], t: Scalar, poses: BodyPoses) -> Array:
    """The angles of all joints that are known up to full turns, in the order of `joint_coordinates`."""
    out = [jnp.zeros(0, poses.dtype)]
    for group in groups:
        periodic = group.group.part.periodic
        # A joint without angles is not evaluated.
        coordinates = group.coordinates(t, poses) if periodic else {}
        out += [values for field, values in coordinates.items() if field in periodic and values.ndim == 1]
    return jnp.concatenate(out)


def joint_measures(coordinates: Mapping[str, JointCoordinate]) -> dict[str, Measure]:
    """Coordinates of joints, their rates and accelerations, as quantities of a motion.

    Angles known up to full turns have the turns that the states carry. Along states that carry none, the change in an
    interval is the possible change nearest to the trapezoidal rule of the rate.
    """
    out = {}
    for name, coordinate in coordinates.items():
        number = None if coordinate.place is None else np.array(coordinate.place)
        place = coordinate._replace(member=np.array(coordinate.member), place=number)
        for order, end in enumerate(ORDERS):
            out[f"{name}{end}"] = Measure(coordinate.shape, _of_joint, (place, order), of_forces=order == 2)
    return out


@view_of_motion
def _of_joint(system, place, ts, ys, solved):
    coordinate, order = place

    def with_rate(t, q, u):
        """The coordinate, and its rate."""
        value = lambda t, q: system.catalogue.joint_coordinate(coordinate, t, q)
        return jax.jvp(value, (t, q), (jnp.ones_like(t), system.rates(t, q, u)))

    def acceleration(t, q, u, udot):
        rate = lambda t, q, u: with_rate(t, q, u)[1]
        return jax.jvp(rate, (t, q, u), (jnp.ones_like(t), system.rates(t, q, u), udot))[1]

    ts = jnp.asarray(ts, ys.q.dtype)
    if order == 2:
        return jax.vmap(acceleration)(ts, ys.q, ys.u, solved.accelerations)
    value, rate = jax.vmap(with_rate)(ts, ys.q, ys.u)
    if order == 1:
        return rate
    if coordinate.place is not None and ys.angles is not None:
        near = lax.dynamic_index_in_dim(ys.angles, coordinate.place, axis=1, keepdims=False)
        return nearest_turn(value, near)
    return _continued(ts, value, rate) if coordinate.periodic and ts.size > 1 else value


def _continued(ts, angles, rates):
    """Unwrapped angles."""
    predicted = jnp.diff(ts) * (rates[1:] + rates[:-1]) / 2
    turns = jnp.round((predicted - jnp.diff(angles)) / (2 * np.pi))
    # Entries after the end of a run are not finite; earlier entries do not depend on them.
    turns = lax.stop_gradient(jnp.where(jnp.isfinite(turns), turns, 0.0))
    return angles + 2 * np.pi * jnp.concatenate([jnp.zeros(1, angles.dtype), jnp.cumsum(turns)])


def beyond_half_turns(system: Any, reach: np.ndarray) -> list[str]:
    """A sentence for each force whose angle turned beyond the half turn to either side within which it is known."""
    places = {name: k for k, name in enumerate(system.wrapped_angle_names())}
    out = []
    for group in system.forces.groups:
        part, joints = group.group.part, dict(group.group.inner).get(("joints", "0"), ())
        middles = part.middle_of_turn() if joints and isinstance(part, AbstractCoordinatePart) else None
        if middles is None or not part.is_periodic():
            continue
        for name, joint, middle in zip(group.group.names, joints, np.asarray(middles).reshape(-1), strict=True):
            coordinate = f"{joint}.{part.within[0]}"
            start, least, largest = reach[:, places[coordinate]]
            # The turn in which the angle starts is the part's own.
            middle = middle + 2 * np.pi * np.round((start - middle) / (2 * np.pi))
            if max(largest - middle, middle - least) > np.pi:
                out.append(
                    f"{name!r} jumps where {coordinate!r} is half a turn from {middle:.6g} rad, and the angle went "
                    f"from {least:.6g} to {largest:.6g}: let it act on 'winding.length' of a tendon that counts turns, "
                    f"jaxmb.FixedTendon('winding', ({coordinate!r},), coefficients=(1.0,))."
                )
    return out


def jumping_couplings(system: Any, t: Scalar, q: Array) -> list[str]:
    """A sentence for each coupling that jumps at concrete coordinates, since an angle is half a turn from its zero."""
    poses, out = system.bodies.prepared_poses(q), []
    for g in system.constraints.position:
        # A concrete class: no other constraint jumps with an angle.
        if not isinstance(g.group.part, JointCoupling):
            continue
        for k, (name, x) in enumerate(zip(g.group.names, g.group.gather(poses), strict=True)):
            part = g.group.single(k, t)
            joints = [dict(g.group.inner)["joints", str(i + 1)][k] for i in range(len(part.within) - 1)]
            for i in part.jumping(system.layout.space, x):
                out.append(
                    f"JointCoupling {name!r} jumps where '{joints[i]}.{part.within[i + 1]}' is half a turn from its "
                    "zero, since it is known up to full turns and the ratio is not an integer: couple the length of "
                    "a jaxmb.FixedTendon along it, which counts turns."
                )
    return out


def held_groups(
    groups: Sequence[ConstraintGroup | CoordinateGroup],
    coordinates: Mapping[str, JointCoordinate],
    values: Mapping[str, Array],
    rates: Mapping[str, Array],
    t: Scalar,
) -> tuple[ConstraintGroup, ...]:
    """Constraints that hold coordinates of joints at `values` at time `t`; the values change at `rates`."""
    out = []
    for name, value in values.items():
        coordinate = coordinates[name]
        group = groups[coordinate.group].group
        driver = JointDriver(name, name, value=value - rates[name] * jnp.asarray(t, value.dtype), rate=rates[name])
        part = driver.with_fields(
            joints={"0": jax.tree.map(lambda leaf, k=coordinate.member: leaf[k], group.part)},
            places=(tuple(range(len(group.bodies[coordinate.member]))),),
            within=(coordinate.field,),
            rows=math.prod(coordinate.shape),
        )
        stacked = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], part)
        inputs = tuple(
            dataclasses.replace(alone, keys=("joints", "0", *alone.keys), members=(0,))
            for signal in group.inputs
            for alone in signal.alone()
            if alone.members == (coordinate.member,)
        )
        out.append(ConstraintGroup(Group(stacked, (name,), (group.bodies[coordinate.member],), group.layout, inputs)))
    return tuple(out)
