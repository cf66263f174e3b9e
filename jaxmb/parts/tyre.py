"""Tyres: compliant wheels whose slip forces build up over a relaxation length.

Source: H. B. Pacejka, "Tyre and Vehicle Dynamics", 3rd ed., Butterworth-Heinemann 2012, chapter 7 (single contact point
transient models).
"""

import abc
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from ..linalg.arrays import is_traced
from ..linalg.jitted import on_host
from ..linalg.rotations import cross, norm
from . import fields
from .base import AbstractDynamicForce, AbstractPotentialForce
from .boundary import check_returns
from .contact import AbstractNormalLaw
from .curves import over_arrays
from .forces import over_ground
from .magic_formula import Forces
from .shapes import Ground, wheel
from .smooth import dry_friction, ramp, step, without_pull
from .terrain import AbstractTerrain, distance, edge_near, outward, pace_over

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


# The sine of the angle between axle and normal of a wheel that lies flat.
_FLAT = 1e-6


class AbstractTyre(AbstractDynamicForce, AbstractPotentialForce):
    """A compliant wheel on terrain: its circle, the contact, and the deflection of its tread.

    **Arguments:**

    - `name`, of the tyre; `body`: the wheel, or a frame fixed in it.
    - `centre` [m], default the origin of the frame.
    - `axis`, unit, shape (3,), in space: the axle fixed in the body, pointing to the left of a wheel that rolls
        forwards, default the y axis. The wheel must not lie flat.
    - `terrain`, from `jaxmb.terrain`; `smoothing` [m] > 0 of the depth, `½ (δ + √(δ² + smoothing²))`.
    - `damping_depth` [m] > 0: damping against the rate of the depth is full from there on. While the wheel rebounds,
        damping is at most as large as the elastic load, so that the ground never pulls.
    - `transition_speed` [m/s] > 0: rolling speeds below it are regularised.
    - `deflection` [m], (d − 1,), an internal state: the deflection of the tread in the contact relative to the rim,
        forwards and, in space, to the left; initially zero. Off the ground it follows the slip as well, without a
        force.
    """

    name: str = fields.name()
    body: str = fields.body_name()
    centre: fields.Number = fields.point(body=0, default="origin")
    axis: fields.Number = fields.axis(body=0, optional=True, dimension=3)
    terrain: AbstractTerrain = fields.law(AbstractTerrain, what="a law from jaxmb.terrain")
    transition_speed: fields.Number = fields.parameter(unit="m/s", sign="positive", default=0.1)
    damping_depth: fields.Number = fields.parameter(unit="m", sign="positive", default=0.01)
    smoothing: fields.Number = fields.parameter(unit="m", sign="positive", default=1e-3)
    deflection: fields.Number = fields.internal_state(shape=None, unit="m")
    # Of the unloaded circle [m].
    radius: AbstractVar[fields.Number]
    # [N s/m]
    damping: AbstractVar[fields.Number]
    # Numbers of one direction along the ground or of all.
    of_directions: ClassVar[tuple[str, ...]] = ("deflection",)
    moving: ClassVar[tuple[str, ...]] = ("terrain",)
    has_limits: ClassVar[bool] = True
    has_gaps: ClassVar[bool] = True
    touches: ClassVar[bool] = True

    def complete(self, space, poses):
        count = space.dimension - 1
        for name in self.of_directions:
            shape = np.shape(getattr(self, name))
            if shape not in ((), (count,)):
                raise ValueError(f"{self.label}: {name} must have shape () or ({count},), got {shape}.")
        place = np.zeros(count, np.asarray(self.radius).dtype)
        check_returns(self.label, "terrain.height", (), self.terrain.height, place)
        part = self if space.dimension == 2 else self.filled(axis=np.eye(3)[1])
        part._check_upright(space, poses)
        return part.with_fields(deflection=fields.as_parameter(np.broadcast_to(self.deflection, (count,))))

    def _check_upright(self, space, poses):
        if space.dimension == 2 or is_traced((self.terrain, self.axis, poses)):
            return
        axle = space.direction(np.asarray(poses[0]), np.asarray(self.axis))
        if not np.linalg.norm(np.cross(axle, _normal_below(self, space, poses[0]))) > _FLAT:
            raise ValueError(f"{self.label}: the wheel lies flat at the given pose; tilt it, or give another axis.")

    def may_vary(self, keys):
        return keys[0] not in ("radius", "centre", "axis")

    def gaps(self, space, poses, t):
        return self._gap(space, poses[0])[None]

    @property
    def gap_width(self):
        return self.smoothing

    def gap_pace(self, space, poses, velocities, t):
        centre = space.point(poses[0], self.centre)
        passing = pace_over(self.terrain, centre, space.point_velocity(poses[0], velocities[0], self.centre))
        return jnp.maximum(super().gap_pace(space, poses, velocities, t), passing)

    def limit_reached(self, space, poses):
        return edge_near(self.terrain, space.point(poses[0], self.centre)[None])

    def shapes(self, space, size):
        # In the plane the axle points to the viewer.
        axle = np.eye(3)[2] if space.dimension == 2 else self.axis
        tyre = wheel(self.radius, axis=axle, position=space.in_space(self.centre))
        return (None, Ground(height=self.terrain.height)), *((0, shape) for shape in tyre)

    def forces(
        self,
        *,
        load: ArrayLike,
        slip_ratio: ArrayLike = 0.0,
        slip_angle: ArrayLike = 0.0,
        camber: ArrayLike = 0.0,
        speed: ArrayLike | None = None,
    ) -> Forces:
        """The forces and moments of steady rolling, without a machine: the law of a motion.

        ```python
        ground = {"terrain": jaxmb.terrain.Flat(), "normal": jaxmb.contact.Linear(2e5)}
        tyre = planar.Tyre(
            "tyre", "wheel", radius=0.3, coefficient=0.9, slip_stiffness=15.0, relaxation_length=0.2, **ground
        )
        forces = tyre.forces(load=4e3, slip_angle=np.linspace(-0.2, 0.2, 101))
        forces.fx, forces.fy
        ```

        **Arguments:** numbers or arrays that broadcast.

        - `load` [N] ≥ 0, the force along the normal.
        - `slip_ratio`: the velocity of the tread against the ground, backwards, over the speed of rolling; positive for
            driving.
        - `slip_angle` [rad], positive for a wheel that moves to the left, less than a right angle.
        - `camber` [rad], positive if the wheel's top leans to the right. `Tyre` does not depend on it.
        - `speed` [m/s] > 0 of rolling, on which `Tyre` does not depend; default LONGVL, the speed of the tyre's data.

        **Returns:** `Forces` on the wheel at the contact: `fx` forwards, `fy` to the left [N]; about these directions
        and the normal `mx`, `my` and `mz` [N m].
        """
        given = {"load": load, "slip_ratio": slip_ratio, "slip_angle": slip_angle, "camber": camber}
        return over_arrays(self.label, type(self)._steady, self, **given, speed=self._usual_speed(speed))

    @abc.abstractmethod
    def _steady(self, load, slip_ratio, slip_angle, camber, speed) -> Forces:
        """The forces of steady rolling."""

    def _usual_speed(self, speed):
        """The speed of rolling, with its default."""
        return 1.0 if speed is None else speed

    def _upwards(self, space, pose, normal_W):
        """World unit vector from the point of the rim that is lowest over the ground to the wheel's centre."""
        if space.dimension == 2:
            return normal_W
        axle = space.direction(pose, self.axis)
        up = cross(axle, cross(normal_W, axle))
        return up / norm(up)

    def _directions(self, space, pose, normal_W):
        """Unit vectors along the ground: forwards and, in space, to the left; world axes."""
        if space.dimension == 2:
            return jnp.stack([normal_W[1], -normal_W[0]])[None]
        forwards = cross(space.direction(pose, self.axis), normal_W)
        forwards = forwards / norm(forwards)
        return jnp.stack([forwards, cross(normal_W, forwards)])

    def _gap(self, space, pose):
        centre = space.point(pose, self.centre)
        rim = centre - self.radius * self._upwards(space, pose, outward(self.terrain, centre))
        return distance(self.terrain, rim)

    def _depth(self, space, pose, growth: Any = 0.0):
        """The depth [m] in the ground of the circle, with a growth [m] of its radius."""
        return ramp(growth - self._gap(space, pose), self.smoothing)

    def _velocity(self, space, pose, velocity, point):
        """The velocity of a point fixed in the body over the ground."""
        return over_ground(self, space.point(pose, self.centre), space.point_velocity(pose, velocity, point))

    def _normal(self, space, pose):
        """The ground's normal below the centre, in world axes."""
        return outward(self.terrain, space.point(pose, self.centre))

    def _contact(self, space, pose, velocity, normal, reach):
        """The directions along the ground, the point [m] in the body's frame at a distance below the centre, the slip
        velocities [m/s] of this point, and the velocity of the centre forwards.
        """
        centre = space.point(pose, self.centre)
        point = space.body_point(pose, centre - reach * self._upwards(space, pose, normal))
        along = self._directions(space, pose, normal)
        slip = along @ self._velocity(space, pose, velocity, point)
        return along, point, slip, jnp.dot(along[0], self._velocity(space, pose, velocity, self.centre))

    def _speed(self, rolling):
        """The rolling speed [m/s], regularised."""
        return jnp.sqrt(rolling**2 + self.transition_speed**2)

    def _normal_forces(self, space, pose, velocity, depth, load):
        """The ground's normal; the forces along it of the spring and against the rate of the depth [N], of which the
        sum is the load of friction; from the `load` of the normal law at a depth.
        """
        normal, square = self._normal(space, pose), depth * depth
        # With the slope of the ramp at this depth.
        spring = load * square / (square + 0.25 * self.smoothing**2)
        rising = jnp.dot(self._velocity(space, pose, velocity, self.centre), normal)
        damping = -self.damping * step(depth / self.damping_depth) * rising
        return normal, spring, without_pull(spring, damping)


