"""Machines from URDF and SDF."""

import re

import numpy as np
import pytest
from model_files import INERTIAL, MASS, body, hinge, joint, kinds, link, model, part, robot

import jaxmb as mb
from jaxmb import importers
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.importers.description import roll_pitch_yaw
from jaxmb.linalg.rotations import from_matrix

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


def test_urdf_tree_is_what_mujoco_reads_of_it():
    mujoco = pytest.importorskip("mujoco")
    own, other = importers.urdf(ARM), mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(other)
    mujoco.mj_kinematics(other, data)
    assert [body.name for body in own.scene.bodies] == ["upper", "lower"]
    for rigid in own.scene.bodies:
        k = other.body(rigid.name).id
        assert float(rigid.mass) == pytest.approx(other.body_mass[k], rel=1e-14)
        np.testing.assert_allclose(rigid.position, data.xpos[k], atol=1e-14)
        np.testing.assert_allclose(rigid.orientation, data.xquat[k], atol=1e-14)
        turn = roll_pitch_yaw((0.0, 0.3, 0.0))
        np.testing.assert_allclose(rigid.inertia, turn @ np.diag([0.02, 0.05, 0.04]) @ turn.T, atol=1e-15)
    # The turn about x comes first, about axes that stay: roll by a quarter takes y to z, then yaw takes x to y.
    quarters = roll_pitch_yaw((np.pi / 2, 0.0, np.pi / 2))
    np.testing.assert_allclose(quarters, [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15)
    np.testing.assert_allclose(part(own, "shoulder").axis_a, roll_pitch_yaw((0, 0, 1.0)) @ [0, 1, 0], atol=1e-15)


def test_urdf_notes_what_it_says():
    model = importers.urdf(ARM)
    found = kinds(model)
    assert found["shoulder stop"] == "JointStop" and found["elbow friction"] == "JointFriction"
    frames = {frame.name: frame.body for frame in model.scene.frames}
    assert frames == {"world": "ground", "base": "ground", "tool": "lower"}
    said = "\n".join(model.notes)
    assert "Limits are compliant stops" in said and "joints at rest creep: 'elbow'" in said
    assert "Limits of efforts and speeds are not read" in said


def test_urdf_with_a_free_base_and_a_mimic():
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


def test_urdf_joints_between_links_without_mass_are_one():
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
    planar = robot(link("base"), link("sled"), joint("table", "base", "sled", "planar", "<axis xyz='0 0 1'/>"))
    (own,) = importers.urdf(planar).scene.joints
    assert own.kind == "Composite" and own.sequence == ("slide", "slide", "hinge")


def pair(inside="<axis xyz='0 1 0'/>", inertial=INERTIAL, kind="revolute"):
    """Two links and a joint between them."""
    return robot(link("a"), link("b", inertial), joint("j", "a", "b", kind, inside))


COLLIDES = "<collision><geometry><sphere radius='1'/></geometry></collision>"
CIRCLE = joint("j", "b", "c"), joint("k", "c", "b")
NO_LINK = "There is no moving link .base='free' sets.* Massless links were left out: 'b'. Give them an <inertial>"
TRIANGLE_RULE = r"The text:3: Body 'b': inertia violates the triangle inequality.*got \[0.02\d*, 0.04\d*, 5.0"
WRONG = [
    (pair(kind="helical"), r"The text:4: joint 'j' has the unknown type 'helical'"),
    (
        robot(link("a"), link("b"), link("c"), *CIRCLE),
        "The text:1: the links do not form a tree: no joints lead from 'a' to 'b', 'c'",
    ),
    (robot(link("a"), joint("j", "a", "b")), r"The text:3: joint 'j' has the child 'b', but there is no such link"),
    (pair(inertial=""), NO_LINK),
    (pair(inertial=INERTIAL.replace('"2"', '"0"')), "The text:3: Body 'b': mass must be positive, got 0.0"),
    (pair("<axis xyz='0 0 0'/>"), "the axis of joint 'j' is zero"),
    (robot(link("a"), link("a")), "The text:3: link 'a' occurs twice"),
    (robot(link("a"), link("b"), joint("j", "a", "b"), joint("k", "a", "b")), "'b' is the child of several joints"),
    (pair("<limit lower='1' upper='0'/>"), "The text:4: the limits of joint 'j' must increase"),
    (robot("<link name='a'>"), "The text:3: mismatched tag"),
    (robot("<xacro:include filename='x'/>"), "run xacro on it"),
    (pair(inertial=INERTIAL.replace('"2"', '"x"')), "<mass>: expected 1 numbers, got 'x'"),
    (pair(inertial=INERTIAL.replace(".05", "5")), TRIANGLE_RULE),
    (pair("<mimic joint='i'/>"), "The text:4: <mimic> of 'j': Unknown joint 'i'"),
    (pair(inertial=INERTIAL + COLLIDES), "Links have shapes for collisions"),
    ("nowhere.urdf", "nowhere.urdf does not exist"),
]


def test_urdf_stop_has_the_inertia_that_moves():
    """About the axis of the joint, y, which is 0.1 m and 0.02 m from the mass centre."""
    own = part(importers.urdf(pair("<axis xyz='0 1 0'/><limit lower='-1' upper='1'/>")), "j stop")
    np.testing.assert_allclose(own.damping**2 / (4 * own.stiffness), 0.05 + 2 * (0.1**2 + 0.02**2), rtol=1e-12)


def test_urdf_that_is_wrong_is_refused():
    for text, message in WRONG:
        with pytest.raises(ValueError, match=message):
            importers.urdf(text)


# SDF

FOUR_BAR = model(
    body("crank", "0 0 0 0 -1.5708 0"),
    body("coupler", "0 0 1 0 0 0"),
    body("rocker", "1 0 0 0 -1.5708 0"),
    hinge("A", "world", "crank"),
    hinge("B", "crank", "coupler", axis="<xyz>0 1 0</xyz><dynamics><spring_stiffness>3</spring_stiffness></dynamics>"),
    hinge("D", "world", "rocker"),
    hinge("C", "rocker", "coupler", "1 0 0 0 0 0"),
)


def test_sdf_link_with_two_parents_closes_a_loop():
    found = importers.sdf(FOUR_BAR)
    # The spring counts full turns of its hinge.
    assert [joint.kind for joint in found.scene.joints] == ["Revolute", "Revolute", "FixedTendon", *["Revolute"] * 2]
    assert float(part(found, "B spring").stiffness) == 3.0
    # 1.5708 is a quarter turn.
    expected = from_matrix(roll_pitch_yaw((0, -np.pi / 2, 0)))
    np.testing.assert_allclose(part(found, "crank").orientation, expected, atol=1e-16)
    assert any("multiples of π/12" in note for note in found.notes)


@pytest.mark.slow
def test_sdf_loop_is_closed_and_its_redundancy_named():
    system = importers.sdf(FOUR_BAR).scene.compile()
    assert system.velocity_rank == 17 and len(system.implied) == 3
    state = mb.assemble(system, fix={"A.angle": 0.3})
    motion = mb.simulate(system, state, t1=0.3, saveat=np.linspace(0, 0.3, 4))
    assert np.max(motion.constraint_violation) < 1e-12 and abs(motion["A"].angle[-1] - 0.3) > 0.05


FALLING = "<xyz>0 1 0</xyz><limit><lower>2</lower><upper>1</upper></limit>"
WRONG_SDF = [
    (model(body("a"), hinge("j", "world", "a", kind="bolt")), "The text:3: joint 'j' has the unknown type 'bolt'"),
    (model(body("a"), hinge("j", "world", "a", kind="gearbox")), "joint 'j' is of type 'gearbox'"),
    (model(body("a"), hinge("j", "world", "b")), "joint 'j' has the child 'b'"),
    (model(body("a"), hinge("j", "a", "a")), "The text:3: parent and child of joint 'j' are the same, 'a'"),
    ("<sdf version='1.6'><include><uri>x</uri></include></sdf>", "The text:1: <include> is not followed"),
    ("<sdf><model name='m'/></sdf>", "The text:1: <sdf> needs the attribute 'version'"),
    ("<sdf version='new'><model name='m'/></sdf>", "the version of the format is a number such as 1.9, got 'new'"),
    (model("<include><uri>x</uri></include>", body("a")), "The text:2: <include> within a model is not read"),
    (model(body("a", "0 0 0 0 0")), "The text:2: <pose>: expected 6 finite numbers"),
    (model(body("a").replace("<pose>", "<pose relative_to='b'>")), "a pose relative to 'b'"),
    (model(body("a"), hinge("j", "world", "a", axis="<xyz>0 0 0</xyz>")), "the axis of joint 'j' is zero"),
    (model(body("a"), hinge("j", "world", "a", axis=FALLING)), "must increase"),
    (model(body("a"), "<model name='n'><link name='b'/></model>"), "The text:3: <model> within a model is not read"),
    (model(body("a"), "<frame name='f'/>"), "The text:3: <frame> within a model is not read"),
    (
        model(body("a"), hinge("j", "world", "a", axis="<xyz expressed_in='b'>0 1 0</xyz>")),
        "The text:3: the axis of 'j' is expressed in 'b', which is not a link",
    ),
    (model(body("a")).replace("name='m'", "name='m' placement_frame='a'"), "placement_frame is not read"),
    (
        model(body("a").replace("<inertial>", "<inertial auto='true'>")),
        "the inertia of link 'a' comes from its shapes",
    ),
]


def test_sdf_that_is_wrong_or_not_read_is_refused():
    for text, message in WRONG_SDF:
        with pytest.raises(ValueError, match=message):
            importers.sdf(text)


def test_sdf_that_is_not_read_is_said():
    found = importers.sdf(
        model(body("a"), hinge("j", "world", "a"), "<plugin name='p'/>", "<self_collide>1</self_collide>")
    )
    assert "<plugin> is not read; lines: 4." in found.notes
    assert any(re.search("do not act on the motion: <self_collide>", note) for note in found.notes)


def test_meshes_that_are_missing_leave_what_collides_to_be_shown():
    seen = "<visual><geometry><mesh filename='none.stl'/></geometry></visual>"
    box = "<collision><geometry><box size='.2 .4 .6'/></geometry></collision>"
    text = robot(link("a", INERTIAL + seen + box), link("world", ""), joint("j", "world", "a", "continuous"))
    model = importers.urdf(text, ignore="collisions")
    assert any("none.stl" in note for note in model.notes)
    (shown,) = model.shapes["a"]
    np.testing.assert_allclose(shown.scale, (0.2, 0.4, 0.6))


# Frames of axes, by the version of SDF


@pytest.mark.parametrize("kind", ["revolute", "universal"])
def test_sdf_axes_by_its_version(kind):
    """The y axis of a model that is turned about x, or of a joint on a link that is turned in the model about z."""
    turned = "<pose>0 0 0 1.570796326794896619 0 0</pose>"
    for version, inside, axis in (
        ("1.4", "", (0, 0, 1)),
        ("1.3", "", (0, 0, 1)),
        ("1.4", "<use_parent_model_frame>0</use_parent_model_frame>", (1, 0, 0)),
        ("1.5", "", (1, 0, 0)),
        ("1.6", "<use_parent_model_frame>True</use_parent_model_frame>", (0, 0, 1)),
        ("1.12", "", (1, 0, 0)),
    ):
        second = f"<axis2><xyz>0 0 1</xyz>{inside}</axis2>" if kind == "universal" else ""
        own = hinge("j", "world", "a", kind=kind, axis=f"<xyz>0 1 0</xyz>{inside}")
        text = model(body("a", "1 2 3 0 0 -1.570796326794896619"), turned, own.replace("</axis>", f"</axis>{second}"))
        # The link's y axis is the model's x axis, which is the world's; the model's y axis is the world's z axis.
        read = importers.sdf(text.replace("version='1.6'", f"version='{version}'"))
        np.testing.assert_allclose(part(read, "a").position, (1, -3, 2), atol=1e-15)
        found = part(read, "j 1 j 2" if kind == "universal" else "j")
        first = found.axes[0] if kind == "universal" else found.axis_a
        np.testing.assert_allclose(first, axis, atol=1e-15)
        if kind == "universal":
            np.testing.assert_allclose(found.axes[1], (0, -1, 0), atol=1e-15)


def test_sdf_inertia_by_default():
    """A mass of 1 kg and moments of 1 kg m², of whatever is not given; a link `world` is the ground."""
    found = importers.sdf(
        model(
            body("world", inside=""),
            body("a", inside=""),
            body("b", inside="<inertial><inertia><iyy>.7</iyy></inertia></inertial>"),
            body("c", inside="<inertial><mass>2</mass></inertial>"),
            hinge("j", "world", "a"),
        )
    )
    masses = {own.name: float(own.mass) for own in found.scene.bodies}
    assert masses == {"a": 1.0, "b": 1.0, "c": 2.0}
    np.testing.assert_array_equal(part(found, "a").inertia, np.eye(3))
    np.testing.assert_array_equal(part(found, "b").inertia, np.diag([1, 0.7, 1]))
    np.testing.assert_array_equal(part(found, "c").inertia, np.eye(3))
    assert "Links without <inertial> have the mass 1 kg and moments of inertia of 1 kg m²: 'a'." in found.notes


# Hostile and unusual files


def bomb(root):
    """A few hundred bytes that stand for a gigabyte."""
    entities = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 9))
    return (
        f'<?xml version="1.0"?>\n<!DOCTYPE x [<!ENTITY e0 "haha haha ">{entities}]>\n<{root}><link>&e8;</link></{root}>'
    )


