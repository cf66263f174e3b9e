"""Planar bodies, and moments of inertia of common shapes."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from ...linalg.rotations import rotate_2d
from .. import fields
from ..base import AbstractBody, AbstractPlanarPart


class AbstractRigidBody(AbstractPlanarPart, AbstractBody):
    """A planar rigid body with its initial guess; subclasses define mass and inertia.

    **Arguments:**

    - `name`, of the body.
    - `position` [m], shape (2,), of the origin of the frame, and `angle` [rad]: a guess that `assemble` improves.
    - `velocity` [m/s], shape (2,), of the origin, and `angular_velocity` [rad/s]: a guess as well. `assemble` changes
        both if joints contradict them, and `assemble(rates=)` prescribes either.
    """

    name: str = fields.name()
    position: fields.Number = fields.guess(shape=(2,), unit="m", default=(0.0, 0.0))
    angle: fields.Number = fields.guess(unit="rad", default=0.0)
    velocity: fields.Number = fields.guess(shape=(2,), unit="m/s", default=(0.0, 0.0))
    angular_velocity: fields.Number = fields.guess(unit="rad/s", default=0.0)
    rotates: ClassVar[bool] = True

    def pose(self):
        return np.append(self.position, self.angle)

    def velocities(self):
        return np.append(self.velocity, self.angular_velocity)


class Body(AbstractRigidBody):
    """A rigid body with a frame, whose origin is the mass centre unless `centre` is given.

    ```python
    bar = planar.Body("bar", mass=1.0, inertia=planar.rod(1.0, 1.0), position=(0.5, 0.0), angular_velocity=2.0)
    from_its_end = planar.Body("bar", mass=1.0, inertia=planar.rod(1.0, 1.0), centre=(0.5, 0.0))
    ```

    The points of parts on the body are in its frame; omitted points of force elements are its origin. Functions see the
    pose and the velocity of the frame. The body's coordinates `"name.x"`, its motion `Trajectory["name"]`, and the
    moments in `Trajectory.forces` refer to the mass centre; a `Frame` on the body shows the motion of the origin.

    **Arguments:** `mass` [kg] > 0; `inertia` [kg m²] > 0 about the mass centre; `centre` [m], shape (2,), the mass
    centre in the frame, default its origin. A changed `"name.centre"` moves the mass centre; the guess of the frame
    stays.
    """

    mass: fields.Number = fields.parameter(unit="kg", sign="positive")
    inertia: fields.Number = fields.parameter(unit="kg m²", sign="positive")
    centre: fields.Number = fields.parameter(shape=("d",), unit="m", optional=True)

    def pose(self):
        pose = super().pose()
        if self.centre is None:
            return pose
        return pose + np.append(rotate_2d(self.angle, self.centre), 0.0)

    def velocities(self):
        velocities = super().velocities()
        if self.centre is None:
            return velocities
        arm = np.asarray(rotate_2d(self.angle, self.centre))
        return velocities + self.angular_velocity * np.array([-arm[1], arm[0], 0.0])


class PointMass(AbstractPlanarPart, AbstractBody):
    """A mass without extension: two coordinates and no angle.

    ```python
    bob = planar.PointMass("bob", mass=0.2, position=(0.6, 0.0))
    system = jaxmb.Scene([bob], joints=[planar.Distance("cord", "ground", "bob")]).compile()
    ```

    **Arguments:** `mass` [kg] > 0; `position` [m] and `velocity` [m/s], shape (2,), a guess that `assemble` improves.
    """

    name: str = fields.name()
    mass: fields.Number = fields.parameter(unit="kg", sign="positive")
    position: fields.Number = fields.guess(shape=(2,), unit="m", default=(0.0, 0.0))
    velocity: fields.Number = fields.guess(shape=(2,), unit="m/s", default=(0.0, 0.0))
    rotates: ClassVar[bool] = False

    @property
    def inertia(self):
        return jnp.zeros_like(self.mass)

    def pose(self):
        return self.position

    def velocities(self):
        return self.velocity


def rod(mass: float, length: float) -> float:
    """Moment of inertia [kg m²] of a thin uniform rod about its centre, `m l² / 12`.

    ```python
    planar.Body("bar", mass=1.0, inertia=planar.rod(1.0, 1.0))
    ```
    """
    return mass * length**2 / 12


def disc(mass: float, radius: float) -> float:
    """Moment of inertia [kg m²] of a uniform disc about its axis, `m r² / 2`.

    ```python
    planar.Body("wheel", mass=2.0, inertia=planar.disc(2.0, 0.3))
    ```
    """
    return mass * radius**2 / 2


def box(mass: float, width: float, height: float) -> float:
    """Moment of inertia [kg m²] of a uniform rectangle about its centre, `m (w² + h²) / 12`.

    ```python
    planar.Body("plate", mass=3.0, inertia=planar.box(3.0, 0.4, 0.2))
    ```
    """
    return mass * (width**2 + height**2) / 12
