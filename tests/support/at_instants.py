"""Quantities of a scene at a few instants by one program, and point masses in the plane."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxmb import planar
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.system.quantities import Solved

FIELDS = ("acceleration", "angular_acceleration", "length", "wrap", "tension")


@functools.partial(jax.jit, static_argnames="names")
def _along(system, ys, names):
    ts = jnp.zeros(len(ys.q))
    solved = Solved(*jax.vmap(lambda t, y: accelerations(system, Multipliers(), t, y.q, y.u))(ts, ys))
    return {name: system.quantities()[name].value(ts, ys, solved) for name in names}


def instants(system, *states):
    """Accelerations of bodies, and what ropes have, at the states, by name."""
    ys = jax.tree.map(lambda *x: np.stack(x), *states)
    names = sorted(name for name in system.quantities() if name.rsplit(".", 1)[-1] in FIELDS)
    values = {name: np.asarray(value) for name, value in _along(system, ys, tuple(names)).items()}
    return values.__getitem__


def point(name, mass, *position, **state):
    return planar.PointMass(name, mass=mass, position=position, **state)