@pytest.mark.parametrize("read, root", [(importers.urdf, "robot"), (importers.sdf, "sdf")], ids=["urdf", "sdf"])
def test_declared_entities_are_refused(read, root):
    message = "The text:2: a document type or an entity is declared, which is not supported"
    with pytest.raises(ValueError, match=message):
        read(bomb(root))


def test_file_that_is_deeply_nested():
    deep = f"<visual>{'<a>' * 10_000}{'</a>' * 10_000}</visual>"
    text = robot(
        link("world", ""), link("a", INERTIAL + deep), joint("j", "world", "a"), "<b>" * 10_000 + "</b>" * 10_000
    )
    assert [own.name for own in importers.urdf(text, ignore="pictures").scene.bodies] == ["a"]


def test_mujoco_expands_no_entities():
    pytest.importorskip("mujoco")
    with pytest.raises(ValueError, match="Schema violation: unrecognized element"):
        importers.mjcf(bomb("mujoco"))


def named(name, encoding, declared):
    head = f'\n<?xml version="1.0" encoding="{declared}"?>' if declared else ""
    return f"{head}{robot(link('world', ''), link(name), joint('j', 'world', name))}".encode(encoding)


def test_urdf_in_any_encoding(tmp_path):
    path = tmp_path / "robot.urdf"
    for encoding, declared in (
        *(("iso-8859-1", "ISO-8859-1"), ("cp1252", "windows-1252")),
        *(("utf-16", ""), ("utf-8-sig", "UTF-8"), ("utf-8", "")),
    ):
        path.write_bytes(named("Fuß", encoding, declared))
        assert [own.name for own in importers.urdf(path).scene.bodies] == ["Fuß"]
    for declared, message in (
        ("", r"robot.urdf:3: the file is not in the encoding 'utf-8': declare"),
        ("klingon", "robot.urdf:1: the encoding 'klingon' is not known"),
    ):
        path.write_bytes(named("Fuß", "iso-8859-1", declared))
        with pytest.raises(ValueError, match=message):
            importers.urdf(path)


