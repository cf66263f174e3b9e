"""Linear stability of the multistep formulas, with rational coefficients.

```python
from jaxmb.solvers import stability
formula = stability.formula("E", 3)  # Enright's, with three points of the past.
stability.is_zero_stable(formula), stability.stability_angle(formula), stability.stiff_abscissa(formula)
stability.spectral_radius(formula, [-0.1, 0.1j, -np.inf]), stability.formula("Adams", 4).error_constant
stability.plot_regions([stability.formula("E", k) for k in (1, 2, 3)]).savefig("regions.png")
```

On the test equation `y' = λ y`, with `μ = h λ`, a multistep formula with second derivatives is a linear recurrence.
Its solutions are powers of the roots ζ of the characteristic polynomial

    Π(ζ, μ) = sum_j (a_j - μ b_j - μ² c_j) ζ^(k - j),

and it is stable where all of these remain bounded. A predictor-corrector method is such a recurrence too, so this
module also applies to Adams' method.

Sources: E. Hairer and G. Wanner, Solving Ordinary Differential Equations II, Springer, 1996, sections V.1 and V.3;
W. H. Enright, SIAM J. Numer. Anal. 11(2), 1974 (family E).
"""

import itertools
import math
from bisect import bisect_left
from collections.abc import Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._moved import tell_of_moved as _tell_of_moved
from ._formulas import FAMILIES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "Formula",
    "formula",
    "is_zero_stable",
    "plot_regions",
    "spectral_radius",
    "stability_angle",
    "stiff_abscissa",
]

Rationals: TypeAlias = tuple[Fraction, ...]

# Tolerances: roots this far outside the unit circle count as on it. Points of the locus this near the imaginary axis,
# relative to their size, count as on the axis.
_OUTSIDE = 1e-7
_LEFT = 1e-9

# Arguments of ζ for the boundary locus. Close to zero rounding errors dominate.
_THETA = np.linspace(1e-3, np.pi, 10_000)

# Rays in the sector of stability, as fractions of its angle, and sizes of μ on them at which the roots are tested.
_RAYS = np.array([0.0, 0.3, 0.7, 0.97, 0.995])
_SIZES = np.logspace(-3, 6, 400)

# Ratios of steps are tried as fractions with this denominator, to keep the rational numbers short.
_PARTS = 100_000


class Formula(NamedTuple):
    """A formula of constant step, newest first: `sum_j a_j y_{n+1-j} = h sum_j b_j f_{n+1-j} + h² sum_j c_j g_{n+1-j}`.

    Here `y' = f` and `y'' = g`, and `a_0 = 1`.

    **Fields:**

    - `name`: the family and the number of points of the past, as in "E4"; for Adams' method the order.
    - `a`, `b`, `c`: the coefficients, `k + 1` of each.
    - `order`: the largest p for which polynomials of degree p are solutions.
    - `error_constant`: C, where the two sides differ by `C h^(order+1) y^(order+1)` for a smooth function y.
    """

    name: str
    a: Rationals
    b: Rationals
    c: Rationals
    order: int
    error_constant: Fraction


def formula(family: str, k: int) -> Formula:
    """A multistep formula of constant step, from its order conditions.

    **Arguments:**

    - `family`: "E": the interpolant of f, with its slope at the end, is integrated over the step; "H": the same with
        the slope at every point. "B": the interpolant of y, with its slope at the end, has the second derivative g
        there; "Y": the same with the slope at every point. "Adams": predictor and corrector, see below.
    - `k`: the number of points of the past, at least 1, also those without practical use; of "Adams" the order of the
        predictor.

    In Adams' method with local extrapolation (PECE) the formula of Adams and Bashforth of order k predicts, and the
    formula of Adams and Moulton of order k + 1 corrects. The derivative is evaluated after each. With the coefficients
    `p_j` and `q_j` of the two formulas, on the test equation,

        y_{n+1} = y_n + h q_0 λ (y_n + h sum_j p_j f_{n+1-j}) + h sum_j q_j f_{n+1-j},  j = 1 ... k,

    where `λ f = g`. So its `Formula` has order k + 1 and `b_0 = c_0 = 0`; the `error_constant` is also for the test
    equation.

    **Returns:** a `Formula`.

    **Raises:** `ValueError` for another family or `k < 1`.
    """
    _check((*FAMILIES, "Adams"), family, k)
    nodes = [Fraction(-j) for j in range(k + 1)]
    if family == "Adams":
        return _with_order(f"Adams {k}", *_of_adams(nodes))
    return _with_order(f"{family}{k}", *_coefficients(family, nodes))


