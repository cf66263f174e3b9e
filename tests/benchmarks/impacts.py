"""Impacts at their exact times beside compliant ones, at equal error and in one process.

A bar that falls on an elastic stop again and again, and a double pendulum whose elbow hits elastic stops.

    python tests/benchmarks/impacts.py [--record FILE]

on an otherwise idle machine. Each program runs over its tolerances or its steps; from the curves come the times at
errors of 1e-3, 1e-4 and 1e-6 of an angle at the end, and the errors in the time that jaxmb takes for 1e-4. Compilation
is not in the times. MuJoCo is left out where it is not installed. `--record` writes the curves as JSON.

- jaxmb: `Stop`, whose impacts end steps of the integration, with `Adams`, the default, and with Dopri8.
- jaxmb, compliant: `JointStop`, over its stiffness, at the tolerance that this deserves.
- MuJoCo: fourth-order Runge–Kutta of fixed steps with a limit of the joint, at every step with the stiffness, of five,
  that comes closest. Without damping it is elastic.

The angle that errors are measured by is that of SciPy's DOP853 at 1e-13, with the equations written out, from one end
of the range to the next.
"""

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from equal_error import Curve, Point, machine, measured, record, seconds_at, table

import jaxmb as mb
from jaxmb import planar

jax.config.update("jax_enable_x64", True)
REPEATS = 5
ERRORS = (1e-3, 1e-4, 1e-6)
GRAVITY, RANGE, T1 = 9.81, 0.5, 3.0


class Arm(NamedTuple):
    """Bars of 1 m and 1 kg in a row, level at the start; the range of the last one's joint is limited."""

    title: str
    bars: int
    joint: str


ARMS = (Arm("bar on an elastic stop", 1, "shoulder"), Arm("elbow between elastic stops", 2, "elbow"))


def scene(arm: Arm, stop) -> mb.RigidBodySystem:
    """With a stop, rigid or compliant."""
    bars = [planar.Body(f"bar{k}", mass=1.0, inertia=1 / 12, position=(0.5 + k, 0.0)) for k in range(arm.bars)]
    joints = [
        planar.Revolute("shoulder", "ground", "bar0", point=(0.0, 0.0)),
        *(planar.Revolute("elbow", "bar0", "bar1", point=(1.0, 0.0)) for _ in bars[1:]),
    ]
    rigid = isinstance(stop, mb.Stop)
    down = mb.Gravity((0.0, -GRAVITY))
    return mb.Scene(bars, joints=joints + [stop] * rigid, forces=[down] + [stop] * (not rigid)).compile()


def exact(arm: Arm) -> float:
    """The angle of the last bar at the end, from equations of its own."""
    n = arm.bars
    across = np.array([-1.0, 1.0])[-n:]

    def solved(angles, rates):
        """Accelerations, and the inverse of the mass matrix."""
        mass, weights, forces = np.array([[1 / 3]]), np.array([0.5]), np.zeros(n)
        if n == 2:
            c, s = np.cos(angles[0] - angles[1]) / 2, np.sin(angles[0] - angles[1]) / 2
            mass, weights = np.array([[4 / 3, c], [c, 1 / 3]]), np.array([1.5, 0.5])
            forces = s * np.array([-(rates[1] ** 2), rates[0] ** 2])
        inverse = np.linalg.inv(mass)
        return inverse @ (forces - GRAVITY * weights * np.cos(angles)), inverse

    field = lambda t, y: np.concatenate([y[n:], solved(y[:n], y[n:])[0]])
    stop = lambda t, y: RANGE - abs(across @ y[:n])
    stop.terminal, stop.direction = True, -1
    t, y, impacts = 0.0, np.zeros(2 * n), 0
    while t < T1:
        run = solve_ivp(field, (t, T1), y, method="DOP853", rtol=1e-13, atol=1e-13, events=stop)
        t, y = run.t[-1], run.y[:, -1]
        if run.status == 1:
            inverse = solved(y[:n], y[n:])[1]
            y[n:] -= inverse @ across * (2 * (across @ y[n:]) / (across @ inverse @ across))
            impacts += 1
    print(f"{arm.title}: {impacts} impacts")
    return y[n - 1]


