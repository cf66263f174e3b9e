"""Scenes as MJCF, read back."""

from typing import ClassVar

import jax
import numpy as np
import pytest
from model_files import check_dynamics, random_states

import jaxmb as mb
from jaxmb import importers, parts, spatial
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.importers.description import rotation_of

MOST_PROGRAMS = 100

mujoco = pytest.importorskip("mujoco")


def small_scene():
    body = lambda name, x, **more: spatial.Body(
        name, mass=1.0, inertia=(0.02, 0.09, 0.07), position=(x, 0.0, 0.0), **more
    )
    bodies = [body("arm", 0.5), body("hand", 1.5), body("float", 3.0, orientation=(0.8, 0.0, 0.6, 0.0))]
    joints = [
        spatial.Revolute("hip", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)),
        spatial.Prismatic("reach", "hand", "arm", point=(1.0, 0.0, 0.0), axis=(0.6, 0.0, 0.8)),
        mb.JointInertia("rotor", "hip.angle", inertia=0.2),
        mb.JointInertia("second rotor", "hip.angle", inertia=0.05),
        mb.FixedTendon("cord", ("hip.angle", "reach.displacement"), coefficients=(0.3, 0.5)),
        mb.JointInertia("drum", "cord.length", inertia=0.1),
        mb.Tendon("rope", [("ground", (0.0, 0.0, 1.0)), ("arm", (0.2, 0.0, 0.1)), ("hand", (0.0, 0.1, 0.0))]),
    ]
    forces = [
        mb.Gravity((0.0, 0.0, -9.81)),
        mb.JointSpring("spring", "hip.angle", stiffness=3.0, damping=0.2, free=0.3),
        mb.JointSpring("pull", "rope.length", stiffness=3.0, free=0.5),
        mb.Actuator("motor", "reach.displacement", gear=2.0, gain=(5.0, 0.0, 0.0), bias=(0.0, -5.0, -1.0)),
        mb.Actuator("winch", "cord.length", gear=2.0),
        spatial.SpringDamper("rubber", "hand", "float", stiffness=20.0, damping=0.5, free_length=0.8),
    ]
    return mb.Scene(bodies, joints=joints, forces=forces, frames=[spatial.Frame("tip", "hand", position=(0.1, 0, 0))])


@pytest.mark.slow
def test_export_of_a_scene_as_mujoco_reads_it():
    system = small_scene().compile()
    exported = importers.to_mjcf(system)
    model = mujoco.MjModel.from_xml_string(exported.text)
    assert (model.nbody, model.njnt, model.ntendon, model.nu, model.nsite) == (4, 3, 3, 2, 6)
    # The slide holds the arm on the hand, and the arm is the parent: its axis points the other way.
    np.testing.assert_allclose(model.joint("reach").axis, [-0.6, 0.0, -0.8], atol=1e-15)
    assert model.joint("hip").stiffness[0] == 3.0 and model.qpos_spring[model.joint("hip").qposadr[0]] == 0.3
    assert model.dof_armature[model.joint("hip").dofadr[0]] == pytest.approx(0.25, rel=1e-15)
    assert model.tendon_armature[model.tendon("cord").id] == 0.1
    back = importers.mjcf(exported.text)
    assert [body.name for body in back.scene.bodies] == ["arm", "hand", "float"]
    assert back.coordinates == {"hip": "hip.angle", "reach": "reach.displacement"}


def accelerations_at(system, state):
    udot, _ = jax.jit(lambda q, u: accelerations(system, Multipliers(), 0.0, q, u))(state.q, state.u)
    return np.asarray(udot)


@pytest.mark.slow
def test_export_read_back_moves_alike():
    system = small_scene().compile()
    state = mb.assemble(system, fix={"hip.angle": 0.4, "reach.displacement": 0.2}, rates={"hip.angle": 1.0})
    back = importers.mjcf(importers.to_mjcf(system, state).text)
    again = check_dynamics(back, 5, scale=0.3)
    # It has one rotor in place of two, and where the other has its coordinate it counts turns for the spring.
    one = mb.State(state.q, np.delete(state.u, again.nu - 2))
    expected = np.delete(accelerations_at(system, state), again.nu - 2)
    np.testing.assert_allclose(accelerations_at(again, one), expected, rtol=0, atol=1e-11)


