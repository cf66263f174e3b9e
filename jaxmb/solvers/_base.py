"""What the multistep solvers ask of a term that also knows a manifold.

A plain `diffrax.ODETerm` is an equation `y' = f(t, y)`. An `AbstractManifoldTerm` is the same equation together with
invariants that every solution satisfies (a constraint manifold) and a local choice of coordinates on it (a chart).
The solver keeps its history for *all* components of `y`; the chart only says which of them are integrated and
which are solved for (`evaluate`), so a change of chart costs neither history nor order.
"""

import abc
from typing import Any, TypeAlias

import diffrax
from jaxtyping import Array, Bool, PyTree

Chart: TypeAlias = PyTree[Array]
Y: TypeAlias = PyTree[Array]
Args: TypeAlias = Any


class AbstractManifoldTerm(diffrax.AbstractTerm[Y, Any]):
    """A vector field on a manifold, with a chart that says which components of the state are independent.

    Besides the methods below a concrete term has diffrax's `vf`, `contr` and `prod` (as `diffrax.ODETerm`), so it also
    runs under any other diffrax solver, then without charts.
    """

    @abc.abstractmethod
    def init_chart(self, t: Any, y: Y, args: Args) -> Chart:
        """Choose a chart at a state; any pytree of arrays, of a structure and shape that never change."""

    @abc.abstractmethod
    def evaluate(self, t: Any, y: Y, chart: Chart, args: Args) -> tuple[Y, Y, Chart, Bool[Array, ""]]:
        """Restore `y` to the manifold, then evaluate the vector field there.

        The independent components of `y` are kept; the others are a first guess and are solved for.

        **Returns:** `(y on the manifold, f, chart, failed)`. The returned chart has the same index sets and may carry
        what makes the next evaluation cheaper (a matrix factor) and counters. `failed` is true where the state could
        not be restored; the step is then retried with a smaller one.
        """

    @abc.abstractmethod
    def controlled(self, chart: Chart) -> PyTree[Bool[Array, "..."]]:
        """A mask with the structure of `y`: true for the components that the local error is measured on."""

    @abc.abstractmethod
    def update_chart(self, t: Any, y: Y, chart: Chart, args: Args) -> Chart:
        """Keep the chart or choose a better one at a state on the manifold.

        Its result only counts if the step that led there is accepted. It is also asked before a restart after a jump.
        """
