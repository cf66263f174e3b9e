"""Machines whose members are computed in batches and one after the other, with all that a motion can have."""

import sys
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import jaxmb as mb
from jaxmb import planar, terrain

DOWN = mb.Gravity((0.0, -9.81))
FLOOR = {"terrain": terrain.Flat()}


def _times(end: float, count: int = 4) -> Any:
    return jnp.linspace(0.0, end, count)


def _of_library(name: str, mass: str, end: float, **options: Any) -> Callable[[Any], Any]:
    found = mb.mechanisms.get(name)
    return _of(found.system, found.state, mass, end, **options)


def _of(system: Any, state: Any, mass: str, end: float, **options: Any) -> Callable[[Any], Any]:
    """The motion of a machine, of which a mass is multiplied."""
    start = mb.parameters(system)[mass]
    options = {"saveat": _times(end), "rtol": 1e-9, "throw": False} | options
    return lambda share: mb.simulate(mb.with_parameters(system, {mass: share * start}), state, t1=end, **options)


def _scene(body: Any, joints: list[Any], forces: list[Any], end: float, rates: Any = None, **options: Any) -> Any:
    system = mb.Scene([body], joints=joints, forces=forces).compile()
    return _of(system, mb.assemble(system, rates=rates), f"{body.name}.mass", end, **options)


def _by_powers(poses, velocities, t, p):
    """A law of x + x²/2 + x³/3, whose powers are loops of different numbers of turns."""
    x = poses[0, 0]
    power = lambda n: lax.while_loop(lambda c: c[0] < n, lambda c: (c[0] + 1, c[1] * x), (0, 1.0))[1]
    terms = jax.vmap(power)(jnp.arange(1, 4)) / jnp.arange(1.0, 4.0)
    return jnp.stack([-jnp.sum(terms), jnp.zeros(()), jnp.zeros(())])[None]


def powers():
    bob = planar.Body("bob", mass=1.0, inertia=1.0, position=(1.0, 0.0))
    return _scene(bob, [], [mb.Force("law", ["bob"], _by_powers)], 0.5)


def four_bar():
    return _of_library("four_bar", "coupler.mass", 0.4)


def dense():
    found = mb.mechanisms.pendulum()
    moves = _of(found.system, found.state, "bob.mass", 0.5, saveat=diffrax.SaveAt(t1=True, dense=True))

    def at_times(share):
        motion = moves(share)
        return motion.at(jnp.array([0.1, 0.234])).q, motion

    return at_times


def heavy_top():
    return _of_library("heavy_top", "top.mass", 0.1)


def chain():
    found = mb.mechanisms.rod_chain(n=2)
    name = next(name for name in mb.parameters(found.system) if name.endswith(".mass"))
    return _of(found.system, found.state, name, 0.4)


def rolling():
    found = mb.mechanisms.rolling_disc()
    name = next(name for name in mb.parameters(found.system) if name.endswith(".mass"))
    return _of(found.system, found.state, name, 0.2)


def driven():
    """A pendulum on a pin that is moved, under a force of time."""
    bob = planar.Body("bob", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bob", point=(0.0, 0.0))
    push = mb.Force(
        "push", ["bob"], lambda poses, velocities, t, p: jnp.stack([jnp.sin(5 * t), 0.0 * t, 0.0 * t])[None]
    )
    return _scene(bob, [pin], [DOWN, push], 0.5)


def sliding():
    block = planar.Body("block", mass=1.0, inertia=0.1)
    slide = planar.Prismatic("slide", "ground", "block", point=(0.0, 0.0), axis=(1.0, 0.0))
    forces = [
        mb.DryFriction("rub", "slide", coefficient=0.3),
        planar.PointForce("push", "block", force=(5.0, 0.0)),
        DOWN,
    ]
    return _scene(block, [slide], forces, 0.5, {"slide.displacement": 1.0})


def bouncing():
    ball = planar.Body("ball", mass=1.0, inertia=0.004, position=(0.0, 1.0), velocity=(1.0, 0.0))
    floor = mb.RigidContact("floor", "ball", radius=0.1, restitution=0.5, **FLOOR)
    return _scene(ball, [floor], [DOWN, mb.DryFriction("rub", "floor", coefficient=0.2)], 0.6)


def stopped():
    bob = planar.Body("bob", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    joints = [planar.Revolute("pin", "ground", "bob", point=(0.0, 0.0)), mb.Stop("stop", "pin.angle", lower=-0.3)]
    return _scene(bob, joints, [DOWN], 0.6)


MACHINES = {
    f.__name__: f for f in (powers, four_bar, dense, heavy_top, chain, rolling, driven, sliding, bouncing, stopped)
}
# Members of which one fails.
SHARES = np.array([0.8, 0.85, 0.9, 0.95, 1.0, np.nan, 1.1, 1.15, 1.2, 1.3, 1.4])


def outcome(name: str) -> Callable[[Any], Any]:
    """The arrays of a motion by the share of a mass."""
    moves = MACHINES[name]()

    def of(share):
        found = moves(share)
        further, motion = found if isinstance(found, tuple) else ((), found)
        return further, motion.ys.q, motion.ys.u, motion.energy, motion.result == mb.RESULTS.successful

    return of


def differences(name: str) -> tuple[dict[str, float], Any]:
    """The largest relative differences of a batch, and of `vmap`, from members one after the other; and the traced
    program of `vmap`.

    **Raises:** `AssertionError` if another member fails in one of them.
    """
    of = outcome(name)
    one = jax.jit(of)
    alone = jax.tree.map(lambda *x: np.stack(x), *[one(share) for share in SHARES])
    assert list(alone[-1]) == [*np.isfinite(SHARES)], alone[-1]
    traced = jax.jit(jax.vmap(of)).trace(SHARES)
    found = {"mb.batch": mb.batch(of)(SHARES), "jax.vmap": traced.lower().compile()(SHARES)}
    return {way: _largest(x, alone) for way, x in found.items()}, traced


def _largest(found: Any, alone: Any) -> float:
    worst = 0.0
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(alone), strict=True):
        x, y = np.asarray(x, float), np.asarray(y, float)
        np.testing.assert_array_equal(np.isnan(x), np.isnan(y))
        worst = max(worst, float(np.nanmax(np.abs(x - y)) / max(1.0, float(np.nanmax(np.abs(y))))))
    return worst


if __name__ == "__main__":
    # One machine, compiled as the argument says.
    mb.setup(compile=sys.argv[2] if len(sys.argv) > 2 else None, keep=False)
    found, _ = differences(sys.argv[1])
    sys.exit(max(found.values()) > 1e-7)