def hinged(*forces, joints=(), angle=0.0, other=0.0):
    """MuJoCo's model of two arms on hinges at some angles, and the notes."""
    bodies, hinges = [], []
    axes = {"axis": (0.0, 0.0, 1.0), "x_a": (1.0, 0.0, 0.0), "x_b": (1.0, 0.0, 0.0)}
    for name, turn in (("hinge", angle), ("pin", other)):
        attitude = (np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2))
        bodies.append(spatial.Body(f"arm of {name}", mass=1.0, inertia=(0.02, 0.09, 0.07), orientation=attitude))
        hinges.append(spatial.Revolute(name, "ground", f"arm of {name}", point=(0.0, 0.0, 0.0), **axes))
    system = mb.Scene(bodies, joints=[*hinges, *joints], forces=forces).compile()
    exported = importers.to_mjcf(system)
    return mujoco.MjModel.from_xml_string(exported.text), exported.notes


@pytest.mark.slow
def test_export_adds_up_what_several_parts_of_a_joint_do():
    spring = lambda name, **more: mb.JointSpring(name, "hinge.angle", free=0.1, **more)
    stop = lambda name, *ends: mb.JointStop(name, "hinge.angle", lower=ends[0], upper=ends[1], stiffness=1e3)
    rub = lambda name, force: mb.JointFriction(name, "hinge.angle", force=force)
    springs = spring("a", stiffness=2.0, damping=0.1), spring("b", stiffness=0.0, damping=0.3)
    model, _ = hinged(*springs, rub("c", 0.2), rub("d", 0.5), stop("e", -1.0, 0.6), stop("f", -0.8, 0.9))
    assert model.dof_frictionloss[0] == pytest.approx(0.7, rel=1e-15)
    assert model.dof_damping[0] == pytest.approx(0.4, rel=1e-15)
    assert model.jnt_stiffness[0] == 2.0 and model.qpos_spring[0] == 0.1
    np.testing.assert_array_equal(model.jnt_range[0], [-0.8, 0.6])
    with pytest.raises(ValueError, match="JointStop 'b' cannot be expressed"):
        hinged(stop("a", -1.0, -0.6), stop("b", 0.2, 0.9))
    ball = spatial.Body("ball", mass=1.0, inertia=(1.0, 1.0, 1.0))
    oil = [spatial.RotationalDamper(name, "ground", "ball", damping=c) for name, c in (("a", 0.02), ("b", 0.05))]
    socket = spatial.Spherical("socket", "ground", "ball", point=(0.0, 0.0, 0.0))
    text = importers.to_mjcf(mb.Scene([ball], joints=[socket], forces=oil).compile()).text
    np.testing.assert_allclose(mujoco.MjModel.from_xml_string(text).dof_damping, 0.07, rtol=1e-15)


TURN = 2 * np.pi


COUNTED = [
    (3.0, {"a": {"free": -3.0}}, 6.0 - TURN, ("'a'.",)),
    (3.5, {"a": {"free": 3.2, "middle": 4.0}}, 0.3, ()),
    (3.5, {"a": {"free": -7.0, "middle": -8.0}}, 10.5 - 2 * TURN, ()),
    (
        3.5,
        {"a": {"free": 3.2, "middle": 4.0}, "b": {"free": -1.0, "middle": -2.0, "stiffness": 6.0}},
        (2.0 * 0.3 + 6.0 * (4.5 - TURN)) / 8.0,
        ("'a', 'b'.",),
    ),
]


def test_export_of_springs_counts_the_turns_of_an_angle():
    """What is written is right at the given pose; a note says where MuJoCo counts on otherwise."""
    for angle, springs, stretch, noted in COUNTED:
        forces = [mb.JointSpring(name, "hinge.angle", **({"stiffness": 2.0} | own)) for name, own in springs.items()]
        model, notes = hinged(*forces, angle=angle)
        assert model.qpos0[0] - model.qpos_spring[0] == pytest.approx(stretch, rel=1e-13)
        after = [note.rpartition("; MuJoCo counts it on from the given pose: ")[2] for note in notes]
        assert after == list(noted)


