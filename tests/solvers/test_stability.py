"""Stability of the multistep formulas, against published tables and against the recurrences themselves.

Source of the numbers for families E and B, but for the growth of steps: E. Hairer and G. Wanner, Solving Ordinary
Differential Equations II, Springer, 1996, section V.3. The others are confirmed here from both sides.
"""

import math
from fractions import Fraction

import diffrax
import jax
import numpy as np
import pytest

from jaxmb.solvers import Adams
from jaxmb.solvers._formulas import FAMILIES, formulas
from jaxmb.solvers.stability import (
    Formula,
    boundary_locus,
    characteristic_roots,
    formula,
    is_zero_stable,
    largest_growth,
    plot_regions,
    spectral_radius,
    stability_angle,
    stiff_abscissa,
)

# Of two points: a, b, c, the order and the error constant.
PUBLISHED = {
    "E": ("1 -1 0", "29/48 5/12 -1/48", "-1/8 0 0", 4, "7/1440"),
    "B": ("1 -8/7 1/7", "6/7 0 0", "-2/7 0 0", 3, "1/21"),
    "H": ("1 -1 0", "101/240 8/15 11/240", "-13/240 1/6 1/80", 6, "1/9450"),
    "Y": ("1 -16/23 -7/23", "12/23 16/23 2/23", "-2/23 0 0", 5, "1/1035"),
}
# Of some numbers of points.
ANGLES = {
    "E": {1: 90, 3: 87.883, 7: 37.608},
    "B": {3: 90, 4: 89.363, 10: 12.341},
    "H": {1: 90},
    "Y": {1: 90, 2: 82.767, 3: 46.825},
}
ABSCISSAS = {1: 0, 2: 0, 3: 0.1034, 4: 0.5262}
GROWTHS = {2: 3.847, 3: 2.148, 5: 1.325}


def test_formulas_have_the_published_coefficients():
    """And as many points and terms as give them their orders, by which they are known."""
    rationals = lambda text: tuple(map(Fraction, text.split()))
    for family, (a, b, c, order, C) in PUBLISHED.items():
        assert formula(family, 2) == (f"{family}2", *map(rationals, (a, b, c)), order, Fraction(C))
    for k in range(1, 8):
        E, B, H, Y = (formula(family, k) for family in "EBHY")
        assert [each.order for each in (E, B, H, Y)] == [k + 2, k + 1, 2 * k + 2, 2 * k + 1]
        assert all(len(row) == k + 1 for each in (E, B, H, Y) for row in (each.a, each.b, each.c))
        for each in (E, H):
            assert each.a == (1, -1, *[0] * (k - 1))
        assert all(x == 0 for row in (E.c, B.b, B.c, Y.c) for x in row[1:])
        assert B.a[0] == Y.a[0] == 1
    assert formula("E", 1)[1:] == formula("Y", 1)[1:]


def test_formulas_have_their_orders_and_error_constants():
    """On `y = exp(s)` and steps of h the two sides differ by `C h^(p+1)`, to first order."""

    def relative(each, h):
        # The series of the difference, exactly, up to far beyond the order.
        y = lambda j: sum((-j * h) ** n / math.factorial(n) for n in range(each.order + 20))
        terms = zip(each.a, each.b, each.c, strict=True)
        return sum((a - h * b - h**2 * c) * y(j) for j, (a, b, c) in enumerate(terms)) / h ** (each.order + 1)

    for each in [formula(f, k) for f in FAMILIES for k in range(1, 8)] + [formula("Adams", k) for k in range(1, 13)]:
        errors = [abs(relative(each, Fraction(1, n)) / each.error_constant - 1) for n in (2000, 4000)]
        assert errors[0] < 0.02, each.name
        assert 0.45 < errors[1] / errors[0] < 0.55, each.name


@pytest.mark.parametrize("family", FAMILIES)
def test_formulas_of_the_solver_are_the_rational_ones_on_equal_steps(family):
    properties, h = FAMILIES[family], 0.25
    multiplicity = properties.multiplicity
    mesh = np.repeat(-h * np.arange(properties.length), multiplicity)[: properties.length]
    run = jax.tree.map(np.asarray, jax.jit(lambda mesh, h: formulas(properties, mesh, h, mesh.dtype))(mesh, h))
    # What the differences are multiplied by, as weights of the values z and of their slopes: Newton's basis at the
    # points takes differences to values.
    spans = mesh[0] - mesh[1:]
    spans = np.where(spans > 0, spans, h)
    for k in range(1, properties.highest + 1):
        exact, m = formula(family, k), k * multiplicity
        np.testing.assert_allclose(run.slope[m], float(exact.b[0]), rtol=1e-13)
        np.testing.assert_allclose(run.curvature[m], float(exact.c[0]), rtol=1e-13)
        basis = [np.poly1d(mesh[:i], r=True) / np.prod(spans[:i]) for i in range(m)]
        rows = [[p(t) for p in basis] for t in mesh[:m:multiplicity]]
        if multiplicity == 2:
            rows += [[h * p.deriv()(t) for p in basis] for t in mesh[:m:multiplicity]]
        weights = np.linalg.solve(np.transpose(rows), run.past[m, :m])
        values, slopes = (exact.b, exact.c) if properties.integrated else (-np.array(exact.a), exact.b)
        np.testing.assert_allclose(weights[:k], np.array(values[1:], float), rtol=0, atol=1e-13)
        np.testing.assert_allclose(weights[k:], np.array(slopes[1:], float)[: m - k], rtol=0, atol=1e-13)


