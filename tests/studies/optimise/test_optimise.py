"""The optimiser: methods, constraints and multipliers, trials and starts that fail, several starts, robust designs."""

import functools
import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxmb as mb
from jaxmb.studies.optimise.evaluation import Program

MOST_PROGRAMS = 130

START = {"x": [-1.2, 1.0]}
DISK = {"square": (None, 1.0)}
METHODS = ["slsqp", "optax"]


def valley(v):
    """Rosenbrock's function."""
    x = v["x"]
    return {"f": (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2, "square": jnp.sum(x * x), "x": x}


@pytest.fixture(scope="module")
def in_disk():
    return mb.optimise(valley, START, objective="f", constraints=DISK)


def test_a_constraint_and_its_multiplier(in_disk):
    """The known optimum in the unit disk; the multiplier is what a larger disk gains."""
    np.testing.assert_allclose(in_disk.parameters["x"], [0.7864151510, 0.6176983125], rtol=0, atol=1e-6)
    np.testing.assert_allclose(in_disk.objective, 0.0456748087, rtol=1e-6)
    (constraint,) = in_disk.constraints
    assert in_disk.success and constraint.active and constraint.before > 1.0
    of = lambda radius: mb.optimise(valley, START, objective="f", constraints={"square": (None, radius)}).objective
    np.testing.assert_allclose(constraint.multiplier, (of(0.999) - of(1.001)) / 0.002, rtol=1e-2)


def test_what_is_printed(in_disk):
    text = str(in_disk)
    for word in ("parameter", "x[1]", "before", "after", "multiplier", "iteration", "result", "failed", "converged"):
        assert word in text
    assert in_disk.before["f"] == pytest.approx(24.2) and in_disk.iterations[0].objective == pytest.approx(24.2)
    assert in_disk.iterations[0].violation > 0 and in_disk.trials >= len(in_disk.iterations) - 1


def test_the_end_is_preferred_to_trials_that_gain_by_breaking_a_constraint():
    cube = lambda v: {"x": v["x"], "cube": v["x"] ** 3}
    best = mb.optimise(cube, {"x": 3.0}, objective="x", constraints={"cube": (0.7, None)})
    assert best.success and best.outputs["cube"] >= 0.7 - 1e-12


def test_a_problem_without_solution_names_the_constraint():
    best = mb.optimise(valley, START, objective="f", constraints={"square": (None, 1.0), "x": ([-2.0, 3.0], None)})
    assert not best.success and "no step makes progress from here" in best.message
    assert re.search(r"most of all ('square' is .*, above 1|'x\[1\]' is .*, below 3)$", best.message)


@pytest.mark.slow
def test_a_flywheel_is_found_from_its_start_and_from_its_end():
    """The multiplier balances the gradient of the start but for rounding errors, which are no slope to follow."""
    wheel = lambda v: {"J": v["J"], "fluctuation": 1.88481475 / v["J"]}
    limits = {"constraints": {"fluctuation": (None, 0.02)}, "bounds": {"J": (0.05, 200.0)}}
    best = mb.optimise(wheel, {"J": 199.0}, objective="J", **limits)
    assert best.success and best.trials < 30
    np.testing.assert_allclose(best.objective, 1.88481475 / 0.02, rtol=1e-6)
    again = mb.optimise(wheel, best.parameters, objective="J", **limits)
    assert again.success and again.trials <= 2


def clashing(v):
    """Linearised where x and y are small, both constraints ask for more than the bounds allow."""
    return {"f": v["x"] + v["y"], "ring": v["x"] ** 2 + v["y"] ** 2, "area": v["x"] * v["y"]}


def hock_and_schittkowski(v):
    """Problem 71 of W. Hock and K. Schittkowski, "Test Examples for Nonlinear Programming Codes", Springer 1981."""
    x = v["x"]
    return {"f": x[0] * x[3] * jnp.sum(x[:3]) + x[2], "product": jnp.prod(x), "square": jnp.sum(x * x)}


def even(v):
    return {"f": (v["x"] - 1) ** 2 + v["x"], "square": v["x"] ** 2, "gap": v["x"] ** 2 - v["y"] ** 2}


@pytest.mark.parametrize(
    "function, start, constraints, bounds, least",
    [
        pytest.param(
            clashing,
            {"x": 0.2, "y": 0.1},
            {"ring": (4.0, None), "area": (1.0, None)},
            {"x": (0.0, 3.0), "y": (0.0, 3.0)},
            6**0.5,
            id="linearised constraints that clash",
        ),
        pytest.param(
            hock_and_schittkowski,
            {"x": [1.0, 5.0, 5.0, 1.0]},
            {"product": (25.0, None), "square": 40.0},
            {"x": (1.0, 5.0)},
            17.0140173,
            id="a start on bounds",
        ),
        pytest.param(even, {"x": 0.0, "y": 1.0}, {"square": (1.0, None)}, {"x": (0.0, 3.0)}, 1.0, id="no slope"),
        pytest.param(even, {"x": 0.0, "y": 0.0}, {"gap": 0.0}, None, 0.75, id="no slope on an equation"),
    ],
)
def test_a_start_from_which_linearised_constraints_show_no_way(function, start, constraints, bounds, least):
    best = mb.optimise(function, start, objective="f", constraints=constraints, bounds=bounds)
    assert best.success
    np.testing.assert_allclose(best.objective, least, rtol=1e-6)


@pytest.mark.slow("equations")
@pytest.mark.parametrize("twice", [2.0, (2.0, None)], ids=["equations", "an inequality"])
def test_constraints_that_say_the_same_twice(twice):
    line = lambda v: {"f": v["x"] ** 2 + v["y"] ** 2, "a": v["x"] + v["y"], "b": 2 * v["x"] + 2 * v["y"]}
    best = mb.optimise(line, {"x": 3.0, "y": -1.0}, objective="f", constraints={"a": 1.0, "b": twice})
    assert best.success
    np.testing.assert_allclose(best.objective, 0.5, rtol=1e-6)


@pytest.mark.slow
def test_more_equations_than_parameters_that_agree():
    three = lambda v: {"f": v["x"] ** 2, "a": v["x"] + v["y"], "b": v["x"] - v["y"], "c": v["x"] * v["y"]}
    best = mb.optimise(three, {"x": 3.0, "y": 1.0}, objective="f", constraints={"a": 3.0, "b": 1.0, "c": 2.0})
    assert best.success and best.objective == pytest.approx(4.0)
    best = mb.optimise(three, {"x": 3.0, "y": 1.0}, objective="f", constraints={"a": 3.0, "b": 1.0, "c": 5.0})
    assert not best.success and "violated" in best.message and "successfully" not in best.message


@pytest.mark.slow("1000000000000.0")
@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_a_bound_of_zero_takes_the_size_of_its_output(unit):
    """The tolerance goes with the unit of the output, and the result has it; that of a bound is a millionth of it."""
    area = lambda v: {"sum": v["x"] + v["y"], "area": unit * (v["x"] * v["y"] - 2.0), "x": v["x"]}
    limits = {"constraints": {"area": 0.0, "x": (0.5, 1e7)}, "bounds": {"x": (0.1, 10.0), "y": (0.1, 10.0)}}
    best = mb.optimise(area, {"x": 3.0, "y": 1.0}, objective="sum", **limits)
    assert best.success
    np.testing.assert_allclose(best.objective, 8**0.5, rtol=1e-6)
    # The area changes by 9.9 times x where y changes by the distance of its bounds.
    np.testing.assert_allclose([c.tolerance for c in best.constraints], [29.7e-6 * unit, 0.5e-6], rtol=1e-9)
    assert "within" in str(best)


@pytest.mark.slow
def test_a_bound_almost_zero_has_a_tolerance_above_rounding_errors():
    area = lambda v: {"f": v["x"] ** 2 + v["y"] ** 2, "area": v["x"] * v["y"] - 2.0}
    best = mb.optimise(area, {"x": 3.0, "y": 1.0}, objective="f", constraints={"area": 1e-12})
    assert best.success and best.trials < 30 and best.objective == pytest.approx(4.0)


@pytest.mark.slow
def test_the_tolerance_of_a_narrow_range_is_that_of_its_width():
    shifted = lambda v: {"x": v["x"], "far": 1e6 + v["x"]}
    best = mb.optimise(shifted, {"x": 3.0}, objective="x", constraints={"far": (1e6 + 0.5, 1e6 + 1.0)})
    assert best.success and abs(best.objective - 0.5) < 1e-6
    assert best.constraints[0].tolerance == pytest.approx(5e-7)


@pytest.mark.slow
def test_a_far_bound_does_not_loosen_the_other():
    area = lambda v: {"sum": v["x"] + v["y"], "area": v["x"] * v["y"]}
    options = {"bounds": {"x": (0.1, 10.0), "y": (0.1, 10.0)}, "objective": "sum"}
    best = mb.optimise(area, {"x": 5.0, "y": 2.0}, constraints={"area": (1.0, 1e7)}, **options)
    np.testing.assert_allclose(best.objective, 2.0, rtol=1e-5)
    assert best.success and best.outputs["area"] > 1 - 1e-6 and best.constraints[0].active


def test_multipliers_of_constraints_that_meet():
    """(x - 2)² + (y - 1)² with two constraints, whose multipliers are 2/3; with a constraint and a bound."""
    corner = lambda v: {"f": (v["x"] - 2) ** 2 + (v["y"] - 1) ** 2, "c": v["x"] ** 2 - v["y"], "d": v["x"] + v["y"]}
    limits = {"c": (None, 0.0), "d": [None, 2.0]}
    best = mb.optimise(corner, {"x": 0.5, "y": 0.5}, objective="f", constraints=limits)
    np.testing.assert_allclose(best.objective, 1.0, rtol=2e-7)
    assert best.success and all(c.active for c in best.constraints)
    np.testing.assert_allclose([c.multiplier for c in best.constraints], 2 / 3, rtol=1e-6)
    limits, bounds = {"d": (None, 1.0)}, {"x": (-1.0, 0.5)}
    best = mb.optimise(corner, {"x": 0.0, "y": 0.0}, objective="f", constraints=limits, bounds=bounds)
    np.testing.assert_allclose(best.constraints[0].multiplier, 1.0, rtol=1e-6)


@pytest.mark.slow
def test_the_unit_of_the_objective_has_no_effect():
    """Lengths of 1e-5, whose squares are small, in units that are powers of two: the same bits."""
    square = lambda v, unit: unit * jnp.mean((v["x"] - jnp.array([3e-5, -2e-5])) ** 2)
    small, large = (
        mb.optimise(lambda v, unit=unit: square(v, unit), {"x": [1e-5, 1e-5]}) for unit in (2.0**-40, 2.0**40)
    )
    assert small.success and large.success and small.trials == large.trials
    np.testing.assert_array_equal(small.parameters["x"], large.parameters["x"])
    np.testing.assert_allclose(small.parameters["x"], [3e-5, -2e-5], rtol=1e-8)


def steep(x):
    return (x[0] - 3) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2


def test_a_large_constant_part_of_the_objective_hides_nothing():
    """In a valley, and where the start is on a bound and a constraint."""
    best = mb.optimise(lambda v: 1e5 + steep(v["x"]), {"x": [0.5, 0.5]})
    assert best.success and steep(best.parameters["x"]) < 1e-8 * 1e5
    far = lambda x: jnp.sum((x - np.array([3.0, -2.0])) ** 2)
    outputs = lambda v: {"f": 1e5 + far(v["x"]), "sum": jnp.sum(v["x"])}
    options = {"constraints": {"sum": (0.0, None)}, "bounds": {"x": ([0.0, -np.inf], None)}}
    best = mb.optimise(outputs, {"x": [0.0, 0.0]}, objective="f", **options)
    assert best.success and far(best.parameters["x"]) < 1e-8 * 1e5


@pytest.mark.slow("optax")
@pytest.mark.parametrize("method", ["slsqp", optax.lbfgs()], ids=METHODS)
def test_bounds_by_every_method(method):
    """The optimum on a bound: x = (0.8, 0.64)."""
    bounds = {"x": (-3.0, [0.8, 1.5])}
    best = mb.optimise(valley, START, objective="f", bounds=bounds, method=method, max_iterations=1000)
    np.testing.assert_allclose(best.objective, 0.04, rtol=1e-4)
    assert best.parameters["x"][0] <= 0.8


@pytest.mark.slow
def test_equations_and_bounds_of_components():
    sides = {"square": 1.0, "x": ([0.0, None], None)}
    with pytest.raises(ValueError, match="The constraint of 'x': low must be an array of real numbers"):
        mb.optimise(valley, START, objective="f", constraints=sides)
    sides["x"] = ([-np.inf, 0.7], None)
    best = mb.optimise(valley, {"x": [0.9, 0.5]}, objective="f", constraints=sides)
    np.testing.assert_allclose(best.parameters["x"], [np.sqrt(0.51), 0.7], atol=1e-6)
    assert [c.name for c in best.constraints] == ["square", "x[0]", "x[1]"]
    assert [c.active for c in best.constraints] == [True, False, True]


class Plain:
    size = 2

    def __call__(self, z):
        return {"x": z}


@pytest.mark.slow
def test_both_modes_of_derivatives_agree():
    forward, reverse = (
        Program(valley, Plain(), ("f", "x"), forward).linearised(jnp.ones(2))  # pyright: ignore
        for forward in (True, False)
    )
    for a, b in zip(forward, reverse, strict=True):
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-13), a, b)