def _of_adams(nodes: list[Fraction]) -> tuple[Rationals, Rationals, Rationals]:
    prediction, correction = _means(nodes[1:]), _means(nodes)
    zero = Fraction(0)
    a = (Fraction(1), Fraction(-1), *[zero] * (len(nodes) - 2))
    b = (zero, correction[0] + correction[1], *correction[2:])
    return a, b, (zero, *(correction[0] * p for p in prediction))


def characteristic_roots(formula: Formula, mu: ArrayLike) -> NDArray[np.complex128]:
    """The roots ζ of the characteristic polynomial.

    **Arguments:** `mu`: `h λ`, complex, of any shape.

    **Returns:** k roots for each, along a new last axis, in no order. Where the leading coefficient vanishes, one root
    is infinite; it is returned as a very large number.
    """
    a, b, c = _floats(formula)
    mu = np.asarray(mu, complex)[..., None]
    polynomial = a - mu * b - mu**2 * c
    leading, size = polynomial[..., :1], np.max(np.abs(polynomial), axis=-1, keepdims=True)
    leading = np.where(np.abs(leading) > np.finfo(float).eps * size, leading, np.finfo(float).eps * size)
    degree = len(a) - 1
    companion = np.zeros((*polynomial.shape[:-1], degree, degree), complex)
    companion[..., 0, :] = -polynomial[..., 1:] / leading
    companion[..., 1:, :-1] = np.eye(degree - 1)
    return np.asarray(np.linalg.eigvals(companion), complex)


def spectral_radius(formula: Formula, mu: ArrayLike) -> NDArray[np.float64]:
    """The largest modulus of the roots, the growth factor of the error in a step.

    **Arguments:** `mu`: `h λ`, complex, of any shape; infinite for the stiffest components.

    **Returns:** real, of the same shape; the formula is stable where it is below one. At infinity it is `|R(∞)|`, 0 if
    the stiffest components are damped at once, and infinite for an explicit formula.
    """
    mu = np.asarray(mu, complex)
    far = np.isinf(mu)
    radius = np.max(np.abs(characteristic_roots(formula, np.where(far, 0.0, mu))), axis=-1)
    # The leading coefficient of an explicit formula vanishes, so one root is infinite.
    return np.where(far, _largest(np.roots(_floats(formula)[2])) if formula.c[0] else math.inf, radius)


def boundary_locus(formula: Formula, theta: ArrayLike) -> NDArray[np.complex128]:
    """The points μ where a root of the characteristic polynomial is `ζ = exp(i theta)`.

    The boundary of the region of stability is a part of these curves.

    **Arguments:** `theta`: angles [rad], of any shape.

    **Returns:** complex, of shape `(2, *theta.shape)`: the roots of smaller and of larger modulus of the quadratic
    equation `Π(ζ, μ) = 0`. The latter is infinite where the equation is linear.
    """
    powers = np.exp(-1j * np.asarray(theta, float)[..., None] * np.arange(len(formula.a)))
    a, b, c = (powers @ coefficients for coefficients in _floats(formula))
    root = np.sqrt(b**2 + 4 * a * c)
    # The sign without cancellation gives one solution; the other follows from their product -a / c.
    numerator = -(b + np.where((np.conj(b) * root).real < 0, -root, root)) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([-a / numerator, np.where(c == 0, np.inf, numerator / c)])


def stability_angle(formula: Formula) -> float:
    """The angle α of A(α)-stability: stable for all μ within α of the negative real axis.

    Computed from the sector without points of the boundary locus; roots are then tested on rays in it.

    **Returns:** α [degrees] to 1e-3, 90 for an A-stable formula and 0 for a formula that is stable in no sector.
    """

    mu = boundary_locus(formula, _THETA)
    alpha = float(np.min(180 - np.abs(np.degrees(np.angle(mu[_is_left(mu)]))), initial=90.0))
    rays = -np.exp(1j * np.radians(alpha * _RAYS))
    return alpha if _is_stable(formula, rays[:, None] * _SIZES) else 0.0


