"""Machines from URDF and SDF."""

import re

import numpy as np
import pytest
from test_importers import kinds, part

import jaxmb as mb
from jaxmb import importers
from jaxmb.importers.description import quaternion, roll_pitch_yaw

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


ARM = robot(
    link("world", ""),
    link("base"),
    link("upper"),
    link("lower"),
    link("tool", ""),
    joint("mount", "world", "base", "fixed"),
    joint("shoulder", "base", "upper", inside="<axis xyz='0 2 0'/><limit lower='-1' upper='1' effort='3'/>"),
    joint("elbow", "upper", "lower", "continuous", "<axis xyz='0 0 1'/><dynamics damping='.3' friction='.1'/>"),
    joint("flange", "lower", "tool", "fixed"),
)


def test_a_urdf_tree_is_what_mujoco_reads_of_it():
    mujoco = pytest.importorskip("mujoco")
    own, other = importers.urdf(ARM), mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(other)
    mujoco.mj_kinematics(other, data)
    assert [body.name for body in own.scene.bodies] == ["upper", "lower"]
    for body in own.scene.bodies:
        k = other.body(body.name).id
        assert float(body.mass) == pytest.approx(other.body_mass[k], rel=1e-14)
        np.testing.assert_allclose(body.position, data.xpos[k], atol=1e-14)
        np.testing.assert_allclose(body.orientation, data.xquat[k], atol=1e-14)
        turn = roll_pitch_yaw((0.0, 0.3, 0.0))
        np.testing.assert_allclose(body.inertia, turn @ np.diag([0.02, 0.05, 0.04]) @ turn.T, atol=1e-15)
    np.testing.assert_allclose(part(own, "shoulder").axis_a, roll_pitch_yaw((0, 0, 1.0)) @ [0, 1, 0], atol=1e-15)


def test_what_a_urdf_says():
    model = importers.urdf(ARM)
    found = kinds(model)
    assert found["shoulder stop"] == "JointStop" and found["elbow friction"] == "JointFriction"
    frames = {frame.name: frame.body for frame in model.scene.frames}
    assert frames == {"world": "ground", "base": "ground", "tool": "lower"}
    said = "\n".join(model.notes)
    assert "Limits are compliant stops" in said and "joints at rest creep: 'elbow'" in said
    assert "Limits of efforts and speeds are not read" in said


def test_a_free_base_and_a_mimic():
    text = robot(
        link("base"),
        link("left"),
        link("right"),
        joint("l", "base", "left", "prismatic"),
        joint("r", "base", "right", "prismatic", "<axis xyz='0 -1 0'/><mimic joint='l' multiplier='2' offset='.1'/>"),
    )
    model = importers.urdf(text, base="free")
    assert [body.name for body in model.scene.bodies] == ["base", "left", "right"]
    coupling = part(model, "r mimic")
    assert coupling.combined == ("r.displacement", "l.displacement")
    np.testing.assert_array_equal(coupling.coefficients, [0.1, 2.0])


@pytest.mark.long
def test_a_mimic_holds_exactly():
    text = robot(
        link("base"),
        link("left"),
        link("right"),
        joint("l", "base", "left", "continuous"),
        joint("r", "base", "right", "continuous", "<axis xyz='0 1 0'/><mimic joint='l' multiplier='-2' offset='.1'/>"),
    )
    system = importers.urdf(text).scene.compile()
    motion = mb.simulate(system, mb.assemble(system, fix={"l.angle": 0.4}), t1=0.3, saveat=np.linspace(0, 0.3, 4))
    np.testing.assert_allclose(motion["r"].angle, 0.1 - 2 * motion["l"].angle, rtol=0, atol=1e-12)


def test_three_joints_between_links_without_mass():
    text = robot(
        *(link(name, "") for name in ("w1", "w2")),
        link("base"),
        link("hand"),
        joint("a", "base", "w1", "continuous", "<origin/><axis xyz='1 0 0'/>"),
        "<joint name='b' type='continuous'><parent link='w1'/><child link='w2'/><axis xyz='0 1 0'/></joint>",
        "<joint name='c' type='continuous'><parent link='w2'/><child link='hand'/><axis xyz='0 0 1'/></joint>",
    )
    model = importers.urdf(text)
    assert kinds(model)["a b c"] == "Composite" and model.coordinates["b"] == "a b c.angle_2"


PLANAR = robot(link("base"), link("sled"), joint("table", "base", "sled", "planar", "<axis xyz='0 0 1'/>"))


def test_a_planar_joint():
    model = importers.urdf(PLANAR)
    (own,) = (joint for joint in model.scene.joints)
    assert own.kind == "Composite" and own.sequence == ("slide", "slide", "hinge")


@pytest.mark.parametrize(
    "text, message",
    [
        (
            robot(link("a"), link("b"), joint("j", "a", "b", "helical")),
            r"The text:4: joint 'j' has the unknown type 'helical'",
        ),
        (robot(link("a"), joint("j", "a", "b")), r"The text:3: joint 'j' has the child 'b', and there is no such link"),
        (
            robot(link("a"), link("b", ""), joint("j", "a", "b")),
            r"The text:3: Link 'b' moves without mass and carries nothing",
        ),
        (
            robot(link("a"), link("b"), joint("j", "a", "b", inside="<axis xyz='0 0 0'/>")),
            "the axis of joint 'j' is zero",
        ),
        (robot(link("a"), link("a")), "The text:3: link 'a' is there twice"),
        (robot(link("a"), link("b"), joint("j", "a", "b"), joint("k", "a", "b")), "'b' is the child of several joints"),
        (
            robot(link("a"), link("b"), joint("j", "a", "b", inside="<limit lower='1' upper='0'/>")),
            "The text:4: the limits of joint 'j' must increase",
        ),
        (robot("<link name='a'>"), "The text:3: mismatched tag"),
        (robot("<xacro:include filename='x'/>"), "run xacro on it"),
        (
            robot(link("a"), link("b", INERTIAL.replace('"2"', '"x"')), joint("j", "a", "b")),
            "<mass>: expected 1 numbers, got 'x'",
        ),
        (
            robot(link("a"), link("b", INERTIAL.replace(".05", "5")), joint("j", "a", "b")),
            "The text:3: Body 'b': inertia violates",
        ),
        (
            robot(
                link("a"),
                link("b", INERTIAL + "<collision><geometry><sphere radius='1'/></geometry></collision>"),
                joint("j", "a", "b"),
            ),
            "Links have shapes for collisions",
        ),
        ("nowhere.urdf", "nowhere.urdf does not exist"),
    ],
)
def test_wrong_urdf(text, message):
    with pytest.raises(ValueError, match=message):
        importers.urdf(text)