@pytest.mark.slow
def test_the_mode_is_the_one_that_the_function_allows():
    """A simulation has both; a function with a rule of its own for reverse mode, and one with a loop, have one."""
    m = mb.mechanisms.get("pendulum")

    def speed(v):
        new = mb.with_parameters(m.system, v)
        motion = mb.simulate(new, m.state, t1=0.1, saveat=[0.05, 0.1], solver=diffrax.Tsit5(), throw=False)
        return jnp.sum(motion.ys.u[-1] ** 2)

    start = {"gravity.acceleration": [0.0, -9.81]}
    bounds = {"gravity.acceleration": ([-0.1, -20.0], [0.1, -1.0])}
    in_reverse = jax.custom_vjp(speed)
    in_reverse.defvjp(lambda v: jax.vjp(speed, v), lambda pull, c: pull(c))
    best = [mb.optimise(own, start, bounds=bounds, max_iterations=3) for own in (speed, in_reverse)]
    assert [b.derivatives for b in best] == ["forward", "reverse"]
    np.testing.assert_allclose(best[0].objective, best[1].objective, rtol=1e-6)
    a_loop = lambda v: by_a_loop(v["gravity.acceleration"])
    assert mb.optimise(a_loop, start, bounds=bounds, max_iterations=2).derivatives == "forward"
    neither = lambda v: a_loop(v) + in_reverse(v)
    with pytest.raises(ValueError, match=r"no derivatives in either mode.*custom_vjp.*loop"):
        mb.optimise(neither, start, bounds=bounds)


