"""Real machines from packages that hold their files; only those that are installed, and only with `--all`."""

import dataclasses
import importlib.metadata
from xml.etree import ElementTree

import numpy as np
import pytest
from model_files import OFF, check_dynamics, random_states

import jaxmb as mb
from jaxmb import importers

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
