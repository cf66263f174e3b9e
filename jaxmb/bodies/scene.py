"""A scene: named bodies, joints and forces, checked and compiled into a system."""

import dataclasses
import inspect
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._dataflow import shaken
from .._printed import preformatted
from .._traced_functions import traced_by_jax
from .._types import State
from ..linalg.arrays import ARRAYS, is_traced
from ..linalg.jitted import on_host
from ..parts.base import (
    GROUND,
    AbstractActor,
    AbstractBody,
    AbstractCompound,
    AbstractConstraint,
    AbstractFlexibleBody,
    AbstractForce,
    AbstractLink,
    AbstractNonIdeal,
    AbstractPart,
    AbstractTendon,
    AbstractVelocityConstraint,
    KnownParts,
    rows_of,
)
from ..parts.boundary import captured, check_kernels, check_returns, check_states
from ..parts.combinations import JointCoupling
from ..parts.dry_friction import AbstractDryFriction, AbstractStickSlip
from ..parts.fields import anonymous, as_parameter, declarations, inner_parts, values_of, warn_of_angles
from ..parts.forces import Gravity
from ..parts.frames import AbstractFrame, frames_by_name
from ..parts.modes import STICK
from ..parts.names import check_arguments, unknown
from ..parts.planar.kinematics import PLANE
from ..parts.servo import Servo
from ..parts.space import AbstractSpace
from ..parts.spatial.kinematics import SPACE
from ..parts.unilateral import AbstractUnilateralConstraint
from ..system.description import Description
from ..system.equation import Ranks
from .body_set import BodySet
from .constraint_set import ConstraintSet
from .force_set import ForceSet
from .groups import (
    BodyGroup,
    CoordinateGroup,
    FlexibleGroup,
    ForceGroup,
    FrameGroup,
    NonIdealGroup,
    servo_group,
    stack,
)
from .law_groups import constraint_group, numbered, velocity_group
from .layout import Layout
from .rigid_bodies import RigidBodySystem
from .structure import with_structure

_TRACED = (
    "A scene cannot be compiled within a function that JAX traces, such as one under jit: compile it before, and "
    "change its numbers there with jaxmb.with_parameters."
)
# The user's place, counted from `Scene.compile`: equinox calls the methods of a module.
_USER = 4


def _as_tuple(parts: Any) -> tuple[Any, ...]:
    if isinstance(parts, AbstractPart):
        raise ValueError(f"A scene takes lists, Scene([body, …], joints=[…]); got {parts.label}: give a list of it.")
    return tuple(parts)


