"""Compliant contact of bodies with terrain: normal force laws, friction laws, and the contact force.

```python
from jaxmb import contact, terrain
soil = contact.Bekker(cohesive_modulus=1e3, frictional_modulus=1.5e6, exponent=1.1, width=0.1, area=0.02)
shear = contact.Janosi(
    cohesion=1e3, friction_angle=0.5, shear_modulus=0.02, length=0.2, area=0.02, transition_speed=0.1
)
on_sand = planar.Contact("on sand", "wheel", terrain=terrain.Flat(), normal=soil, friction=shear, radius=0.3)
steel = {"normal": contact.Hertz(1e9), "friction": contact.Coulomb(0.3, transition_speed=0.01)}
on_rail = planar.Contact("on rail", "wheel", terrain=terrain.Flat(), radius=0.3, **steel)
on_springs = planar.Contact("on springs", "wheel", terrain=terrain.Flat(), normal=contact.Linear(1e5), radius=0.3)
```

A body touches the ground with a disc, a sphere or a point. The ground is compliant: its force is a function of the
penetration depth, so contact adds no constraint and no event.
"""

import abc
import itertools
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..linalg.rotations import norm
from . import fields
from .base import AbstractLaw, AbstractPotentialForce
from .boundary import check_returns
from .curves import over_arrays
from .forces import over_ground
from .shapes import Ground
from .smooth import dry_friction, ramp, step, without_pull
from .space import round_shapes
from .terrain import AbstractTerrain, distance, edge_near, outward, pace_over

__all__ = ["AbstractFrictionLaw", "AbstractNormalLaw", "Bekker", "Contact", "Coulomb", "Hertz", "Janosi", "Linear"]

Number = Float[Array, ""]
Vector = Float[Array, "d"]


class AbstractNormalLaw(AbstractLaw):
    """Normal force as a function of penetration depth, the same for loading and unloading."""

    @abc.abstractmethod
    def force(self, depth: Number) -> Number:
        """Normal force [N] at a depth [m] > 0."""

    @abc.abstractmethod
    def energy(self, depth: Number) -> Number:
        """Elastic energy [J] stored at a depth [m] > 0."""


class Linear(AbstractNormalLaw):
    """`stiffness depth`.

    **Arguments:** `stiffness` [N/m].
    """

    stiffness: fields.Number = fields.parameter(unit="N/m", sign="positive", kw_only=False)

    def force(self, depth):
        return self.stiffness * depth

    def energy(self, depth):
        return 0.5 * self.stiffness * depth**2


class Hertz(AbstractNormalLaw):
    """Hertzian point contact of elastic bodies, `stiffness depth^1.5`.

    **Arguments:** `stiffness` [N/m^1.5], for a sphere of radius R on a plane `4/3 E √R` with
    `1/E = (1 − ν₁²)/E₁ + (1 − ν₂²)/E₂`.
    """

    stiffness: fields.Number = fields.parameter(unit="N/m^1.5", sign="positive", kw_only=False)

    def force(self, depth):
        return self.stiffness * depth**1.5

    def energy(self, depth):
        return self.stiffness * depth**2.5 / 2.5


class Bekker(AbstractNormalLaw):
    """Bekker's pressure-sinkage relation of soil, `area (cohesive_modulus / width + frictional_modulus)
    depth^exponent`.

    Unloading follows the loading curve; permanent sinkage is not modelled.

    Source: M. G. Bekker, "Introduction to Terrain-Vehicle Systems", University of Michigan Press 1969.

    **Arguments:** `cohesive_modulus` k_c [N/m^(n+1)] ≥ 0; `frictional_modulus` k_φ [N/m^(n+2)] ≥ 0; `exponent` n > 0;
    `width` b [m], the smaller side of the contact patch; `area` [m²] of the patch.
    """

    cohesive_modulus: fields.Number = fields.parameter(sign="non-negative")
    frictional_modulus: fields.Number = fields.parameter(sign="non-negative")
    exponent: fields.Number = fields.parameter(unit="1", sign="positive")
    width: fields.Number = fields.parameter(unit="m", sign="positive")
    area: fields.Number = fields.parameter(unit="m²", sign="positive")

    def force(self, depth):
        return self.area * (self.cohesive_modulus / self.width + self.frictional_modulus) * depth**self.exponent

    def energy(self, depth):
        return self.force(depth) * depth / (self.exponent + 1)


