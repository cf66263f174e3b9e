"""Actuators of MJCF whose force depends on the control and on the length and speed of a joint or tendon."""

from typing import Any

import numpy as np

from .description import Actuator
from .notes import Notes


def read_actuators(mujoco: Any, model: Any, names: Any, notes: Notes) -> list[Actuator]:
    """The actuators of a model; the others are refused."""
    return [
        actuator
        for k in range(model.nu)
        if (actuator := _read(mujoco, model, names, notes, k, names("actuator", k))) is not None
    ]


def _read(mujoco, model, names, notes, k, name):
    transmissions, kind = mujoco.mjtTrn, mujoco.mjtTrn(int(model.actuator_trntype[k]))
    gear, target = np.array(model.actuator_gear[k]), int(model.actuator_trnid[k][0])

    def refuse(what):
        notes.refuse("actuators", name, f"Actuator {name!r} {what}")

    if model.actuator_dyntype[k] != mujoco.mjtDyn.mjDYN_NONE:
        return refuse("has dynamics of its own, such as a filter or a muscle")
    if kind in (transmissions.mjTRN_JOINT, transmissions.mjTRN_JOINTINPARENT):
        if mujoco.mjtJoint(int(model.jnt_type[target])) not in (
            mujoco.mjtJoint.mjJNT_HINGE,
            mujoco.mjtJoint.mjJNT_SLIDE,
        ):
            return refuse("acts on a ball or free joint")
        of = names.joint(target)
    elif kind == transmissions.mjTRN_TENDON:
        of = names("tendon", target)
    else:
        return refuse(f"acts by way of {str(kind).rpartition('mjTRN_')[2].lower()}")
    gains, biases = mujoco.mjtGain, mujoco.mjtBias
    gain, bias = np.array(model.actuator_gainprm[k][:3]), np.array(model.actuator_biasprm[k][:3])
    if model.actuator_gaintype[k] == gains.mjGAIN_FIXED:
        gain[1:] = 0.0
    elif model.actuator_gaintype[k] != gains.mjGAIN_AFFINE:
        return refuse("has a gain that is not affine in length and speed")
    if model.actuator_biastype[k] == biases.mjBIAS_NONE:
        bias[:] = 0.0
    elif model.actuator_biastype[k] != biases.mjBIAS_AFFINE:
        return refuse("has a bias that is not affine in length and speed")
    force_range = tuple(model.actuator_forcerange[k]) if model.actuator_forcelimited[k] else None
    if kind != transmissions.mjTRN_TENDON and model.jnt_actfrclimited[target]:
        own = (model.actuator_trntype == int(kind)) & (model.actuator_trnid[:, 0] == target)
        if np.sum(own) > 1:
            return refuse(f"shares the limit of the actuator force of joint {of!r} with others")
        own = np.sort(np.array(model.jnt_actfrcrange[target]) / gear[0])
        given = own if force_range is None else np.array(force_range)
        force_range = (max(own[0], given[0]), min(own[1], given[1]))
    return Actuator(
        name,
        of,
        gear=float(gear[0]),
        gain=tuple(gain),
        bias=tuple(bias),
        control_range=tuple(model.actuator_ctrlrange[k]) if model.actuator_ctrllimited[k] else None,
        force_range=force_range,
    )
