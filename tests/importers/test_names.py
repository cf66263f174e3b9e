"""Names of elements in files: whatever they are, no element is taken for another one, nor for the fixed world."""

import numpy as np
import pytest
from model_files import HINGE, MASS, ROD, body, file, hinge, joint, kinds, link, model, part, robot, rod

import jaxmb as mb
from jaxmb import importers, spatial

mujoco = pytest.importorskip("mujoco")

RENAMED = "Elements have other names, since names are unique in a scene: "
TIP, WELD = link("tip", ""), joint("weld", "ground", "welded", "fixed")
ENDS = "<parent>{}</parent><child>{}</child>"
CROSS = f"<joint name='u' type='universal'>{ENDS}<axis><xyz>0 1 0</xyz></axis><axis2><xyz>1 0 0</xyz></axis2></joint>"


def ends(found):
    """Bodies, and for each joint its bodies."""
    joints = [own for own in found.scene.joints if hasattr(own, "body_a")]
    return [own.name for own in found.scene.bodies], {own.name: (own.body_a, own.body_b) for own in joints}


# The fixed world

ON_THE_WORLD = f'<body name="ground" pos="0 0 1"><freejoint/>{ROD}{rod("arm", HINGE)}</body>'
ON_A_BASE = (
    f'<body name="base"><freejoint/>{ROD}{rod("ground", HINGE, rod("arm", HINGE.replace("hip", "knee")))}</body>'
)


def test_body_of_mjcf_that_is_called_ground_moves():
    """It has the mass and the place that MuJoCo gives it."""
    for text, joints in (
        (ON_THE_WORLD, {"hip": ("ground link", "arm")}),
        (ON_A_BASE, {"hip": ("base", "ground link"), "knee": ("ground link", "arm")}),
    ):
        found = importers.mjcf(file(text))
        names, connected = ends(found)
        assert connected == joints and found.notes == (f"{RENAMED}'ground → ground link'.",)
        there = found.locate.model
        assert sum(float(own.mass) for own in found.scene.bodies) == pytest.approx(there.body_mass.sum(), rel=1e-15)
        data = mujoco.MjData(there)
        data.qpos = there.qpos0 + 0.1
        mujoco.mj_kinematics(there, data)
        place = np.asarray(found.state(there.qpos0 + 0.1).q).reshape(-1, 7)[names.index("ground link"), :3]
        np.testing.assert_allclose(place, data.body("ground").xipos, atol=1e-15)


def test_elements_of_all_kinds_that_are_called_ground():
    text = file(
        f'<body name="ground"><freejoint/>{ROD}<site name="ground"/><body name="welded" pos="0 0 1">{ROD}</body>'
        f'<body name="arm"><joint name="ground" axis="0 1 0"/>{ROD}</body></body>',
        '<equality><connect name="ground" body1="ground" body2="arm" anchor="0 0 0"/></equality>'
        '<tendon><fixed name="ground" stiffness="2"><joint joint="ground" coef="2"/></fixed></tendon>'
        '<actuator><motor name="ground" joint="ground"/><motor name="winch" tendon="ground"/></actuator>'
        '<sensor><jointpos name="ground" joint="ground"/></sensor>',
    )
    found = importers.mjcf(text)
    assert ends(found)[1] == {"ground joint": ("ground link", "arm"), "ground loop": ("ground link", "arm")}
    assert {own.name: own.body for own in found.scene.frames} == {
        "welded": "ground link",
        "ground frame": "ground link",
    }
    assert found.coordinates == {"ground": "ground joint.angle"}
    assert found.controls == {"ground": "ground actuator.control", "winch": "winch.control"}
    assert part(found, "ground spring").coordinate == part(found, "winch").coordinate == "ground tendon.length"
    assert part(found, "ground actuator").coordinate == "ground joint.angle"


ROBOTS = {
    "the last link": (
        robot(link("base"), link("b"), link("ground"), joint("j", "base", "b"), joint("k", "b", "ground"))
    ),
    "the root link": robot(link("ground"), link("b"), joint("j", "ground", "b")),
    "with a welded link": robot(link("base"), link("ground"), link("welded"), joint("j", "base", "ground"), WELD),
}


def test_link_of_urdf_that_is_called_ground_is_what_it_is_by_another_name():
    renamed = lambda name: "ground link" if name == "tool" else name
    for text in ROBOTS.values():
        for base in ("fixed", "free"):
            found, plain = (importers.urdf(own, base=base) for own in (text, text.replace("'ground'", "'tool'")))
            names, joints = ends(plain)
            moved = {own: (*map(renamed, pair),) for own, pair in joints.items()}
            assert ends(found) == ([*map(renamed, names)], moved)
            frames = [(renamed(own.name), renamed(own.body)) for own in plain.scene.frames]
            assert [(own.name, own.body) for own in found.scene.frames] == frames
            assert found.notes[0].startswith(f"{RENAMED}'ground → ground link'")


