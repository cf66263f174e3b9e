"""Motions of several members side by side."""

import subprocess
import sys

import batched_machines
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb
from jaxmb.lanes import members, sizes, together

MASSES = jnp.linspace(0.9, 1.1, 3)


def four_bar(**options):
    found = jaxmb.mechanisms.get("four_bar")
    start = jaxmb.parameters(found.system)["coupler.mass"]

    def end(share):
        changed = jaxmb.with_parameters(found.system, {"coupler.mass": start * share})
        motion = jaxmb.simulate(changed, found.state, **options)
        return motion.ys.q[-1], motion.stats["num_steps"]

    return end


def side_by_side(function, *members):
    like = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in members]
    return together(jax.make_jaxpr(jax.jit(function))(*like))(*members)


def carried_shapes(program):
    """The shapes of arrays that the loop over steps carries, which carries more than other loops."""
    for equation in getattr(program, "jaxpr", program).eqns:
        if equation.primitive.name == "while" and len(equation.outvars) > 10:
            yield from (variable.aval.shape for variable in equation.outvars)
        for inner in sizes.inner_programs(equation):
            yield from carried_shapes(inner)


@pytest.mark.slow(but=("powers",))
@pytest.mark.parametrize("name", batched_machines.MACHINES)
def test_members_of_batches_move_as_each_alone(name, monkeypatch):
    """By `mb.batch` and by `vmap`, in blocks that fill the registers."""
    monkeypatch.setattr(members, "computes_side_by_side", lambda: True)
    found, traced = batched_machines.differences(name)
    assert max(found.values()) < 1e-8
    # Eleven members are two blocks of six. A loop with the tables of dense output is too large to stand side by side.
    shapes = set(carried_shapes(traced.jaxpr))
    if name != "dense":
        assert any(shape[-1:] == (6,) for shape in shapes) and not any(shape[:1] == (11,) for shape in shapes)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["quickly", "for speed", "for batches", None])
def test_batches_with_all_ways_to_compile(way, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    command = [sys.executable, batched_machines.__file__, "powers", *([way] if way else [])]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
def test_members_and_their_derivatives_are_those_of_each_alone():
    """Of a member that fails, nothing is known, and of the others all."""
    end, exact = four_bar(t1=0.3, rtol=1e-9), four_bar(t1=0.3, rtol=1e-12)
    slope = jax.value_and_grad(lambda mass: (jnp.sum((out := end(mass))[0]), out), has_aux=True)
    masses = jnp.array([*MASSES, jnp.nan])
    found = jax.jit(lambda masses: side_by_side(slope, masses))(masses)
    alone = [jax.tree.leaves(jax.jit(slope)(mass)) for mass in MASSES]
    value, q, steps, derivative = (np.asarray(x) for x in found)
    expected = [np.stack(x) for x in zip(*alone, strict=True)]
    np.testing.assert_allclose(value[:3], expected[0], rtol=1e-7)
    np.testing.assert_allclose(q[:3], expected[1], rtol=1e-8, atol=1e-8)
    assert np.all(np.abs(steps[:3] - expected[2]) <= 2)
    np.testing.assert_allclose(derivative[:3], expected[3], rtol=1e-7)
    assert np.all(np.isnan(q[3]))
    total = jax.jit(lambda mass: jnp.sum(exact(mass)[0]))
    differences = [(total(mass + 1e-4) - total(mass - 1e-4)) / 2e-4 for mass in MASSES]
    np.testing.assert_allclose(derivative[:3], differences, rtol=1e-6)


@pytest.mark.slow
def test_a_vmap_within_a_vmap_and_its_derivatives(monkeypatch):
    end = four_bar(t1=0.1, rtol=3e-9)
    masses = jnp.linspace(0.9, 1.1, 6).reshape(2, 3)
    every = jax.vmap(jax.vmap(lambda mass: end(mass)[0]))
    total = lambda masses: jnp.sum(every(masses) ** 2)
    expected = jax.jit(every)(masses), jax.jit(jax.grad(total))(masses)
    monkeypatch.setattr(members, "computes_side_by_side", lambda: True)
    jax.clear_caches()
    found = jax.jit(lambda masses: every(masses))(masses), jax.jit(jax.grad(lambda masses: total(masses)))(masses)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9), found, expected)


@pytest.mark.slow
def test_derivatives_are_those_of_vmap():
    end = four_bar(t1=0.1, rtol=1e-9)

    def total(scale, masses, at_once):
        alone = lambda mass: end(scale * mass)[0]
        found = side_by_side(alone, masses)[0] if at_once else jax.vmap(alone)(masses)
        return jnp.sum(found**2)

    for derivative in (jax.grad, jax.jacfwd):
        slope = jax.jit(derivative(total, (0, 1)), static_argnums=2)
        both = [slope(1.0, MASSES, at_once) for at_once in (True, False)]
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9), *both)