def test_stability_angle():
    for family, angles in ANGLES.items():
        for k, angle in angles.items():
            assert abs(stability_angle(formula(family, k)) - angle) < 0.001, (family, k)
    for family, k in (("E", 8), ("H", 2), ("Y", 4), ("Adams", 4)):
        assert stability_angle(formula(family, k)) == 0
    # Beside the ray at the angle there is a point of instability on one side only.
    sizes, each = np.logspace(-2, 3, 20001), formula("Y", 3)
    ray = lambda degrees: np.max(spectral_radius(each, -sizes * np.exp(1j * np.radians(degrees))))
    assert ray(stability_angle(each) - 0.02) < 1 < ray(stability_angle(each) + 0.02)


def test_stiff_abscissa():
    for k, expected in ABSCISSAS.items():
        assert abs(stiff_abscissa(formula("E", k)) - expected) < 1e-4
    line = lambda x: np.max(spectral_radius(formula("E", 4), x + 1j * np.linspace(0, 20, 20001)))
    assert line(-ABSCISSAS[4] - 0.002) < 1 < line(-ABSCISSAS[4] + 0.002)
    assert stiff_abscissa(formula("H", 1)) == 0
    assert stiff_abscissa(formula("H", 2)) == stiff_abscissa(formula("Adams", 4)) == math.inf


def test_damping_at_infinity():
    for family in ("E", "B", "Y"):
        assert all(spectral_radius(formula(family, k), -math.inf) == 0 for k in range(1, 8))
    assert spectral_radius(formula("H", 1), -math.inf) == 1
    # 13 ζ² - 40 ζ - 3 = 0
    np.testing.assert_allclose(spectral_radius(formula("H", 2), -math.inf), (20 + math.sqrt(439)) / 13, rtol=1e-14)
    assert spectral_radius(formula("Adams", 3), -math.inf) == math.inf


def test_characteristic_roots():
    """Those of one step are Padé approximations, or Heun's method; where a coefficient is zero, one is at infinity."""
    mu = np.array([-1.0, 0.3 + 2.0j, -1e3])
    E1 = (1 + mu / 3) / (1 - 2 * mu / 3 + mu**2 / 6)
    H1 = (1 + mu / 2 + mu**2 / 12) / (1 - mu / 2 + mu**2 / 12)
    for each, expected in ((formula("E", 1), E1), (formula("H", 1), H1), (formula("Adams", 1), 1 + mu + mu**2 / 2)):
        np.testing.assert_allclose(characteristic_roots(each, mu)[:, 0], expected, rtol=1e-14)
    each, mu = formula("E", 3), np.array([[-1.0, 2.0j, -1.0 + 1.0j]])
    roots = characteristic_roots(each, mu)
    assert roots.shape == (1, 3, 3)
    np.testing.assert_array_equal(spectral_radius(each, mu), np.max(np.abs(roots), axis=-1))
    assert spectral_radius(each, np.roots([-float(each.c[0]), -float(each.b[0]), 1.0])[0]) > 1e12


def test_boundary_locus():
    theta = np.linspace(0.1, 3, 7)
    for each in (formula("E", 4), formula("B", 6), formula("H", 2), formula("Adams", 5)):
        mu = boundary_locus(each, theta)
        assert mu.shape == (2, 7)
        roots = characteristic_roots(each, mu)
        np.testing.assert_allclose(np.min(np.abs(roots - np.exp(1j * theta)[:, None]), axis=-1), 0, atol=1e-10)
        assert np.all(np.abs(mu[0]) <= np.abs(mu[1])) and np.all(mu[0] != mu[1])
    np.testing.assert_array_equal(boundary_locus(formula("H", 1), 0.0), [0, np.inf])


def test_zero_stability():
    """A double root on the circle is not stable, as Störmer's; two simple ones are, as those of Y with four points."""
    for family, points in (("E", 8), ("H", 8), ("B", 10), ("Y", 4), ("Adams", 13)):
        assert all(is_zero_stable(formula(family, k)) for k in range(1, points + 1, 3)), family
    assert not is_zero_stable(formula("B", 11)) and not is_zero_stable(formula("Y", 5))
    one, zero = Fraction(1), Fraction(0)
    assert is_zero_stable(Formula("midpoint", (one, zero, -one), (zero, 2 * one, zero), (zero,) * 3, 2, one / 3))
    assert not is_zero_stable(Formula("Störmer", (one, -2 * one, one), (zero,) * 3, (one, zero, zero), 1, one))


