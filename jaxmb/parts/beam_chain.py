"""Chains of beams along straight lines and curves, in the plane and in space."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from .._types import VectorLike
from ..linalg import rotations as rot
from .beam import Beam, InextensibleBeam
from .planar.bodies import Body as PlanarBody
from .planar.joints import Fixed as PlanarFixed
from .sections import AbstractSection
from .spatial.axes import shortest_turn
from .spatial.bodies import Body as SpatialBody
from .spatial.joints import Fixed as SpatialFixed


class BeamChain(NamedTuple):
    """The parts of a chain of beams, for the lists of a `Scene`."""

    bodies: list[Any]
    joints: list[Any]
    forces: list[Any]


def beam_chain(
    name: str,
    points: Float[ArrayLike, "n+1 d"],
    section: AbstractSection,
    *,
    mass: float,
    ends: Sequence[str | None] = ("ground", None),
    inextensible: bool = False,
    damping_time: float = 0.0,
    y: VectorLike | None = None,
) -> BeamChain:
    """A uniform beam as a chain of n beams between rigid nodes, stress-free along a line or a curve.

    ```python
    strip = jaxmb.sections.Rectangle(thickness=2e-3, width=0.02, modulus=2.1e11, poisson_ratio=0.3)
    nodes = np.linspace((0.0, 0.0), (0.5, 0.0), 5)
    blade = planar.beam_chain("blade", nodes, strip, mass=0.16)
    scene = jaxmb.Scene(blade.bodies, joints=blade.joints, forces=[*blade.forces, jaxmb.Gravity((0.0, -9.81))])
    hanging = jaxmb.equilibrium(scene.compile())
    ```

    The bodies are `"blade_node0"` to `"blade_node4"`, at the points, with their x axes along the beam; the beams are
    `"blade1"` to `"blade4"`. Welds `"blade_start"` and `"blade_end"` hold the ends; their reactions are the forces at
    the clamps. A node has half of the mass of each beam at it, with the inertia of its section; the nodes near both
    ends have other shares, by which a straight chain of equal beams has the inertia of the rod. A node of an
    inextensible chain has the halves, with the inertia of a rod. Errors fall with the square of n, so that `(4 x₂ₙ -
    xₙ) / 3` is closer than both; those of small deflections of elastic beams with its fourth power. A number of all
    beams at once is a `jaxmb.Variable` of `jaxmb.design`.

    **Arguments:**

    - `name`: the names of all parts begin with it; `section` as in `Beam`.
    - `points` [m], shape (n + 1, 2) for a planar scene, (n + 1, 3) for a spatial one: the nodes, in their order.
    - `mass` [kg] > 0 of the whole beam.
    - `ends`: names of the bodies to which the first and the last node are welded, None for a free end.
    - `inextensible`: a chain of `InextensibleBeam`, among its joints; by default of `Beam`, among its forces.
    - `damping_time` [s] as in `Beam`; `y`, in space: a direction in the plane of the first section's axes x and y, in
        the world; default from the shortest turn of the world's x axis to the beam.

    **Returns:** a `BeamChain` of `bodies`, `joints` and `forces`.

    **Raises:** `ValueError` for points of another shape or that coincide, and in space for a section without the axial
    stiffness by which the inertia about the beam follows.
    """
    places = np.asarray(points, float)
    if places.ndim != 2 or len(places) < 2 or places.shape[1] not in (2, 3):
        raise ValueError(f"beam_chain {name!r}: points must have shape (n + 1, 2) or (n + 1, 3), got {places.shape}.")
    lengths = np.linalg.norm(np.diff(places, axis=0), axis=1)
    if not np.all(lengths > 0):
        raise ValueError(f"beam_chain {name!r}: neighbouring points coincide; leave one out.")
    names = [f"{name}_node{k}" for k in range(len(places))]
    bodies = _nodes(names, places, section, mass * lengths / np.sum(lengths), y, inextensible)
    kind = InextensibleBeam if inextensible else Beam
    numbered = enumerate(itertools.pairwise(names), start=1)
    beams = [kind(f"{name}{k}", *pair, section=section, damping_time=damping_time) for k, pair in numbered]
    fixed = PlanarFixed if places.shape[1] == 2 else SpatialFixed
    held = zip(("start", "end"), ends, (0, -1), strict=True)
    welds = [fixed(f"{name}_{end}", to, names[k], point=places[k]) for end, to, k in held if to is not None]
    return BeamChain(bodies, [*welds, *beams], []) if inextensible else BeamChain(bodies, welds, beams)


def _nodes(names, places, section, masses, y, inextensible):
    """The bodies at the nodes, from the masses of the beams between them."""
    d = places.shape[1]
    ways = np.diff(places, axis=0)
    lengths = np.linalg.norm(ways, axis=1)
    if inextensible:
        # With this inertia errors of the strains and of the kinetic energy of waves cancel.
        mass, along = (np.convolve(values, (0.5, 0.5)) for values in (masses, masses * lengths**2 / 12))
    else:
        mass = _with_ends(masses, lengths)
        along = np.zeros_like(mass)
    if not (missing := section.missing(d, extends=True)):
        # Squares of the radii of gyration.
        gyration = np.asarray(section.bending(d))[d - 2 :] / np.asarray(section.extension(d))[0]
    elif d == 2:
        gyration = np.zeros(1)
    else:
        raise ValueError(f"beam_chain of {names[0]!r}: {missing}, by which the inertia of the nodes follows.")
    tangents = np.concatenate([ways[:1], ways[1:] + ways[:-1], ways[-1:]])
    if d == 2:
        angles = np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))
        inertias = along + mass * gyration[0]
        rows = zip(names, mass, inertias, places, angles, strict=True)
        return [PlanarBody(name, mass=m, inertia=i, position=at, angle=angle) for name, m, i, at, angle in rows]
    about = np.outer(mass, [np.sum(gyration), *gyration]) + np.outer(along, [0.0, 1.0, 1.0])
    rows = zip(names, mass, about, places, _attitudes(tangents, y), strict=True)
    return [
        SpatialBody(name, mass=m, inertia=np.diag(i), position=at, orientation=turn) for name, m, i, at, turn in rows
    ]


def _with_ends(masses: Any, lengths: Any) -> Any:
    """The masses of the nodes between the halves of elastic beams, changed near both ends.

    Halves are the trapezoidal rule for the kinetic energy; with these ends it is Gregory's rule of fourth order, and
    Simpson's for two beams. It is for beams of similar length there.
    """
    out = np.convolve(masses, (0.5, 0.5))
    for nodes, m, l in ((out, masses, lengths), (out[::-1], masses[::-1], lengths[::-1])):
        if len(l) > 1 and 0.5 <= l[0] / l[1] <= 2.0:
            both = l[0] + l[1]
            near, far = m[0] * both / (12 * l[1]), m[0] * l[0] ** 2 / (12 * l[1] * both)
            nodes[:3] += far - near, near, -far
    return out


def _attitudes(tangents, y):
    """Euler parameters of the nodes, each from the previous one by the shortest turn."""
    x: Any = np.eye(3)[0]
    turn: Any = shortest_turn(x, tangents[0])
    if y is not None:
        z = np.cross(tangents[0], y)
        axes = np.stack([tangents[0], np.cross(z, tangents[0]), z], axis=1)
        turn = np.asarray(rot.from_matrix(axes / np.linalg.norm(axes, axis=0)))
    out = [turn]
    for tangent in tangents[1:]:
        turn = rot.normalize(rot.multiply(shortest_turn(rot.rotate(turn, x), tangent), turn))
        out.append(turn)
    return out
