"""The interface between the multistep solvers and a term on a manifold.

A plain `diffrax.ODETerm` is an equation `y' = f(t, y)`. An `AbstractManifoldTerm` adds invariants that every solution
satisfies (a constraint manifold) and a local choice of coordinates on it (a chart). The solver keeps its history for
*all* components of `y`. The chart only says which components are integrated and which follow from the constraints
(`project_near`), so a change of chart preserves history and order.
"""

import abc
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int, PyTree

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

Chart: TypeAlias = PyTree[Array]
Y: TypeAlias = PyTree[Array]
Args: TypeAlias = Any


class ManifoldEvaluation(NamedTuple):
    """The value of an `AbstractManifoldTerm` at a state.

    **Fields:**

    - `y`: the state, on the manifold if a projection was requested.
    - `f`: the vector field there.
    - `chart`: the chart, with the same index sets; it may carry counters, and data that make the next evaluation
        cheaper.
    - `failed`: true if the state could not be evaluated or projected; a smaller step is then tried.
    - `factors`: data for a cheaper projection of a nearby state at the same time; any pytree of arrays, or None.
    """

    y: Y
    f: Y
    chart: Chart
    failed: Bool[Array, ""] | bool
    factors: PyTree = None


class AbstractResolvent(eqx.Module):
    """The solved form of `(1 - r J) z = x` for one complex number r, on the tangent space of a manifold."""

    @abc.abstractmethod
    def solve(self, x: Complex[Array, " n"]) -> Complex[Array, " n"]:
        """`(1 - r J)⁻¹ x` of a raveled tangent vector."""

    @abc.abstractmethod
    def transpose_solve(self, x: Complex[Array, " n"]) -> Complex[Array, " n"]:
        """The transpose of `solve`."""

    @abc.abstractmethod
    def weights(self) -> Float[Array, " n"]:
        """Weights of the components in which J is nearly normal for eigenvalues of the size of 1 / r."""


