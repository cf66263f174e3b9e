"""Static indices of each body's entries in the vectors of coordinates and velocities."""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np

from ..parts.base import ScalarCoordinate
from ..parts.space import AbstractSpace


@dataclasses.dataclass(frozen=True)
class Layout:
    """Bodies in order, each with contiguous entries in q and u; then scalar coordinates; then the ground.

    A body that does not rotate (a point mass) has translations only; the rest of its pose is constant. A scalar
    coordinate has only the first entry of a pose and, if it moves, the first entry of a velocity. `flexible` lists, for
    each body with modal coordinates, its index and those of the modal coordinates.
    """

    space: AbstractSpace
    rotates: tuple[bool, ...]
    scalars: tuple[ScalarCoordinate, ...] = ()
    flexible: tuple[tuple[int, ...], ...] = ()

    @property
    def bodies(self) -> int:
        return len(self.rotates)

    @property
    def ground(self) -> int:
        """The index of the ground, equal to the count of bodies and scalar coordinates."""
        return len(self.rotates) + len(self.scalars)

    @property
    def spatial(self) -> bool:
        """Whether bodies move in space, not in a plane."""
        return self.space.dimension == 3

    def is_place(self, numbers: Sequence[int]) -> np.ndarray:
        """Which indices belong to bodies or the ground, not to scalar coordinates."""
        index = np.array(numbers)
        return (index < self.bodies) | (index == self.ground)

    @property
    def uniform(self) -> bool:
        """Whether all bodies rotate, without scalar coordinates. Then poses are a reshape of the coordinates."""
        return all(self.rotates) and not self.scalars

    @functools.cached_property
    def turning(self) -> list[int]:
        """Indices of the bodies with Euler parameters: in space all bodies that rotate."""
        return [k for k, rotates in enumerate(self.rotates) if rotates and self.spatial]

    @functools.cached_property
    def coordinate_lengths(self) -> np.ndarray:
        """Which coordinates are lengths, shape (nq,)."""
        return self._lengths(self.pose_index, self.nq)

    @functools.cached_property
    def velocity_lengths(self) -> np.ndarray:
        """Which velocities are rates of lengths, shape (nu,)."""
        return self._lengths(self.velocity_index, self.nu)

    def _lengths(self, index, size):
        translation = np.zeros(size, bool)
        translation[index[: self.bodies, : self.space.dimension]] = True
        for scalar, (first, *_) in zip(self.scalars, index[self.bodies : -1], strict=True):
            if first < size:
                translation[first] = scalar.is_length
        return translation

    @functools.cached_property
    def pose_index(self) -> np.ndarray:
        """Index of every pose entry, shape (ground + 1, pose size), into the coordinates followed by the ground's
        pose.
        """
        return _index(self._pose_sizes, [*range(self.nq, self.nq + self.space.pose_size)])

    @functools.cached_property
    def velocity_index(self) -> np.ndarray:
        """Index of every velocity entry, shape (ground + 1, velocity size), into the velocities followed by a zero."""
        return _index(self._velocity_sizes, [self.nu] * self.space.velocity_size)

    @functools.cached_property
    def velocity_place(self) -> np.ndarray:
        """Index of each velocity among all bodies' velocities, body by body, shape (nu,)."""
        return np.flatnonzero(self.velocity_index[:-1].ravel() < self.nu).astype(np.int32)

    @functools.cached_property
    def mass_index(self) -> np.ndarray:
        """As `velocity_index`, for the bodies and scalar coordinates that inertia does not couple: a flexible body has
        its modal coordinates' velocities after its own, and these coordinates have none.
        """
        if not self.flexible:
            return self.velocity_index
        size = self.space.velocity_size
        out = np.full((self.ground + 1, size + max(map(len, self.flexible)) - 1), self.nu, np.int32)
        out[:, :size] = self.velocity_index
        for mode, place in self._mass_places.items():
            out[place] = self.velocity_index[mode, 0]
            out[mode] = self.nu
        return out

    def mass_place(self, number: int) -> tuple[int, int]:
        """The row and the column of `mass_index` at which the velocities of a body or scalar coordinate begin."""
        return self._mass_places.get(number, (number, 0))

    @functools.cached_property
    def _mass_places(self) -> dict[int, tuple[int, int]]:
        size = self.space.velocity_size
        return {mode: (body, size + k) for body, *modes in self.flexible for k, mode in enumerate(modes)}

    @functools.cached_property
    def coordinate_place(self) -> np.ndarray:
        """Index of each coordinate among all bodies' poses, body by body, shape (nq,)."""
        return np.flatnonzero(self.pose_index[:-1].ravel() < self.nq).astype(np.int32)

    @functools.cached_property
    def nq(self) -> int:
        return sum(self._pose_sizes)

    @functools.cached_property
    def nu(self) -> int:
        return sum(self._velocity_sizes)

    @property
    def _pose_sizes(self) -> list[int]:
        size, d = self.space.pose_size, self.space.dimension
        return [*(size if rotates else d for rotates in self.rotates), *(1 for _ in self.scalars)]

    @property
    def _velocity_sizes(self) -> list[int]:
        size, d = self.space.velocity_size, self.space.dimension
        return [*(size if rotates else d for rotates in self.rotates), *(int(scalar.moves) for scalar in self.scalars)]

    def jacobian_source(self, groups: list[tuple[np.ndarray, int]], *, of_poses: bool) -> np.ndarray:
        """Source of each entry of an assembled Jacobian.

        **Arguments:** `groups`: for each group of parts its bodies (parts, k) and its rows; `of_poses`: columns are
        coordinates rather than velocities.

        **Returns:** shape (all rows, columns), indices into the raveled blocks (parts, rows, k, size) of all groups,
        followed by a zero.
        """
        index = self.pose_index if of_poses else self.velocity_index
        columns = self.nq if of_poses else self.nu
        total = sum(bodies.shape[0] * rows * bodies.shape[1] * index.shape[1] for bodies, rows in groups)
        source = np.full((sum(b.shape[0] * rows for b, rows in groups), columns + index.shape[1] + 1), total)
        row = start = 0
        for bodies, rows in groups:
            parts, k = bodies.shape
            block = start + np.arange(parts * rows * k * index.shape[1]).reshape(parts, rows, k, index.shape[1])
            start += block.size
            target = np.arange(row, row + parts * rows).reshape(parts, rows, 1, 1)
            source[target, index[bodies][:, None]] = block
            row += parts * rows
        return source[:, :columns]

    def reaction_source(
        self, joints: list[tuple[tuple[str, ...], tuple[tuple[int, ...], ...]]], names: tuple[str, ...]
    ) -> np.ndarray:
        """Indices of the wrench entries that add up to reactions: shape (names, largest count, k, velocity size).

        **Arguments:** `joints`: for each group of constraints the names of its parts and their bodies (parts, k);
        `names` of the joints with the reactions, all between the same number of bodies.

        Indices are into the raveled wrenches (parts, k, velocity size) of all groups, followed by a zero.
        """
        size, start = self.space.velocity_size, 0
        sources: dict[str, list[np.ndarray]] = {name: [] for name in names}
        for parts, bodies in joints:
            for name, part_bodies in zip(parts, bodies, strict=True):
                if name in sources:
                    sources[name].append(start + np.arange(len(part_bodies) * size).reshape(len(part_bodies), size))
                start += len(part_bodies) * size
        width = max(map(len, sources.values()))
        fill = lambda blocks: [*blocks, *[np.full_like(blocks[0], start)] * (width - len(blocks))]
        return np.array([fill(sources[name]) for name in names])


def _index(sizes: list[int], constant: list[int]) -> np.ndarray:
    """Consecutive indices of entries for bodies of these `sizes`; `constant` for missing entries and the ground."""
    index, start = [], 0
    for size in sizes:
        index.append([*range(start, start + size), *constant[size:]])
        start += size
    return np.array([*index, constant], np.int32)
