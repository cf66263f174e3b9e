"""A tyre on a wheel that rolls in the plane."""

import jax.numpy as jnp

from ..base import AbstractPlanarPart
from ..tyre import AbstractTyre


class Tyre(AbstractPlanarPart, AbstractTyre):
    """A tyre with longitudinal slip and relaxation.

    ```python
    wheel = planar.Body("wheel", mass=10.0, inertia=planar.disc(10.0, 0.3), position=(0.0, 0.3), velocity=(5.0, 0.0))
    ground = {"terrain": jaxmb.terrain.Flat(), "normal": jaxmb.contact.Linear(2e5)}
    grip = {"coefficient": 0.9, "slip_stiffness": 15.0, "relaxation_length": 0.2}
    system = jaxmb.Scene([wheel], forces=[planar.Tyre("tyre", "wheel", radius=0.3, **ground, **grip)]).compile()
    ```

    The tread deflects as `ḋ = −v_s − (V/σ) d`, with the slip velocity v_s of the wheel's lowest point and the rolling
    speed `V = √(v² + transition_speed²)` of its centre, so that in steady rolling the slip `d/σ` is `−v_s/V`. The force
    on the wheel at its lowest point is `μ N tanh(c |d| / (σ μ))` in the direction of d, with the load N: `c N d/σ` for
    small slips, and friction for large ones. It has no rolling resistance.
    """

    def axle(self, space):
        return jnp.array([0.0, 0.0, 1.0])

    def lowest(self, space, pose, normal_W):
        return -self.radius * normal_W

    def directions(self, space, pose, normal_W):
        return jnp.stack([normal_W[1], -normal_W[0]])[None]
