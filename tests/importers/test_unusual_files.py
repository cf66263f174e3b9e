"""Files that are written in unusual ways: nothing in them is dropped in silence, and what is read is exact."""

import jax.numpy as jnp
import numpy as np
import pytest
from model_files import HINGE, ROD, body, check_dynamics, file, hinge, joint, kinds, link, model, part, robot, rod

from jaxmb import importers
from jaxmb.importers.description import roll_pitch_yaw

mujoco = pytest.importorskip("mujoco")

DEFAULTS = """<default><geom contype="0" conaffinity="0"/><joint damping=".05"/>
  <default class="stiff"><joint stiffness="2" armature=".02"/>
    <default class="bent"><joint springref="1.2" damping=".3"/></default></default></default>"""
HEAD = '<compiler angle="radian" eulerseq="zyx" autolimits="true"/><option gravity="1 -2 -9"/>' + DEFAULTS
# Machines that touch each other nowhere, each with an unusual thing.
UNUSUAL = {
    "a class of a class, for a child": '<body name="m0" childclass="stiff"><joint name="j0" axis="1 2 0" class="bent"/>'
    f'{ROD}<body pos=".3 0 0"><joint name="k0" axis="0 1 1"/>{ROD}</body></body>',
    "a frame, and a sequence of Euler angles": '<frame pos="0 1 0" euler=".3 .2 .5"><frame quat=".8 0 .6 0">'
    f'<body name="m1" euler="-.4 .1 .9" pos=".1 .2 .3"><joint name="j1" pos=".05 0 .1" axis="0 -3 1"/>{ROD}</body>'
    "</frame></frame>",
    "a full inertia": '<body name="m2" pos="0 2 0"><joint name="j2" type="ball" damping=".2"/>'
    '<inertial pos=".1 .2 -.1" mass="1.5" fullinertia=".05 .06 .04 .01 -.005 .008"/></body>',
    "a negative axis, and armature with a reference": '<body name="m3" pos="0 3 0"><joint name="j3" axis="0 -1 0" '
    f'ref=".7" armature=".05" stiffness="3" springref="-.2"/>{ROD}<body pos=".3 0 0"><joint name="k3" type="slide" '
    f'axis="-1 0 -2" ref="-.3" armature=".4" stiffness="9" springref=".1"/>{ROD}</body></body>',
    "a share of the weight": f'<body name="m4" gravcomp=".4" pos="0 4 0"><joint name="j4" axis="0 1 0"/>{ROD}'
    f'<body name="n4" pos=".2 0 0" gravcomp="1.5"><geom type="sphere" size=".05"/></body></body>',
    "a spring from its time and ratio": f'<body name="m5" pos="0 5 0"><joint name="j5" springdamper=".3 .4" '
    f'axis="0 1 0"/>{ROD}</body>',
    "a range beyond half a turn": '<body name="m6" pos="0 6 0"><joint name="j6" axis="0 1 0" range="-4.5 .9" '
    f'stiffness="2" springref=".3"/>{ROD}</body>',
    "a free body with damping": f'<body name="m7" pos="0 7 0"><joint name="j7" type="free" damping=".4"/>{ROD}</body>',
    "a joint and a tendon of one name": f'<body name="m8" pos="0 8 0"><joint name="j8" axis="0 1 0"/>{ROD}'
    f'<body pos=".3 0 0"><joint name="k8" axis="1 0 0" ref=".2"/>{ROD}</body></body>',
    "sledges at other places than their hinges": '<body name="m9" pos="0 9 0"><joint name="x9" type="slide" '
    'pos="1 1 0" axis="1 0 0" ref=".3" damping="0"/><joint name="z9" type="slide" axis="0 0 -1" pos="0 2 0" '
    'damping="0"/><joint name="j9" axis="0 1 0" pos=".1 0 -.1" ref="-.4" stiffness="2" armature=".1"/>'
    f"{ROD}</body>",
    "a body that is held by its children": f'<body name="m10" pos="0 10 0"><body name="n10" pos="0 0 1">{ROD}</body>'
    f'<joint name="j10" axis="1 1 0"/>{ROD}</body>',
}
MORE = """<tendon><fixed name="j8" stiffness="2" damping=".1"><joint joint="j8" coef=".5"/>
  <joint joint="k8" coef="-.7"/></fixed></tendon><actuator>
  <position name="servo" joint="j3" kp="10" kv="1" gear="-2" timeconst=".1"/>
  <general name="spring" joint="k3" gaintype="affine" gainprm="1 2 3" biastype="affine" biasprm=".5 -1 -2"
    ctrllimited="true" ctrlrange="-.3 .3" dyntype="filter" dynprm=".2" actlimited="true" actrange="-1 1"/>
  <cylinder name="piston" joint="j4" timeconst=".3" area="2" bias="1 -2 -3"/>
  <damper name="brake" joint="j5" kv="2" ctrlrange="0 1"/>
  <motor name="m8" joint="j8" gear="3"/><motor name="n8" tendon="j8" gear="-2"/>
  <position name="p6" joint="j6" kp="5" inheritrange="1"/>
  <motor name="off" joint="j4" gear="9" group="3"/></actuator>"""


