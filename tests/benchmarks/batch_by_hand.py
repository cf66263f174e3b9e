"""A batch of four-bar linkages beside their equations written by hand under `jax.vmap`, at equal error.

    python tests/benchmarks/batch_by_hand.py [members]

Members differ in the mass of the coupler. The equation by hand is of the crank's angle, with closed expressions for
the rates of the other bars; diffrax integrates it with `Dopri8` and `Tsit5`. Each row has the time of a member, its
steps, and the largest error of the crank's angle after ten seconds. One core, one thread, one process.
"""

import os
import sys
import time

# One core, and one thread of XLA, before JAX starts.
os.environ["NPROC"] = "1"
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb

T1, GRAVITY, BASE = 10.0, 9.81, 2.5
LENGTHS, MASSES = (1.0, 3.0, 2.5), (1.0, 3.0, 2.5)
REPEATS = 5


def field(t, y, mass):
    """Rates of the three angles and of the crank's rate, for a mass of the coupler with unchanged inertia."""
    a, b, c = LENGTHS
    sines, cosines, rate = jnp.sin(y[:3]), jnp.cos(y[:3]), y[3]
    (s1, s2, s3), (c1, c2, c3) = sines, cosines
    # Rates of coupler and rocker for unit rate of the crank, from the derivative of the closed loop.
    det = s3 * c2 - c3 * s2
    ratios = jnp.stack([jnp.ones_like(rate), a * (s1 * c3 - c1 * s3) / (b * det), a * (s1 * c2 - c1 * s2) / (c * det)])
    rates = ratios * rate
    # Accelerations without acceleration of the crank, from its second derivative.
    x = a * c1 * rates[0] ** 2 + b * c2 * rates[1] ** 2 - c * c3 * rates[2] ** 2
    z = a * s1 * rates[0] ** 2 + b * s2 * rates[1] ** 2 - c * s3 * rates[2] ** 2
    coupler = (c3 * x + s3 * z) / (b * det)
    rocker = (s2 * z + c2 * x) / (c * det)
    # The centre of the coupler: velocity for unit rate of the crank, and acceleration.
    vx, vy = -a * s1 - 0.5 * b * s2 * ratios[1], a * c1 + 0.5 * b * c2 * ratios[1]
    ax = -a * c1 * rates[0] ** 2 - 0.5 * b * (c2 * rates[1] ** 2 + s2 * coupler)
    ay = -a * s1 * rates[0] ** 2 - 0.5 * b * (s2 * rates[1] ** 2 - c2 * coupler)
    of_crank, of_coupler, of_rocker = MASSES[0] * a**2 / 3, MASSES[1] * b**2 / 12, MASSES[2] * c**2 / 3
    inertia = of_crank + mass * (vx**2 + vy**2) + of_coupler * ratios[1] ** 2 + of_rocker * ratios[2] ** 2
    force = mass * (vx * ax + vy * (ay + GRAVITY)) + of_coupler * ratios[1] * coupler + of_rocker * ratios[2] * rocker
    force = force + 0.5 * GRAVITY * (MASSES[0] * a * c1 + MASSES[2] * c * c3 * ratios[2])
    return jnp.append(rates, -force / inertia)


def by_hand(start, solver, rtol):
    """The crank's angle at the end and the number of steps, for factors of the coupler's mass."""

    def run(factor):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            solver,
            0.0,
            T1,
            None,
            start,
            args=MASSES[1] * factor,
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=1e-2 * rtol),
            max_steps=100_000,
        )
        return solution.ys[-1, 0], solution.stats["num_steps"]

    return jax.jit(jax.vmap(run))


def of_package(mechanism, rtol):
    """The same by `jaxmb.batch`."""

    def run(factor):
        system = mb.with_parameters(mechanism.system, {"coupler.mass": MASSES[1] * factor})
        motion = mb.simulate(system, mechanism.state, t1=T1, rtol=rtol)
        return motion["crank"].angle[-1], motion.stats["num_steps"]

    return mb.batch(run)


def main():
    members = int(sys.argv[1]) if len(sys.argv) > 1 else 256
    mb.setup(compile="for batches", keep=False)
    mechanism = mb.mechanisms.four_bar(lengths=LENGTHS, masses=MASSES, base=BASE, gravity=GRAVITY)
    at_start = mb.simulate(mechanism.system, mechanism.state, t1=1e-6, saveat=[0.0])
    angles = [at_start[name].angle[0] for name in ("crank", "coupler", "rocker")]
    start = jnp.stack([*angles, at_start["crank"].angular_velocity[0]])
    factors = jnp.linspace(0.95, 1.05, members)
    exact = by_hand(start, diffrax.Dopri8(), 1e-13)(factors)[0]
    ways = {f"jaxmb {rtol:.0e}": of_package(mechanism, rtol) for rtol in (1e-6, 1e-7, 1e-8, 1e-9)}
    ways |= {f"Dopri8 {rtol:.0e}": by_hand(start, diffrax.Dopri8(), rtol) for rtol in (1e-7, 1e-8, 1e-9)}
    ways |= {f"Tsit5 {rtol:.0e}": by_hand(start, diffrax.Tsit5(), rtol) for rtol in (1e-8, 1e-9)}
    print(f"{'':14}{'ms a member':>12}{'steps':>8}{'error':>10}")
    for name, run in ways.items():
        jax.block_until_ready(run(factors))
        shortest = np.inf
        for _ in range(REPEATS):
            began = time.perf_counter()
            angle, steps = jax.block_until_ready(run(factors))
            shortest = min(shortest, time.perf_counter() - began)
        error = float(jnp.max(jnp.abs(angle - exact)))
        print(f"{name:14}{1e3 * shortest / members:12.3f}{float(jnp.mean(steps)):8.0f}{error:10.1e}", flush=True)


if __name__ == "__main__":
    main()
