"""Cross-sections of beams: stiffnesses as numbers, or of a shape and a material.

```python
from jaxmb import sections
steel = {"modulus": 2.1e11, "poisson_ratio": 0.3}
strip, wire = sections.Rectangle(thickness=1e-3, width=0.02, **steel), sections.Circle(radius=1e-3, **steel)
profile = sections.Section(bending_stiffness=(40.0, 90.0), torsional_stiffness=30.0)
blade = spatial.Beam("blade", "ground", "tip", section=strip)
tip = spatial.Body("tip", mass=0.1, inertia=spatial.sphere(0.1, 0.02), position=(0.2, 0.0, 0.0))
system = jaxmb.Scene([tip], forces=[blade]).compile()
thicker = jaxmb.with_parameters(system, {"blade.section.thickness": 2e-3})
```

The axes of a section are x along the beam, and y and z, the principal axes through its centre. A planar beam bends in
its plane of x and y.
"""

import abc
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from ..linalg.arrays import namespace
from . import fields
from .base import AbstractLaw

__all__ = ["AbstractSection", "Circle", "Rectangle", "Section"]

# Σ 1/n⁵ over odd n, and the first n; the next term of the differences is below rounding.
_ODD_SUM, _ODD = 1.0045237627951396, np.arange(1.0, 11.0, 2.0)


class AbstractSection(AbstractLaw):
    """A cross-section of a beam; its numbers are parameters, `"blade.section.thickness"`."""

    @abc.abstractmethod
    def extension(self, dimension: int) -> Float[Array, "d"]:
        """The stiffnesses [N] against extension along x, and against shear along the other axes."""

    @abc.abstractmethod
    def bending(self, dimension: int) -> Float[Array, "r"]:
        """The stiffness [N m²] against bending in the plane; in space against torsion, and bending about y and z."""

    def missing(self, dimension: int, *, extends: bool) -> str:
        """Hook: a sentence about numbers that a beam needs and the section has not; empty if it has all.

        **Arguments:** `extends`: whether the beam has stiffnesses against extension and shear.
        """
        del dimension, extends
        return ""


class Section(AbstractSection):
    """A section given by its stiffnesses.

    **Arguments:**

    - `bending_stiffness` E I [N m²] > 0: in the plane a number; in space the two about y and z, or one for both.
    - `torsional_stiffness` G J [N m²] > 0, for spatial beams.
    - `axial_stiffness` E A [N] > 0, and `shear_stiffness` k G A [N] > 0, in space the two along y and z or one for
        both; an `InextensibleBeam` needs neither.
    """

    bending_stiffness: fields.Number = fields.parameter(shape=None, unit="N m²", sign="positive")
    torsional_stiffness: fields.Number = fields.parameter(unit="N m²", sign="positive", optional=True)
    axial_stiffness: fields.Number = fields.parameter(unit="N", sign="positive", optional=True)
    shear_stiffness: fields.Number = fields.parameter(shape=None, unit="N", sign="positive", optional=True)

    def extension(self, dimension):
        xp = namespace(self.axial_stiffness, self.shear_stiffness)
        return xp.append(self.axial_stiffness, xp.broadcast_to(self.shear_stiffness, (dimension - 1,)))

    def bending(self, dimension):
        if dimension == 2:
            return self.bending_stiffness[None]
        xp = namespace(self.torsional_stiffness, self.bending_stiffness)
        return xp.append(self.torsional_stiffness, xp.broadcast_to(self.bending_stiffness, (2,)))

    def missing(self, dimension, *, extends):
        if dimension == 3 and self.torsional_stiffness is None:
            return "its section has no torsional_stiffness"
        if extends and (self.axial_stiffness is None or self.shear_stiffness is None):
            return "its section lacks axial_stiffness or shear_stiffness; give both, or take an InextensibleBeam"
        shapes = {"bending_stiffness": self.bending_stiffness, "shear_stiffness": self.shear_stiffness}
        for name, value in shapes.items():
            if value is not None and value.shape not in ((), (2,) if dimension == 3 else ()):
                return f"section.{name} must be one number{' or two' if dimension == 3 else ''}, got {value.tolist()}"
        return ""


class AbstractSolid(AbstractSection):
    """A section of one material.

    **Arguments:**

    - `modulus` E [Pa] > 0, and `poisson_ratio` ν, so that the shear modulus is `G = E / (2 + 2 ν)`.
    """

    modulus: fields.Number = fields.parameter(unit="Pa", sign="positive")
    poisson_ratio: fields.Number = fields.parameter(unit="1")

    @property
    @abc.abstractmethod
    def area(self) -> Float[Array, ""]:
        """The area A [m²]."""

    @property
    @abc.abstractmethod
    def shear_factor(self) -> Float[Array, ""]:
        """The share k of the area that bears shear."""

    @property
    @abc.abstractmethod
    def second_moments(self) -> Float[Array, "3"]:
        """The torsion constant J, and the second moments of area about y and z [m⁴]."""

    @property
    def _shear_modulus(self):
        return self.modulus / (2 + 2 * self.poisson_ratio)

    def extension(self, dimension):
        shear = self.shear_factor * self._shear_modulus
        return namespace(shear).stack([self.modulus, *[shear] * (dimension - 1)]) * self.area

    def bending(self, dimension):
        if dimension == 2:
            return self.modulus * self.second_moments[2:]
        shear = self._shear_modulus
        return namespace(shear).stack([shear, self.modulus, self.modulus]) * self.second_moments


class Rectangle(AbstractSolid):
    """A rectangle.

    **Arguments:** `thickness` [m] > 0 along y; `width` [m] > 0 along z.

    Source: of torsion, S. P. Timoshenko and J. N. Goodier, "Theory of Elasticity", McGraw-Hill 1951, section 94 (Saint-
    Venant); of shear, G. R. Cowper, "The Shear Coefficient in Timoshenko's Beam Theory", J. Appl. Mech. 33, 1966.
    """

    thickness: fields.Number = fields.parameter(unit="m", sign="positive")
    width: fields.Number = fields.parameter(unit="m", sign="positive")

    @property
    def area(self):
        return self.thickness * self.width

    @property
    def shear_factor(self):
        return 10 * (1 + self.poisson_ratio) / (12 + 11 * self.poisson_ratio)

    @property
    def second_moments(self):
        y, z = self.thickness, self.width
        xp: Any = namespace(y, z)
        short, long = xp.minimum(y, z), xp.maximum(y, z)
        # Saint-Venant's series of hyperbolic tangents, by their fast decaying differences from one.
        decay = xp.exp(-np.pi * _ODD * long / short)
        sums = _ODD_SUM - xp.sum(2 * decay / (1 + decay) / _ODD**5)
        torsion = long * short**3 * (1 / 3 - 64 / np.pi**5 * short / long * sums)
        return xp.stack([torsion, y * z**3 / 12, z * y**3 / 12])


class Circle(AbstractSolid):
    """A full circle.

    **Arguments:** `radius` [m] > 0.

    Source: of shear, G. R. Cowper, "The Shear Coefficient in Timoshenko's Beam Theory", J. Appl. Mech. 33, 1966.
    """

    radius: fields.Number = fields.parameter(unit="m", sign="positive")

    @property
    def area(self):
        return np.pi * self.radius**2

    @property
    def shear_factor(self):
        return 6 * (1 + self.poisson_ratio) / (7 + 6 * self.poisson_ratio)

    @property
    def second_moments(self):
        return np.pi * self.radius**4 * np.array([1 / 2, 1 / 4, 1 / 4])
