"""Optimal control of a four-bar linkage against exact optima: values, prices, derivatives, phases, messages."""

import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.studies.plan.courses import COURSES
from jaxmb.studies.plan.guess import Guess
from jaxmb.studies.plan.solve import arcs_of

MOST_PROGRAMS = 120

# Exact optima of the linkage without gravity, turned by half a turn from rest to rest. Work and inertia alone determine
# the least time, T = ∫ √(M / 2 τ Δθ) dθ, with the switch where the works of both torques are equal; Pontryagin's
# equations in one coordinate, solved by `scipy.integrate.solve_bvp` at 1e-8, the least effort in two seconds.
LEAST_TIME, SWITCH, BY_LENGTH = 2.6639894054, 1.5702019682, -0.1036951
LEAST_EFFORT, FIRST_TORQUE, LAST_TORQUE = 18.987353952, 5.336762213, -5.336762214
REST, TURNED = ({"crank.angle": angle, "crank.angle_rate": 0.0} for angle in (1.57, 1.57 + np.pi))
FREE, BOUNDED = {"motor.force": None}, {"motor.force": (-2.0, 2.0)}


def linkage(length=2.0):
    """Uniform bars of 1 kg, with a motor at the ground pivot of the crank."""
    bar = lambda name, size, position, angle: planar.Body(
        name, mass=1.0, inertia=planar.rod(1.0, size), position=position, angle=angle
    )
    bodies = [
        bar("crank", 1.0, (0.0, 0.5), 1.57),
        bar("coupler", length, (1.0, 1.4), 0.4),
        bar("rocker", 1.8, (2.2, 0.9), 1.8),
    ]
    pins = [
        planar.Revolute("A", "ground", "crank", point_a=(0.0, 0.0), point_b=(-0.5, 0.0)),
        planar.Revolute("B", "crank", "coupler", point_a=(0.5, 0.0), point_b=(-0.5 * length, 0.0)),
        planar.Revolute("C", "coupler", "rocker", point_a=(0.5 * length, 0.0), point_b=(0.9, 0.0)),
        planar.Revolute("D", "ground", "rocker", point_a=(2.5, 0.0), point_b=(-0.9, 0.0)),
    ]
    return mb.Scene(bodies, joints=pins, forces=[mb.JointForce("motor", "A.angle", force=0.0)]).compile()


@pytest.fixture(scope="module")
def system():
    return linkage()


@pytest.fixture(scope="module")
def planned(system):
    """Plans by their options, each made once."""

    @functools.cache
    def plan(kind, intervals, interpolation="linear"):
        options = {"start": REST, "end": TURNED, "intervals": intervals, "interpolation": interpolation}
        if kind == "time":
            return mb.plan(system, controls=BOUNDED, duration=(1.0, 5.0), final="time", moving=True, **options)
        return mb.plan(system, controls=FREE, duration=2.0, running="effort", **options)

    return plan


