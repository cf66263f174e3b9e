"""Kinematics and compliance of a suspension over wheel travel and steering."""

from collections.abc import Iterable, Mapping
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._arguments import real_array
from ..._types import Scalar, State, VectorLike
from ...linalg.arrays import is_traced
from ...linalg.failure import nan_where
from ...linalg.jitted import jitted
from ...linalg.rotations import norm
from ...parts.base import AbstractPointPair
from ...parts.names import names_arguments, unknown
from ...states.arguments import check_no_states, check_system, checked_guess, checked_time
from ...states.refusals import violated_joints
from ...system import AbstractSystem, parameters
from ...system.quantities import component_names, directions
from ..loads import mass_centre
from .positions import Inputs, Position, Rig, Steering, as_inputs, as_vector, solved
from .result import KinematicsAndCompliance
from .wheel import Spring, SteeringAxis, Wheel

_NAME = "kinematics_and_compliance"
_LOADS = ("longitudinal_force", "lateral_force", "aligning_moment")
_SIDES = {"left": 1.0, "right": -1.0}
# The smallest horizontal part of the spin axis; the smallest rate of the wheel's pose that counts as steering.
_HORIZONTAL, _STEERS = 1e-3, 1e-9
# Displacements below this part of the largest are not named.
_SHARE = 0.2


@names_arguments
def kinematics_and_compliance(
    system: AbstractSystem,
    carrier: str,
    *,
    radius: Scalar,
    travel: VectorLike,
    steer: Mapping[str, VectorLike] | None = None,
    centre: VectorLike = (0.0, 0.0, 0.0),
    axis: VectorLike = (0.0, 1.0, 0.0),
    side: Literal["left", "right"] | None = None,
    springs: Iterable[str] | None = None,
    loads: Mapping[str, Scalar] | None = None,
    guess: State | None = None,
    t: Scalar = 0.0,
    throw: bool | None = None,
) -> KinematicsAndCompliance:
    """Find toe, camber, track, roll centre, motion ratios and compliances of a suspension over wheel travel and steer.

    ```python
    wishbone = jaxmb.mechanisms.double_wishbone().system
    travel, rack = np.linspace(-0.08, 0.08, 9), np.linspace(-0.04, 0.04, 5)
    curves = jaxmb.kinematics_and_compliance(
        wishbone, "upright", radius=0.32, travel=travel, steer={"tie_rod.point_a[1]": rack}
    )
    print(curves)
    ```

    Where joints determine the position for each travel and steer, it follows from the constraints alone. Otherwise, as
    with bushings, it is a static equilibrium of all forces on the system, and the compliances are its derivatives by
    loads at the contact patch. The vertical force that holds the travel acts at the wheel's centre. Freedoms that do
    not move the carrier, such as the spin of a wheel, stay as they are.

    Axes: x forward, y to the left, z up; the ground is horizontal.

    **Arguments:**

    - `system`: a compiled scene in space.
    - `carrier`: the body that carries the wheel, or turns with it about the vertical; loads act on it.
    - `radius` [m] > 0 of the wheel, to the contact patch.
    - `travel` [m], a number or shape (n,): rise of the wheel's centre from the guess.
    - `steer`: values of one number by name, a number or shape (m,), as displacements from the present value. The number
        is a coordinate of a joint or body, such as `"rack.displacement"`, or a parameter or its component, such as
        `"tie_rod.point_a[1]"`; a variable of `design` moves along any direction.
    - `centre` [m] of the wheel, and `axis` of its spin, of either sense, in the carrier's frame.
    - `side`: "left" or "right", default the side of y = 0 on which the wheel's centre is.
    - `springs`: names of springs between two points, or of coordinates, `"arm.angle"`, for motion ratios and steering
        axes; default every `SpringDamper`, and every part of your own with `is_spring = True` in its class.
    - `loads` on the wheel at the contact patch, by the names "longitudinal_force" and "lateral_force" [N], along x and
        y, and "aligning_moment" [N m], about z; default none.
    - `guess`: the state in design position, default the poses given with the bodies.
    - `t`: the time, for forces and drivers that depend on it [s].
    - `throw`: whether to raise an error at a position that is not found. By default an error is raised, except under
        `jit`, `vmap` or a derivative. There, and with `False` everywhere, its values are NaN.

    **Returns:** `KinematicsAndCompliance`, differentiable by parameters, travel, steer, loads, centre, axis and radius.

    **Raises:** `ValueError` for unknown names; a system with contacts, rolling, friction or internal states; a spin
    axis that is vertical; a steer that does not move the wheel; constraints that leave no travel or steer; a travel out
    of reach; and freedoms that no force resists. The message names the travel and the joints or coordinates.
    """
    _check_system(system)
    guess = checked_guess(_NAME, system, guess)
    t = checked_time(_NAME, t, guess.q.dtype)
    travel = _grid("travel", travel, guess.q.dtype)
    steering, steers = _steering(system, steer, guess.q.dtype)
    wheel = _wheel(system, guess.q, carrier, side, radius, centre, axis)
    rig = Rig(system, jnp.asarray(t), guess.q, wheel, steering)
    _check_freedoms(rig)
    places = _springs(system, springs)
    load = _load(loads, guess.q.dtype)
    along = jnp.zeros(1, guess.q.dtype) if steers is None else steers.reshape(-1)
    curves = _curves(rig, tuple(places.values()), travel.reshape(-1), along, load)
    curves = _checked(curves, rig, (travel.reshape(-1), along, load), throw)
    shape = travel.shape + (() if steers is None else steers.shape)
    shaped = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[2:]), curves)
    return _result(shaped, rig, tuple(places), travel, steers)


