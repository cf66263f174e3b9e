"""Spatial bodies, and moments of inertia of common shapes."""

from pathlib import Path
from typing import Any, ClassVar, Literal, Self, get_args

import numpy as np
from jaxtyping import Array, Float

from ...linalg import rotations as rot
from ...linalg.arrays import namespace
from .. import fields
from ..base import AbstractBody, AbstractSpatialPart
from ..fields import as_parameter
from ..shapes import Mesh
from .mesh_solid import MeshSolid

Axis = Literal["x", "y", "z"]


def inertia_matrix(value: Any) -> Array:
    """An inertia matrix from a full matrix or from its diagonal."""
    value = as_parameter(value)
    return namespace(value).diag(value) if value.shape == (3,) else value


class AbstractRigidBody(AbstractSpatialPart, AbstractBody):
    """A spatial rigid body with its initial guess; subclasses define mass and inertia.

    **Arguments:**

    - `name`, of the body.
    - `position` [m], shape (3,), of the origin of the frame, and `orientation`, shape (4,), unit Euler parameters
        (scalar first) from body to world: a guess that `assemble` improves.
    - `velocity` [m/s], shape (3,), of the origin in the world frame, and `angular_velocity` [rad/s], shape (3,), in the
        body frame: a guess as well. `assemble` changes both if joints contradict them, and `assemble(rates=)`
        prescribes either.
    """

    name: str = fields.name()
    position: fields.Number = fields.guess(shape=(3,), unit="m", default=(0.0, 0.0, 0.0))
    orientation: fields.Number = fields.attitude(state=True, default=(1.0, 0.0, 0.0, 0.0))
    velocity: fields.Number = fields.guess(shape=(3,), unit="m/s", default=(0.0, 0.0, 0.0))
    angular_velocity: fields.Number = fields.guess(shape=(3,), unit="rad/s", default=(0.0, 0.0, 0.0))
    rotates: ClassVar[bool] = True

    def pose(self):
        return np.append(self.position, rot.normalize(self.orientation))

    def velocities(self):
        return np.append(self.velocity, self.angular_velocity)

    def validate(self):
        _check_inertia(self)


class Body(AbstractRigidBody):
    """A rigid body with a frame, whose origin is the mass centre unless `centre` is given.

    ```python
    top = spatial.Body("top", mass=1.0, inertia=(0.002, 0.002, 0.003), angular_velocity=(0.0, 0.0, 50.0))
    tilted = jaxmb.rotations.from_axis_angle((1.0, 0.0, 0.0), 0.3)
    leaning = spatial.Body("top", mass=1.0, inertia=(0.002, 0.002, 0.003), orientation=tilted, centre=(0.0, 0.0, 0.1))
    ```

    The points of parts on the body are in its frame; omitted points of force elements are its origin. Functions see the
    pose and the velocity of the frame. The body's coordinates `"name.x"`, its motion `Trajectory["name"]`, and the
    moments in `Trajectory.forces` refer to the mass centre; a `Frame` on the body shows the motion of the origin.

    **Arguments:**

    - `mass` [kg] > 0.
    - `inertia` [kg m²], shape (3, 3), about the mass centre in body axes, symmetric and positive definite (products of
        inertia enter as `−∫ x y dm`); or shape (3,), its diagonal, in principal axes. A gradient by the matrix is not
        symmetric: only the sum of its entries [i, j] and [j, i] has a meaning, as the derivative by both together.
    - `centre` [m], shape (3,), the mass centre in the frame, default its origin. A changed `"name.centre"` moves the
        mass centre; the guess of the frame stays.
    """

    mass: fields.Number = fields.parameter(unit="kg", sign="positive")
    inertia: fields.Number = fields.parameter(
        shape=None, unit="kg m²", sign="positive definite", converter=inertia_matrix
    )
    centre: fields.Number = fields.parameter(shape=("d",), unit="m", optional=True)

    @classmethod
    def from_mesh(cls, name: str, path: str | Path, *, density: float, scale: Any = 1.0, **pose: Any) -> Self:
        """A homogeneous body from a closed surface in a file that trimesh reads, such as STL, OBJ, PLY or GLB.

        ```python
        arm = spatial.Body.from_mesh("arm", "arm.stl", density=2700.0, scale=1e-3)
        hinge = spatial.Revolute("hinge", "ground", "arm", point=(-0.05, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
        system = jaxmb.Scene([arm], joints=[hinge], forces=[jaxmb.Gravity((0.0, 0.0, -9.81))]).compile()
        picture = {"shapes": {"arm": jaxmb.shapes.Mesh.read("arm.stl", scale=1e-3)}}  # For viz.show.
        ```

        The body's frame is the frame of the file, so that points are given in the coordinates of the drawing.

        **Arguments:** `density` [kg/m³] > 0; `scale` [m per unit of the file], 1e-3 for millimetres; `position`,
        `orientation`, `velocity` and `angular_velocity` as of a `Body`.

        **Raises:** `ValueError` for a surface with holes or with triangles that face both ways, and for a file that
        trimesh cannot read; `ImportError` without trimesh, which `jaxmb[view]` installs.
        """
        surface = Mesh.read(path, scale=scale)
        solid = MeshSolid.of(surface.vertices, surface.faces, f"Body {name!r}: {str(path)!r}")
        numbers = {"mass": density * solid.volume, "inertia": density * solid.inertia, "centre": solid.centre}
        return cls(name, **numbers, **pose)

    def pose(self):
        pose = super().pose()
        if self.centre is None:
            return pose
        return pose + np.append(rot.rotate(rot.normalize(self.orientation), self.centre), np.zeros(4))

    def velocities(self):
        velocities = super().velocities()
        if self.centre is None:
            return velocities
        moving = rot.rotate(rot.normalize(self.orientation), rot.cross(self.angular_velocity, self.centre))
        return velocities + np.append(moving, np.zeros(3))


