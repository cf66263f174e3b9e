"""Other programs beside jaxmb, at equal error and in one process.

A four-bar linkage (a loop) and a pendulum of ten links (a tree), values and gradients.

    python tests/benchmarks/peers.py [--record FILE]

Times are processor times; `NPROC=1 OMP_NUM_THREADS=1` before it allows each of them one thread. What is not installed
is left out: `pip install pin mujoco exudyn casadi`. Each program runs over its tolerances or its steps; from the curves
come the times at relative errors of 1e-4, 1e-6 and 1e-8 of an angle at the end, and of its derivative by a mass,
where a program gets there. Compilation is not in the times. `--record` writes the curves as JSON, for the notebook on
benchmarks: `--record notebooks/14_benchmarks.json`.

- jaxmb: `simulate` with its defaults, `Adams` on independent coordinates.
- Pinocchio: accelerations by `aba`, or `constraintDynamics` in the loop, in minimal coordinates; SciPy's DOP853.
- MuJoCo: fourth-order Runge–Kutta of fixed steps, the loop closed by a stiff `connect`, which is soft.
- Exudyn: trapezoidal rule with constraints of index 2, fixed steps, planar bodies with redundant coordinates.
- CasADi: equations written out, with CVODES or IDAS (multipliers as algebraic variables), gradients by their
  adjoint sensitivities.
- diffrax: equations written out, Dopri8; constraints hold in accelerations only.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from bar_chain import GRAVITY, BarChain, accelerations, four_bar, levers, pendulum
from equal_error import Curve, machine, measured, record, table

import jaxmb as mb

jax.config.update("jax_enable_x64", True)
REPEATS = 3
TOLERANCES = 10.0 ** -np.arange(3.0, 12.1)


class Peer(NamedTuple):
    """`value(setting)` and `gradient(setting)` of a chain's watched angle, over `settings`; None for no gradient."""

    value: Callable[[float], Any]
    gradient: Callable[[float], Any] | None
    settings: np.ndarray = TOLERANCES


def of_jaxmb(chain: BarChain) -> dict[str, Peer]:
    mechanism, name = chain.mechanism, chain.bodies[chain.varied]
    inertia = chain.lengths[chain.varied] ** 2 / 12

    def angle(mass, rtol, system, state):
        changed = mb.with_parameters(system, {f"{name}.mass": mass, f"{name}.inertia": mass * inertia})
        motion = mb.simulate(changed, state, t1=chain.t1, rtol=rtol)
        return motion[chain.bodies[chain.watched]].angle[-1]

    value, gradient = eqx.filter_jit(angle), eqx.filter_jit(jax.grad(angle))
    start = mechanism.system, mechanism.state
    mass = jnp.asarray(chain.masses[chain.varied])
    return {"jaxmb": Peer(*(lambda rtol, f=f: f(mass, jnp.asarray(rtol), *start) for f in (value, gradient)))}


def of_diffrax(chain: BarChain) -> dict[str, Peer]:
    y0 = jnp.concatenate([chain.angles, chain.rates])
    n = len(chain.lengths)

    def angle(mass, rtol):
        field = lambda t, y, mass: jnp.concatenate([y[n:], accelerations(chain, y[:n], y[n:], mass)])
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Dopri8(),
            0.0,
            chain.t1,
            None,
            y0,
            mass,
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
            max_steps=100_000,
            throw=False,
        )
        return solution.ys[-1, chain.watched]

    mass = jnp.asarray(chain.masses[chain.varied])
    functions = jax.jit(angle), jax.jit(jax.grad(angle))
    return {"diffrax": Peer(*(lambda rtol, f=f: f(mass, jnp.asarray(rtol)) for f in functions))}


def of_pinocchio(chain: BarChain) -> dict[str, Peer]:
    import pinocchio as pin
    from scipy.integrate import solve_ivp

    model = pin.Model()
    model.gravity.linear = np.array([0.0, -GRAVITY, 0.0])
    place = lambda x: pin.SE3(np.eye(3), np.array([x, 0.0, 0.0]))
    joint, offset = 0, 0.0
    for k, (length, mass, inertia) in enumerate(zip(chain.lengths, chain.masses, chain.inertias, strict=True)):
        joint = model.addJoint(joint, pin.JointModelRZ(), place(offset), f"joint{k}")
        body = pin.Inertia(mass, np.array([length / 2, 0.0, 0.0]), np.diag([0.0, inertia, inertia]))
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
        offset = length
    data, free, n = model.createData(), np.zeros(model.nv), model.nv
    if chain.end is None:
        solve = lambda q, v: pin.aba(model, data, q, v, free)
    else:
        kind, frame = pin.ContactType.CONTACT_3D, pin.ReferenceFrame.LOCAL
        pivot = pin.SE3(np.eye(3), np.append(chain.end, 0.0))
        loop = pin.RigidConstraintModel(kind, model, joint, place(offset), 0, pivot, frame)
        models, datas = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
        models.append(loop)
        datas.append(loop.createData())
        settings = pin.ProximalSettings(1e-12, 1e-12, 10)
        pin.initConstraintDynamics(model, data, models, datas)
        solve = lambda q, v: pin.constraintDynamics(model, data, q, v, free, models, datas, settings)
    relative = lambda x: np.diff(x, prepend=0.0)
    start = np.concatenate([relative(chain.angles), relative(chain.rates)])
    field = lambda t, y: np.concatenate([y[n:], solve(y[:n], y[n:])])

    def angle(rtol):
        solution = solve_ivp(field, (0.0, chain.t1), start, method="DOP853", rtol=rtol, atol=rtol)
        return np.sum(solution.y[: chain.watched + 1, -1])

    return {"Pinocchio": Peer(angle, None)}


