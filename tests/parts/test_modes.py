"""Modes of contacts and dry friction: their numbers, the laws that they say, and the direction of slip."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.parts.modes import (
    BEGUN,
    CLOSED,
    FORWARD,
    FREE,
    IMPLIED,
    IMPLIED_STICK,
    OPEN,
    STICK,
    Modes,
    modes_of_contacts,
    modes_of_friction,
    slip_direction,
)

MOST_PROGRAMS = 70

# Friction in one direction, then one in two directions.
ALONG = np.array([0.6, -0.8])


@functools.partial(jax.jit, static_argnums=(1, 2))
def _laws(numbers, contacts, single):
    modes = Modes.of(numbers, contacts, (single,))
    whole = {name: getattr(modes, name) for name in ("open", "shut", "closed", "slides", "sticks", "held", "kinds")}
    in_plane = [getattr(modes.in_plane, name) for name in ("begun", "slides", "slips")]
    return whole | {"slips": modes.slips(jnp.ones(len(numbers) - contacts)), "in plane": in_plane}


def laws_of(contacts, single, both):
    return _laws(np.array([*contacts, *single, *both], float), len(contacts), len(single))


def test_modes_of_contacts_and_of_friction_in_one_direction():
    """Rounding errors of the numbers do not count."""
    laws = laws_of([OPEN + 1e-9, CLOSED - 1e-9, IMPLIED], [-FORWARD + 1e-9], [FREE, FREE])
    np.testing.assert_array_equal(laws["open"], [True, False, False])
    np.testing.assert_array_equal(laws["shut"], [False, True, True])
    np.testing.assert_array_equal(laws["closed"], [False, True, False])
    np.testing.assert_array_equal(laws["slides"], [True, False, False])
    np.testing.assert_array_equal(laws["slips"], [-1, 0, 0])
    np.testing.assert_array_equal(laws["kinds"], [0, 1, 2, -1, 0, 0])


@pytest.mark.parametrize(
    "mode, sticks, held, begun, slides, kind",
    [
        ([FREE, FREE], False, False, False, False, FREE),
        (BEGUN * ALONG, False, False, True, False, FORWARD),
        (ALONG, False, False, False, True, FORWARD),
        ([STICK, STICK], True, True, False, False, STICK),
        ([IMPLIED_STICK, IMPLIED_STICK], False, True, False, False, STICK),
    ],
    ids=["free", "begun", "slides", "sticks", "implied"],
)
def test_modes_of_friction_in_two_directions(mode, sticks, held, begun, slides, kind):
    laws = laws_of([OPEN], [FREE], mode)
    np.testing.assert_array_equal(laws["sticks"], [False, sticks, sticks])
    np.testing.assert_array_equal(laws["held"], [False, held, held])
    np.testing.assert_array_equal(np.ravel(laws["in plane"]), [begun, slides, begun or slides])
    np.testing.assert_array_equal(laws["kinds"], [OPEN, FREE, kind, kind])


def test_the_direction_of_slip():
    """That of the slip, on the side of the modes; that of the modes where slip has begun, or there is none."""
    slip, none, along = 3.0 * np.array([0.8, 0.6]), np.zeros(2), jax.jit(slip_direction)
    direction = lambda mode, slip: along(np.asarray(mode, float), slip)
    np.testing.assert_allclose(direction([1.0, 0.0], slip), [0.8, 0.6], rtol=1e-15)
    np.testing.assert_allclose(direction([-1.0, 0.0], slip), [-0.8, -0.6], rtol=1e-15)
    np.testing.assert_allclose(direction(BEGUN * ALONG, slip), ALONG, rtol=1e-15)
    np.testing.assert_allclose(direction(ALONG, none), ALONG, rtol=1e-15)
    for mode in (FREE, STICK, IMPLIED_STICK):
        np.testing.assert_array_equal(direction([mode, mode], slip), 0.0)
        np.testing.assert_array_equal(direction([mode], slip[:1]), 0.0)
    np.testing.assert_array_equal(direction([-FORWARD], slip[:1]), [-1.0])


def test_laws_are_coded_as_they_are_read():
    yes, no = np.eye(2, 4, dtype=bool)
    of_contacts = modes_of_contacts(yes, no)
    np.testing.assert_array_equal(of_contacts, [CLOSED, IMPLIED, OPEN, OPEN])
    slips = np.array([0.0, 0.0, *ALONG])
    begun = np.array([False, False, True, True])
    of_friction = modes_of_friction(yes, no, slips, begun)
    modes = Modes.of(jnp.concatenate([of_contacts, of_friction]), 4, (2,))
    np.testing.assert_array_equal(modes.sticks, yes)
    np.testing.assert_array_equal(modes.implied_stick, no)
    np.testing.assert_allclose(modes.slips(jnp.zeros(4)), slips, rtol=1e-15)
    assert modes.in_plane.begun
