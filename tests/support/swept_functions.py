"""Functions of sweeps and ways of changing them, importable by other processes."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

SCALE = {"number": 1.0}


class Wind:
    """A user's class of no kind that JAX knows."""

    def __init__(self, strength):
        self.strength = strength

    def force(self, k):
        return {"x": self.strength * k}

    def gust(self, k):
        return {"x": self.strength * k**2}


def within(factor):
    return lambda k: {"x": factor * k}


def with_default(value):
    def function(k, a=value):
        return {"x": a * k}

    return function


def with_global(scale):
    """A function that reads another value of a global variable."""
    made = type(within)(_scaled.__code__, {"SCALE": scale}, "scaled")
    made.__module__ = __name__
    return made


def _scaled(k):
    return {"x": SCALE["number"] * k}


def of_table(values):
    table = np.array(values)
    return lambda k: {"x": k * jnp.asarray(table)[1]}


def power(exponent, k):
    return {"x": k**exponent}


def slope(rule):
    """The derivative of a function with a rule for it."""

    @jax.custom_jvp
    def bent(x):
        return jnp.abs(x)

    bent.defjvp(lambda primals, tangents: (bent(*primals), rule(primals[0]) * tangents[0]))
    return lambda k: {"x": jax.grad(bent)(k)}


def pull(rule):
    @jax.custom_vjp
    def bent(x):
        return jnp.abs(x)

    bent.defvjp(lambda x: (bent(x), x), lambda x, ct: (rule(x) * ct,))
    return lambda k: {"x": jax.grad(bent)(k)}


def summed(axis):
    return lambda k: {"x": jnp.sum(k * jnp.ones((2, 2)), axis)}


def loop(length):
    return lambda k: {"x": jax.lax.fori_loop(0, length, lambda _, x: 2 * x, k)}


def plain(k):
    return {"x": 2 * k}


def told(speed):
    """Twice a speed."""
    # The same with other words.
    doubled = 2 * speed
    return {"x": doubled}


# For each way of changing what a sweep computes: two functions, made anew with every call.
CHANGES = {
    "an exponent": (lambda: lambda k: {"x": k**2}, lambda: lambda k: {"x": k**3}),
    "an exponent of a partial": (lambda: functools.partial(power, 2), lambda: functools.partial(power, 3)),
    "the axis of a sum": (lambda: summed(0), lambda: summed(1)),
    "the length of a loop": (lambda: loop(2), lambda: loop(3)),
    "an index": (lambda: lambda k: {"x": jnp.arange(3.0)[1] * k}, lambda: lambda k: {"x": jnp.arange(3.0)[2] * k}),
    "a direction": (
        lambda: lambda k: {"x": jnp.cumsum(k * jnp.ones(3))},
        lambda: lambda k: {"x": jax.lax.cumsum(k * jnp.ones(3), reverse=True)},
    ),
    "a function of a package": (lambda: lambda k: {"x": jnp.sin(k)}, lambda: lambda k: {"x": jnp.cos(k)}),
    "the order of operands": (lambda: lambda k: {"x": k - 1.0}, lambda: lambda k: {"x": 1.0 - k}),
    "the value of a closure": (lambda: within(1.0), lambda: within(1.0 + 1e-15)),
    "a default argument": (lambda: with_default(1.0), lambda: with_default(2.0)),
    "a global variable": (lambda: with_global({"number": 1.0}), lambda: with_global({"number": 2.0})),
    "an attribute": (lambda: Wind(1.0).force, lambda: Wind(2.0).force),
    "a method": (lambda: Wind(1.0).force, lambda: Wind(1.0).gust),
    "a number in an array": (lambda: of_table([1.0, 2.0]), lambda: of_table([1.0, 3.0])),
    "a number in a long array": (lambda: of_table(np.ones(5000)), lambda: of_table(np.r_[1.0, 2.0, np.ones(4998)])),
    "a compiled function": (lambda: jax.jit(within(1.0)), lambda: jax.jit(within(2.0))),
    "a rule of forward mode": (lambda: slope(jnp.sign), lambda: slope(jnp.tanh)),
    "a rule of reverse mode": (lambda: pull(jnp.sign), lambda: pull(jnp.tanh)),
    "the type of a number": (
        lambda: lambda k: {"x": jnp.float64(k)},
        lambda: lambda k: {"x": jnp.float32(k)},
    ),
    "a key of random numbers": (
        lambda: lambda k: {"x": k * jax.random.normal(jax.random.key(1))},
        lambda: lambda k: {"x": k * jax.random.normal(jax.random.key(2))},
    ),
}