class Scene(eqx.Module):
    """Bodies, joints and forces by name.

    ```python
    bar = planar.Body("bar", mass=1.0, inertia=planar.rod(1.0, 1.0), position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    system = jaxmb.Scene([bar], joints=[pin], forces=[jaxmb.Gravity((0.0, -9.81))]).compile()
    ```

    A scene is planar or spatial, never both; its bodies decide. Joints are position or velocity constraints, in any
    order; closed loops and redundant joints are the normal case. A scene does not change: `extended` makes a new scene.

    **Arguments:** `bodies`: `planar.Body`, `planar.PointMass` or their spatial namesakes; `joints`: constraints,
    including drivers, rolling, `Stop`, rigid contacts and `Servo`, tendons, and inertias of joints; `forces`: force
    elements, friction of joints and contacts, and at most one `Gravity`; `frames`: `planar.Frame` or `spatial.Frame`,
    which parts may name in place of bodies. `"ground"` names the fixed world.

    **Raises:** `ValueError` for repeated or unknown names, parts of the other space, and bad numbers; the message
    names the part.
    """

    bodies: tuple[Any, ...] = eqx.field(converter=_as_tuple)
    joints: tuple[Any, ...] = eqx.field(converter=_as_tuple, default=(), kw_only=True)
    forces: tuple[Any, ...] = eqx.field(converter=_as_tuple, default=(), kw_only=True)
    frames: tuple[Any, ...] = eqx.field(converter=_as_tuple, default=(), kw_only=True)

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        check_arguments(cls.__name__, inspect.signature(cls), len(args), kwargs)
        return super().__new__(cls)

    def __check_init__(self):
        _check_kinds(self)
        _check_names(self)

    def extended(
        self,
        *,
        bodies: Sequence[Any] = (),
        joints: Sequence[Any] = (),
        forces: Sequence[Any] = (),
        frames: Sequence[Any] = (),
        without: Sequence[str] = (),
    ) -> "Scene":
        """Add parts to a scene, or leave some out; also for a scene from a file or of a mechanism.

        ```python
        scene = jaxmb.mechanisms.get("four_bar").scene
        driven = scene.extended(forces=[planar.Torque("motor", "crank", torque=1.0)])
        cut = scene.extended(without=["D"])  # An open chain.
        ```

        **Arguments:** `bodies`, `joints`, `forces`, `frames`: parts to add; `without`: names of parts to leave out.

        **Returns:** a new scene.

        **Raises:** `ValueError` for a name in `without` that no part has, and as `Scene` does.
        """
        names = [part.name for part in (*self.bodies, *self.joints, *self.forces, *self.frames)]
        for name in without:
            if name not in names:
                raise unknown("part", name, names, "without")
        kept = lambda parts, added: (*(part for part in parts if part.name not in without), *added)
        return Scene(
            kept(self.bodies, bodies),
            joints=kept(self.joints, joints),
            forces=kept(self.forces, forces),
            frames=kept(self.frames, frames),
        )

    def __repr__(self) -> str:
        parts = {name: getattr(self, name) for name in ("bodies", "joints", "forces", "frames")}
        return f"Scene: {', '.join(f'{len(listed)} {name}' for name, listed in parts.items() if listed)}"

    def __str__(self) -> str:
        lines = [f"{self!r}; compile() makes a system of it"]
        for kind in ("bodies", "joints", "forces", "frames"):
            lines += [f"  {type(part).__name__} {part.name!r}" for part in getattr(self, kind)]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return preformatted(self)

    def describe(self) -> Description:
        """Compile the scene and describe the result, as text and as HTML."""
        return self.compile().describe()

    def compile(self) -> RigidBodySystem:
        """Check the scene, find its structure (ranks, implied rows), and stack its parts.

        Functions of the scene are captured with the values that they read now. After a change of a global variable,
        an attribute or an array that a function reads, compile the scene anew.

        **Returns:** the system, a pytree whose leaves are the parameters.

        **Raises:** `ValueError` for numbers out of range, a mechanism that cannot be assembled from the given poses,
        contradictory constraints, and singular poses: there rows are dependent that are independent nearby. The message
        names the parts. Also within a function under `jit`: change parameters there instead.
        """
        return with_structure(as_given(self))


def as_given(scene: Scene) -> RigidBodySystem:
    """The system of a scene at its given poses, before its structure is found: for pictures only."""
    for part in (*scene.bodies, *scene.joints, *scene.forces, *scene.frames):
        if is_traced(part):
            raise ValueError(f"{part.label} has a number that JAX traces. {_TRACED}")
    for body in scene.bodies:
        _call(body, "check")
        _check_inertia(body)
    for part in (*scene.bodies, *scene.frames):
        warn_of_angles(part, part, stacklevel=_USER)
    space = SPACE if scene.bodies[0].dimension == 3 else PLANE
    layout, index, of_parts = _placed(scene, space)
    guess = _given_state(scene, layout)
    if is_traced(guess):
        raise ValueError(_TRACED)
    given: Any = np.append(np.asarray(guess.q), np.asarray(space.ground, guess.q.dtype))[layout.pose_index]

    frames = frames_by_name(scene.frames, scene.bodies)
    index |= {name: index[frame.of_body] for name, frame in frames.items()}
    observed = frozenset(frame.name for frame in scene.frames)
    resolved = KnownParts(space, index, of_parts, frames, observed, given, {})
    parts, laws, gravity = _settled(scene, resolved, layout)

    def kind(cls, check=check_kernels):
        return stack([(part, bodies) for part, bodies in parts if isinstance(part, cls)], layout, check)

    def of_joints(group):
        return tuple(of_joint[name] for name in group.names)

    of_joint = {law.name: law.joint for law, _ in laws}
    of_joint |= {part.name: part.joint_name for part, _ in parts if isinstance(part, AbstractStickSlip)}
    constraints = kind(AbstractConstraint)
    position, velocity = numbered(
        [constraint_group(group) for group in constraints if group.rows],
        [velocity_group(group, of_joint) for group in kind(AbstractVelocityConstraint)],
    )
    forces = ForceSet(
        groups=tuple(map(ForceGroup, kind(AbstractForce))),
        gravity=None if gravity is None else jax.device_put(gravity.acceleration),
        gravity_name="" if gravity is None else gravity.name,
    )
    system = RigidBodySystem(
        bodies=BodySet(
            groups=_body_groups(scene, layout, of_parts),
            tendons=tuple(map(CoordinateGroup, kind(AbstractTendon, None))),
            names=tuple(body.name for body in scene.bodies),
            layout=layout,
        ),
        constraints=ConstraintSet(
            position=position,
            velocity=velocity,
            servos=tuple(map(servo_group, kind(Servo, _check_program))),
            nonideal=tuple(NonIdealGroup(g, of_joints(g)) for g in stack(laws, layout, check_kernels)),
            layout=layout,
        ),
        forces=forces,
        frames=tuple(map(FrameGroup, stack([_observed(frame.name, resolved) for frame in scene.frames], layout))),
        free_joints=tuple(CoordinateGroup(group) for group in constraints if not group.rows),
        guess=guess,
        length=_length([inner for part, _ in parts for inner in (part, *_inner(part))], guess, layout),
        ranks=Ranks(0, 0, 0, 0),
        implied=(),
        elimination=None,
    )
    return _with_initial_states(_with_initial_scalars(system))


