"""Shapes of a uniform bar that is clamped at its first end, along the station ξ from 0 to 1.

Curvatures of bending, and strains of stretch and torsion, are Legendre's polynomials, so that the stiffness is
diagonal. The first two shapes of bending, and the first of stretch and torsion, bear all loads at the second end
exactly; the others vanish there. The second shape of bending has the slope zero there.
"""

import functools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial import Legendre

from ..linalg.arrays import namespace

_DOMAIN = (0.0, 1.0)


class BarShapes(NamedTuple):
    """Values at stations, shape (s, modes): of `bend`, its `slope` and `curvature`; of `stretch` and its `strain`; of
    `twist`; and (s, modes, modes) of the `shortening`, the integral of the products of slopes from the first end.
    """

    bend: Any
    slope: Any
    curvature: Any
    stretch: Any
    strain: Any
    twist: Any
    shortening: Any


class BarTables(NamedTuple):
    """Coefficients of all shapes by Legendre's polynomials, columns one after the other; stations and weights of a
    quadrature that is exact for products of displacements, with the shapes there; and the stiffnesses of bending,
    stretch and torsion, of a bar whose rigidities and length are one.
    """

    counts: tuple[int, int, int]
    coefficients: Float[np.ndarray, "p columns"]
    stations: Float[np.ndarray, "s"]
    weights: Float[np.ndarray, "s"]
    shapes: BarShapes
    stiffness: tuple[Float[np.ndarray, "k"], ...]


@functools.cache
def bar_tables(bending: int, stretch: int, twist: int) -> BarTables:
    """The shapes for numbers of modes."""
    curvatures, bend = _integrated(bending, twice=True)
    strains, along = _integrated(max(stretch, twist), twice=False)
    slopes = [shape.deriv() for shape in bend]
    shortening = [(a * b).integ(lbnd=0.0) for a in slopes for b in slopes]
    columns = [*bend, *slopes, *curvatures, *along[:stretch], *strains[:stretch], *along[:twist], *shortening]
    coefficients = np.zeros((max(len(column.coef) for column in columns), len(columns)))
    for k, column in enumerate(columns):
        coefficients[: len(column.coef), k] = column.coef
    counts = bending, stretch, twist
    # Exact to the square of the shortening.
    nodes, weights = np.polynomial.legendre.leggauss(max(2 * bending + 2, stretch + 1, twist + 1))
    stations, weights = 0.5 + 0.5 * nodes, 0.5 * weights
    shapes = _shapes(counts, coefficients, stations)
    stiffness = tuple(weights @ x**2 for x in (shapes.curvature, shapes.strain))
    twisting = np.array([(strain**2).integ(lbnd=0.0)(1.0) for strain in strains[:twist]])
    return BarTables(counts, coefficients, stations, weights, shapes, (*stiffness, twisting))


def shapes_at(tables: BarTables, stations: Float[Array | np.ndarray, "s"]) -> BarShapes:
    """The values at stations."""
    return _shapes(tables.counts, tables.coefficients, stations)


def _integrated(count, twice):
    """Legendre's polynomials and their integrals that vanish at zero, whose largest value is one."""
    grid, polynomials, integrals = np.linspace(0.0, 1.0, 1001), [], []
    for k in range(count):
        polynomial = Legendre.basis(k, domain=_DOMAIN)
        integral = polynomial.integ(2 if twice else 1, lbnd=0.0)
        values = integral(grid)
        largest = values[np.argmax(np.abs(values))]
        polynomials.append(polynomial / largest)
        integrals.append(integral / largest)
    return polynomials, integrals


def _shapes(counts, coefficients, stations):
    xp, x = namespace(stations), 2 * stations - 1
    polynomials = [xp.ones_like(x), x]
    for n in range(1, len(coefficients) - 1):
        polynomials.append(((2 * n + 1) * x * polynomials[-1] - n * polynomials[-2]) / (n + 1))
    values = xp.stack(polynomials[: len(coefficients)], axis=-1) @ coefficients.astype(x.dtype)
    bend, stretch, twist = counts
    ends = np.cumsum([bend, bend, bend, stretch, stretch, twist])
    parts = xp.split(values, ends, axis=-1)
    return BarShapes(*parts[:-1], shortening=parts[-1].reshape(*parts[-1].shape[:-1], bend, bend))
