"""Derivatives of assembled states with known numbers, against those of programs and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.states import nearest

# Most are of single operations, outside of `jit`.
MOST_PROGRAMS = 105
MACHINES = [
    *("parallelogram", "spatial_slider_crank", "double_wishbone", "bennett", "flyball", "rolling_disc", "rod_chain"),
    *("spherical_four_bar", "chaplygin_sleigh", "benenti", "appell_hamel", "car_axis"),
]


def four_bar():
    lengths = {"crank": (1.0, (0.5, 0.0), 0.0), "coupler": (2.0, (1.5, 0.8), 0.6), "rocker": (2.0, (2.2, 0.8), 1.2)}
    bodies = [
        planar.Body(name, mass=1.0, inertia=planar.rod(1.0, length), position=position, angle=angle)
        for name, (length, position, angle) in lengths.items()
    ]
    joints = [
        planar.Revolute("A", "ground", "crank", point_a=(0.0, 0.0), point_b=(-0.5, 0.0)),
        planar.Revolute("B", "crank", "coupler", point_a=(0.5, 0.0), point_b=(-1.0, 0.0)),
        planar.Revolute("C", "coupler", "rocker", point_a=(1.0, 0.0), point_b=(1.0, 0.0)),
        planar.Revolute("D", "rocker", "ground", point_a=(-1.0, 0.0), point_b=(2.0, 0.0)),
    ]
    return mb.Scene(bodies, joints=joints).compile()


@pytest.fixture
def searches(monkeypatch):
    """The names of the searches that a program makes."""
    called = []

    def spy(name):
        search = getattr(nearest, name)
        monkeypatch.setattr(nearest, name, lambda *given: called.append(name) or search(*given))

    spy("closest_configuration")
    spy("closest_velocities")
    return called


def test_assembled_states_of_known_numbers_have_derivatives_without_a_search(searches):
    """In forward and reverse mode, by a length, the guess and a rate, equal to differences and to those of `jit`."""
    system = four_bar()
    point, turned = jnp.array([-0.5, 0.0]), jnp.tile(jnp.array([0.0, 0.0, 0.2]), 3)

    def end(x):
        longer = mb.with_parameters(system, {"A.point_b": point * x[0]})
        guess = mb.State(system.guess.q + x[1] * turned, jnp.zeros(9))
        state = mb.assemble(longer, guess, rates={"A.angle": x[2]})
        return jnp.concatenate([state.q, state.u])

    x = jnp.array([1.05, 1.0, 2.0])
    forward, reverse = jax.jacfwd(end)(x), jax.jacrev(end)(x)
    assert searches == []
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=1e-13)
    step = 1e-4
    for k, unit in enumerate(np.eye(3)):
        near, far = ((end(x + n * step * unit) - end(x - n * step * unit)) / (2 * n * step) for n in (1, 2))
        np.testing.assert_allclose(forward[:, k], (4 * near - far) / 3, rtol=0, atol=1e-9)
    np.testing.assert_allclose(forward, jax.jit(jax.jacfwd(end))(x), rtol=0, atol=1e-12)
    assert set(searches) == {"closest_configuration", "closest_velocities"}


@pytest.mark.slow
def test_assembled_states_have_second_derivatives():
    system = four_bar()

    def end(x):
        state = mb.assemble(
            mb.with_parameters(system, {"A.point_b": x * np.array([-0.5, 0.0])}), rates={"A.angle": 2.0}
        )
        return jnp.sum(state.q**2) + jnp.sum(state.u**2)

    slope = jax.grad(end)
    near, far = ((slope(1.0 + h) - slope(1.0 - h)) / (2 * h) for h in (1e-4, 2e-4))
    for second in (jax.hessian(end), jax.jacfwd(jax.jacfwd(end)), jax.jit(jax.hessian(end))):
        np.testing.assert_allclose(second(1.0), (4 * near - far) / 3, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", MACHINES)
def test_assembled_states_of_machines_have_the_derivatives_of_programs(name):
    """By the guess and the time; with redundant rows too."""
    built, random = mb.mechanisms.get(name), np.random.default_rng(1)
    system, z = built.system, built.state.z
    q, u = (np.asarray(x) + 0.01 * random.normal(size=x.size) for x in (built.state.q, built.state.u))
    dq, du = random.normal(size=q.size), random.normal(size=u.size)

    def end(x, t):
        state = mb.assemble(system, mb.State(q + x * dq, u + x * du, z), t=t, throw=False)
        return jnp.concatenate([state.q, state.u])

    along = lambda x, t: jax.jvp(end, (x, t), (1.0, 1.0))
    for found, expected in zip(along(0.0, 0.3), jax.jit(along)(0.0, 0.3), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)
