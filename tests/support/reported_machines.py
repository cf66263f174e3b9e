"""A machine for reports and scripts that compare variants of it."""

import equinox as eqx
import jax.numpy as jnp

import jaxmb as mb
from jaxmb import planar


def pendulum():
    """A rod on a pin, with a torsion spring: the system and a state."""
    rod = planar.Body("rod", mass=2.0, inertia=0.3, position=(0.5, 0.0), angular_velocity=1.0)
    pin = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    spring = planar.TorsionalSpringDamper("spring", "ground", "rod", stiffness=3.0)
    system = mb.Scene([rod], joints=[pin], forces=[mb.Gravity((0.0, -9.81)), spring]).compile()
    return system, mb.assemble(system, rates={"rod.angle": 1.0})


@eqx.filter_jit
def udot(system, y):
    """Accelerations at t = 0."""
    return mb.formulations.accelerations(system, mb.formulations.Multipliers(), jnp.zeros(()), y.q, y.u)[0]
