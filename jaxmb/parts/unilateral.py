"""Unilateral constraints: gaps that close at an instant, with an impact, and open again.

A gap is a function of the poses of bodies that stays non-negative. An open gap has no effect; a closed gap is a
constraint `gap = 0`, whose force pushes and never pulls. `simulate` finds the times of impacts and of loss of contact
within its steps. Every pair that may touch must be named; no others are searched for.
"""

import abc
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..linalg.rotations import norm, normalize
from . import fields
from .base import (
    AbstractInertialConstraint,
    AbstractPointPair,
    PathKind,
    Poses,
    Quantities,
    ScalarCoordinate,
    Velocities,
)
from .contact_laws import AbstractImpactLaw, Newton, Poisson
from .coordinate_parts import AbstractScalarPart
from .forces import over_ground
from .kinks import clipped
from .modes import CLOSED, kind_of
from .shapes import Box, Ground
from .space import AbstractSpace, round_shapes, separation
from .terrain import AbstractTerrain, distance, edge_near


class AbstractUnilateralConstraint(AbstractInertialConstraint):
    """A gap between bodies; the gap stays non-negative.

    Subclasses define the `gap` and list the bodies. The part adds one coordinate, one velocity and one row to the
    scene. The coordinate is its mode: 0 open, 1 closed, 2 closed but implied by other contacts. Its name is
    `"stop.mode"`: `assemble(system, fix={"stop.mode": 1})` closes the gap.

    By Newton's law of impact the gap opens at `restitution` times the rate at which it closed. By Poisson's law the
    impulse of restitution is `restitution` times the impulse of compression, or more where the gap would close. The two
    laws differ if friction or several contacts act at once. Contacts that are closed at the same time share the
    impulse. With friction, or with several coefficients at once, Newton's law may add energy (T. R. Kane and D. A.
    Levinson, "Dynamics", McGraw-Hill, 1985, §5.9); all rebounds of such an impact are reduced by the same fraction, so
    that no energy is gained.

    **Arguments:**

    - `restitution` from 0 to 1, default 0: the rate after an impact over the rate before; `impact_law`, `"newton"`
        (default) or `"poisson"`.
    """

    restitution: fields.Number = fields.parameter(unit="1", sign="non-negative", default=0.0, constant=True)
    impact_law: Literal["newton", "poisson"] = fields.choice("newton", "poisson", default="newton")
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    @property
    def inertia(self) -> Float[Array, ""]:  # pyright: ignore[reportIncompatibleVariableOverride]
        # The inertia of the mode, on which no force acts.
        return jnp.ones_like(self.restitution)

    def validate(self):
        if not self.restitution <= 1:
            raise ValueError(f"{self.label}: restitution must lie between 0 and 1, got {self.restitution}.")

    def numbers_agree(self):
        return self.restitution <= 1

    def scalar_coordinates(self, space, parts):
        del space, parts
        return (ScalarCoordinate(f"{self.name}.mode", moves=True),)

    @property
    def contact_law(self) -> AbstractImpactLaw:
        """Hook: the law of impact, by default the part's `impact_law`."""
        return (Poisson if self.impact_law == "poisson" else Newton)(self.restitution)

    @abc.abstractmethod
    def gap(self, space: AbstractSpace, poses: Poses) -> Float[Array, ""]:
        """The gap [m, rad] at the poses of the bodies, as a smooth function, also where it is negative; a kink is
        allowed at its `peak`.
        """

    @property
    def knows_gap_rate(self) -> bool:
        """Hook: whether `gap_rate` is the rate of the gap."""
        return False

    def gap_rate(self, space: AbstractSpace, poses: Poses, velocities: Velocities) -> Float[Array, ""]:
        """Hook: the rate of the gap of bodies on their other constraints, linear in velocities."""
        raise NotImplementedError(f"{self.kind} has no rate of its gap in closed form.")

    @property
    def peak(self) -> Float[Array, "..."]:
        """The largest value of a gap that rises to a kink and falls again, as between two stops; by default infinite,
        without a kink.
        """
        return jnp.full_like(self.restitution, jnp.inf)

    def residual(self, space, poses, t):
        """`gap = 0` while the contact is closed; otherwise the mode keeps its value."""
        del t
        mode = poses[-1, 0]
        kind = kind_of(mode)
        return jnp.where(kind == CLOSED, self.gap(space, poses[:-1]), mode - kind)[None]


