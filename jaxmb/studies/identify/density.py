"""The posterior density of unknowns, for samplers such as blackjax and numpyro."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .fit import Fit
from .problem import Problem


class LogDensity(eqx.Module):
    """The logarithm of a posterior density as a function of the unconstrained vector, up to a constant.

    It is the density of the vector: the likelihood times the priors, uniform by default, times the Jacobian determinant
    of the values with respect to the vector. `−∞` if a simulation fails, with derivatives of zero. `jax.grad`, `jit`
    and `vmap` apply.

    **Fields:** `start`: the vector of the estimates, a start for a chain.
    """

    problem: Problem
    start: Float[Array, "n"]

    @eqx.filter_jit
    def __call__(self, z: Float[Array, "n"]) -> Float[Array, ""]:
        return _log_density(z, problem=self.problem)

    def parameters(self, z: Float[Array, "*batch n"]) -> dict[str, Array]:
        """The values by name of a vector, or of the vectors of a chain, in the order of the vector's entries."""
        each = self.problem.free
        names = list(each(self.start))
        for _ in range(z.ndim - 1):
            each = jax.vmap(each)
        # JAX sorts dictionaries.
        values = each(z)
        return {name: values[name] for name in names}


def logdensity(fit: Fit) -> LogDensity:
    """As `Identification.logdensity`."""
    if not fit.problem.known_noise:
        raise ValueError("A density needs the noise level of every sensor: give sigma, or let it be free.")
    fit.whole_motions("A density")
    return LogDensity(fit.problem, fit.z)


def _value(z: Float[Array, "n"], problem: Problem) -> Float[Array, ""]:
    value = problem.free.log_volume(z) - problem.objective(z)
    return jnp.where(jnp.isnan(value), -jnp.inf, value)


@eqx.filter_custom_jvp
def _log_density(z, *, problem):
    return _value(z, problem)


@_log_density.def_jvp
def _log_density_jvp(primals, tangents, *, problem):
    value, gradient = jax.value_and_grad(_value)(primals[0], problem)
    # Without a density the gradient is zero.
    return value, jnp.where(jnp.isfinite(value), gradient, 0.0) @ tangents[0]
