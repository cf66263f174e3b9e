"""What is measured of a motion: quantities by name, with their shapes and values."""

from jaxtyping import Array

from ..system import AbstractSystem, RigidBodySystem
from ..system.reactions import joint_names
from ..trajectory import Trajectory


def quantities(system: AbstractSystem, times: int) -> dict[str, tuple[int, ...]]:
    """Names that can be measured at so many times, with their shapes: `"rod.position"` of a body, `"A.force"` of a
    joint, and of a system with coordinates of the user's `"theta"`, `"theta.rate"`, and `"A.force"` of a constraint.
    """
    if not isinstance(system, RigidBodySystem):
        names = list(system.coordinate_names())
        forces = {f"{name}.force": (times, system.nu) for name in joint_names(system)}
        return dict.fromkeys((*names, *(f"{name}.rate" for name in names)), (times,)) | forces
    d = system.layout.space.dimension
    spin = (times,) if d == 2 else (times, 3)
    out = {}
    for name, rotates in zip(system.body_names, system.layout.rotates, strict=True):
        out |= {f"{name}.position": (times, d), f"{name}.velocity": (times, d)}
        if rotates:
            out |= {f"{name}.angle": (times,)} if d == 2 else {f"{name}.orientation": (times, 4)}
            out |= {f"{name}.angular_velocity": spin}
    for name in joint_names(system):
        out |= {f"{name}.force": (times, d), f"{name}.moment": spin}
    return out


def quantity(trajectory: Trajectory, name: str) -> Array:
    """One of the `quantities` along a motion; axis 0 is time."""
    system = trajectory.system
    names = system.coordinate_names()
    if not isinstance(system, RigidBodySystem) and name in names:
        return trajectory[name]
    part, field = name.rsplit(".", 1)
    if not isinstance(system, RigidBodySystem):
        return trajectory.rates[:, names[part][0]] if field == "rate" else trajectory.constraint_forces[part]
    source = trajectory[part] if part in system.body_names else trajectory.reactions[part]
    return getattr(source, field)


def places(system: AbstractSystem) -> tuple[str, ...]:
    """The quantities that tell where everything is: positions of the bodies, or all coordinates."""
    if isinstance(system, RigidBodySystem):
        return tuple(f"{name}.position" for name in system.body_names)
    return tuple(system.coordinate_names())
