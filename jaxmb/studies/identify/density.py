"""The posterior density of unknowns, for samplers such as those of blackjax and numpyro."""

from typing import Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .fit import Fit
from .problem import Problem


class LogDensity(eqx.Module):
    """The logarithm of a posterior density as a function of the unconstrained vector, up to a constant.

    It is the density of the vector: the likelihood times the priors, which are uniform where none is given, times the
    volume of the values that belong to a change of the vector. `−∞` where a simulation fails. `jax.grad`, `jit` and
    `vmap` apply.

    **Fields:** `start`: the vector of the estimates, where a chain may start; `mode`: how a gradient is computed.
    """

    problem: Problem
    start: Float[Array, "n"]
    mode: Literal["forward", "reverse"] = eqx.field(static=True)

    @eqx.filter_jit
    def __call__(self, z: Float[Array, "n"]) -> Float[Array, ""]:
        if self.mode == "reverse":
            return _log_density(self.problem, None, z)
        return _with_forward_gradient(z, self.problem)

    def parameters(self, z: Float[Array, "*batch n"]) -> dict[str, Array]:
        """The values by name of a vector, or of the vectors of a chain."""
        each = self.problem.free
        for _ in range(z.ndim - 1):
            each = jax.vmap(each)
        return each(z)


def logdensity(fit: Fit, mode: Literal["forward", "reverse"] = "forward") -> LogDensity:
    """As `Identification.logdensity`."""
    if mode not in ("forward", "reverse"):
        raise ValueError(f"mode must be 'forward' or 'reverse', got {mode!r}.")
    if not fit.known_noise:
        raise ValueError("A density needs the noise level of every sensor: give sigma, or let it be free.")
    fit.whole_motions("A density")
    return LogDensity(fit.problem, fit.z, mode)


def _log_density(problem: Problem, adjoint, z):
    value = problem.free.log_volume(z) - problem.objective(z, adjoint)
    return jnp.where(jnp.isnan(value), -jnp.inf, value)


@eqx.filter_custom_vjp
def _with_forward_gradient(z, problem):
    return _log_density(problem, diffrax.ForwardMode(), z)


@_with_forward_gradient.def_fwd
def _forward(perturbed, z, problem):
    del perturbed

    def both(z):
        value = _log_density(problem, diffrax.ForwardMode(), z)
        return value, value

    gradient, value = jax.jacfwd(both, has_aux=True)(z)
    # Where there is no density there is no way up either.
    return value, jnp.where(jnp.isfinite(value), gradient, 0.0)


@_with_forward_gradient.def_bwd
def _backward(gradient, cotangent, perturbed, z, problem):
    del perturbed, z, problem
    return cotangent * gradient
