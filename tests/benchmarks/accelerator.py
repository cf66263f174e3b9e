"""Cost of batches on a GPU, over that of a single run on the processor beside it, and how far the two differ.

Run it with `python tests/benchmarks/accelerator.py [mechanism ...]` where JAX finds a GPU, by default for all of
`CASES`; `--sizes 256 4096 65536` of batches, `--gradients` for derivatives as well. The mass of one body differs by up
to 30 % among members. Times are the shortest of three; compiling is shown apart.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb

jax.config.update("jax_enable_x64", True)

SIZES, REPEATS, RTOL = (256, 4096, 65536), 3, 1e-8
# The end of the motion.
CASES = {"four_bar": ({}, 1.0), "rod_chain2": ({"n": 2}, 1.0), "andrews": ({}, 0.05)}


def member_of(name):
    """The run of a member, from the factor of a mass to its end and number of steps."""
    parameters, t1 = CASES[name]
    mechanism = mb.mechanisms.get(name.rstrip("0123456789"), **parameters)
    mass, nominal = next(own for own in mb.parameters(mechanism.system).items() if own[0].endswith(".mass"))

    def member(factor):
        system = mb.with_parameters(mechanism.system, {mass: nominal * factor})
        sol = mb.simulate(system, mechanism.state, t1=t1, rtol=RTOL, throw=False)
        return sol.ys.q[-1], sol.stats["num_accepted_steps"]

    return member


def gradient_of(name):
    """The derivative of the sum of the last coordinates of a member, and its number of steps."""
    member = member_of(name)
    return jax.grad(lambda factor: (lambda q, steps: (jnp.sum(q), steps))(*member(factor)), has_aux=True)


def measured(function, argument):
    """The results, the shortest time of several calls, and the time to compile [s]."""
    begin = time.perf_counter()
    program = jax.jit(function).lower(argument).compile()
    times = [time.perf_counter() - begin]
    for _ in range(REPEATS + 1):
        begin = time.perf_counter()
        found = jax.block_until_ready(program(argument))
        times.append(time.perf_counter() - begin)
    return found, min(times[1:]), times[0]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(CASES))
    parser.add_argument("--sizes", nargs="*", type=int, default=SIZES)
    parser.add_argument("--gradients", action="store_true")
    options = parser.parse_args()
    device, processor = jax.devices()[0], jax.devices("cpu")[0]
    print(f"{device.device_kind}, jax {jax.__version__}; µs are of a step of a member")
    for of in (member_of, gradient_of)[: 1 + options.gradients]:
        for name in options.names:
            function, like = of(name), jax.device_put(jnp.asarray(1.0), processor)
            with jax.default_device(processor):
                (expected, steps), seconds, compiled = measured(function, like)
            what = f"{of.__name__.removesuffix('_of')} of {name}"
            print(
                f"{what:24}{'CPU':>8}{1e6 * seconds / int(steps):10.3f} µs{seconds:9.4f} s, compiled in {compiled:.1f}"
            )
            for size in options.sizes:
                factors = jnp.linspace(0.7, 1.3, size).at[0].set(1.0)
                (found, steps), seconds, compiled = measured(jax.vmap(function), factors)
                off = np.max(np.abs(np.asarray(found[0]) - np.asarray(expected))) / np.max(np.abs(np.asarray(expected)))
                cost = 1e6 * seconds / int(np.sum(np.asarray(steps)))
                print(
                    f"{'':24}{size:8}{cost:10.3f} µs{seconds:9.4f} s, compiled in {compiled:.1f}, differs by {off:.0e}"
                )


if __name__ == "__main__":
    main()
