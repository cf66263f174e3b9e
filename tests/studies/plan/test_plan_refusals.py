"""Arguments of plans that are refused in words, and arguments that have two readings."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.studies.plan.guess import first_guess
from jaxmb.studies.plan.plan import task_of
from jaxmb.studies.plan.task import checked_limits

MOST_PROGRAMS = 60


@pytest.fixture(scope="module")
def system():
    """A bar on a pin with a motor, pushed by a vector of forces."""
    bar = planar.Body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    push = planar.PointForce("push", "bar", force=(0.0, 0.0))
    return mb.Scene([bar], joints=[pin], forces=[mb.JointForce("motor", "pin.angle", force=0.0), push]).compile()


GOOD = {"controls": {"motor.force": (-20.0, 20.0)}, "duration": 1.0, "running": "effort", "intervals": 2}
GOOD |= {"start": {"pin.angle": 0.0}, "end": {"pin.angle": 1.0}}
REFUSED = [
    ({"running": lambda at: jnp.ones(2)}, "running= must return a number, and returns shape (2,)"),
    ({"running": lambda at: None}, "running= must return a number, and returns nothing"),
    ({"final": lambda at: at["bar.position"]}, "final= must return a number, and returns shape (2,)"),
    ({"tol": "small"}, "tol must be a real number, got 'small'"),
    ({"guess": 3.0}, "guess must be values by name, a Trajectory, RequiredForces or a Plan; got 3.0"),
    ({"moving": True, "interpolation": "cubic"}, "take interpolation='held', got 'cubic'"),
    ({"controls": {"motor.force": (2.0, 2.0)}}, "'motor.force' is held by its bounds"),
    ({"controls": {"push.force": ((1.0, 0.0), (-1.0, 0.0))}}, "must be (low, high) with low ≤ high"),
    ({"end": {"pin.angle": float("nan")}}, "must not be NaN"),
]


@pytest.mark.parametrize(("change", "words"), REFUSED, ids=[words[:40] for _, words in REFUSED])
def test_plan_refuses_in_words(system, change, words):
    with pytest.raises(ValueError) as error:
        mb.plan(system, **{**GOOD, **change})
    assert words in str(error.value)


def test_two_numbers_bound_a_vector_along_the_way_and_are_its_value_at_an_end(system):
    limits = {"pin.force": (-500.0, 400.0)}
    low, high = checked_limits(system, "path", limits, {}).by_name()["pin.force"]
    np.testing.assert_array_equal([low, high], [[-500.0, -500.0], [400.0, 400.0]])
    low, high = checked_limits(system, "end", limits, {}).by_name()["pin.force"]
    np.testing.assert_array_equal([low, high], [[-500.0, 400.0], [-500.0, 400.0]])
    pair = {"pin.force": ((-1.0, -2.0), (1.0, 2.0))}
    low, high = checked_limits(system, "end", pair, {}).by_name()["pin.force"]
    np.testing.assert_array_equal([low, high], [[-1.0, -2.0], [1.0, 2.0]])


def test_prices_of_a_fixed_state_are_those_of_its_coordinates(system):
    ends = [{"pin.angle": angle, "pin.angle_rate": 0.0} for angle in (0.0, 1.0)]
    options = {"controls": {"motor.force": None}, "duration": 1.0, "running": "effort", "intervals": 4}
    named = mb.plan(system, start=ends[0], end=ends[1], **options)
    start, end = (mb.assemble(system, fix={"pin.angle": given["pin.angle"]}) for given in ends)
    fixed = mb.plan(system, start=start, end=end, **options)
    for where, angle in (("start", 0.0), ("end", 1.0)):
        prices = {name: value for name, value in fixed.prices.items() if name.startswith(where)}
        assert len(prices) == 2
        # One coordinate is that of the bar's pose, whose slope by the angle the chain rule tells.
        slopes = {"bar.x": -0.5 * np.sin(angle), "bar.y": 0.5 * np.cos(angle), "bar.angle": 1.0}
        for name, price in prices.items():
            rate = name.endswith("_rate")
            slope = slopes[name.removeprefix(f"{where} ").removesuffix("_rate")]
            np.testing.assert_allclose(
                price * slope, named.prices[f"{where} pin.angle{'_rate' if rate else ''}"], rtol=1e-6
            )


def test_guess_chooses_what_the_start_leaves_free(system):
    """The start gives a height that two angles have; the guess is near the second."""
    height = 0.5 * np.sin(0.3)
    task = task_of(
        system,
        controls=GOOD["controls"],
        duration=1.0,
        ends=({"bar.y": height}, {}),
        objective=("effort", None),
        nodes=(2, "linear"),
    )
    guess = first_guess(task, {"pin.angle": lambda t: 2.9 + t})
    np.testing.assert_allclose(guess.states.q[0, 2], np.pi - 0.3, rtol=0, atol=1e-9)