class AbstractFrictionLaw(AbstractLaw):
    """Tangential force that opposes slip."""

    @abc.abstractmethod
    def force(self, load: Number, engaged: Number, slip: Vector, travel: Vector) -> Vector:
        """Force [N] on the body.

        **Arguments:** `load`: normal force [N]; `engaged`: from 0 off the ground to 1 in full contact; `slip`: velocity
        along the ground [m/s] of the body's lowest point; `travel`: the velocity of its centre.
        """


class Coulomb(AbstractFrictionLaw):
    """Coulomb friction, regularised at zero slip: `coefficient load tanh(slip / transition_speed)`.

    On a slope a body creeps instead of resting, at a speed proportional to `transition_speed`.

    **Arguments:** `coefficient` ≥ 0; `transition_speed` [m/s] > 0, the slip at which 76 % of the friction acts.
    """

    coefficient: fields.Number = fields.parameter(unit="1", sign="non-negative", kw_only=False)
    transition_speed: fields.Number = fields.parameter(unit="m/s", sign="positive")

    def force(self, load, engaged, slip, travel):
        del engaged, travel
        return dry_friction(self.coefficient * load, slip, self.transition_speed)


class Janosi(AbstractFrictionLaw):
    """Soil shear of Janosi and Hanamoto, `τ = (c + p tan φ) (1 − exp(−j/K))`, under a patch along which the shear
    displacement j grows linearly to slip ratio times length.

    The slip ratio is the slip divided by the travel speed or the circumferential speed, whichever is larger; speeds
    below `transition_speed` are regularised.

    Source: Z. Janosi and B. Hanamoto, "The analytical determination of drawbar pull as a function of slip for tracked
    vehicles in deformable soils", 1st ISTVS Conference, Torino 1961.

    **Arguments:** `cohesion` c [Pa] ≥ 0; `friction_angle` φ [rad]; `shear_modulus` K [m] > 0, a displacement; `length`
    [m] > 0 of the patch, and its `area` [m²]; `transition_speed` [m/s] > 0.
    """

    cohesion: fields.Number = fields.parameter(unit="Pa", sign="non-negative")
    friction_angle: fields.Number = fields.parameter(unit="rad", sign="non-negative")
    shear_modulus: fields.Number = fields.parameter(unit="m", sign="positive")
    length: fields.Number = fields.parameter(unit="m", sign="positive")
    area: fields.Number = fields.parameter(unit="m²", sign="positive")
    transition_speed: fields.Number = fields.parameter(unit="m/s", sign="positive")

    def force(self, load, engaged, slip, travel):
        strength = self.cohesion * self.area * engaged + load * jnp.tan(self.friction_angle)
        speed = lambda v: jnp.sqrt(jnp.dot(v, v) + self.transition_speed**2)
        reference = 0.5 * (speed(travel) + speed(travel - slip) + speed(slip))
        scale = self.length / (self.shear_modulus * reference)
        x = scale * norm(slip)
        small = x < 0.02
        other = jnp.where(small, 1.0, x)
        series = 1 / 2 - x * (1 / 6 - x * (1 / 24 - x * (1 / 120 - x * (1 / 720 - x / 5040))))
        # The mean of 1 − exp(−j/K) for j/K from 0 to x, over x.
        return -strength * scale * jnp.where(small, series, (other + jnp.expm1(-other)) / other**2) * slip