class Stop(AbstractScalarPart, AbstractUnilateralConstraint):
    """Rigid stops at one end or both ends of a coordinate's range.

    ```python
    buffer = jaxmb.Stop("buffer", "pin.angle", lower=-1.0, upper=1.0, restitution=0.6)
    scene = jaxmb.Scene([bar], joints=[pin, buffer], forces=[jaxmb.Gravity((0.0, -9.81))])
    ```

    `JointStop` is compliant.

    **Arguments:** `lower` < `upper` [rad, m]; either may be left out. In space the range of an angle must be less than
    a full turn and have both ends.
    """

    lower: fields.Number = fields.parameter(unit=("rad", "m"), optional=True)
    upper: fields.Number = fields.parameter(unit=("rad", "m"), optional=True)

    def validate(self):
        super().validate()
        if self.lower is None and self.upper is None:
            raise ValueError(f"{self.label}: give lower, upper or both.")
        if self.lower is not None and self.upper is not None and not self.lower < self.upper:
            raise ValueError(f"{self.label}: lower must be less than upper, got {self.lower} and {self.upper}.")

    def numbers_agree(self):
        agree = super().numbers_agree()
        return agree if self.lower is None or self.upper is None else agree & (self.lower < self.upper)

    def with_numbers(self, given):
        if self.is_periodic():
            if self.lower is None or self.upper is None:
                raise ValueError(
                    f"{self.label}: an angle in space is known up to full turns; give lower and upper of its range."
                )
            if self.upper - self.lower >= 2 * np.pi:
                raise ValueError(
                    f"{self.label}: the range of an angle in space must be less than a full turn, got {self.lower} to "
                    f"{self.upper}."
                )
        return super().with_numbers(given)

    @property
    def peak(self):
        if self.lower is None or self.upper is None:
            return super().peak
        return 0.5 * (self.upper - self.lower)

    def gap(self, space, poses):
        (value,) = self.measured(space, poses)
        if self.lower is None or self.upper is None:
            return value - self.lower if self.upper is None else self.upper - value
        # The nearer of the two stops.
        return self.peak - jnp.abs(self._from_middle(value))

    def _from_middle(self, value):
        middle = 0.5 * (self.lower + self.upper)
        return self.near(value[None], middle)[0] - middle

    @property
    def knows_gap_rate(self):
        return self.joint.knows_rates

    def gap_rate(self, space, poses, velocities):
        (rate,) = self.rate(space, poses, velocities)
        if self.lower is None or self.upper is None:
            return rate if self.upper is None else -rate
        (value,) = self.measured(space, lax.stop_gradient(poses))
        return -jnp.sign(self._from_middle(value)) * rate


class AbstractGeometricContact(AbstractUnilateralConstraint):
    """A unilateral constraint of lengths; its coordinate is the `gap` [m], `"floor.gap"`."""

    quantities: ClassVar[Quantities] = {"gap": "length"}

    def coordinates(self, space, poses):
        return {"gap": self.gap(space, poses[:-1])}