class _Curves(NamedTuple):
    """Values on the grid, shape (travels, steers, …).

    **Fields:** `at`: the positions without derivatives; `patch` and its displacement from the guess (`moved`); `rates`:
    derivatives of what is seen by travel, steer and loads, on the last axis; `steers`: the largest by steer.
    """

    at: Position
    q: Array
    toe: Array
    camber: Array
    patch: Array
    moved: Array
    rates: Any
    steering_axis: Any
    steers: Array


class _Seen(NamedTuple):
    """What is seen of a position."""

    pose: Array
    toe: Array
    camber: Array
    patch: Array
    lengths: Array


@jitted
def _curves(rig: Rig, springs: tuple[Spring, ...], travel: Array, steer: Array, load: Array) -> _Curves:
    rig = rig.prepared()
    of_steer = jax.vmap(lambda travel, steer: _position(rig, springs, Inputs(travel, steer, load)), (None, 0))
    return jax.vmap(of_steer, (0, None))(travel, steer)


def _position(rig: Rig, springs: tuple[Spring, ...], inputs: Inputs) -> _Curves:
    """All values of one position."""
    at, x, tangents = solved(rig, inputs)
    now = as_vector(inputs)

    def seen(w):
        """What is seen after small changes of the inputs."""
        q = at.shifted(rig, x + tangents @ (w - now)).q
        system = rig.steered(as_inputs(w))
        lengths = [spring.length(system, rig.t, q) for spring in springs]
        lengths = jnp.stack(lengths) if lengths else jnp.zeros(0, q.dtype)
        return _Seen(rig.wheel.pose(system, q), *rig.wheel.attitude(system, q), lengths)

    values, rates, q = seen(now), jax.jacfwd(seen)(now), at.shifted(rig, x).q
    axis = None
    if rig.steering is not None:
        axis = rig.wheel.steering_axis(rig.system, q, rates.pose[:, :2], rates.lengths[:, :2])
    steers = jnp.max(jnp.abs(rates.pose[:, 1]))
    moved = values.patch - rig.wheel.attitude(rig.system, rig.guess).patch
    return _Curves(at, q, values.toe, values.camber, values.patch, moved, rates, axis, steers)


def _result(curves: _Curves, rig: Rig, springs: tuple[str, ...], travel, steers) -> KinematicsAndCompliance:
    wheel, rates = rig.wheel, curves.rates
    side = wheel.side
    along = lambda k: {
        "toe": rates.toe[..., k],
        "camber": rates.camber[..., k],
        "track": side * rates.patch[..., 1, k],
        "wheelbase": rates.patch[..., 0, k],
    }
    axis = SteeringAxis(None, None, None, None) if curves.steering_axis is None else curves.steering_axis
    return KinematicsAndCompliance(
        travel,
        steers,
        curves.toe,
        curves.camber,
        rates.toe[..., 0],
        rates.camber[..., 0],
        side * curves.moved[..., 1],
        curves.moved[..., 0],
        curves.patch[..., 1] * rates.patch[..., 1, 0] / rates.patch[..., 2, 0],
        {name: -rates.lengths[..., k, 0] for k, name in enumerate(springs)},
        axis.caster,
        axis.kingpin_inclination,
        axis.scrub_radius,
        axis.caster_trail,
        {name: along(2 + k) for k, name in enumerate(_LOADS)},
        curves.q,
        rig.freedoms,
    )


