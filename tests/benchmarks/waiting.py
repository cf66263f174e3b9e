"""Waiting times of first calls [s], in a new process and in a later one, which finds kept programs.

Run it with `python tests/benchmarks/waiting.py`; it takes some minutes.
"""

import json
import os
import subprocess
import sys
import tempfile

from jaxmb._setup import VARIABLE
from jaxmb.report.table import aligned

# Waiting times in a new process [s]: imports, and for some machines the first value with its scene, the first gradient,
# and the second call of each.
FIRST_CALLS = """
import json, time
seconds, last = {}, time.perf_counter()

def done(name):
    global last
    now = time.perf_counter()
    seconds[name], last = now - last, now

import diffrax, jax
done("import jax, diffrax")
import jaxmb as mb
mb.simulate, mb.Scene
done("import jaxmb")
mb.setup()
stop = mb.Stop("stop", "slide.displacement", lower=0.3, restitution=0.5)
machines = [
    ("four_bar", "four_bar", "coupler", [], None),
    ("spatial_slider_crank", "spatial_slider_crank", "slider", [], None),
    ("slider_crank with a stop", "slider_crank", "slider", [stop], None),
    ("stiff_four_bar", "stiff_four_bar", "coupler", [], mb.solvers.Hermite()),
]
for title, name, body, joints, solver in machines:
    last = time.perf_counter()
    machine = mb.mechanisms.get(name)
    system = machine.scene.extended(joints=joints).compile() if joints else machine.system
    start = mb.assemble(system, fix=machine.fix, rates=machine.rates) if joints else machine.state
    t1 = 0.02 if solver else machine.t1 / 10

    def end(mass):
        own = mb.with_parameters(system, {body + ".mass": mass})
        state = mb.assemble(own, start)
        return mb.simulate(own, state, t1=t1, rtol=1e-8, solver=solver, throw=False).ys.u[-1, 0]

    mass = float(mb.parameters(system)[body + ".mass"])
    for what, call in (("value", end), ("gradient", jax.grad(end))):
        for which in ("first", "another"):
            call(mass).block_until_ready()
            done(f"{title}: {which} {what}")
print(json.dumps(seconds))
"""


def first_calls() -> list[list[str]]:
    """The waiting times of two processes; the second finds the programs of the first in the cache."""
    with tempfile.TemporaryDirectory() as folder:
        kept = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
        environment = kept | {VARIABLE: folder}
        both = [durations_of(environment) for _ in range(2)]
    return [["", "first", "second"], *([name, *(f"{seconds[name]:.3f}" for seconds in both)] for name in both[0])]


def durations_of(environment: dict[str, str]) -> dict[str, float]:
    run = subprocess.run([sys.executable, "-c", FIRST_CALLS], env=environment, capture_output=True, text=True)
    if run.returncode:
        raise RuntimeError(f"A new process failed: {run.stderr.strip().splitlines()[-1]}")
    return json.loads(run.stdout)


if __name__ == "__main__":
    print("\n".join(aligned(first_calls())))
