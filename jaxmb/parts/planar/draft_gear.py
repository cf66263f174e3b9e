"""Couplers between the vehicles of a train."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ...linalg.rotations import norm
from .. import fields
from ..base import AbstractPlanarPart, AbstractPointPair, AbstractPotentialForce, PathKind
from ..kinks import clipped
from ..smooth import quintic, sign
from ..space import force_pair, separation, separation_rate


class DraftGear(AbstractPlanarPart, AbstractPointPair, AbstractPotentialForce):
    r"""A friction draft gear: slack, then a preloaded spring with dry friction, then a solid stop; in both directions.

    ```python
    cars = [planar.Body(name, mass=2e4, inertia=1e5, position=(x, 0.0)) for name, x in (("front", 0), ("rear", -15))]
    gear = planar.DraftGear("gear", "rear", "front", slack=0.02, point_a=(7.0, 0.0), point_b=(-7.0, 0.0))
    system = jaxmb.Scene(cars, forces=[gear]).compile()
    ```

    The force acts along the line between the two points. With the extension `s` (length less `free_length`, negative
    in buff), the stroke is `x = s − slack` in draft and `x = −s − slack` in buff, and the force against it is

    $$(S_0\,p(x) + k\,r(x))\,(\frac{1 + \eta}{2} + \frac{1 - \eta}{2} \tanh\frac{\dot x}{v_0})
      + k_s\,r(x - x_\text{max}) + c\,p(x)\,\dot x$$

    A loading gear follows the spring, an unloading one η times the spring: a cycle to the stroke δ dissipates
    `(1 − η)(½ k δ² + S₀ δ)`. The ramp r is x⁺ and the step p its derivative, except for |x| < `smoothing`/2, where
    polynomials give the ramp three continuous derivatives. Without slack, preload and friction the force is exactly
    `k s`. Friction and damping always dissipate; strong damping may exceed the spring of a gear that unloads fast.

    At zero length the direction is undefined and the force is taken as zero; `free_length` should exceed slack and
    stroke.

    **Arguments:**

    - `stiffness` k [N/m] ≥ 0 when loading; `unloading` η, between 0 and 1, the fraction of the force that remains when
        unloading.
    - `preload` S₀ [N] ≥ 0; `slack` [m] ≥ 0, to either side.
    - `travel` x_max [m] > 0, the stroke at which the stop is reached, and its `stop_stiffness` k_s [N/m] ≥ 0.
    - `damping` c [N s/m] ≥ 0, acting outside the slack.
    - `transition_speed` v₀ [m/s] > 0, the speed at which 76 % of the friction acts; `smoothing` [m] > 0. The smaller
        they are, the shorter the time steps.
    - `free_length` [m], default the length at the given poses.
    """

    stiffness: fields.Number = fields.parameter(unit="N/m", sign="non-negative", default=1e7)
    unloading: fields.Number = fields.parameter(unit="1", sign="non-negative", default=0.4)
    preload: fields.Number = fields.parameter(unit="N", sign="non-negative", default=5e4)
    slack: fields.Number = fields.parameter(unit="m", sign="non-negative", default=0.02)
    travel: fields.Number = fields.parameter(unit="m", sign="positive", default=0.11)
    stop_stiffness: fields.Number = fields.parameter(unit="N/m", sign="non-negative", default=1e8)
    damping: fields.Number = fields.parameter(unit="N s/m", sign="non-negative", default=0.0)
    transition_speed: fields.Number = fields.parameter(unit="m/s", sign="positive", default=0.01)
    smoothing: fields.Number = fields.parameter(unit="m", sign="positive", default=0.005)
    free_length: fields.Number = fields.parameter(unit="m", sign="non-negative", optional=True)
    path_kind: ClassVar[PathKind] = "coil"
    has_gaps: ClassVar[bool] = True

    def validate(self):
        if self.unloading > 1:
            raise ValueError(
                f"{self.label}: unloading is the fraction of the force that remains, at most 1, got {self.unloading}; "
                "a larger value would create energy."
            )

    def numbers_agree(self):
        return self.unloading <= 1

    def complete(self, space, poses):
        return self if self.free_length is not None else self.filled(free_length=norm(separation(space, self, poses)))

    def tension(self, extension: Float[Array, "..."], rate: Float[Array, "..."]) -> Float[Array, "..."]:
        """The force [N], positive in draft, at an extension [m] and its rate [m/s]."""
        return self._against(extension - self.slack, rate) - self._against(-extension - self.slack, -rate)

    def stored(self, extension: Float[Array, "..."]) -> Float[Array, "..."]:
        """Energy [J] of the springs, from the mean of loading and unloading force; friction only dissipates."""
        return self._stored(extension - self.slack) + self._stored(-extension - self.slack)

    def wrenches(self, space, poses, velocities, t):
        d, rate = separation(space, self, poses), separation_rate(space, self, poses, velocities)
        square = jnp.dot(d, d)
        apart = square > 0
        length = jnp.sqrt(jnp.where(apart, square, 1.0))
        tension = self.tension(length - self.free_length, jnp.dot(d, rate) / length)
        return force_pair(space, self, poses, -jnp.where(apart, tension / length, 0.0) * d)

    def energy(self, space, poses, t):
        return self.stored(norm(separation(space, self, poses)) - self.free_length)

    def gaps(self, space, poses, t):
        extension = norm(separation(space, self, poses)) - self.free_length
        strokes = jnp.stack([extension - self.slack, -extension - self.slack])
        # The ramps begin half their width before zero.
        return -jnp.concatenate([strokes, strokes - self.travel]) - 0.5 * self.smoothing

    def _against(self, stroke, rate):
        engaged, ramp, _ = self._engaged(stroke)
        spring = self.preload * engaged + self.stiffness * ramp
        friction = 0.5 * (1 + self.unloading) + 0.5 * (1 - self.unloading) * sign(rate, self.transition_speed)
        _, stop, _ = self._engaged(stroke - self.travel)
        return spring * friction + self.stop_stiffness * stop + self.damping * engaged * rate

    def _stored(self, stroke):
        _, ramp, area = self._engaged(stroke)
        _, _, stop = self._engaged(stroke - self.travel)
        return 0.5 * (1 + self.unloading) * (self.preload * ramp + self.stiffness * area) + self.stop_stiffness * stop

    def _engaged(self, x):
        """A smooth step from 0 to 1 over the width `smoothing`, and its first and second integral."""
        width = self.smoothing
        z = clipped(x / width + 0.5, 0.0, 1.0)
        beyond = jnp.where(x > 0.5 * width, x - 0.5 * width, 0.0)
        ramp = z**4 * (2.5 + z * (z - 3))
        area = z**5 * (0.5 + z * (z / 7 - 0.5))
        # With x = width/2 + beyond: the ramp is x, its integral x²/2 + width²/56.
        return quintic(z), width * ramp + beyond, width**2 * area + beyond * (0.5 * width + 0.5 * beyond)