def stiff_abscissa(formula: Formula) -> float:
    """The abscissa D of stiff stability: the smallest `D >= 0` such that the formula is stable for `Re μ <= -D`.

    D does not describe small μ: a formula that is not zero-stable may have a finite D, too.

    **Returns:** D to 1e-4; infinite for a formula that is stable in no such half-plane.
    """

    mu = boundary_locus(formula, _THETA)
    D = float(np.max(-mu[_is_left(mu)].real, initial=0.0))
    rays = -np.exp(1j * np.radians(90 * _RAYS))
    return D if _is_stable(formula, rays[:, None] * _SIZES - D) else math.inf


def is_zero_stable(formula: Formula) -> bool:
    """Whether the formula is stable for `μ = 0`: all roots in the unit circle, and roots on it simple."""
    roots = characteristic_roots(formula, 0.0)
    on_circle = roots[np.abs(roots) > 1 - _OUTSIDE]
    distances = np.abs(on_circle[:, None] - on_circle) + np.eye(len(on_circle))
    return bool(_largest(roots) <= 1 + _OUTSIDE and np.all(distances > np.sqrt(_OUTSIDE)))


def largest_growth(family: str, k: int) -> float:
    """The largest constant ratio of neighbouring steps for which a formula of variable step remains zero-stable.

    With steps in a constant ratio the coefficients are constant too. The coefficients of y are the same for all steps
    in the families E and H, and in the one-step formulas.

    **Arguments:** `family`, `k`: as for `formula`.

    **Returns:** the ratio of a step and its predecessor, to 1e-5; infinite if every ratio is stable. It is below one
    for a formula that is not zero-stable when the steps are equal.

    **Raises:** `ValueError` for another family or `k < 1`.
    """
    _check(tuple(FAMILIES), family, k)
    if FAMILIES[family].integrated or k == 1:
        return math.inf

    def unstable(n):
        ratio = Fraction(n, _PARTS)
        nodes = [Fraction(0), *itertools.accumulate(-(ratio**-j) for j in range(k))]
        # Sums of the coefficients are the coefficients of the polynomial divided by ζ - 1.
        return _largest(np.roots(np.cumsum(np.array(_coefficients(family, nodes)[0], float))[:-1])) > 1

    tenth = _PARTS // 10
    end = next(n for n in (int(tenth * 1.05**i) for i in itertools.count()) if unstable(n))
    return (bisect_left(range(end), True, lo=tenth, key=unstable) - 1) / _PARTS