def test_link_of_sdf_that_is_called_ground_or_world():
    text = model(
        "<static>{}</static>",
        *(body("a"), body("ground"), body("c")),
        *(hinge("j", "a", "ground"), hinge("k", "ground", "c"), hinge("l", "world", "c")),
    )
    with pytest.raises(ValueError, match="There is no moving link"):
        importers.sdf(text.format(1))
    joints = {"j": ("a", "ground link"), "k": ("ground link", "c"), "l": ("ground", "c")}
    assert ends(importers.sdf(text.format(0))) == (["a", "ground link", "c"], joints)
    note = "A link called world that has an <inertial> is not the ground, and moves as its joints allow: 'world'."
    for inside, bodies, parent, notes in (("", ["b"], "ground", ()), (MASS, ["world", "b"], "world", (note,))):
        found = importers.sdf(model(body("world", inside=inside), body("b"), hinge("j", "world", "b")))
        assert ends(found) == (bodies, {"j": (parent, "b")}) and found.notes == notes


def test_root_of_urdf_that_is_called_world():
    """It is the ground, which is said where its mass is lost."""
    note = "The root link 'world' is the ground, whatever its mass, despite base='free': give it another name."
    for inside, base, notes in (("", "free", ()), (link("x"), "fixed", ()), (link("x"), "free", (note,))):
        text = robot(link("world", inside), link("b"), joint("j", "world", "b")).replace("<link name='x'>", "")
        found = importers.urdf(text.replace("</link></link>", "</link>"), base=base)
        assert ends(found) == (["b"], {"j": ("ground", "b")}) and found.notes == notes


# Names that others have already


def test_element_has_the_name_of_the_file_before_others_are_given_it():
    for names, expected in (
        (("ground", "ground link"), ["ground 2", "ground link"]),
        (("ground link", "ground"), ["ground link", "ground 2"]),
        (("b.c", "b_c"), ["b_c link", "b_c"]),
        (("crank.angle", "crank"), ["crank_angle", "crank"]),
        (("a/b", "{}"), ["a/b", "{}"]),
    ):
        text = file("".join(rod(name, HINGE.replace("hip", f"joint {k}")) for k, name in enumerate(names)))
        found = importers.mjcf(text)
        assert [own.name for own in found.scene.bodies] == expected
        listed = ", ".join(repr(f"{old} → {new}") for old, new in zip(names, expected, strict=True) if old != new)
        assert found.notes == ((f"{RENAMED}{listed}.",) if listed else ())


def test_elements_of_mjcf_without_a_name_beside_those_that_have_theirs():
    text = file(
        f'<body name="body 2"><joint name="body 2 2 joint 1"/>{ROD}</body><body><joint axis="0 1 0"/>{ROD}</body>'
        f'<body name="body"><joint name="j"/><joint name="k" axis="0 1 0"/>{ROD}</body>{rod("body after j", HINGE)}',
        '<actuator><motor name="actuator 1" joint="j"/><motor joint="k"/></actuator>',
    )
    found = importers.mjcf(text)
    assert [own.name for own in found.scene.bodies] == ["body 2", "body 2 2", "body", "body after j"]
    assert sum(float(own.mass) for own in found.scene.bodies) == pytest.approx(found.locate.model.body_mass.sum())
    own = {"body 2 2 joint 1": "body 2 2 joint 1.angle", "body 2 2 joint 1 2": "body 2 2 joint 1 2.angle"}
    own |= {"j": "j k.angle_1", "k": "j k.angle_2", "hip": "hip.angle"}
    assert found.coordinates == own
    assert found.controls == {"actuator 1": "actuator 1.control", "actuator 1 2": "actuator 1 2.control"}


@pytest.mark.parametrize("base", ["fixed", "free"])
def test_joint_of_urdf_that_is_called_base(base):
    """It is not the one of the root: the root keeps its joint where this one is left out with the end that it has."""
    found = importers.urdf(robot(link("a"), link("b"), TIP, joint("j", "a", "b"), joint("base", "b", "tip")), base=base)
    assert ends(found) == (["a", "b"], {"j": ("a", "b")}) if base == "free" else (["b"], {"j": ("ground", "b")})
    found = importers.urdf(robot(link("a"), link("b"), joint("base", "a", "b")), base=base)
    assert found.coordinates == {"base": "base.angle"}


