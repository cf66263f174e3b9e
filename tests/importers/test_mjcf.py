"""Machines from MJCF: every row of the table of what is exact, approximate and refused."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from model_files import HINGE, ROD, body_accelerations, check_dynamics, file, kinds, part, random_states, rod

from jaxmb import importers, shapes
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.importers.description import roll_pitch_yaw, rotation_of, turn_about

mujoco = pytest.importorskip("mujoco")


def small_tree():
    inner = rod(
        "arm",
        '<joint name="elbow" axis="0 1 1" damping=".3" stiffness="2" springref="10" armature=".02" ref="5"/>',
        '<site name="tip" pos=".3 0 0"/>'
        + rod("hand", '<joint name="reach" type="slide" axis="1 0 .2" stiffness="50" armature=".3" ref=".1"/>'),
    )
    bodies = f'<site name="hook" pos="1 1 1"/><body name="base" pos="0 0 1"><freejoint/>{ROD}{inner}</body>'
    more = """<tendon><fixed name="cord" stiffness="3" damping=".2"><joint joint="elbow" coef=".5"/><joint joint="reach"
        coef="-.3"/></fixed><spatial name="rope" stiffness="3" springlength=".3"><site site="tip"/><site site="hook"/>
        </spatial></tendon><actuator><position name="servo" joint="elbow" kp="10" kv="1" gear="2"/><motor name="pull"
        tendon="cord" gear="3"/><velocity name="speed" joint="reach" kv="2"/></actuator>"""
    return file(bodies, more, '<option gravity="0 1 -9"/>')


@pytest.mark.slow
def test_mjcf_of_a_small_tree_moves_as_in_mujoco():
    """Hinge, slide and free joints, springs, dampers, armature, reference values, tendons and actuators."""
    check_dynamics(importers.mjcf(small_tree()))


@pytest.mark.slow
def test_armature_moves_as_in_mujoco():
    """Of a hinge, of a slide, of a tendon along both, and of one between points; with it a machine has its mass.

    A spring winds up through full turns of the hinge.
    """
    hinge = '<joint name="hip" axis="0 1 1" armature=".02" damping=".1" ref="7"/>'
    slide = '<joint name="reach" type="slide" axis="1 0 .2" armature=".3" ref=".1"/>'
    fixed = '<fixed name="cord" armature=".4" stiffness="3" springlength="1"><joint joint="hip" coef=".5"/>'
    fixed += '<joint joint="reach" coef="2"/></fixed>'
    straight = '<spatial name="line" armature=".6"><site site="far"/><site site="tip"/></spatial>'
    hand = rod("hand", slide + '<site name="tip" pos=".1 .2 0"/>', pos=".4 0 0")
    body = rod("arm", hinge, hand) + '<site name="far" pos="0 1 .5"/>'
    model = importers.mjcf(file(body, f"<tendon>{fixed}{straight}</tendon>"))
    system = check_dynamics(model, 3, scale=6.0)
    assert system.nu == 2 * 6 + 4 and not any("rotor" in own.name for own in model.scene.bodies)
    assert float(jnp.sum(system.mass)) == pytest.approx(float(np.sum(model.locate.model.body_mass)), rel=1e-14)


def joint(name, kind="hinge", axis="0 0 1", more=""):
    return f'<joint name="{name}" type="{kind}" axis="{axis}" {more}/>'


# Joints on one link, by what they are like.
SUCCESSIONS = {
    "three skew hinges apart": joint("k1", axis="0 0 1", more='pos=".1 .05 0" ref="9"')
    + joint("k2", axis="1 0 .2", more='pos="0 -.05 .07" range="-50 50" stiffness="1"')
    + joint("k3", axis=".3 1 0", more='damping=".1" ref="-4"'),
    "a planar walker": joint("x", "slide", "1 0 0", 'damping=".3" ref=".2"')
    + joint("z", "slide", "0 0 1", 'ref="1.2" stiffness="3"')
    + joint("y", "hinge", "0 1 0", 'pos="0 0 .1" armature=".02"'),
    "three slides": joint("s1", "slide", "1 0 0", 'damping=".1"')
    + joint("s2", "slide", "0 1 0")
    + joint("s3", "slide", "0 .2 1", 'stiffness="2" ref=".3"'),
    "a slide and a hinge": joint("n1", "slide", "1 0 0", 'damping=".1"') + joint("n2", axis="0 1 .3", more='ref="20"'),
    "a hinge and two slides": joint("o1", axis="1 1 0", more='ref="10"')
    + joint("o2", "slide", "0 1 .3", 'ref=".1" stiffness="4"')
    + joint("o3", "slide", "1 0 .3"),
    "two skew hinges apart": joint("l1", axis="0 0 1", more='pos=".1 .05 0" damping=".1"')
    + joint("l2", axis="1 0 .2", more='stiffness="1" ref="9"'),
    "two hinges that meet": joint("u1", axis="1 0 0", more='damping=".1" armature=".01"')
    + joint("u2", axis="0 1 0", more='stiffness="1" ref="9"'),
    "three hinges that meet": joint("g1", axis="1 0 0", more='armature=".01"')
    + joint("g2", axis="0 0 1", more='ref="5" stiffness="1" range="-60 70"')
    + joint("g3", axis="0 1 0", more='damping=".2"'),
    "a pin that turns and slides": joint("c1", axis="1 0 0", more='damping=".1"')
    + joint("c2", "slide", "-1 0 0", 'stiffness="9" ref=".1"'),
    "all six": joint("a1", "slide", "1 0 0", 'damping=".2"')
    + joint("a2", "slide", "0 1 0")
    + joint("a3", "slide", "0 0 1", 'armature=".1"')
    + joint("a4", axis="1 0 0", more='stiffness="2"')
    + joint("a5", axis="0 1 0", more='range="-60 60"')
    + joint("a6", axis="0 0 1", more='damping=".1"'),
    "slides and a ball": joint("b1", "slide", "1 0 0", 'damping=".2"')
    + joint("b2", "slide", "0 0 1")
    + joint("b3", "ball", more='damping=".1"'),
}
MOTORS = ("x", "y", "k2", "k3", "s3", "n1", "n2", "o1", "o3", "g2", "c2", "a1", "a5", "b1")


def successions(names):
    bodies = "".join(rod(f"body {k}", SUCCESSIONS[name], pos=f"0 {k} 0") for k, name in enumerate(names))
    motors = "".join(f'<motor name="m {own}" joint="{own}" gear="2"/>' for own in MOTORS if f'name="{own}"' in bodies)
    servo = '<position name="servo" joint="k1" kp="3" kv=".1"/>' if 'name="k1"' in bodies else ""
    return importers.mjcf(file(bodies, f"<actuator>{motors}{servo}</actuator>"), ignore="limits")


@pytest.mark.slow
@pytest.mark.parametrize("names", [list(SUCCESSIONS)[:6], list(SUCCESSIONS)[6:]])
def test_joints_in_succession_move_as_in_mujoco(names):
    """With motors, a servo, springs and dampers on their coordinates."""
    model = successions(names)
    check_dynamics(model, 10, scale=0.5)
    if "three skew hinges apart" in names:
        assert model.coordinates["k3"] == "k1 k2 k3.angle_3"
        assert any("Joints 'k1', 'k2', 'k3' in succession are the Composite 'k1 k2 k3'" in own for own in model.notes)
        assert not any("'k2'" in note for note in model.notes if "limited to half a turn" in note)


def test_equalities_of_tendons_are_those_of_mujoco():
    """Sums of coordinates, polynomials of one, and lengths where they are neither."""
    bodies = rod("a", joint("i", axis="0 1 0", more='ref="20"')) + rod("b", joint("j", axis="0 1 0"), pos="0 1 0")
    bodies += rod("c", joint("k", "slide", "1 0 0", 'ref=".1"'), '<site name="tip"/>', pos="0 2 0")
    along = {"t1": {"i": 2, "j": 3, "k": -0.5}, "t2": {"k": 2}, "t3": {"i": 2}, "t4": {"k": 2, "j": -1}}
    on_joints = lambda own: "".join(f'<joint joint="{name}" coef="{c}"/>' for name, c in own.items())
    tendons = "".join(f'<fixed name="{name}">{on_joints(own)}</fixed>' for name, own in along.items())
    tendons += '<spatial name="s"><site site="o"/><site site="tip"/></spatial>'
    ties = {
        "e1": ('tendon1="t1" polycoef=".3 0 0 0 0"', "JointCoupling", 2.0),
        "e2": ('tendon1="t3" tendon2="t2" polycoef=".1 .2 .3 .4 .5"', "JointCoupling", 2.0),
        "e3": ('tendon1="t1" tendon2="t4" polycoef=".1 .7 0 0 0"', "JointCoupling", 2.0),
        "e4": ('tendon1="t3" tendon2="t4" polycoef=".1 .7 .2 0 0"', "JointCoupling", 1.0),
        "e5": ('tendon1="s" polycoef=".1 0 0 0 0"', "JointDriver", 1.0),
        "e6": ('tendon1="t2" polycoef=".1 0 0 0 0"', "JointDriver", 2.0),
    }
    equalities = "".join(f'<tendon name="{name}" {own}/>' for name, (own, *_) in ties.items())
    more = f"<tendon>{tendons}</tendon><equality>{equalities}</equality>"
    imported = importers.mjcf(file(f'<site name="o" pos="0 1 1"/>{bodies}', more))
    model = imported.locate.model
    data = mujoco.MjData(model)
    for q, v in random_states(model, 3, scale=0.4):
        data.qpos, data.qvel = q, v
        mujoco.mj_forward(model, data)
        values = {own: q[k] for k, own in enumerate("ijk")}
        values = {imported.coordinates[own]: value for own, value in values.items()}
        values |= {f"{model.tendon(k).name}.length": data.ten_length[k] for k in range(model.ntendon)}
        for name, (_, kind, scale) in ties.items():
            own = part(imported, name)
            assert own.kind == kind
            if kind == "JointDriver":
                found = values[own.coordinate] - own.value
            else:
                found, powers = values[own.coordinate] - own.zero, own.coefficients.reshape(len(own.other), -1)
                for other, zero, row in zip(own.other, own.other_zero.reshape(-1), powers, strict=True):
                    found = found - np.polyval(row[::-1], values[other] - zero)
            theirs = data.efc_pos[(data.efc_type == 0) & (data.efc_id == model.equality(name).id)]
            np.testing.assert_allclose(scale * found, theirs, rtol=1e-12, atol=1e-14)
    assert part(imported, "e1").other == ("j.angle", "k.displacement")


# The rows of the table

ACTUATOR, EQUALITY = "<actuator><{}/></actuator>", "<equality><{}/></equality>"
CORD = '<tendon><fixed name="t" {}><joint joint="hip" coef="{}"/></fixed></tendon>'
MOTOR = ACTUATOR.format('motor name="m" joint="hip" {}')
SLIDE = joint("hip", "slide", "1 0 0", 'stiffness="2" springref=".3"') + joint("turn", axis="0 1 0")
THREE = joint("hip", axis="1 0 0") + joint("h2", axis="0 1 0") + joint("h3")
EXACT = [
    ('<joint name="hip" axis="0 2 0"/>', "", "hip", {"axis_a": [0, 1, 0]}),
    ('<joint name="hip" type="slide" axis="1 0 0"/>', "", "hip", {"axis_a": [1, 0, 0]}),
    ('<joint name="hip" type="ball"/>', "", "hip", {}),
    ('<joint name="hip" stiffness="2" springref="90"/>', "", "hip spring", {"stiffness": 2, "free": np.pi / 2}),
    ('<joint name="hip" damping=".5"/>', "", "hip spring", {"damping": 0.5, "stiffness": 0}),
    ('<joint name="hip" armature=".1"/>', "", "hip armature", {"inertia": 0.1}),
    (HINGE, CORD.format('armature=".3"', 2), "t armature", {"inertia": 0.3}),
    (HINGE, EQUALITY.format('connect name="loop" body1="a" anchor=".3 0 0"'), "loop", {"point_b": [0.6, 0, 0]}),
    (HINGE, EQUALITY.format('weld name="loop" body1="a"'), "loop", {"orientation": [1, 0, 0, 0]}),
    (HINGE, EQUALITY.format('joint name="loop" joint1="hip" polycoef=".2 0 0 0 0"'), "loop", {"value": 0.2}),
    (HINGE, MOTOR.format('gear="3"'), "m", {"gear": 3, "gain": [1, 0, 0]}),
    (SLIDE, MOTOR.format('gear="3"'), "hip spring", {"stiffness": 2, "free": 0.3}),
    (
        HINGE,
        ACTUATOR.format('position name="m" joint="hip" kp="5" kv="2"'),
        "m",
        {"gain": [5, 0, 0], "bias": [0, -5, -2]},
    ),
    (HINGE, ACTUATOR.format('velocity name="m" joint="hip" kv="2"'), "m", {"gain": [2, 0, 0], "bias": [0, 0, -2]}),
    (HINGE, CORD.format("", ".4"), "t", {"coefficients": [0.4]}),
]
APPROXIMATE = [
    ('<joint name="hip" frictionloss=".2"/>', "", "hip friction", "JointFriction", "joints at rest creep: 'hip'"),
    ('<joint name="hip" range="-30 40"/>', "", "hip stop", "JointStop", "Limits are compliant stops"),
    (HINGE, MOTOR.format('ctrlrange="-1 1"'), "m", "Actuator", "clipped to their ranges.*'m'"),
    (
        HINGE,
        EQUALITY.format('connect name="l" body1="a" anchor=".3 0 0" solref=".1 1"'),
        "l",
        "Spherical",
        "their solref and solimp have no effect",
    ),
    (
        THREE,
        "",
        "hip h2 h3",
        "Composite",
        "is limited to half a turn, between the angles at which the three axes lie in one plane: 'h2'",
    ),
]


def test_mjcf_that_is_exact():
    said = "Equalities hold exactly|up to half a turn|in succession are the Composite"
    for joints, more, name, fields in EXACT:
        model = importers.mjcf(file(rod("a", joints), more))
        own = part(model, name)
        for field, value in fields.items():
            np.testing.assert_allclose(getattr(own, field), value, rtol=0, atol=1e-15)
        assert all(re.search(said, note) for note in model.notes)


def test_mjcf_that_is_approximated_is_said():
    for joints, more, name, kind, note in APPROXIMATE:
        model = importers.mjcf(file(rod("a", joints), more))
        assert kinds(model)[name] == kind
        assert any(re.search(note, said) for said in model.notes)


def test_stop_has_the_stiffness_and_damping_of_a_limit():
    """Of the inertia that moves, for a time constant times its ratio."""
    found = importers.mjcf(file(rod("a", '<joint name="hip" range="-30 40" solreflimit=".1 .5"/>')))
    own, inertia = part(found, "hip stop"), 1 / found.locate.model.dof_invweight0[0]
    np.testing.assert_allclose([own.stiffness, own.damping], [inertia / 0.05**2, 2 * inertia / 0.05], rtol=1e-12)
    np.testing.assert_allclose([own.lower, own.upper], np.radians([-30.0, 40.0]), rtol=1e-12)


def test_joints_are_where_mujoco_has_them():
    """Positions and velocities of MuJoCo satisfy them, and their coordinates are those of the file, with references."""
    slide = rod("b", joint("reach", "slide", "1 0 0", 'ref=".1"'), pos=".1 .3 0")
    found = importers.mjcf(file(rod("a", joint("hip", axis="0 1 0", more='ref="20" pos=".1 0 .05"'), slide)))
    host = found.scene.compile().on_host(0.0)
    for q, v in random_states(found.locate.model, 3, scale=0.4):
        state = found.state(q, v)
        np.testing.assert_allclose(host.coordinate_residual(np.asarray(state.q)), 0.0, atol=1e-12)
        velocities, _ = host.velocity_rows_at(np.asarray(state.q), np.asarray(state.u))
        np.testing.assert_allclose(velocities, 0.0, atol=1e-12)
    # No body is turned in the file.
    hip, reach, a, b = (part(found, name) for name in ("hip", "reach", "a", "b"))
    assert np.arctan2(np.cross(hip.x_a, hip.x_b)[1], hip.x_a @ hip.x_b) == pytest.approx(np.radians(20.0), abs=1e-14)
    apart = b.position + reach.point_b - a.position - reach.point_a
    np.testing.assert_allclose(apart, [0.1, 0.0, 0.0], atol=1e-14)


def test_joints_in_succession_are_where_mujoco_has_them():
    """From zero coordinates the body turns about each axis in turn, the last one first."""
    found = importers.mjcf(file(rod("c", SUCCESSIONS["three skew hinges apart"], pos="0 2 0")), ignore="limits")
    own, model = part(found, "k1 k2 k3"), found.locate.model
    data = mujoco.MjData(model)
    for q, _ in random_states(model, 3):
        attitude = rotation_of(own.orientation)
        position = own.point_a - attitude @ own.point_b
        for axis, point, angle in zip(own.axes[::-1], own.points[::-1], q[::-1], strict=True):
            turn = turn_about(axis, angle)
            attitude, position = turn @ attitude, point + turn @ (position - point)
        data.qpos = q
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(attitude.ravel(), data.body("c").xmat, rtol=0, atol=1e-12)
        np.testing.assert_allclose(position, data.body("c").xpos, rtol=0, atol=1e-12)


def test_weld_of_sites_has_their_relative_attitude():
    sites = '<site name="o" euler=".3 0 0"/>' + rod("a", HINGE, '<site name="s" euler="0 0 .4"/>', pos="0 0 0")
    weld = EQUALITY.format('weld name="loop" site1="s" site2="o"')
    own = part(importers.mjcf(file(sites, weld, '<compiler angle="radian"/>')), "loop")
    assert (own.body_a, own.body_b) == ("a", "ground")
    turn = rotation_of(np.asarray(own.orientation))
    np.testing.assert_allclose(turn, roll_pitch_yaw((0, 0, 0.4)) @ roll_pitch_yaw((0.3, 0, 0)).T, rtol=0, atol=1e-14)


@pytest.mark.parametrize("ends", ['body1="a" anchor=".1 .2 .3" relpose=".5 .2 .3 1 0 0 0"', 'site1="s" site2="o"'])
@pytest.mark.parametrize("scale, kind", [("0", "Spherical"), ("3", "Fixed")])
def test_weld_without_torque_holds_its_point_only(ends, scale, kind):
    bodies = '<site name="o" pos=".1 .2 .3"/>' + rod("a", HINGE, '<site name="s" pos=".5 .2 .3"/>')
    model = importers.mjcf(file(bodies, EQUALITY.format(f'weld name="loop" {ends} torquescale="{scale}"')))
    own = part(model, "loop")
    assert own.kind == kind and (own.body_a, own.body_b) == ("a", "ground")
    np.testing.assert_allclose(own.point_b, [0.1, 0.2, 0.3], rtol=0, atol=1e-15)
    np.testing.assert_allclose(own.point_a, [0.5, 0.2, 0.3], rtol=0, atol=1e-15)


def test_inertia_names_and_frames():
    inside = '<geom type="sphere" size=".02"/><site name="eye" pos="1 0 0"/>'
    fixed = f'<body name="sensor" pos="0 0 .1" euler="0 0 90">{inside}</body>'
    model = importers.mjcf(file(rod("a", HINGE, fixed) + '<body name="wall"><geom type="box" size="1 1 1"/></body>'))
    reference = mujoco.MjModel.from_xml_string(file(rod("a", HINGE, fixed)))
    (body,) = model.scene.bodies
    assert body.name == "a" and float(body.mass) == pytest.approx(reference.body_subtreemass[1], rel=1e-14)
    frames = {frame.name: frame for frame in model.scene.frames}
    assert {name: frame.body for name, frame in frames.items()} == {"sensor": "a", "eye": "a", "wall": "ground"}
    np.testing.assert_allclose(frames["eye"].position, [0, 1, 0.1], atol=1e-15)
    assert model.coordinates == {"hip": "hip.angle"}


def test_mocap_bodies_move_as_prescribed():
    text = file('<body name="hand" mocap="true" pos="0 0 1"/>' + rod("a", HINGE))
    model = importers.mjcf(text)
    assert kinds(model)["hand motion"] == "Fixed"
    np.testing.assert_array_equal(part(model, "hand motion").point_a, [0, 0, 1])
    assert any("Mocap bodies are held by a joint" in note and "'hand'" in note for note in model.notes)


TWICE = joint("p1", axis="0 1 0") + joint("p2", "slide", "1 0 0") + joint("p3", axis="0 1 0", more='pos="1 0 0"')
FOUR = "".join(joint(f"h{k}", axis=axis) for k, axis in enumerate(("1 0 0", "0 1 0", "0 0 1", "1 1 0")))
TWO_SLIDES = joint("s1", "slide") + joint("s2", "slide")
FLAT = joint("f1", axis="0 0 1") + joint("f2", axis="1 0 0") + joint("f3", axis="0 0 1")


TENDON = '<tendon><spatial name="t" {}><site site="o"/>{}<site site="s"/></spatial></tendon>'
PLUGIN = '<plugin joint="hip" plugin="mujoco.pid"><config key="kp" value="1"/></plugin>'
REFUSED = [
    (TWICE, "", "", "Joints in succession to 'a' are degenerate, hinge 'p1', hinge 'p3' are parallel hinges"),
    (TWO_SLIDES, "", "", "slide 's1', slide 's2' slide in linearly dependent directions"),
    (FOUR, "", "", "hinge 'h0', hinge 'h1', hinge 'h2', hinge 'h3' have more than three rotations"),
    (FLAT, "", "", "the axes of the hinges 'f1', 'f2', 'f3' lie in one plane in the middle of the range of 'f2'"),
    (HINGE, TENDON.format("", '<geom geom="drum"/>'), "", "Tendon 't' wraps around shapes or pulleys"),
    (HINGE, TENDON.format('stiffness="1" springlength=".1 .2"', ""), "", "The spring of tendon 't' has a slack range"),
    (
        HINGE,
        ACTUATOR.format('muscle name="m" joint="hip" lengthrange="-1 1"'),
        "",
        "Actuator 'm' has dynamics other than a filter",
    ),
    (HINGE, ACTUATOR.format('general name="m" site="s" gear="0 0 1 0 0 0"'), "", "Actuator 'm' acts by way of site"),
    (HINGE, "", '<option density="1"/>', "A fluid is not modelled"),
    ('<joint name="hip" type="ball" limited="true" range="0 30"/>', "", "", "limits of the ball joint 'hip'"),
    ('<joint name="hip" stiffness="1 2 3"/>', "", "", "Joint 'hip' has nonlinear stiffness"),
    ('<joint name="hip" damping="1 2 3"/>', "", "", "Joint 'hip' has nonlinear damping"),
    (HINGE, MOTOR.format('delay=".1" nsample="2"'), "", "'m' has delays"),
    (
        HINGE,
        f"<actuator>{PLUGIN}</actuator>",
        '<extension><plugin plugin="mujoco.pid"/></extension>',
        "Plugins are not supported; remove them from the file",
    ),
]


def test_mjcf_that_is_refused_is_named():
    for joints, more, head, message in REFUSED:
        bar = rod("a", joints, '<site name="s" pos=".1 0 0"/>')
        text = file(f'<site name="o"/><geom name="drum" type="sphere" size=".01"/>{bar}', more, head)
        with pytest.raises(ValueError, match=message):
            importers.mjcf(text)
    wrist = rod("hand", '<joint name="wrist" type="ball" armature=".1"/>')
    with pytest.raises(ValueError, match="armature of the ball joint 'wrist'"):
        importers.mjcf(file(rod("a", HINGE, wrist)))
    grid = '<flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" mass="1" dim="2">'
    with pytest.raises(ValueError, match="Deformable bodies") as error:
        importers.mjcf(file(rod("a", HINGE) + f'{grid}<edge equality="true"/></flexcomp>'))
    assert "is of type flex (ignore='loops' leaves it out)" in str(error.value)


def rotors(gravity):
    """A free body whose frame is off its mass centre, and one on a ball joint, each with armature and an arm."""
    arm = lambda name: rod(name, '<joint axis="0 1 1" armature=".02"/>')
    return importers.mjcf(
        file(
            rod("boat", '<joint name="float" type="free" armature=".7"/>', arm("oar"))
            + rod("bob", '<joint name="ball" type="ball" armature=".3"/>', arm("tail"), "0 0 2"),
            head=f'<option gravity="{gravity}"/>',
        )
    )


@pytest.mark.slow
def test_armature_of_free_joints_and_of_balls_on_the_ground():
    model = rotors("0 0 0")
    system = check_dynamics(model, 5)
    masses = model.locate.model.body_mass[[1, 3]]
    np.testing.assert_allclose(np.asarray(system.mass)[[0, 2]], masses + np.array([0.7, 0.0]), rtol=1e-12)
    assert any("Armature of free joints" in note and "'float', 'ball'" in note for note in model.notes)
    # It has no weight.
    model = rotors("1 2 -9.81")
    system, there = model.scene.compile(), model.locate.model
    data = mujoco.MjData(there)
    there.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    for q, v in random_states(there, 5):
        data.qpos, data.qvel = q, v
        mujoco.mj_forward(there, data)
        state = model.state(q, v)
        udot, _ = accelerations(system, Multipliers(), 0.0, state.q, state.u)
        expected = np.array(list(body_accelerations(there, data, model).values()))
        found = np.asarray(udot)[: expected.size].reshape(expected.shape)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.max(np.abs(expected)))
    light = importers.mjcf(file(rod("a", '<joint type="free" armature=".7"/>')), ignore="armature")
    np.testing.assert_allclose(light.scene.compile().mass, light.locate.model.body_mass[1], rtol=1e-12)


def test_adhesion_does_nothing_without_contacts():
    adhesion = '<adhesion name="foot" body="a" ctrlrange="0 1"/><motor name="m" joint="hip"/>'
    model = importers.mjcf(file(rod("a", HINGE), f"<actuator>{adhesion}</actuator>"))
    assert list(model.controls) == ["m"]
    assert any("Adhesion" in note and "'foot'" in note for note in model.notes)


def test_files_that_are_included(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "bar.xml").write_text(f"<mujocoinclude>{rod('a', HINGE)}</mujocoinclude>")
    (tmp_path / "machine.xml").write_text(file('<include file="parts/bar.xml"/>'))
    found, expected = importers.mjcf(tmp_path / "machine.xml"), importers.mjcf(file(rod("a", HINGE)))
    assert kinds(found) == kinds(expected)
    assert float(part(found, "a").mass) == float(part(expected, "a").mass)


def test_collisions_are_refused_unless_left_out():
    text = f'<mujoco><worldbody><geom type="plane" size="1 1 1"/>{rod("a", "<freejoint/>")}</worldbody></mujoco>'
    with pytest.raises(ValueError, match=r"Shapes of 1 bodies may collide \(a.*ignore='collisions' leaves it out"):
        importers.mjcf(text)
    model = importers.mjcf(text, ignore="collisions")
    assert "Left out, as ignore='collisions' asks: collisions." in model.notes
    (plane,), (bar, *ends) = model.shapes["ground"], model.shapes["a"]
    assert isinstance(plane, shapes.Ground) and bar.radius == 0.03 and [ball.radius for ball in ends] == [0.03, 0.03]
    assert model.shapes == model.collision_shapes


EXPLICIT = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'


HILLS = '<geom name="g" type="hfield" hfield="hills" contype="1" conaffinity="1"/>'
IGNORED = [
    ('<geom name="g" size="0"/>', "pictures", "size 0 must be positive"),
    ('<geom name="g" size="0" contype="1" conaffinity="1"/>', "collisions", "size 0 must be positive"),
    (HILLS, "collisions", "The file 'hills.png' of the height field 'hills' is missing"),
]


@pytest.mark.parametrize("shape, word, message", IGNORED, ids=["pictures", "collisions", "hills"])
def test_numbers_of_shapes_do_not_matter_where_they_are_ignored(shape, word, message):
    """Also of shapes that a sensor names."""
    hills = '<asset><hfield name="hills" file="hills.png" size="1 1 1 1"/></asset>'
    more = '<sensor><framepos objtype="geom" objname="g"/></sensor>'
    text = file(f'<body name="a"><joint name="hip"/>{EXPLICIT}{shape}</body>', more, hills if "hfield" in shape else "")
    with pytest.raises(ValueError, match=message):
        importers.mjcf(text)
    found = importers.mjcf(text, ignore=word)
    assert set(kinds(found)) == {"hip", "gravity"} and not found.shapes
    assert "Not read, since they do not act on the motion: 1 sensors." in found.notes


def test_elements_are_left_out_by_kind_or_by_name():
    text = file(rod("a", '<joint name="hip" range="-30 40" damping=".1"/>'))
    assert "hip stop" in kinds(importers.mjcf(text)) and importers.mjcf(text).shapes
    assert not importers.mjcf(text, ignore="pictures").shapes
    for ignored in (("limits", "damping"), "hip"):
        assert set(kinds(importers.mjcf(text, ignore=ignored))) == {"hip", "gravity"}
    found = importers.mjcf(file(rod("a", HINGE), "", '<option density="1.2" viscosity=".1"/>'), ignore="fluid")
    assert "Left out, as ignore='fluid' asks: fluid." in found.notes and set(kinds(found)) == {"hip", "gravity"}
    with pytest.raises(ValueError, match="Unknown element 'limit'; did you mean 'limits'"):
        importers.mjcf(text, ignore="limit")


# Files that are wrong


MESH = "<mujoco><asset><mesh name='m' file='m.stl'/></asset><worldbody><body name='a'><joint name='j'/>{}</body>"
WRONG = [
    ("<mujoco><worldbody><body><joint type='hing'/></body></worldbody></mujoco>", "hing"),
    ("<mujoco><worldbody><body name='a'><joint name='j'/></body></worldbody></mujoco>", "mass and inertia"),
    ("<mujoco><include file='nowhere.xml'/></mujoco>", "nowhere.xml"),
    (
        MESH.format("<geom type='mesh' mesh='m'/>") + "</worldbody></mujoco>",
        "The mass of body 'a' comes from mesh 'm', whose file is missing",
    ),
    ("nowhere.xml", "nowhere.xml does not exist"),
    ("<mujoco/>", "There is no moving link"),
]


def test_mjcf_that_is_wrong_is_refused():
    for text, message in WRONG:
        with pytest.raises(ValueError, match=message):
            importers.mjcf(text)


def test_meshes_of_pictures_that_are_missing_are_said():
    text = file(
        '<body name="a"><joint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        '<geom type="mesh" mesh="m"/></body>',
        '<asset><mesh name="m" file="m.stl"/></asset>',
    )
    assert "Mesh files are missing, so the picture lacks them: m." in importers.mjcf(text).notes


def test_degrees_and_compiler_options_are_those_of_mujoco():
    body = rod("a", '<joint name="hip" axis="0 1 0" ref="90" springref="45" stiffness="1"/>')
    degrees = importers.mjcf(file(body))
    numbers = body.replace("90", f"{np.pi / 2!r}").replace("45", f"{np.pi / 4!r}")
    radians = importers.mjcf(file(numbers, head='<compiler angle="radian"/>'))
    for own in (degrees, radians):
        assert float(part(own, "hip spring").free) == pytest.approx(np.pi / 4)


def test_keyframes_are_states():
    text = file(rod("a", HINGE), '<keyframe><key name="up" qpos="1.5" qvel="2"/></keyframe>')
    model = importers.mjcf(text)
    state = model.states["up"]
    np.testing.assert_allclose(state.u[3:], [0, 2, 0], atol=1e-15)
    np.testing.assert_allclose(state.q[3:], [np.cos(0.75), 0, np.sin(0.75), 0], atol=1e-15)


# Loops, angles and filters along a motion


OPEN = [
    ('<connect name="loop" site1="tip" site2="far"/>', "0.31 0.02 0", "loop by 0.0224 m"),
    ('<connect name="loop" site1="tip" site2="far"/>', "0.3 0 1e-9", None),
    ('<weld name="loop" site1="tip" site2="far"/>', "0.3 0 0", "loop by 0.2 rad"),
    ('<weld name="loop" site1="tip" site2="far"/>', "0.3 0 0.1", "loop by 0.1 m and 0.2 rad"),
    ('<connect name="loop" body1="a" anchor=".3 0 0"/>', "9 0 0", None),
    ('<weld body1="a" relpose="0 0.05 0 1 0 0 0"/>', "9 0 0", "equality 0 by 0.05 m"),
]


def test_loop_that_is_open_as_drawn_is_said():
    """The gap and the angle, by their formulas: of sites at (0.3, 0, 0) and at `pos`, there turned by 0.2 rad."""
    arm = rod("a", HINGE, '<site name="tip" pos=".3 0 0"/>', pos="0 0 0")
    for equality, pos, said in OPEN:
        far = f'<site name="far" pos="{pos}" euler="0 0 0.2"/>'
        found = importers.mjcf(file(far + arm, f"<equality>{equality}</equality>", '<compiler angle="radian"/>'))
        notes = [note for note in found.notes if "open as drawn" in note]
        expected = f"Loops are open as drawn, and assemble moves the bodies to close them: {said!r}."
        assert notes == ([] if said is None else [expected])


@pytest.mark.slow
@pytest.mark.parametrize("limits, angle", [("", 9.0), ('range="-200 200"', -3.4)])
def test_springs_and_servos_of_hinges_count_through_full_turns(limits, angle):
    joint = f'<joint name="hip" axis="0 1 0" stiffness="2" damping=".1" ref="20" springref="-70" {limits}/>'
    servo = '<actuator><position name="m" joint="hip" kp="5" kv=".3" gear="2"/></actuator>'
    imported = importers.mjcf(file(rod("a", joint), servo), ignore=("limits", "collisions"))
    model, system, state = imported.locate.model, imported.scene.compile(), imported.state([angle], [2.0])
    data = mujoco.MjData(model)
    data.qpos, data.qvel = angle, 2.0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    mujoco.mj_forward(model, data)
    udot, _ = accelerations(system, Multipliers(), 0.0, state.q, state.u)
    assert float(udot[4]) == pytest.approx(data.qacc[0], rel=1e-9)
    assert not any("turn" in note for note in imported.notes)
