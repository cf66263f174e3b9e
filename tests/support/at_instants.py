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
    values = {name: system.quantities()[name].value(ts, ys, solved) for name in names}
    broken = jax.vmap(system.position_residual)(ts, ys.q), jax.vmap(system.velocity_residual)(ts, ys.q, ys.u)
    return values, broken, jax.vmap(system.potential_energy)(ts, ys.q)


def instants(system, *states):
    """Accelerations of bodies and what ropes have at the states, by name; what is left of the constraints there; and
    the potential energies.
    """
    ys = jax.tree.map(lambda *x: np.stack(x), *states)
    names = sorted(name for name in system.quantities() if name.rsplit(".", 1)[-1] in FIELDS)
    values, broken, energies = _along(system, ys, tuple(names))
    values = {name: np.asarray(value) for name, value in values.items()}
    return values.__getitem__, np.concatenate(broken, axis=1), np.asarray(energies)


def point(name, mass, *position, **state):
    return planar.PointMass(name, mass=mass, position=position, **state)
