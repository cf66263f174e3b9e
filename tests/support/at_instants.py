"""Quantities of a scene at one instant, and point masses in the plane."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxmb import planar
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.system.quantities import Solved


def instant(system, state, t=0.0):
    """Quantities by name at one state, in the plane and in space."""
    udot, multipliers = accelerations(system.at(state), Multipliers(), t, state.q, state.u)
    along = jnp.full(1, t), jax.tree.map(lambda x: x[None], state), Solved(udot[None], multipliers[None])
    return lambda name: np.asarray(system.quantities()[name].value(*along)[0])


def point(name, mass, *position, **state):
    return planar.PointMass(name, mass=mass, position=position, **state)
