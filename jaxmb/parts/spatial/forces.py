"""A spatial bushing."""

import jax.numpy as jnp

from .. import fields
from ..base import AbstractSpatialPart
from ..forces import AbstractBushing
from .axes import offset_in_a, rotation_error, with_given_orientation


class Bushing(AbstractSpatialPart, AbstractBushing):
    """A compliant joint: springs and dampers on the six relative motions of a frame in B with respect to one in A.

    ```python
    crate = spatial.Body("crate", mass=3.0, inertia=spatial.box(3.0, 0.4, 0.2, 0.1))
    softness = {"stiffness": (1e4, 1e4, 1e4, 10.0, 10.0, 10.0), "damping": (50.0, 50.0, 50.0, 0.1, 0.1, 0.1)}
    bush = spatial.Bushing("bush", "ground", "crate", point=(0.0, 0.0, -0.05), **softness)
    system = jaxmb.Scene([crate], forces=[bush]).compile()
    ```

    The motions are the position of B's point relative to A's point in the axes of `body_a` (3) [m], and twice the
    vector part of the Euler parameters from `orientation` to the relative attitude, in the axes of `body_b` (3): the
    rotation vector [rad] when small, `2 sin(angle/2)` along the axis of rotation in general, so the moment of an
    isotropic spring is `stiffness sin(angle)`. Both signs of the bodies' Euler parameters give the same wrench and
    energy.

    **Arguments:** `orientation`, shape (4,), unit Euler parameters of B relative to A, default those at the given
    poses.
    """

    orientation: fields.Number = fields.attitude(optional=True)

    def complete(self, space, poses):
        return with_given_orientation(super().complete(space, poses), poses)

    def motions(self, space, poses):
        return jnp.concatenate([offset_in_a(space, self, poses), rotation_error(self, poses)])
