"""What derivatives cost beside the motion, and how exact they are.

    python tests/benchmarks/gradients.py [NAME …]

on an otherwise idle machine; `taskset -c 0` before it allows one thread. Of each mechanism: the time under `jit` of
the motion; those of its gradient by all masses, and of its tangents along one direction and three, as multiples of it;
what lowering and compiling of motion and gradient take; the numbers of compiled kernels; and the error of the gradient
over tolerances, relative to its largest entry, beside that of the motion. References are the same runs at 1e-12.
"""

import sys
import time

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb.report.table import aligned
from jaxmb.solvers import Hermite

jax.config.update("jax_enable_x64", True)

REPEATS, RTOL = 11, 1e-8
TOLERANCES = 10.0 ** -np.array([4.0, 6.0, 8.0, 10.0])
# Of each case: the mechanism, its parameters, the end [s], and the options of its motion.
CASES = {
    "four_bar": ("four_bar", {}, 10.0, {}),
    "andrews": ("andrews", {}, 0.05, {}),
    "rod_chain(10)": ("rod_chain", {"n": 10}, 1.0, {}),
    "tracked_vehicle": ("tracked_vehicle", {}, 1.0, {}),
    "heavy_top": ("heavy_top", {}, 1.0, {}),
    "rolling_disc": ("rolling_disc", {}, 1.0, {}),
    "bricard": ("bricard", {}, 1.0, {}),
    "rod_chain(100)": ("rod_chain", {"n": 100}, 0.3, {}),
    "cable(20)": ("cable", {"n": 20}, 0.3, {}),
    "stiff_four_bar, Hermite": ("stiff_four_bar", {}, 0.1, {"solver": Hermite()}),
    "andrews, Dopri8": ("andrews", {}, 0.05, {"solver": diffrax.Dopri8(), "manifold": mb.manifold.Projection()}),
}


class Case:
    """A motion's end as a function of its masses, scaled by `x`, in one number, and the compiled forms of it."""

    def __init__(self, name: str):
        mechanism, given, t1, options = CASES[name]
        found = mb.mechanisms.get(mechanism, **given)
        system, state, start = found.system, found.state, mb.parameters(found.system)
        masses = [key for key in start if key.endswith(".mass")]
        weights = np.cos(np.arange(float(system.nq)))

        def end(x, rtol):
            changed = mb.with_parameters(system, {key: start[key] * x[k] for k, key in enumerate(masses)})
            motion = mb.simulate(changed, state, t1=t1, rtol=rtol, max_steps=200_000, **options)
            return jnp.sum(weights * motion.ys.q[-1]), motion.stats["num_steps"]

        along = np.random.default_rng(0).normal(size=(3, len(masses)))
        value = lambda x, rtol: end(x, rtol)[0]
        push = lambda x, rtol, w: jax.jvp(lambda x: value(x, rtol), (x,), (w,))[1]
        self.x = jnp.ones(len(masses))
        self.forms = {
            "motion": lambda x, rtol: end(x, rtol),
            "reverse": lambda x, rtol: jax.value_and_grad(value)(x, rtol),
            "one direction": lambda x, rtol: push(x, rtol, along[0]),
            "three": lambda x, rtol: jax.vmap(lambda w: push(x, rtol, w))(along),
        }
        self.programs, self.seconds, self.kernels = {}, {}, {}
        for form, function in self.forms.items():
            begin = time.perf_counter()
            lowered = eqx.filter_jit(function).lower(self.x, jnp.asarray(RTOL))
            between = time.perf_counter()
            self.programs[form] = lowered.compile()
            self.seconds[form] = between - begin, time.perf_counter() - between
            self.kernels[form] = self.programs[form].compiled.as_text().count(" fusion(")

    def at(self, form: str, rtol: float):
        return jax.block_until_ready(self.programs[form](self.x, jnp.asarray(rtol)))

    def times(self) -> dict[str, float]:
        """The shortest times, all forms in turns."""
        least = dict.fromkeys(self.forms, np.inf)
        for _ in range(REPEATS):
            for form in self.forms:
                begin = time.perf_counter()
                self.at(form, RTOL)
                least[form] = min(least[form], time.perf_counter() - begin)
        return least

    def errors(self) -> list[str]:
        """Of motion and gradient over the tolerances."""
        value, gradient = (np.asarray(x) for x in self.at("reverse", 1e-12))
        out = []
        for rtol in TOLERANCES:
            own = [np.asarray(x) for x in self.at("reverse", rtol)]
            error = abs(own[0] / value - 1), np.max(np.abs(own[1] - gradient)) / np.max(np.abs(gradient))
            out.append(f"{error[0]:.0e} {error[1]:.0e}")
        return out


def main():
    names = sys.argv[1:] or list(CASES)
    costs = [
        ("rtol 1e-8", "steps", "motion [ms]", "reverse", "one direction", "three", "lower, compile [s]", "kernels")
    ]
    errors = [("errors of motion, gradient", *(f"{rtol:.0e}" for rtol in TOLERANCES))]
    for name in names:
        case = Case(name)
        times = case.times()
        ratios = [f"{times[form] / times['motion']:.2f}" for form in ("reverse", "one direction", "three")]
        spent = " → ".join("{:.1f}, {:.1f}".format(*case.seconds[form]) for form in ("motion", "reverse"))
        kernels = " → ".join(str(case.kernels[form]) for form in ("motion", "reverse"))
        steps = str(int(case.at("motion", RTOL)[1]))
        costs.append((name, steps, f"{1e3 * times['motion']:.2f}", *ratios, spent, kernels))
        errors.append((name, *case.errors()))
        print("  ".join((*costs[-1], *errors[-1][1:])), file=sys.stderr, flush=True)
        # All programs together have more pieces of code than a process may map.
        del case
        jax.clear_caches()
    print("\n".join([*aligned(costs), "", *aligned(errors)]))


if __name__ == "__main__":
    main()