class AbstractFieldJacobian(eqx.Module):
    """The derivative J of a vector field along its manifold at a state, with a known structure.

    J may leave out terms that are small with the change of the state in a step: implicit solvers correct for them.
    """

    @abc.abstractmethod
    def project(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """The nearest tangent vector to a raveled one; a linear function."""

    @abc.abstractmethod
    def resolvent(self, r: Complex[Array, ""]) -> AbstractResolvent:
        """Factor `1 - r J`."""


class GuardsSeen(NamedTuple):
    """The guards at a time.

    **Fields:** their `values`; their `rates`, where guards can be negative inside a step but not at its ends, or their
    zeros are crossed in one direction; otherwise infinite. `begins`: which guards begin to grow from zero if a step
    starts here; None if no guard does. Such a guard may be smaller than the error of the step between its ends, so it
    counts only at the step's end, as long as its rate is positive.
    """

    values: Float[Array, " guards"]
    rates: Float[Array, " guards"]
    begins: Bool[Array, " guards"] | None = None


class AbstractGuards(eqx.Module):
    """The guards of a term, functions of time and state, both in the term's time.

    **Fields:** `touch`: values down to minus this count as zero; `near`: a step that was meant to end at an event does
    so if a guard is at most this.
    """

    touch: AbstractVar[Float[Array, ""]]
    near: AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def seen(self, t: Any, y: PyTree[Array]) -> GuardsSeen:
        """The guards at a time, in a state."""

    @abc.abstractmethod
    def forces(self, y: PyTree[Array]) -> Bool[Array, "guards"]:
        """Which guards are forces, of size one at most: the motion does not show how they vary in a step."""

    @abc.abstractmethod
    def changed(self, before: PyTree[Array], after: PyTree[Array]) -> Bool[Array, ""]:
        """Whether something changed in an event, from the states before and after it."""


class GapsSeen(NamedTuple):
    """The gaps of forces at a time.

    **Fields:** the `gaps`, negative where a force acts; their `rates`; the `widths` in which forces set in, as large as
    the gaps where these close; the `pace` [1/s]: in an interval of 1/pace no gap closes and opens unless its rates at
    both ends say so.
    """

    gaps: Float[Array, " gaps"]
    rates: Float[Array, " gaps"]
    widths: Float[Array, " gaps"]
    pace: Float[Array, ""]


class AbstractGaps(eqx.Module):
    """The gaps in which the forces of a term act, functions of time and state, in the term's time.

    **Fields:** `touch`: depths down to this count as zero.
    """

    touch: AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def seen(self, t: Any, y: PyTree[Array]) -> GapsSeen:
        """The gaps at a time and state."""


class AbstractVectorField(eqx.Module):
    """A vector field that knows the `gaps` in which its forces act; None without any."""

    @property
    @abc.abstractmethod
    def gaps(self) -> AbstractGaps | None:
        """The gaps of its forces."""


class AbstractManifoldTerm(diffrax.AbstractTerm[Y, Any]):
    """A vector field on a manifold, with a chart that says which components of the state are independent.

    Besides the methods below a concrete term has diffrax's `vf`, so it also runs under any other diffrax solver, then
    without charts.
    """

    def contr(self, t0, t1, **kwargs):
        del kwargs
        return t1 - t0

    def prod(self, vf, control):
        return jax.tree.map(lambda v: control * v, vf)

    @abc.abstractmethod
    def init_chart(self, t: Any, y: Y, args: Args) -> Chart:
        """A first chart at a state: any pytree of arrays, whose structure and shapes never change.

        `update_chart` follows at the same state before anything is evaluated, and may make the choice.
        """

    @abc.abstractmethod
    def evaluate(self, t: Any, y: Y, chart: Chart, args: Args) -> ManifoldEvaluation:
        """Evaluate the vector field at a state on the manifold or near it, a prediction; projection is optional."""

    @abc.abstractmethod
    def project_near(self, t: Any, y: Y, linearized_at: ManifoldEvaluation, args: Args) -> ManifoldEvaluation:
        """Project a state on the manifold, and evaluate the vector field there.

        The independent components of `y` are kept; the others are a first guess and are solved for. `linearized_at` is
        an evaluation of the prediction that `y` corrects, at the same time, or in a first step of the state before it.
        Its `factors` may make this evaluation cheap.
        """

    def project_cold(self, t: Any, y: Y, chart: Chart, args: Args) -> ManifoldEvaluation:
        """`project_near` without an evaluation nearby; `y` is a first guess.

        A manifold that needs only one evaluation, at the projected state, overrides this method.
        """
        # The point of linearisation does not affect the derivative.
        manifold, *at = jax.tree.map(stop, (self, t, y, args))
        linearized_at = manifold.evaluate(at[0], at[1], chart, at[2])
        out = self.project_near(t, y, linearized_at, args)
        return out._replace(failed=out.failed | linearized_at.failed)

    def kept(self, chart: Chart) -> PyTree[Array]:
        """The part of the chart at the end of a step for `at_solution`, stored for each step; by default all of it."""
        return chart

    def kept_at_start(self, chart: Chart) -> PyTree[Array]:
        """`kept` for the start of a run, from the chart at the end of the first step, whose prediction is the start.

        `update_chart` chose the index sets at the start.
        """
        return self.kept(chart)

    def at_solution(self, t: Any, y: Y, f: Y, kept: PyTree[Array], args: Args) -> tuple[Y, Y]:
        """A known state on the manifold and the known vector field there, with their derivatives by the equations.

        A manifold that need not solve its equations for this overrides this method.

        **Arguments:** `kept`: of a chart that is good there.
        """
        del f
        out = self.project_cold(t, y, kept, args)
        return out.y, out.f

    def along_solution(self, t: Any, y: Y, f: Y, along: Y | None, kept: PyTree[Array], args: Args) -> tuple[Y, Y, Y]:
        """`at_solution`, and the rate of the vector field along a rate `along` of the state, by default the field.

        A manifold that knows the rate of its equations overrides this method.
        """
        y, f = self.at_solution(t, y, f, kept, args)
        at = lambda t, y: self.at_solution(t, y, f, kept, args)[1]
        return y, f, jax.jvp(at, (t, y), (jnp.ones_like(t), f if along is None else along))[1]

    def found_at_jump(self, t: Any, y: Y, args: Args) -> PyTree[Array]:
        """The numbers of a jump that take long to compute, without derivatives; by default None.

        They are computed once, and stored for the derivatives of `after_jump`.
        """
        del t, y, args
        return None

    def after_jump(self, t: Any, y: Y, found: PyTree[Array], args: Args) -> Y:
        """The state just after a time at which the field or the manifold jumps; by default it has not changed.

        A manifold whose states jump with it overrides this method.

        **Arguments:** `found`: the numbers of `found_at_jump`.
        """
        del t, found, args
        return y

    def chart_after_jump(self, chart: Chart) -> Chart:
        """The chart just after a jump, for `update_chart`; by default the chart before the jump."""
        return chart

    @property
    def guards(self) -> AbstractGuards | None:
        """The functions whose zeros are events; `after_jump` gives the state after an event. By default None."""
        return None

    @property
    def gaps(self) -> AbstractGaps | None:
        """The gaps in which forces act, which no step may pass over; by default None."""
        return None

    def controlled(self, chart: Chart) -> PyTree[Bool[Array, "..."]]:
        """A mask like `y`: true for the components whose local error is measured; by default None, all."""
        del chart
        return None

    @abc.abstractmethod
    def free(self, chart: Chart) -> Int[Array, " free"] | None:
        """Indices of the independent components in the raveled state; their number never changes. None for all."""

    @abc.abstractmethod
    def update_chart(self, t: Any, y: Y, chart: Chart, args: Args) -> Chart:
        """Keep the chart or choose a better one at a state on the manifold, from which a step begins."""

    def jacobian(self, t: Any, y: Y, args: Args) -> AbstractFieldJacobian | None:
        """The derivative of the vector field at a state on the manifold, if the term knows its structure.

        By default None: implicit solvers then compute a full matrix for the independent components. A term that
        overrides this method projects states and does not single out components: all of them are `free`.
        """
        del t, y, args
        return None

    def closed(self, t: Any, y: Y, args: Args) -> "AbstractManifoldTerm":
        """The same term as a pytree of all numbers that it depends on; by default the term itself.

        **Arguments:** as of `vf`, an example.
        """
        del t, y, args
        return self

    def after_step(self, t: Any, y: Y, chart: Chart, args: Args) -> Chart:
        """The chart at the end of a step, with the data there that `refuses` needs; by default the same chart."""
        del t, y, args
        return chart

    def refuses(self, chart: Chart, before: Chart) -> Bool[Array, ""] | bool:
        """Whether a step must not lead from the chart `before` to this one; a shorter step is then tried."""
        del chart, before
        return False


class PlainTerm(AbstractManifoldTerm):
    """Another term of an ordinary differential equation, as a manifold without constraints and charts."""

    term: diffrax.AbstractTerm

    def vf(self, t, y, args):
        zero = jnp.zeros_like(t)
        return self.term.vf_prod(t, y, args, self.term.contr(zero, zero + 1))

    def init_chart(self, t, y, args):
        return None

    def evaluate(self, t, y, chart, args):
        return ManifoldEvaluation(y, self.vf(t, y, args), None, False)

    def project_near(self, t, y, linearized_at, args):
        return self.evaluate(t, y, None, args)

    def project_cold(self, t, y, chart, args):
        return self.evaluate(t, y, None, args)

    def along_solution(self, t, y, f, along, kept, args):
        field = lambda t, y: self.vf(t, y, args)
        along = field(t, y) if along is None else along
        return y, *jax.jvp(field, (t, y), (jnp.ones_like(t), along))

    @property
    def gaps(self):
        field = self.term.vector_field if isinstance(self.term, diffrax.ODETerm) else None
        return field.gaps if isinstance(field, AbstractVectorField) else None

    def free(self, chart):
        return None

    def update_chart(self, t, y, chart, args):
        return None

    def closed(self, t, y, args):
        # Functions may close over numbers that have derivatives.
        return PlainTerm(diffrax.ODETerm(eqx.filter_closure_convert(self.vf, t, y, args)))


def stop(x: Any) -> Any:
    """An array without its derivative; anything else as it is."""
    return jax.lax.stop_gradient(x) if isinstance(x, jax.Array) else x
