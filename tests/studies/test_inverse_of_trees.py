"""Inverse dynamics of trees as MuJoCo has it."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import importers

mujoco = pytest.importorskip("mujoco")

TREE = """
<mujoco>
  <option gravity="0.3 -1 -9.81"><flag contact="disable"/></option>
  <default><geom type="capsule" size="0.05"/><joint damping="0.2" stiffness="1.5"/></default>
  <worldbody>
    <body name="trunk"><joint name="turn" axis="0 0 1"/><geom fromto="0 0 0 0 0.1 0.6"/>
      <body name="arm" pos="0 0.1 0.6"><joint name="lift" axis="1 0.2 0"/><geom fromto="0 0 0 0.7 0 0"/>
        <body name="rod" pos="0.7 0 0"><joint name="slide" type="slide" axis="1 0 0.3"/><geom fromto="0 0 0 0 0.4 0"/>
        </body>
      </body>
      <body name="leg" pos="0 0 0.3"><joint name="hip" axis="0 1 0" armature="0.1"/><geom fromto="0 0 0 0 0 -0.5"/>
        <body name="shin" pos="0 0 -0.5"><joint name="knee" axis="0 1 0.4"/><geom fromto="0 0 0 0.2 0 -0.5"/></body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.slow
def test_forces_of_a_tree_as_in_mujoco(tmp_path):
    (tmp_path / "tree.xml").write_text(TREE)
    imported = importers.mjcf(tmp_path / "tree.xml", ignore="collisions")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "tree.xml"))
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    system, names = imported.scene.compile(), [imported.coordinates[model.joint(k).name] for k in range(model.njnt)]
    for _ in range(3):
        q, v, a = random.uniform(-1.0, 1.0, (3, model.nv)) * np.array([[0.8], [2.0], [5.0]])
        data.qpos, data.qvel, data.qacc = q, v, a
        mujoco.mj_inverse(model, data)
        ts = np.linspace(0.0, 1.0, 5)
        # The polynomial of degree two through these points is its own spline.
        motion = {name: jnp.asarray(q[k] + v[k] * ts + a[k] * ts**2 / 2) for k, name in enumerate(names)}
        found = mb.required_forces(system, motion, by=names, ts=ts)
        forces = np.array([found[name][0] for name in names])
        np.testing.assert_allclose(forces, data.qfrc_inverse, rtol=0, atol=1e-12 * np.max(np.abs(forces)))
