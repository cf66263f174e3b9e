"""Functions of sweeps and ways of changing them, importable by other processes."""

import jax
import jax.numpy as jnp
import numpy as np


def within(factor):
    return lambda k: {"x": factor * k}


def of_table(values):
    table = np.array(values)
    return lambda k: {"x": k * jnp.asarray(table)[1]}


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
    "a number in a long array": (lambda: of_table(np.ones(5000)), lambda: of_table(np.r_[1.0, 2.0, np.ones(4998)])),
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
