"""Elastic beams between two bodies, in the plane and in space."""

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..linalg import rotations as rot
from ..linalg.arrays import namespace
from . import fields
from .base import AbstractConstraint, AbstractPointPair, AbstractPotentialForce, PathKind
from .forces import generalized_force
from .planar.joints import relative_angle
from .sections import AbstractSection
from .space import both_points, rate_of, separation
from .spatial.axes import offset_in_a, relative_orientation, shortest_turn


class AbstractBeam(AbstractPointPair):
    """A beam from A to B, deformed uniformly along its length. A rigid section is fixed in each body, with x along the
    beam.

    **Arguments:**

    - `section`: a section of `jaxmb.sections`, with its stiffnesses.
    - `damping_time` τ [s] ≥ 0, default zero: the stresses are those of the strains plus τ times their rates (Kelvin and
        Voigt).
    - `length` [m] > 0 along the beam, default the distance of A and B at the given poses.
    - `angle_a`, `angle_b` [rad], in the plane: the directions of the sections' x axes in `body_a` and in `body_b`;
        default from A to B at the given poses.
    - `orientation_a`, `orientation_b`, in space, shape (4,), unit Euler parameters from the axes of the sections to the
        axes of `body_a` and `body_b`. By default the shortest turn at the given poses leads x of `body_a`, and x of
        section A, to the direction from A to B.
    - `free_strain` Γ₀ [1], shape (2,) or (3,), and `free_curvature` κ₀ [1/m], a number in the plane and shape (3,) in
        space: strains without a force; default from the given poses. A straight beam has (1, 0, 0) and zero.
    """

    section: AbstractSection = fields.law(AbstractSection, what="a section, such as jaxmb.sections.Rectangle(...)")
    damping_time: fields.Number = fields.parameter(unit="s", sign="non-negative", default=0.0)
    length: fields.Number = fields.length(sign="positive", optional=True)
    angle_a: fields.Number = fields.parameter(unit="rad", optional=True, dimension=2)
    angle_b: fields.Number = fields.parameter(unit="rad", optional=True, dimension=2)
    orientation_a: fields.Number = fields.attitude(optional=True)
    orientation_b: fields.Number = fields.attitude(optional=True)
    free_strain: fields.Number = fields.parameter(shape=("d",), unit="1", optional=True)
    free_curvature: fields.Number = fields.parameter(shape=None, unit="1/m", optional=True)
    moving: ClassVar[tuple[str, ...]] = (
        *("length", "angle_a", "angle_b", "orientation_a", "orientation_b", "free_strain", "free_curvature"),
    )
    path_kind: ClassVar[PathKind] = "bar"
    # Whether stretch and shear store energy.
    extends: ClassVar[bool]

    def complete(self, space, poses):
        d, along = space.dimension, separation(space, self, poses)
        distance = rot.norm(along)
        if not distance > 0:
            raise ValueError(f"{self.label}: its points coincide at the given poses; move one.")
        if missing := self.section.missing(d, extends=self.extends):
            raise ValueError(f"{self.label}: {missing}.")
        shape = () if d == 2 else (3,)
        if self.free_curvature is not None and self.free_curvature.shape != shape:
            raise ValueError(f"{self.label}: free_curvature must have shape {shape}, got {self.free_curvature.shape}.")
        part = self.filled(length=distance, **self._sections(space, poses, along))
        strain, curvature = part.strains(space, poses)
        return part.filled(free_strain=strain, free_curvature=curvature)

    def _sections(self, space, poses, along) -> dict[str, Any]:
        """The directions or attitudes of the sections along the line from A to B."""
        if space.dimension == 2:
            angle = namespace(along).arctan2(along[1], along[0])
            return {"angle_a": angle - poses[0, 2], "angle_b": angle - poses[1, 2]}
        start = self.orientation_a
        x = np.eye(3)[0] if start is None else rot.rotate(start, np.eye(3)[0])
        turn = shortest_turn(x, space.body_direction(poses[0], along))
        in_a = turn if start is None else rot.multiply(turn, start)
        in_b = rot.multiply(rot.conjugate(relative_orientation(poses)), in_a)
        return {"orientation_a": in_a, "orientation_b": rot.normalize(in_b)}

    def strains(self, space: Any, poses: Float[Array, "2 p"]) -> tuple[Float[Array, "d"], Array]:
        """Γ [1], the vector from A to B over the length in the axes of the middle section, and κ [1/m], the rotation
        vector from section A to section B over the length.
        """
        if space.dimension == 2:
            start = poses[0, 2] + self.angle_a
            turn = relative_angle(poses) + self.angle_b - self.angle_a
            return rot.rotate_2d(-start - turn / 2, separation(space, self, poses)) / self.length, turn / self.length
        turn = rot.multiply(rot.conjugate(self.orientation_a), relative_orientation(poses))
        turn = rot.multiply(turn, self.orientation_b)
        in_a = rot.unrotate(self.orientation_a, offset_in_a(space, self, poses))
        half = rot.half_turn(turn)
        return rot.unrotate(half, in_a) / self.length, rot.doubled(half) / self.length

    def path(self, space, poses):
        # The cubic curve along the sections' x axes.
        a, b = both_points(space, self, poses)
        along = np.eye(space.dimension)[0]
        if space.dimension == 2:
            in_bodies = [rot.rotate_2d(angle, along) for angle in (self.angle_a, self.angle_b)]
        else:
            in_bodies = [rot.rotate(turn, along) for turn in (self.orientation_a, self.orientation_b)]
        ends = [space.direction(x, axis) for x, axis in zip(poses, in_bodies, strict=True)]
        chord, s = b - a, np.linspace(0.0, 1.0, 9)
        start, end = (rot.norm(chord) * axis - chord for axis in ends)
        return a[None] + jnp.outer(s, chord) + jnp.outer(s * (1 - s) ** 2, start) - jnp.outer(s**2 * (1 - s), end)

    def deformations(self, space: Any, poses: Float[Array, "2 p"]) -> tuple[Float[Array, "d"], Array]:
        """The strains less those without a force."""
        strain, curvature = self.strains(space, poses)
        return strain - self.free_strain, curvature - self.free_curvature