def test_mjcf_in_another_encoding(tmp_path):
    pytest.importorskip("mujoco")
    path = tmp_path / "robot.xml"
    text = '<mujoco><worldbody><body name="Fuß"><joint/><geom size=".1"/></body></worldbody></mujoco>'
    path.write_bytes(text.encode("iso-8859-1"))
    with pytest.raises(ValueError, match=r"robot\.xml: names must be in UTF-8"):
        importers.mjcf(path)


# Meshes and packages

TRIANGLE = """solid t
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
endsolid t"""


def seen(*files):
    """Looks of a link that is there with these mesh files."""
    shown = "".join(f"<visual><geometry><mesh filename='{own}'/></geometry></visual>" for own in files)
    return robot(link("a", INERTIAL + shown), link("world", ""), joint("j", "world", "a"))


def test_meshes_are_found_in_packages_and_beside_the_file(tmp_path):
    robots = tmp_path / "my_robot"
    for folder in ("urdf", "meshes"):
        (robots / folder).mkdir(parents=True)
    elsewhere = tmp_path / "elsewhere" / "tools-1.2"
    elsewhere.mkdir(parents=True)
    (elsewhere / "package.xml").write_text("<package><name> tools </name></package>")
    for path in (robots / "urdf" / "near.stl", robots / "meshes" / "my part.stl", elsewhere / "tool.stl"):
        path.write_text(TRIANGLE)
    path = robots / "urdf" / "robot.urdf"
    files = ("near.stl", "../meshes/my part.stl", "package://my_robot/meshes/my%20part.stl", "package://tools/tool.stl")
    path.write_text(seen(*files, f"file://{robots}/urdf/near.stl", "http://example.org/near.stl"))
    for folders, count in ((), 4), (elsewhere, 5), ([elsewhere.parent, elsewhere], 5), (elsewhere.parent, 4):
        found = importers.urdf(path, package_dirs=folders)
        assert len(found.shapes["a"]) == count
        (missing,) = (names for note, names in found.named.items() if note.startswith("Mesh files are missing"))
        assert len(missing) == 6 - count
    with pytest.raises(ValueError, match=r"package_dirs: .*nowhere is not a folder"):
        importers.urdf(path, package_dirs=[tmp_path / "nowhere"])


