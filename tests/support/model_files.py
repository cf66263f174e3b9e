"""Texts of model files, and MuJoCo's motions of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb.formulations import Multipliers, accelerations

mujoco = pytest.importorskip("mujoco")

OFF = ("collisions", "limits", "friction")


def file(bodies, more="", head=""):
    """An MJCF text whose shapes do not collide."""
    default = '<default><geom contype="0" conaffinity="0"/></default>'
    return f"<mujoco>{head}{default}<worldbody>{bodies}</worldbody>{more}</mujoco>"


HINGE = '<joint name="hip" axis="0 1 0"/>'
ROD = '<geom type="capsule" fromto="0 0 0 .3 .05 -.1" size=".03"/>'


def rod(name, joints, inner="", pos=".3 0 0"):
    return f'<body name="{name}" pos="{pos}">{joints}{ROD}{inner}</body>'


def part(model, name):
    scene = model.scene
    return next(own for own in (*scene.bodies, *scene.joints, *scene.forces, *scene.frames) if own.name == name)


def kinds(model):
    return {own.name: own.kind for own in (*model.scene.joints, *model.scene.forces, *model.scene.frames)}


# URDF

INERTIAL = (
    '<inertial><origin xyz=".1 0 .02" rpy="0 .3 0"/><mass value="2"/>'
    '<inertia ixx=".02" iyy=".05" izz=".04" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def robot(*elements):
    return "<robot name='r'>\n" + "\n".join(elements) + "\n</robot>"


def link(name, inside=INERTIAL):
    return f"<link name='{name}'>{inside}</link>"


def joint(name, parent, child, kind="revolute", inside="<axis xyz='0 1 0'/>"):
    ends = f"<parent link='{parent}'/><child link='{child}'/><origin xyz='.3 0 .1' rpy='0 0 .5'/>"
    return f"<joint name='{name}' type='{kind}'>{ends}{inside}</joint>"


# SDF

MASS = "<inertial><mass>1</mass><inertia><ixx>.02</ixx><iyy>.05</iyy><izz>.04</izz></inertia></inertial>"


def model(*elements):
    return "<sdf version='1.6'><model name='m'>\n" + "\n".join(elements) + "\n</model></sdf>"


def body(name, pose="0 0 0 0 0 0", inside=MASS):
    return f"<link name='{name}'><pose>{pose}</pose>{inside}</link>"


def hinge(name, parent, child, pose="0 0 0 0 0 0", kind="revolute", axis="<xyz>0 1 0</xyz>"):
    ends = f"<parent>{parent}</parent><child>{child}</child>"
    return f"<joint name='{name}' type='{kind}'><pose>{pose}</pose>{ends}<axis>{axis}</axis></joint>"


# Accelerations and energies


def random_states(model, count, *, scale=1.0, seed=0):
    """MuJoCo's coordinates, of joints with limits between these, and velocities."""
    random = np.random.default_rng(seed)
    limited = np.flatnonzero(model.jnt_limited & (model.jnt_type >= 2))
    for _ in range(count):
        q = model.qpos0.copy()
        mujoco.mj_integratePos(model, q, scale * random.normal(size=model.nv), 1.0)
        q[model.jnt_qposadr[limited]] = random.uniform(*model.jnt_range[limited].T)
        yield q, random.normal(size=model.nv)


def body_accelerations(model, data, imported):
    """Accelerations of the mass centres and angular ones in body axes, of the bodies that MuJoCo has."""
    out = {}
    for k, body in enumerate(imported.scene.bodies):
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body.name)
        if number < 0:  # It has no name in the file.
            continue
        turn = data.xmat[number].reshape(3, 3)
        centre = data.xpos[number] + turn @ np.asarray(body.centre)
        moves, turns, more_moves, more_turns = (np.zeros((3, model.nv)) for _ in range(4))
        mujoco.mj_jac(model, data, moves, turns, centre, number)
        mujoco.mj_jacDot(model, data, more_moves, more_turns, centre, number)
        linear = moves @ data.qacc + more_moves @ data.qvel
        out[k] = np.append(linear, turn.T @ (turns @ data.qacc + more_turns @ data.qvel))
    return out


def check_dynamics(imported, count=20, *, scale=1.0):
    """Accelerations, energies and rates of activations are MuJoCo's, without what jaxmb approximates, at random states,
    controls and activations.
    """
    model = imported.locate.model
    bits = mujoco.mjtDisableBit
    model.opt.disableflags |= int(bits.mjDSBL_CONTACT | bits.mjDSBL_LIMIT | bits.mjDSBL_FRICTIONLOSS)
    data = mujoco.MjData(model)
    system = imported.scene.compile()
    states = list(random_states(model, count, scale=scale))
    random = np.random.default_rng(1)
    controls, activations = (random.normal(size=(count, size)) for size in (model.nu, model.na))
    names = list(imported.controls.values())
    # Those without a name are numbered.
    known = {model.actuator(k).name or f"actuator {k}": k for k in range(model.nu)}
    numbers = [known[own] for own in imported.controls]
    # Activations have the order of the actuators there, that of the groups of parts here.
    filtered = {
        name.replace(".control", ".activation"): model.actuator_actadr[k]
        for k, name in zip(numbers, names, strict=True)
    }
    order = np.array([filtered[name] for name in system.state_names()], int)

    @jax.jit
    def evaluate(q, u, z, control):
        own = mb.with_parameters(system, dict(zip(names, control, strict=True))) if names else system
        own = own.with_states(z) if model.na else own
        udot, _ = accelerations(own, Multipliers(), 0.0, q, u)
        unmet = jnp.max(jnp.abs(own.velocity_residual(0.0, q, u)), initial=0.0)
        rates = own.state_rates(0.0, q, u) if model.na else z
        return udot, rates, own.kinetic_energy(0.0, q, u), own.potential_energy(0.0, q), unmet

    offset = None
    for (q, v), control, activation in zip(states, controls, activations, strict=True):
        data.qpos, data.qvel, data.ctrl, data.act = q, v, control, activation
        mujoco.mj_forward(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        state = imported.state(q, v)
        found = evaluate(state.q, state.u, activation[order], list(control[numbers]))
        udot, rates, kinetic, potential, unmet = jax.tree.map(np.asarray, found)
        np.testing.assert_allclose(rates, data.act_dot[order], rtol=1e-12, atol=0)
        assert unmet < 1e-12
        expected = body_accelerations(model, data, imported)
        found = udot[: 6 * system.layout.bodies].reshape(-1, 6)[list(expected)]
        size = np.max(np.abs(list(expected.values())))
        np.testing.assert_allclose(found, list(expected.values()), rtol=0, atol=1e-9 * size)
        potential_there, kinetic_there = data.energy
        assert kinetic == pytest.approx(kinetic_there, rel=1e-10)
        # Bodies that are fixed to the world have a weight in MuJoCo.
        offset = potential_there - potential if offset is None else offset
        scale_of_energy = abs(kinetic_there) + abs(potential_there) + abs(offset)
        assert potential + offset == pytest.approx(potential_there, abs=1e-10 * scale_of_energy)
    return system