def of_mujoco(chain: BarChain) -> dict[str, Peer]:
    import mujoco

    relative = np.diff(chain.angles, prepend=0.0)

    def model(step):
        bodies, offset = "", 0.0
        for k, (length, mass, inertia) in enumerate(zip(chain.lengths, chain.masses, chain.inertias, strict=True)):
            bodies += (
                f'<body name="b{k}" pos="{offset} 0 0"><joint type="hinge" axis="0 0 1"/>'
                f'<inertial pos="{length / 2} 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>'
            )
            offset = length
        bodies += "</body>" * len(chain.lengths)
        ground = loop = ""
        if chain.end is not None:
            # A time constant of two steps, and forces of nearly the whole stiffness, are as hard as it gets.
            hard = f'solref="{2 * step} 1" solimp="0.9999 0.9999 0.001"'
            bodies = bodies.replace("</body>", f'<site name="tip" pos="{offset} 0 0"/></body>', 1)
            ground = f'<site name="pin" pos="{chain.end[0]} {chain.end[1]} 0"/>'
            loop = f'<equality><connect site1="tip" site2="pin" {hard}/></equality>'
        return mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{step}" integrator="RK4" gravity="0 {-GRAVITY} 0" tolerance="1e-14" '
            f'iterations="100"><flag contact="disable"/></option><worldbody>{ground}{bodies}</worldbody>{loop}</mujoco>'
        )

    models = {}

    def angle(step):
        count = round(chain.t1 / step)
        if count not in models:
            models[count] = model(chain.t1 / count)
        m = models[count]
        d = mujoco.MjData(m)
        d.qpos[:], d.qvel[:] = relative, np.diff(chain.rates, prepend=0.0)
        mujoco.mj_step(m, d, nstep=count)
        return np.sum(d.qpos[: chain.watched + 1])

    return {"MuJoCo": Peer(angle, None, chain.t1 / np.geomspace(300, 100_000, 9).round())}


def of_exudyn(chain: BarChain) -> dict[str, Peer]:
    import exudyn as exu
    from exudyn import itemInterface as item

    container = exu.SystemContainer()
    mbs = container.AddSystem()
    direction = np.stack([np.cos(chain.angles), np.sin(chain.angles)], axis=1)
    across = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    W = levers(chain.lengths)
    centres, speeds = W @ direction, W @ (chain.rates[:, None] * across)
    ground = mbs.AddObject(item.ObjectGround())
    at = lambda body, x, y=0.0: mbs.AddMarker(item.MarkerBodyPosition(bodyNumber=body, localPosition=[x, y, 0.0]))
    before, nodes = at(ground, 0.0), []
    for k, (length, mass, inertia) in enumerate(zip(chain.lengths, chain.masses, chain.inertias, strict=True)):
        node = mbs.AddNode(
            item.NodeRigidBody2D(
                referenceCoordinates=[*centres[k], chain.angles[k]], initialVelocities=[*speeds[k], chain.rates[k]]
            )
        )
        body = mbs.AddObject(item.ObjectRigidBody2D(physicsMass=mass, physicsInertia=inertia, nodeNumber=node))
        mbs.AddObject(item.ObjectJointRevolute2D(markerNumbers=[before, at(body, -length / 2)]))
        weight = mbs.AddMarker(item.MarkerBodyMass(bodyNumber=body))
        mbs.AddLoad(item.LoadMassProportional(markerNumber=weight, loadVector=[0.0, -GRAVITY, 0.0]))
        before = at(body, length / 2)
        nodes.append(node)
    if chain.end is not None:
        mbs.AddObject(item.ObjectJointRevolute2D(markerNumbers=[before, at(ground, *chain.end)]))
    mbs.Assemble()
    settings = exu.SimulationSettings()
    settings.timeIntegration.endTime = chain.t1
    settings.timeIntegration.verboseMode = 0
    settings.timeIntegration.newton.useModifiedNewton = True
    settings.timeIntegration.newton.relativeTolerance = 1e-10
    settings.timeIntegration.newton.absoluteTolerance = 1e-12
    settings.solutionSettings.writeSolutionToFile = False
    settings.displayStatistics = False

    def angle(step):
        settings.timeIntegration.numberOfSteps = round(chain.t1 / step)
        mbs.SolveDynamic(settings, solverType=exu.DynamicSolverType.TrapezoidalIndex2, updateInitialValues=False)
        return (
            mbs.GetNodeOutput(nodes[chain.watched], exu.OutputVariableType.Coordinates)[2] + chain.angles[chain.watched]
        )

    return {"Exudyn": Peer(angle, None, chain.t1 / np.geomspace(300, 100_000, 9).round())}


