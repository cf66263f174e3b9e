"""Trees, cables and nets of any size: against equations of their own, and what they keep."""

import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from oracles import large

import jaxmb as mb
from jaxmb.mechanisms.observe import point_motion

TIMES = np.array([0.2, 0.4, 0.6, 0.8])


def tree(*, n):
    """The values of an oracle, how to observe the same in a motion, and the drift of the oracle."""
    labels = ["tip_x", "tip_y", *(f"{what}{k}" for what in ("th", "w") for k in range(1, n + 1))]
    return large.tree(TIMES, n=n), lambda found, sol: [found[label] for label in labels], 0.0


def cable(*, n):
    ends, drift = large.cable(TIMES, n=n)
    start = np.zeros((len(TIMES), 1, 3))
    joints = np.concatenate([start, ends], axis=1)
    middle = (joints[:, n // 2] + joints[:, (n + 1) // 2]) / 2

    def observe(found, sol):
        own = [point_motion(sol, f"rod{k}", (0.5 / n, 0.0, 0.0))[0] for k in range(1, n + 1)]
        return [*(found[label] for label in "xyz"), *np.concatenate(own, axis=1).T]

    return np.concatenate([middle, ends.reshape(len(TIMES), -1)], axis=1), observe, drift


def net(*, n, m):
    places, drift = large.net(TIMES, n=n, m=m)

    def observe(found, sol):
        knots = [sol[f"knot{i}_{j}"].position for i in range(1, n + 1) for j in range(1, m + 1)]
        return [*(found[label] for label in "xyz"), *np.concatenate(knots, axis=1).T]

    return np.concatenate([places[:, -1, -1], places.reshape(len(TIMES), -1)], axis=1), observe, drift


@pytest.mark.slow
@pytest.mark.parametrize(
    "case, size, free",
    [
        (net, {"n": 3, "m": 3}, 13),
        # Of 30 rows and more, by sparse elimination.
        (tree, {"n": 20}, 20),
        (cable, {"n": 12}, 33),
    ],
)
def test_motion_is_that_of_other_equations(case, size, free):
    expected, observe, drift = case(**size)
    assert drift <= 1e-12
    mechanism = mb.mechanisms.get(case.__name__, **size)
    system, state = mechanism.system, mechanism.state
    assert system.velocity_rank == system.velocity_rows == system.nu - free
    sol = mb.simulate(system, state, t1=TIMES[-1], rtol=1e-9, saveat=TIMES)
    found = np.stack(observe(mechanism.observe(sol), sol), axis=1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)
    start = system.potential_energy(0.0, state.q)
    released = np.max(np.abs(sol.potential_energy - start))
    np.testing.assert_allclose(sol.energy, start, rtol=0, atol=1e-9 * released)
    assert np.all(sol.constraint_violation.position <= 1e-12)
    assert np.all(sol.constraint_violation.velocity <= 1e-12)


@pytest.mark.slow
def test_tree_has_no_dense_matrix_and_programs_of_one_size():
    """The largest array of any program grows with the number of bodies, and its number of lines hardly at all: the
    elimination has at most three loops.
    """
    lines = []
    for n in (150, 600):
        mechanism = mb.mechanisms.get("tree", n=n)
        system, state = mechanism.system, mechanism.state
        programs = (
            jax.jit(lambda y, system=system: mb.assemble(system, y, throw=False)).lower(state),
            jax.jit(lambda y, system=system: mb.simulate(system, y, t1=0.1).ys).lower(state),
        )
        texts = [program.as_text() for program in programs]
        sizes = {shape for text in texts for shape in re.findall(r"tensor<((?:\d+x)+)f64>", text)}
        assert max(math.prod(map(int, shape[:-1].split("x"))) for shape in sizes) < 200 * n
        lines.append([text.count("\n") for text in texts])
    # By 1.20, 1.19 and 1.13 when this was measured: the smaller tree needs fewer of the loops.
    assert np.all(np.array(lines[1]) <= 1.25 * np.array(lines[0]))


@pytest.mark.slow
def test_n_four_bar_of_many_is_assembled():
    """One crank determines all angles, which makes the last pivot of the elimination as small as 1 / n³."""
    system = mb.mechanisms.get("n_four_bar", n=150).system
    assert system.velocity_rank == system.velocity_rows == system.nu - 1
    state = mb.assemble(system, fix={"upright0.angle": 1.3})
    angles = np.asarray(state.q).reshape(-1, 3)[:151, 2]
    np.testing.assert_allclose(angles, 1.3, rtol=0, atol=1e-9)
    # All uprights turn as the first one does.
    own = jax.jit(lambda angle: mb.assemble(system, fix={"upright0.angle": angle}, throw=False).q[2::3][:151])
    forward = jax.jit(lambda angle: jax.jvp(own, (angle,), (1.0,)))(1.3)[1]
    np.testing.assert_allclose(forward, 1.0, rtol=0, atol=1e-8)
    reverse = jax.jit(jax.grad(lambda angle: np.cos(np.arange(151)) @ own(angle)))(1.3)
    np.testing.assert_allclose(reverse, np.cos(np.arange(151)) @ forward, rtol=1e-9)
    with pytest.raises(ValueError, match=r"upright0\.angle and upright70\.angle depend on each other"):
        mb.assemble(system, fix={"upright0.angle": 1.3, "upright70.angle": 1.3})


@pytest.mark.slow
def test_rod_chain_derivatives_of_states_between_steps():
    """Interpolated states are projected on the constraints by sparse elimination: forward mode, reverse mode and
    differences, under `jit` and `vmap`.
    """
    mechanism = mb.mechanisms.get("rod_chain", n=20)
    system, times = mechanism.system, jnp.array([0.0513, 0.1177])
    assert system.elimination is not None
    mass = mb.parameters(system)["link4.mass"]

    def saved(share, rtol):
        own = mb.with_parameters(system, {"link4.mass": mass * (1.0 + share)})
        y = mb.simulate(own, mechanism.state, t1=0.15, saveat=times, rtol=rtol).ys
        return jnp.cos(jnp.arange(float(system.nq))) @ y.q[0] + jnp.sin(jnp.arange(float(system.nu))) @ y.u[1]

    along = lambda s, rtol: jax.jvp(lambda s: saved(s, rtol), (s,), (1.0,))
    forward = jit_quickly(jax.vmap(along, (0, None)))
    reverse = jit_quickly(jax.vmap(jax.grad(lambda s: saved(s, 1e-9))))(jnp.zeros(2))
    h = 2e-3
    found = forward(jnp.zeros(4), 1e-9)[1][0]
    value = np.asarray(forward(h * jnp.array([-2.0, -1.0, 1.0, 2.0]), 1e-12)[0])
    difference = (8 * (value[2] - value[1]) - (value[3] - value[0])) / (12 * h)
    np.testing.assert_allclose(reverse, found, rtol=1e-9)
    np.testing.assert_allclose(found, difference, rtol=1e-7)