def _with_initial_states(system: RigidBodySystem) -> RigidBodySystem:
    """The system with the parts' internal states in its guess, and none in the parts."""
    guess = dataclasses.replace(system.guess, z=system.state_table.initial())
    return dataclasses.replace(system.state_table.held(None), guess=guess)


def _placed(scene: Scene, space: AbstractSpace) -> tuple[Layout, dict[str, int], dict[str, tuple[int, ...]]]:
    """The layout; indices of bodies and ground by name; indices of the scalar coordinates of parts by name."""
    joints = {part.name: part for part in scene.joints}
    links = [part for part in (*scene.joints, *scene.forces) if isinstance(part, AbstractLink)]
    flexible = [(k, body) for k, body in enumerate(scene.bodies) if isinstance(body, AbstractFlexibleBody)]
    scalars = {body.name: _call(body, "scalar_coordinates") for _, body in flexible}
    scalars |= {part.name: _call(part, "scalar_coordinates", space, joints) for part in links}
    numbers = itertools.count(len(scene.bodies))
    of_parts = {name: tuple(itertools.islice(numbers, len(of_part))) for name, of_part in scalars.items()}
    coupled = tuple((k, *of_parts[body.name]) for k, body in flexible)
    layout = Layout(space, tuple(body.rotates for body in scene.bodies), sum(scalars.values(), ()), coupled)
    index = {body.name: k for k, body in enumerate(scene.bodies)} | {GROUND: layout.ground}
    return layout, index, of_parts


def _body_groups(scene: Scene, layout: Layout, of_parts: Mapping[str, tuple[int, ...]]) -> tuple[BodyGroup, ...]:
    """The stacked bodies, each with its modal coordinates."""
    bodies = [(body, (k, *of_parts.get(body.name, ()))) for k, body in enumerate(scene.bodies)]
    groups = stack(bodies, layout, check_states)
    kind = lambda group: FlexibleGroup if isinstance(group.part, AbstractFlexibleBody) else BodyGroup
    return tuple(kind(group)(group) for group in groups)


def _observed(name: str, known: KnownParts) -> tuple[AbstractFrame, tuple[int, ...]]:
    """A frame with the indices of its body, and of the modal coordinates with which it moves."""
    frame, bodies = known.frames[name], (known.numbers[name], *known.modal(known.frames[name]))
    return (frame.with_fields(rows=(1, len(bodies))) if len(bodies) > 1 else frame), bodies


@on_host
def _mass_matrix(body, space, zeta):
    return body.mass_matrix(space, zeta)


