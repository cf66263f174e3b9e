"""What is said of a user's own system, with residuals of its own, whose motion fails."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import pytest

import jaxmb as mb
from jaxmb.simulate.outcome import about_residuals
from jaxmb.system import AbstractSystem, DiagonalInertia, Ranks


class Winch(AbstractSystem):
    """A particle on a rod whose length depends on time, in Cartesian coordinates."""

    guess: mb.State
    length: float = 1.0
    design: tuple = ()
    nq: ClassVar[int] = 2
    nu: ClassVar[int] = 2
    position_rows: ClassVar[int] = 1
    rows: ClassVar = (("rod", 0),)
    ranks: ClassVar[Ranks] = Ranks(1, 1, 1, 1)

    def coordinate_names(self):
        return {"x": [0], "y": [1]}

    def coordinate_scale(self):
        return jnp.ones(2)

    def velocity_scale(self):
        return jnp.ones(2)

    def inertia(self, t, q, u):
        return DiagonalInertia(jnp.ones(2))

    def force(self, t, q, u):
        return jnp.array([0.0, -9.81])

    def kinetic_energy(self, t, q, u):
        return 0.5 * jnp.dot(u, u)

    def potential_energy(self, t, q):
        return 9.81 * q[1]

    def position_residual(self, t, q):
        return 0.5 * (jnp.dot(q, q) - (1.0 + 0.2 * jnp.sin(t)) ** 2)[None]

    def velocity_residual(self, t, q, u):
        return jax.jvp(self.position_residual, (t, q), (jnp.ones_like(t), u))[1]

    def acceleration_residual(self, t, q, u, udot):
        return jax.jvp(self.velocity_residual, (t, q, u), (jnp.ones_like(t), u, udot))[1]


class WithoutTime(Winch):
    """Its residuals of velocities and accelerations are those of a constant length."""

    def velocity_residual(self, t, q, u):
        return jnp.dot(q, u)[None]

    def acceleration_residual(self, t, q, u, udot):
        return (jnp.dot(q, udot) + jnp.dot(u, u))[None]


class WithoutTimeInAccelerations(Winch):
    def acceleration_residual(self, t, q, u, udot):
        return (jnp.dot(q, udot) + jnp.dot(u, u))[None]


class DeclaredAtRest(Winch):
    drift_free: ClassVar[bool] = True


class DeclaredLinear(Winch):
    linear: ClassVar[bool] = True
    position_rows: ClassVar[int] = 0
    velocity_rows: ClassVar[int] = 1
    ranks: ClassVar[Ranks] = Ranks(0, 0, 1, 1)

    def velocity_residual(self, t, q, u):
        return (jnp.dot(u, u) - 1.0)[None]


@pytest.mark.parametrize(
    "kind, text",
    [
        (Winch, ""),
        (WithoutTime, "velocity_residual is not the derivative of position_residual by time"),
        (WithoutTimeInAccelerations, "acceleration_residual is not the derivative of velocity_residual by time"),
        (DeclaredAtRest, "velocity_residual does not vanish at rest, although drift_free = True"),
        (DeclaredLinear, "velocity_residual is not linear, although linear = True"),
    ],
)
def test_residuals_of_a_users_system_that_contradict_each_other(kind, text):
    system = kind(mb.State(jnp.array([1.0, 0.0]), jnp.zeros(2)))
    said = about_residuals(system, 0.3, mb.State(jnp.array([0.6, -0.8]), jnp.array([0.8, 0.6])))
    assert text in said and bool(said) == bool(text)
    assert not text or said.startswith("The residuals of 'rod' contradict each other: ")


@pytest.mark.slow
def test_a_forgotten_rate_of_a_users_constraint_is_not_called_stiff():
    system = WithoutTime(mb.State(jnp.array([0.8, -0.6]), jnp.zeros(2)), length=jnp.ones(()))
    with pytest.raises(RuntimeError, match="'rod' contradict each other: velocity_residual is not the deriv"):
        mb.simulate(system, mb.assemble(system), t1=3.0, max_steps=1000)
