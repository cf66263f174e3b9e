"""Plans of many kinds of systems against closed forms: bounds, forces of time, angles in space, turns, friction."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, optimize

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.studies.plan import lanes, solvers
from jaxmb.studies.plan.guess import first_guess
from jaxmb.studies.plan.plan import task_of
from jaxmb.studies.plan.transcription import Transcription

MOST_PROGRAMS = 120
PUSHED = {"push.force": (-5.0, 5.0)}


def sliding(*forces, mass=1.0, joints=()):
    """A slider along x."""
    slider = planar.Body("slider", mass=mass, inertia=1.0)
    rail = planar.Prismatic("rail", "ground", "slider", point=(0.0, 0.0), axis=(1.0, 0.0))
    push = mb.JointForce("push", "rail.displacement", force=0.0)
    return mb.Scene([slider], joints=[rail, *joints], forces=[push, *forces]).compile()


def moved(system, controls, distance=1.0, **options):
    """The plan of least effort from rest to rest in a second."""
    start, end = ({"slider.x": x, "slider.x_rate": 0.0} for x in (0.0, distance))
    options = {"duration": 1.0, "running": "effort", "intervals": 6, **options}
    return mb.plan(system, controls=controls, start=start, end=end, **options)


@pytest.fixture(scope="module")
def system():
    return sliding()


@functools.cache
def bounded_effort():
    """The least ∫ F² dt of a unit mass over a unit length in a second with |F| ≤ 5: F = s (1/2 − t), clipped."""
    ts = np.linspace(0.0, 1.0, 200001)
    force = lambda slope: np.clip(slope * (0.5 - ts), -5.0, 5.0)
    slope = optimize.brentq(lambda s: integrate.simpson((1 - ts) * force(s), x=ts) - 1.0, 1.0, 100.0)
    return integrate.simpson(force(slope) ** 2, x=ts)


@pytest.mark.slow
def test_bounds_of_cubic_controls_hold_between_nodes(system):
    plan = moved(system, PUSHED, interpolation="cubic", intervals=8)
    force = jax.vmap(plan.controls["push.force"])(jnp.linspace(0.0, 1.0, 2001))
    assert plan.success and np.max(np.abs(force)) < 5.0 + 1e-6
    assert plan.active == ("push.force",)
    assert 0 < plan.objective / bounded_effort() - 1 < 2e-3


@pytest.mark.slow
def test_sensitivities_at_active_bounds_are_differences_of_optima(system):
    plan, aside = moved(system, PUSHED, intervals=7), 1e-3
    found = plan.sensitivities("slider.mass")["slider.mass"]
    again = functools.partial(moved, controls=PUSHED, intervals=7, guess=plan)
    heavier, lighter = (again(mb.with_parameters(system, {"slider.mass": 1.0 + x})) for x in (aside, -aside))
    assert plan.active == heavier.active == lighter.active == ("push.force",)
    difference = lambda of: (of(heavier) - of(lighter)) / (2 * aside)
    np.testing.assert_allclose(found.objective, difference(lambda plan: plan.objective), rtol=1e-5)
    slopes = difference(lambda plan: np.asarray(plan.controls["push.force"].values))
    assert np.count_nonzero(np.abs(slopes) < 1e-4) in (2, 4) and np.max(np.abs(slopes)) > 1.0
    np.testing.assert_allclose(found.controls["push.force"], slopes, rtol=0, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [pytest.param(2, id="two"), pytest.param(3, id="three")])
def test_exact_second_derivatives_of_an_interval_are_differences_of_first_derivatives(monkeypatch, steps):
    """With a swinging load and a running cost."""
    load = planar.Body("load", mass=1.0, inertia=0.1, position=(0.3, -0.4))
    hook = planar.Revolute("hook", "slider", "load", point=(0.0, 0.0))
    slider = planar.Body("slider", mass=1.0, inertia=1.0)
    rail = planar.Prismatic("rail", "ground", "slider", point=(0.0, 0.0), axis=(1.0, 0.0))
    forces = [mb.JointForce("push", "rail.displacement", force=0.0), mb.Gravity((0.0, -9.81))]
    swinging = mb.Scene([slider, load], joints=[rail, hook], forces=forces).compile()
    free = mb.assemble(swinging)
    running = lambda at: at["push.force"] ** 2 * at["load.x"]
    options = {"duration": (0.5, 2.0), "objective": (running, None), "nodes": (2, "cubic"), "ends": (free, {})}
    task = task_of(swinging, controls={"push.force": None}, **options)
    made = Transcription.of(task, first_guess(task, {"push.force": lambda t: 3.0 - t}), 2)
    block, random = made.problem.terms[0].block, np.random.default_rng(0)
    inputs = made.problem.terms[0].at(made.start)
    inputs += 0.1 * random.standard_normal(inputs.shape)
    block.steps = steps
    outputs, first = block.linearised(inputs)
    weights = random.standard_normal(outputs.shape)
    scales = np.ones(inputs.shape)
    differences = block.curvature(inputs, first, weights, scales, central=True)
    with monkeypatch.context() as patch:
        patch.setattr(lanes, "_MANY", 1)
        exact = block.curvature(inputs, first, weights, scales)
    assert np.max(np.abs(exact)) > 0.1
    np.testing.assert_allclose(exact, exact.transpose(0, 2, 1), rtol=0, atol=1e-12)
    np.testing.assert_allclose(exact, differences, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_required_forces_of_a_motion_are_a_feasible_guess():
    bar = planar.Body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    forces = [mb.JointForce("motor", "pin.angle", force=0.0), mb.Gravity((0.0, -9.81))]
    system = mb.Scene([bar], joints=[pin], forces=forces).compile()
    ts = np.linspace(0.0, 1.0, 5)
    torque = {"motor.force": mb.Series(ts, [7.0, 6.0, 1.0, 2.0, 3.0])}
    motion = mb.simulate(mb.with_inputs(system, torque), mb.assemble(system), t1=1.0, saveat=ts, rtol=1e-10)
    needed = mb.required_forces(system, motion, by=["motor.force"])
    start, end = (jax.tree.map(lambda y, k=k: y[k], motion.ys) for k in (0, -1))
    options = {"controls": {"motor.force": None}, "duration": 1.0, "running": "effort", "intervals": 4}
    first = [
        mb.plan(system, start=start, end=end, guess=guess, max_iterations=1, **options).iterations[0].violation
        for guess in (motion, needed)
    ]
    assert first[1] < 1e-6 < 1e-2 < first[0]
    with pytest.raises(ValueError, match=r"Unknown control 'pin.angle'"):
        other = mb.required_forces(system, motion, by=["pin.angle"])
        mb.plan(system, start=start, end=end, guess=other, **options)


@pytest.fixture(scope="module")
def hinged():
    """A disc on an axle in space, with an eccentric mass."""
    disc = spatial.Body("disc", mass=2.0, inertia=(0.3, 0.3, 0.5), position=(0.1, 0.0, 0.0))
    axle = spatial.Revolute("axle", "ground", "disc", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    forces = [mb.JointForce("motor", "axle.angle", force=0.0), mb.Gravity((0.0, 0.0, 0.0))]
    return mb.Scene([disc], joints=[axle], forces=forces).compile()


@pytest.mark.slow
@pytest.mark.parametrize("angle", [np.pi, 3.5])
def test_angle_in_space_at_the_end_counts_turns(hinged, angle):
    """The torque is linear in time, ∫ τ² dt = 12 J² φ² / T³."""
    start, end = ({"axle.angle": x, "axle.angle_rate": 0.0} for x in (0.0, angle))
    options = {"duration": 2.0, "running": "effort", "intervals": 6, "path": {"axle.angle": (-9.0, 9.0)}}
    plan = mb.plan(hinged, controls={"motor.force": None}, start=start, end=end, **options)
    assert plan.success and plan.objective == pytest.approx(12 * 0.52**2 * angle**2 / 8, rel=1e-8)
    assert plan.violation == {"axle.angle": 0.0}
    np.testing.assert_allclose(plan.trajectory.quantity("axle.angle")[-1], angle, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_periodic_plan_in_space_ends_after_a_turn(hinged):
    """Against gravity, a free turn in the same time needs no torque; Euler parameters have the other sign then."""
    system = mb.with_parameters(hinged, {"gravity.acceleration": (0.0, -9.81, 0.0)})
    turn = {"axle.angle": lambda t: np.pi * t}
    options = {"duration": 2.0, "running": "effort", "periodic": True, "intervals": 16}
    plan = mb.plan(system, controls={"motor.force": None}, start={"axle.angle": 0.0}, guess=turn, **options)
    assert plan.success and plan.objective < 1e-8
    np.testing.assert_allclose(plan.states.u[-1], plan.states.u[0], rtol=0, atol=1e-7)
    np.testing.assert_allclose(plan.trajectory.quantity("axle.angle")[-1], 2 * np.pi, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_plan_of_a_lagrangian_system():
    system = mb.lagrangian.LagrangianSystem(
        lambda t, q, v, p: 0.5 * v[0] ** 2,
        q=[0.0],
        coordinates=["theta"],
        force=lambda t, q, v, p: p["torque"][None],
        parameters={"torque": 0.0},
    )
    start, end = ({"theta": x, "theta_rate": 0.0} for x in (0.0, 1.0))
    options = {"duration": 1.0, "running": "effort", "intervals": 4}
    plan = mb.plan(system, controls={"torque": None}, start=start, end=end, **options)
    assert plan.success and plan.objective == pytest.approx(12.0, rel=1e-9)


@pytest.mark.slow
def test_plan_knows_forces_of_time():
    """A wind w(t); the best force is linear in time."""
    system = sliding(mb.JointForce("wind", "rail.displacement", force=0.0))
    wind = lambda t: 3.0 * jnp.sin(2.0 * t)
    plan = moved(mb.with_inputs(system, {"wind.force": wind}), {"push.force": None}, t0=1.0)
    ts = np.linspace(1.0, 2.0, 20001)
    of_wind = [integrate.simpson(weight * np.asarray(wind(ts)), x=ts) for weight in (np.ones(ts.size), 2.0 - ts)]
    of_line = np.array([[1.0, 0.5], [0.5, 1.0 / 6.0]])
    line = np.linalg.solve(of_line, np.array([0.0, 1.0]) - of_wind)
    force = np.asarray(plan.controls["push.force"].values)
    assert plan.success and plan.ts[0] == 1.0
    np.testing.assert_allclose(force, line[0] + line[1] * (plan.ts - 1.0), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_plan_takes_variables_of_a_design(system):
    """The effort is 12 m², with the mass m as the third power of the size."""
    size = {"size": mb.Variable(1.0, bounds=(0.8, 1.2), unit="m")}
    machine, free = mb.design(system, size, lambda v: {"slider.mass": v["size"] ** 3}), {"push.force": None}
    smaller = moved(machine, free, design={"size": (0.8, 1.2)}, intervals=2)
    assert smaller.success and smaller.objective == pytest.approx(12 * 0.8**6, rel=1e-6)
    assert moved(machine, free, intervals=2).derivatives("size")["size"] == pytest.approx(72.0, rel=1e-8)


@pytest.mark.slow
def test_plan_names_dry_friction_that_changes():
    """At rest friction sticks; from a state of slip on, the force is linear in time, and works against friction."""
    system = sliding(mb.JointFriction("rub", "rail.displacement", force=0.5, exact=True))
    free = {"push.force": None}
    stuck = moved(system, free, intervals=2)
    assert not stuck.success and "'rub' has the event 'slip at start' at t = 0" in stuck.message
    rest = mb.assemble(system)
    start = mb.State(rest.q.at[3].set(1.0), rest.u.at[0].set(0.1))
    end, options = {"slider.x": 1.0, "slider.x_rate": 0.0}, {"duration": 1.0, "running": "effort", "intervals": 2}
    plan = mb.plan(system, controls=free, start=start, end=end, **options)
    assert plan.success and plan.objective == pytest.approx(10.99, rel=1e-8)


def test_plan_refuses_controls_of_constraints():
    driven = sliding(joints=[mb.JointDriver("drive", "rail.displacement", value=0.0)])
    with pytest.raises(ValueError, match=r"constraints depend on the control 'drive.value'; take a force instead"):
        mb.plan(driven, controls={"drive.value": None}, duration=1.0, start={}, running="effort")


def test_plan_says_how_to_install_ipopt(monkeypatch):
    monkeypatch.setattr(solvers.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r'pip install "jaxmb\[plan\]"'):
        solvers.chosen_method("ipopt", 10)
    with pytest.raises(ValueError, match=r"up to 400 variables, and this plan has 401"):
        solvers.chosen_method(None, 401)
    assert solvers.chosen_method(None, 10) == "slsqp"