def plot_regions(formulas: Sequence[Formula], ax: "Axes | None" = None) -> "Figure":
    """Draw the regions of stability of some formulas in the plane of μ, shaded.

    **Arguments:** `formulas`: the formulas; `ax`: the matplotlib axes, default in a new figure.

    **Returns:** the matplotlib `Figure`.

    **Raises:** `ImportError` without matplotlib.
    """
    try:
        from matplotlib.figure import Figure
        from matplotlib.lines import Line2D
    except ImportError as error:
        raise ImportError('Figures need matplotlib; install it with: pip install "jaxmb[plot]"') from error

    figure: Any = Figure(figsize=(6.0, 6.0), layout="constrained") if ax is None else ax.figure
    axes = figure.add_subplot() if ax is None else ax
    re, im = _window(formulas)
    upper = re + 1j * im[:, None]
    for n, rule in enumerate(formulas):
        radius = spectral_radius(rule, upper)
        mirrored = np.concatenate([radius[:0:-1], radius])
        plane = re, np.concatenate([-im[:0:-1], im]), mirrored
        axes.contourf(*plane, levels=[0.0, 1.0], colors=[f"C{n % 10}"], alpha=0.1)
        axes.contour(*plane, levels=[1.0], colors=[f"C{n % 10}"])
    axes.axhline(0.0, color="0.5", linewidth=0.5)
    axes.axvline(0.0, color="0.5", linewidth=0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("Re μ")
    axes.set_ylabel("Im μ")
    handles = [Line2D([], [], color=f"C{n % 10}", label=rule.name) for n, rule in enumerate(formulas)]
    axes.legend(handles=handles, fontsize="small")
    return figure


def _window(formulas: Sequence[Formula], points: int = 161) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Real and nonnegative imaginary parts of a grid around the boundaries of the regions."""
    extents = []
    for rule in formulas:
        locus = boundary_locus(rule, np.linspace(1e-3, np.pi, 500)).ravel()
        locus = locus[np.isfinite(locus)]
        boundary = locus[spectral_radius(rule, locus) <= 1 + _OUTSIDE]
        locus = boundary if len(boundary) else locus
        # Some boundaries extend to infinity.
        extents.append(locus[np.abs(locus) <= 3 * np.median(np.abs(locus))])
    around: NDArray[np.complex128] = np.concatenate(extents)
    margin = 0.15 * np.max(np.abs(around))
    re = np.linspace(np.min(around.real) - margin, np.max(around.real) + margin, points)
    return re, np.linspace(0.0, np.max(np.abs(around.imag)) + margin, points // 2)


def _check(families: Sequence[str], family: str, k: int) -> None:
    if family not in families:
        raise ValueError(f"The families are {', '.join(map(repr, families))}; got family={family!r}.")
    if k < 1:
        raise ValueError(f"The formulas of family {family!r} have k = 1, 2, ... points of the past; got k={k}.")


def _coefficients(family: str, nodes: Sequence[Fraction]) -> tuple[Rationals, Rationals, Rationals]:
    """`a`, `b`, `c` for the times `(t_{n+1-j} - t_{n+1}) / h` of the points, newest first."""
    integrated, multiplicity = FAMILIES[family].integrated, FAMILIES[family].multiplicity
    points = range(len(nodes))
    fixed = {(0, 0): Fraction(1), (0, 1): Fraction(-1)} if integrated else {(0, 0): Fraction(1)}
    # Coefficients are named by the derivative that they multiply, and by the point.
    lowest = 1 if integrated else 0
    unknown = [(1, 0), (2, 0), *((d, j) for d in range(lowest, lowest + multiplicity) for j in points[1:])]
    # The fixed a sum to zero, so constants are solutions already.
    degrees = range(lowest, lowest + len(unknown))
    matrix = [[_residual(nodes[j], d, q) for d, j in unknown] for q in degrees]
    right = [sum((-x * _residual(nodes[j], d, q) for (d, j), x in fixed.items()), Fraction(0)) for q in degrees]
    solved = fixed | dict(zip(unknown, _solve(matrix, right), strict=True))
    a, b, c = (tuple(solved.get((d, j), Fraction(0)) for j in points) for d in range(3))
    return a, b, c


def _residual(node: Fraction, derivative: int, degree: int) -> Fraction:
    """The contribution of a unit coefficient to the difference of the two sides, for `y = s^degree`."""
    power = node ** (degree - derivative) if degree >= derivative else Fraction(0)
    return math.perm(degree, derivative) * (power if derivative == 0 else -power)


def _with_order(name: str, a: Rationals, b: Rationals, c: Rationals) -> Formula:
    degree, residual = -1, Fraction(0)
    while residual == 0:
        degree += 1
        residual = sum(
            (x * _residual(Fraction(-j), d, degree) for d, row in enumerate((a, b, c)) for j, x in enumerate(row)),
            Fraction(0),
        )
    return Formula(name, a, b, c, degree - 1, residual / math.factorial(degree))


def _means(nodes: Sequence[Fraction]) -> list[Fraction]:
    """Weights of the values at some times in the mean of their interpolant over the step from -1 to 0."""
    degrees = range(len(nodes))
    return _solve([[node**q for node in nodes] for q in degrees], [Fraction((-1) ** q, q + 1) for q in degrees])


def _solve(matrix: Sequence[Sequence[Fraction]], right: Sequence[Fraction]) -> list[Fraction]:
    """The exact solution of a linear system, by elimination."""
    rows = [[*row, last] for row, last in zip(matrix, right, strict=True)]
    for i in range(len(rows)):
        pivot = next(n for n in range(i, len(rows)) if rows[n][i])
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for n in range(len(rows)):
            if n != i and rows[n][i]:
                rows[n] = [x - rows[n][i] * y for x, y in zip(rows[n], rows[i], strict=True)]
    return [row[-1] for row in rows]


def _floats(formula: Formula) -> NDArray[np.float64]:
    """`a`, `b`, `c` as the rows of a matrix."""
    return np.array([formula.a, formula.b, formula.c], float)


def _is_left(mu: NDArray[np.complex128]) -> NDArray[np.bool_]:
    """Whether points are left of the imaginary axis, by more than rounding."""
    return np.isfinite(mu) & (mu.real < -_LEFT * np.abs(mu))


def _is_stable(formula: Formula, mu: ArrayLike) -> bool:
    return bool(np.all(spectral_radius(formula, mu) <= 1 + _OUTSIDE))


def _largest(roots: NDArray[Any]) -> float:
    return float(np.max(np.abs(roots), initial=0.0))


_tell_of_moved(__name__, adams='formula("Adams", k)', damping_at_infinity="spectral_radius(formula, -numpy.inf)")
