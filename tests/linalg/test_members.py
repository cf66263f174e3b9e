"""Members of a batch in blocks are those of one batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb.linalg import members
from jaxmb.linalg.members import in_blocks, vmap_states


def test_blocks_are_filled_up_and_cut_off():
    sizes = []

    def square(own):
        sizes.append(own["x"].shape[0])
        return own["x"] ** 2, own["y"].sum(axis=1)

    given = [{"x": np.arange(1.0, count + 1), "y": np.ones((count, 2))} for count in (1, 4, 5, 9, 16)]
    found = jax.jit(lambda given: [in_blocks(square, jax.tree.map(jnp.asarray, own), 4) for own in given])(given)
    for (squares, sums), own in zip(found, given, strict=True):
        np.testing.assert_array_equal(squares, own["x"] ** 2)
        np.testing.assert_array_equal(sums, np.full(len(own["x"]), 2.0))
    assert max(sizes) <= 4


def test_states_of_large_matrices_are_computed_in_blocks(monkeypatch):
    function, (ts, ys) = lambda t, y: jnp.sin(t) * y, (np.linspace(0.0, 1.0, 20), np.ones((20, 3)))
    loops = lambda numbers: str(jax.make_jaxpr(vmap_states(function, numbers))(ts, ys)).count("scan")
    assert loops(9) == 0 and loops(100_000) == 1
    monkeypatch.setattr(members.jax, "default_backend", lambda: "gpu")
    assert loops(100_000) == 0


@pytest.mark.slow
def test_saved_states_and_their_derivatives_do_not_depend_on_blocks(monkeypatch):
    mechanism = mb.mechanisms.get("four_bar")
    system, state = mechanism.system, mechanism.state
    key = next(key for key in mb.parameters(system) if key.endswith(".mass"))
    times = np.linspace(0.0, 0.1, 19)

    def sizes(mass):
        motion = mb.simulate(mb.with_parameters(system, {key: mass}), state, t1=0.1, saveat=times)
        return jnp.stack([jnp.sum(motion.ys.q**2), jnp.sum(motion.multipliers**2)]), motion.ys

    mass = mb.parameters(system)[key]
    both = lambda x: (sizes(x), jax.jacrev(lambda x: sizes(x)[0])(x))
    together = jax.jit(both)(mass)
    monkeypatch.setattr(members, "_CACHE", 1)
    apart = jax.jit(lambda x: both(x))(mass)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12), together, apart)
