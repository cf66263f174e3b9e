"""A four-bar linkage whose design variables are the lengths of crank and coupler."""

import jax.numpy as jnp

import jaxmb as mb

HALF = jnp.array([0.5, 0.0])


def lengths(v):
    """What follows from the lengths of crank and coupler."""
    out = {"A.point_b": -v["crank"] * HALF, "B.point_a": v["crank"] * HALF, "B.point_b": -v["rod"] * HALF}
    return out | {"C.point_a": v["rod"] * HALF, "coupler.inertia": 3.0 * v["rod"] ** 2 / 12}


def designed(mechanism):
    variables = {"rod": mb.Variable(3.0, bounds=(0.1, 9.0), unit="m"), "crank": mb.Variable(1.0, unit="m")}
    return mb.design(mechanism.system, variables, lengths)
