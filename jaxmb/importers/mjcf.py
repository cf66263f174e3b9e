"""Machines from MJCF, MuJoCo's format, which MuJoCo itself reads."""

from collections.abc import Collection
from typing import Any

import jax
import numpy as np

from .._types import State
from ..parts.shapes import Box, Cylinder, Ellipsoid, Ground, Mesh, Sphere, capsule
from .build import build_scene
from .description import WORLD, Coupling, Joint, Link, LinkKey, Loop, Machine, Mark, TendonPath, rotation_of, unused
from .geometry import color_of
from .mjcf_actuators import read_actuators
from .mjcf_file import compiled, load_mujoco
from .mjcf_refusals import refuse_unknown
from .model import ImportedModel
from .notes import Notes, checked_ignore

_KINDS = ("free", "ball", "slide", "hinge")


def mjcf(source: Any, *, ignore: str | Collection[str] = ()) -> ImportedModel:
    """A machine from MJCF.

    ```python
    model = jaxmb.importers.mjcf("arm.xml", ignore=("collisions", "limits"))
    model.notes, model.coordinates, model.controls
    system = model.scene.compile()
    ```

    MuJoCo reads the file, with its includes, defaults, units and compiler options. Constraints are hard here:
    `connect`, `weld`, `joint` and `tendon` equalities hold exactly, whatever their `solref` and `solimp`; a `weld` with
    zero `torquescale` holds the point only. Several joints of a body become one `spatial.Composite`, with a coordinate
    for each.

    **Arguments:** `source`: a path, the text of a file, or a `mujoco.MjSpec`; `ignore`: elements to leave out, by words
    such as `"collisions"`, `"limits"` and `"friction"`, or by name.

    **Returns:** an `ImportedModel`; its `notes` list the approximations.

    **Raises:** `ValueError` that lists the elements that cannot be imported; `ImportError` without MuJoCo, `pip install
    "jaxmb[import]"`.
    """
    notes = Notes(checked_ignore(ignore))
    mujoco = load_mujoco()
    model, file = compiled(mujoco, source, notes)

    refuse_unknown(mujoco, model, notes)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    names = _Names(mujoco, model)
    machine = Machine(names.model, np.array(model.opt.gravity))
    disabled = {word for word in mujoco.mjtDisableBit.__members__.values() if model.opt.disableflags & int(word)}
    off = {str(word).rpartition("mjDSBL_")[2] for word in disabled}
    if "CONSTRAINT" in off:
        off |= {"EQUALITY", "LIMIT", "FRICTIONLOSS"}
    if "GRAVITY" in off:
        machine.gravity = np.zeros(3)
    _read_links(model, data, names, machine)
    _read_joints(model, data, names, machine, off)
    if "EQUALITY" not in off:
        _read_equalities(mujoco, model, names, machine, notes)
    _read_tendons(mujoco, model, names, machine, off)
    if "ACTUATION" not in off:
        machine.actuators = read_actuators(mujoco, model, names, notes, off)
    _read_marks(model, names, machine)
    _read_shapes(mujoco, model, names, machine, notes)
    built = build_scene(machine, notes)
    sentences = notes.finish(file)
    locate = _Locate(mujoco, model, names, built)
    states = {
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, k) or f"key {k}": locate(model.key_qpos[k], model.key_qvel[k])
        for k in range(model.nkey)
    }
    coordinates = {joint: name for joint, name in built.coordinates.items() if name is not None}
    seen = built.shapes, built.collision_shapes
    return ImportedModel(
        names.model, built.scene, tuple(sentences), coordinates, built.controls, states, *seen, sentences, locate
    )


class _Names:
    """Names of elements by kind and number; elements without a name are numbered."""

    def __init__(self, mujoco: Any, model: Any):
        of_kind = lambda kind: getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        self._find = lambda kind, k: mujoco.mj_id2name(model, of_kind(kind), k)
        self._is_there = lambda kind, name: mujoco.mj_name2id(model, of_kind(kind), name) >= 0
        text = model.names[: model.names.find(b"\0")].decode()
        self.model = text or "model"
        self._model = model

    def __call__(self, kind: str, k: int) -> str:
        return self._find(kind, k) or self._unused(kind, f"{kind} {k}")

    def _unused(self, kind, name):
        return unused(name, lambda candidate: self._is_there(kind, candidate))

    def link(self, k: int) -> LinkKey:
        """A body, or the world."""
        return self("body", k) if k else WORLD

    def joint(self, k: int) -> str:
        """A joint; without a name it is called after its body."""
        return self._find("joint", k) or self._unused("joint", f"{self('body', self._model.jnt_bodyid[k])} joint {k}")


