"""Steps that hide a force which sets in and ends within them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from jaxtyping import Array

from jaxmb.solvers.gaps import hidden
from jaxmb.solvers.manifold_term import AbstractGaps, GapsSeen


class Wall(AbstractGaps):
    """The distance from a wall of some thickness, of a body that has the position y."""

    place: Array
    thickness: Array
    width: Array
    touch: Array

    def seen(self, t, y):
        position, velocity = y
        off = position - self.place
        gap, rate = jnp.abs(off) - self.thickness, jnp.sign(off) * velocity
        return GapsSeen(gap[None], rate[None], self.width[None], jnp.zeros(()))


class Arm(AbstractGaps):
    """The distance of the tip of an arm, which turns by the angle y, from a point on the circle of its tip."""

    radius: Array
    touch: Array

    def seen(self, t, y):
        angle, rate = y
        distance = 2 * jnp.abs(jnp.sin(0.5 * angle))
        closing = jnp.sign(jnp.sin(0.5 * angle)) * jnp.cos(0.5 * angle) * rate
        return GapsSeen((distance - self.radius)[None], closing[None], 0 * self.radius[None], jnp.abs(rate))


@eqx.filter_jit
def looked(gaps, t0, t1, way):
    at = lambda t: jax.jvp(way, (t,), (jnp.ones_like(t),))
    found = hidden(gaps, 1, None, (t0, t1), at(t1), at)
    return found.target, found.hides


STRAIGHT, TURNS = (lambda t: t), (lambda t: 40.0 * t + 1.0)


def wall(place, thickness, width=0.0):
    return Wall(*(jnp.array(x) for x in (place, thickness, width, 1e-14)))


@pytest.mark.parametrize("thickness", [0.1, 1e-3, 1e-6])
@pytest.mark.parametrize("place", [0.2, 0.5, 0.51, 0.9])
def test_a_wall_that_a_step_passes_is_found(place, thickness):
    target, hides = looked(wall(place, thickness), jnp.array(0.0), jnp.array(1.0), STRAIGHT)
    assert hides == 1 and abs(target - place) <= thickness


@pytest.mark.parametrize("place", [1.05, -0.05, 0.99, 3.0])
def test_a_step_that_ends_in_a_wall_or_comes_to_none_hides_nothing(place):
    target, hides = looked(wall(place, 0.1), jnp.array(0.0), jnp.array(1.0), STRAIGHT)
    assert hides == 0 and target == 1


def test_a_wall_beside_which_a_smooth_force_begins_is_found():
    # The way turns before the wall: what remains of the ramp there is four times that at the ends.
    turns = lambda t: 0.9 - (2 * t - 1.0) ** 2
    target, hides = looked(wall(1.0, 0.01, 0.05), jnp.array(0.0), jnp.array(1.0), turns)
    assert hides == 1 and abs(target - 0.5) < 0.1


@pytest.mark.parametrize("radius", [0.3, 1e-2, 1e-4])
def test_every_turn_of_a_step_of_many_turns_is_looked_at(radius):
    # Six turns; the tip first passes the point after a turn less a radian.
    ends = jnp.array(0.0), jnp.array(1.0)
    target, hides = looked(Arm(jnp.array(radius), jnp.array(1e-14)), *ends, TURNS)
    assert hides == 1 and 0 < target < 1
    short = jnp.array(0.12)
    target, hides = looked(Arm(jnp.array(radius), jnp.array(1e-14)), ends[0], short, TURNS)
    assert hides == 0 and target == short


def test_an_interpolant_that_is_unlike_its_velocities_near_a_wall_is_not_trusted():
    # At a distance from the wall that hides nothing, but less than the error of the positions.
    wrong = lambda t: (t + 0.3 * jnp.sin(jnp.pi * t) ** 2, jnp.ones_like(t))
    gaps = wall(1.0, 1e-3)
    found = hidden(gaps, 1, None, (jnp.array(0.0), jnp.array(0.9)), (jnp.array(0.8), jnp.array(1.0)), wrong)
    assert found.hides == 1