class AbstractContact(AbstractPotentialForce):
    """Base class of contacts with one terrain. Subclasses define the distance from the ground (`distance`, `outward`),
    the onset of damping (`onset`) and the force that presses (`pressing`); fields as in `Contact`.
    """

    name: str = fields.name()
    bodies: fields.Names = fields.body_names()
    terrain: AbstractTerrain = fields.law(AbstractTerrain, what="a law from jaxmb.terrain")
    normal: AbstractNormalLaw = fields.law(AbstractNormalLaw, what="a law from jaxmb.contact")
    friction: AbstractFrictionLaw | None = fields.law(
        AbstractFrictionLaw | None, what="a law from jaxmb.contact", default=None
    )
    radius: fields.Number = fields.length(shape=None, sign="non-negative", default=0.0)
    centres: fields.Number = fields.parameter(shape=None, unit="m", optional=True)
    damping: fields.Number = fields.parameter(unit="N s/m", sign="non-negative", default=0.0)
    damping_depth: fields.Number = fields.parameter(unit="m", sign="positive", default=0.01)
    smoothing: fields.Number = fields.parameter(unit="m", sign="positive", default=1e-3)
    moving: ClassVar[tuple[str, ...]] = ("terrain",)
    has_gaps: ClassVar[bool] = True
    touches: ClassVar[bool] = True
    has_limits: ClassVar[bool] = True

    @abc.abstractmethod
    def distance(self, centre: Vector) -> Number:
        """Distance [m] of a point above the ground."""

    @abc.abstractmethod
    def outward(self, centre: Vector) -> Vector:
        """Unit outward normal of the ground below a point."""

    @abc.abstractmethod
    def onset(self, depth: Number) -> Number:
        """Fraction of the damping, from 0 to 1, at a depth relative to `damping_depth`."""

    @abc.abstractmethod
    def pressing(self, spring: Number, damping: Number, load: Number) -> tuple[Number, Number]:
        """The force of damping along the normal that acts, and the load of friction [N].

        **Arguments:** the forces of spring and damper along the normal; the `load` of the normal law at the depth.
        """

    def complete(self, space, poses):
        part, n, d = self.filled(centres=np.zeros(space.dimension)), len(self.bodies), space.dimension
        for field, shapes in {"radius": ((), (n,)), "centres": ((d,), (n, d))}.items():
            shape = getattr(part, field).shape
            if shape not in shapes:
                raise ValueError(f"{self.label}: {field} must have shape {shapes[0]} or {shapes[1]}, got {shape}.")
        place = np.zeros(d - 1, part.centres.dtype)
        check_returns(self.label, "terrain.height", (), self.terrain.height, place)
        return part

    def may_vary(self, keys):
        return keys[0] not in ("radius", "centres")

    def wrenches(self, space, poses, velocities, t):
        return self._each(space, lambda *arguments: self._wrench(space, *arguments), poses, velocities)

    def energy(self, space, poses, t):
        single = lambda pose, point, radius: self.normal.energy(self._depth(space.point(pose, point), radius))
        return jnp.sum(self._each(space, single, poses))

    def gaps(self, space, poses, t):
        return self._each(space, lambda pose, point, radius: self.distance(space.point(pose, point)) - radius, poses)

    @property
    def gap_width(self):
        return self.smoothing

    def gap_pace(self, space, poses, velocities, t):
        def passing(pose, velocity, point, radius):
            del radius
            return pace_over(self.terrain, space.point(pose, point), space.point_velocity(pose, velocity, point))

        turning = super().gap_pace(space, poses, velocities, t)
        return jnp.maximum(turning, jnp.max(self._each(space, passing, poses, velocities)))

    def limit_reached(self, space, poses):
        return edge_near(self.terrain, self._each(space, lambda pose, point, _: space.point(pose, point), poses))

    def shapes(self, space, size):
        n = len(self.bodies)
        radii, centres = np.broadcast_to(self.radius, n), np.broadcast_to(self.centres, (n, space.dimension))
        solids = (round_shapes(space, k, radii[k], centres[k]) for k in range(n))
        return (None, Ground(height=self.terrain.height)), *itertools.chain(*solids)

    def _each(self, space, single, *of_bodies):
        """`single(…, point, radius)` of every body."""
        n = len(self.bodies)
        centres, radii = jnp.broadcast_to(self.centres, (n, space.dimension)), jnp.broadcast_to(self.radius, (n,))
        return jax.vmap(single)(*of_bodies, centres, radii)

    def _depth(self, centre, radius):
        """Depth of the lowest point of a body, smoothed."""
        return ramp(radius - self.distance(centre), self.smoothing)

    def _pressed(self, depth, load, spring, rising):
        """The share of the damping, the force of damping, and the load of friction; from the smoothed depth, the `load`
        of the normal law there, the force of the spring and the velocity along the normal.
        """
        engaged = self.onset(depth / self.damping_depth)
        return engaged, *self.pressing(spring, -self.damping * engaged * rising, load)

    def forces(
        self, *, depth: ArrayLike, rate: ArrayLike = 0.0, slip: ArrayLike = 0.0, travel: ArrayLike = 0.0
    ) -> "ContactForces":
        """The forces of even ground on a body, without a machine: the laws of a motion.

        ```python
        laws = {"normal": jaxmb.contact.Linear(1e5), "friction": jaxmb.contact.Coulomb(0.8, transition_speed=0.01)}
        ground = planar.Contact("ground contact", "wheel", terrain=jaxmb.terrain.Flat(), radius=0.3, **laws)
        forces = ground.forces(depth=np.linspace(0.0, 0.02, 101), slip=0.1)
        forces.normal, forces.friction
        ```

        **Arguments:** numbers or arrays that broadcast. `depth` [m] of the body's lowest point below the ground,
        negative above it, and its `rate` [m/s]; along a line in the ground the `slip` velocity [m/s] of the lowest
        point and the velocity `travel` of its centre, which only `Janosi` asks for.

        **Returns:** `ContactForces`.
        """
        return over_arrays(self.label, _on_even_ground, self, depth=depth, rate=rate, slip=slip, travel=travel)

    def _wrench(self, space, pose, velocity, point, radius):
        centre = space.point(pose, point)
        travel = over_ground(self, centre, space.point_velocity(pose, velocity, point))
        depth, gradient = jax.value_and_grad(self._depth)(centre, radius)
        load, normal = self.normal.force(depth), self.outward(centre)
        spring = -load * gradient
        engaged, damping, load = self._pressed(depth, load, jnp.dot(spring, normal), jnp.dot(travel, normal))
        # A normal force has the same wrench at the centre as at the lowest point.
        wrench = space.point_force(pose, point, spring + damping * normal)
        if self.friction is None:
            return wrench
        lowest = space.body_point(pose, centre - radius * normal)
        along = lambda v: v - jnp.dot(v, normal) * normal
        slip = along(over_ground(self, centre, space.point_velocity(pose, velocity, lowest)))
        friction = self.friction.force(load, engaged, slip, along(travel))
        return wrench + space.point_force(pose, lowest, friction)


