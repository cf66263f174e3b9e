"""Results of an import."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .._types import State
from ..bodies.scene import Scene
from ..parts.shapes import AbstractShape


@dataclasses.dataclass(frozen=True)
class ImportedModel:
    """A machine from a file.

    **Fields:**

    - `scene`: its bodies, joints, forces and frames, a `Scene`, to which `scene.extended(forces=[…])` adds parts.
        Bodies and joints have the names of the file, and bodies their frames; links fixed to other links, sites and
        other marks are frames. Angles and displacements of joints are the file's. Joints in succession, with no mass in
        between, are one `Composite`. The armature of a joint is a `JointInertia`.
    - `notes`: sentences on approximations and omissions, one for each kind, with the first names or lines of the file
        that it concerns; `named`: for each note all of these names or lines.
    - `coordinates`: for each joint of the file its coordinate in the scene, `{"hip": "hip.angle"}`.
    - `controls`: for each actuator of the file its control, a parameter, `{"motor": "motor.control"}`, for
        `simulate(..., inputs=)`.
    - `states`: the named states of the file, such as keyframes of MJCF, for `assemble`.
    - `shapes` of each body, its collision shapes if it has no others, for `viz.show(trajectory, shapes=model.shapes)`;
        `collision_shapes`: the file's shapes for collisions, for new contacts.
    """

    name: str
    scene: Scene
    notes: tuple[str, ...]
    coordinates: Mapping[str, str]
    controls: Mapping[str, str] = dataclasses.field(default_factory=dict)
    states: Mapping[str, State] = dataclasses.field(default_factory=dict)
    shapes: Mapping[str, tuple[AbstractShape, ...]] = dataclasses.field(default_factory=dict, repr=False)
    collision_shapes: Mapping[str, tuple[AbstractShape, ...]] = dataclasses.field(default_factory=dict, repr=False)
    named: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict, repr=False)
    locate: Callable[[np.ndarray, np.ndarray], State] | None = dataclasses.field(default=None, repr=False)

    def state(self, qpos: Any, qvel: Any = None) -> State:
        """The state of the bodies at MuJoCo's coordinates and velocities, for models from MJCF.

        **Arguments:** `qpos`, shape (nq,), and `qvel`, shape (nv,), default zero, in MuJoCo's order and conventions.

        **Raises:** `ValueError` for a model from another format, which has no such order; use `assemble` with
        `fix={"hip.angle": 0.3}` there.
        """
        if self.locate is None:
            raise ValueError(f"{self.name!r} has no coordinates of MuJoCo: use assemble with fix= by joint names.")
        qpos = np.asarray(qpos, float)
        return self.locate(qpos, np.zeros(0) if qvel is None else np.asarray(qvel, float))
