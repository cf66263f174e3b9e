"""Trajectories through given states."""

import jax.numpy as jnp

import jaxmb as mb


def motion_of(system, ts, q, u):
    """A trajectory through given states."""
    ys = mb.State(jnp.asarray(q), jnp.asarray(u))
    formulation = mb.formulations.Partitioned()
    return mb.Trajectory(system, formulation, jnp.asarray(ts), ys, {}, mb.RESULTS.successful, None, None)