# Arguments


def _check_system(system):
    check_system(_NAME, system)
    if not getattr(system, "spatial", False):
        raise ValueError(f"{_NAME} needs bodies in space; build the scene from jaxmb.spatial.")
    check_no_states(_NAME, system)
    contacts = system.contacts
    if contacts or contacts.m:
        names = ", ".join((*contacts.contact_names, *contacts.friction_names))
        raise ValueError(f"{_NAME} does not support contacts and dry friction: remove {names}.")
    if not system.ideal_on_velocities or system.velocity_rows > system.position_rows:
        raise ValueError(f"{_NAME} needs ideal constraints on positions; remove rolling, friction and servos.")


def _grid(label, values, dtype) -> Array:
    out = jnp.asarray(real_array(f"{_NAME}: {label}", values, dtype, None))
    if out.ndim > 1 or not out.size:
        raise ValueError(f"{_NAME}: {label} is a number or a vector of numbers, got shape {out.shape}.")
    return out


def _steering(system, steer, dtype) -> tuple[Steering | None, Array | None]:
    """The number that steers, and its values."""
    if steer is None:
        return None, None
    if not isinstance(steer, Mapping) or len(steer) != 1:
        raise ValueError(
            f"{_NAME}: steer gives values of one number by name, {{'rack.displacement': values}}; got {steer!r}."
        )
    ((name, values),) = steer.items()
    return _steering_number(system, str(name)), _grid(f"steer of {name!r}", values, dtype)


def _steering_number(system, name: str) -> Steering:
    joints, coordinates, numbers = system.joint_coordinates(), system.coordinate_names(), parameters(system)
    if name in joints and joints[name].shape == ():
        return Steering(name, "joint", joints[name])
    if name in coordinates and len(coordinates[name]) == 1:
        return Steering(name, "coordinate", coordinates[name][0])
    base = name.split("[")[0]
    components = component_names(base, numbers[base].shape) if base in numbers else []
    if name in components:
        where = np.unravel_index(components.index(name), numbers[base].shape)
        return Steering(name, "parameter", tuple(map(int, where)))
    if components:
        raise ValueError(f"{_NAME}: {name!r} is not a number; steer by a component, such as {components[0]!r}.")
    scalars = [other for other in joints if joints[other].shape == ()]
    raise unknown("number", name, [*scalars, *coordinates, *numbers], f"{_NAME}: steer")


def _wheel(system, guess, carrier, side, radius, centre, axis) -> Wheel:
    if carrier not in system.body_names:
        raise unknown("body", carrier, system.body_names, f"{_NAME}: carrier")
    if side is not None and side not in _SIDES:
        raise ValueError(f"{_NAME}: side is 'left' or 'right', got {side!r}.")
    number, dtype = system.body_names.index(carrier), guess.dtype
    if not system.layout.rotates[number]:
        raise ValueError(
            f"{_NAME}: the carrier {carrier!r} is a point mass, which has no attitude; give it an inertia."
        )
    radius = jnp.asarray(real_array(f"{_NAME}: radius", radius, dtype))
    if not is_traced(radius) and not radius > 0:
        raise ValueError(f"{_NAME}: radius must be positive, got {float(radius):g} m.")
    centre, axis = (
        jnp.asarray(real_array(f"{_NAME}: {name}", x, dtype, ((3,),)))
        for name, x in (("centre", centre), ("axis", axis))
    )
    size = norm(axis)
    if not is_traced(size) and not size > 0:
        raise ValueError(f"{_NAME}: axis must be a direction, got zero.")
    wheel = Wheel(number, jnp.ones((), dtype), centre - mass_centre(system, number), axis / size, radius)
    pose, space = wheel.pose(system, guess), system.layout.space
    lateral, axle = space.point(pose, wheel.centre)[1], space.direction(pose, wheel.axle)
    if not is_traced(axle) and np.hypot(*axle[:2]) < _HORIZONTAL:
        raise ValueError(
            f"{_NAME}: the spin axis of the wheel on {carrier!r} is parallel to the travel; give its axis."
        )
    if side is None and not is_traced(lateral) and lateral == 0:
        raise ValueError(f"{_NAME}: the wheel's centre is in the plane y = 0; give side='left' or 'right'.")
    sign = jnp.where(lateral < 0, -1.0, 1.0) if side is None else jnp.asarray(_SIDES[side])
    sign = sign.astype(dtype)
    outward = jnp.where(axle[1] * sign < 0, -1.0, 1.0).astype(dtype)
    return eqx.tree_at(lambda w: (w.side, w.axle), wheel, (sign, outward * wheel.axle))


