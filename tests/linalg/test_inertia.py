"""Mass matrices by their structure, and their roots."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

import jaxmb as mb
from jaxmb.linalg.inertia import BlockInertia, DenseInertia, DiagonalInertia


def test_inertias_and_their_roots_are_those_of_full_matrices():
    """`M`, its inverse, `L Lᵀ` by products and by solves, and derivatives of what no choice of root can change."""
    rng = np.random.default_rng(4)
    half = rng.normal(size=(2, 3, 3))
    rotary = half @ half.swapaxes(1, 2) + 10 * np.eye(3)
    point = mb.spatial.PointMass("p", mass=2.0)
    body = mb.spatial.Body("b", mass=3.0, inertia=rotary[0], position=(1.0, 0.0, 0.0))
    mixed = mb.Scene([point, body]).compile()
    three = np.eye(3)
    cases = [
        (DiagonalInertia(np.array([1.0, 4.0, 0.3])), np.diag([1.0, 4.0, 0.3])),
        (BlockInertia(np.array([2.0, 3.0]), rotary), block_diag(2 * three, rotary[0], 3 * three, rotary[1])),
        (None, block_diag(2 * three, 3 * three, rotary[0])),
        (DenseInertia(rotary[0]), rotary[0]),
    ]
    forces = [rng.normal(size=(len(matrix), 2)) for _, matrix in cases]

    def compare(inertias, forces):
        for inertia, f, (_, matrix) in zip(inertias, forces, cases, strict=True):
            inertia = mixed.inertia(0.0, *jax.tree.leaves(mixed.guess)) if inertia is None else inertia
            solved = np.linalg.inv(matrix)
            root = inertia.root()
            back = root.transpose()
            for v in (f, f[:, 0]):
                yield inertia.product(v), matrix @ v
                yield inertia.solve(v), solved @ v
            yield root.product(back.product(f)), matrix @ f
            yield back.solve(root.solve(f)), solved @ f
            yield root.solve(root.product(f)), f
            framed = jax.grad(lambda inertia, f=f: jnp.sum(inertia.root().solve(f) ** 2))(inertia)
            plain = jax.grad(lambda inertia, f=f: jnp.vdot(f, inertia.solve(f)))(inertia)
            # A matrix that stays symmetric knows only the symmetric part of its gradient.
            symmetric = lambda x: x if x.ndim < 2 else x + x.swapaxes(-1, -2)
            yield from zip(*(map(symmetric, jax.tree.leaves(x)) for x in (framed, plain)), strict=True)

    inertias = jax.tree.map(jnp.asarray, [inertia for inertia, _ in cases])
    for found, expected in jax.jit(lambda *given: list(compare(*given)))(inertias, forces):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