@on_host
def _normal_below(tyre, space, pose):
    return tyre._normal(space, pose)


class Tyre(AbstractTyre):
    """A tyre on a thin wheel, with relaxation, and with slip lengthwise and in space sideways.

    ```python
    wheel = planar.Body("wheel", mass=10.0, inertia=planar.disc(10.0, 0.3), position=(0.0, 0.3), velocity=(5.0, 0.0))
    ground = {"terrain": jaxmb.terrain.Flat(), "normal": jaxmb.contact.Linear(2e5)}
    grip = {"coefficient": 0.9, "slip_stiffness": 15.0, "relaxation_length": 0.2}
    system = jaxmb.Scene([wheel], forces=[planar.Tyre("tyre", "wheel", radius=0.3, **ground, **grip)]).compile()
    ```

    The tread deflects in each direction as `ḋ = −v_s − (V/σ) d`, with the slip velocity v_s of the wheel's lowest point
    and the rolling speed `V = √(v² + transition_speed²)` of its centre. In steady rolling the slips `d/σ` are thus
    `−v_s/V`; the lateral slip is the tangent of the slip angle. With `s = c d/(σ μ)`, the force on the wheel at its
    lowest point is `μ N tanh(|s|) s/|s|`: `c N d/σ` for small slips, and friction for large ones. The load N is the
    force along the normal, of spring and damping. The wheel's inclination only moves the contact; there is no aligning
    torque or rolling resistance. `tyre.forces(load=4e3, slip_angle=0.1)` are the forces without a machine.

    **Arguments:**

    - `radius` [m] > 0 of the circle.
    - `normal`: the load [N] as a function of the depth, from `jaxmb.contact`; `damping` [N s/m] ≥ 0 against the rate of
        the depth.
    - `slip_stiffness` c > 0, of one direction or of all, (d − 1,): force over load and slip, for small slips;
        `coefficient` μ > 0 of friction.
    - `relaxation_length` σ [m] > 0, of one direction or of all.
    """

    radius: fields.Number = fields.length(sign="positive")
    normal: AbstractNormalLaw = fields.law(AbstractNormalLaw, what="a law from jaxmb.contact")
    coefficient: fields.Number = fields.parameter(unit="1", sign="positive")
    slip_stiffness: fields.Number = fields.parameter(shape=None, unit="1", sign="positive")
    relaxation_length: fields.Number = fields.parameter(shape=None, unit="m", sign="positive")
    damping: fields.Number = fields.parameter(unit="N s/m", sign="non-negative", default=0.0)
    of_directions: ClassVar[tuple[str, ...]] = ("slip_stiffness", "relaxation_length", "deflection")

    def wrenches(self, space, poses, velocities, t):
        pose, velocity = poses[0], velocities[0]
        depth, gradient = jax.value_and_grad(lambda pose: self._depth(space, pose))(pose)
        load = self.normal.force(depth)
        wrench = space.pull_back(pose, -load * gradient)
        normal, spring, damping = self._normal_forces(space, pose, velocity, depth, load)
        along, point, *_ = self._contact(space, pose, velocity, normal, self.radius)
        friction = self._friction(spring + damping, self.deflection, self.relaxation_length)
        return (wrench + space.point_force(pose, point, friction @ along + damping * normal))[None]

    def _friction(self, load, deflection, relaxation_length):
        sliding = self.slip_stiffness * deflection / (relaxation_length * self.coefficient)
        # The law of dry friction, with the deflection in the place of slip.
        return dry_friction(self.coefficient * load, -sliding, 1.0)

    def _steady(self, load, slip_ratio, slip_angle, camber, speed):
        fx, fy = self._friction(load, jnp.stack([slip_ratio, -jnp.tan(slip_angle)]), 1.0)
        none = jnp.zeros_like(fx)
        return Forces(fx, fy, none, none, none)

    def energy(self, space, poses, t):
        return self.normal.energy(self._depth(space, poses[0]))

    def state_rates(self, space, poses, velocities, t):
        normal = self._normal(space, poses[0])
        *_, slip, rolling = self._contact(space, poses[0], velocities[0], normal, self.radius)
        return {"deflection": -slip - self._speed(rolling) / self.relaxation_length * self.deflection}

    def state_sizes(self):
        return {"deflection": 0.1 * jnp.max(self.relaxation_length)}