def test_export_of_stops_and_actuators_counts_the_turns_of_an_angle():
    """At 3.5 rad, which MuJoCo has less a full turn."""
    stop = mb.JointStop("stop", "hinge.angle", lower=3.0, upper=4.0, stiffness=1e3)
    servo = mb.Actuator(
        "servo", "hinge.angle", gear=1.5, gain=(5.0, 0.3, 0.1), bias=(0.2, -5.0, -1.0), middle=4.0, control=0.7
    )
    model, notes = hinged(stop, servo, angle=3.5)
    assert model.qpos0[0] == pytest.approx(3.5 - TURN, rel=1e-14)
    np.testing.assert_allclose(model.jnt_range[0], [3.0 - TURN, 4.0 - TURN], rtol=1e-14)
    data = mujoco.MjData(model)
    data.ctrl[0] = 0.7
    mujoco.mj_forward(model, data)
    # f = (5 + 0.3 l) control + 0.2 − 5 l with l = 1.5 · 3.5.
    assert data.actuator_force[0] == pytest.approx((5 + 0.3 * 5.25) * 0.7 + 0.2 - 5 * 5.25, rel=1e-13)
    assert notes == ("Stops are MuJoCo's limits, with its stiffness: 'stop'.",)


@pytest.mark.slow(but=("coupled",))
@pytest.mark.parametrize(
    "equality",
    [
        mb.JointDriver("drive", "hinge.angle", value=3.5),
        # 0.5 = −0.5 + 2 (3.5 − 3), and 3.5 − 3 = 1 − 0.5 + 0 · 0.5².
        mb.JointCoupling("gear", "pin.angle", "hinge.angle", coefficients=(-0.5, 2.0), zero=0.0, other_zero=3.0),
        mb.JointCoupling("gear", "hinge.angle", "pin.angle", coefficients=(1.0, -1.0, 0.0), zero=3.0, other_zero=0.0),
    ],
    ids=["driven", "follows", "coupled"],
)
def test_export_of_equalities_counts_the_turns_of_an_angle(equality):
    """They hold where they hold here, at 3.5 rad, which MuJoCo has less a full turn."""
    model, _ = hinged(joints=[equality], angle=3.5, other=0.5)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.efc_pos, [0.0], atol=1e-14)


@pytest.mark.slow
def test_export_of_a_cord_that_has_wound_up():
    """Its length counts full turns of the hinge, of which MuJoCo's has none at the given pose; −1 is a free length."""
    body = spatial.Body("arm", mass=1.0, inertia=(0.02, 0.09, 0.07))
    hinge = spatial.Revolute("hinge", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    cord = mb.FixedTendon("cord", "hinge.angle", coefficients=(0.3,))
    spring = mb.JointSpring("spring", "cord.length", stiffness=2.0, free=0.5)
    servo = mb.Actuator("servo", "cord.length", gear=1.5, bias=(0.2, -5.0, -1.0))
    system = mb.Scene([body], joints=[hinge, cord], forces=[spring, servo]).compile()
    wound = mb.State(system.guess.q.at[-1].set(2 * TURN), system.guess.u)
    model = mujoco.MjModel.from_xml_string(importers.to_mjcf(system, wound).text)
    np.testing.assert_allclose(model.tendon_lengthspring[0], 0.5 - 0.6 * TURN, rtol=1e-14)
    assert model.actuator_biasprm[0, 0] == pytest.approx(0.2 - 5.0 * 1.5 * 0.6 * TURN, rel=1e-14)
    cord = mb.FixedTendon("cord", "hinge.angle", coefficients=(1.0,))
    model, _ = hinged(mb.JointSpring("a", "cord.length", stiffness=2.0, free=-1.0), joints=[cord], angle=0.3)
    np.testing.assert_allclose(model.tendon_lengthspring[0], -1.0, rtol=1e-15)


# Those of the library that MuJoCo can express. `rolling_disc`, `net`, `swash_plate`, `double_wishbone` and
# `spherical_four_bar` have constraints or forces that it has not.
MACHINES = ("heavy_top", "free_body", "spatial_slider_crank", "bricard", "bennett", "spatial_loop", "cable")


@pytest.mark.slow
@pytest.mark.parametrize("name", MACHINES)
def test_export_of_machines_of_the_library_read_back(name):
    own = mb.mechanisms.get(name)
    system = importers.mjcf(importers.to_mjcf(own.system, own.state).text).scene.compile()
    assert system.nu - system.velocity_rank == own.system.nu - own.system.velocity_rank
    order = np.array([own.system.body_names.index(body) for body in system.body_names])
    theirs, here = (
        jax.jit(lambda q, u, system=system: accelerations(system, Multipliers(), 0.0, q, u)[0])
        for system in (own.system, system)
    )
    random = np.random.default_rng(0)
    for _ in range(3):
        q = own.state.q + 0.05 * np.asarray(own.system.coordinate_scale()) * random.normal(size=own.state.q.shape)
        u = own.state.u + np.asarray(own.system.velocity_scale()) * random.normal(size=own.state.u.shape)
        given = mb.assemble(own.system, mb.State(q, u))
        places, speeds = own.system.poses(given.q), own.system.velocities(given.u)
        expected = np.asarray(theirs(given.q, given.u)).reshape(-1, 6)[order]
        found = np.asarray(here(places[order].reshape(-1), speeds[order].reshape(-1))).reshape(-1, 6)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.max(np.abs(expected)))