def _read_links(model, data, names, machine):
    for k in range(1, model.nbody):
        turn = rotation_of(model.body_iquat[k])
        name = names("body", k)
        machine.links[name] = Link(
            name,
            mass=float(model.body_mass[k]),
            centre=np.array(model.body_ipos[k]),
            inertia=turn @ np.diag(model.body_inertia[k]) @ turn.T,
            position=np.array(data.xpos[k]),
            rotation=np.array(data.xmat[k]).reshape(3, 3),
        )
        if model.body_mocapid[k] >= 0:
            # Links with prescribed motion may have any mass.
            link = machine.links[name]
            link.moved, link.mass, link.inertia = True, max(link.mass, 1.0), link.inertia + np.eye(3)
        if model.body_gravcomp[k]:
            machine.buoyancy[name] = float(model.body_gravcomp[k])
        if not model.body_jntnum[k] and not machine.links[name].moved:
            parent = names.link(model.body_parentid[k])
            machine.joints.append(Joint("", "fixed", parent, name))


def _read_joints(model, data, names, machine, off):
    fixed, machine.joints = machine.joints, []
    child: LinkKey = WORLD
    for k in range(model.njnt):
        body, dof, q = model.jnt_bodyid[k], model.jnt_dofadr[k], model.jnt_qposadr[k]
        first, last = model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body] - 1
        kind = _KINDS[model.jnt_type[k]]
        parent = names.link(model.body_parentid[body]) if k == first else child
        child = names("body", body)
        if k < last:
            # Massless links lie between joints in succession.
            place = {"position": machine.links[child].position, "rotation": machine.links[child].rotation}
            child = machine.add(Link(f"{child} after {names.joint(k)}", **place))
        scalar = kind in ("hinge", "slide")
        stop = None
        if model.jnt_solref[k][0] > 0 and model.dof_invweight0[dof] > 0:
            time, ratio = model.jnt_solref[k]
            stop = (1 / model.dof_invweight0[dof], time * ratio)
        machine.joints.append(
            Joint(
                names.joint(k),
                kind,
                parent,
                child,
                point=np.array(data.xanchor[k]),
                axis=np.array(data.xaxis[k]),
                reference=float(model.qpos0[q]) if scalar else 0.0,
                stiffness=0.0 if "SPRING" in off else float(model.jnt_stiffness[k]),
                free=float(model.qpos_spring[q]) if scalar else None,
                damping=0.0 if "DAMPER" in off else float(model.dof_damping[dof]),
                armature=float(model.dof_armature[dof]),
                friction=0.0 if "FRICTIONLOSS" in off else float(model.dof_frictionloss[dof]),
                limits=tuple(model.jnt_range[k]) if model.jnt_limited[k] and "LIMIT" not in off else None,
                stop=stop,
            )
        )
    machine.joints += fixed


def _read_equalities(mujoco, model, names, machine, notes):
    kinds = mujoco.mjtEq
    for k in range(model.neq):
        name, data = names("equality", k), np.array(model.eq_data[k])
        if not model.eq_active0[k]:
            notes.say("Equalities that are not active are left out: {}.", name)
            continue
        one, two, kind = model.eq_obj1id[k], model.eq_obj2id[k], kinds(int(model.eq_type[k]))
        if kind == kinds.mjEQ_JOINT:
            zero = lambda j: float(model.qpos0[model.jnt_qposadr[j]])
            others = [(names.joint(two), data[1:5], zero(two))] if two >= 0 else []
            machine.couplings.append(Coupling(name, names.joint(one), data[0], others, zero(one)))
        elif kind == kinds.mjEQ_TENDON:
            machine.couplings.append(_tendon_coupling(mujoco, model, names, name, one, two, data))
        elif kind in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
            machine.loops.append(_loop(mujoco, model, names, name, k, data))
        else:
            what = str(kind).rpartition("mjEQ_")[2].lower()
            notes.refuse("loops", name, f"The equality {name!r} is of type {what}")