class AbstractElasticBeam(AbstractBeam, AbstractPotentialForce):
    """The stresses of a beam, in the axes of the middle section: forces [N] and moments [N m] on the section with x
    outward, thus a tension is positive.
    """

    def _stored(self, space, poses):
        """The deformations that store energy."""
        strain, curvature = self.deformations(space, poses)
        return jnp.append(strain, curvature) if self.extends else jnp.reshape(curvature, -1)

    def _stiffness(self, space):
        bending = self.section.bending(space.dimension)
        if not self.extends:
            return bending
        extension = self.section.extension(space.dimension)
        # A shear force bends the beam between its middle and its ends. Shear along y bends about z, along z about y.
        compliance = 1 / extension[1:] + self.length**2 / (12 * bending[::-1][: space.dimension - 1])
        return jnp.concatenate([extension[:1], 1 / compliance, bending])

    def _stress(self, space):
        stiffness = self._stiffness(space)
        return lambda strain, rate: stiffness * (strain + self.damping_time * rate)

    def wrenches(self, space, poses, velocities, t):
        law, stored = self._stress(space), lambda part, x: part._stored(space, x)
        return generalized_force(space, self, stored, poses, velocities, lambda x, v: -self.length * law(x, v))

    def energy(self, space, poses, t):
        return 0.5 * self.length * jnp.sum(self._stiffness(space) * self._stored(space, poses) ** 2)

    def observables(self, space, poses, velocities, t):
        d = space.dimension
        strain, curvature = self.strains(space, poses)
        stress = self._stress(space)(*rate_of(space, self, lambda part, x: part._stored(space, x), poses, velocities))
        moment = stress[d:] if self.extends else stress
        moments = {"curvature": curvature, "section_moment": moment.reshape(curvature.shape)}
        return {"strain": strain, "section_force": stress[:d]} | moments if self.extends else moments


