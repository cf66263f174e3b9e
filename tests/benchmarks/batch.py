"""A batch of four-bars with different cranks: `jax.vmap` over all of them against a loop, warm and in one process.

Run it with `python tests/benchmarks/batch.py`.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb

jax.config.update("jax_enable_x64", True)

MEMBERS = 256
REPEATS = 5
RTOL = 1e-8


MECHANISM = mb.mechanisms.get("four_bar")


def crank_angle(length, rtol):
    """Angle of the crank after two seconds, and the number of steps."""
    half = jnp.stack([length / 2, jnp.zeros_like(length)])
    values = {"A.point_b": -half, "B.point_a": half, "crank.inertia": length**2 / 12}
    system = mb.with_parameters(MECHANISM.system, values)
    state = mb.assemble(system, MECHANISM.state, fix=MECHANISM.fix, rates=MECHANISM.rates, throw=False)
    sol = mb.simulate(system, state, t1=2.0, rtol=rtol, throw=False)
    return sol["crank"].angle[-1], sol.stats["num_steps"]


def main():
    lengths = jnp.linspace(0.8, 1.1, MEMBERS)
    together, single = jax.jit(jax.vmap(crank_angle, (0, None))), jax.jit(crank_angle)
    loop = lambda rtol: [single(length, rtol) for length in lengths]
    batch = lambda rtol: together(lengths, rtol)
    for rtol in (1e-12, RTOL):
        (angles, steps), singles = jax.block_until_ready((batch(rtol), loop(rtol)))
        difference = np.max(np.abs(angles - np.array([a for a, _ in singles])))
        print(f"largest difference at a tolerance of {rtol:.0e}: {difference:.1e}")
    print(f"steps of one: {np.mean(steps):.0f} on average, {np.max(steps)} at most")
    best = {"loop": np.inf, "batch": np.inf}
    for _ in range(REPEATS):
        for name, run in (("loop", loop), ("batch", batch)):
            start = time.perf_counter()
            jax.block_until_ready(run(RTOL))
            best[name] = min(best[name], time.perf_counter() - start)
    per_step = {"loop": best["loop"] / np.sum(steps), "batch": best["batch"] / np.max(steps)}
    print(f"loop  {1e3 * best['loop']:8.1f} ms, {1e6 * per_step['loop']:6.2f} µs a step")
    print(f"batch {1e3 * best['batch']:8.1f} ms, {1e6 * per_step['batch']:6.1f} µs a step of all")
    print(f"ratio {best['loop'] / best['batch']:.2f}")


if __name__ == "__main__":
    main()