@pytest.mark.slow("32")
@pytest.mark.parametrize("most", [pytest.param(16, id="16"), pytest.param(32, id="32")])
def test_plan_of_least_effort_converges_to_the_exact_optimum_as_the_fourth_power_of_the_interval(planned, most):
    coarse, fine = (planned("effort", intervals) for intervals in (most // 2, most))
    errors = np.array([coarse.objective, fine.objective]) - LEAST_EFFORT
    assert coarse.success and fine.success and 0 < errors[1] < 3e-6 * (32 / most) ** 4
    assert errors[0] > 11.0 * errors[1]
    torques = np.asarray(fine.controls["motor.force"].values)[[0, -1]]
    np.testing.assert_allclose(torques, [FIRST_TORQUE, LAST_TORQUE], atol=0.01 * (32 / most) ** 2)


@pytest.mark.slow
def test_plan_simulated_in_one_run_arrives_at_its_end_on_the_constraints(planned):
    plan = planned("effort", 8)
    assert plan.arrival < 1e-7 and plan.integration_error < 1e-8
    np.testing.assert_allclose(plan.trajectory["crank"].angle[-1], 1.57 + np.pi, rtol=0, atol=1e-7)
    assert np.max(np.abs(plan.trajectory.constraint_violation.position)) < 1e-12
    assert "motor.force" in str(plan) and "converged" in str(plan) and plan.active == ()


def test_refined_plan_has_twice_the_intervals(planned):
    finer = planned("effort", 8).refined()
    assert finer.success and len(finer.ts) == 17
    np.testing.assert_allclose(finer.objective, planned("effort", 16).objective, rtol=1e-9)


@pytest.mark.slow
def test_refined_plan_of_least_time_moves_its_nodes(planned):
    moved = planned("time", 6, "held").refined()
    assert moved.success and len(moved.ts) == 13
    np.testing.assert_allclose(moved.objective, LEAST_TIME, rtol=1e-6)


@pytest.mark.slow
def test_plan_of_least_time_switches_at_the_exact_time(planned):
    plan = planned("time", 6, "held")
    torque = np.asarray(plan.controls["motor.force"].values)[:-1]
    switch = plan.ts[int(np.argmax(torque < 0))]
    np.testing.assert_allclose([plan.objective, switch], [LEAST_TIME, SWITCH], rtol=1e-6)
    np.testing.assert_allclose(np.abs(torque), 2.0, rtol=1e-6)
    assert plan.active == ("motor.force",) and plan.duration == plan.objective


@pytest.mark.slow
def test_derivative_of_the_least_time_by_a_length_follows_from_multipliers(planned):
    """The exact derivative, at a constant mass of the coupler."""
    slopes = planned("time", 6, "held").derivatives("B.point_b", "C.point_a", "coupler.inertia")
    of_inertia = jax.grad(lambda length: planar.rod(1.0, length))(2.0)
    by_length = -0.5 * slopes["B.point_b"][0] + 0.5 * slopes["C.point_a"][0] + slopes["coupler.inertia"] * of_inertia
    np.testing.assert_allclose(by_length, BY_LENGTH, rtol=1e-5)


def test_derivatives_of_an_optimum_are_differences_of_optima(system, planned):
    plan, aside = planned("effort", 8), 1e-3
    heavier, lighter = (
        mb.plan(
            mb.with_parameters(system, {"coupler.mass": 1.0 + change}),
            controls=FREE,
            duration=2.0,
            running="effort",
            start=REST,
            end=TURNED,
            intervals=8,
            guess=plan,
        )
        for change in (aside, -aside)
    )
    sensitivity = plan.sensitivities("coupler.mass")["coupler.mass"]
    difference = (heavier.objective - lighter.objective) / (2 * aside)
    np.testing.assert_allclose(sensitivity.objective, difference, rtol=1e-6)
    np.testing.assert_allclose(plan.derivatives("coupler.mass")["coupler.mass"], difference, rtol=1e-6)
    torques = [np.asarray(p.controls["motor.force"].values) for p in (heavier, lighter)]
    by_mass = sensitivity.controls["motor.force"]
    np.testing.assert_allclose(by_mass, (torques[0] - torques[1]) / (2 * aside), rtol=0, atol=1e-5)
    slope = jax.grad(lambda mass: plan.objective_of({"coupler.mass": mass}))(1.0)
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


def test_plan_to_another_branch_of_the_constraints_does_not_succeed(system):
    """The crank does not tell the open linkage from the crossed one, and no motion leads from one to the other."""
    here = mb.assemble(system, fix={"crank.angle": 1.57})
    crank, rocker = np.array([np.cos(1.57), np.sin(1.57)]), np.array([2.5, 0.0])
    pin = rocker + 1.8 * np.array([np.cos(here.q[8]), np.sin(here.q[8])])
    along = (rocker - crank) / np.linalg.norm(rocker - crank)
    mirrored = crank + 2 * along * np.dot(pin - crank, along) - (pin - crank)
    angles = [np.arctan2(*(mirrored - pivot)[::-1]) for pivot in (crank, rocker)]
    places = [*here.q[:3], *(crank + mirrored) / 2, angles[0], *(rocker + mirrored) / 2, angles[1]]
    crossed = mb.State(np.array(places), np.asarray(here.u))
    np.testing.assert_allclose(system.coordinate_residual(0.0, crossed.q), 0.0, atol=1e-12)
    plan = mb.plan(system, controls=FREE, duration=2.0, running="effort", start=here, end=crossed, intervals=8)
    assert not plan.success and "at t = 2 s the motion would jump" in plan.message


@pytest.mark.slow
def test_prices_of_ends_and_of_the_duration_are_differences_of_optima(system, planned):
    plan, aside = planned("effort", 8), 1e-3
    again = functools.partial(mb.plan, system, controls=FREE, running="effort", start=REST, intervals=8, guess=plan)
    further, nearer = (
        again(duration=2.0, end={**TURNED, "crank.angle": 1.57 + np.pi + change}).objective
        for change in (aside, -aside)
    )
    np.testing.assert_allclose(plan.prices["end crank.angle"], (further - nearer) / (2 * aside), rtol=1e-5)
    later, sooner = (again(duration=2.0 + change, end=TURNED).objective for change in (aside, -aside))
    np.testing.assert_allclose(plan.derivatives("duration")["duration"], (later - sooner) / (2 * aside), rtol=1e-5)


@pytest.mark.slow
def test_bounds_along_the_way_hold_at_nodes_and_their_violation_between_is_told(system):
    slow = {"crank.angle_rate": (None, 1.8)}
    options = {"duration": (1.0, 5.0), "final": "time", "start": REST, "end": TURNED, "path": slow}
    plan = mb.plan(system, controls=BOUNDED, intervals=16, **options)
    rates = np.asarray(plan.states.u)[:, 2]
    assert plan.success and np.max(rates) <= 1.8 + 1e-7 and plan.objective > LEAST_TIME
    assert "crank.angle_rate" in plan.active and 0 < plan.violation["crank.angle_rate"] < 0.1


@pytest.mark.slow
def test_parameters_are_optimised_with_controls(system, planned):
    """Less mass needs less torque: the coupler's mass is at its lower bound."""
    options = {"controls": FREE, "duration": 2.0, "running": "effort", "start": REST, "end": TURNED, "intervals": 8}
    plan = mb.plan(system, design={"coupler.mass": (0.5, 2.0)}, **options)
    light = planned("effort", 8).objective_of({"coupler.mass": 0.5})
    np.testing.assert_allclose(plan.parameters["coupler.mass"], 0.5, rtol=1e-6)
    np.testing.assert_allclose(plan.objective, light, rtol=1e-7)


@pytest.mark.slow
def test_phases_of_one_system_are_one_plan_and_a_load_changes_the_second(system, planned):
    half = lambda system: mb.Phase(system, controls=FREE, duration=1.0, running="effort", intervals=4)
    whole = mb.plan_phases([half(system), half(system)], start=REST, end=TURNED)
    # The torque may jump between phases.
    assert whole.success and planned("effort", 8).objective - 1e-3 < whole.objective < planned("effort", 8).objective
    loaded = mb.plan_phases(
        [half(system), half(mb.with_parameters(system, {"coupler.mass": 2.0}))], start=REST, end=TURNED
    )
    first, second = loaded.phases
    assert loaded.success and loaded.objective > whole.objective
    np.testing.assert_allclose(first.states.u[-1], second.states.u[0], rtol=0, atol=1e-8)
    assert max(first.arrival, second.arrival) < 1e-6


@pytest.mark.slow
def test_slsqp_finds_the_plan_of_ipopt(system, planned):
    options = {"controls": FREE, "duration": 2.0, "running": "effort", "start": REST, "end": TURNED, "intervals": 8}
    plan = mb.plan(system, method="slsqp", tol=1e-10, **options)
    np.testing.assert_allclose(plan.objective, planned("effort", 8).objective, rtol=1e-7)
    np.testing.assert_allclose(
        plan.prices["end crank.angle"], planned("effort", 8).prices["end crank.angle"], rtol=1e-4
    )


@pytest.mark.slow
def test_plan_by_cubic_controls_meets_the_exact_optimum_with_few_intervals(planned):
    plan = planned("effort", 16, "cubic")
    np.testing.assert_allclose(plan.objective, LEAST_EFFORT, rtol=1e-8)
    values, slopes = plan.controls["motor.force"].values, plan.controls["motor.force"].slopes
    np.testing.assert_allclose([values[0], values[-1]], [FIRST_TORQUE, LAST_TORQUE], atol=1e-3)
    assert slopes.shape == values.shape


@pytest.mark.slow
def test_parameters_alone_are_planned():
    """The least stiffness by which a slider of 2 kg comes from rest to the middle in a second, (π / 2)² m."""
    slider = planar.Body("slider", mass=2.0, inertia=1.0, position=(1.0, 0.0))
    rail = planar.Prismatic("rail", "ground", "slider", point=(0.0, 0.0), axis=(1.0, 0.0))
    spring = planar.Bushing(
        "spring", "ground", "slider", point_a=(0.0, 0.0), point_b=(0.0, 0.0), stiffness=(4.0, 0.0, 0.0)
    )
    system = mb.Scene([slider], joints=[rail], forces=[spring]).compile()
    name = next(name for name in mb.parameters(system) if "stiffness" in name)
    bounds = ((0.5, 0.0, 0.0), (50.0, 0.0, 0.0))
    ends = {"start": {"slider.x": 1.0, "slider.x_rate": 0.0}, "end": {"slider.x": 0.0}}
    least = lambda at: at[name][0]
    plan = mb.plan(system, controls={}, design={name: bounds}, duration=1.0, final=least, intervals=4, **ends)
    assert plan.success and plan.objective == pytest.approx(2.0 * (np.pi / 2) ** 2, rel=1e-8)


@pytest.mark.slow
def test_phases_catch_a_load_by_its_impulse():
    """A slider catches a resting one of its mass after half a metre, and both come to rest after another half metre.

    Oracle: the least ∫ F² dt over d with velocities v and 0 at the ends is 4 m² (3 d² − 3 d v T + v² T²) / T³, and the
    velocity halves where the sliders meet; the sum is minimised over v.
    """
    bodies = [
        planar.Body(name, mass=1.0, inertia=1.0, position=(x, 0.0)) for name, x in (("slider", 0.0), ("load", 1.0))
    ]
    rail = planar.Prismatic("rail", "ground", "slider", point=(0.0, 0.0), axis=(1.0, 0.0))
    forces = [mb.JointForce("push", "rail.displacement", force=0.0)]
    resting = planar.Fixed("rest", "ground", "load", point=(1.0, 0.0))
    caught = planar.Fixed("catch", "slider", "load", point_a=(0.5, 0.0), point_b=(0.0, 0.0))
    alone, together = (mb.Scene(bodies, joints=[rail, joint], forces=forces).compile() for joint in (resting, caught))
    phase = lambda system, **options: mb.Phase(
        system, controls={"push.force": None}, duration=1.0, running="effort", intervals=4, **options
    )
    phases = [phase(alone, end={"slider.x": 0.5}), phase(together)]
    start, end = ({"slider.x": x, "slider.x_rate": 0.0} for x in (0.0, 1.0))
    plan = mb.plan_phases(phases, start=start, end=end)
    effort = lambda mass, v: 4 * mass**2 * (3 * 0.5**2 - 3 * 0.5 * v + v**2)
    speeds = np.linspace(0.0, 2.0, 200001)
    total = effort(1.0, speeds) + effort(2.0, speeds / 2)
    assert plan.success
    np.testing.assert_allclose(plan.objective, total.min(), rtol=1e-8)
    before, after = (np.asarray(one.states.u)[k] for one, k in zip(plan.phases, (-1, 0), strict=True))
    np.testing.assert_allclose(
        [before[0], after[0], after[3]], speeds[total.argmin()] * np.array([1, 0.5, 0.5]), atol=1e-4
    )
    # Without the meeting place as an end the load would jump.
    apart = mb.plan_phases([phase(alone), phase(together)], start=start, end=end)
    assert not apart.success and "'load.x' jumps by" in apart.message


@pytest.mark.slow
def test_plan_that_would_strike_a_stop_says_so():
    """A slider from rest to rest in two seconds, with a stop that it passes, or does not meet."""

    def plan(place):
        slider = planar.Body("slider", mass=1.0, inertia=1.0)
        rail = planar.Prismatic("rail", "ground", "slider", point=(0.0, 0.0), axis=(1.0, 0.0))
        stop = mb.Stop("stop", "rail.displacement", upper=place)
        forces = [mb.JointForce("push", "rail.displacement", force=0.0)]
        system = mb.Scene([slider], joints=[rail, stop], forces=forces).compile()
        ends = ({"slider.x": x, "slider.x_rate": 0.0} for x in (0.0, 1.0))
        options = {"duration": 2.0, "running": "effort", "intervals": 4}
        return mb.plan(
            system, controls={"push.force": None}, **dict(zip(("start", "end"), ends, strict=True)), **options
        )

    struck, free = plan(0.5), plan(2.0)
    assert not struck.success and "'stop' has the event 'impact' at t = 1" in struck.message
    # The force is linear in time, from 6 x / T² to its opposite, ∫ F² dt = 12 m² x² / T³.
    assert free.success and free.objective == pytest.approx(1.5, rel=1e-9)


GOOD = {"controls": FREE, "duration": 2.0, "running": "effort", "start": REST, "end": TURNED, "intervals": 4}
REFUSED = [
    ({"controls": {"motor.forc": None}}, "Unknown control 'motor.forc'; did you mean 'motor.force'?"),
    ({"controls": {}}, "there is nothing to choose"),
    ({"controls": ["motor.force"]}, "controls must be bounds by the names of parameters"),
    ({"controls": {"motor.force": (2.0, -2.0)}}, "must be (low, high) with low"),
    ({"controls": {"crank.mass": None}}, "crank.mass"),
    ({"duration": 0.0}, "duration must be a positive number of seconds"),
    ({"duration": (3.0, 1.0)}, "duration"),
    ({"running": None}, "there is nothing to minimise"),
    ({"running": "time"}, "got 'time'"),
    ({"interpolation": "square"}, "interpolation must be 'held', 'linear' or 'cubic'"),
    ({"intervals": 0}, "intervals must be an integer of at least 1"),
    ({"intervals": [0.0, 0.7, 0.5, 1.0]}, "ascending shares from 0 to 1"),
    ({"end": {"crank.angel": 1.0}}, "Unknown quantity 'crank.angel'; did you mean 'crank.angle'?"),
    ({"end": {"crank.angle": 9.0, "rocker.angle": 9.0}}, "contradicts the constraints"),
    ({"start": {**REST, "rocker.angle_rate": 0.0}}, "conditions of the start depend on each other"),
    ({"path": {"motor.power": (0.0, 1.0)}}, "Unknown quantity 'motor.power'"),
    ({"design": {"motor.force": (0.0, 1.0)}}, "is a control and a designed parameter"),
    ({"design": {"crank.mass": (2.0, 3.0)}}, "not within its bounds"),
    ({"method": "newton"}, "method must be 'ipopt' or 'slsqp'"),
    ({"guess": {"crank.angl": 1.0}}, "Unknown coordinate 'crank.angl'"),
    ({"tol": 0.0}, "tol must be positive"),
]


@pytest.mark.slow("contradicts the constraints", "conditions of the start depend")
@pytest.mark.parametrize(("change", "words"), REFUSED, ids=[words[:30] for _, words in REFUSED])
def test_plan_refuses(system, change, words):
    with pytest.raises((ValueError, KeyError)) as error:
        mb.plan(system, **{**GOOD, **change})
    assert words in str(error.value)


def test_ctrl_c_returns_the_plan_so_far(system, monkeypatch):
    lines = []

    def interrupt(text, **options):
        del options
        lines.append(text)
        if len(lines) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr("builtins.print", interrupt)
    plan = mb.plan(system, verbose=True, **GOOD)
    assert not plan.success and plan.message == "interrupted" and len(lines) == 2
    assert np.all(np.isfinite(plan.states.q)) and jnp.shape(plan.states.q) == (5, 9)


@pytest.mark.parametrize("kind", COURSES)
def test_courses_are_their_series_on_each_interval(kind):
    course, ts = COURSES[kind], np.array([0.0, 0.5, 1.5, 2.0])
    numbers = np.random.default_rng(0).standard_normal((course.count(3), 2))
    series = course.series(ts, numbers)
    places, shares = course.places(3), np.array([0.0, 0.3, 0.9])
    lengths, weights = np.diff(ts), course.weights(ts / 2.0)
    times = ts[:3, None] + lengths[:, None] * shares
    known = np.asarray(jax.jit(jax.vmap(jax.vmap(series)))(times))
    for k in range(3):
        powers = np.stack(course.powers(weights[k][:, None] * numbers[places[k]]))
        values = np.stack([np.sum(share ** np.arange(len(powers))[:, None] * powers, axis=0) for share in shares])
        np.testing.assert_allclose(values, known[k], rtol=0, atol=1e-12)
    nodes = numbers[course.values(3)]
    np.testing.assert_allclose(nodes[:3], known[:, 0], rtol=0, atol=1e-12)
    assert course.numbers(nodes, nodes).shape == numbers.shape


def test_arcs_begin_where_a_held_control_switches():
    """At a jump, and at the larger one of two jumps beside a value between the bounds; not where it drifts."""
    values = np.array([2.0, 2.0, 1.5, -2.0, -2.0, -1.95, -1.9, 2.0, 2.0])
    found = Guess(None, np.arange(10.0), (values[:, None],), np.zeros(0))
    task = types.SimpleNamespace(intervals=9)
    assert arcs_of(task, found) == (0, 3, 7, 9)
