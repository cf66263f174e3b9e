"""A skate on an incline."""

import jax.numpy as jnp
import numpy as np

from .. import planar
from ..bodies.scene import Scene
from ..parts.forces import Gravity
from .mechanism import Mechanism, References, build, mechanism
from .observe import columns


@mechanism()
def knife_edge(
    *,
    mass: float = 1.0,
    inertia: float = 0.1,
    incline: float = np.pi / 6,
    spin: float = 2.0,
    gravity: float = 9.81,
) -> Mechanism:
    """A blade on an inclined plane, turning steadily about the plane's normal: it slides not down but sideways, on a
    cycloid. x points down the incline, y along the contour.

    Source: Ju. I. Neimark and N. A. Fufaev, "Dynamics of Nonholonomic Systems", AMS 1972, ch. II. The reference values
    are the closed form `x = a sin² ωt`, `y = a (ωt − ½ sin 2ωt)`, `a = g sin α / 2ω²`.

    **Arguments:** `mass` [kg] and `inertia` [kg m²] about its contact point, its mass centre; `incline` α [rad]; `spin`
    ω [rad/s]; `gravity` [m/s²].

    **Labels:** `x`, `y` [m]; `phi` [rad], heading from x, from zero; `v` [m/s] along the blade.
    """
    skate = planar.Body("skate", mass=mass, inertia=inertia)
    blade = planar.KnifeEdge("blade", "skate")
    return build(
        "knife_edge",
        Scene([skate], joints=[blade], forces=[Gravity((gravity * np.sin(incline), 0.0))]),
        t1=5.0,
        observe=_observe,
        description="A knife edge on an incline, which drifts sideways on a cycloid.",
        references=References.load("knife_edge"),
        rates={"skate.angle": spin},
    )


def _observe(trajectory):
    skate = trajectory["skate"]
    c, s = jnp.cos(skate.angle), jnp.sin(skate.angle)
    speed = c * skate.velocity[:, 0] + s * skate.velocity[:, 1]
    return columns("xy", skate.position) | {"phi": skate.angle, "v": speed}
