"""Machines from files of other programs: MJCF of MuJoCo, URDF of ROS, SDF of Gazebo; and MJCF of a scene.

`mjcf`, `urdf` and `sdf` return an `ImportedModel`: a `scene` to extend and compile, `notes` on all approximations and
omissions, and `coordinates`, `controls` and `states` by the names of the file. MuJoCo reads MJCF, with its includes,
defaults and units (`pip install "jaxmb[import]"`). URDF may have `mimic` joints; in SDF, of any version, links with two
parents close loops. Bodies and joints keep their names, and bodies their frames; links fixed to other links, and sites,
become frames. Angles have the file's values. `viz.show(trajectory, shapes=model.shapes)` shows the links;
`model.collision_shapes` are shapes for contacts. `to_mjcf` writes a scene as MJCF for a check in MuJoCo, which holds
loops and couplings softly.

```python
model = jaxmb.importers.mjcf("arm.xml", ignore="collisions")
for note in model.notes:
    print(note)
system = model.scene.extended(forces=[jaxmb.JointSpring("hold", "elbow.angle", stiffness=5.0)]).compile()
state = jaxmb.assemble(system, fix={"elbow.angle": 0.3})
motion = jaxmb.simulate(system, state, t1=1.0, inputs={"motor.control": lambda t: 0.5 * jnp.sin(t)})
```

**Exact:**

- bodies: inertia, given or from shapes; bodies fixed to each other; gravity and its compensation; massless links
  between joints;
- joints: hinge, slide, ball, free; successions of joints, as one `Composite`; reference values; linear stiffness and
  damping; armature, as a `JointInertia`, or as part of a free body's mass and inertia, without weight;
- loops and couplings: `connect`, `weld`, `joint`, `tendon` of several joints; `mimic`; links with two parents;
  redundant rows are named;
- tendons along joints, through full turns, and straight between sites, with springs, dampers and armature;
- actuators: motors, position and velocity servos, all forces affine in length and speed, also with a filtered control:
  `Actuator(lag=)` filters the control, as MuJoCo does, and its `activation` is an internal state; `Motor(lag=)` filters
  the force;
- files: includes, degrees and other options of MJCF.

**Approximate, with a note:**

- moments of inertia that violate the triangle inequality by up to 5 % are lowered to the bound; massless links at the
    ends are left out;
- limits are compliant stops for the inertia that moves with the joint, with the time of MuJoCo's `solref`, 0.02 s by
  default; dry friction is `tanh(rate / transition_speed)`;
- `solref` and `solimp` have no effect on loops: constraints are hard; couplings see angles up to half a turn from zero,
  except gears of integer ratios;
- ranges of controls and forces are clipped; a mocap body is held by a joint, whose place may be an input; adhesion,
  which acts in contacts, is left out;
- SDF angles within rounding of a multiple of π/12, such as 1.5708, are snapped to it.

**Refused by name, or left out by `ignore=`:**

- collisions; flexible bodies; a mass from a missing mesh; inertia beyond the 5 %, or without mass;
- parallel hinges in succession; gearboxes and screws of SDF; poses in SDF relative to other frames; nonlinear
  stiffness and damping; armature of ball joints between moving bodies, limits of ball joints;
- `flex` equalities; tendons around shapes or pulleys, slack ranges; muscles, integrators, delays, actuators on sites; a
  joint's force limit shared by several actuators;
- fluids, plugins; `include` in SDF; xacro; document types and entities of XML.
"""

from .export import Exported as Exported, to_mjcf as to_mjcf
from .mjcf import mjcf as mjcf
from .model import ImportedModel as ImportedModel
from .sdf import sdf as sdf
from .urdf import urdf as urdf
