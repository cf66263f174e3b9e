"""Actuators of MJCF whose force depends on the control and on the length and speed of a joint or tendon."""

from collections.abc import Collection
from typing import Any

import numpy as np

from .description import ActuatorElement
from .notes import Notes


def read_actuators(mujoco: Any, model: Any, names: Any, notes: Notes, off: Collection[str]) -> list[ActuatorElement]:
    """The actuators of a model; unsupported actuators are refused. `off`: names of MuJoCo's flags that are disabled."""
    out = []
    for k in range(len(model.actuator_trntype)):
        name = names("actuator", k)
        if model.opt.disableactuator & (1 << int(model.actuator_group[k])):
            notes.say("Actuators of disabled groups are left out: {}.", name)
            continue
        actuator = _read(mujoco, model, names, notes, k, name)
        if actuator is not None:
            if "CLAMPCTRL" in off:
                actuator.control_range = None
            out.append(actuator)
    return out


def _read(mujoco, model, names, notes, k, name):
    transmissions, kind = mujoco.mjtTrn, mujoco.mjtTrn(int(model.actuator_trntype[k]))
    target = int(model.actuator_trnid[k][0])
    # Before MuJoCo 4 every actuator has one control and one force.
    control, out = (int(getattr(model, f"actuator_{word}adr", range(model.nu))[k]) for word in ("ctrl", "out"))
    gear = float(model.actuator_gear[out][0])
    control_range = tuple(model.actuator_ctrlrange[control]) if model.actuator_ctrllimited[control] else None
    if kind == transmissions.mjTRN_BODY:
        # Shapes that may touch are ignored, or the model is refused.
        notes.say("Adhesion acts in contacts only, and there are none here: {}.", name)
        return None

    def refuse(what):
        notes.refuse("actuators", name, f"Actuator {name!r} {what}")

    dynamics, lag = mujoco.mjtDyn(int(model.actuator_dyntype[k])), None
    if dynamics in (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT):
        lag = float(model.actuator_dynprm[k][0])
        if lag <= 0:
            return refuse("has a filter whose time constant is not positive")
        if model.actuator_actlimited[k] and not _within(control_range, model.actuator_actrange[k]):
            return refuse("has a range of activation that the control may leave")
    elif dynamics != mujoco.mjtDyn.mjDYN_NONE:
        return refuse("has dynamics other than a filter, such as an integrator or a muscle")
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
    # An actuator with the gear 0 exerts no force, so a limit has no effect.
    if kind != transmissions.mjTRN_TENDON and model.jnt_actfrclimited[target] and gear:
        if len(_acting_on(mujoco, model, target)) > 1:
            return refuse(f"shares the limit of the actuator force of joint {of!r} with others")
        limits = np.sort(np.array(model.jnt_actfrcrange[target]) / gear)
        given = limits if force_range is None else np.array(force_range)
        force_range = (max(limits[0], given[0]), min(limits[1], given[1]))
    if kind == transmissions.mjTRN_TENDON:
        for joint in np.flatnonzero(model.jnt_actfrclimited):
            if k in _acting_on(mujoco, model, joint):
                return refuse(f"acts on joint {names.joint(joint)!r}, which limits the force of its actuators")
    return ActuatorElement(
        name,
        of,
        on_tendon=kind == transmissions.mjTRN_TENDON,
        gear=gear,
        gain=tuple(gain),
        bias=tuple(bias),
        control_range=control_range,
        force_range=force_range,
        lag=lag,
    )


def _acting_on(mujoco, model, joint):
    """Indices of the actuators that may act on a joint, directly or through a tendon."""
    kinds, numbers = mujoco.mjtTrn, []
    for k, (number, (target, _)) in enumerate(zip(model.actuator_trntype, model.actuator_trnid, strict=True)):
        kind = kinds(int(number))
        if kind == kinds.mjTRN_BODY:
            continue
        if kind == kinds.mjTRN_TENDON:
            wraps = range(model.tendon_adr[target], model.tendon_adr[target] + model.tendon_num[target])
            is_other = lambda w: model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT and model.wrap_objid[w] != joint
            if not all(is_other(w) for w in wraps):
                numbers.append(k)
        elif kind not in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT) or target == joint:
            numbers.append(k)
    return numbers


def _within(control_range, activation_range):
    """Whether a filtered control never leaves the range of its activation, which starts at zero."""
    if control_range is None:
        return False
    (low, high), (least, most) = control_range, activation_range
    return least <= min(low, 0.0) and max(high, 0.0) <= most