class AbstractRigidContact(AbstractGeometricContact):
    """A unilateral constraint of bodies that touch at a point, perhaps with friction (`DryFriction`).

    Subclasses define the point of contact, `touching`, and a `gap` that grows by one metre a metre as the last body
    moves away:

    ```python
    class RingContact(jaxmb.parts.AbstractRigidContact):
        # A ring about the z-axis of its body, on the plane z = 0.
        name: str = jaxmb.parts.name()
        body: str = jaxmb.parts.body_name()
        ring: jaxmb.parts.Number = jaxmb.parts.length(sign="positive")
        tube: jaxmb.parts.Number = jaxmb.parts.length(sign="positive")

        def lowest(self, space, poses):
            up = jnp.array([0.0, 0.0, 1.0])
            axis = space.direction(poses[0], up)
            across = up - jnp.dot(up, axis) * axis
            return poses[0, :3] - self.ring * across / jaxmb.rotations.norm(across)

        def gap(self, space, poses):
            return self.lowest(space, poses)[2] - self.tube

        def touching(self, space, poses):
            return self.lowest(space, poses) - jnp.array([0.0, 0.0, 1.0]) * self.tube

    floor = RingContact("floor", "hoop", ring=0.5, tube=0.1)
    ```

    The derivatives of a gap are found by automatic differentiation. `AbstractSurfaceContact` needs less: the distance
    of a ball from a surface.
    """

    touches: ClassVar[bool] = True

    @abc.abstractmethod
    def touching(self, space: AbstractSpace, poses: Poses) -> Float[Array, "d"]:
        """The world point [m] at which the bodies touch where the gap is zero, from the poses of the bodies."""

    def outward(self, space: AbstractSpace, poses: Poses) -> Float[Array, "d"]:
        """The unit vector along which the contact pushes the last body."""
        gap_at = lambda x: self.gap(space, poses.at[-1, : space.dimension].set(x))
        out = jax.grad(gap_at)(poses[-1, : space.dimension])
        return out / norm(out)

    def tangents(self, space: AbstractSpace, poses: Poses, pole: int = 0) -> Float[Array, "n d"]:
        """Unit vectors along which bodies slip: in the plane the outward normal turned clockwise; in space two
        tangents, turned like the normal from an axis of the first of two bodies or of the world.

        **Arguments:** `pole`: in space this axis, 1, 2 or 3, negative for the opposite direction; zero in the plane.
        The normal must not be opposite to it.
        """
        normal = self.outward(space, poses)
        if len(poses) == 1:
            return tangents_of(normal, pole)
        tangents = tangents_of(space.body_direction(poses[0], normal), pole)
        return jax.vmap(lambda v: space.direction(poses[0], v))(tangents)

    def slip(self, space: AbstractSpace, poses: Poses, velocities: Velocities, pole: int = 0) -> Float[Array, "n"]:
        """The velocity [m/s] of the last body relative to the other body or the world, at the point of contact, along
        the `tangents`.
        """
        point = self.touching(space, poses)

        def velocity(k):
            return space.point_velocity(poses[k], velocities[k], space.body_point(poses[k], point))

        relative = velocity(-1) - velocity(0) if len(poses) == 2 else self.over_ground(point, velocity(-1))
        return self.tangents(space, poses, pole) @ relative

    def over_ground(self, point: Float[Array, "d"], velocity: Float[Array, "d"]) -> Float[Array, "d"]:
        """Hook: the velocity [m/s] of a single body relative to the surface that it touches at a point, from its
        velocity in the world.
        """
        del point
        return velocity


def tangents_of(normal: Float[Array, "d"], pole: int) -> Float[Array, "n d"]:
    """Unit tangents of a surface from its normal, see `AbstractRigidContact.tangents`."""
    if not pole:
        return jnp.stack([normal[1], -normal[0]])[None]
    axes, upwards = map(jnp.asarray, axes_of(pole, normal.dtype))
    # The smallest turn from the pole to the normal.
    return axes - ((axes @ normal) / (1 + upwards @ normal))[:, None] * (upwards + normal)[None]


def axes_of(pole: int, dtype: Any) -> tuple[Float[np.ndarray, "2 3"], Float[np.ndarray, "3"]]:
    """The axes beside a pole, and the pole."""
    k, one = abs(pole) - 1, np.eye(3, dtype=dtype)
    return one[[(k + 1) % 3, (k + 2) % 3]], np.sign(pole) * one[k]


class AbstractSurfaceContact(AbstractRigidContact):
    """A rigid contact of a ball (in the plane a disc), fixed in the last body, with a surface, fixed in the first of
    two bodies or in the world.

    Subclasses say what the ball is, and how far it is from the surface with its centre at a place. The gap, the point
    of contact, the normal and their rates follow. Places, gradients and rates are in the axes of the surface's body.

    ```python
    class DrumContact(jaxmb.parts.AbstractSurfaceContact):
        name: str = jaxmb.parts.name()
        body: str = jaxmb.parts.body_name()
        drum: jaxmb.parts.Number = jaxmb.parts.length(sign="positive")
        radius: jaxmb.parts.Number = jaxmb.parts.length(sign="positive")

        @property
        def ball(self):
            return jnp.zeros(3), self.radius

        def clearance(self, place):
            return jnp.hypot(place[0], place[2]) - self.drum - self.radius

    on = DrumContact("on", "ball", drum=1.0, radius=0.1)
    ```
    """

    @property
    @abc.abstractmethod
    def ball(self) -> tuple[Float[Array, "d"], Float[Array, ""]]:
        """The centre [m] of the ball, fixed in the last body, and its radius [m]."""

    @abc.abstractmethod
    def clearance(self, place: Float[Array, "d"]) -> Float[Array, ""]:
        """The gap [m] of a ball whose centre is at this place [m]."""

    def facing(self, place: Float[Array, "d"]) -> tuple[Float[Array, "d"], Float[Array, ""] | None]:
        """The gradient of `clearance`, and its length, None if that is one."""
        gradient = jax.grad(self.clearance)(place)
        return gradient, norm(gradient)

    def facing_rate(self, place: Float[Array, "d"], velocity: Float[Array, "d"]) -> Float[Array, "d"] | None:
        """The rate of the gradient as the centre moves; None for a plane, where it is constant."""
        return jax.jvp(jax.grad(self.clearance), (place,), (velocity,))[1]

    def gap(self, space, poses):
        return self.clearance(self._place(space, poses))

    def touching(self, space, poses):
        centre, radius = self.ball
        return space.point(poses[-1], centre) - radius * self.outward(space, poses)

    def outward(self, space, poses):
        gradient, size = self.facing(self._place(space, poses))
        normal = gradient if size is None else gradient / size
        return space.direction(poses[0], normal) if len(poses) == 2 else normal

    def _place(self, space, poses):
        centre = space.point(poses[-1], self.ball[0])
        return space.body_point(poses[0], centre) if len(poses) == 2 else centre


