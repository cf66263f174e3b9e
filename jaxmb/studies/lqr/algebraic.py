"""Constant gains by the algebraic Riccati equation, and the reason why there are none."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...linalg.jitted import jitted
from ...linalg.riccati import balance, is_stabilising, riccati

# Singular values below this fraction of the largest count as zero; the least decay of a mode, relative to the fastest.
_SINGULAR, _STILL = 1e-8, 1e-7


class Algebraic(NamedTuple):
    """The `gains` K; `cost`: X of the least cost `zᵀ X z` from changes z on; `closed`: A − B K; and whether they are
    `ok`.
    """

    gains: Float[Array, "i k"]
    cost: Float[Array, "k k"]
    closed: Float[Array, "k k"]
    ok: Bool[Array, ""]


@jitted
def algebraic(A: Float[Array, "k k"], B: Float[Array, "k i"], q: Float[Array, "k"], r: Float[Array, "i"]) -> Algebraic:
    """The regulator of `ż = A z + B w` with the weights q of z² and r of w²."""
    G, Q = (B / r[None, :]) @ B.T, jnp.diag(q)
    X = riccati(A, G, Q)
    gains = (B.T @ X) / r[:, None]
    return Algebraic(gains, X, A - B @ gains, is_stabilising(A, G, Q, X))


def reason(A: np.ndarray, B: np.ndarray, q: np.ndarray, states: Sequence[str], inputs: Sequence[str]) -> str:
    """The reason why there is no regulator: a mode that no input reaches, or a persistent mode without cost."""
    d = np.asarray(balance(jnp.asarray(A), jnp.asarray(B @ B.T), jnp.diag(jnp.asarray(q))))
    A, B, C = A * d[None, :] / d[:, None], B / d[:, None], np.diag(np.sqrt(q) * d)
    values = np.linalg.eigvals(A)
    still = _STILL * np.max(np.abs(values), initial=0.0)
    for value in values[np.argsort(-values.real)]:
        shifted = A - value * np.eye(len(A))
        if value.real >= -still and (k := _lost(shifted.T, B.T)) is not None:
            return (
                f"lqr: {', '.join(inputs)} cannot stabilise the mode with the eigenvalue {_shown(value)} 1/s, in which "
                f"{states[k]} takes part most. Add an input that moves it."
            )
        if abs(value.real) <= still and (k := _lost(shifted, C)) is not None:
            return (
                f"lqr: the mode with the eigenvalue {_shown(value)} 1/s, in which {states[k]} takes part most, neither "
                f"decays nor costs anything. Give {states[k]} a weight."
            )
    return (
        "lqr: the Riccati equation has no solution within rounding; the weights may differ by too many powers of ten."
    )


def _lost(shifted, rows):
    """The largest part of a null vector of both matrices; None if there is no null vector."""
    scale = np.linalg.norm(shifted) / max(np.linalg.norm(rows), 1e-300)
    _, sizes, vectors = np.linalg.svd(np.concatenate([shifted, scale * rows]))
    return None if sizes[-1] > _SINGULAR * sizes[0] else int(np.argmax(np.abs(vectors[-1])))


def _shown(value):
    return f"{value.real:.4g}" if abs(value.imag) < 1e-9 * abs(value) or value == 0 else f"{value:.4g}"