def by_a_loop(x):
    """A half of the sum of squares, of a loop that is not bounded."""
    return jax.lax.while_loop(lambda y: y[0] < 1.0, lambda y: (2 * y[0], y[1] / 2), (0.5, jnp.sum(x**2)))[1]


def edge(v):
    """Not a number from 0.5 on, where it leads to."""
    return jnp.where(v["x"] < 0.5, (v["x"] - 1.0) ** 2, jnp.nan)


@pytest.mark.slow("optax")
@pytest.mark.parametrize("method", ["slsqp", optax.sgd(0.4)], ids=METHODS)
def test_trials_that_fail_shorten_the_step(method):
    best = mb.optimise(edge, {"x": -3.0}, method=method, max_iterations=60)
    assert 0.45 < best.parameters["x"] < 0.5 and np.isfinite(best.objective)
    assert not best.success


def test_an_objective_that_leaps_up_is_no_optimum():
    """As where a mechanism is assembled on another branch: SciPy's method calls it a success."""
    leaping = lambda v: jnp.where(v["x"] < 0.5, (v["x"] - 1.0) ** 2, 40.0 + v["x"])
    best = mb.optimise(leaping, {"x": -3.0})
    assert 0.499 < best.parameters["x"] < 0.5
    assert not best.success and "leaps to 40.5" in best.message
    # A kink is an optimum.
    best = mb.optimise(lambda v: jnp.abs(v["x"] - 0.5) + 1e-3 * v["x"], {"x": -3.0})
    np.testing.assert_allclose(best.parameters["x"], 0.5, atol=1e-6)
    assert best.success


