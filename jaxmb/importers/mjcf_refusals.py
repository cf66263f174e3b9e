"""Elements of MJCF that are refused, and elements without effect on a motion."""

from typing import Any

import numpy as np

from .notes import Notes

# Numbers that must vanish, by their field of the model: the kind of element, a description, and the word of `ignore`.
_MUST_VANISH = {
    "jnt_stiffnesspoly": ("joint", "nonlinear stiffness", "springs"),
    "jnt_springyield": ("joint", "plastic springs", "springs"),
    "dof_dampingpoly": ("dof", "nonlinear damping", "damping"),
    "tendon_stiffnesspoly": ("tendon", "nonlinear stiffness", "tendons"),
    "tendon_dampingpoly": ("tendon", "nonlinear damping", "tendons"),
    "tendon_springyield": ("tendon", "plastic springs", "tendons"),
    "tendon_actfrclimited": ("tendon", "limits of the actuator force", "tendons"),
    "actuator_armature": ("actuator", "armature", "actuators"),
    "actuator_damping": ("actuator", "damping", "actuators"),
    "actuator_dampingpoly": ("actuator", "nonlinear damping", "actuators"),
    "actuator_delay": ("actuator", "delays", "actuators"),
    "jnt_actgravcomp": ("joint", "actuators that compensate gravity", "actuators"),
}


def refuse_unknown(mujoco: Any, model: Any, notes: Notes) -> None:
    """Refuse elements without a counterpart, and note unread elements without effect on a motion."""
    named = lambda kind, k: (
        mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), k) or f"{kind} {k}"
    )
    for field, (kind, what, leave) in _MUST_VANISH.items():
        for k in _set(getattr(model, field, np.zeros(0))):
            name = named("joint", model.dof_jntid[k]) if kind == "dof" else named(kind, k)
            notes.refuse(leave, name, f"{'Joint' if kind == 'dof' else kind.capitalize()} {name!r} has {what}")
    for k in range(model.ntendon):
        _check_tendon(mujoco, model, notes, k, named("tendon", k))
    pairs = _colliding(mujoco, model)
    if pairs and not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
        listed = ", ".join(sorted({named("body", b) for b in pairs})[:6])
        notes.refuse("collisions", "", f"Shapes of {len(pairs)} bodies may collide ({listed}, …)")
    if model.nflex:
        notes.refused.append("Deformable bodies (flex) are not modelled; remove them from the file.")
    if model.nplugin:
        notes.refused.append("Plugins are not supported; remove them from the file.")
    if model.opt.density or model.opt.viscosity:
        notes.refuse("fluid", "", "A fluid is not modelled: set density and viscosity of <option> to zero")
    effectless = {
        "cameras": model.ncam,
        "lights": model.nlight,
        "height fields": model.nhfield,
    }
    listed = ", ".join(f"{number} {what}" for what, number in effectless.items() if number)
    if listed:
        notes.say(f"Not read, since they do not act on the motion: {listed}.")
    if np.any(model.key_ctrl) or np.any(model.key_act):
        notes.say(
            "Controls and activations of keyframes are not read: give them with the parameters in `controls`, and to "
            "assemble as fix={'motor.activation': …}."
        )
    if model.neq:
        notes.say("Equalities hold exactly: their solref and solimp have no effect.")
    mocap = np.flatnonzero(model.body_mocapid >= 0)
    if mocap.size:
        notes.say(
            "Mocap bodies are held by a joint, whose point_a and orientation may be inputs: {}.",
            *(named("body", k) for k in mocap),
        )


def _set(values):
    """Indices of the elements with a nonzero entry."""
    values = np.asarray(values)
    return np.flatnonzero(np.any(values.reshape(len(values), -1) != 0, axis=1)) if values.size else ()


def _check_tendon(mujoco, model, notes, k, name):
    start = model.tendon_adr[k]
    wraps = {int(wrap) for wrap in model.wrap_type[start : start + model.tendon_num[k]]}
    plain = {int(mujoco.mjtWrap.mjWRAP_JOINT), int(mujoco.mjtWrap.mjWRAP_SITE)}
    if wraps - plain:
        notes.refuse("tendons", name, f"Tendon {name!r} wraps around shapes or pulleys")
    lower, upper = model.tendon_lengthspring[k]
    if model.tendon_stiffness[k] and lower != upper:
        notes.refuse("tendons", name, f"The spring of tendon {name!r} has a slack range")


def _colliding(mujoco, model):
    """Indices of moving bodies whose shapes may collide with another body."""
    types: dict[tuple[int, int, int], set[int]] = {}
    for g in range(model.ngeom):
        mask = int(model.geom_contype[g]), int(model.geom_conaffinity[g])
        if any(mask):
            body = int(model.geom_bodyid[g])
            types.setdefault((int(model.body_weldid[body]), *mask), set()).add(body)
    excluded = {int(pair) for pair in np.asarray(model.exclude_signature)}
    colliding = set()
    for (i, type_i, affinity_i), bodies_i in types.items():
        for (j, type_j, affinity_j), bodies_j in types.items():
            if i == j or not (type_i & affinity_j or type_j & affinity_i):
                continue
            for a in bodies_i:
                for b in bodies_j:
                    if (min(a, b) << 16) + max(a, b) not in excluded:
                        colliding |= {k for k in (a, b) if model.body_weldid[k]}
    for k in range(model.npair):
        colliding |= {int(model.geom_bodyid[geom]) for geom in (model.pair_geom1[k], model.pair_geom2[k])} - {0}
    return colliding
