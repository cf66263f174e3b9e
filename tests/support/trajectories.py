"""Trajectories through given states."""

import dataclasses

import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb import planar, terrain
from jaxmb.contacts.events import FoundEvents


def motion_of(system, ts, q, u, z=None):
    """A trajectory through given states."""
    ys = mb.State(jnp.asarray(q), jnp.asarray(u), z)
    formulation = mb.formulations.Partitioned()
    return mb.Trajectory(system, formulation, jnp.asarray(ts), ys, {}, mb.RESULTS.successful, None, None)


def bounced():
    """A ball that falls for a second, meets the floor, and rises to a quarter of the height; its only event."""
    system = mb.Scene(
        [planar.Body("ball", mass=1.0, inertia=0.1, position=(0.0, 5.0))],
        joints=[mb.RigidContact("floor", "ball", terrain=terrain.Flat(), restitution=0.5)],
        forces=[mb.Gravity((0.0, -10.0))],
    ).compile()
    t = np.linspace(0.0, 1.5, 16)
    after = np.maximum(t - 1.0, 0.0)
    height = np.where(t <= 1.0, 5.0 - 5.0 * t**2, 5.0 * after - 5.0 * after**2)
    speed = np.where(t <= 1.0, -10.0 * t, 5.0 - 10.0 * after)
    still = 0.0 * t
    motion = motion_of(
        system,
        t,
        np.stack([still, height, still, still], axis=1),
        np.stack([still, speed, still, still], axis=1),
    )
    before = jnp.array([[0.0, 0.0, 0.0, 0.0, 0.0, -10.0, 0.0, 0.0]])
    found = FoundEvents(jnp.array(1), jnp.array([1.0]), before, jnp.array(1e-9))
    return dataclasses.replace(motion, found_events=found)