def _tendon_coupling(mujoco, model, names, name, one, two, data):
    """A tendon's length as a polynomial of another tendon's, both less their lengths at the reference pose. If this
    relation is a sum of polynomials of joint coordinates, the coupling is between the joints, which may then turn
    without end.
    """
    on_joints = lambda k: model.wrap_type[model.tendon_adr[k]] == mujoco.mjtWrap.mjWRAP_JOINT
    tendons = [one] if two < 0 else [one, two]
    terms: dict[int, np.ndarray] = {}
    for k in tendons if all(map(on_joints, tendons)) else ():
        powers = -data[1:5] if k == two else np.array([1.0, 0, 0, 0])
        for w in range(model.tendon_adr[k], model.tendon_adr[k] + model.tendon_num[k]):
            joint, scale = int(model.wrap_objid[w]), model.wrap_prm[w] ** np.arange(1, 5)
            terms[joint] = terms.get(joint, np.zeros(4)) + powers * scale
    terms = {joint: powers for joint, powers in terms.items() if np.any(powers)}
    first = next((joint for joint, powers in terms.items() if powers[0] and not np.any(powers[1:])), None)
    is_sum = two < 0 or model.tendon_num[two] == 1 or not np.any(data[2:5])
    if first is None or not is_sum:
        length = lambda k: float(model.tendon_length0[k])
        others = [(names("tendon", k), data[1:5], length(k)) for k in tendons[1:]]
        return Coupling(name, names("tendon", one), data[0], others, length(one), of_tendons=True)
    scale, zero = terms.pop(first)[0], lambda j: float(model.qpos0[model.jnt_qposadr[j]])
    others = [(names.joint(j), -powers / scale, zero(j)) for j, powers in terms.items()]
    return Coupling(name, names.joint(first), data[0] / scale, others, zero(first))


def _loop(mujoco, model, names, name, k, data):
    one, two = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
    weld = model.eq_type[k] == mujoco.mjtEq.mjEQ_WELD
    # MuJoCo multiplies the residuals of a weld's rotation by this number: at zero the weld holds the point only.
    holds_rotation = weld and data[10] != 0
    if model.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE:
        a, b = (names.link(model.site_bodyid[site]) for site in (one, two))
        turns = [rotation_of(model.site_quat[site]) for site in (one, two)]
        points = [np.array(model.site_pos[site]) for site in (one, two)]
        return Loop(name, a, b, points[0], points[1], turns[0] @ turns[1].T if holds_rotation else None)
    a, b = names.link(one), names.link(two)
    if weld:
        return Loop(name, a, b, data[3:6], data[0:3], rotation_of(data[6:10]) if holds_rotation else None)
    return Loop(name, a, b, data[0:3], data[3:6])


def _read_tendons(mujoco, model, names, machine, off):
    for k in range(model.ntendon):
        start = model.tendon_adr[k]
        wraps = range(start, start + model.tendon_num[k])
        tendon = TendonPath(
            names("tendon", k),
            stiffness=0.0 if "SPRING" in off else float(model.tendon_stiffness[k]),
            free=float(model.tendon_lengthspring[k][0]),
            damping=0.0 if "DAMPER" in off else float(model.tendon_damping[k]),
            armature=float(model.tendon_armature[k]),
            friction=0.0 if "FRICTIONLOSS" in off else float(model.tendon_frictionloss[k]),
            limits=tuple(model.tendon_range[k]) if model.tendon_limited[k] and "LIMIT" not in off else None,
        )
        if model.tendon_solref_lim[k][0] > 0 and model.tendon_invweight0[k] > 0:
            time, ratio = model.tendon_solref_lim[k]
            tendon.stop = (1 / model.tendon_invweight0[k], time * ratio)
        for w in wraps:
            item = model.wrap_objid[w]
            if model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT:
                tendon.joints.append((names.joint(item), float(model.wrap_prm[w])))
            elif model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_SITE:
                tendon.points.append((names.link(model.site_bodyid[item]), np.array(model.site_pos[item])))
        machine.tendons.append(tendon)