class Beam(AbstractElasticBeam):
    """An elastic beam: a geometrically exact element with one point of integration, exact for small deflections. It
    resists extension, shear, bending and torsion, for any rotation of its bodies.

    ```python
    strip = jaxmb.sections.Rectangle(thickness=2e-3, width=0.02, modulus=2.1e11, poisson_ratio=0.3)
    tip = planar.Body("tip", mass=0.1, inertia=1e-5, position=(0.2, 0.0))
    blade = planar.Beam("blade", "ground", "tip", section=strip, damping_time=1e-4)
    system = jaxmb.Scene([tip], forces=[blade, jaxmb.Gravity((0.0, -9.81))]).compile()
    motion = jaxmb.simulate(system, jaxmb.assemble(system), t1=0.01)
    motion["blade"].section_moment, motion["blade"].curvature
    ```

    Its energy is `length / 2` times the sum of `stiffness (strain − free strain)²`, over the strains Γ (extension and
    shear) and κ (torsion and bending). In the stiffness k of shear, `1 / k = 1 / (G A) + length² / (12 E I)`, so that a
    beam of any length has the small deflections of Timoshenko's beam with loads at its ends. It has no mass; the bodies
    have it. For large deflections its error falls with the square of its length: `beam_chain` makes a chain of beams.
    In space the sections turn relative to each other by less than half a turn; the moment jumps there.

    Along a motion it has `strain` Γ and `curvature` κ [1/m], and in the axes of its middle section `section_force` [N]
    (tension, shear forces) and `section_moment` [N m] (torsion and bending; in the plane a number).

    Sources: J. C. Simo, "A finite strain beam formulation. The three-dimensional dynamic problem. Part I", Comput.
    Methods Appl. Mech. Eng. 49, 1985; R. H. MacNeal, "A simple quadrilateral shell element", Comput. Struct. 8, 1978
    (residual bending flexibility).
    """

    extends: ClassVar[bool] = True


class BeamBending(AbstractElasticBeam):
    """Bending and torsion of an inextensible beam."""

    extends: ClassVar[bool] = False


class InextensibleBeam(AbstractBeam, AbstractConstraint):
    """A beam that bends and twists, and neither stretches nor shears. Rows 2 in the plane, 3 in space: `length (Γ₀ − Γ)
    = 0`.

    ```python
    wire = jaxmb.sections.Section(bending_stiffness=0.5)
    tip = planar.Body("tip", mass=0.1, inertia=1e-5, position=(0.2, 0.0))
    blade = planar.InextensibleBeam("blade", "ground", "tip", section=wire)
    system = jaxmb.Scene([tip], joints=[blade], forces=[jaxmb.Gravity((0.0, -9.81))]).compile()
    motion = jaxmb.simulate(system, jaxmb.assemble(system), t1=0.01)
    motion["blade"].section_moment, motion.reactions["blade"].multipliers
    ```

    It stands among the joints of a scene, and is else like `Beam`, of which it is the limit for a thin beam without the
    fast vibrations of its length. Its multipliers are the tension and the shear forces [N] in the axes of the middle
    section. It has no coordinates.
    """

    rheonomic: ClassVar[bool] = False
    extends: ClassVar[bool] = False

    @property
    def rows(self):
        # A row for each direction; stacked beams have a leading axis.
        return self.free_strain.shape[-1]

    def residual(self, space, poses, t):
        return -self.length * self.deformations(space, poses)[0]

    def components(self):
        values = fields.values_of(self)
        return self, BeamBending(**{field.name: values[field.name] for field in dataclasses.fields(self) if field.init})