@pytest.mark.slow
def test_mjcf_of_unusual_machines_moves_as_in_mujoco():
    """Accelerations, energies and the rates of activations, with a group of actuators that is switched off."""
    head = HEAD.replace("<option ", '<option actuatorgroupdisable="3" ')
    text = f"<mujoco>{head}<worldbody>{''.join(UNUSUAL.values())}</worldbody>{MORE}</mujoco>"
    imported = importers.mjcf(text, ignore="limits")
    assert "off" not in imported.controls
    assert "Actuators of disabled groups are left out: 'off'." in imported.notes
    system = check_dynamics(imported, scale=0.5)
    assert set(system.state_names()) == {"servo.activation", "spring.activation", "piston.activation"}


# What is missing with a flag, or which field has another value.
FLAGS = {
    "spring": (set(), "stiffness", 0.0),
    "damper": (set(), "damping", 0.0),
    "clampctrl": (set(), "control_range", None),
    "gravity": ({"gravity"}, None, None),
    "constraint": ({"loop", "hip stop", "hip friction"}, None, None),
    "actuation": ({"m"}, None, None),
}


def test_flags_that_switch_things_off():
    bar = rod("a", '<joint name="hip" axis="0 1 0" stiffness="2" damping=".1" range="-30 40" frictionloss=".1"/>')
    more = '<actuator><motor name="m" joint="hip" ctrlrange="-1 1"/></actuator>'
    more += '<equality><connect name="loop" body1="a" anchor=".3 0 0"/></equality>'
    for flag, (missing, field, value) in FLAGS.items():
        found = importers.mjcf(file(bar, more, f'<option><flag {flag}="disable"/></option>'))
        assert {"hip spring", "m", "hip stop", "hip friction", "loop", "gravity"} - set(kinds(found)) == missing
        if field is not None:
            assert getattr(part(found, "m" if flag == "clampctrl" else "hip spring"), field) == value


def test_keyframes_of_free_bodies():
    """The quaternion of a key need not be of unit length."""
    text = file(f'<body name="a"><freejoint/>{ROD}</body>', '<keyframe><key qpos="1 2 3 2 0 0 2"/></keyframe>')
    state = importers.mjcf(text).states["key 0"]
    np.testing.assert_allclose(state.q[3:], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-15)


def test_mocap_body_that_carries_a_machine():
    inner = rod("a", HINGE)
    found = importers.mjcf(file(f'<body name="hand" mocap="true" pos="0 0 1">{ROD}{inner}</body>'))
    assert [(own.name, own.body_a, own.body_b) for own in found.scene.joints] == [
        ("hand motion", "ground", "hand"),
        ("hip", "hand", "a"),
    ]


CORD = '<tendon><fixed name="t"><joint joint="hip" coef="2"/></fixed></tendon>'
ACTUATORS = [
    (
        f'{CORD}<actuator><motor name="m" tendon="t"/></actuator>',
        "Actuator 'm' acts on joint 'hip', which limits the force of its actuators",
    ),
    (
        '<actuator><motor name="m" joint="hip"/><motor name="n" jointinparent="hip"/></actuator>',
        "Actuator 'm' shares the limit of the actuator force of joint 'hip'",
    ),
    ('<actuator><intvelocity name="m" joint="hip" kp="1" actrange="-1 1"/></actuator>', "'m' has dynamics"),
    (
        '<actuator><general name="n" joint="hip" dyntype="filter" dynprm=".1" ctrlrange="-2 2" actrange="-1 1"/>'
        "</actuator>",
        "Actuator 'n' has a range of activation that the control may leave",
    ),
    (
        '<actuator><general name="m" joint="hip" dyntype="filter" dynprm="0"/></actuator>',
        "Actuator 'm' has a filter whose time constant is not positive",
    ),
]


def test_actuators_that_are_refused():
    for more, message in ACTUATORS:
        with pytest.raises(ValueError, match=message):
            importers.mjcf(file(rod("a", '<joint name="hip" axis="0 1 0" actuatorfrcrange="-1 2"/>'), more))