@pytest.mark.slow
def test_export_of_an_overconstrained_machine_is_assembled_from_rough_poses():
    """Two points on the last axis close Bennett's linkage: four rows of 21 are implied, and contradict each other in
    the square of the distance.
    """
    own = mb.mechanisms.get("bennett")
    scene, random = importers.mjcf(importers.to_mjcf(own.system, own.state).text).scene, np.random.default_rng(0)
    for off in (1e-9, 1e-6, 1e-3, 1e-2):
        moved = [
            body.with_fields(position=np.asarray(body.position) + off * random.normal(size=3)) for body in scene.bodies
        ]
        system = mb.Scene(moved, joints=scene.joints, forces=scene.forces).compile()
        assert system.nu - system.velocity_rank == 1
        residual = system.position_residual(0.0, mb.assemble(system).q)
        assert np.max(np.abs(residual)) < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize("name", ["spatial_slider_crank", "bennett", "cable"])
def test_export_of_machines_of_the_library_in_mujoco(name):
    """Without the constraints that close loops, accelerations and energies are MuJoCo's; these have its residuals."""
    own = mb.mechanisms.get(name)
    text = importers.to_mjcf(own.system, own.state).text
    opened = importers.mjcf(text, ignore="loops")
    opened.locate.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)
    check_dynamics(opened, 5, scale=0.3)

    closed = importers.mjcf(text)
    model, system = closed.locate.model, closed.scene.compile()
    rows, data = [part for part, _ in system.rows], mujoco.MjData(model)
    assert np.all(model.eq_type == mujoco.mjtEq.mjEQ_CONNECT)
    for q, v in random_states(model, 5, scale=0.3):
        data.qpos, data.qvel = q, v
        mujoco.mj_forward(model, data)
        residual = np.asarray(system.position_residual(0.0, closed.state(q, v).q))
        for k in range(model.neq):
            theirs = data.efc_pos[(data.efc_type == 0) & (data.efc_id == k)]
            here = residual[rows.index(model.equality(k).name) :][:3]
            assert np.linalg.norm(here) == pytest.approx(np.linalg.norm(theirs), rel=1e-10)


class Revolute(parts.AbstractSpatialPart, parts.AbstractJoint):
    """A ball joint of a user's with the name of a hinge."""

    rows: ClassVar[int] = 3

    def residual(self, space, poses, t):
        return parts.separation(space, self, poses)


class Hinge(spatial.Revolute):
    """A hinge of a user's with a damping of its own, which nothing reads here."""

    damping: parts.Number = parts.parameter(unit="N m s/rad", default=0.1)


class Loose(Hinge):
    """A hinge whose axes may tilt."""

    rows: ClassVar[int] = 3

    def residual(self, space, poses, t):
        return parts.separation(space, self, poses)


class Stiffening(mb.JointSpring):
    """A spring with another law."""

    def wrenches(self, space, poses, velocities, t):
        return self.force_along(space, poses, velocities, lambda x, v: -self.stiffness * x**3)


def exported(joint, *forces):
    body = spatial.Body("body", mass=1.0, inertia=(1.0, 1.0, 1.0))
    return importers.to_mjcf(mb.Scene([body], joints=[joint], forces=forces).compile()).text


AT, ABOUT = {"point": (0.0, 0.0, 0.2)}, {"axis": (0.0, 1.0, 0.0)}


def test_export_writes_what_a_joint_says_of_itself_and_not_what_its_class_is_called():
    model = mujoco.MjModel.from_xml_string(exported(Hinge("joint", "ground", "body", **AT, **ABOUT)))
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_HINGE
    np.testing.assert_allclose((model.jnt_axis[0], model.jnt_pos[0]), ((0, 1, 0), (0, 0, 0.2)), atol=1e-15)
    for joint in (Revolute("joint", "ground", "body", **AT), Loose("joint", "ground", "body", **AT, **ABOUT)):
        with pytest.raises(ValueError, match=f"{joint.kind} 'joint' cannot be expressed"):
            exported(joint)