class ContactForces(NamedTuple):
    """Forces of the ground on a body.

    **Fields:** `normal` [N], of spring and damping, away from the ground; `friction` [N] along the line of the slip,
    zero without friction.
    """

    normal: Float[Array, "..."]
    friction: Float[Array, "..."]


def _on_even_ground(contact, depth, rate, slip, travel):
    smoothed, slope = jax.value_and_grad(ramp)(depth, contact.smoothing)
    load = contact.normal.force(smoothed)
    spring = load * slope
    engaged, damping, load = contact._pressed(smoothed, load, spring, -rate)
    if contact.friction is None:
        return ContactForces(spring + damping, jnp.zeros_like(spring))
    return ContactForces(spring + damping, contact.friction.force(load, engaged, slip[None], travel[None])[0])


class Contact(AbstractContact):
    """Contact of bodies with one terrain, each as a disc (in the plane), a sphere (in space), or a point.

    ```python
    wheel = planar.Body("wheel", mass=10.0, inertia=planar.disc(10.0, 0.3), position=(0.0, 0.3))
    laws = {"normal": jaxmb.contact.Linear(1e5), "friction": jaxmb.contact.Coulomb(0.8, transition_speed=0.01)}
    ground = planar.Contact("ground contact", "wheel", terrain=jaxmb.terrain.Flat(), radius=0.3, damping=500.0, **laws)
    system = jaxmb.Scene([wheel], forces=[ground, jaxmb.Gravity((0.0, -9.81))]).compile()
    ```

    The penetration depth is smoothed, `δ = ½ (d + √(d² + smoothing²))` for a distance d below the ground, and has a
    potential, the energy of `normal`. The contact also exerts normal damping, with the coefficient
    `damping step(δ / damping_depth)`, and friction at the body's lowest point. While a body separates, damping is at
    most as large as the force of the spring, so that the ground never pulls. The load of friction is the sum of both.

    The distance d is normal to the terrain, exact on even ground and to first order in its curvature; the function
    `step` has two continuous derivatives. `ground.forces(depth=0.01, slip=0.1)` are the forces without a machine.

    **Arguments:**

    - `bodies`: one name or several; all share one terrain, one law and one set of parameters.
    - `terrain`: an `AbstractTerrain`, from `jaxmb.terrain`; fixed in the world, but it rises and sinks if its numbers
        are inputs.
    - `normal`: `Linear`, `Hertz` or `Bekker`; `friction`: `Coulomb`, `Janosi` or None; all from `jaxmb.contact`.
    - `radius` [m] ≥ 0, of shape () or (bodies,), 0 for a point.
    - `centres` [m], body-fixed, shape (d,) or (bodies, d), default the origins of the frames.
    - `damping` [N s/m] ≥ 0, which acts fully from the depth `damping_depth` [m] > 0 on.
    - `smoothing` [m] > 0. Far above the ground a depth of `smoothing² / (4 |d|)` remains.
    """

    def distance(self, centre):
        return distance(self.terrain, centre)

    def outward(self, centre):
        return outward(self.terrain, centre)

    def onset(self, depth):
        return step(depth)

    def pressing(self, spring, damping, load):
        del load
        damping = without_pull(spring, damping)
        return damping, spring + damping
