"""Steps that hide a force which sets in and ends within them."""

import jax
import jax.numpy as jnp
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


def looked(gaps, t0, t1, way):
    at = lambda t: jax.jvp(way, (t,), (jnp.ones_like(t),))
    found = hidden(gaps, 1, (t0, t1), at(t1), at)
    return found.target, found.hides


def wall(place, thickness, width=0.0):
    return Wall(*(jnp.asarray(x) for x in (place, thickness, width, 1e-14)))


START, END = jnp.array(0.0), jnp.array(1.0)


def test_a_wall_that_a_step_passes_is_found():
    """One in which the step ends, or to which it does not come, hides nothing."""
    look = jax.jit(lambda place, thickness: looked(wall(place, thickness), START, END, lambda t: t))
    for place in (0.2, 0.5, 0.51, 0.9):
        for thickness in (0.1, 1e-3, 1e-6):
            target, hides = look(place, thickness)
            assert hides and abs(target - place) <= thickness
    for place in (1.05, -0.05, 0.99, 3.0):
        target, hides = look(place, 0.1)
        assert not hides and target == 1


def test_every_turn_of_a_step_of_many_turns_is_looked_at():
    # Six turns; the tip first passes the point after a turn less a radian.
    turns = lambda t: 40.0 * t + 1.0
    look = jax.jit(lambda radius, end: looked(Arm(radius, jnp.array(1e-14)), START, end, turns))
    for radius in (0.3, 1e-2, 1e-4):
        target, hides = look(radius, 1.0)
        assert hides and 0 < target < 1
        target, hides = look(radius, 0.12)
        assert not hides and target == 0.12


def test_interpolants_beside_a_wall():
    @jax.jit
    def run():
        # The way turns before the wall: what remains of the ramp there is four times that at the ends.
        turns = lambda t: 0.9 - (2 * t - 1.0) ** 2
        # At a distance from the wall that hides nothing, but less than the error of the positions.
        wrong = lambda t: (t + 0.3 * jnp.sin(jnp.pi * t) ** 2, jnp.ones_like(t))
        ends = (START, jnp.array(0.9)), (jnp.array(0.8), jnp.array(1.0))
        return looked(wall(1.0, 0.01, 0.05), START, END, turns), hidden(wall(1.0, 1e-3), 1, *ends, wrong).hides

    (target, hides), hides_by_error = run()
    assert hides and hides_by_error and abs(target - 0.5) < 0.1
