"""Elastic bodies of space."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .. import fields
from ..elastic import AbstractElasticBar, AbstractElasticBody
from .bodies import AbstractRigidBody


class ElasticBody(AbstractElasticBody, AbstractRigidBody):
    """An elastic body, from integrals of its modes or, by `from_nodes`, from a finite element model.

    ```python
    # Four springs join the corners of a tetrahedron of point masses to each other.
    nodes = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    stiffness = np.zeros((4, 3, 4, 3))
    for i, j in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)):
        way = (nodes[j] - nodes[i]) / np.linalg.norm(nodes[j] - nodes[i])
        for a, b in ((i, i), (j, j), (i, j), (j, i)):
            stiffness[a, :, b] += (1.0 if a == b else -1.0) * 1e4 * np.outer(way, way)
    model = {"nodes": nodes, "mass": np.full(4, 0.5), "stiffness": stiffness.reshape(12, 12)}
    body, (base,) = spatial.ElasticBody.from_nodes("body", model, interfaces={"base": [0, 1, 2]}, fixed=3)
    system = jaxmb.Scene([body], frames=[base]).compile()
    ```

    The body's frame, of which `position` is the origin, need not be at the mass centre. Modal coordinates are
    coordinates of the scene, `"body.mode_1"`, with zeros as their guess. A `ModalFrame` moves with them.
    """


class ElasticBar(AbstractElasticBar, AbstractRigidBody):
    """A uniform elastic bar, which bends along y and z of its frame.

    ```python
    section = {"width": 0.03, "thickness": 0.01}
    rod = spatial.ElasticBar("rod", length=1.0, young=2e11, density=7800.0, poisson=0.3, torsion=1, **section)
    tip = spatial.BarFrame("tip", "rod")
    clamp = spatial.Fixed("clamp", "ground", "rod", point=(0.0, 0.0, 0.0))
    system = jaxmb.Scene([rod], joints=[clamp], frames=[tip]).compile()
    state = jaxmb.assemble(system, fix={"rod.bend_y_1": 0.01, "rod.twist_1": 0.1})
    ```

    The section turns by torsion about the centre line, without warping inertia; the twist is small.

    **Arguments:**

    - `thickness` along y and `width` along z; or, with `area`, `section_moments` [m⁴], ∫ y² and ∫ z² over the
        section, and `torsion_constant` [m⁴], all > 0.
    - `poisson`: Poisson's ratio, default 0.3, for torsion.
    - `bending`: the number of modes along each of y and z, in `"rod.bend_y_1"`, `"rod.bend_z_1"`; `torsion`: of those
        about x, default 0, in `"rod.twist_1"`, the turn [rad] of the other end.
    """

    section_moments: fields.Number = fields.parameter(shape=(2,), unit="m^4", sign="positive", optional=True)
    torsion_constant: fields.Number = fields.parameter(unit="m^4", sign="positive", optional=True)
    poisson: fields.Number = fields.parameter(unit="1", default=0.3)
    torsion: int = eqx.field(static=True, kw_only=True, default=0)
    of_section: ClassVar[tuple[str, ...]] = ("area", "section_moments", "torsion_constant")
    bends: ClassVar[tuple[str, ...]] = ("bend_y", "bend_z")
    turns: ClassVar[np.ndarray] = np.array([[0.0, 0.0], [0.0, -1.0], [1.0, 0.0]])

    def second_moments(self):
        if self.section_moments is not None:
            return self.section_moments
        return self.sectional_area / 12 * jnp.stack([self.thickness**2, self.width**2])

    def torsional_rigidity(self):
        constant = self.torsion_constant
        if constant is None:
            constant = _torsion_constant(self.width, self.thickness)
        return self.young / (2 * (1 + self.poisson)) * constant

    def validate(self):
        super().validate()
        if not -1 < self.poisson <= 0.5:
            raise ValueError(f"{self.label}: poisson must be from -1 to 0.5, got {self.poisson}.")


def _torsion_constant(width, thickness):
    """Saint-Venant's constant of a rectangle [m⁴]. Source: S. P. Timoshenko, J. N. Goodier, "Theory of Elasticity",
    McGraw-Hill, chapter on torsion.
    """
    long, short = jnp.maximum(width, thickness), jnp.minimum(width, thickness)
    odd = np.array([1.0, 3.0, 5.0, 7.0])
    # The series of tanh / n⁵, whose later terms are those of 1 / n⁵ to rounding.
    total = jnp.sum((jnp.tanh(odd * np.pi * long / (2 * short)) - 1) / odd**5) + _ODD_FIFTHS
    return long * short**3 * (1 / 3 - 64 / np.pi**5 * short / long * total)


# The sum of 1 / n⁵ over all odd n, 31/32 ζ(5).
_ODD_FIFTHS = 1.0045237627951384
