"""A tyre on a wheel that rolls in space."""

import jax.numpy as jnp

from ...linalg.rotations import cross, norm
from .. import fields
from ..base import AbstractSpatialPart
from ..tyre import AbstractTyre


class Tyre(AbstractSpatialPart, AbstractTyre):
    """A tyre with longitudinal and lateral slip and relaxation, on a thin wheel.

    ```python
    wheel = spatial.Body("wheel", mass=10.0, inertia=spatial.disc(10.0, 0.3, axis="y"), position=(0.0, 0.0, 0.3))
    ground = {"terrain": jaxmb.terrain.Flat(), "normal": jaxmb.contact.Linear(2e5)}
    grip = {"coefficient": 0.9, "slip_stiffness": (15.0, 12.0), "relaxation_length": (0.2, 0.4)}
    system = jaxmb.Scene([wheel], forces=[spatial.Tyre("tyre", "wheel", radius=0.3, **ground, **grip)]).compile()
    ```

    The tread deflects in both directions as `ḋ = −v_s − (V/σ) d`, with the slip velocity v_s of the wheel's lowest
    point and the rolling speed `V = √(v² + transition_speed²)` of its centre, so that in steady rolling the slips `d/σ`
    are `−v_s/V`, the lateral one the tangent of the slip angle. With `s = c d/(σ μ)`, the force on the wheel at its
    lowest point is `μ N tanh(|s|) s/|s|`, with the load N: `c N d/σ` for small slips, and friction for large ones. The
    wheel's inclination only moves the contact; there are no aligning torque and no rolling resistance.

    **Arguments:** `axis`, unit, shape (3,), the axle fixed in the body, pointing to the left of a wheel that rolls
    forwards. The wheel must not lie flat.
    """

    axis: fields.Number = fields.axis(body=0, default=(0.0, 1.0, 0.0))

    def axle(self, space):
        return self.axis

    def lowest(self, space, pose, normal_W):
        axle = space.direction(pose, self.axis)
        up = cross(axle, cross(normal_W, axle))
        return -self.radius * up / norm(up)

    def directions(self, space, pose, normal_W):
        forwards = cross(space.direction(pose, self.axis), normal_W)
        forwards = forwards / norm(forwards)
        return jnp.stack([forwards, cross(normal_W, forwards)])
