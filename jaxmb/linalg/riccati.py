"""The algebraic Riccati equation `Aᵀ X + X A − X G X + Q = 0` and Lyapunov's equation, with derivatives of any order.

Sources: R. Byers, "Solving the algebraic Riccati equation with the matrix sign function", Linear Algebra and its
Applications 85, 1987; D. L. Kleinman, "On an iterative technique for Riccati equation computations", IEEE Transactions
on Automatic Control 13, 1968.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

# The largest number of iterations for a matrix's sign, steps to balance, and Newton's steps after it.
_ITERATIONS, _BALANCING, _CORRECTIONS = 100, 20, 3
# The least decay of a stable matrix, and the largest residual of a solution, relative to the terms.
_LEAST, _RESIDUAL = 1e-10, 1e-6


def balance(A: Float[Array, "n n"], G: Float[Array, "n n"], Q: Float[Array, "n n"]) -> Float[Array, "n"]:
    """Units of the states in which rows and columns of the Hamiltonian matrix have nearly equal sizes."""

    def step(_, d):
        of_states = jnp.abs(A) * d[None, :] / d[:, None]
        of_states = of_states - jnp.diag(jnp.diag(of_states))
        columns = jnp.sum(of_states, axis=0) + d * (jnp.abs(Q) @ d)
        rows = jnp.sum(of_states, axis=1) + (jnp.abs(G) @ (1 / d)) / d
        both = (columns > 0) & (rows > 0)
        return d * jnp.where(both, jnp.where(both, rows, 1.0) / jnp.where(both, columns, 1.0), 1.0) ** 0.25

    return lax.fori_loop(0, _BALANCING, step, jnp.ones(A.shape[0], A.dtype))


def lyapunov(F: Float[Array, "n n"], C: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The solution X of `Fᵀ X + X F + C = 0`."""
    n = F.shape[0]
    unit = jnp.eye(n, dtype=F.dtype)
    return jnp.linalg.solve(jnp.kron(F.T, unit) + jnp.kron(unit, F.T), -C.reshape(-1)).reshape(n, n)


@jax.custom_jvp
def riccati(A: Float[Array, "n n"], G: Float[Array, "n n"], Q: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The symmetric solution X for which `A − G X` is stable, G and Q being symmetric and G positive semidefinite.

    The sign of the Hamiltonian matrix gives its stable subspace, and Newton's steps remove rounding. Whether there is a
    solution, `is_stabilising` tells.
    """
    n, d = A.shape[0], balance(A, G, Q)
    F, H, C = A * d[None, :] / d[:, None], G / (d[:, None] * d[None, :]), Q * d[:, None] * d[None, :]
    sign = _sign(jnp.block([[F, -H], [-C, -F.T]]))
    unit = jnp.eye(n, dtype=A.dtype)
    left = jnp.concatenate([sign[:n, n:], sign[n:, n:] + unit])
    orthogonal, triangular = jnp.linalg.qr(left)
    right = orthogonal.T @ jnp.concatenate([sign[:n, :n] + unit, sign[n:, :n]])
    X = -jax.scipy.linalg.solve_triangular(triangular, right)

    def correct(_, X):
        X = 0.5 * (X + X.T)
        return lyapunov(F - H @ X, C + X @ H @ X)

    X = lax.fori_loop(0, _CORRECTIONS, correct, X)
    return 0.5 * (X + X.T) / (d[:, None] * d[None, :])


@riccati.defjvp
def _riccati_jvp(primals, tangents):
    (A, G, Q), (dA, dG, dQ) = primals, tangents
    X = riccati(A, G, Q)
    change = dA.T @ X + X @ dA - X @ dG @ X + dQ
    return X, lyapunov(A - G @ X, 0.5 * (change + change.T))


def is_stabilising(
    A: Float[Array, "n n"], G: Float[Array, "n n"], Q: Float[Array, "n n"], X: Float[Array, "n n"]
) -> Bool[Array, ""]:
    """Whether X solves the Riccati equation, and makes `A − G X` stable."""
    A, G, Q, X = lax.stop_gradient((A, G, Q, X))
    d = balance(A, G, Q)
    outer = d[:, None] * d[None, :]
    F, H, C, X = A * d[None, :] / d[:, None], G / outer, Q * outer, X * outer
    closed = F - H @ X
    terms = X @ F, X @ H @ X, C
    size = sum(jnp.linalg.norm(term) for term in terms)
    residual = jnp.linalg.norm(terms[0].T + terms[0] - terms[1] + C)
    rounding = jnp.finfo(A.dtype).eps / jnp.finfo(jnp.float64).eps
    values = jnp.linalg.eigvals(jnp.where(jnp.all(jnp.isfinite(closed)), closed, jnp.zeros_like(closed)))
    decays = jnp.max(values.real) < -_LEAST * jnp.sqrt(rounding) * jnp.max(jnp.abs(values))
    return jnp.all(jnp.isfinite(X)) & decays & (residual <= _RESIDUAL * jnp.sqrt(rounding) * size)


def _sign(Z: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """The sign of a matrix by Newton's iteration, scaled by determinants."""
    m, enough = Z.shape[0], 10 * Z.shape[0] * jnp.finfo(Z.dtype).eps

    def going(carry):
        _, change, count = carry
        return (change > enough) & (count < _ITERATIONS)

    def step(carry):
        Z, change, count = carry
        inverse = jnp.linalg.inv(Z)
        # Near the sign, scaling would only add rounding.
        scale = jnp.where(change > 1e-2, jnp.exp(-jnp.linalg.slogdet(Z)[1] / m), 1.0)
        new = 0.5 * (scale * Z + inverse / scale)
        return new, jnp.linalg.norm(new - Z) / jnp.linalg.norm(new), count + 1

    return lax.while_loop(going, step, (Z, jnp.ones((), Z.dtype), 0))[0]
