"""Covariances of estimates, and the combinations of unknowns that make no difference to the data."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Directions of unknowns to which the residuals are less sensitive than this, relative to the strongest direction, are
# not determined.
_UNDETERMINED = 1e-6
# Nor are those to which the data are less sensitive than so many relative tolerances of the motions: derivatives are
# not more exact.
_TOLERANCES = 100.0
# Components with at least this share in such a direction are named.
_SHARE = 0.1


class Covariance(NamedTuple):
    """What a linearised fit says of its unknowns.

    **Fields:** `matrix`: covariance of the components, infinite on the diagonal where they are not determined; `root`:
    its factor along the directions that are determined, components × directions; `lost`: the others, components ×
    directions; `undetermined`: mask of the components that have a share in one of these; `noise`: the factor of the
    standard deviations that the residuals show, 1 where it is known.
    """

    matrix: Float[np.ndarray, "components components"]
    root: Float[np.ndarray, "components strong"]
    lost: Float[np.ndarray, "components weak"]
    undetermined: np.ndarray
    noise: float

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations of the components."""
        return np.sqrt(np.diag(self.matrix))


def covariance(
    jacobian: Float[np.ndarray, "rows n"],
    changes: Float[np.ndarray, "components n"],
    squares: float | None,
    count: int,
    slope: float = 1.0,
    rtol: float = 0.0,
) -> Covariance:
    """The covariance of a fit.

    **Arguments:** `jacobian` of the residuals along n directions, first of the `count` of data; `changes` of the
    components along them; `squares`: sum of the squared residuals of data, which estimates the noise if it is not
    known. For a robust loss these are the squares of `ψ = r ρ'(r²)`, and `slope` is the mean of `ψ'`: the covariance is
    that of Huber's M-estimate, as from samples with noise of the variance `mean ψ² / (mean ψ')²`. `rtol`: the
    relative tolerance of the motions.
    """
    noise = 1.0
    if squares is not None:
        # The rank of what is determined does not depend on how the rows are weighted.
        surplus = count - int(np.sum(~_directions(jacobian, count, rtol)[2]))
        noise = np.sqrt(squares / surplus) / slope if surplus > 0 and slope > 0 else np.nan
        if np.isfinite(noise):
            # What is known beside the data has the size that it is known with.
            jacobian = np.vstack([jacobian[:count], noise * jacobian[count:]])
    sizes, directions, weak = _directions(jacobian, count, rtol)
    root = changes @ (directions[~weak] / sizes[~weak][:, None]).T
    lost = changes @ directions[weak].T
    root = root * noise
    matrix = root @ root.T
    undetermined = np.max(np.abs(lost), axis=1, initial=0.0) > _SHARE * np.max(np.abs(changes), axis=1)
    matrix[undetermined, :] = matrix[:, undetermined] = 0.0
    matrix[undetermined, undetermined] = np.inf
    return Covariance(matrix, root, lost, undetermined, float(noise))


def _directions(jacobian, count, rtol):
    """Singular values of a Jacobian, their directions, and which of them are not determined."""
    rows, n = jacobian.shape
    # Rows of zeros complete the directions, without a square matrix of as many rows as there are data.
    _, sizes, directions = np.linalg.svd(np.pad(jacobian, ((0, max(n - rows, 0)), (0, 0))), full_matrices=False)
    of_data, of_others = (np.linalg.norm(rows @ directions.T, axis=0) for rows in np.split(jacobian, [count]))
    smallest = _UNDETERMINED * sizes[0]
    # What is known beside the data is exact.
    hidden = (of_data <= _TOLERANCES * rtol * np.linalg.norm(jacobian[:count], 2)) & (of_others <= smallest)
    return sizes, directions, (sizes <= smallest) | hidden


def combinations(components: tuple[str, ...], values: np.ndarray, found: Covariance) -> tuple[dict[str, float], ...]:
    """The changes, relative to the values, that together make no difference: one dictionary for each direction.

    The largest change of a direction is one; components that hardly change are left out. Directions are chosen such
    that they share as few components as possible.
    """
    size = np.where(values == 0, 1.0, np.abs(values))
    relative = found.lost / size[:, None]
    relative = relative[:, np.max(np.abs(relative), axis=0, initial=0.0) > 0]
    basis, left = [], relative.copy()
    for _ in range(relative.shape[1]):
        row, column = np.unravel_index(np.argmax(np.abs(left)), left.shape)
        direction = left[:, column] / left[row, column]
        left = np.delete(left - np.outer(direction, left[row]), column, axis=1)
        basis = [own - own[row] * direction for own in basis] + [direction]
    out = []
    for direction in basis:
        direction = direction / direction[np.argmax(np.abs(direction))]
        out.append({name: float(x) for name, x in zip(components, direction, strict=True) if abs(x) > 1e-3})
    return tuple(out)
