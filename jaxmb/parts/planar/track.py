"""Tracks and belts: a closed elastic loop around wheels."""

import itertools
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._types import VectorLike
from ...linalg.arrays import namespace
from ...linalg.rotations import norm
from ...linalg.sums import placed_sums
from .. import fields
from ..base import AbstractPlanarPart, AbstractPotentialForce, PathKind
from ..space import round_shapes


class Track(AbstractPlanarPart, AbstractPotentialForce):
    """A closed elastic track or belt without mass around points of any number of bodies.

    ```python
    corners = {"left": (-1.0, 0.0), "right": (1.0, 0.0), "top": (0.0, 0.5)}
    wheels = [planar.Body(name, mass=5.0, inertia=planar.disc(5.0, 0.2), position=at) for name, at in corners.items()]
    path = [(name, (0.0, 0.0)) for name in corners]
    belt = planar.Track("belt", path, pretension=100.0, stiffness=1e4, radii=(0.2, 0.2, 0.2))
    system = jaxmb.Scene(wheels, forces=[belt]).compile()
    ```

    Its tension is `pretension + stiffness (length − free_length)`, the same all around, and its potential `pretension
    (length − free_length) + ½ stiffness (length − free_length)²`. Without `radii` the track is a polygon through the
    points. With `radii` it wraps circles, joined by their common tangents. It slides on them without friction and
    drives no wheel. In both cases it is assumed to touch every wheel, even a wheel that has risen above the line
    between its neighbours.

    **Arguments:**

    - `path`: at least 3 pairs (body, point), in the order of the track; points [m] are body-fixed, shape (2,). A body
        may occur several times.
    - `pretension` [N] ≥ 0, at the free length; `stiffness` [N/m] ≥ 0.
    - `free_length` [m], default from the given poses.
    - `radii` [m] ≥ 0, shape (points,), of circles around the points. The circles lie inside the track, and its path
        must be counter-clockwise.

    **Fields:** `bodies`, each once; `owners`, for each point the index of its body in `bodies`; `points`.
    """

    name: str = fields.name()
    bodies: fields.Names = fields.body_names()
    owners: tuple[int, ...] = eqx.field(static=True, default=())
    points: fields.Number = fields.parameter(shape=None, unit="m", kw_only=False)
    pretension: fields.Number = fields.parameter(unit="N", sign="non-negative", kw_only=False)
    stiffness: fields.Number = fields.parameter(unit="N/m", sign="non-negative", kw_only=False)
    free_length: fields.Number = fields.parameter(unit="m", optional=True, kw_only=False)
    radii: fields.Number = fields.parameter(shape=None, unit="m", sign="non-negative", optional=True, kw_only=False)
    path_kind: ClassVar[PathKind] = "belt"

    def __init__(
        self,
        name: str,
        path: Sequence[tuple[str, VectorLike]],
        *,
        pretension: Any,
        stiffness: Any,
        free_length: Any = None,
        radii: VectorLike | None = None,
    ):
        self.name = name
        self.bodies = tuple(dict.fromkeys(body for body, _ in path))
        self.owners = tuple(self.bodies.index(body) for body, _ in path)
        self.points = [np.asarray(point, float) for _, point in path]
        self.pretension, self.stiffness = pretension, stiffness
        self.free_length, self.radii = free_length, radii

    def __check_init__(self):
        n = len(self.owners)
        if n < 3 or self.points.shape != (n, 2):
            raise ValueError(
                f"{self.label}: path must hold at least 3 pairs (body, point) with points of shape (2,), got {n} with "
                f"points of shape {self.points.shape[1:]}."
            )
        if self.radii is not None and self.radii.shape != (n,):
            raise ValueError(f"{self.label}: radii must have shape ({n},), one per point, got {self.radii.shape}.")

    def complete(self, space, poses):
        if self.radii is not None:
            xp = namespace(poses, self.radii)
            distance, more = norm(self._lines(space, poses)), xp.roll(self.radii, -1) - self.radii
            if xp.any(distance <= xp.abs(more)):
                raise ValueError(f"{self.label}: a circle lies in its neighbour; remove it or make it smaller.")
            _, _, turn = self._tangents(self._lines(space, poses))
            # For a turn next to an end of its range, rounding decides whether all turns add up to a full turn.
            if xp.abs(xp.sum(turn) - 2 * np.pi) > 1.0 or xp.any(xp.abs(turn - 0.5 * np.pi) > np.pi - 1e-6):
                raise ValueError(f"{self.label}: a path with radii must be counter-clockwise; reverse its order.")
        return self.filled(free_length=self.length(space, poses))

    def _lines(self, space, poses):
        """The vectors from each point to the next."""
        points = self._centres(space, poses)
        return namespace(points).roll(points, -1, axis=0) - points

    def _centres(self, space, poses) -> Any:
        pairs = poses[np.array(self.owners)], self.points
        if namespace(*pairs) is np:
            return np.stack([space.point(*pair) for pair in zip(*pairs, strict=True)])
        return jax.vmap(space.point)(*pairs)

    def length(self, space, poses: Float[Array, "k p"]) -> Float[Array, ""]:
        """Length of the track [m]."""
        return self._measured(self._lines(space, poses))[0]

    def _measured(self, d):
        """From the lines of centres `d`: the length of the track, and the unit vectors of its straight parts."""
        if self.radii is None:
            xp, sizes = namespace(d), norm(d)
            return xp.sum(sizes), d / xp.where(sizes > 0, sizes, 1.0)[:, None]
        xp, (straight, along, turn) = namespace(d, self.radii), self._tangents(d)
        return xp.sum(straight) + xp.dot(self.radii, turn), along

    def _tangents(self, d):
        """For each line of centres in `d`: length and unit vector of the straight part, and the angle of the turn on
        the circle before it.
        """
        xp = namespace(d, self.radii)
        square = xp.sum(d * d, axis=1)
        more = xp.roll(self.radii, -1) - self.radii
        across = xp.stack([-d[:, 1], d[:, 0]], axis=1)
        # Circles without a common tangent give NaN, without a warning of NumPy.
        with np.errstate(invalid="ignore"):
            straight = xp.sqrt(square - more**2)
            # The unit vector along a tangent, turned from the line of centres towards the smaller circle.
            along = (straight[:, None] * d - more[:, None] * across) / square[:, None]
        into = xp.roll(along, 1, axis=0)
        turn = xp.arctan2(into[:, 0] * along[:, 1] - into[:, 1] * along[:, 0], xp.sum(into * along, axis=1))
        # A track may turn by half a turn or more at its ends; it turns backwards by less than a quarter turn.
        return straight, along, xp.where(turn < -0.5 * xp.pi, turn + 2 * xp.pi, turn)

    def path(self, space, poses):
        centres = self._centres(space, poses)
        if self.radii is None:
            return centres
        _, along, turn = self._tangents(self._lines(space, poses))
        # On each circle from the end of one straight part to the start of the next.
        back = jnp.linspace(1.0, 0.0, 9)[None, :] * turn[:, None]
        outward = jnp.stack([along[:, 1], -along[:, 0]], axis=1)[:, None, :]
        c, s = jnp.cos(back), jnp.sin(back)
        arc = jnp.stack([c * outward[..., 0] + s * outward[..., 1], c * outward[..., 1] - s * outward[..., 0]], axis=2)
        return (centres[:, None, :] + self.radii[:, None, None] * arc).reshape(-1, 2)

    def shapes(self, space, size):
        if self.radii is None:
            return ()
        circles = zip(self.owners, self.radii, self.points, strict=True)
        return tuple(itertools.chain(*(round_shapes(space, *circle) for circle in circles)))

    def tension(self, space, poses: Float[Array, "k p"]) -> Float[Array, ""]:
        """Tension [N]."""
        return self.pretension + self.stiffness * (self.length(space, poses) - self.free_length)

    def wrenches(self, space, poses, velocities, t):
        length, along = self._measured(self._lines(space, poses))
        tension = self.pretension + self.stiffness * (length - self.free_length)
        # The length of a taut line changes only with the ends of its straight parts, also around circles.
        pull = tension * (along - jnp.roll(along, 1, axis=0))
        forces = jax.vmap(space.point_force)(poses[np.array(self.owners)], self.points, pull)
        return placed_sums(np.array(self.owners), len(self.bodies))(forces)

    def energy(self, space, poses, t):
        stretch = self.length(space, poses) - self.free_length
        return self.pretension * stretch + 0.5 * self.stiffness * stretch**2
