"""Real machines from packages that hold their files; only those that are installed, and only with `--all`."""

import dataclasses
import importlib.metadata
from xml.etree import ElementTree

import numpy as np
import pytest
from model_files import OFF, check_dynamics, random_states

import jaxmb as mb
from jaxmb import contact, importers, spatial, terrain
from jaxmb.importers.description import rotation_of

pytestmark = pytest.mark.slow

mujoco = pytest.importorskip("mujoco")

PLAYGROUND = "mujoco_playground/_src/"
TREES = {
    "cheetah": ("playground", f"{PLAYGROUND}dm_control_suite/xmls/cheetah.xml"),
    "ant": ("newton", "newton/examples/assets/nv_ant.xml"),
    "go1": ("playground", f"{PLAYGROUND}locomotion/go1/xmls/go1_mjx_feetonly.xml"),
    "leap hand": ("playground", f"{PLAYGROUND}manipulation/leap_hand/xmls/leap_rh_mjx.xml"),
}
# What a fluid would do is left out, and a height field whose file is missing.
SWIMMERS = {
    "fish": ("dm_control", "suite/fish.xml"),
    "go1 on hills": ("playground", f"{PLAYGROUND}locomotion/go1/xmls/scene_mjx_feetonly_rough_terrain.xml"),
}
# Robots whose pictures have wrong numbers, with ball joints of Bullet, or with empty lines before their XML.
URDF = {
    "differential": ("pybullet", "differential/diff_ring.urdf"),
    "humanoid": ("pybullet", "pybullet_data/humanoid/humanoid.urdf"),
    "talos": ("example-robot-data", "robots/talos_left_arm.urdf"),
}
ROBOTIQ = ("playground", f"{PLAYGROUND}manipulation/franka_emika_panda_robotiq/xmls/panda_updated_robotiq_2f85.xml")
CASSIE = ("example-robot-data", "cassie_description/robots/cassie_v2.sdf")


def path_of(package, end):
    """A file of an installed package, which is not imported."""
    try:
        files = importlib.metadata.files(package) or []
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(f"{package} is not installed: pip install --no-deps {package}")
    return next(own for own in files if str(own).endswith(end)).locate().resolve()


@pytest.mark.parametrize("name", TREES)
def test_trees_move_as_in_mujoco(name):
    model = importers.mjcf(path_of(*TREES[name]), ignore=(*OFF, "meshes"))
    system = check_dynamics(model, scale=0.5)
    there = model.locate.model
    # Mocap bodies, whose motion is prescribed, may have any mass.
    prescribed = [there.body(k).name for k in np.flatnonzero(there.body_mocapid >= 0)]
    masses = [mass for name, mass in zip(system.body_names, system.mass, strict=True) if name not in prescribed]
    moving = (there.body_weldid > 0) & (there.body_mocapid < 0)
    assert float(np.sum(masses)) == pytest.approx(np.sum(there.body_mass[moving]), rel=1e-12)


@pytest.mark.parametrize("name", SWIMMERS)
def test_swimmers_move_as_in_mujoco_without_their_fluid(name):
    imported = importers.mjcf(path_of(*SWIMMERS[name]), ignore=(*OFF, "fluid"))
    option = imported.locate.model.opt
    option.density = option.viscosity = 0.0
    check_dynamics(imported, scale=0.5)


def placed_by_mujoco(model, path):
    """A model from URDF with the states and equations that MuJoCo has for the same file."""
    spec = mujoco.MjSpec.from_string(text_without(path))
    other = importers.mjcf(spec, ignore=(*OFF, "couplings"))
    rows = {body.name: k for k, body in enumerate(other.scene.bodies)}
    order = np.array([rows[body.name] for body in model.scene.bodies])

    class Locate:
        model = other.locate.model

        def __call__(self, qpos, qvel):
            state = other.locate(qpos, qvel)
            return mb.State(state.q.reshape(-1, 7)[order].ravel(), state.u.reshape(-1, 6)[order].ravel())

    return dataclasses.replace(model, locate=Locate())


def text_without(path):
    """The text of a URDF without shapes."""
    root = ElementTree.fromstring(path.read_text().strip("\0 \n"))
    for link in root.iter("link"):
        for child in [own for own in link if own.tag in ("visual", "collision")]:
            link.remove(child)
    return ElementTree.tostring(root, encoding="unicode")


@pytest.mark.parametrize("name", URDF)
def test_robots_from_urdf_move_as_in_mujoco(name):
    path = path_of(*URDF[name])
    model = importers.urdf(path, ignore=(*OFF, "pictures", "couplings"))
    check_dynamics(placed_by_mujoco(model, path), scale=0.5)


def test_urdf_tree_moves_as_in_mujoco():
    """MuJoCo reads the same file."""
    path = path_of("newton", "newton/examples/assets/quadruped.urdf")
    model = importers.urdf(path, ignore=OFF)
    other = importers.mjcf(path, ignore=OFF)
    system, again = model.scene.compile(), check_dynamics(other, 20)
    assert sorted(system.body_names) == sorted(again.body_names)
    np.testing.assert_allclose(np.sort(system.mass), np.sort(again.mass), rtol=1e-12)


def test_equalities_are_those_of_mujoco():
    """The residuals of its own test model: connect and weld, between bodies and between sites, and a polynomial."""
    imported = importers.mjcf(path_of("newton", "newton/tests/assets/constraints.xml"), ignore=OFF)
    model = imported.locate.model
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT)
    system, data = imported.scene.compile(), mujoco.MjData(model)
    state = mb.assemble(system)
    assert np.max(np.abs(system.position_residual(0.0, state.q))) < 1e-12
    names = [name for name, _ in system.rows]
    for q, v in random_states(model, 5, scale=0.3):
        data.qpos, data.qvel = q, v
        mujoco.mj_forward(model, data)
        residual = np.asarray(system.position_residual(0.0, imported.state(q, v).q))
        for k, (name, rows) in enumerate((("c_site", 3), ("connect", 3), ("w_site", 3), ("weld", 3), ("joint", 1))):
            theirs = data.efc_pos[(data.efc_type == 0) & (data.efc_id == k)][:rows]
            own = residual[names.index(name) :][:rows]
            assert np.linalg.norm(own) == pytest.approx(np.linalg.norm(theirs), rel=1e-10), name