def test_a_design_that_bounds_forbid_names_them_after_a_few_trials():
    """The values scatter as those of a simulation, so that no line search ends by itself."""
    scatter = lambda x: 1e-6 * jax.lax.stop_gradient(jnp.sin(1e14 * x))
    wheel = lambda v: {"J": v["J"], "fluctuation": 1.88481475 / v["J"] * (1.0 + scatter(v["J"]))}
    limits = {"constraints": {"fluctuation": (None, 0.02)}, "bounds": {"J": (0.05, 50.0)}}
    best = mb.optimise(wheel, {"J": 5.0}, objective="J", **limits)
    assert not best.success and best.trials < 100 and best.parameters["J"] == pytest.approx(50.0)
    assert re.search(r"'fluctuation' is 0\.037\d*, above 0\.02, with 'J' at a bound$", best.message)


SADDLE = lambda v: v["x"] ** 2 - v["y"] ** 2 + v["y"] ** 4


STATIONARY = [
    # Whether also by optax; the function, its start, and what is said.
    (True, lambda v: -(v["x"] ** 2), {"x": 0.0}, "a maximum.*decreases where 'x'"),
    (False, lambda v: v["x"] ** 3, {"x": 0.0}, "not a minimum.*'x' decreases"),
    (True, SADDLE, {"x": 0.3, "y": 0.0}, "a saddle.*decreases where 'y'"),
    (False, lambda v: jnp.floor(5 * v["x"]), {"x": 1.3}, "exactly zero.*in steps"),
    (False, lambda v: 0 * v["x"] + 3.0, {"x": 1.3}, "does not change.*exactly zero"),
    (
        False,
        lambda v: jnp.sum(jnp.arange(1.0, 13.0).at[7].set(-8.0) * v["x"] ** 2),
        {"x": np.zeros(12)},
        r"saddle.*'x\[7\]'",
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["slsqp", optax.sgd(0.4)], ids=METHODS)
def test_a_stationary_point_that_is_no_minimum(method):
    for is_tried, function, start, words in STATIONARY:
        if is_tried or method == "slsqp":
            best = mb.optimise(function, start, method=method, max_iterations=2000)
            assert not best.success and re.search(words, best.message)


@pytest.mark.slow
def test_a_maximum_on_a_bound_and_on_constraints():
    best = mb.optimise(lambda v: -(v["x"] ** 2), {"x": 0.0}, bounds={"x": (0.0, 1.0)})
    assert not best.success and "where 'x' increases" in best.message
    circle = lambda v: {"x": v["x"], "square": v["x"] ** 2 + v["y"] ** 2}
    for bound in (1.0, (1.0, None)):
        best = mb.optimise(circle, {"x": 1.0, "y": 0.0}, objective="x", constraints={"square": bound})
        assert not best.success and "a maximum" in best.message and "'y'" in best.message
    best = mb.optimise(circle, {"x": 0.9, "y": 0.1}, objective="x", constraints={"square": 1.0})
    assert best.success and best.objective == pytest.approx(-1.0)


MINIMA = {
    "no curvature": (lambda v: (v["x"] - 1) ** 4, {"x": 1.0}, {}),
    "a valley": (lambda v: (v["x"] + v["y"] - 1) ** 2, {"x": 3.0, "y": 5.0}, {}),
    "no effect": (lambda v: (v["x"] - 1) ** 2 + 0 * v["y"], {"x": 0.0, "y": 1.0}, {}),
    "a corner": (lambda v: jnp.sum(v["x"]), {"x": [1.0, 1.0]}, {"bounds": {"x": (0.0, 2.0)}}),
    "concave to a bound": (lambda v: -(v["x"] ** 2), {"x": 0.1}, {"bounds": {"x": (-1.0, 2.0)}}),
    "constraints alone": (
        lambda v: {"f": 0 * v["x"], "c": v["x"] ** 2},
        {"x": 1.3},
        {"objective": "f", "constraints": {"c": 2.0}},
    ),
}


@pytest.mark.slow("a valley", "no effect", "a corner")
@pytest.mark.parametrize("name", MINIMA)
def test_minima_are_called_minima(name):
    function, start, options = MINIMA[name]
    assert mb.optimise(function, start, **options).success


def test_a_simulation_that_throws_is_a_trial_that_failed():
    import equinox as eqx

    thrown = lambda v: eqx.error_if((v["x"] - 1.0) ** 2, v["x"] > 0.5, "no further")
    best = mb.optimise(thrown, {"x": -3.0}, max_iterations=30)
    assert best.failed > 0 and 0.4 < best.parameters["x"] <= 0.5


def open_(v):
    """Not a number where the gap is positive."""
    x = v["x"]
    gap = jnp.maximum(jnp.hypot(x[0], x[1]) - 1.0, 0.0)
    return {"f": jnp.where(gap > 0, jnp.nan, (x[0] - 0.2) ** 2 + x[1] ** 2), "gap": gap, "room": -gap}


def test_a_start_that_fails_is_led_to_one_that_does_not():
    for limits in ({"gap": (None, 0)}, {"room": (0, None)}):
        best = mb.optimise(open_, {"x": [3.0, 2.0]}, objective="f", constraints=limits)
        assert best.success and np.isnan(best.before["f"]) and best.before["gap"] > 0
        np.testing.assert_allclose(best.parameters["x"], [0.2, 0.0], atol=1e-4)
        assert "led from the failed start" in best.message
    with pytest.raises(ValueError, match=r"'f' is not finite.*assembly_gap"):
        mb.optimise(open_, {"x": [3.0, 2.0]}, objective="f")
    with pytest.raises(ValueError, match="no violated constraint leads away"):
        mb.optimise(open_, {"x": [3.0, 2.0]}, objective="f", constraints={"gap": (None, 9.0)})


def hills(v):
    """Many valleys, the deepest at zero."""
    return {"f": jnp.sum(v["x"] ** 2 + 20.0 * (1 - jnp.cos(4.0 * v["x"])))}


@pytest.mark.slow
def test_several_starts_find_the_deepest_valley():
    one = mb.optimise(hills, {"x": [2.9, -3.1]}, bounds={"x": (-4.0, 4.0)})
    many = mb.optimise(hills, {"x": [2.9, -3.1]}, bounds={"x": (-4.0, 4.0)}, starts=64)
    assert one.objective > 1.0 and many.objective < 1e-8
    assert len(many.attempts) == 4 and many.attempts[0].after == min(a.after for a in many.attempts)
    with pytest.raises(ValueError, match=r"give 'x\[0\]' both"):
        mb.optimise(hills, {"x": [2.9, -3.1]}, starts=8)


@pytest.mark.slow
def test_design_variables_bring_bounds_and_scales():
    m = mb.mechanisms.get("pendulum")
    name = "gravity.acceleration"
    system = mb.design(
        m.system, {"g": mb.Variable(9.0, bounds=(5.0, 10.0))}, lambda v: {name: jnp.stack([0.0 * v["g"], -v["g"]])}
    )
    best = mb.optimise(lambda v: -mb.parameters(mb.with_parameters(system, v))[name][1], ["g"], system=system)
    assert best.parameters["g"] == 5.0 and best.start["g"] == 9.0
    narrower = mb.optimise(lambda v: v["g"], "g", system=system, bounds={"g": (6.0, None)})
    np.testing.assert_allclose(narrower.parameters["g"], 6.0)
    with pytest.raises(ValueError, match="reach beyond"):
        mb.optimise(lambda v: v["g"], ["g"], system=system, bounds={"g": (4.0, None)})
    with pytest.raises(ValueError, match="Unknown parameter 'h'"):
        mb.optimise(lambda v: v["g"], ["h"], system=system)


def landscape(v):
    """Two minima of equal depth, one of them wide."""
    depth = lambda x, at, width: jnp.exp(-(((x - at) / width) ** 2))
    return {"f": 1.0 + v["level"] - depth(v["x"], -1.0, 0.1) - depth(v["x"], 1.0, 1.0)}


@functools.cache
def scattered():
    rng = np.random.default_rng(0)
    return {"x": 0.2 * rng.standard_normal(64), "level": rng.uniform(-0.1, 0.1, 64)}


def test_robust_has_the_mean_and_the_spread_of_its_samples():
    samples = scattered()
    of_both = lambda x: (
        mb.robust(landscape, samples, weight=2.0)({"x": x}),
        landscape(samples | {"x": x + samples["x"]}),
    )
    out, exact = jax.jit(of_both)(-0.3)
    values = np.asarray(exact["f"])
    np.testing.assert_allclose(out["f.mean"], np.mean(values))
    np.testing.assert_allclose(out["f.spread"], np.std(values, ddof=1))
    np.testing.assert_allclose(out["f"], np.mean(values) + 2.0 * np.std(values, ddof=1))
    same = mb.robust(lambda v: v["x"] * 0.0, {"x": [0.0, 1.0]}, weight=1.0)
    assert float(jax.grad(lambda x: same({"x": x})["objective"])(1.0)) == 0.0
    for bad, message in (
        ({"x": [1.0]}, "at least two"),
        ({"x": [1.0, 2.0], "y": [1.0] * 3}, "equally many for every name"),
        ({}, "at least one"),
    ):
        with pytest.raises(ValueError, match=message):
            mb.robust(landscape, bad)


@pytest.mark.slow
def test_a_robust_design_is_in_the_wide_minimum():
    objective = mb.robust(landscape, scattered(), weight=2.0)
    best = mb.optimise(objective, {"x": -0.9}, objective="f", bounds={"x": (-2.0, 2.0)}, starts=16)
    assert 0.5 < best.parameters["x"] < 1.5


REFUSED = [
    ("Unknown output 'g'; there are 'f', 'square', 'x'", {"objective": "g"}),
    ("Name the objective", {}),
    ("must be a number, but 'x' has shape", {"objective": "x"}),
    ("did you mean 'square'", {"objective": "f", "constraints": {"squar": (0, 1)}}),
    ("low ≤ high", {"objective": "f", "constraints": {"square": (1, 0)}}),
    ("one of them None at most", {"objective": "f", "constraints": {"square": (None, None)}}),
    ("must be a real number, got an array", {"objective": "f", "constraints": {"square": (None, [1.0, 2.0])}}),
    ("low < high", {"objective": "f", "bounds": {"x": (1.0, 0.0)}}),
    ("not within its bounds", {"objective": "f", "bounds": {"x": (0.0, 2.0)}}),
    ("Unknown parameter with bounds 'y'", {"objective": "f", "bounds": {"y": (0.0, 2.0)}}),
    ("must be a pair", {"objective": "f", "bounds": {"x": 2.0}}),
    ("method must be", {"objective": "f", "method": "newton"}),
    ("'slsqp' now", {"objective": "f", "method": "bfgs"}),
    ("need method='slsqp'", {"objective": "f", "method": optax.sgd(0.1), "constraints": {"square": (0, 1)}}),
    ("starts must be", {"objective": "f", "starts": 0}),
    ("starts must be", {"objective": "f", "starts": True}),
    ("tol must be positive", {"objective": "f", "tol": 0.0}),
    ("strictly within", {"objective": "f", "method": optax.sgd(0.1), "bounds": {"x": (-1.2, 2.0)}}),
    ("no argument 'local' any more: the best four", {"local": 1}),
    ("no argument 'derivatives' any more: the cheaper mode", {"derivatives": 1}),
]
# Functions and starts.
STARTS = [
    (valley, {}, "empty"),
    (valley, ["x"], "system="),
    (valley, {"x": [np.nan, 1.0]}, "NaN"),
    (valley, {"x": "far"}, "real number"),
    (lambda v: {"f": None}, START, "must return a number"),
]


def test_what_optimise_refuses():
    for message, options in REFUSED:
        with pytest.raises((ValueError, TypeError), match=message):
            mb.optimise(valley, START, **options)
    for function, start, message in STARTS:
        with pytest.raises(ValueError, match=message):
            mb.optimise(function, start, objective="f")


def test_a_number_that_the_function_reads_may_change():
    numbers = {"k": 1.0}
    function = lambda values: (values["x"] - numbers["k"]) ** 2
    best = lambda: mb.optimise(function, {"x": 0.0}).parameters["x"]
    np.testing.assert_allclose(best(), 1.0, atol=1e-6)
    numbers["k"] = 3.0
    np.testing.assert_allclose(best(), 3.0, atol=1e-6)


@pytest.mark.slow
def test_rows_of_the_log_are_accepted_or_tried():
    """Rosenbrock's valley from a start beyond its bend, where a method with momentum goes up."""
    valley = lambda p: {"f": (1.0 - p["x"]) ** 2 + 100.0 * (p["y"] - p["x"] ** 2) ** 2}
    best = mb.optimise(valley, {"x": -1.2, "y": 1.0}, objective="f", method=optax.adam(0.3), max_iterations=8)
    least = np.inf
    for row in best.iterations:
        assert row.accepted == (row.objective <= least)
        least = min(least, row.objective)
    assert {row.accepted for row in best.iterations} == {True, False}
    rows = [line.split() for line in str(best).splitlines()]
    marks = {row[0]: row[-1] for row in rows if row and row[-1] in ("accepted", "tried")}
    assert all(marks[str(i.number)] == ("accepted" if i.accepted else "tried") for i in best.iterations)
