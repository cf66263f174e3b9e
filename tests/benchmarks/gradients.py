"""What gradients of stiff motions take: warm run times of `jax.grad` over those of the motion, in one process.

Run it with `python tests/benchmarks/gradients.py`. All runs are of `Hermite`, with the adjoint that diffrax recommends
for reverse mode; a parameter or all rates of a problem are scaled, and the gradient is with respect to that.
"""

import sys
import time
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from stiff_problems import PROBLEMS, solve

import jaxmb as mb
from jaxmb.solvers import Hermite

jax.config.update("jax_enable_x64", True)

REPEATS = 9
MAX_STEPS = 4096
# Of mechanisms: the parameter, the end of the motion, and the tolerance.
MECHANISMS = (
    ("stiff_four_bar", "D.stiffness", 0.1, 1e-7),
    ("stiff_four_bar", "D.stiffness", 1.0, 1e-4),
    ("flyball", "spring1.stiffness", 10.0, 1e-9),
)
ADJOINT = diffrax.RecursiveCheckpointAdjoint()


def problem_end(name: str, rtol: float):
    """The sum of the states at the end, of the logarithm of a scale of all arguments of an equation."""
    problem = PROBLEMS[name]

    def end(x):
        args = jax.tree.map(lambda a: jnp.asarray(a) * jnp.exp(x), problem.args)
        return jnp.sum(solve(problem, rtol, args=args, adjoint=ADJOINT, max_steps=MAX_STEPS).ys[-1])

    return end


def mechanism_end(name: str, parameter: str, t1: float, rtol: float):
    """The sum of the coordinates at the end, of the logarithm of a scale of a parameter."""
    mechanism = mb.mechanisms.get(name)
    value = mb.parameters(mechanism.system)[parameter]

    def end(x):
        system = mb.with_parameters(mechanism.system, {parameter: value * jnp.exp(x)})
        options = {"solver": Hermite(), "adjoint": ADJOINT, "max_steps": MAX_STEPS}
        return jnp.sum(mb.simulate(system, mechanism.state, t1=t1, rtol=rtol, **options).ys.q[-1])

    return end


def main():
    cases = [(f"{name}, rtol 1e-08", problem_end(name, 1e-8)) for name in ("van der Pol 1e3", "Robertson")]
    cases += [
        (f"{name}, {t1:g} s, rtol {rtol:.0e}", mechanism_end(name, *rest, t1, rtol))
        for name, *rest, t1, rtol in MECHANISMS
    ]
    for name, end in cases:
        best = []
        for run in (jax.jit(end), jax.jit(jax.grad(end))):
            jax.block_until_ready(run(0.0))
            times = []
            for _ in range(REPEATS):
                begin = time.perf_counter()
                jax.block_until_ready(run(0.0))
                times.append(time.perf_counter() - begin)
            best.append(1e3 * np.min(times))
        print(f"{name:32}  motion {best[0]:7.1f} ms  gradient {best[1]:7.1f} ms  ratio {best[1] / best[0]:.1f}")


if __name__ == "__main__":
    main()