def _check_inertia(body: AbstractRigidBody) -> None:
    inertia = np.asarray(body.inertia)
    if inertia.shape != (3, 3):
        raise ValueError(f"{body.label}: inertia must have shape (3, 3) or (3,), got {inertia.shape}.")
    if not np.all(np.isfinite(inertia)):
        raise ValueError(f"{body.label}: inertia must be finite, got {inertia.tolist()}.")
    if not np.allclose(inertia, inertia.T, rtol=0.0, atol=1e-9 * np.max(np.abs(inertia))):
        raise ValueError(f"{body.label}: inertia must be symmetric, got {inertia.tolist()}; use (J + J.T) / 2.")
    moments = np.linalg.eigvalsh(inertia)
    # Moments this far below the largest come from rounding errors, not from a thin body.
    if moments[0] <= 1e-14 * np.max(np.abs(moments)):
        raise ValueError(
            f"{body.label}: inertia must be positive definite, got principal moments {moments.tolist()} kg m²; a "
            "body without extension across an axis needs some: give a rod its radius, or use PointMass."
        )
    if moments[2] > (moments[0] + moments[1]) * (1 + 1e-9):
        raise ValueError(
            f"{body.label}: inertia violates the triangle inequality: no principal moment may exceed the sum of the "
            f"other two, got {moments.tolist()} kg m²; check that it is about the mass centre, in body axes, with "
            "products of inertia of the right sign."
        )


class PointMass(AbstractSpatialPart, AbstractBody):
    """A mass without extension: three coordinates and no orientation.

    ```python
    bob = spatial.PointMass("bob", mass=0.2, position=(0.0, 0.0, -0.6))
    system = jaxmb.Scene([bob], joints=[spatial.Distance("cord", "ground", "bob")]).compile()
    ```

    **Arguments:** `mass` [kg] > 0; `position` [m] and `velocity` [m/s], shape (3,), a guess that `assemble` improves.
    """

    name: str = fields.name()
    mass: fields.Number = fields.parameter(unit="kg", sign="positive")
    position: fields.Number = fields.guess(shape=(3,), unit="m", default=(0.0, 0.0, 0.0))
    velocity: fields.Number = fields.guess(shape=(3,), unit="m/s", default=(0.0, 0.0, 0.0))
    rotates: ClassVar[bool] = False

    @property
    def inertia(self):
        return np.zeros((3, 3), self.mass.dtype)

    def pose(self):
        return self.position

    def velocities(self):
        return self.velocity


def _axial(along: Any, across: Any, axis: Axis) -> Float[Array, "3 3"]:
    if axis not in get_args(Axis):
        raise ValueError(f"axis must be one of {get_args(Axis)}, got {axis!r}.")
    moments = [as_parameter(across)] * 3
    moments["xyz".index(axis)] = as_parameter(along)
    xp = namespace(*moments)
    return xp.diag(xp.stack(moments))


def rod(mass: float, length: float, axis: Axis = "x", *, radius: float = 0.0) -> Float[Array, "3 3"]:
    """Inertia [kg m²] of a uniform round rod along `axis` about its centre; `m l² / 12` across and zero along for a
    thin one.

    ```python
    spatial.Body("arm", mass=1.0, inertia=spatial.rod(1.0, 1.0, axis="x", radius=0.02))
    ```

    A thin rod has no inertia about its axis and cannot be a `Body`: give it a `radius`.
    """
    return cylinder(mass, radius, length, axis)


def disc(mass: float, radius: float, axis: Axis = "z") -> Float[Array, "3 3"]:
    """Inertia [kg m²] of a thin uniform disc whose axle is `axis`: `m r² / 2` about it, `m r² / 4` about a diameter.

    ```python
    spatial.Body("wheel", mass=2.0, inertia=spatial.disc(2.0, 0.3, axis="y"))
    ```
    """
    return _axial(mass * radius**2 / 2, mass * radius**2 / 4, axis)


def box(mass: float, x: float, y: float, z: float) -> Float[Array, "3 3"]:
    """Inertia [kg m²] of a uniform box with edges of lengths `x`, `y`, `z` [m] along the axes, about its centre.

    ```python
    spatial.Body("crate", mass=3.0, inertia=spatial.box(3.0, 0.4, 0.2, 0.1))
    ```
    """
    x2, y2, z2 = as_parameter(x) ** 2, as_parameter(y) ** 2, as_parameter(z) ** 2
    moments = as_parameter(mass) / 12 * namespace(x2, y2, z2).stack([y2 + z2, z2 + x2, x2 + y2])
    return namespace(moments).diag(moments)


def sphere(mass: float, radius: float) -> Float[Array, "3 3"]:
    """Inertia [kg m²] of a uniform solid sphere about its centre, `2 m r² / 5`.

    ```python
    spatial.Body("ball", mass=1.0, inertia=spatial.sphere(1.0, 0.1))
    ```
    """
    moment = 2 * as_parameter(mass) * as_parameter(radius) ** 2 / 5
    return moment * np.eye(3, dtype=moment.dtype)


def cylinder(mass: float, radius: float, length: float, axis: Axis = "z") -> Float[Array, "3 3"]:
    """Inertia [kg m²] of a uniform solid cylinder along `axis` about its centre: `m r² / 2` along, `m (3 r² + l²) / 12`
    across.

    ```python
    spatial.Body("roller", mass=3.0, inertia=spatial.cylinder(3.0, 0.1, 0.5, axis="y"))
    ```
    """
    return _axial(mass * radius**2 / 2, mass * (3 * radius**2 + length**2) / 12, axis)
