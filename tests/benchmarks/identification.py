"""Masses and joint damping of a chain of three links from encoders: `identify` against `mujoco.sysid`, same data.

Both fit the same angles of three joints from the same start. MuJoCo integrates with fourth-order Runge–Kutta at a fixed
step, its Jacobian is by finite differences.

Run it with `python tests/benchmarks/identification.py`; MuJoCo is optional: `pip install "mujoco[sysid]"`.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb import planar

jax.config.update("jax_enable_x64", True)

LINKS, LENGTH, STEP, TIMES, NOISE, REPEATS = 3, 0.5, 0.005, 400, 1e-3, 5
TRUE = {"mass": (1.0, 0.8, 0.5), "damping": (0.3, 0.2, 0.1)}
START = 1.6
INERTIA = 0.02


def chain():
    """The links lie along x at the start, each joint with a viscous damper."""
    bodies, joints, forces = [], [], [mb.Gravity((0.0, -9.81))]
    for k in range(LINKS):
        below = f"link{k - 1}" if k else "ground"
        point = (LENGTH / 2, 0.0) if k else (0.0, 0.0)
        place = ((k + 0.5) * LENGTH, 0.0)
        bodies.append(planar.Body(f"link{k}", mass=TRUE["mass"][k], inertia=INERTIA, position=place))
        joints.append(planar.Revolute(f"joint{k}", below, f"link{k}", point_a=point, point_b=(-LENGTH / 2, 0.0)))
        damping = TRUE["damping"][k]
        forces.append(planar.TorsionalSpringDamper(f"damper{k}", below, f"link{k}", stiffness=0.0, damping=damping))
    return mb.Scene(bodies, joints=joints, forces=forces).compile()


def joint_angles(trajectory):
    """Angles between neighbours, shape (times, links)."""
    absolute = jnp.stack([trajectory[f"link{k}"].angle for k in range(LINKS)], axis=1)
    return jnp.diff(absolute, axis=1, prepend=0.0)


def true_values():
    """The unknowns by name: the mass of the first link moves nothing that its damping does not, so it is known."""
    masses = {f"link{k}.mass": TRUE["mass"][k] for k in range(1, LINKS)}
    return masses | {f"damper{k}.damping": TRUE["damping"][k] for k in range(LINKS)}


def by_jaxmb(system, ts, data):
    """A function that fits once."""
    residual = lambda trajectory: (joint_angles(trajectory) - data) / NOISE
    free = {name: START * value for name, value in true_values().items()}
    return lambda: mb.identify(system, ts=ts, free=free, residual=residual, rtol=1e-6).parameters


XML = """
<mujoco><option timestep="{step}" integrator="RK4"><flag contact="disable"/></option>
<worldbody>{bodies}</worldbody><actuator>{motors}</actuator><sensor>{sensors}</sensor></mujoco>
"""


def by_mujoco(data):
    """A function that fits once, and the largest difference of the motion with the true values from exact angles."""
    import mujoco
    from mujoco import rollout, sysid

    bodies = ""
    for k in reversed(range(LINKS)):
        bodies = (
            f'<body name="link{k}" pos="{LENGTH if k else 0} 0 0"><joint name="joint{k}" type="hinge" axis="0 -1 0" '
            f'damping="{TRUE["damping"][k]}"/><inertial pos="{LENGTH / 2} 0 0" mass="{TRUE["mass"][k]}" '
            f'diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>{bodies}</body>'
        )
    each = lambda text: "".join(text.format(k) for k in range(LINKS))
    motors, sensors = each('<motor joint="joint{0}"/>'), each('<jointpos name="angle{0}" joint="joint{0}"/>')
    spec = mujoco.MjSpec.from_string(XML.format(step=STEP, bodies=bodies, motors=motors, sensors=sensors))
    model = spec.compile()
    start = sysid.create_initial_state(model, np.zeros(LINKS), np.zeros(LINKS), np.zeros(0))
    times = STEP * np.arange(TIMES + 2)
    control = np.zeros((times.size, LINKS))
    state, readings = rollout.rollout(model, mujoco.MjData(model), start, control[:-1])
    # A step's sensors show the state before it.
    seen = np.squeeze(readings, 0)[1:]
    control, measured = sysid.TimeSeries(times, control), np.squeeze(state, 0)[:, 0]
    whole = np.vstack([np.zeros((1, LINKS)), data])
    recorded = sysid.TimeSeries.from_names(measured, whole, model)

    def body(name):
        return lambda spec, parameter: setattr(spec.body(name), "mass", parameter.value[0])

    def joint(name):
        def change(spec, parameter):
            damping = np.array(spec.joint(name).damping, float)
            spec.joint(name).damping = parameter.value[0] if damping.ndim == 0 else [parameter.value[0], 0, 0]

        return change

    modifiers = {name: body(name.split(".")[0]) for name in true_values() if name.endswith("mass")}
    modifiers |= {f"damper{k}.damping": joint(f"joint{k}") for k in range(LINKS)}

    def fit():
        unknown = sysid.ParameterDict()
        for name, value in true_values().items():
            own = sysid.Parameter(name, nominal=value, min_value=0.1 * value, max_value=10 * value)
            own.modifier = modifiers[name]
            unknown.add(own)
            unknown[name].value[:] = START * value
        sequences = sysid.ModelSequences("chain", spec, "swing", start, control, recorded)
        residual = sysid.build_residual_fn(models_sequences=[sequences])
        found, _ = sysid.optimize(initial_params=unknown, residual_fn=residual, optimizer="mujoco", verbose=False)
        return {name: found[name].value[0] for name in true_values()}

    return fit, seen


def main():
    system = chain()
    ts = STEP * jnp.arange(1, TIMES + 1)
    exact = np.asarray(joint_angles(mb.simulate(system, mb.assemble(system), t1=ts[-1], saveat=ts, rtol=1e-10)))
    data = exact + NOISE * np.random.default_rng(0).standard_normal(exact.shape)
    fits = {"jaxmb": by_jaxmb(system, ts, data)}
    try:
        fits["mujoco.sysid"], seen = by_mujoco(data)
        print(f"the two models' motions differ by at most {np.max(np.abs(seen - exact)):.1e} rad")
    except ImportError:
        print('mujoco.sysid is not installed: pip install "mujoco[sysid]"')
    times, found, first = {name: [] for name in fits}, {}, {}
    for repeat in range(REPEATS + 1):
        for name, fit in fits.items():
            began = time.perf_counter()
            found[name] = fit()
            spent = time.perf_counter() - began
            if repeat:
                times[name].append(spent)
            else:
                first[name] = spent
    print(f"{'':16}  {'first [s]':>10}  {'again [s]':>10}  {'largest relative error':>24}")
    for name in fits:
        errors = [abs(float(found[name][key]) / value - 1) for key, value in true_values().items()]
        print(f"{name:16}  {first[name]:10.2f}  {min(times[name]):10.3f}  {max(errors):24.1e}")


if __name__ == "__main__":
    main()
