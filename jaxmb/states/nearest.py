"""Closest states where their numbers may be known: found in NumPy, and differentiated by one small program.

A state x is the closest to a guess if `F(x, μ, p) = 0`, where μ are multipliers of the constraints and p all numbers of
the system (`optimality` of `states/closest.py`). With known numbers NumPy finds x and inverts `∂F/∂(x, μ)`; a compiled
program only finds the change of F by p. Under `jit` and `vmap`, and for higher derivatives, all of it is in the
program.
"""

import abc
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float

from ..linalg.arrays import is_traced
from ..linalg.elimination import full_pivot
from ..linalg.jitted import Split, jitted, on_host
from ..system import AbstractSystem
from ..system.instant import Instant
from .closest import closest_configuration, closest_velocities, independent_above, optimality
from .on_host import AbstractHost


class _Optimum(NamedTuple):
    """A closest state x in NumPy.

    **Fields:** the multipliers of independent `rows`; the `inverse` of the derivative of the optimality conditions by x
    and the multipliers.
    """

    x: Float[np.ndarray, "n"]
    multipliers: Float[np.ndarray, "r"]
    rows: tuple[int, ...]
    inverse: Float[np.ndarray, "n+r n+r"]


class AbstractNearest(eqx.Module):
    """The search for the closest state to a guess on the constraints of a system."""

    def found(self) -> tuple[Any, Any]:
        """The closest state, and whether it satisfies the constraints; differentiable."""
        arrays, static = Split.of(self)
        # Within a trace, a function with a derivative of its own has no known numbers.
        return _nearest(static, *arrays) if is_traced(arrays) else _value(self)

    @abc.abstractmethod
    def in_program(self) -> tuple[Array, Bool[Array, ""]]:
        """The closest state by a program, and whether it satisfies the constraints."""

    @abc.abstractmethod
    def in_numpy(self) -> tuple[AbstractHost, Float[np.ndarray, "n"]] | None:
        """The constraints of known numbers and the closest state in NumPy; None if it is left to the program."""

    @abc.abstractmethod
    def optimum(self, host: AbstractHost, x: Float[np.ndarray, "n"]) -> _Optimum | None:
        """The matrices at the closest state; None if its derivatives are left to the program."""

    @abc.abstractmethod
    def conditions(self, x: Array, multipliers: Array, rows: tuple[int, ...]) -> tuple[Array, Array]:
        """The optimality conditions, zero at the closest state."""


class Configuration(AbstractNearest):
    """The closest configuration.

    **Fields:** `held`: which coordinates keep their values; `rank` of the rows in the columns of the others.
    """

    system: AbstractSystem
    t: Any
    guess: Float[Array, "nq"]
    held: tuple[bool, ...] = eqx.field(static=True)
    rank: int = eqx.field(static=True)

    def in_program(self):
        return closest_configuration(self.system, self.t, self.guess, self.held, self.rank)

    def in_numpy(self):
        host = self.system.on_host(self.t)
        if host is None:
            return None
        q = host.closest_configuration(np.asarray(self.guess), np.array(self.held), self.rank)
        return None if q is None else (host, q)

    def optimum(self, host, x):
        pull = np.asarray(self.guess) - x, host.coordinate_jacobian(x), host.coordinate_scale
        return _optimum(x, *pull, np.array(self.held), self.rank, lambda forces: host.curvature(x, forces))

    def conditions(self, x, multipliers, rows):
        residual = lambda q: self.system.coordinate_residual(self.t, q)[np.array(rows, int)]
        scale = self.system.coordinate_scale()
        return optimality(residual, x - self.guess, x, multipliers, scale, np.array(self.held))