# SDF

MASS = "<inertial><mass>1</mass><inertia><ixx>.02</ixx><iyy>.05</iyy><izz>.04</izz></inertia></inertial>"


def model(*elements):
    return "<sdf version='1.6'><model name='m'>\n" + "\n".join(elements) + "\n</model></sdf>"


def body(name, pose="0 0 0 0 0 0", inside=MASS):
    return f"<link name='{name}'><pose>{pose}</pose>{inside}</link>"


def hinge(name, parent, child, pose="0 0 0 0 0 0", kind="revolute", axis="<xyz>0 1 0</xyz>"):
    ends = f"<parent>{parent}</parent><child>{child}</child>"
    return f"<joint name='{name}' type='{kind}'><pose>{pose}</pose>{ends}<axis>{axis}</axis></joint>"


FOUR_BAR = model(
    body("crank", "0 0 0 0 -1.5708 0"),
    body("coupler", "0 0 1 0 0 0"),
    body("rocker", "1 0 0 0 -1.5708 0"),
    hinge("A", "world", "crank"),
    hinge("B", "crank", "coupler", axis="<xyz>0 1 0</xyz><dynamics><spring_stiffness>3</spring_stiffness></dynamics>"),
    hinge("D", "world", "rocker"),
    hinge("C", "rocker", "coupler", "1 0 0 0 0 0"),
)


def test_a_link_with_two_parents_closes_a_loop():
    found = importers.sdf(FOUR_BAR)
    assert [joint.kind for joint in found.scene.joints] == ["Revolute"] * 4
    assert float(part(found, "B spring").stiffness) == 3.0
    # 1.5708 is a quarter turn.
    expected = quaternion(roll_pitch_yaw((0, -np.pi / 2, 0)))
    np.testing.assert_allclose(part(found, "crank").orientation, expected, atol=1e-16)
    assert any("multiples of π/12" in note for note in found.notes)


@pytest.mark.long
def test_the_loop_is_closed_and_its_redundancy_named():
    system = importers.sdf(FOUR_BAR).scene.compile()
    assert system.velocity_rank == 17 and len(system.implied) == 3
    state = mb.assemble(system, fix={"A.angle": 0.3})
    motion = mb.simulate(system, state, t1=0.3, saveat=np.linspace(0, 0.3, 4))
    assert np.max(motion.constraint_violation) < 1e-12 and abs(motion["A"].angle[-1] - 0.3) > 0.05


@pytest.mark.parametrize(
    "text, message",
    [
        (model(body("a"), hinge("j", "world", "a", kind="bolt")), "The text:3: joint 'j' has the unknown type 'bolt'"),
        (model(body("a"), hinge("j", "world", "a", kind="gearbox")), "joint 'j' is of type 'gearbox'"),
        (model(body("a"), hinge("j", "world", "b")), "joint 'j' has the child 'b'"),
        (model(body("a", inside="")), "The text:2: link 'a' has no <inertial>"),
        ("<sdf><include><uri>x</uri></include></sdf>", "The text:1: <include> is not followed"),
        (model("<include><uri>x</uri></include>", body("a")), "The text:2: <include> within a model is not read"),
        (model(body("a", "0 0 0 0 0")), "The text:2: <pose>: expected 6 finite numbers"),
        (model(body("a").replace("<pose>", "<pose relative_to='b'>")), "a pose relative to 'b'"),
        (model(body("a"), hinge("j", "world", "a", axis="<xyz>0 0 0</xyz>")), "the axis of joint 'j' is zero"),
        (
            model(
                body("a"),
                hinge("j", "world", "a", axis="<xyz>0 1 0</xyz><limit><lower>2</lower><upper>1</upper></limit>"),
            ),
            "must increase",
        ),
    ],
)
def test_wrong_sdf(text, message):
    with pytest.raises(ValueError, match=message):
        importers.sdf(text)


def test_what_is_not_read_is_said():
    found = importers.sdf(
        model(body("a"), hinge("j", "world", "a"), "<plugin name='p'/>", "<self_collide>1</self_collide>")
    )
    assert "The text:4: <plugin> is not read." in found.notes
    assert any(re.search("do not act on the motion: <self_collide>", note) for note in found.notes)


def test_what_collides_is_shown_where_a_mesh_is_missing():
    seen = "<visual><geometry><mesh filename='none.stl'/></geometry></visual>"
    box = "<collision><geometry><box size='.2 .4 .6'/></geometry></collision>"
    text = robot(link("a", INERTIAL + seen + box), link("world", ""), joint("j", "world", "a", "continuous"))
    model = importers.urdf(text, ignore="collisions")
    assert any("none.stl" in note for note in model.notes)
    (shown,) = model.shapes["a"]
    np.testing.assert_allclose(shown.scale, (0.2, 0.4, 0.6))