# A planar walker, slides, and a dog whose shoulder blades turn about three skew axes that do not meet.
IN_SUCCESSION = {
    "walker": ("gymnasium", "mujoco/assets/walker2d.xml"),
    "fetch": ("gymnasium-robotics", "assets/fetch/reach.xml"),
    "dog": ("dm_control", "suite/dog.xml"),
}


@pytest.mark.parametrize("name", IN_SUCCESSION)
def test_joints_in_succession_move_as_in_mujoco(name):
    """All their motors act: there are as many controls as actuators. Loops are opened."""
    imported = importers.mjcf(path_of(*IN_SUCCESSION[name]), ignore=(*OFF, "meshes", "loops", "couplings"))
    model = imported.locate.model
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)
    assert any(joint.kind == "Composite" for joint in imported.scene.joints)
    assert len(imported.controls) == model.nu
    check_dynamics(imported, scale=0.5)


def gripper():
    """The gripper of the arm by itself, on the world."""
    whole = mujoco.MjSpec.from_file(str(path_of(*ROBOTIQ)))
    for geom in list(whole.geoms):
        whole.delete(geom) if geom.meshname else None
    for mesh in list(whole.meshes):
        whole.delete(mesh)
    alone = mujoco.MjSpec()
    alone.compiler.degree = whole.compiler.degree
    alone.compiler.autolimits = whole.compiler.autolimits
    alone.worldbody.add_frame().attach_body(whole.body("base"), "", "")
    return importers.mjcf(alone, ignore="collisions")


def test_robotiq_gripper_closes_and_moves():
    model = gripper()
    system = model.scene.compile()
    assert {item.name for item in system.implied}
    state = mb.assemble(system)
    assert np.max(np.abs(system.position_residual(0.0, state.q))) < 1e-12
    (control,) = model.controls.values()
    closing = mb.with_parameters(system, {control: 0.3})
    motion = mb.simulate(closing, state, t1=0.03, rtol=1e-7, saveat=np.linspace(0, 0.03, 4))
    left, right = (motion.quantity(f"{side}_driver_joint.angle") for side in ("left", "right"))
    np.testing.assert_allclose(left, right, rtol=0, atol=1e-12)
    assert left[-1] > 1e-3 and np.max(motion.constraint_violation) < 1e-12


# Cassie


def cassie(*parts, joints=()):
    """The robot with its motors held by springs, and with balls at the ends of its soles."""
    model = importers.sdf(path_of(*CASSIE), ignore="collisions")
    motors = [f"{side}-{joint}-op" for side in ("left", "right") for joint in ("roll", "yaw", "pitch", "knee", "foot")]
    # Feet have little inertia, and would be stiff on springs as strong as the others.
    gains = lambda own: {"stiffness": 20.0, "damping": 0.2} if "foot" in own else {"stiffness": 400.0, "damping": 10.0}
    held = [mb.JointSpring(f"{own} hold", f"{own}.angle", **gains(own)) for own in motors]
    return model, model.scene.extended(joints=joints, forces=[*held, *parts]).compile()


def soles(model, system, state):
    """Contacts at the ends of the feet with a floor that is 2 mm below them."""
    motions = dict(zip(system.body_names, np.asarray(system.poses(state.q)), strict=True))
    centres = {body.name: np.asarray(body.centre) for body in model.scene.bodies}
    balls, lowest = [], np.inf
    for body in ("left-foot", "right-foot"):
        (roll,) = model.collision_shapes[body]
        for way in (-0.5, 0.5):
            at = roll.position + way * roll.length * rotation_of(roll.orientation)[:, 2]
            pose = motions[body]
            lowest = min(lowest, (pose[:3] + rotation_of(pose[3:]) @ (at - centres[body]))[2] - roll.radius)
            balls.append((body, at, roll.radius))
    law = {"normal": contact.Linear(4e4), "damping": 400.0, "friction": contact.Coulomb(0.8, transition_speed=0.05)}
    floor = terrain.Flat(level=lowest - 0.002)
    return [
        spatial.Contact(f"sole {k}", body, centres=at, radius=radius, terrain=floor, **law)
        for k, (body, at, radius) in enumerate(balls)
    ]


def test_cassie_hangs_is_released_and_lands_on_its_springs():
    """From the equilibrium while its pelvis was held, with the feet above a floor."""
    hold = spatial.Fixed("hold", "ground", "pelvis", point=(0.0, 0.0, 1.01))
    model, hanging = cassie(joints=[hold])
    assert {item.name for item in hanging.implied} == {"left-foot-op", "right-foot-op"}
    start = mb.equilibrium(hanging)
    _, system = cassie(*soles(model, hanging, start))
    assert system.nu - system.velocity_rank == 18
    motion = mb.simulate(system, start, t1=0.05, rtol=1e-8, saveat=np.linspace(0.0, 0.05, 7))
    height = motion["pelvis"].position[:, 2]
    assert height[-1] < height[0] - 5e-3
    assert np.max(motion.constraint_violation) < 1e-12
    # The heel springs yield where the feet have touched the floor.
    spring = motion["left-tarsus-spring-joint"].angle
    assert spring[-1] - spring[0] > 5e-3