@pytest.mark.slow
def test_sdf_models_are_one_machine():
    """Each moves as it does alone, and the names of links are those of their models and their own."""
    arm = FOUR_BAR.partition("<sdf version='1.6'>")[2].replace("</sdf>", "")
    box = "<model name='box'><pose>0 0 3 0 0 0</pose>" + body("a") + "</model>"
    floor = "<model name='floor'><static>1</static>" + body("a") + "</model>"
    both = importers.sdf(f"<sdf version='1.6'><world name='w'>{arm}{box}{floor}{arm}</world></sdf>")
    alone = importers.sdf(FOUR_BAR)
    names = [own.name for own in alone.scene.bodies]
    here = [own.name for own in both.scene.bodies]
    assert here == [*(f"m::{own}" for own in names), "box::a", *(f"m 2::{own}" for own in names)]
    assert any("m → m 2" in note for note in both.notes)
    udot = [
        np.asarray(accelerations(system, Multipliers(), 0.0, system.guess.q, system.guess.u)[0]).reshape(-1, 6)
        for system in (both.scene.compile(), alone.scene.compile())
    ]
    expected = np.concatenate([udot[1], [[0.0, 0.0, -9.81, 0.0, 0.0, 0.0]], udot[1]])
    np.testing.assert_allclose(udot[0], expected, rtol=0, atol=1e-11)


