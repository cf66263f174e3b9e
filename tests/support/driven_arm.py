"""A driven arm whose rate jumps, with a rod on its end."""

import jax.numpy as jnp

import jaxmb as mb
from jaxmb import planar

# A driven arm of length A; on its end a rod with its mass centre at B.
A, B, MASS, INERTIA, G = 0.8, 0.5, 1.5, 0.2, 9.81
BEFORE, AFTER, WHEN, END = 0.4, 2.5, 0.6, 1.1


def turned(t, p):
    """A rate that jumps from `before` to `after`."""
    when = p["when"]
    return jnp.where(t < when, p["before"] * t, p["before"] * when + p["after"] * (t - when))


def driven_arm(*forces):
    bodies = [
        planar.Body("arm", mass=1.0, inertia=0.1, position=(A / 2, 0.0)),
        planar.Body("rod", mass=MASS, inertia=INERTIA, position=(A + B, 0.0)),
    ]
    numbers = {"before": BEFORE, "after": AFTER, "when": WHEN}
    joints = [
        planar.Revolute("pin", "ground", "arm", point=(0.0, 0.0)),
        planar.Revolute("elbow", "arm", "rod", point=(A, 0.0)),
        planar.Driver("drive", "ground", "arm", quantity="angle", motion=turned, parameters=numbers),
    ]
    return mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, -G)), *forces]).compile()
