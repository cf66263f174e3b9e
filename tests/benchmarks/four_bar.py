"""The library's four-bar for 10 s: Adams on its partition against Dopri8 with projection and, if installed, Pinocchio.

Run it with `python tests/benchmarks/four_bar.py`, with `NPROC=1` before it for a single thread of XLA. It prints
work–precision curves, and ratios at equal error read off them by interpolation: evaluations and warm run time of Adams
over those of the others, in one process, interleaved.
Pinocchio (`pip install pin`) solves for accelerations with `constraintDynamics`, SciPy's DOP853 integrates.
"""

import time

import diffrax
import jax
import numpy as np

import jaxmb as mb

jax.config.update("jax_enable_x64", True)

REPEATS = 7
ERRORS = (1e-6, 1e-7, 1e-8, 1e-9)


def jaxmb_runs():
    """Functions of the tolerance that return the end angle of the crank and the number of evaluations."""
    mechanism = mb.mechanisms.get("four_bar")
    dopri8 = {"solver": diffrax.Dopri8(), "formulation": mb.formulations.Multipliers()}
    runs = {}
    for name, options, cost in (
        ("Adams + Partition", {}, lambda stats: int(stats["num_evaluations"])),
        # Of 14 stages the first is the last of the step before.
        ("Dopri8 + Projection", dopri8, lambda stats: 13 * int(stats["num_steps"]) + 1),
    ):

        @jax.jit
        def run(rtol, options=options):
            sol = mb.simulate(mechanism.system, mechanism.state, t1=10.0, rtol=rtol, throw=False, **options)
            return sol["crank"].angle[-1], sol.stats

        runs[name] = run, cost, 10.0 ** -np.arange(5.0, 13.1, 0.5 if name.startswith("Adams") else 1.0)
    return runs


def pinocchio_run():
    import pinocchio as pin
    from scipy.integrate import solve_ivp

    lengths, masses = (1.0, 3.0, 2.5), (1.0, 3.0, 2.5)
    model = pin.Model()
    model.gravity.linear = np.array([0.0, -9.81, 0.0])
    joint, offset = 0, 0.0
    for k, (length, mass) in enumerate(zip(lengths, masses, strict=True)):
        placement = pin.SE3(np.eye(3), np.array([offset, 0.0, 0.0]))
        joint = model.addJoint(joint, pin.JointModelRZ(), placement, f"joint{k}")
        rod = mass * length**2 / 12
        inertia = pin.Inertia(mass, np.array([length / 2, 0.0, 0.0]), np.diag([0.0, rod, rod]))
        model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
        offset = length
    data = model.createData()
    tip, pivot = pin.SE3(np.eye(3), np.array([2.5, 0.0, 0.0])), pin.SE3(np.eye(3), np.array([2.5, 0.0, 0.0]))
    kind, frame = pin.ContactType.CONTACT_3D, pin.ReferenceFrame.LOCAL
    loop = pin.RigidConstraintModel(kind, model, joint, tip, 0, pivot, frame)
    closure, closures = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
    closure.append(loop)
    closures.append(loop.createData())
    settings = pin.ProximalSettings(1e-12, 1e-12, 10)
    pin.initConstraintDynamics(model, data, closure, closures)
    still = np.zeros(model.nv)

    start = np.array([0.0, 1.0])  # crank at 90°
    across = np.array([2.5, 0.0]) - start
    reach = np.linalg.norm(across)
    along = (3.0**2 - 2.5**2 + reach**2) / (2 * reach)
    up = np.array([-across[1], across[0]]) / reach
    knee = start + along * across / reach + np.sqrt(3.0**2 - along**2) * up
    direction = lambda v: np.arctan2(v[1], v[0])
    coupler, rocker = direction(knee - start), direction(np.array([2.5, 0.0]) - knee)
    q0 = np.array([np.pi / 2, coupler - np.pi / 2, rocker - coupler])
    # Rates of the absolute angles from the loop's velocity, crank at 4 rad/s.
    spin = lambda angle, length: length * np.array([-np.sin(angle), np.cos(angle)])
    others = np.linalg.solve(np.stack([spin(coupler, 3.0), spin(rocker, 2.5)], axis=1), -4.0 * spin(np.pi / 2, 1.0))
    v0 = np.array([4.0, others[0] - 4.0, others[1] - others[0]])
    count = [0]

    def field(t, y):
        count[0] += 1
        a = pin.constraintDynamics(model, data, y[:3], y[3:], still, closure, closures, settings)
        return np.concatenate([y[3:], a])

    def run(rtol):
        count[0] = 0
        sol = solve_ivp(field, (0.0, 10.0), np.concatenate([q0, v0]), method="DOP853", rtol=rtol, atol=rtol / 100)
        return sol.y[0, -1], count[0]

    return run, lambda count: count, 10.0 ** -np.arange(5.0, 12.1, 1.0)


def main():
    runs = jaxmb_runs()
    try:
        runs["Pinocchio + DOP853"] = pinocchio_run()
    except ImportError:
        print("Pinocchio is not installed (pip install pin): left out.")
    # In closed coordinates and extended precision; see jaxmb/mechanisms/four_bar.py.
    mechanism = mb.mechanisms.get("four_bar")
    label = mechanism.references.labels.index("crank")
    exact = float(mechanism.references.values[-1, label])
    curves = {}
    for name, (run, cost, tolerances) in runs.items():
        ends = [jax.block_until_ready(run(rtol)) for rtol in tolerances]
        errors = [abs(float(angle) - exact) / abs(exact) for angle, _ in ends]
        curves[name] = np.array([(error, cost(work), np.inf) for error, (_, work) in zip(errors, ends, strict=True)])
    # In turns, for the speed of the machine changes.
    for _ in range(REPEATS):
        for name, (run, _, tolerances) in runs.items():
            for row, rtol in zip(curves[name], tolerances, strict=True):
                row[2] = min(row[2], _timed(run, rtol))
    for name, curve in curves.items():
        print(f"\n{name}\n{'error':>10}  {'evaluations':>11}  {'run [ms]':>8}")
        for error, evaluations, seconds in curve:
            print(f"{error:10.1e}  {evaluations:11.0f}  {1e3 * seconds:8.2f}")
    first = curves.pop("Adams + Partition")
    for name, curve in curves.items():
        print(f"\nAdams + Partition over {name}\n{'error':>10}  {'evaluations':>11}  {'time':>6}")
        for error in ERRORS:
            ratio = [_at(first, error, k) / _at(curve, error, k) for k in (1, 2)]
            print(f"{error:10.0e}  {ratio[0]:11.2f}  {ratio[1]:6.2f}")


def _timed(run, rtol) -> float:
    start = time.perf_counter()
    jax.block_until_ready(run(rtol))
    return time.perf_counter() - start


def _at(curve, error, column) -> float:
    """Cost at an error, from a straight line through the log–log curve around it (errors of single runs scatter)."""
    x, y = np.log10(curve[:, 0]), np.log10(curve[:, column])
    near = np.abs(x - np.log10(error)) < 2.0
    slope, level = np.polyfit(x[near], y[near], 1)
    return 10.0 ** (slope * np.log10(error) + level)


if __name__ == "__main__":
    main()