class Velocities(AbstractNearest):
    """The closest velocities.

    **Fields:** `guess`: a state with the guess; `held`: which rates keep their values.
    """

    guess: Instant
    held: tuple[bool, ...] = eqx.field(static=True)

    def in_program(self):
        return closest_velocities(self.guess, self.held)

    def in_numpy(self):
        system: Any = self.guess.system
        host = system.on_host(self.guess.t)
        if host is None:
            return None
        q, u = np.asarray(self.guess.q), np.asarray(self.guess.u)
        u = host.closest_velocities(q, u, np.array(self.held), system.velocity_rank)
        return None if u is None else (host, u)

    def optimum(self, host, x):
        if not host.linear:
            return None
        guess, rank = self.guess, self.guess.system.velocity_rank
        _, jacobian = host.velocity_rows_at(np.asarray(guess.q), x)
        pull = np.asarray(guess.u) - x, jacobian, host.velocity_scale
        return _optimum(x, *pull, np.array(self.held), rank, lambda forces: 0.0)

    def conditions(self, x, multipliers, rows):
        residual = lambda u: self.guess.with_(u=u).velocity_residual[np.array(rows, int)]
        scale = self.guess.system.velocity_scale()
        return optimality(residual, x - self.guess.u, x, multipliers, scale, np.array(self.held))


def _value(nearest):
    known = None if is_traced(nearest) else nearest.in_numpy()
    return nearest.in_program() if known is None else (jax.device_put(known[1]), jnp.array(True))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _nearest(static, *arrays):
    return _value(Split(list(arrays), static).whole())


def _derivative(static, primals, tangents):
    nearest = Split(list(primals), static).whole()
    known = None if is_traced(primals) else nearest.in_numpy()
    optimum = None if known is None else nearest.optimum(*known)
    places = [k for k, x in enumerate(tangents) if not isinstance(x, SymbolicZero) and x.dtype != jax.dtypes.float0]
    moved = [tangents[k] for k in places]
    if optimum is None:

        def in_program(*moved):
            arrays = list(primals)
            for k, x in zip(places, moved, strict=True):
                arrays[k] = x
            return Split(arrays, static).whole().in_program()

        (x, ok), (change, _) = jax.jvp(in_program, [primals[k] for k in places], moved)
    else:
        x, ok = jax.device_put(optimum.x), jnp.array(True)
        numbers = tuple(jax.device_put(x) for x in (optimum.x, optimum.multipliers, optimum.inverse))
        change = _moved(nearest, tuple(places), numbers, optimum.rows, moved)
    return (x, ok), (change, np.zeros((), jax.dtypes.float0))


_nearest.defjvp(_derivative, symbolic_zeros=True)


@jitted
def _moved(nearest, places, numbers, rows, tangents):
    """The change of a closest state by changes of some of the problem's arrays."""
    x, multipliers, inverse = numbers
    arrays, static = Split.of(nearest)

    def conditions(*moved):
        changed = list(arrays)
        for k, array in zip(places, moved, strict=True):
            changed[k] = array
        return jnp.concatenate(Split(changed, static).whole().conditions(x, multipliers, rows))

    _, change = jax.jvp(conditions, [arrays[k] for k in places], tangents)
    return -(inverse[: x.size] @ change)


_pivots: Any = on_host(full_pivot)


def _optimum(x, pull, jacobian, scale, held, rank, curvature):
    """The matrices at a closest state x, to which the guess is at `pull`; None where they are singular.

    **Arguments:** `curvature(forces)`: the derivative of `jacobianᵀ forces`.
    """
    free, (m, n) = ~held, jacobian.shape
    rows = np.arange(m)
    scaled = jacobian * np.where(free, scale, 0.0)
    sizes = np.linalg.svd(scaled, compute_uv=False)
    if m > n or np.any(sizes <= independent_above(x.dtype) * np.max(sizes, initial=0.0)):
        # Implied rows are left out, the same ones as in programs.
        found = _pivots(jacobian, scale=np.where(free, scale, 0.0))
        rows = np.asarray(found.order.rows)[: min(rank, int(found.rank))]
    kept, weights = jacobian[rows], np.where(free, 1 / scale**2, 1.0)
    multipliers = np.linalg.lstsq(kept[:, free].T, (weights * pull)[free], rcond=None)[0]
    forces = np.zeros(m)
    forces[rows] = multipliers
    balance = np.diag(weights) + np.where(free[:, None], curvature(forces), 0.0)
    pushed = np.where(free[:, None], kept.T, 0.0)
    matrix = np.block([[balance, pushed], [kept, np.zeros((rows.size, rows.size))]])
    try:
        inverse = np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        return None
    return _Optimum(x, multipliers, tuple(rows.tolist()), inverse) if np.all(np.isfinite(inverse)) else None