def of_jaxmb(arm: Arm) -> dict[str, tuple]:
    """`run(setting)` and the settings of each way."""
    ends, last = {"lower": -RANGE, "upper": RANGE}, f"bar{arm.bars - 1}"
    rigid = scene(arm, mb.Stop("stop", f"{arm.joint}.angle", **ends, restitution=1.0))
    start = mb.assemble(rigid)

    def by(solver, manifold):
        run = lambda rtol, system, start: mb.simulate(
            system, start, t1=T1, rtol=rtol, solver=solver, manifold=manifold, max_steps=100_000
        )[last].angle[-1]
        compiled = eqx.filter_jit(run)
        return lambda rtol: compiled(jnp.asarray(rtol), rigid, start)

    tolerances = 10.0 ** -np.arange(3.0, 11.1)
    soft = scene(arm, mb.JointStop("stop", f"{arm.joint}.angle", **ends, stiffness=1.0, smoothing=1.0))
    begin = mb.assemble(soft)

    @eqx.filter_jit
    def compliant(rtol, stiffness, system, start):
        harder = mb.with_parameters(system, {"stop.stiffness": stiffness, "stop.smoothing": 1e-2 / jnp.sqrt(stiffness)})
        motion = mb.simulate(harder, start, t1=T1, rtol=rtol, max_steps=1_000_000)
        return motion[last].angle[-1]

    hardness = 10.0 ** np.arange(4.0, 12.1)
    return {
        "jaxmb": (by(None, None), tolerances),
        "jaxmb, Dopri8": (by(diffrax.Dopri8(), mb.manifold.Projection()), tolerances),
        # The error of a stiff stop is about the root of its compliance.
        "jaxmb, compliant": (
            lambda stiffness: compliant(jnp.asarray(0.1 / np.sqrt(stiffness)), jnp.asarray(stiffness), soft, begin),
            hardness,
        ),
    }


def of_mujoco(arm: Arm, reference: float) -> list[Point]:
    import mujoco

    def model(count, hardness):
        step = T1 / count
        # Rates of contact [1/s²] that the step resolves more or less well.
        stiffness = (hardness / step) ** 2
        ends = (
            f'limited="true" range="{-RANGE} {RANGE}" solreflimit="{-stiffness} -1e-12" solimplimit="0.9999 0.9999 1"'
        )
        bars, inertia = "", 1 / 12
        for k in reversed(range(arm.bars)):
            limit = ends if k == arm.bars - 1 else ""
            bars = (
                f'<body pos="{min(k, 1)} 0 0"><joint type="hinge" axis="0 0 1" {limit}/>'
                f'<inertial pos="0.5 0 0" mass="1" diaginertia="1e-9 {inertia} {inertia}"/>{bars}</body>'
            )
        return mujoco.MjModel.from_xml_string(
            f'<mujoco><compiler angle="radian"/><option timestep="{step}" integrator="RK4" gravity="0 {-GRAVITY} 0" '
            f'tolerance="1e-14" iterations="100"/><worldbody>{bars}</worldbody></mujoco>'
        )

    points = []
    for count in np.geomspace(300, 100_000, 6).round().astype(int):
        models = {hardness: model(count, hardness) for hardness in (0.03, 0.1, 0.2, 0.5, 1.0)}

        def angle(hardness, models=models, count=count):
            d = mujoco.MjData(models[hardness])
            mujoco.mj_step(models[hardness], d, nstep=int(count))
            return np.sum(d.qpos)

        own = measured(angle, lambda found: abs(found / reference - 1), models, REPEATS if count < 1e4 else 1)
        best = min(own, key=lambda point: point.error)
        points.append(Point(T1 / count, best.error, best.seconds))
    return points


def compare(arm: Arm) -> list[Curve]:
    reference = exact(arm)
    error = lambda found: abs(float(found) / reference - 1)
    curves = [
        Curve(arm.title, "value", name, measured(run, error, settings, REPEATS))
        for name, (run, settings) in of_jaxmb(arm).items()
    ]
    try:
        curves.append(Curve(arm.title, "value", "MuJoCo", of_mujoco(arm, reference)))
    except ImportError:
        print("mujoco is not installed: left out.", file=sys.stderr)
    return curves


def at_equal_time(curves: list[Curve], error: float) -> str:
    """The errors in the time that jaxmb takes for one."""
    allowed = seconds_at(curves[0].points, error)
    least = [min((p.error for p in curve.points if p.seconds <= allowed), default=np.nan) for curve in curves]
    found = ", ".join(f"{curve.program} {x:.0e}" for curve, x in zip(curves, least, strict=True))
    return f"{curves[0].case}, least errors in {1e3 * allowed:.1f} ms: {found}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--record", metavar="FILE", type=Path, help="write the curves into a JSON file")
    given = parser.parse_args()
    described = machine(("jaxmb", "jax", "jaxlib", "diffrax", "scipy", "mujoco"))
    print(described)
    of_arms = [compare(arm) for arm in ARMS]
    curves = [curve for own in of_arms for curve in own]
    print(f"\nTimes at equal error, and over those of jaxmb\n\n{table(curves, ERRORS)}\n")
    for own in of_arms:
        print(at_equal_time(own, 1e-4))
    if given.record:
        record(given.record, "impacts", described, curves)


if __name__ == "__main__":
    main()