def _check_inertia(body: AbstractBody):
    """Refuse a flexible body whose mass matrix is not one."""
    if not isinstance(body, AbstractFlexibleBody):
        return
    space, k = SPACE if body.dimension == 3 else PLANE, len(body.modes)
    zeta, size = as_parameter(np.zeros(k)), space.velocity_size + k
    with traced_by_jax(body.label, "an argument"):
        check_returns(body.label, "mass_matrix", (size, size), lambda zeta: body.mass_matrix(space, zeta), zeta)
        matrix = np.asarray(_mass_matrix(anonymous(body), space, jnp.asarray(zeta)))
    # The kernel rounds: 1e-12 and 1e-9 in double precision.
    rounding, equal = (float(np.finfo(matrix.dtype).eps) ** power for power in (0.77, 0.575))
    if not np.allclose(matrix, matrix.T, rtol=equal, atol=rounding * np.max(np.abs(matrix))):
        raise ValueError(f"{body.label}: mass_matrix must be symmetric, and is not at zero modal coordinates.")
    if not np.min(np.linalg.eigvalsh(matrix)) > 0:
        raise ValueError(f"{body.label}: mass_matrix must be positive definite, and is not at zero modal coordinates.")
    if not np.allclose(np.diag(matrix)[: space.dimension], body.mass, rtol=equal):
        raise ValueError(
            f"{body.label}: mass_matrix has the masses {np.diag(matrix)[: space.dimension]} on the velocity of the "
            f"frame, and mass is {float(body.mass)}; both are the whole mass."
        )


def _given_state(scene: Scene, layout: Layout) -> State:
    """The given poses and velocities of the bodies, and zeros for scalar coordinates."""
    zeros = as_parameter(np.zeros(len(layout.scalars)))
    moving = [k for k, scalar in enumerate(layout.scalars) if scalar.moves]
    return State(
        jax.device_put(np.concatenate([*(_call(body, "pose") for body in scene.bodies), zeros])),
        jax.device_put(np.concatenate([*(_call(body, "velocities") for body in scene.bodies), zeros[moving]])),
    )


def _with_initial_scalars(system: RigidBodySystem) -> RigidBodySystem:
    """The system, with a guess whose scalar coordinates and rates satisfy their constraints."""
    if not system.layout.scalars:
        return system
    q, u = jax.device_put(_scalars(system))
    return dataclasses.replace(system, guess=dataclasses.replace(system.guess, q=q, u=u))


@on_host
def _scalars(system):
    guess, layout = system.guess, system.layout
    t, u = jnp.zeros((), guess.q.dtype), guess.u
    q = system.normalize(t, guess.q)
    for g in system.constraints.inertial:
        scalars = g.group.body_index[:, -1]
        unmet = g.residual(t, system.bodies.prepared_poses(q))[:, 0]
        q = q.at[layout.pose_index[scalars, 0]].add(-unmet)
        unmet = g.velocity(system.kinematics(t, q, u))[:, 0]
        u = u.at[layout.velocity_index[scalars, 0]].add(-unmet)
    return q, u


def _settled(scene: Scene, resolved: KnownParts, layout: Layout):
    """Parts and laws of joints with every number resolved, each with the indices of its bodies; and gravity."""
    parts, laws = [], []
    acting = [part for part in (*scene.joints, *scene.forces) if isinstance(part, AbstractActor)]
    # Gravity acts on every body, so it is not an actor on named bodies.
    gravity = next((part for part in scene.forces if not isinstance(part, AbstractActor)), None)
    if gravity is not None:
        gravity.check(layout.space.dimension)
    for part in sorted(acting, key=_stage):
        settled, bodies = _call(part, "settled", resolved)
        if bodies and all(k >= layout.bodies for k in bodies):
            raise ValueError(f"{part.label} acts on the ground alone, which does not move; name a body.")
        warn_of_angles(settled, part, stacklevel=_USER + 1)
        if isinstance(settled, AbstractNonIdeal):
            laws.append((settled, bodies))
            continue
        resolved.joints[part.name] = settled, bodies
        frames = settled.body_frames
        components = [_call(one, "with_fields", body_frames=frames) for one in _call(settled, "components")]
        if not part.stage:
            _check_rotation(settled, components, bodies, layout, resolved.poses[list(bodies)])
        parts += [(component, bodies) for component in components]
    return parts, laws, gravity


def _stage(part):
    return part.stage


def _check_program(servo, space, bodies):
    check_kernels(servo.program, space, bodies)


def _call(part, name, *arguments, **fields):
    """Call a method through the class: bound methods are modules, too slow for thousands of parts."""
    return getattr(type(part), name)(part, *arguments, **fields)


