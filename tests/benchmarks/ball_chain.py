"""An open chain of ten links on ball joints for 2 s: Adams on its constraints against Pinocchio and SciPy's DOP853.

    NPROC=1 taskset -c 0 python tests/benchmarks/ball_chain.py

Pinocchio (`pip install pin`) finds accelerations in 30 minimal coordinates by its articulated-body algorithm. Printed
is the CPU time of the fastest warm run, compilation apart, whose error of the tip's position at the end is at most 1e-6
and 1e-8, against DOP853 at its tightest.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import jaxmb as mb
from jaxmb import spatial

jax.config.update("jax_enable_x64", True)
LINKS, T, INERTIA = 10, 2.0, (0.03, 0.1, 0.12)
SPIN = 0.3 * np.cos(np.arange(3 * LINKS)).reshape(LINKS, 3)
TOLERANCES = 10.0 ** -np.arange(5, 12.5, 0.5)
REPEATS = 5


def of_pinocchio():
    """The tip's position at the end as a function of the tolerance."""
    model = pin.Model()
    for k in range(LINKS):
        place = pin.SE3(np.eye(3), np.array([1.0 if k else 0.0, 0.0, 0.0]))
        joint = model.addJoint(k, pin.JointModelSpherical(), place, f"j{k}")
        model.appendBodyToJoint(
            joint, pin.Inertia(1.0, np.array([0.5, 0.0, 0.0]), np.diag(INERTIA)), pin.SE3.Identity()
        )
    data, free = model.createData(), np.zeros(model.nv)

    def rates(t, y):
        q, v = y[: model.nq], y[model.nq :]
        xyz, w, turn = q.reshape(LINKS, 4)[:, :3], q.reshape(LINKS, 4)[:, 3:], v.reshape(LINKS, 3)
        vector = w * turn + np.stack(
            [
                xyz[:, 1] * turn[:, 2] - xyz[:, 2] * turn[:, 1],
                xyz[:, 2] * turn[:, 0] - xyz[:, 0] * turn[:, 2],
                xyz[:, 0] * turn[:, 1] - xyz[:, 1] * turn[:, 0],
            ],
            axis=1,
        )
        qdot = 0.5 * np.concatenate([vector, -np.sum(xyz * turn, axis=1, keepdims=True)], axis=1)
        return np.concatenate([qdot.ravel(), pin.aba(model, data, q, v, free)])

    relative = SPIN - np.concatenate([np.zeros((1, 3)), SPIN[:-1]])
    start = np.concatenate([pin.neutral(model), relative.ravel()])

    def tip(tol):
        y = solve_ivp(rates, (0.0, T), start, method="DOP853", rtol=tol, atol=tol).y[:, -1]
        pin.forwardKinematics(model, data, pin.normalize(model, y[: model.nq]))
        return data.oMi[LINKS].act(np.array([1.0, 0.0, 0.0]))

    return tip


def of_jaxmb():
    bodies, joints, velocity = [], [], np.zeros(3)
    for k, spin in enumerate(SPIN):
        half = np.cross(spin, [0.5, 0.0, 0.0])
        moving = {"velocity": tuple(velocity + half), "angular_velocity": tuple(spin)}
        bodies.append(spatial.Body(f"b{k}", mass=1.0, inertia=INERTIA, position=(k + 0.5, 0.0, 0.0), **moving))
        ends = (f"b{k - 1}" if k else "ground", f"b{k}")
        joints.append(spatial.Spherical(f"j{k}", *ends, point=(float(k), 0.0, 0.0)))
        velocity = velocity + 2 * half
    system = mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, 0.0, -9.81))]).compile()
    state = mb.assemble(system)
    run = jax.jit(lambda tol: mb.simulate(system, state, t1=T, rtol=tol, throw=False).ys.q[-1][-7:])
    point = jnp.array([0.5, 0.0, 0.0])

    def tip(tol):
        pose = np.asarray(run(jnp.asarray(tol)))
        return pose[:3] + np.asarray(mb.linalg.rotations.rotate(pose[3:], np.asarray(point)))

    tip(1e-6)
    return tip


if __name__ == "__main__":
    methods = {"jaxmb Adams": of_jaxmb(), "Pinocchio + DOP853": of_pinocchio()}
    exact = methods["Pinocchio + DOP853"](1e-13)
    found = {}
    for name, tip in methods.items():
        for tol in TOLERANCES:
            times, error = [], np.inf
            for _ in range(REPEATS):
                start = time.process_time()
                error = np.max(np.abs(tip(tol) - exact))
                times.append(time.process_time() - start)
            found.setdefault(name, []).append((float(error), min(times)))
    for target in (1e-6, 1e-8):
        for name, runs in found.items():
            good = [(seconds, error) for error, seconds in runs if error <= target]
            seconds, error = min(good) if good else (np.nan, np.nan)
            print(f"error ≤ {target:.0e}  {name:20s} {1e3 * seconds:8.2f} ms  (error {error:.1e})", flush=True)
