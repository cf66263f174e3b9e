"""A machine at rest takes long steps, although the forces that balance leave rounding errors; small motions do not."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly

import jaxmb as mb
from jaxmb import planar, spatial

SOLVERS = {"Adams": mb.solvers.Adams(), "Dopri8": diffrax.Dopri8(), "Hermite": mb.solvers.Hermite()}
DOWN = (0.0, 0.0, -9.81)


def hanging_chain(n):
    """Bodies one below the other, each with its centre of mass beside the line of their ball joints."""
    aside = np.random.default_rng(1).normal(size=(n, 2)) * 0.3
    body = lambda k: spatial.Body(
        f"link{k}", mass=1.0, inertia=(0.02, 0.02, 0.01), position=(*map(float, aside[k]), -0.5 - k)
    )
    joint = lambda k: spatial.Spherical(f"ball{k}", f"link{k - 1}" if k else "ground", f"link{k}", point=(0.0, 0.0, -k))
    return mb.Scene([body(k) for k in range(n)], joints=[joint(k) for k in range(n)], forces=[mb.Gravity(DOWN)])


def sprung_car():
    """A stiff balance without any joint: forces of springs against the weight."""
    car = planar.Body("car", mass=1000.0, inertia=500.0, position=(0.0, 1.0))
    spring = lambda name, x: planar.SpringDamper(
        name, "ground", "car", stiffness=3e4, free_length=1.0, point_a=(x, 0.0), point_b=(x, 0.0)
    )
    return mb.Scene([car], forces=[mb.Gravity((0.0, -9.81)), spring("rear", -1.2), spring("front", 1.3)])


SCENES = {"pendulum": lambda: hanging_chain(1), "double pendulum": lambda: hanging_chain(2), "car": sprung_car}


@functools.cache
def balanced(name):
    system = SCENES[name]().compile()
    return system, mb.equilibrium(system)


def swing(system, state, **options):
    """A motion of ten seconds that a change of gravity excites."""
    gravity = mb.parameters(system)["gravity.acceleration"]
    moved = mb.with_parameters(system, {"gravity.acceleration": 1.1 * gravity.at[0].set(1.0)})
    return mb.simulate(moved, state, t1=10.0, **options)


CASES = [("pendulum", "Adams"), ("double pendulum", "Adams"), ("car", "Adams"), ("car", "Dopri8"), ("car", "Hermite")]


@pytest.mark.slow(but=("car-Dopri8",))
@pytest.mark.parametrize("name, solver", CASES)
def test_machine_at_rest_takes_fewer_steps_than_a_swing(name, solver):
    system, state = balanced(name)
    most = int(swing(system, state, rtol=1e-6, solver=SOLVERS[solver]).stats["num_steps"])
    for rtol in (1e-6, 1e-9, 1e-12):
        rest = mb.simulate(system, state, t1=10.0, rtol=rtol, solver=SOLVERS[solver])
        assert int(rest.stats["num_steps"]) < most
        assert jnp.max(jnp.abs(rest.ys.u)) <= 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_steps_at_rest_do_not_enlarge_rounding_errors(solver):
    """A pendulum that balances exactly at the start, and later is pushed by as much as rounding errors would."""
    bob = planar.Body("bob", mass=1.0, inertia=0.02, position=(0.0, -1.0))
    pin = planar.Revolute("pin", "ground", "bob", point=(0.0, 0.0))
    push = mb.Force("push", "bob", lambda x, v, t, p: jnp.zeros((1, 3)).at[0, 2].set(1e-14 * jnp.sin(t)))
    system = mb.Scene([bob], joints=[pin], forces=[mb.Gravity((0.0, -9.81)), push]).compile()
    times = np.linspace(0.0, 20.0, 201)
    rest = mb.simulate(system, mb.assemble(system), t1=20.0, saveat=times, rtol=1e-6, solver=SOLVERS[solver])
    assert jnp.max(jnp.abs(rest.ys.u)) <= 1e-11


@pytest.mark.slow
def test_a_long_chain_at_rest():
    """Rounding errors of twenty bodies add up."""
    system = hanging_chain(20).compile()
    state = mb.equilibrium(system)
    rest = mb.simulate(system, state, t1=10.0, rtol=1e-9)
    assert rest.stats["num_steps"] < swing(system, state, rtol=1e-6).stats["num_steps"]


@pytest.mark.slow
def test_small_motion_is_no_rest():
    """An oscillator beside its balance, to its own size, and a pendulum a billionth of a radian from where it hangs,
    which coordinates of size one just resolve.
    """
    end = lambda system, rtol: mb.simulate(system, mb.assemble(system), t1=5.0, rtol=rtol).ys
    for amplitude in (1e-6, 1e-10):
        body = planar.Body("bob", mass=1.0, inertia=1.0, position=(amplitude, 0.0))
        at = {"point_a": (0.0, 0.0), "point_b": (0.0, 0.0)}
        rail = planar.Prismatic("rail", "ground", "bob", axis=(1.0, 0.0), **at)
        spring = planar.Bushing("spring", "ground", "bob", stiffness=(10.0, 0.0, 0.0), **at)
        last, phase = end(mb.Scene([body], joints=[rail], forces=[spring]).compile(), 1e-9), np.sqrt(10.0) * 5.0
        assert abs(last.q[-1, 0] / amplitude - np.cos(phase)) <= 1e-8
        assert abs(last.u[-1, 0] / (amplitude * np.sqrt(10.0)) + np.sin(phase)) <= 1e-8
    angle, rate = 1e-9, np.sqrt(9.81 / 1.02)
    bob = planar.Body("bob", mass=1.0, inertia=0.02, position=(np.sin(angle), -np.cos(angle)), angle=angle)
    pin = planar.Revolute("pin", "ground", "bob", point=(0.0, 0.0))
    last = end(mb.Scene([bob], joints=[pin], forces=[mb.Gravity((0.0, -9.81))]).compile(), 1e-10)
    assert abs(last.u[-1, 2] / (angle * rate) + np.sin(rate * 5.0)) <= 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("name, solver", [("car", "Adams"), ("pendulum", "Hermite")])
def test_machine_at_rest_has_derivatives(name, solver):
    """By gravity, which moves the machine: forward and reverse mode, and differences of a tighter motion; in a batch,
    of which one starts a little beside it.
    """
    system, state = balanced(name)
    gravity = mb.parameters(system)["gravity.acceleration"]

    def end(slope, rtol):
        tilted = mb.with_parameters(system, {"gravity.acceleration": gravity.at[0].set(slope)})
        last = jax.tree.map(lambda x: x[-1], mb.simulate(tilted, state, t1=2.0, rtol=rtol, solver=SOLVERS[solver]).ys)
        return last.q @ jnp.arange(1.0, 1 + last.q.size) + last.u @ jnp.arange(1.0, 1 + last.u.size)

    forward = jit_quickly(lambda slope, rtol: jax.jvp(lambda x: end(x, rtol), (slope,), (1.0,)))
    value, slope = lambda x: forward(x, 1e-12)[0], forward(0.0, 1e-9)[1]
    np.testing.assert_allclose(slope, (value(1e-4) - value(-1e-4)) / 2e-4, rtol=1e-6)
    batch = jit_quickly(jax.vmap(jax.grad(end), (0, None)))(jnp.array([0.0, 1e-13, 0.3]), 1e-9)
    np.testing.assert_allclose(batch[:2], np.full(2, slope), rtol=1e-6)