def of_casadi(chain: BarChain) -> dict[str, Peer]:
    import casadi as ca

    n, W = len(chain.lengths), levers(chain.lengths)
    q, v, mass = ca.SX.sym("q", n), ca.SX.sym("v", n), ca.SX.sym("mass")
    masses = ca.vertcat(*(mass if k == chain.varied else m for k, m in enumerate(chain.masses)))
    A = W.T @ ca.diag(masses) @ W
    between = ca.repmat(q, 1, n) - ca.repmat(q.T, n, 1)
    M = A * ca.cos(between) + ca.diag(masses * chain.lengths**2 / 12)
    h = (A * ca.sin(between)) @ v**2 + GRAVITY * (masses.T @ W).T * ca.cos(q)
    right, matrix, unknown = -h, M, n
    if chain.end is not None:
        x, y = chain.lengths * ca.cos(q), chain.lengths * ca.sin(q)
        G, gamma = ca.horzcat(-y, x).T, -ca.horzcat(x, y).T @ v**2
        matrix = ca.blockcat([[M, -G.T], [G, ca.SX(2, 2)]])
        right, unknown = ca.vertcat(-h, -gamma), n + 2
    z = ca.SX.sym("z", unknown)
    state = {"x": ca.vertcat(q, v), "p": mass}
    forms = {
        "CasADi, CVODES": ("cvodes", state | {"ode": ca.vertcat(v, ca.solve(matrix, right)[:n])}),
        "CasADi, IDAS": ("idas", state | {"z": z, "ode": ca.vertcat(v, z[:n]), "alg": matrix @ z - right}),
    }
    start, given = np.concatenate([chain.angles, chain.rates]), chain.masses[chain.varied]
    values = ca.Function("values", [q, v, mass], [ca.solve(matrix, right)])
    z0 = values(chain.angles, chain.rates, given)

    def peer(name, form):
        programs = {}

        def program(rtol):
            if rtol not in programs:
                options = {"reltol": rtol, "abstol": rtol, "max_num_steps": 1_000_000}
                solver = ca.integrator("motion", name, form, 0.0, chain.t1, options)
                inputs = {"x0": start, "z0": z0} if name == "idas" else {"x0": start}
                p = ca.MX.sym("p")
                angle = solver(**inputs, p=p)["xf"][chain.watched]
                programs[rtol] = ca.Function("value", [p], [angle]), ca.Function("slope", [p], [ca.gradient(angle, p)])
            return programs[rtol]

        def run(which):
            def at(rtol):
                try:
                    return float(program(rtol)[which](given))
                except RuntimeError:
                    return float("nan")

            return at

        return Peer(run(0), run(1), TOLERANCES[:-1])

    return {name: peer(*form) for name, form in forms.items()}


PEERS = {
    "mujoco": of_mujoco,
    "pinocchio": of_pinocchio,
    "exudyn": of_exudyn,
    "casadi": of_casadi,
    "diffrax": of_diffrax,
}
PACKAGES = ("jaxmb", "jax", "jaxlib", "diffrax", "scipy", "pin", "mujoco", "exudyn", "casadi")


def compare(chain: BarChain) -> list[Curve]:
    """Of every program, values and gradients."""
    programs = of_jaxmb(chain)
    for package, build in PEERS.items():
        try:
            programs |= build(chain)
        except ImportError:
            print(f"{package} is not installed: left out.", file=sys.stderr)
    # The angle is known better than any program computes it; its derivative from two programs at their tightest.
    slope, other = (float(programs[name].gradient(1e-13)) for name in ("jaxmb", "diffrax"))
    print(f"{chain.title}: derivative {slope:.12g}, jaxmb and diffrax differ by {abs(other / slope - 1):.0e}")
    curves = []
    for kind, exact in (("value", chain.exact), ("gradient", slope)):
        error = lambda found, exact=exact: abs(float(found) / exact - 1)
        for name, peer in programs.items():
            run = getattr(peer, kind)
            if run is not None:
                print(f"{chain.title}, {kind}, {name}", file=sys.stderr, flush=True)
                curves.append(Curve(chain.title, kind, name, measured(run, error, peer.settings, REPEATS)))
    return curves


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--record", metavar="FILE", type=Path, help="write the curves into a JSON file")
    given = parser.parse_args()
    described = machine(PACKAGES)
    print(described)
    curves = [curve for chain in (four_bar(), pendulum()) for curve in compare(chain)]
    print(
        f"\nTimes at equal error, and over those of jaxmb: × is more than one where jaxmb is faster\n\n{table(curves)}"
    )
    if given.record:
        record(given.record, "peers", described, curves)


if __name__ == "__main__":
    main()