def test_limit_of_the_force_at_a_joint_holds_behind_a_gear():
    inner = rod("b", '<joint name="knee" axis="0 1 0" actuatorfrcrange="-3 5"/>')
    bar = rod("a", '<joint name="hip" axis="0 1 0" actuatorfrcrange="-1 2"/>', inner)
    motors = '<motor name="m" joint="hip" gear="-4" forcerange="-.4 1"/><motor name="n" joint="knee"/>'
    found = importers.mjcf(file(bar, f"<actuator>{motors}</actuator>"))
    np.testing.assert_allclose(part(found, "m").force_range, [-0.4, 0.25])
    np.testing.assert_allclose(part(found, "n").force_range, [-3, 5])
    # It does not matter without a gear.
    bar = rod("a", '<joint name="hip" axis="0 1 0" actuatorfrcrange="-1 2"/>')
    found = importers.mjcf(file(bar, '<actuator><motor name="m" joint="hip" gear="0"/></actuator>'))
    assert part(found, "m").force_range is None and part(found, "m").gear == 0


# URDF


@pytest.mark.slow
def test_urdf_mimic_with_an_offset_is_an_equality_of_mujoco():
    """The same row, for a joint along a negative axis that is not normalised."""
    text = robot(
        link("base"),
        link("left"),
        link("right"),
        joint("l", "base", "left", "continuous", "<axis xyz='0 -2 0'/>"),
        joint("r", "base", "right", "prismatic", "<axis xyz='0 0 -3'/><mimic joint='l' multiplier='-.2' offset='.1'/>"),
    )
    found = importers.urdf(text)
    system, other = found.scene.compile(), mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(other)
    data.qpos = [0.3, 0.25]
    mujoco.mj_forward(other, data)
    (row,) = data.efc_pos[data.efc_type == 0]
    q = [own for name in system.body_names for k in [other.body(name).id] for own in (data.xipos[k], data.xquat[k])]
    residual = system.position_residual(0.0, jnp.concatenate([jnp.asarray(own) for own in q]))
    assert float(np.max(np.abs(residual))) == pytest.approx(abs(row), rel=1e-12) and abs(row) > 0.2
    assert "Couplings see angles of hinges only up to half a turn from their zeros: 'r mimic'." in found.notes


def test_urdf_range_of_zero_is_none():
    text = robot(link("a"), link("b"), joint("j", "a", "b", inside="<axis xyz='0 1 0'/><limit effort='1'/>"))
    found = importers.urdf(text)
    assert "Limits without a range are ignored: 'j'." in found.notes and "j stop" not in kinds(found)


# Of the joints of these files.
TURN = roll_pitch_yaw((0, 0, 0.5))


def test_fixed_joints_are_frames_also_where_a_file_keeps_them():
    fixed = joint("f", "b", "c", "fixed").replace("type=", "dont_collapse='true' type=")
    found = importers.urdf(robot(link("a"), link("b"), link("c"), joint("j", "a", "b"), fixed))
    (own,) = found.scene.bodies
    assert own.name == "b" and float(own.mass) == 4.0
    assert {frame.name: frame.body for frame in found.scene.frames}["c"] == "b"
    # Of two equal masses: their moments, and half of one at their distance.
    places = [np.array([0.1, 0.0, 0.02]), np.array([0.3, 0.0, 0.1]) + TURN @ (0.1, 0.0, 0.02)]
    moments = roll_pitch_yaw((0, 0.3, 0)) @ np.diag([0.02, 0.05, 0.04]) @ roll_pitch_yaw((0, 0.3, 0)).T
    apart = places[1] - places[0]
    expected = moments + TURN @ moments @ TURN.T + apart @ apart * np.eye(3) - np.outer(apart, apart)
    np.testing.assert_allclose(own.inertia, expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(own.centre, np.mean(places, axis=0), rtol=0, atol=1e-14)


# SDF


def test_sdf_axes_in_other_frames():
    """In the frame of a model that is turned about x, and in that of another link."""
    for inside, axis in (
        ("<xyz expressed_in='__model__'>0 -1 0</xyz>", (0, 0, -1)),
        ("<xyz>0 -2 0</xyz><use_parent_model_frame>1</use_parent_model_frame>", (0, 0, -1)),
        ("<xyz expressed_in='b'>1 0 0</xyz>", (0, 0, 1)),
        ("<xyz>0 0 1</xyz>", (1, 0, 0)),
    ):
        found = importers.sdf(
            model(
                body("a", "0 0 0 0 1.5708 0"),
                body("b", "1 0 0 0 0 1.5708"),
                "<pose>0 0 0 1.5708 0 0</pose>",
                hinge("i", "world", "b"),
                hinge("j", "world", "a", axis=inside),
            )
        )
        np.testing.assert_allclose(part(found, "j").axis_a, axis, atol=1e-15)


def test_sdf_link_without_weight():
    inertial = body("x").partition("</pose>")[2].removesuffix("</link>")
    found = importers.sdf(model(body("a", inside="<gravity>0</gravity>" + inertial)))
    np.testing.assert_allclose(part(found, "a buoyancy").force, [0, 0, 9.81])
