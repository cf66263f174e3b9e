"""A study for `jaxmb sweep`: four-bars with cranks of different lengths; the environment's MEMBERS says how many."""

import os

import jax.numpy as jnp
import numpy as np

import jaxmb as mb

MECHANISM = mb.mechanisms.get("four_bar")


def four_bar(length, t1, max_steps=65536):
    """The angle of the crank at the end of a motion."""
    half = jnp.stack([length / 2, jnp.zeros_like(length)])
    values = {"A.point_b": -half, "B.point_a": half, "crank.inertia": length**2 / 12}
    system = mb.with_parameters(MECHANISM.system, values)
    state = mb.assemble(system, MECHANISM.state, fix=MECHANISM.fix, rates=MECHANISM.rates, throw=False)
    sol = mb.simulate(system, state, t1=t1, rtol=1e-6, throw=False, max_steps=max_steps)
    return {"angle": sol["crank"].angle[-1], "result": sol}


function = four_bar
cases = mb.cases.table(length=np.linspace(0.8, 1.1, int(os.environ.get("MEMBERS", "10000"))), t1=0.5)
units = {"length": "m", "t1": "s", "angle": "rad"}
