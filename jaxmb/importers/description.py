"""Description of a machine in a file, in one form for all formats: links, joints, loops and forces.

Places and axes are in the world, at the reference pose; `[...]` gives shapes and units. Orientations are rotation
matrices from the link to the world.
"""

import dataclasses
import enum
import itertools
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from ..parts.shapes import AbstractShape


class _Fixed(enum.Enum):
    WORLD = enum.auto()


# The key of the fixed world among the links, whose keys are their names in the file: no name equals it.
WORLD = _Fixed.WORLD
LinkKey = str | Literal[_Fixed.WORLD]
Kind = Literal["hinge", "slide", "ball", "free", "fixed"]


def _zeros():
    return np.zeros(3)


@dataclasses.dataclass
class Link:
    """A rigid link: `mass` [kg], `inertia` [kg m²] about the mass centre and `centre` [m] in the link's axes, and the
    `position` [m] and `rotation` of its frame. `where`: file and line, for messages.

    `moved`: its motion is prescribed.
    """

    name: str
    mass: float = 0.0
    centre: np.ndarray = dataclasses.field(default_factory=_zeros)
    inertia: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((3, 3)))
    position: np.ndarray = dataclasses.field(default_factory=_zeros)
    rotation: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
    where: str = ""
    moved: bool = False


@dataclasses.dataclass
class Joint:
    """An elementary joint of `child` on `parent`, with the forces on its coordinate. A weld that the file does not call
    a joint has an empty name.

    `point` [m] and `axis`, unit; `reference` [rad, m]: the coordinate at the reference pose; `stiffness` and `free`,
    `damping`, `armature`, `friction`, and `limits`, a pair or None. `stop`: the inertia [kg m², kg] and the time [s] of
    a compliant stop, None for a default.
    """

    name: str
    kind: Kind
    parent: LinkKey
    child: LinkKey
    point: np.ndarray = dataclasses.field(default_factory=_zeros)
    axis: np.ndarray = dataclasses.field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    reference: float = 0.0
    stiffness: float = 0.0
    free: Any = 0.0
    damping: float = 0.0
    armature: float = 0.0
    friction: float = 0.0
    limits: tuple[float, float] | None = None
    stop: tuple[float, float] | None = None
    where: str = ""

    @property
    def passive(self) -> tuple[str, ...]:
        """The forces on the joint, by the words that leave them out."""
        values = {
            "springs": self.stiffness,
            "damping": self.damping,
            "armature": self.armature,
            "friction": self.friction,
            "limits": self.limits is not None,
        }
        return tuple(kind for kind, value in values.items() if value)


@dataclasses.dataclass
class Loop:
    """Two links whose points [m], in the links' axes, coincide; with a `rotation`, of B in A, the links are welded."""

    name: str
    link_a: LinkKey
    link_b: LinkKey
    point_a: np.ndarray
    point_b: np.ndarray
    rotation: np.ndarray | None = None


@dataclasses.dataclass
class Coupling:
    """A joint's coordinate as a constant plus polynomials of other joints' coordinates, `x − zero = constant + Σᵢ Σₖ
    powersᵢ[k − 1] (yᵢ − zeroᵢ)ᵏ`; without others it is constant.

    `others`: names, powers and zeros; `of_tendons`: all coordinates, its own included, are tendon lengths.
    """

    name: str
    joint: str
    constant: float = 0.0
    others: list[tuple[str, np.ndarray, float]] = dataclasses.field(default_factory=list)
    zero: float = 0.0
    of_tendons: bool = False


@dataclasses.dataclass
class TendonPath:
    """A tendon along joints, pairs of a name and a coefficient, or straight along points of links, with a spring, a
    damper and an inertia.
    """

    name: str
    joints: list[tuple[str, float]] = dataclasses.field(default_factory=list)
    points: list[tuple[LinkKey, np.ndarray]] = dataclasses.field(default_factory=list)
    stiffness: float = 0.0
    free: float = 0.0
    damping: float = 0.0
    armature: float = 0.0
    friction: float = 0.0
    limits: tuple[float, float] | None = None
    stop: tuple[float, float] | None = None


@dataclasses.dataclass
class ActuatorElement:
    """An actuator of a joint, or of a tendon; its numbers as in `jaxmb.Actuator`."""

    name: str
    of: str
    on_tendon: bool = False
    gear: float = 1.0
    gain: tuple[float, float, float] = (1.0, 0.0, 0.0)
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    control: float = 0.0
    control_range: tuple[float, float] | None = None
    force_range: tuple[float, float] | None = None
    lag: float | None = None


@dataclasses.dataclass
class Mark:
    """A named frame on a link; `position` [m] and `rotation` in the link's axes."""

    name: str
    link: LinkKey
    position: np.ndarray
    rotation: np.ndarray


@dataclasses.dataclass
class Machine:
    """A machine as a file describes it.

    `shapes`, and `collisions` for shapes that may collide: pairs of a link and a shape in its frame.
    """

    name: str
    gravity: np.ndarray
    links: dict[str, Link] = dataclasses.field(default_factory=dict)
    joints: list[Joint] = dataclasses.field(default_factory=list)
    loops: list[Loop] = dataclasses.field(default_factory=list)
    couplings: list[Coupling] = dataclasses.field(default_factory=list)
    tendons: list[TendonPath] = dataclasses.field(default_factory=list)
    actuators: list[ActuatorElement] = dataclasses.field(default_factory=list)
    marks: list[Mark] = dataclasses.field(default_factory=list)
    shapes: list[tuple[LinkKey, AbstractShape]] = dataclasses.field(default_factory=list)
    collisions: list[tuple[LinkKey, AbstractShape]] = dataclasses.field(default_factory=list)
    buoyancy: dict[str, float] = dataclasses.field(default_factory=dict)

    def add(self, link: Link) -> str:
        """Add a link that the file does not have.

        **Returns:** its name: the name of `link`, or a similar unused name.
        """
        link.name = unused(link.name, self.links.__contains__)
        self.links[link.name] = link
        return link.name


def unused(name: str, is_used: Callable[[str], bool]) -> str:
    """A name, followed by a number if it is already used."""
    return next(
        candidate
        for candidate in itertools.chain([name], (f"{name} {k}" for k in itertools.count(2)))
        if not is_used(candidate)
    )


# Rotations


def rotation_of(quaternion: Any) -> np.ndarray:
    """The rotation matrix of Euler parameters, scalar first. They need not be normalised; the matrix is orthogonal to
    rounding.
    """
    w, x, y, z = np.asarray(quaternion, float) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def turn_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """The rotation matrix of a turn [rad] about a unit axis."""
    return rotation_of([np.cos(angle / 2), *(np.sin(angle / 2) * axis)])


def roll_pitch_yaw(angles: Any) -> np.ndarray:
    """The rotation matrix of angles [rad] about the fixed axes x, y and z in turn."""
    roll, pitch, yaw = angles
    x, y, z = np.eye(3)
    return turn_about(z, yaw) @ turn_about(y, pitch) @ turn_about(x, roll)