def _check_kinds(scene: Scene):
    if not scene.bodies:
        raise ValueError("A scene needs at least one body.")
    for body in scene.bodies:
        if not isinstance(body, AbstractBody):
            raise ValueError(f"bodies must hold Body or PointMass, got {_misplaced(body)}.")
    for part in scene.joints:
        if not isinstance(part, AbstractLink) or isinstance(part, AbstractForce | AbstractStickSlip):
            raise ValueError(f"joints must hold constraints, got {_misplaced(part)}.")
    for part in scene.forces:
        # A concrete class: gravity acts on every body, so it shares no abstract class with force elements.
        if not isinstance(part, AbstractForce | AbstractNonIdeal | AbstractStickSlip | Gravity):
            raise ValueError(f"forces must hold force elements, friction, or Gravity, got {_misplaced(part)}.")
    if sum(not isinstance(part, AbstractActor) for part in scene.forces) > 1:
        raise ValueError("A scene has one Gravity; add the accelerations.")
    for frame in scene.frames:
        if not isinstance(frame, AbstractFrame):
            raise ValueError(f"frames must hold planar.Frame or spatial.Frame, got {_misplaced(frame)}.")
    dimension = scene.bodies[0].dimension
    for part in (*scene.bodies, *scene.joints, *scene.forces, *scene.frames):
        if dimension not in part.dimensions:
            kind, other = ("planar", "spatial") if dimension == 2 else ("spatial", "planar")
            raise ValueError(f"{part.label} is {other}, but the scene is {kind}; use the {kind} part of that name.")


def _misplaced(part) -> str:
    """The label of a part in the wrong list of a scene, and the right list."""
    if not isinstance(part, AbstractPart):
        return repr(part)
    if isinstance(part, AbstractBody):
        place = "bodies"
    elif isinstance(part, AbstractFrame):
        place = "frames"
    elif isinstance(part, AbstractLink) and not isinstance(part, AbstractForce | AbstractStickSlip):
        place = "joints"
    else:
        place = "forces"
    return f"{part.label}; it belongs in {place}="


def _check_names(scene: Scene):
    seen = {GROUND}
    for part in (*scene.bodies, *scene.joints, *scene.forces, *scene.frames):
        name = part.name
        if name in seen:
            raise ValueError(
                f"The name {name!r} is used twice; every body, joint, force and frame needs its own"
                + (" ('ground' is the fixed world)." if name == GROUND else ".")
            )
        if not name or "." in name:
            raise ValueError(f"{part.label}: a name must not be empty or contain a dot.")
        seen.add(name)
    body_names = dict.fromkeys([*(body.name for body in scene.bodies), GROUND, *(frame.name for frame in scene.frames)])
    # A servo's program is not a joint and has no friction.
    kinds = AbstractConstraint | AbstractVelocityConstraint | AbstractCompound
    # A concrete class: among constraints of coordinates gears alone have losses.
    joints = dict.fromkeys(
        part.name
        for part in scene.joints
        if isinstance(part, AbstractTendon | JointCoupling) or (isinstance(part, kinds) and not part.sources)
    )
    # Unilateral constraints of coordinates, such as stops, have no point of contact.
    stops = {
        stop.name: stop for stop in scene.joints if isinstance(stop, AbstractUnilateralConstraint) and stop.sources
    }
    places = [*joints, *(name for name in body_names if name != GROUND)]
    for part in (*scene.joints, *scene.forces):
        if isinstance(part, AbstractActor) and part.sources:
            what, allowed = ("joint, body or frame", places) if part.takes_bodies else ("joint", joints)
            for name in part.sources:
                if name in body_names and name not in allowed and not part.takes_bodies:
                    raise ValueError(
                        f"{part.label}: {name!r} is not a joint; the part acts on joints, and there are "
                        f"{', '.join(map(repr, joints)) or 'none'}."
                    )
                if isinstance(part, AbstractNonIdeal | AbstractDryFriction) and name in stops:
                    raise ValueError(
                        f"{part.label}: {stops[name].label} has no point at which bodies touch, and no friction."
                    )
                if name not in allowed or name == part.name:
                    raise unknown(what, name, allowed, part.label)
        elif isinstance(part, AbstractLink):
            bodies = part.bodies
            for name in bodies:
                if name not in body_names:
                    raise unknown("body", name, body_names, part.label)
            bodies = part.distinct(bodies)
            twice = [name for name in bodies if bodies.count(name) > 1]
            if twice and (twice[0] != GROUND or set(bodies) == {GROUND}):
                raise ValueError(f"{part.label} connects {twice[0]!r} with itself.")


