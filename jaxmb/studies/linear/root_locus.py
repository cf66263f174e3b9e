"""Eigenvalues along a parameter, with tracked modes."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import ArrayLike, Complex, Float

from ..._arguments import real_array
from ..._pictured import picture
from ..._types import Scalar, State
from ...parts.names import names_arguments, unknown
from ...system import AbstractSystem, parameters, with_parameters
from .linearise import linearise

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class RootLocus(eqx.Module):
    """Eigenvalues along a parameter; `plot` draws them.

    ```python
    locus = jaxmb.root_locus(system, "bar.inertia", [0.05, 0.08, 0.12], state=jaxmb.equilibrium)
    locus.eigenvalues[-1], locus.states
    locus.plot().savefig("locus.png")
    ```

    **Fields:**

    - `name` and `values` of the parameter, (values,).
    - `eigenvalues` [1/s], (values, k): each column is one tracked mode.
    - `shapes` of the modes in all coordinates and velocities, (values, nq + nu, k), each of norm one in units of the
        system's size.
    - `states`: names of the states.
    """

    name: str = eqx.field(static=True)
    values: Float[np.ndarray, "v"]
    eigenvalues: Complex[np.ndarray, "v k"]
    shapes: Complex[np.ndarray, "v n k"]
    states: tuple[str, ...] = eqx.field(static=True)

    def plot(self, labels: Sequence[str] = ()) -> "Figure":
        """Draw the eigenvalues, as `viz.plot_root_locus`, with `labels` of the modes."""
        return picture("root_locus.plot_root_locus", self, labels)

    def stable(self, least: float = 1e-6) -> np.ndarray:
        """At each value, whether no eigenvalue has a real part above `least` times the largest eigenvalue's size."""
        sizes = np.max(np.abs(self.eigenvalues), axis=1)
        return np.all(np.real(self.eigenvalues) <= least * sizes[:, None], axis=1)

    def boundaries(self, least: float = 1e-6) -> np.ndarray:
        """The values at which stability changes, by linear interpolation of the largest real parts between `values`;
        `least` as in `stable`.
        """
        sizes = np.max(np.abs(self.eigenvalues), axis=1)
        # Modes that stay at zero neither grow nor decay.
        moving = np.any(np.abs(self.eigenvalues) > least * sizes[:, None], axis=0)
        growth = np.max(np.real(self.eigenvalues[:, moving]), axis=1, initial=-np.inf)
        (k,) = np.nonzero(np.diff(self.stable(least)))
        return self.values[k] - growth[k] * np.diff(self.values)[k] / np.diff(growth)[k]


@names_arguments
def root_locus(
    system: AbstractSystem | Callable[[Scalar], tuple[AbstractSystem, State]],
    name: str,
    values: ArrayLike,
    *,
    state: Callable[[AbstractSystem], State] | None = None,
    t: Scalar = 0.0,
    coordinates: Sequence[str] | None = None,
    rates: Sequence[str] | None = None,
) -> RootLocus:
    """Linearise along values of a parameter and follow the modes.

    ```python
    locus = jaxmb.root_locus(system, "bar.mass", [0.5, 1.0, 2.0], state=jaxmb.equilibrium)
    ```

    Modes at neighbouring values are matched, all at once, by the overlap of their shapes and the distance of their
    eigenvalues. So modes keep their columns if eigenvalues cross.

    **Arguments:**

    - `system`: a compiled scene, or another system, whose parameter `name` takes the values; or a function that returns
        a system and a state for each value, such as a speed.
    - `name` of the parameter, or the meaning of the values.
    - `values`: numbers in order, close enough to follow the modes.
    - `state(system)`: the equilibrium or steady motion of each system, such as `mb.equilibrium`; not with a function.
    - `t`, `coordinates`, `rates`: as in `linearise`.

    All values are computed in one program, so functions must be traceable by JAX.

    **Returns:** a `RootLocus`, with NumPy arrays.

    **Raises:** `ValueError` for an unknown or non-scalar parameter, fewer than two values, a missing or superfluous
    `state`, refusals of `linearise` at the first value, and values without an equilibrium or steady motion.
    """
    case = _case(system, name, state)
    given = np.asarray(real_array("root_locus: values", values, np.result_type(float), None))
    if given.ndim != 1 or given.size < 2 or not np.all(np.isfinite(given)):
        raise ValueError(f"root_locus: values must be a vector of at least two finite numbers, got {values!r}.")
    # The first value names the states, and raises errors.
    first = linearise(*case(given[0]), t=t, coordinates=coordinates, rates=rates)
    chosen = first.states[: first.coordinates], first.states[first.coordinates :]

    def of_one(value):
        linear = linearise(*case(value), t=t, coordinates=chosen[0], rates=chosen[1])
        return linear.eigenvalues, linear.basis.astype(linear.vectors.dtype) @ linear.vectors

    # A loop: in a batch, two LAPACK routines at once may wait for each other's threads for ever, on two cores.
    of_all = eqx.filter_jit(lambda values: jax.lax.map(of_one, values))

    eigenvalues, shapes = map(np.asarray, of_all(given.astype(first.A.dtype)))
    bad = ~np.all(np.isfinite(eigenvalues), axis=1)
    if np.any(bad):
        listed = ", ".join(f"{value:.6g}" for value in given[bad][:8])
        raise ValueError(
            f"root_locus: there is no equilibrium or steady motion, or none in these states, at {name} = {listed}. "
            "linearise it there to see why."
        )
    sizes = np.concatenate([np.asarray(first.system.coordinate_scale()), np.asarray(first.system.velocity_scale())])
    shapes = shapes / sizes[None, :, None]
    shapes = shapes / np.linalg.norm(shapes, axis=1, keepdims=True)
    return RootLocus(name, given, *_followed(eigenvalues, shapes), first.states)


def _case(system: Any, name: str, state: Any) -> Any:
    """A function of a value that returns a system and its state."""
    if not isinstance(name, str):
        raise ValueError(f"root_locus: name must be text, got {name!r}.")
    if not isinstance(system, AbstractSystem):
        if not callable(system):
            raise ValueError("root_locus takes a compiled system, or a function that returns a system and a state.")
        if state is not None:
            raise ValueError("root_locus: the function returns a system and its state, so `state` is not needed.")
        return system
    values = parameters(system)
    if name not in values:
        raise unknown("parameter", name, values)
    if values[name].shape != ():
        shape = values[name].shape
        raise ValueError(f"root_locus: {name!r} has shape {shape}, and values are numbers; give a function.")
    if state is None:
        raise ValueError("root_locus needs the state of each system: state=jaxmb.equilibrium, or another function.")

    def of_parameter(value):
        changed = with_parameters(system, {name: value})
        return changed, state(changed)

    return of_parameter


def _followed(values, shapes):
    """Eigenvalues and shapes with modes in the same columns as at the first value."""
    from scipy.optimize import linear_sum_assignment

    values, shapes = values.copy(), shapes.copy()
    for k in range(1, len(values)):
        expected = values[k - 1] if k == 1 else 2 * values[k - 1] - values[k - 2]
        size = np.max(np.abs(values[k])) + np.finfo(float).tiny
        apart = np.abs(expected[:, None] - values[k][None, :]) / size
        overlap = np.abs(shapes[k - 1].conj().T @ shapes[k])
        _, order = linear_sum_assignment(apart + (1 - overlap))
        values[k], shapes[k] = values[k][order], shapes[k][:, order]
    return values, shapes
