"""Elastic bodies of the plane."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from .. import fields
from ..elastic import AbstractElasticBar, AbstractElasticBody
from .bodies import AbstractRigidBody


class ElasticBody(AbstractElasticBody, AbstractRigidBody):
    """An elastic body, from integrals of its modes or, by `from_nodes`, from a finite element model.

    ```python
    # A bob of 0.3 kg at (1, 0) m, which moves across a light arm; the mode moves it by one.
    rocker = planar.ElasticBody(
        "rocker",
        mass=1.3,
        first_moment=(0.3, 0.0),
        second_moment=((0.4, 0.0), (0.0, 0.1)),
        modal_moments=((0.0, 0.3),),
        mixed_moments=(((0.0, 0.3), (0.0, 0.0)),),
        modal_products=((((0.0, 0.0), (0.0, 0.3)),),),
        stiffness=((500.0,),),
        names=("bend",),
    )
    system = jaxmb.Scene([rocker]).compile()
    ```

    The body's frame, of which `position` is the origin, need not be at the mass centre. Modal coordinates are
    coordinates of the scene, `"rocker.bend"`, with zeros as their guess. A `ModalFrame` moves with them.
    """


class ElasticBar(AbstractElasticBar, AbstractRigidBody):
    """A uniform elastic bar.

    ```python
    rod = planar.ElasticBar("rod", length=1.0, young=2e11, density=7800.0, width=0.02, thickness=0.01, bending=3)
    tip = planar.BarFrame("tip", "rod")
    clamp = planar.Fixed("clamp", "ground", "rod", point=(0.0, 0.0))
    system = jaxmb.Scene([rod], joints=[clamp], frames=[tip]).compile()
    state = jaxmb.assemble(system, fix={"rod.bend_1": 0.01})
    ```

    **Arguments:** `second_moment` [m⁴] > 0, ∫ y² over the section, with `area`. The `thickness` is in the plane.
    """

    second_moment: fields.Number = fields.parameter(unit="m^4", sign="positive", optional=True)
    of_section: ClassVar[tuple[str, ...]] = ("area", "second_moment")
    bends: ClassVar[tuple[str, ...]] = ("bend",)
    turns: ClassVar[np.ndarray] = np.array([[1.0]])

    def second_moments(self):
        rectangle = self.second_moment is None
        return jnp.reshape(self.width * self.thickness**3 / 12 if rectangle else self.second_moment, (1,))

    def torsional_rigidity(self):
        return 0.0