def test_export_of_what_mujoco_cannot_express_is_refused():
    body = spatial.Body("body", mass=1.0, inertia=(1.0, 1.0, 1.0))
    hinge = spatial.Revolute("joint", "ground", "body", **AT, **ABOUT)
    rod = spatial.Distance("rod", "ground", "body", point_a=(0, 0, 2.0))
    for joints, forces, message in (
        ([rod], [], "Distance 'rod' cannot be expressed where"),
        ([], [spatial.PointForce("push", "body", force=(1.0, 0, 0))], "PointForce 'push' cannot be expressed"),
        ([hinge], [Stiffening("spring", "joint.angle", stiffness=1.0)], "Stiffening 'spring' cannot be expressed"),
    ):
        system = mb.Scene([body], joints=joints, forces=forces).compile()
        with pytest.raises(ValueError, match=message):
            importers.to_mjcf(system)
        assert "<body" in importers.to_mjcf(system, ignore=[own.name for own in (*joints, *forces)]).text


# Joints in succession that turn the body by these angles, in the order of their axes.
SUCCESSIONS = {
    "universal": spatial.Universal("j", "ground", "body", **AT, axis_a_W=(1.0, 0.0, 0.0), axis_b_W=(0.0, 1.0, 0.0)),
    "gimbal": spatial.Gimbal(
        "j",
        "ground",
        "body",
        **AT,
        axis_1_W=(0.0, 0.0, 1.0),
        axis_2_W=(0.0, 1.0, 0.0),
        axis_3_W=(-1.0, 0.0, 0.0),
    ),
    "cylinder": spatial.Cylindrical("j", "ground", "body", **AT, **ABOUT),
    "face": spatial.Planar("j", "ground", "body", **AT, **ABOUT),
    "composite": spatial.Composite(
        "j",
        "body",
        "ground",
        point=(0.1, 0.2, 0.3),
        sequence=("slide", "hinge", "slide", "hinge"),
        axes_W=[(0.0, 0.6, 0.8), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)],
        points_W=[(0.0, 0.1, 0.2), (0.3, 0.0, 0.0)],
    ),
    "ball": spatial.Composite(
        "j", "ground", "body", **AT, sequence=("ball", "slide"), axes_W=[(0, 0, 1), (0.6, 0, 0.8)]
    ),
}


@pytest.mark.slow(but=("gimbal", "face"))
@pytest.mark.parametrize("name", SUCCESSIONS)
def test_export_of_joints_in_succession_places_the_body(name):
    """From where all coordinates are zero, turns and shifts about the axes of MuJoCo lead to the given pose."""
    moments = np.array([[2.0, 0.3, 0.1], [0.3, 1.5, -0.2], [0.1, -0.2, 1.2]])
    system = mb.Scene([spatial.Body("body", mass=1.0, inertia=moments)], joints=[SUCCESSIONS[name]]).compile()
    random = np.random.default_rng(1)
    near = mb.State(np.asarray(system.guess.q) + 0.3 * random.normal(size=7), np.zeros(6))
    state = mb.assemble(system, near)
    model = mujoco.MjModel.from_xml_string(importers.to_mjcf(system, state).text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.body("body").xpos, state.q[:3], atol=1e-12)
    turn = rotation_of(model.body("body").iquat)
    np.testing.assert_allclose(turn @ np.diag(model.body("body").inertia) @ turn.T, moments, atol=1e-12)
    coordinates = {key.split(".")[1] for key in system.joint_coordinates()}
    free = model.nv
    assert free == 6 - system.velocity_rank and len(coordinates) <= model.njnt
    # The rates that the joints of MuJoCo leave are those that the joint here does.
    host = system.on_host(0.0)
    for k in range(free):
        data.qvel[:] = np.eye(free)[k]
        mujoco.mj_forward(model, data)
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, model.body("body").id, velocity, 0)
        rates = np.concatenate([velocity[3:], rotation_of(state.q[3:]).T @ velocity[:3]])
        np.testing.assert_allclose(host.velocity_rows_at(np.asarray(state.q), rates)[0], 0.0, atol=1e-10)
