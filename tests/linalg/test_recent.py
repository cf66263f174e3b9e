"""What is kept of the last arguments is found for the same ones only."""

import gc
import weakref

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxmb.linalg.recent import Recent


class Box(eqx.Module):
    array: object
    number: object = 1.0
    word: str = eqx.field(static=True, default="a")


def counter():
    """A function that counts how often it is computed."""
    calls = []
    return calls, lambda: calls.append(None) or len(calls)


def test_the_same_arguments_are_found():
    _, compute = counter()
    recent, array = Recent(4), jnp.ones(3)
    keys = [(Box(array), np.float64(0.5)), (Box(array), np.float64(0.5)), (Box(array, 1.0), np.array(0.5))]
    assert [recent.found(key, compute) for key in keys] == [1, 1, 1]
    others = [
        (Box(jnp.ones(3)), np.float64(0.5)),
        (Box(array, 2.0), np.float64(0.5)),
        (Box(array, word="b"), np.float64(0.5)),
        (Box(array), np.float64(0.25)),
        (Box(array), np.float32(0.5)),
        (Box(array),),
        (Box(None), np.float64(0.5)),
    ]
    assert [recent.found(key, compute) for key in others] == list(range(2, 9))


def test_an_array_that_was_changed_in_place_is_another_one():
    _, compute = counter()
    recent, times = Recent(4), np.array([0.1, 0.2])
    assert recent.found((times,), compute) == 1
    times[0] = 0.3
    assert recent.found((times,), compute) == 2


def test_few_are_kept_and_none_that_is_traced():
    calls, compute = counter()
    recent = Recent(2)
    boxes = [Box(jnp.full(1, float(k))) for k in range(3)]
    for box in boxes:
        recent.found((box,), compute)
    assert recent.found((boxes[2],), compute) == 3 and recent.found((boxes[0],), compute) == 4
    first = weakref.ref(boxes[1].array)
    recent.found((Box(jnp.zeros(1)),), compute)
    del boxes, box
    gc.collect()
    assert first() is None
    before = len(calls)
    jax.jit(lambda x: recent.found((Box(x),), lambda: compute() * x))(1.0)
    jax.jit(lambda x: recent.found((Box(x),), lambda: compute() * x))(1.0)
    assert len(calls) == before + 2