def test_joints_and_links_that_are_called_as_those_of_a_planar_joint():
    found = importers.urdf(
        robot(link("a"), link("b"), link("p x"), joint("p", "a", "b", "planar"), joint("p x", "b", "p x"))
    )
    assert ends(found) == (["b", "p x"], {"p x 2 p y p": ("ground", "b"), "p x joint": ("b", "p x")})
    assert found.coordinates["p x"] == "p x joint.angle"
    assert found.coordinates["p x 2"] == "p x 2 p y p.displacement_1"


def test_joints_and_links_that_are_called_as_those_of_a_universal_joint():
    text = model(body("a"), body("b"), CROSS.format("a", "b"), hinge("u 1", "b", "u cross"), body("u cross"))
    found = importers.sdf(text)
    assert ends(found) == (["a", "b", "u cross"], {"u 1 2 u 2": ("a", "b"), "u 1": ("b", "u cross")})
    assert found.coordinates["u 1"] == "u 1.angle" and found.coordinates["u 1 2"] == "u 1 2 u 2.angle_1"


@pytest.mark.parametrize(
    "read, text",
    [
        (importers.urdf, robot(link("a"), link("b"), link("c"), joint("j", "a", "b"), joint("j", "b", "c"))),
        (importers.sdf, model(body("a"), body("b"), hinge("j", "world", "a"), hinge("j", "a", "b"))),
    ],
    ids=["urdf", "sdf"],
)
def test_joints_of_one_name_are_refused(read, text):
    with pytest.raises(ValueError, match=r"The text:\d: joint 'j' occurs twice"):
        read(text)


# Names in MuJoCo's file


@pytest.mark.slow
def test_scene_with_names_that_mujoco_has():
    """Of a body that MuJoCo would take for the world, and of elements that the file needs beside those of the scene."""
    balls = [spatial.Spherical(f"ball {k}", "ground", "world", point=(float(k), 0.0, 0.0)) for k in range(2)]
    body = spatial.Body("world", mass=1.0, inertia=(0.1, 0.1, 0.1))
    rubber = spatial.SpringDamper("rubber", "world", "ground", stiffness=1.0)
    exported = importers.to_mjcf(
        mb.Scene([body], joints=balls, forces=[rubber], frames=[spatial.Frame("rubber a", "ground")]).compile()
    )
    assert "Bodies have other names, since MuJoCo reserves these: 'world → world body'." in exported.notes
    back = importers.mjcf(exported.text)
    assert [own.name for own in back.scene.bodies] == ["world body"]
    assert back.coordinates == {"ball 0": "ball 0.rotation"}
    assert part(back, "ball 1").body_a == "world body" and kinds(back)["ball 1"] == "Spherical"
    own = {"rubber a": "ground", "rubber a 2": "world body", "rubber b": "ground"}
    assert {own.name: own.body for own in back.scene.frames} == own


@pytest.mark.slow
def test_joints_that_are_called_as_those_that_mujoco_needs_besides():
    bodies = [spatial.Body(name, mass=1.0, inertia=(0.1, 0.1, 0.1)) for name in ("arm", "plate", "bob z")]
    bodies.append(spatial.PointMass("bob", mass=1.0))
    at = {"point": (0.0, 0.0, 0.0), "axis": (0.0, 1.0, 0.0)}
    joints = [
        spatial.Planar("table", "arm", "plate", **at),
        spatial.Prismatic("table x", "ground", "plate", **at),
        spatial.Revolute("bob y", "plate", "bob z", **at),
    ]
    forces = [mb.JointSpring("spring", "table x.displacement", stiffness=2.0)]
    text = importers.to_mjcf(mb.Scene(bodies, joints=joints, forces=forces).compile()).text
    there = mujoco.MjModel.from_xml_string(text)
    of_table = {"table x", "table x 2", "table y", "table angle"}
    assert {there.joint(k).name for k in range(there.njnt)} == of_table | {"bob x", "bob y", "bob y 2", "bob z 2"}
    assert there.joint("table x").stiffness[0] == 2.0 and there.joint("table x 2").stiffness[0] == 0.0


@pytest.mark.slow
def test_link_called_ground_through_a_scene_and_back():
    found = importers.urdf(ROBOTS["with a welded link"], base="free")
    back = importers.mjcf(importers.to_mjcf(found.scene.compile()).text)
    assert ends(back) == ends(found) and {own.name: own.body for own in back.scene.frames} == {"welded": "ground link"}