def test_sdf_models_are_found(tmp_path):
    (tmp_path / "box" / "meshes").mkdir(parents=True)
    (tmp_path / "box" / "meshes" / "box.stl").write_text(TRIANGLE)
    shown = "<visual><geometry><mesh><uri>model://box/meshes/box.stl</uri></mesh></geometry></visual>"
    path = tmp_path / "box" / "model.sdf"
    path.write_text(model(body("a", inside=MASS + shown)))
    assert len(importers.sdf(path).shapes["a"]) == 1
    assert len(importers.sdf(path.read_text(), package_dirs=tmp_path).shapes["a"]) == 1


def test_meshes_that_cannot_be_read(tmp_path):
    for name in ("thing", "thing.obj"):
        (tmp_path / name).write_text("v 1 2")
    path = tmp_path / "robot.urdf"
    path.write_text(seen("thing", "thing.obj"))
    found = importers.urdf(path)
    notes = [note for note in found.notes if note.startswith("Mesh files cannot be read")]
    assert "'thing'" in notes[0] and "'thing.obj'" in notes[1] and not found.shapes


# What need not be right

ZERO = "<geometry><sphere radius='0'/></geometry>"


def test_urdf_shapes_with_wrong_numbers_may_be_ignored():
    for inside in (ZERO, "<origin xyz='0 0'/><geometry><box size='1 1 1'/></geometry>", ""):
        for tag, word in (("visual", "pictures"), ("collision", "collisions")):
            text = robot(link("world", ""), link("a", f"{INERTIAL}<{tag}>{inside}</{tag}>"), joint("j", "world", "a"))
            with pytest.raises(ValueError, match=f"The text:3: .*ignore='{word}' leaves it out"):
                importers.urdf(text)
            found = importers.urdf(text, ignore=word)
            assert [own.name for own in found.scene.bodies] == ["a"] and not found.shapes
            assert f"Left out, as ignore='{word}' asks: {word} ('a')." in found.notes


def test_limits_with_wrong_numbers_may_be_ignored():
    own = joint("j", "a", "b", inside="<axis xyz='0 1 0'/><limit lower='1' upper='x'/>")
    assert "j stop" not in kinds(importers.urdf(robot(link("a"), link("b"), own), ignore="limits"))


