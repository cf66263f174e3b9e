"""Which formulas damp the eigenvalues of a Jacobian, against the roots of their characteristic polynomials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.solvers._damping import are_damped, eigenvalues
from jaxmb.solvers._formulas import FAMILIES
from jaxmb.solvers.stability import formula, spectral_radius


@pytest.mark.slow("E", "B")
@pytest.mark.parametrize("family", FAMILIES)
def test_damped_formulas_are_those_that_do_not_grow(family):
    """And what is not, grows, or is so close to growing that a little longer or shorter step does."""
    points = np.arange(1, FAMILIES[family].highest + 1)
    rng = np.random.default_rng(3)
    mu = 10 ** rng.uniform(-1.5, 3, 400) * -np.exp(1j * np.pi / 2 * (1 - rng.uniform(0, 1, 400) ** 2))
    ones = np.ones(points.size)
    damped = jax.jit(jax.vmap(lambda mu: are_damped(family, points, ones, mu[None])))(mu)
    for k, allowed in zip(points, np.asarray(damped).T, strict=True):
        own = formula(family, int(k))
        around = np.stack([spectral_radius(own, mu * factor) for factor in np.linspace(0.7, 1.4, 15)])
        assert np.all(around[np.argmin(np.abs(np.linspace(0.7, 1.4, 15) - 1)), allowed] < 1.002)
        assert np.all(np.max(around, axis=0)[~allowed] > 1.0005)
        assert np.all(allowed) == (k <= FAMILIES[family].stable)


@pytest.mark.slow
def test_only_growing_motions_are_left_to_grow():
    steps, points = np.ones(3), np.array([2, 4, 7])
    program = jax.jit(lambda spectrum: are_damped("E", points, steps, spectrum))
    damped = lambda *spectrum: np.asarray(program(np.asarray(spectrum, complex)))
    np.testing.assert_array_equal(damped(-1e9 + 0j, -1.0 + 0j, 0j), True)
    np.testing.assert_array_equal(damped(3j, -3j), [True, False, False])
    np.testing.assert_array_equal(damped(3.0 + 1j, 3.0 - 1j), True)
    np.testing.assert_array_equal(damped(1e-9 + 3j, -1e9 + 0j), [True, False, False])
    # Resolved by short steps, or so fast that every formula damps it.
    np.testing.assert_array_equal(damped(0.1j, 1e4j), True)


def test_eigenvalues_of_a_batch():
    matrices = np.random.default_rng(5).normal(size=(4, 3, 3))
    slope = lambda matrix: jax.jvp(lambda x: jnp.abs(eigenvalues(x * matrix)), (2.0,), (1.0,))[1]
    both, slopes = jax.jit(jax.vmap(lambda matrix: (eigenvalues(matrix), slope(matrix))))(matrices)
    for one, expected in zip(both, np.linalg.eigvals(matrices), strict=True):
        np.testing.assert_allclose(np.sort_complex(one), np.sort_complex(expected), rtol=1e-12)
    assert np.all(np.asarray(slopes) == 0)