class RigidContact(AbstractSurfaceContact):
    """Rigid contact of a body with a terrain, as a disc (in the plane), a sphere (in space), or a point; frictionless
    without a `DryFriction`.

    ```python
    ball = planar.Body("ball", mass=1.0, inertia=planar.disc(1.0, 0.1), position=(0.0, 0.5))
    floor = jaxmb.RigidContact("floor", "ball", terrain=jaxmb.terrain.Flat(), radius=0.1, restitution=0.8)
    scene = jaxmb.Scene([ball], joints=[floor], forces=[jaxmb.Gravity((0.0, -9.81))])
    ```

    The gap is normal to the terrain, exact on even ground and to first order in its curvature. `Contact` is compliant.
    The rim of a disc in space has no rigid contact with ground; `spatial.RollingDisc` rolls on a plane. For contacts of
    other shapes see `parts.AbstractRigidContact` and `parts.AbstractSurfaceContact`.

    **Arguments:**

    - `name`, of the contact; `body`: the body that touches, or a frame in it, by name.
    - `terrain`, from `jaxmb.terrain`, fixed in the world.
    - `radius` [m] ≥ 0, 0 for a point; `centre` [m], body-fixed, default the origin of the frame.
    """

    name: str = fields.name()
    body: str = fields.body_name()
    terrain: AbstractTerrain = fields.law(AbstractTerrain, what="a law from jaxmb.terrain")
    radius: fields.Number = fields.length(sign="non-negative", default=0.0)
    centre: fields.Number = fields.point(body=0, default="origin")
    has_limits: ClassVar[bool] = True

    @property
    def ball(self):
        return self.centre, self.radius

    def clearance(self, place):
        return distance(self.terrain, place) - self.radius

    def facing(self, place):
        return self.terrain.facing(place)

    def facing_rate(self, place, velocity):
        return self.terrain.facing_rate(place, velocity)

    def over_ground(self, point, velocity):
        return over_ground(self, point, velocity)

    def limit_reached(self, space, poses):
        return edge_near(self.terrain, self._place(space, poses[:1])[None])

    def shapes(self, space, size):
        return (None, Ground(height=self.terrain.height)), *round_shapes(space, 0, self.radius, self.centre)


class RigidBallContact(AbstractSurfaceContact, AbstractPointPair):
    """Rigid contact of two discs (in the plane) or balls (in space) of different bodies; frictionless without a
    `DryFriction`.

    ```python
    disc = {"mass": 1.0, "inertia": planar.disc(1.0, 0.1)}
    discs = [planar.Body("a", velocity=(1.0, 0.0), **disc), planar.Body("b", position=(0.5, 0.0), **disc)]
    meet = jaxmb.RigidBallContact("meet", "a", "b", radius_a=0.1, radius_b=0.1, restitution=0.9)
    scene = jaxmb.Scene(discs, joints=[meet])
    ```

    **Arguments:** `radius_a`, `radius_b` [m] ≥ 0 about the points; one of them may be zero. The points must not
    coincide.
    """

    radius_a: fields.Number = fields.length(sign="non-negative")
    radius_b: fields.Number = fields.length(sign="non-negative")

    def validate(self):
        super().validate()
        if not self.radius_a + self.radius_b > 0:
            raise ValueError(f"{self.label}: only one of radius_a and radius_b may be zero; give the other.")

    def numbers_agree(self):
        return super().numbers_agree() & (self.radius_a + self.radius_b > 0)

    @property
    def ball(self):
        return self.point_b, self.radius_b

    def clearance(self, place):
        return norm(place - self.point_a) - self.radius_a - self.radius_b

    def facing(self, place):
        return normalize(place - self.point_a), None

    def facing_rate(self, place, velocity):
        return _turning_of_normal(place - self.point_a, velocity)

    def shapes(self, space, size):
        first = round_shapes(space, 0, self.radius_a, self.point_a)
        return first + round_shapes(space, 1, self.radius_b, self.point_b)