@pytest.mark.parametrize("high, lowered", [(0.0629, 0.06), (0.0599, 0.0599)])
def test_urdf_inertia_that_rounding_has_made_impossible(high, lowered):
    """The largest moment is that of a flat body, in axes that the file gives."""
    turn = roll_pitch_yaw((0.0, 0.3, 0.0))
    moments = lambda zz: INERTIAL.replace('iyy=".05"', 'iyy=".04"').replace('izz=".04"', f'izz="{zz}"')
    found = importers.urdf(robot(link("a"), link("b", moments(high)), joint("j", "a", "b")))
    np.testing.assert_allclose(part(found, "b").inertia, turn @ np.diag([0.02, 0.04, lowered]) @ turn.T, atol=1e-16)
    assert any("by rounding" in note and "'b'" in note for note in found.notes) == (high > 0.06)
    with pytest.raises(ValueError, match=r"Body 'b': inertia violates.*got \[0.02\d*, 0.04\d*, 0.06"):
        importers.urdf(robot(link("a"), link("b", moments(0.0631)), joint("j", "a", "b")))


# Links without mass

BARE = (link("base"), link("arm"), joint("shoulder", "base", "arm", "continuous"))
ENDS = (
    link("finger", "<visual><geometry><sphere radius='1'/></geometry></visual>"),
    link("tip", ""),
    joint("knuckle", "arm", "finger", inside="<axis xyz='0 1 0'/><dynamics damping='1' friction='1'/>"),
    joint("nail", "finger", "tip", "continuous"),
    link("plate", ""),
    joint("table", "arm", "plate", "planar"),
)


@pytest.mark.parametrize("base", ["fixed", "free"])
def test_links_without_mass_at_ends_are_left_out(base):
    """What remains is the machine without them."""
    found, bare = (importers.urdf(robot(*BARE, *own), base=base, ignore="pictures") for own in (ENDS, ()))
    for parts in ("bodies", "joints", "forces", "frames"):
        names = [own.name for own in getattr(found.scene, parts)]
        assert names == [own.name for own in getattr(bare.scene, parts)]
    assert found.coordinates == bare.coordinates == {"shoulder": "shoulder.angle"}
    left_out = "Links without mass at the ends of the machine take no force and are left out: "
    (names,) = (names for note, names in found.named.items() if note.startswith(left_out))
    assert {"'finger'", "'tip'", "'plate'"} <= set(names)


def test_links_without_mass_at_a_free_root():
    found = importers.urdf(robot(link("base", ""), link("arm"), joint("j", "base", "arm")), base="free")
    assert [own.name for own in found.scene.bodies] == ["arm"] and not found.scene.joints


def test_links_without_mass_that_are_coupled():
    """A follower that resists nothing takes no force; one with damping hands it to the joint that it follows."""
    follower = lambda inside: (
        link("end", ""),
        joint("k", "arm", "end", "continuous", f"<mimic joint='shoulder'/>{inside}"),
    )
    found = importers.urdf(robot(*BARE, *follower("")))
    assert [own.name for own in found.scene.joints] == ["shoulder"]
    damped = robot(*BARE, *follower("<dynamics damping='1'/>"))
    with pytest.raises(ValueError, match="Link 'end' moves without mass"):
        importers.urdf(damped)
    assert [own.name for own in importers.urdf(damped, ignore="damping").scene.joints] == ["shoulder"]


# Notes


def test_notes_of_one_kind_are_one():
    """They list the first names, and `named` has all of them."""
    many = [own for k in range(20) for own in (link(f"l{k}"), joint(f"j{k}", "base", f"l{k}", inside=LIMITED))]
    found = importers.urdf(robot(link("base"), *many, *["<gazebo><a/></gazebo>"] * 30))
    (stops,) = (note for note in found.notes if note.startswith("Limits are compliant stops"))
    assert stops.endswith("'j5', 'j6', 'j7' and 12 more.")
    assert found.named[stops] == tuple(repr(f"j{k}") for k in range(20))
    assert "<gazebo> is not read; lines: 43, 44, 45, 46, 47, 48, 49, 50 and 22 more." in found.notes
    assert tuple(found.named) == found.notes and len(found.notes) == 3


LIMITED = "<axis xyz='0 1 0'/><limit lower='-1' upper='1'/>"


def test_urdf_of_bullet_with_a_ball_and_a_fixed_joint_that_follows():
    found = importers.urdf(
        robot(
            *BARE,
            link("head"),
            joint("neck", "arm", "head", "spherical"),
            link("hat"),
            joint("pin", "head", "hat", "fixed", "<mimic joint='shoulder'/>"),
        )
    )
    assert found.coordinates["neck"] == "neck.rotation" and kinds(found)["neck"] == "Spherical"
    assert "Fixed joints do not move, so their <mimic> has no effect: 'pin'." in found.notes
