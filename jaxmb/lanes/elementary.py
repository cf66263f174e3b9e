"""Sine, cosine and powers by operations that the compiler vectorises, in double precision.

The library's functions compute one number at a time.
"""

import math
from fractions import Fraction
from typing import Any

import jax.numpy as jnp
from jax import lax

# Angles beyond this, in which multiples of π/2 are no longer exact, are left to the library.
_LARGEST_ANGLE = 1e5
_HALF_PI = Fraction("1.57079632679489661923132169163975144209858469968755291048747")


def _in_parts(number: Fraction, bits: tuple[int, ...]) -> tuple[float, ...]:
    """A number as a sum of parts with these numbers of bits behind the binary point, and the rest."""
    parts = []
    for count in bits:
        part = Fraction(round(number * 2**count), 2**count)
        parts.append(float(part))
        number -= part
    return (*parts, float(number))


# Multiples of the first two parts by integers below 2²⁰ are exact.
_PARTS = _in_parts(_HALF_PI, (32, 65))
# Powers of e beyond this exponent, to either side, are left to the library: the error grows with the exponent.
_LARGEST_EXPONENT = 32.0
_LOG_2 = (0.693147180369123816490, 1.90821492927058770002e-10)


def sin(x: Any) -> Any:
    return _where_small(x, lambda x: _sin_cos(x)[0], lax.sin)


def cos(x: Any) -> Any:
    return _where_small(x, lambda x: _sin_cos(x)[1], lax.cos)


def _where_small(x, of_small, of_any):
    return lax.cond(jnp.all(jnp.abs(x) < _LARGEST_ANGLE), of_small, of_any, x)


def _sin_cos(x):
    """By Taylor's series of the distance from the nearest multiple of π/2, to three units in the last place."""
    quarter = lax.round(x * float(1 / _HALF_PI), lax.RoundingMethod.TO_NEAREST_EVEN)
    rest = x
    for part in _PARTS:
        rest = rest - quarter * part
    square = rest * rest
    coefficient = lambda k: (-1) ** (k // 2) / math.factorial(k)
    sine = rest + (rest * square) * _polynomial(square, [coefficient(k) for k in range(3, 17, 2)])
    cosine = 1 + square * _polynomial(square, [coefficient(k) for k in range(2, 18, 2)])
    turn = quarter - 4 * lax.floor(quarter * 0.25)
    odd = (turn == 1) | (turn == 3)
    sine, cosine = jnp.where(odd, cosine, sine), jnp.where(odd, sine, cosine)
    return jnp.where(turn >= 2, -sine, sine), jnp.where((turn == 1) | (turn == 2), -cosine, cosine)


def power(x: Any, y: Any) -> Any:
    """`x ** y`, with a relative error of 1e-14."""
    normal = (x >= jnp.finfo(x.dtype).tiny) & jnp.isfinite(x)
    exponent = y * _log(jnp.where(normal, x, 1.0))
    plain = jnp.all(normal & (jnp.abs(exponent) < _LARGEST_EXPONENT))
    return lax.cond(plain, lambda x, y, exponent: _exp(exponent), lambda x, y, exponent: lax.pow(x, y), x, y, exponent)


def _log(x):
    """The natural logarithm of normal numbers."""
    bits = lax.bitcast_convert_type(x, jnp.int64)
    exponent = (bits >> 52) - 1023
    mantissa = lax.bitcast_convert_type((bits & ((1 << 52) - 1)) | (1023 << 52), jnp.float64)
    large = mantissa > math.sqrt(2)
    mantissa = jnp.where(large, 0.5 * mantissa, mantissa)
    exponent = jnp.where(large, exponent + 1, exponent).astype(jnp.float64)
    z = (mantissa - 1) / (mantissa + 1)
    return exponent * math.log(2) + 2 * z * _polynomial(z * z, [1 / k for k in range(1, 22, 2)])


def _exp(x):
    """The exponential of numbers for which it is far from overflow."""
    n = lax.round(x / math.log(2), lax.RoundingMethod.TO_NEAREST_EVEN)
    rest = (x - n * _LOG_2[0]) - n * _LOG_2[1]
    scale = lax.bitcast_convert_type((n.astype(jnp.int64) + 1023) << 52, jnp.float64)
    return _polynomial(rest, [1 / math.factorial(k) for k in range(14)]) * scale


def _polynomial(x, coefficients):
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total
