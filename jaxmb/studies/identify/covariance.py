"""Covariances of estimates, and the combinations of unknowns that the data do not determine."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# A direction of unknowns is undetermined if the residuals are less sensitive to it than this, relative to the strongest
# direction.
_UNDETERMINED = 1e-6
# A direction is also undetermined if the data's sensitivity is below this multiple of the motions' relative tolerance,
# the accuracy of derivatives.
_TOLERANCES = 100.0
# Least share in an undetermined direction that makes a component undetermined.
_SHARE = 0.1


class Covariance(NamedTuple):
    """The uncertainty of the unknowns of a linearised fit.

    **Fields:** `matrix`: covariance of the components, infinite on the diagonal for undetermined components; `root`:
    its factor along the determined directions, components × directions; `lost`: the undetermined directions, components
    × directions; `undetermined`: mask of the components with a share in these directions; `noise`: the factor of the
    standard deviations, estimated from the residuals, or 1 for known noise.
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

    **Arguments:** `jacobian` of the residuals along n directions, starting with the `count` residuals of data;
    `changes` of the components along these directions; `squares`: sum of the squared residuals of data, which estimates
    unknown noise; None for known noise and a linear loss. For a robust loss, `squares` is the sum of the squares of
    `ψ`, and `slope` the mean of `ψ'`, with `ψ = r ρ'(r²)`. The result is then the covariance of Huber's M-estimate, as
    for noise of the variance `mean ψ² / (mean ψ')²`. `rtol`: the relative tolerance of the motions.
    """
    noise = 1.0
    if squares is not None:
        # The number of determined directions does not depend on the weights of the rows.
        surplus = count - int(np.sum(~_directions(jacobian, count, rtol)[2]))
        noise = np.sqrt(squares / surplus) / slope if surplus > 0 and slope > 0 else np.nan
        if np.isfinite(noise):
            # Prior knowledge keeps its known size.
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
    """Singular values of a Jacobian, their directions, and a mask of the undetermined directions."""
    rows, n = jacobian.shape
    # Rows of zeros complete the directions, without a square matrix of as many rows as there are data.
    _, sizes, directions = np.linalg.svd(np.pad(jacobian, ((0, max(n - rows, 0)), (0, 0))), full_matrices=False)
    of_data, of_others = (np.linalg.norm(rows @ directions.T, axis=0) for rows in np.split(jacobian, [count]))
    smallest = _UNDETERMINED * sizes[0]
    # Prior knowledge is exact.
    hidden = (of_data <= _TOLERANCES * rtol * np.linalg.norm(jacobian[:count], 2)) & (of_others <= smallest)
    return sizes, directions, (sizes <= smallest) | hidden


def combinations(components: tuple[str, ...], values: np.ndarray, found: Covariance) -> tuple[dict[str, float], ...]:
    """The joint changes, relative to the values, that do not change the data: one dictionary for each direction.

    The largest change of a direction is one; components that hardly change are left out. The directions share as few
    components as possible.
    """
    size = np.where(values == 0, 1.0, np.abs(values))
    relative = found.lost / size[:, None]
    relative = relative[:, np.max(np.abs(relative), axis=0, initial=0.0) > 0]
    basis, left = [], relative.copy()
    for _ in range(relative.shape[1]):
        row, column = np.unravel_index(np.argmax(np.abs(left)), left.shape)
        direction = left[:, column] / left[row, column]
        left = np.delete(left - np.outer(direction, left[row]), column, axis=1)
        basis = [other - other[row] * direction for other in basis] + [direction]
    out = []
    for direction in basis:
        direction = direction / direction[np.argmax(np.abs(direction))]
        out.append({name: float(x) for name, x in zip(components, direction, strict=True) if abs(x) > 1e-3})
    return tuple(out)
