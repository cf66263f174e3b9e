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


def machine(make, **options):
    found = make()
    system, state = found.system, jaxmb.assemble(found.system, fix=found.fix, rates=found.rates)
    (name, *_) = [key for key in jaxmb.parameters(system) if key.endswith(".mass")]
    start = jaxmb.parameters(system)[name]

    def end(share):
        motion = jaxmb.simulate(jaxmb.with_parameters(system, {name: start * share}), state, **options)
        return motion.ys.q[-1], motion.stats["num_steps"]

    return end


def side_by_side(function, *members):
    like = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in members]
    return together(jax.make_jaxpr(jax.jit(function))(*like))(*members)


def test_members_end_where_each_alone_does():
    end = machine(jaxmb.mechanisms.four_bar, t1=0.3, rtol=1e-9)
    found, steps = jax.jit(lambda masses: side_by_side(end, masses))(MASSES)
    alone = [jax.jit(end)(mass) for mass in MASSES]
    np.testing.assert_allclose(found, [q for q, _ in alone], rtol=1e-8, atol=1e-8)
    assert np.all(np.abs(steps - np.array([count for _, count in alone])) <= 2)


def carried_shapes(program):
    """The shapes of arrays that the loops of a program carry."""
    for equation in getattr(program, "jaxpr", program).eqns:
        if equation.primitive.name == "while":
            yield from (variable.aval.shape for variable in equation.outvars)
        for inner in sizes.inner_programs(equation):
            yield from carried_shapes(inner)


def test_a_vmap_has_members_side_by_side(monkeypatch):
    # No other test has traced this motion.
    end = machine(jaxmb.mechanisms.slider_crank, t1=0.3, rtol=1e-9)
    monkeypatch.setattr(members, "computes_side_by_side", lambda: True)
    masses = jnp.linspace(0.9, 1.1, 11)
    together = jax.jit(jax.vmap(lambda mass: end(mass)[0]))
    alone = jax.jit(lambda mass: end(mass)[0])
    np.testing.assert_allclose(together(masses), [alone(mass) for mass in masses], rtol=1e-8, atol=1e-8)
    # Eleven members are two blocks of six.
    shapes = set(carried_shapes(together.trace(masses).jaxpr))
    assert any(shape[-1:] == (6,) for shape in shapes) and not any(shape[:1] == (11,) for shape in shapes)


@pytest.mark.slow(but=("powers",))
@pytest.mark.parametrize("name", batched_machines.MACHINES)
def test_machines_in_batches_move_as_each_alone(name, monkeypatch):
    monkeypatch.setattr(members, "computes_side_by_side", lambda: True)
    assert max(batched_machines.differences(name).values()) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("way", ["quickly", "for speed", "for batches", None])
def test_batches_with_all_ways_to_compile(way, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    options = [] if way is None else ["--compile", way]
    done = subprocess.run(
        [sys.executable, batched_machines.__file__, "powers", *options], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
def test_a_vmap_within_a_vmap_and_its_derivatives(monkeypatch):
    end = machine(jaxmb.mechanisms.four_bar, t1=0.1, rtol=3e-9)
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
    end = machine(jaxmb.mechanisms.four_bar, t1=0.1, rtol=1e-9)

    def total(scale, masses, at_once):
        alone = lambda mass: end(scale * mass)[0]
        found = side_by_side(alone, masses)[0] if at_once else jax.vmap(alone)(masses)
        return jnp.sum(found**2)

    for derivative in (jax.grad, jax.jacfwd):
        slope = jax.jit(derivative(total, (0, 1)), static_argnums=2)
        both = [slope(1.0, MASSES, at_once) for at_once in (True, False)]
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9), *both)


@pytest.mark.slow
def test_gradients_of_members_are_those_of_each_alone():
    end = machine(jaxmb.mechanisms.four_bar, t1=0.3, rtol=1e-9)
    slope = jax.value_and_grad(lambda mass: jnp.sum(end(mass)[0]))
    found = jax.jit(lambda masses: side_by_side(slope, masses))(MASSES)
    alone = [jax.jit(slope)(mass) for mass in MASSES]
    np.testing.assert_allclose(found, np.transpose(alone), rtol=1e-7)
    exact = machine(jaxmb.mechanisms.four_bar, t1=0.3, rtol=1e-12)
    total = jax.jit(lambda mass: jnp.sum(exact(mass)[0]))
    differences = [(total(mass + 1e-4) - total(mass - 1e-4)) / 2e-4 for mass in MASSES]
    np.testing.assert_allclose(found[1], differences, rtol=1e-6)


@pytest.mark.slow
def test_members_bounce_at_their_own_times():
    ball = jaxmb.planar.Body("ball", mass=1.0, inertia=0.004, position=(0.0, 1.0))
    floor = jaxmb.RigidContact("floor", "ball", terrain=jaxmb.terrain.Flat(), radius=0.1, restitution=0.8)
    system = jaxmb.Scene([ball], joints=[floor], forces=[jaxmb.Gravity((0.0, -9.81))]).compile()
    start = jaxmb.assemble(system)

    def height(lifted):
        state = jaxmb.assemble(system, start, fix={"ball.y": lifted})
        return jaxmb.simulate(system, state, t1=1.5, rtol=1e-9, max_events=16)["ball"].position[-1, 1]

    heights = jnp.array([0.6, 1.0, 1.7])
    found = jax.jit(lambda heights: side_by_side(height, heights)[0])(heights)
    np.testing.assert_allclose(found, [height(x) for x in heights], rtol=1e-8)


@pytest.mark.slow
def test_a_member_that_fails_spoils_no_other():
    end = machine(jaxmb.mechanisms.four_bar, t1=0.1, rtol=1e-9)
    masses = jnp.array([1.0, jnp.nan, 1.05])
    found, _ = jax.jit(lambda masses: side_by_side(end, masses))(masses)
    assert np.all(np.isnan(found[1])) and np.all(np.isfinite(found[np.array([0, 2])]))
