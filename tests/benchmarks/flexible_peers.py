"""A pendulum of rubber beside Exudyn, at equal error against its continuous limit, and the cost of more beams.

    python tests/benchmarks/flexible_peers.py [--record FILE]

A bar of 1 m and a square section of 20 mm, damped by strain rates, falls from rest, held by a pin at one end. Both
programs make it of n geometrically exact beams with the strains at the middle, and so have the same limit: jaxmb's
`beam_chain` by `Hermite`, Exudyn's `ObjectBeamGeometricallyExact2D` by its two implicit methods. The limit is
extrapolated from the finest chains of each program; the two limits are printed. Each program runs over numbers of
beams and tolerances or steps. Times are processor times without compiling; `NPROC=1 OMP_NUM_THREADS=1` before it
allows one thread. Exudyn: `pip install exudyn`. `--record notebooks/14_benchmarks.json` is for the notebook.
"""

import argparse
import functools
import sys
import time
from pathlib import Path

import jax
import numpy as np
from equal_error import Curve, machine, measured, record, table

import jaxmb as mb
from jaxmb import planar

jax.config.update("jax_enable_x64", True)
LENGTH, SIDE, DENSITY, MODULUS, POISSON, DAMPING_TIME = 1.0, 0.02, 1100.0, 5e6, 0.45, 1e-3
GRAVITY, T1 = 9.81, 0.5
CASE = "rubber pendulum"
REPEATS = 3
SECTION = mb.sections.Rectangle(thickness=SIDE, width=SIDE, modulus=MODULUS, poisson_ratio=POISSON)