class RigidPlaneContact(AbstractSurfaceContact, AbstractPointPair):
    """Rigid contact of a disc or ball of `body_b`, or of a point, with a plane (a line in planar scenes) of `body_a`;
    frictionless without a `DryFriction`.

    ```python
    ball = planar.Body("ball", mass=1.0, inertia=planar.disc(1.0, 0.1), position=(0.2, 0.5))
    on = jaxmb.RigidPlaneContact("on", "bar", "ball", normal=(0.0, 1.0), radius=0.1, restitution=0.5)
    scene = jaxmb.Scene([bar, ball], joints=[pin, on], forces=[jaxmb.Gravity((0.0, -9.81))])
    ```

    The plane has no end, and the ball is always on the side to which the normal points.

    **Arguments:** `normal_a`, fixed in `body_a`, or `normal` in the world at the given poses: the normal of the plane,
    which contains point A; `radius` [m] ≥ 0 about point B, default 0.
    """

    normal_a: fields.Number = fields.axis(body=0, optional=True)
    normal: fields.Number = fields.axis(body=None, gives=("normal_a",))
    radius: fields.Number = fields.length(sign="non-negative", default=0.0)

    @property
    def ball(self):
        return self.point_b, self.radius

    def clearance(self, place):
        return jnp.dot(self.normal_a, place - self.point_a) - self.radius

    def facing(self, place):
        return self.normal_a, None

    def facing_rate(self, place, velocity):
        return None


class RigidBoxContact(AbstractSurfaceContact, AbstractPointPair):
    """Rigid contact of a disc or ball of `body_b` with a rectangle (in the plane) or a box of `body_a`, at its faces,
    edges and corners; frictionless without a `DryFriction`.

    ```python
    wheel = planar.Body("wheel", mass=1.0, inertia=planar.disc(1.0, 0.3), position=(0.0, 0.3))
    step = jaxmb.RigidBoxContact("step", "ground", "wheel", size=(1.0, 0.2), point_a=(2.0, 0.1), radius=0.3)
    scene = jaxmb.Scene([wheel], joints=[step])
    ```

    The ball rolls or slides from a face over an edge without an event, but with a jump of its acceleration.

    **Arguments:** `size` [m], the lengths of the box about point A along the axes of the frame of `body_a`; `radius`
    [m] > 0 about point B, which stays outside of the box.
    """

    size: fields.Number = fields.parameter(shape=("d",), unit="m", sign="positive")
    radius: fields.Number = fields.length(sign="positive")

    @property
    def ball(self):
        return self.point_b, self.radius

    def clearance(self, place):
        return norm(self._outside(place)) - self.radius

    def facing(self, place):
        return normalize(self._outside(place)), None

    def facing_rate(self, place, velocity):
        out = self._outside(place)
        return _turning_of_normal(out, jnp.where(out == 0, 0.0, velocity))

    def _outside(self, place):
        """From the nearest point of the box to a place, in the axes of the box."""
        centre = place - self.point_a
        return centre - clipped(centre, -0.5 * self.size, 0.5 * self.size)

    def shapes(self, space, size):
        extent = space.in_space(self.size)
        # A rectangle is as thick as a disc.
        extent = np.where(np.arange(3) < space.dimension, extent, self.radius / 3)
        box = Box(extent, position=space.in_space(self.point_a))
        return (0, box), *round_shapes(space, 1, self.radius, self.point_b)


def _turning_of_normal(out, rate):
    """The rate of the unit vector along a vector."""
    size = norm(out)
    normal = out / size
    return (rate - normal * jnp.dot(normal, rate)) / size


class Slack(AbstractGeometricContact, AbstractPointPair):
    """A rope between two points, or a coupling with slack: the points are at most `length` apart.

    ```python
    bob = planar.PointMass("bob", mass=1.0, position=(0.6, 0.0))
    rope = jaxmb.Slack("rope", "ground", "bob", length=1.0)
    scene = jaxmb.Scene([bob], joints=[rope], forces=[jaxmb.Gravity((0.0, -9.81))])
    ```

    **Arguments:** `length` [m] > 0.
    """

    length: fields.Number = fields.length(sign="positive")
    path_kind: ClassVar[PathKind] = "cord"

    def slack(self, space, poses):
        return self.length - norm(separation(space, self, poses))

    def gap(self, space, poses):
        d = separation(space, self, poses)
        # Smooth where the points coincide.
        return (self.length**2 - jnp.dot(d, d)) / (2 * self.length)