def _read_marks(model, names, machine):
    for k in range(model.nsite):
        link = names.link(model.site_bodyid[k])
        machine.marks.append(Mark(names("site", k), link, np.array(model.site_pos[k]), rotation_of(model.site_quat[k])))


def _read_shapes(mujoco, model, names, machine, notes):
    for k in range(model.ngeom):
        color, number = color_of(model.geom_rgba[k]), model.geom_bodyid[k]
        place = {"position": np.array(model.geom_pos[k]), "orientation": np.array(model.geom_quat[k]), "color": color}
        shapes = [(names.link(number), shape) for shape in _shape(mujoco.mjtGeom, model, k, place)]
        if model.geom_contype[k] or model.geom_conaffinity[k]:
            machine.collisions += shapes
        elif color is not None and not notes.leaves_out("pictures", names("body", number)):
            machine.shapes += shapes


def _shape(kinds, model, k, place):
    """The shapes of a geom; none for height fields and signed distances."""
    size = np.array(model.geom_size[k])
    match kinds(int(model.geom_type[k])):
        case kinds.mjGEOM_PLANE:
            return (Ground(**place),)
        case kinds.mjGEOM_SPHERE:
            return (Sphere(size[0], **place),)
        case kinds.mjGEOM_CAPSULE:
            return capsule(size[0], 2 * size[1], **place)
        case kinds.mjGEOM_ELLIPSOID:
            return (Ellipsoid(size, **place),)
        case kinds.mjGEOM_CYLINDER:
            return (Cylinder(size[0], 2 * size[1], **place),)
        case kinds.mjGEOM_BOX:
            return (Box(2 * size, **place),)
        case kinds.mjGEOM_MESH:
            # As MuJoCo places it, in the mesh's principal axes.
            mesh = model.geom_dataid[k]
            of_mesh = lambda first, count, rows: np.array(rows[first[mesh] : first[mesh] + count[mesh]])
            vertices = of_mesh(model.mesh_vertadr, model.mesh_vertnum, model.mesh_vert)
            return (Mesh(vertices, of_mesh(model.mesh_faceadr, model.mesh_facenum, model.mesh_face), **place),)
    return ()


class _Locate:
    """States of the bodies at the coordinates and velocities of MuJoCo's `model`."""

    def __init__(self, mujoco: Any, model: Any, names: _Names, built: Any):
        self._mujoco, self.model = mujoco, model
        links = {names.link(k): k for k in range(model.nbody)}
        numbers = {carrier.name: links[link] for link, carrier in built.fused.carriers.items()}
        bodies = () if built.scene is None else built.scene.bodies
        self._bodies = [(numbers[body.name], np.asarray(body.centre)) for body in bodies]
        joints = {names.joint(k): k for k in range(model.njnt)}
        tendons = {names("tendon", k): k for k in range(model.ntendon)}
        self._scalars = [((tendons if scalar.of_tendon else joints)[scalar.name], scalar) for scalar in built.scalars]

    def __call__(self, qpos: np.ndarray, qvel: np.ndarray) -> State:
        mujoco, model = self._mujoco, self.model
        qvel = qvel if qvel.size else np.zeros(model.nv)
        if qpos.shape != (model.nq,) or qvel.shape != (model.nv,):
            raise ValueError(f"qpos must have shape ({model.nq},) and qvel ({model.nv},).")
        data = mujoco.MjData(model)
        data.qpos, data.qvel = qpos, qvel
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        q, u = [], []
        for k, centre in self._bodies:
            turn = data.xmat[k].reshape(3, 3)
            velocity = np.zeros(6)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, k, velocity, 0)
            arm = turn @ centre
            q += [*(data.xpos[k] + arm), *data.xquat[k]]
            u += [*(velocity[3:] + np.cross(velocity[:3], arm)), *(turn.T @ velocity[:3])]
        for k, scalar in self._scalars:
            value = data.ten_length[k] if scalar.of_tendon else data.qpos[model.jnt_qposadr[k]]
            q.append(value)
            if scalar.moves:
                u.append(data.ten_velocity[k] if scalar.of_tendon else data.qvel[model.jnt_dofadr[k]])
        return State(jax.device_put(np.array(q)), jax.device_put(np.array(u)))
