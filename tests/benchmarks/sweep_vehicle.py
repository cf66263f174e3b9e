"""A study for `jaxmb sweep`: tracked vehicles, height of the bump × speed × stiffness of the torsion bars."""

import os

import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb import State, terrain

END = 0.5
TS = np.linspace(0.0, END, 26)
MECHANISM = mb.mechanisms.tracked_vehicle(speed=5.0, terrain=terrain.Bump(start=1.9, length=1.5, peak=0.12))
NAMES = [f"bar{k}.stiffness" for k in range(1, 6)]


def function(height, speed, stiffness, max_steps=20000):
    """The hull over a bump: its height and pitch, and how far it rises."""
    values = {"road.terrain.peak": height, **dict.fromkeys(NAMES, stiffness)}
    system = mb.with_parameters(MECHANISM.system, values)
    # Forward at another speed, with wheels that roll.
    start = State(MECHANISM.state.q, MECHANISM.state.u * speed / 5.0)
    sol = mb.simulate(system, start, t1=END, saveat=TS, rtol=1e-5, throw=False, max_steps=max_steps)
    hull = sol["hull"]
    rise = jnp.max(hull.position[:, 1]) - hull.position[0, 1]
    return {"height_of_hull": hull.position[:, 1], "pitch": hull.angle, "rise": rise, "result": sol}


_SIDE = max(round((int(os.environ.get("MEMBERS", "2000")) / 20) ** 0.5), 1)
cases = mb.cases.grid(
    height=np.linspace(0.02, 0.15, _SIDE), speed=np.linspace(3.0, 8.0, 20), stiffness=np.linspace(3e4, 8e4, _SIDE)
)
dims = {"height_of_hull": ["time"], "pitch": ["time"]}
coords = {"time": TS}
units = {"height": "m", "speed": "m/s", "stiffness": "N m/rad", "time": "s", "pitch": "rad", "height_of_hull": "m"}