def test_largest_growth_of_steps():
    """Of B against the roots at μ = 0 besides one, from the second derivatives of the Lagrange polynomials."""

    def growth(k, ratio):
        s = -np.cumsum(ratio ** -np.arange(float(k)))
        weights = [1 / x**2 * np.prod([y / (y - x) for y in s if y != x]) for x in s]
        quotient, _ = np.polydiv([-sum(weights), *weights], [1.0, -1.0])
        return np.max(np.abs(np.roots(quotient)))

    for k, expected in GROWTHS.items():
        limit = largest_growth("B", k)
        assert abs(limit - expected) < 0.001
        assert growth(k, limit - 0.001) < 1 < growth(k, limit + 0.001)
    np.testing.assert_allclose([largest_growth("Y", 2), largest_growth("Y", 3)], [1.5, 1.0629], rtol=0, atol=1e-4)
    for family in ("E", "H"):
        assert all(largest_growth(family, k) == math.inf for k in range(1, 5))
    assert largest_growth("B", 1) == largest_growth("Y", 1) == math.inf


@pytest.mark.slow
def test_largest_growth_is_below_one_where_equal_steps_are_unstable():
    assert 0.98 < largest_growth("B", 11) < 1


def _growth_of_pece(k, mu, steps):
    """The mean growth in a step of the second half of a simulation of `y' = mu y`, with quadrature of polynomials."""
    x, w = np.polynomial.legendre.leggauss(k + 1)
    x, w = (x - 1) / 2, w / 2

    def weights(nodes):
        lagrange = lambda own: np.prod([np.ones_like(x), *((x - t) / (own - t) for t in nodes if t != own)], axis=0)
        return np.array([lagrange(own) @ w for own in nodes])

    predictor, corrector = weights([-float(j) for j in range(1, k + 1)]), weights([-float(j) for j in range(k + 1)])
    y, f = 1.0, mu * np.random.default_rng(k).normal(size=k)
    logarithm = 0.0
    for step in range(steps):
        prediction = y + predictor @ f
        y = y + corrector[0] * mu * prediction + corrector[1:] @ f
        f = np.append(mu * y, f[:-1])
        scale = np.linalg.norm(f)
        y, f = y / scale, f / scale
        logarithm += np.log(scale) if step >= steps // 2 else 0.0
    return np.exp(logarithm / (steps - steps // 2))


@pytest.mark.parametrize("k", [1, 4, 12])
def test_adams_grows_as_a_simulation(k):
    each = formula("Adams", k)
    assert each.order == k + 1
    # The first point of instability on the negative real axis.
    low, high = 0.0, next(x for x in np.linspace(0.01, 3, 300) if spectral_radius(each, -x) > 1)
    while high - low > 1e-6:
        middle = (low + high) / 2
        low, high = (low, middle) if spectral_radius(each, -middle) > 1 else (middle, high)
    assert _growth_of_pece(k, -0.97 * low, 2000) < 1 < _growth_of_pece(k, -1.03 * low, 2000)
    for mu in (-1.4 * low, low * (-0.3 + 0.4j), low * (0.2 + 1.1j)):
        np.testing.assert_allclose(_growth_of_pece(k, mu, 2000), spectral_radius(each, mu), rtol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("k", [1, 4, 9, 12])
def test_adams_steps_by_the_recurrence(k):
    """The states of the solver itself, at fixed order and step."""
    each, mu, steps = formula("Adams", k), np.array([-2.1, -1.4, -0.3, 0.2, 1.5]), 25
    ys = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: mu * y),
        Adams(min_order=k, max_order=k, rtol=1e-3, atol=1e-3),
        0.0,
        float(steps),
        1.0,
        np.ones(5),
        stepsize_controller=diffrax.ConstantStepSize(),
        saveat=diffrax.SaveAt(steps=True),
        max_steps=steps,
        adjoint=diffrax.ForwardMode(),
    ).ys
    a, b, c = (np.array(row, float)[:, None] for row in (each.a, each.b, each.c))
    newest_first = np.asarray(ys)[::-1][: k + 1]
    residual = np.sum((a - mu * b - mu**2 * c) * newest_first, axis=0)
    np.testing.assert_allclose(residual / np.max(np.abs(newest_first), axis=0), 0, atol=1e-11)


def test_refused():
    for function in (formula, largest_growth):
        for family, k, message in (("Q", 2, "family='Q'"), ("E", 0, "k=0")):
            with pytest.raises(ValueError, match=message):
                function(family, k)
    with pytest.raises(ValueError, match="k=0"):
        formula("Adams", 0)


def test_plot_of_regions():
    from matplotlib.figure import Figure

    (axes,) = plot_regions([formula("H", 1), formula("Adams", 2)]).axes
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["H1", "Adams 2"]
    # Left of the imaginary axis the boundary of E4 is as far away as its abscissa says.
    axes = Figure().add_subplot()
    assert plot_regions([formula("E", 4)], axes) is axes.figure
    (boundary,) = (c for c in axes.collections if len(c.get_facecolor()) == 0)
    leftmost = min(path.vertices[:, 0].min() for path in boundary.get_paths() if len(path.vertices))
    assert abs(leftmost + ABSCISSAS[4]) < 0.05
