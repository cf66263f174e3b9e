"""A nonlinear program whose functions are computed in lanes: objective, constraints, and exact sparse derivatives.

With variables z, lane k has the inputs `v = E z + e`, outputs `y(v)` and their Jacobian J. Objective and constraints
are the rows of `R y + L z`. Their derivatives are sums over lanes of products of R, J and E, and second derivatives are
sums of products of E with the lanes' second derivatives. One sparse matrix makes each from the numbers of the lanes.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from .lanes import Block


@dataclasses.dataclass(frozen=True)
class Term:
    """Lanes and their inputs: `inputs @ z + offset`, lane by lane; `outputs` of each lane."""

    block: Block
    inputs: sparse.csr_array
    offset: np.ndarray
    outputs: int

    @property
    def lanes(self) -> int:
        """The number of lanes."""
        return len(self.block.charts[1])

    def at(self, z: np.ndarray) -> np.ndarray:
        """The inputs, shape (lanes, inputs)."""
        product: Any = self.inputs @ z
        return (product + self.offset).reshape(self.lanes, -1)

    @functools.cached_property
    def active(self) -> sparse.csr_array:
        """The rows of `inputs` for active inputs."""
        width = self.offset.size // self.lanes
        rows = np.arange(self.lanes)[:, None] * width + np.array(self.block.active, int)
        return sparse.csr_array(self.inputs[rows.reshape(-1)])


class Evaluated(NamedTuple):
    """All functions at a point: inputs, outputs and Jacobians of all lanes; `rows`: the objective, and constraints."""

    z: np.ndarray
    inputs: list[np.ndarray]
    outputs: list[np.ndarray]
    jacobians: list[np.ndarray]
    rows: np.ndarray

    @property
    def finite(self) -> bool:
        """Whether all numbers are finite."""
        return all(np.all(np.isfinite(x)) for x in (*self.outputs, *self.jacobians))


@dataclasses.dataclass(frozen=True)
class Problem:
    """Minimise row 0 of `R y + L z`, with bounds of the other rows and of z.

    **Fields:** `scale` of the variables, `low` and `high`; the `terms`; `of_outputs` R, with the outputs of all terms
    one after the other; `of_variables` L; `row_low`, `row_high`: bounds of the rows after the first; `names` of them.
    """

    scale: np.ndarray
    low: np.ndarray
    high: np.ndarray
    terms: Sequence[Term]
    of_outputs: sparse.csr_array
    of_variables: sparse.csr_array
    row_low: np.ndarray
    row_high: np.ndarray
    names: list[str]

    @functools.cached_property
    def _last(self) -> list[Evaluated]:
        return []

    @property
    def last(self) -> Evaluated | None:
        """The last point."""
        return self._last[0] if self._last else None

    def at(self, z: np.ndarray) -> Evaluated:
        """All functions at z; the last point is kept."""
        if self._last and np.array_equal(self._last[0].z, z):
            return self._last[0]
        inputs = [term.at(z) for term in self.terms]
        pairs = [term.block.linearised(given) for term, given in zip(self.terms, inputs, strict=True)]
        outputs, jacobians = [y for y, _ in pairs], [jacobian for _, jacobian in pairs]
        flat = np.concatenate([np.zeros(0), *(y.reshape(-1) for y in outputs)])
        rows = self.of_outputs @ flat + self.of_variables @ z
        self._last[:] = [Evaluated(z.copy(), inputs, outputs, jacobians, rows)]
        return self._last[0]

    @functools.cached_property
    def _slopes(self) -> tuple[np.ndarray, np.ndarray, sparse.csr_array, np.ndarray]:
        """Places of the derivatives' entries, the matrix that makes them from Jacobians, and their constant part."""
        rows, columns, values, sources = [], [], [], []
        first = place = 0
        for term in self.terms:
            width, active = term.lanes * term.outputs, len(term.block.active)
            part = sparse.coo_array(self.of_outputs[:, first : first + width])
            # Each entry of R meets all inputs of its lane, and each of these the variables that it depends on.
            lane = np.repeat(part.col // term.outputs, active)
            of_input = lane * active + np.tile(np.arange(active), part.nnz)
            source = place + np.repeat(part.col * active, active) + np.tile(np.arange(active), part.nnz)
            counts = np.diff(term.active.indptr)[of_input]
            entries = _ranges(term.active.indptr[of_input], counts)
            rows.append(np.repeat(np.repeat(part.row, active), counts))
            columns.append(term.active.indices[entries])
            values.append(np.repeat(np.repeat(part.data, active), counts) * term.active.data[entries])
            sources.append(np.repeat(source, counts))
            first, place = first + width, place + width * active
        constant = sparse.coo_array(self.of_variables)
        r, c = (np.concatenate([*parts, extra]) for parts, extra in ((rows, constant.row), (columns, constant.col)))
        places, entry = np.unique(r.astype(np.int64) * self.scale.size + c, return_inverse=True)
        k = r.size - constant.nnz
        made = (np.concatenate([np.zeros(0), *values]), (entry[:k], np.concatenate([np.zeros(0, int), *sources])))
        matrix = sparse.csr_array(made, shape=(places.size, max(place, 1)))
        fixed = np.bincount(entry[k:], weights=constant.data, minlength=places.size)
        return places // self.scale.size, places % self.scale.size, matrix, fixed

    def slopes(self, at: Evaluated) -> np.ndarray:
        """The derivatives of all rows by the variables, entry by entry at `places`."""
        *_, matrix, fixed = self._slopes
        flat = np.concatenate([np.zeros(0), *(jacobian.reshape(-1) for jacobian in at.jacobians)])
        return matrix @ (flat if flat.size else np.zeros(1)) + fixed

    @property
    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and variables of the entries of `slopes`."""
        return self._slopes[0], self._slopes[1]

    def jacobian(self, at: Evaluated) -> sparse.csr_array:
        """The derivatives of all rows, the objective's first."""
        return sparse.csr_array((self.slopes(at), self.places), shape=(1 + self.row_low.size, self.scale.size))

    @functools.cached_property
    def _bends(self) -> tuple[np.ndarray, np.ndarray, sparse.csr_array]:
        """Places of the lower triangle of second derivatives, and the matrix that makes them from the lanes'."""
        rows, columns, values, sources = [], [], [], []
        place = 0
        for term in self.terms:
            active, lanes = len(term.block.active), term.lanes
            lane, i, j = (x.reshape(-1) for x in np.mgrid[:lanes, :active, :active])
            starts, counts = term.active.indptr, np.diff(term.active.indptr)
            by_i, by_j = lane * active + i, lane * active + j
            pairs = counts[by_i] * counts[by_j]
            inner = _ranges(np.zeros(pairs.size, int), pairs)
            wide = np.repeat(counts[by_j], pairs)
            of_i = np.repeat(starts[by_i], pairs) + inner // np.maximum(wide, 1)
            of_j = np.repeat(starts[by_j], pairs) + inner % np.maximum(wide, 1)
            r, c = term.active.indices[of_i], term.active.indices[of_j]
            lower = r >= c
            rows.append(r[lower])
            columns.append(c[lower])
            values.append((term.active.data[of_i] * term.active.data[of_j])[lower])
            sources.append((place + np.repeat(np.arange(lane.size), pairs))[lower])
            place += lane.size
        r, c = np.concatenate(rows), np.concatenate(columns)
        places, entry = np.unique(r.astype(np.int64) * self.scale.size + c, return_inverse=True)
        matrix = sparse.csr_array(
            (np.concatenate(values), (entry, np.concatenate(sources))), shape=(places.size, max(place, 1))
        )
        return places // self.scale.size, places % self.scale.size, matrix

    @property
    def lower_places(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the entries of `bends`."""
        return self._bends[0], self._bends[1]

    def bends(self, at: Evaluated, weights: np.ndarray, central: bool = False) -> np.ndarray:
        """The lower triangle of the second derivatives of the weighted sum of all rows."""
        of_outputs, first, parts = self.of_outputs.T @ weights, 0, []
        for term, inputs, jacobian in zip(self.terms, at.inputs, at.jacobians, strict=True):
            own = of_outputs[first : first + term.lanes * term.outputs].reshape(term.lanes, term.outputs)
            first += own.size
            scales = (abs(term.inputs) @ self.scale).reshape(inputs.shape)
            parts.append(term.block.curvature(inputs, jacobian, own, scales, central).reshape(-1))
        return self._bends[2] @ np.concatenate(parts)


def _ranges(starts: Any, counts: np.ndarray) -> np.ndarray:
    """The ranges of integers from each start, one after the other."""
    ends = np.cumsum(counts)
    return np.repeat(starts - (ends - counts), counts) + np.arange(int(ends[-1]) if ends.size else 0)