def _check_rotation(part, components, bodies, layout, poses):
    """Refuse parts that act on the rotation of a point mass."""
    points = [i for i, k in enumerate(bodies) if k < layout.bodies and not layout.rotates[k]]
    space = layout.space
    for component in components if points else ():
        with traced_by_jax(part.label, "an argument"):
            now, kernels, _ = captured(anonymous(_loaded(component)), space, len(bodies) - component.modal_rows)
            turned = _turned(now, space, poses, tuple(kernels.items()))
        if np.any(turned[points]):
            raise ValueError(
                f"{part.label} acts on the rotation of a PointMass, which has none: put its point at the origin, "
                "or use a Body."
            )


def _loaded(part):
    """The part with unit values for zero forces and moments, since inputs may replace them.

    The parameters of a user's function, weights of modules among them, become independent numbers.
    """
    filled = lambda x: np.ones_like(x) if isinstance(x, ARRAYS) and not np.any(x) else x
    ones = {}
    for name, declared in declarations(type(part)).items():
        value = values_of(part)[name]
        if declared.kind in ("numbers", "module"):
            ones[name] = shaken(value, 0)
        elif isinstance(value, Mapping):
            ones[name] = {key: filled(x) for key, x in value.items()}
        elif declared.unit in ("N", "N m", "Pa") and value is not None:
            ones[name] = filled(value)
    return _call(part, "with_fields", **ones) if ones else part


@on_host
def _turned(part, space, poses, kernels):
    """Which bodies a part turns, at the given poses or at displaced poses with stretched springs and closed contacts.

    **Arguments:** `kernels` of a user's class; they are part of the cache key, since the class may have changed.
    """
    del kernels
    d, k = space.dimension, poses.shape[0]
    varied = lambda size: jnp.asarray(1 + 0.4 * np.cos(np.arange(k * size)), poses.dtype).reshape(k, size)

    def turned(poses):
        strength = _strength(part, space, poses, varied(space.velocity_size))
        # Arms up to this length are rounding errors.
        least = 100 * float(np.finfo(poses.dtype).eps) * jnp.max(jnp.abs(poses[:, :d]))
        return jnp.any(strength[:, d:] > least * jnp.max(strength[:, :d]), axis=1)

    displaced = jax.vmap(space.normalize)(poses + varied(space.pose_size))
    return jnp.any(lax.map(turned, jnp.stack([poses, displaced])), axis=0)


def _strength(part, space, poses, velocities):
    """The absolute wrenches of a part, or column sums of its absolute Jacobian, by body and velocity."""
    if isinstance(part, AbstractForce):
        wrenches = part.wrenches(space, *part.seen(space, poses, velocities), jnp.zeros((), poses.dtype))
        return jnp.abs(part.wrenches_on_bodies(space, poses, wrenches))
    if isinstance(part, AbstractStickSlip):
        poses = poses.at[-part.rows :, 0].set(STICK)
    rows = rows_of(part, space, poses)
    return jnp.sum(jnp.abs(rows), axis=0)


def _inner(part):
    """The inner parts of a part."""
    return (inner for _, inner in inner_parts(part))


def _length(parts, guess, layout):
    """The scene's size [m]: the largest length of a part, else the largest coordinate of a given position, else 1."""
    lengths = (
        values[name]
        for part in parts
        for values in [values_of(part)]
        for name, declared in declarations(type(part)).items()
        if declared.sizes
    )
    sizes = [float(np.max(np.abs(value), initial=0.0)) for value in lengths if value is not None]
    size = max(sizes, default=0.0)
    if size == 0.0:
        dimension = layout.space.dimension
        position = np.concatenate([np.asarray(guess.q)[row[:dimension]] for row in layout.pose_index[: layout.bodies]])
        size = float(np.max(np.abs(position)))
    return jax.device_put(np.asarray(size if size > 0 else 1.0, guess.q.dtype))
