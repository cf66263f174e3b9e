"""Curves of a suspension over wheel travel and steering."""

from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..._pictured import picture
from ..._printed import Printed
from ...linalg.arrays import is_traced

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The largest number of lines in a table.
_MOST = 21


class KinematicsAndCompliance(Printed, eqx.Module):
    """Curves of a suspension, from `kinematics_and_compliance`; `print` shows a table.

    ```python
    wishbone = jaxmb.mechanisms.double_wishbone().system
    curves = jaxmb.kinematics_and_compliance(wishbone, "upright", radius=0.32, travel=np.linspace(-0.08, 0.08, 9))
    curves.toe, curves.bump_steer, curves.motion_ratio["spring"], curves.compliance["lateral_force"]["toe"]
    curves.plot("toe", "camber").savefig("toe.png")
    ```

    All arrays have the shape of `travel`, followed by the shape of `steer` if it steers. Axes: x forward, y to the
    left, z up.

    **Fields:**

    - `travel` [m] of the wheel's centre, upward; `steer`: displacements of the steering [m, rad], or None.
    - `toe` [rad], front inward; `camber` [rad], top outward; `bump_steer` and `bump_camber` [rad/m], their derivatives
        by travel.
    - `track` and `wheelbase` [m]: displacements of the contact patch from the guess, outward and forward.
    - `roll_centre` [m]: its height above the ground, where the other wheel is the mirror image in the plane y = 0.
    - `motion_ratio` by the names of springs: shortening of the spring per wheel travel [1].
    - `caster` [rad], top rearward, and `kingpin_inclination` [rad], top inward; `scrub_radius` and `caster_trail` [m],
        from the steering axis to the contact patch on the ground, outward and rearward. None without steering. The
        steering axis is the instantaneous screw axis of the carrier while a spring keeps its length. Of several springs
        it is the spring with which the carrier turns most nearly without a shift along the axis; without springs that
        travel moves, it turns without a shift. Where joints hold two points of the carrier, as two ball joints do, the
        axis goes through both, whatever springs there are.
    - `compliance["lateral_force"]["toe"]` [rad/N]: derivatives of `toe`, `camber`, `track` and `wheelbase` by a load on
        the wheel at the contact patch. Loads are "longitudinal_force" [N] along x, "lateral_force" [N] along y and
        "aligning_moment" [N m] about z, with the axle locked. Zero if the constraints determine the position.
    - `q`: coordinates of the positions, followed by an axis of shape (nq,).
    - `freedoms`: the number of freedoms in static equilibrium; 0 if the constraints determine the position.
    """

    travel: Float[Array, "*travel"]
    steer: Float[Array, "*steer"] | None
    toe: Float[Array, "*grid"]
    camber: Float[Array, "*grid"]
    bump_steer: Float[Array, "*grid"]
    bump_camber: Float[Array, "*grid"]
    track: Float[Array, "*grid"]
    wheelbase: Float[Array, "*grid"]
    roll_centre: Float[Array, "*grid"]
    motion_ratio: dict[str, Float[Array, "*grid"]]
    caster: Float[Array, "*grid"] | None
    kingpin_inclination: Float[Array, "*grid"] | None
    scrub_radius: Float[Array, "*grid"] | None
    caster_trail: Float[Array, "*grid"] | None
    compliance: dict[str, dict[str, Float[Array, "*grid"]]]
    q: Float[Array, "*grid nq"]
    freedoms: int = eqx.field(static=True)

    def plot(self, *names: str) -> "Figure":
        """Plot curves over the travel, which points upward, one for each of at most five steers.

        **Arguments:** `names` of the fields to show, such as `"toe"` and `"caster"`; default toe, camber, the
        way of the contact patch, the roll centre and the motion ratios.

        **Returns:** a matplotlib `Figure`, in degrees and millimetres.

        **Raises:** `ValueError` for unknown names, and for a single position; `ImportError` without matplotlib.
        """
        return picture("suspension.plot", self, names)

    def __str__(self) -> str:
        how = f"static equilibria in {self.freedoms} freedoms" if self.freedoms else "kinematics"
        if is_traced((self.travel, self.toe)) or not self.toe.size:
            return f"Suspension, {how}, on a grid of shape {self.toe.shape}"
        middle = () if self.steer is None or not self.steer.ndim else (int(np.argmin(np.abs(self.steer))),)
        at = lambda x: np.atleast_1d(np.asarray(x)[(..., *middle)])
        mm, degrees, one = 1e3, 180 / np.pi, 1.0
        columns = {
            "travel [mm]": (np.atleast_1d(self.travel), mm),
            "toe [°]": (at(self.toe), degrees),
            "camber [°]": (at(self.camber), degrees),
            "track [mm]": (at(self.track), mm),
            "wheelbase [mm]": (at(self.wheelbase), mm),
            "roll centre [mm]": (at(self.roll_centre), mm),
        } | {f"ratio {name}": (at(ratio), one) for name, ratio in self.motion_ratio.items()}
        if self.caster is not None and self.kingpin_inclination is not None:
            columns |= {"caster [°]": (at(self.caster), degrees)}
            columns |= {"kingpin [°]": (at(self.kingpin_inclination), degrees)}
        if self.freedoms:
            columns |= {
                "toe/Fx [°/kN]": (at(self.compliance["longitudinal_force"]["toe"]), 1e3 * degrees),
                "toe/Fy [°/kN]": (at(self.compliance["lateral_force"]["toe"]), 1e3 * degrees),
                "camber/Fy [°/kN]": (at(self.compliance["lateral_force"]["camber"]), 1e3 * degrees),
                "toe/Mz [°/kN m]": (at(self.compliance["aligning_moment"]["toe"]), 1e3 * degrees),
            }
        count = columns["travel [mm]"][0].size
        shown = np.unique(np.round(np.linspace(0, count - 1, min(count, _MOST))).astype(int))
        lines = [list(columns), *([f"{x[k] * unit:.4g}" for x, unit in columns.values()] for k in shown)]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        table = ["  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines]
        steered = "" if not middle else f", at steer {float(np.asarray(self.steer)[middle]):.4g}"
        return "\n".join([f"Suspension, {how}{steered}", *table])
