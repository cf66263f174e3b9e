"""A skate on an incline."""

import jax.numpy as jnp
import numpy as np

from .. import planar
from ..parts.forces import Gravity
from ..scene import Scene
from .mechanism import Mechanism, References, build, mechanism


@mechanism()
def knife_edge(
    *,
    mass: float = 1.0,
    inertia: float = 0.1,
    incline: float = np.pi / 6,
    spin: float = 2.0,
    gravity: float = 9.81,
) -> Mechanism:
    """A blade on an inclined plane, turning steadily about the plane's normal: it does not slide down but to the side,
    on a cycloid. x points down the incline, y along the contour.

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
        references=_REFERENCES,
        rates={"skate.angle": spin},
    )


def _observe(trajectory):
    skate = trajectory["skate"]
    c, s = jnp.cos(skate.angle), jnp.sin(skate.angle)
    return {
        "x": skate.position[:, 0],
        "y": skate.position[:, 1],
        "phi": skate.angle,
        "v": c * skate.velocity[:, 0] + s * skate.velocity[:, 1],
    }


_REFERENCES = References(
    times=np.array([1.0, 2.0, 5.0]),
    labels=("x", "y", "phi", "v"),
    values=np.array(
        [
            [0.5069451225210011, 1.458257264967837, 2.0, 2.2300519392899845],
            [0.3511673541144531, 2.1491998625195197, 4.0, -1.8560581197426942],
            [0.18145984292533202, 5.851375221573812, 10.0, -1.3342117744561794],
        ]
    ),
    source="the cycloid in closed form",
    tolerance=1e-14,
)