@functools.cache
def chain(beams):
    nodes = np.linspace((0.0, 0.0), (LENGTH, 0.0), beams + 1)
    mass = DENSITY * SIDE**2 * LENGTH
    rubber = planar.beam_chain("rubber", nodes, SECTION, mass=mass, ends=(None, None), damping_time=DAMPING_TIME)
    pin = planar.Revolute("pin", "ground", "rubber_node0", point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    forces = [*rubber.forces, mb.Gravity((0.0, -GRAVITY))]
    system = mb.Scene(rubber.bodies, joints=[pin, *rubber.joints], forces=forces).compile()
    return system, mb.assemble(system)


def of_jaxmb(beams, rtol):
    """The place of the free end at the end of the motion [m], and the number of steps."""
    system, state = chain(beams)
    motion = mb.simulate(system, state, t1=T1, rtol=rtol, solver=mb.solvers.Hermite())
    return np.asarray(motion[f"rubber_node{beams}"].position[-1]), int(motion.stats["num_steps"])


@functools.cache
def exudyn_chain(beams):
    import exudyn as exu
    from exudyn import itemInterface as item

    system = exu.SystemContainer().AddSystem()
    area, inertia = SIDE**2, SIDE**4 / 12
    shear = float(SECTION.shear_factor) * area * MODULUS / (2 * (1 + POISSON))
    nodes = [
        system.AddNode(item.NodeRigidBody2D(referenceCoordinates=[x, 0.0, 0.0]))
        for x in np.linspace(0.0, LENGTH, beams + 1)
    ]
    for k in range(beams):
        beam = item.ObjectBeamGeometricallyExact2D(
            nodeNumbers=nodes[k : k + 2],
            length=LENGTH / beams,
            massPerLength=DENSITY * area,
            crossSectionInertia=DENSITY * inertia,
            bendingStiffness=MODULUS * inertia,
            axialStiffness=MODULUS * area,
            shearStiffness=shear,
            bendingDamping=DAMPING_TIME * MODULUS * inertia,
            axialDamping=DAMPING_TIME * MODULUS * area,
            shearDamping=DAMPING_TIME * shear,
        )
        weight = system.AddMarker(item.MarkerBodyMass(bodyNumber=system.AddObject(beam)))
        system.AddLoad(item.LoadMassProportional(markerNumber=weight, loadVector=[0.0, -GRAVITY, 0.0]))
    ground = system.AddNode(item.NodePointGround())
    fixed = system.AddMarker(item.MarkerNodeCoordinate(nodeNumber=ground, coordinate=0))
    for axis in (0, 1):
        held = system.AddMarker(item.MarkerNodeCoordinate(nodeNumber=nodes[0], coordinate=axis))
        system.AddObject(item.ObjectConnectorCoordinate(markerNumbers=[fixed, held]))
    system.Assemble()
    return system, nodes[-1]


def of_exudyn(method, beams, steps):
    import exudyn as exu

    system, last = exudyn_chain(beams)
    settings = exu.SimulationSettings()
    settings.timeIntegration.endTime = T1
    settings.timeIntegration.numberOfSteps = steps
    settings.timeIntegration.verboseMode = 0
    settings.timeIntegration.newton.useModifiedNewton = True
    settings.solution.file.write = False
    if method == "generalised alpha":
        settings.timeIntegration.generalizedAlpha.spectralRadius = 0.7
    settings.linearSolver.solverType = exu.LinearSolverType.EigenSparse
    kind = (
        exu.DynamicSolverType.TrapezoidalIndex2 if method == "trapezoidal" else exu.DynamicSolverType.GeneralizedAlpha
    )
    try:
        system.SolveDynamic(settings, solverType=kind, updateInitialValues=False)
    except exu.SolverError:
        return np.full(2, np.nan), steps
    return np.asarray(system.GetNodeOutput(last, exu.OutputVariableType.Position))[:2], steps


def limit(run, fine, coarse):
    """The value at no size of the beams, from two numbers of beams and an error that falls with the square."""
    return (4 * run(fine) - run(coarse)) / 3


def error_curves():
    exact = limit(lambda n: of_jaxmb(n, 1e-9)[0], 96, 48)
    print(f"limit by jaxmb: {exact}")
    settings = {"jaxmb": [(n, rtol) for n in (6, 12, 24, 48, 96) for rtol in (1e-3, 1e-4, 1e-5, 1e-6)]}
    runs = {"jaxmb": lambda setting: of_jaxmb(*setting)[0]}
    try:
        other = limit(lambda n: of_exudyn("trapezoidal", n, 20_000)[0], 192, 96)
    except ImportError:
        print("exudyn is not installed: left out.", file=sys.stderr)
    else:
        print(f"limit by Exudyn: {other}, {np.linalg.norm(other - exact):.1e} m away")
        for method in ("trapezoidal", "generalised alpha"):
            program = f"Exudyn, {method}"
            runs[program] = lambda setting, method=method: of_exudyn(method, *setting)[0]
            settings[program] = [(n, steps) for n in (6, 12, 24, 48, 96, 192) for steps in (100, 300, 1000, 3000)]
    for program, run in runs.items():
        print(program, file=sys.stderr, flush=True)
        error = lambda found: float(np.linalg.norm(found - exact)) / LENGTH
        yield Curve(CASE, "value", program, measured(run, error, settings[program], REPEATS))


def growth():
    """Processor time over numbers of beams, at one tolerance and one number of steps."""
    print(f"\n{'beams':>6} {'jaxmb steps':>12} {'[ms a step]':>12} {'Exudyn [ms a step]':>19}")
    for beams in (12, 25, 50, 100, 200):
        shown = []
        for run, *setting in ((of_jaxmb, beams, 1e-5), (of_exudyn, "trapezoidal", beams, 1000)):
            try:
                run(*setting)
            except ImportError:
                continue
            shortest = np.inf
            for _ in range(REPEATS):
                begin = time.process_time()
                _, steps = run(*setting)
                shortest = min(shortest, time.process_time() - begin)
            shown.append((steps, 1e3 * shortest / steps))
        (steps, ours), *other = shown
        print(f"{beams:>6} {steps:>12} {ours:>12.3f} " + " ".join(f"{each:>19.3f}" for _, each in other), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--record", metavar="FILE", type=Path, help="write the curves into a JSON file")
    given = parser.parse_args()
    described = machine(("jaxmb", "jax", "jaxlib", "exudyn"))
    print(described)
    curves = list(error_curves())
    print("\nTimes at equal error, and over those of jaxmb: × is more than one where jaxmb is faster\n")
    print(table(curves, (1e-2, 1e-3, 1e-4, 1e-5)))
    growth()
    if given.record:
        record(given.record, "flexible", described, curves)


if __name__ == "__main__":
    main()