def _check_freedoms(rig: Rig):
    if rig.freedoms < 0:
        steered = "" if rig.steering is None else f" and {rig.steering.name}"
        raise ValueError(
            f"{_NAME}: the constraints leave {rig.freedoms + rig.prescribed} freedom(s), too few for travel{steered}. "
            "Remove a driver that holds them, or steer by its value."
        )


def _springs(system, springs) -> dict[str, Spring]:
    """The places of springs by name."""
    joints = system.joint_coordinates()
    known = {name: Spring(0, 0, joint) for name, joint in joints.items() if joint.shape == ()}
    usual = []
    for g, group in enumerate(system.forces.groups):
        if isinstance(group.group.part, AbstractPointPair):
            known |= {name: Spring(g, k) for k, name in enumerate(group.group.names)}
            usual += group.group.names if group.group.part.is_spring else ()
    if springs is None:
        return {name: known[name] for name in usual}
    if isinstance(springs, str):
        raise ValueError(f"{_NAME}: springs names springs in a sequence, [{springs!r}], also a single one.")
    for name in springs:
        if name not in known:
            raise unknown("spring", name, known, _NAME)
    return {name: known[name] for name in springs}


def _load(loads, dtype) -> Float[Array, "3"]:
    if not isinstance(loads or {}, Mapping):
        raise ValueError(f"{_NAME}: loads are numbers by name, {{'lateral_force': 1000.0}}; got {loads!r}.")
    for name in loads or {}:
        if name not in _LOADS:
            raise unknown("load", name, _LOADS, _NAME)
    return jnp.stack([jnp.asarray(real_array(f"{_NAME}: {n}", (loads or {}).get(n, 0.0), dtype)) for n in _LOADS])


# Failures


def _checked(curves: _Curves, rig: Rig, given, throw) -> _Curves:
    """The curves, NaN at positions that were not found."""
    if is_traced((curves, rig, given)):
        spoiled = jax.vmap(jax.vmap(lambda curves: nan_where(~curves.at.ok, curves, (rig, given))))(curves)
        if not throw:
            return spoiled
        text = f"{_NAME}: a position was not found; call it outside jit to see the reason."
        return eqx.error_if(curves, ~jnp.all(curves.at.ok), text)
    if throw is not False:
        if not np.all(curves.at.ok):
            raise ValueError(_refusal(curves, rig, given))
        if rig.steering is not None and np.max(curves.steers) < _STEERS:
            name = rig.system.body_names[rig.wheel.number]
            raise ValueError(
                f"{_NAME}: {rig.steering.name!r} does not move {name!r}; steer by a number of its tie rod."
            )
        return curves
    return jax.vmap(jax.vmap(lambda curves: nan_where(~curves.at.ok, curves)))(curves)


def _refusal(curves: _Curves, rig: Rig, given) -> str:
    """The reason why a position was not found, the nearest to the guess."""
    travels, steers, load = map(np.asarray, given)
    size = np.abs(travels)[:, None] + np.abs(steers)[None, :]
    i, j = np.unravel_index(np.argmin(np.where(np.asarray(curves.at.ok), np.inf, size)), size.shape)
    steered = "" if rig.steering is None else f" and {rig.steering.name} = {steers[j]:+g}"
    lead = f"{_NAME}: at travel = {travels[i]:+g} m{steered}"
    q, free = curves.at.q[i, j], np.asarray(curves.at.free[i, j])
    if np.any(free):
        known = directions(rig.system.rate_names())
        order = np.argsort(-np.abs(free))
        names = ", ".join(known[int(k)] for k in order[:4] if abs(free[k]) > _SHARE * abs(free[order[0]]))
        cure = (
            "Hold it by a joint or a spring" if rig.steering else "Steer it with steer, or hold it by a joint or spring"
        )
        return f"{lead} no force resists a displacement of {names}. {cure}."
    system = rig.steered(Inputs(jnp.asarray(travels[i]), jnp.asarray(steers[j]), jnp.asarray(load)))
    violated = violated_joints(system, rig.t, q, 1e-6)
    if rig.freedoms and not violated:
        return f"{lead} no static equilibrium was found. Give smaller steps of travel, or a guess nearer to it."
    remain = f": residuals [m, rad] remain in {violated}" if violated else ""
    return f"{lead} the suspension is out of reach{remain}. Give a smaller travel, or check lengths, points and axes."
