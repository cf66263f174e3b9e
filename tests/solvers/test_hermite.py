"""The implicit second-derivative methods: orders, stiff problems, derivatives, diffrax's features, and bad input."""

from types import SimpleNamespace
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from stiff_problems import PROBLEMS, solve

import jaxmb as mb
from jaxmb import planar
from jaxmb.solvers import Hermite, MultistepController
from jaxmb.solvers._formulas import FAMILIES, double, formulas, start
from jaxmb.solvers._history import History, advance, basis, before_each


def relative_error(problem, rtol, **kwargs):
    """The largest of all components, and the solution."""
    solution = solve(problem, rtol, **kwargs)
    return np.max(np.abs(solution.ys[-1] / problem.y1 - 1)), solution


# Orders


@eqx.filter_jit
def _march(family, k, ts, first):
    """A solution `exp(-t)` from exact values at the points up to `first`, by the formula with k points: its error."""
    exact = lambda t: jnp.exp(-t)
    rate = lambda t, y: -exact(t) - 0.1 * (y - exact(t)) + (y - exact(t)) ** 2
    curvature = lambda t, y: jax.jvp(rate, (t, y), (jnp.ones_like(t), rate(t, y)))[1]

    def recorded(t, y):
        y, f, g = y[None], rate(t, y)[None], curvature(t, y)[None]
        return (f, g) if family.integrated else (y, f)

    def step(carry, n):
        history, y = carry
        t, h = ts[n], ts[n] - ts[n - 1]
        rows = formulas(family, history.mesh, t, history.differences.dtype)
        m = family.multiplicity * k
        past = rows.past[m] @ history.differences[:, 0]
        past = y + h * past if family.integrated else past
        a, b = h * rows.slope[m], h**2 * rows.curvature[m]
        new = y
        for _ in range(20):
            residual = lambda new: new - past - a * rate(t, new) - b * curvature(t, new)
            new = new - residual(new) / jax.grad(residual)(new)
        new = jnp.where(n <= first, exact(t), new)
        z, slope = recorded(t, new)
        sums = jnp.asarray(before_each(family.length)) @ (basis(history.mesh, t[None]) * history.differences)
        history = advance(history, t, z, sums)
        return (double(history, slope) if family.multiplicity == 2 else history, new), None

    history = start(family, ts[0], *recorded(ts[0], exact(ts[0])), ts[1] - ts[0])
    (_, y), _ = jax.lax.scan(step, (history, exact(ts[0])), jnp.arange(1, ts.size))
    return jnp.abs(y - exact(ts[-1]))


# Zero-stable where neighbouring steps differ by up to a factor of two.
VARIABLE = {"E": range(1, 8), "B": range(1, 4), "H": (1, 2), "Y": (1, 2)}


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_order_with_steps_of_any_size(name):
    family = FAMILIES[name]
    rng = np.random.default_rng(7)
    steps = [np.concatenate([[0.0], np.cumsum(2 ** rng.uniform(-0.5, 0.5, 14))]) for _ in range(8)]
    meshes = [step - step[-1] / 2 for step in steps]
    for k in VARIABLE[name]:
        order = family.order(k)
        # As many steps, of other sizes: the error falls with one power more than the order.
        scales = np.array([0.2, 0.14]) * 0.5 ** ((9 - order) / 1.5)
        errors = [
            np.mean([np.log(_march(family, jnp.array(k), jnp.asarray(scale * mesh), k + 1)) for mesh in meshes])
            for scale in scales
        ]
        assert (errors[0] - errors[1]) / np.log(scales[0] / scales[1]) - 1 >= order - 0.3, (k, errors)


# Stiff problems


# Problem: components of which errors are measured, steps at 1e-8 and 1e-10, and most errors there. Steps err by a
# twentieth of the tolerance, so at 20 times as much each may err by it.
FEW = {
    "van der Pol 1e3": ((0, 1), (700, 1150), (1e-6, 5e-9)),
    "van der Pol 1e6": ((0, 1), (2000, 2000), (2e-5, 2e-7)),
    "HIRES": (range(8), (2000, 2000), (2e-5, 2e-7)),
    "Robertson": ((0, 2), (1000, 1000), (1e-6, 1e-8)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW)
def test_stiff_problems_take_few_steps(name):
    """With errors in proportion to the tolerance."""
    (components, most, bounds), problem = FEW[name], PROBLEMS[name]
    run = jax.jit(lambda rtol: (lambda out: (out.ys[-1], out.stats))(solve(problem, rtol)))
    for rtol, steps, bound in zip((1e-8, 1e-10), most, bounds, strict=True):
        end, stats = run(20 * rtol)
        assert stats["num_steps" if name == "Robertson" else "num_accepted_steps"] <= steps, stats
        assert np.max(np.abs(end / problem.y1 - 1)[np.array(components)]) <= bound
        if name != "Robertson":
            assert stats["num_rejected_steps"] < 0.1 * stats["num_accepted_steps"]


@pytest.mark.slow
@pytest.mark.parametrize("family, points", [("E", (2, 4)), ("H", (1, 2)), ("B", None), ("Y", None), ("E", (1,))])
def test_every_family(family, points):
    """To the end of a stiff problem, and between the steps of another."""
    error, solution = relative_error(PROBLEMS["HIRES"], 1e-6, solver=Hermite(family, points))
    assert error < 1e-3
    used = np.flatnonzero(solution.solver_state.step_counts[1:]) + 1
    if points is not None:
        assert set(used) <= {*range(1, points[0]), *points} and points[-1] in used
    # Of the family H only the formula with one point is stable there.
    solver = Hermite(family, (1,) if family == "H" else points)
    ts, controller = jnp.linspace(0.0, 5.0, 101), MultistepController(1e-7, 1e-7)
    solution = _run(solver=solver, controller=controller, saveat=diffrax.SaveAt(ts=ts))
    np.testing.assert_allclose(solution.ys, _exact(np.asarray(ts)), rtol=0, atol=5e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["van der Pol 1e3", "Robertson"])
def test_no_tolerance_is_missed_by_far(name):
    """Newton's method must not end, nor the error be filtered, by a matrix that hides what is wrong."""
    problem = PROBLEMS[name]

    @jax.jit
    def end(rtol):
        solution = solve(problem, rtol, max_steps=10000)
        return solution.ys[-1]

    for rtol in np.logspace(-2.5, -6.5, 21):
        assert np.max(np.abs(end(rtol) / problem.y1 - 1)) < 300 * rtol, rtol


@pytest.mark.slow
def test_what_grows_is_not_stepped_over():
    """A pendulum that is let go above its pivot, nearer to it than the tolerance, falls nevertheless."""
    for points in (None, (1,)):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: jnp.stack([y[1], jnp.sin(y[0])])),
            Hermite(past_points=points),
            0.0,
            100.0,
            None,
            jnp.array([1e-12, 0.0]),
            stepsize_controller=MultistepController(1e-6, 1e-8),
            saveat=diffrax.SaveAt(steps=True),
            adjoint=diffrax.ForwardMode(),
        )
        assert np.max(solution.ys[np.isfinite(solution.ts), 0]) > np.pi


# Derivatives


@pytest.mark.slow
def test_derivatives_of_a_reaction_over_eleven_decades():
    """Where y1 = k2² / (k3 k1² t) and y2 = k2 / (k1 k3 t), up to terms of the order of y1."""
    problem = PROBLEMS["Robertson"]

    def logarithms(change, adjoint):
        rates = problem.args * jnp.exp(change)
        return jnp.log(solve(problem, 1e-8, args=rates, adjoint=adjoint, max_steps=1024).ys[-1][:2])

    exact = np.array([[-2.0, 2.0, -1.0], [-1.0, 1.0, -1.0]])
    along = jax.jit(jax.jacfwd(lambda x: logarithms(x, diffrax.ForwardMode())))(jnp.zeros(3))
    np.testing.assert_allclose(along, exact, rtol=1e-5)
    adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=1024)
    against = jax.jit(jax.jacrev(lambda x: logarithms(x, adjoint)))(jnp.zeros(3))
    np.testing.assert_allclose(against, along, rtol=1e-6)


@pytest.mark.slow
def test_simulation_warns_of_a_part_without_derivative(recwarn):
    for hide in (jax.lax.stop_gradient, lambda x: x):
        law = lambda poses, velocities, t, p, hide=hide: -1e3 * hide(poses)
        body = planar.Body("bob", mass=1.0, inertia=1.0, position=(1.0, 0.5), angle=0.1)
        system = mb.Scene([body], forces=[mb.Force("pull", "bob", law, parameters={})]).compile()
        motion = mb.simulate(system, system.guess, t1=0.01, rtol=1e-4, solver=Hermite(), throw=False)
        assert bool(motion.stats["wrong_derivative"]) == (hide is jax.lax.stop_gradient)
    told = [w for w in recwarn if "contradicts its differences" in str(w.message)]
    assert [w.filename for w in told] == [__file__]


# Diffrax's features


def _forced(t, y, args):
    """A stiff component that follows the cosine, and a slow one; exact from consistent values."""
    return jnp.stack([-1e4 * (y[0] - jnp.cos(t)) - jnp.sin(t), y[0] - y[1]])


def _exact(t):
    return np.stack([np.cos(t), (np.cos(t) + np.sin(t) + np.exp(-t)) / 2], axis=-1)


def _run(y0=(1.0, 1.0), t1=5.0, solver=None, controller=None, **kwargs):
    controller = MultistepController(1e-8, 1e-8) if controller is None else controller
    kwargs = {"adjoint": diffrax.ForwardMode(), **kwargs}
    term, solver = diffrax.ODETerm(_forced), Hermite() if solver is None else solver
    return diffrax.diffeqsolve(term, solver, 0.0, t1, None, jnp.asarray(y0), stepsize_controller=controller, **kwargs)


@pytest.mark.slow
def test_jumps_events_batches_and_backward_time():
    controller = diffrax.ClipStepSizeController(MultistepController(1e-8, 1e-8), jump_ts=jnp.array([1.0, 2.5]))
    solution = _run(controller=controller, saveat=diffrax.SaveAt(t1=True, solver_state=True))
    assert solution.solver_state.step_counts[0] == 3
    np.testing.assert_allclose(solution.ys[-1], _exact(np.array(5.0)), rtol=0, atol=1e-6)
    event = diffrax.Event(lambda t, y, args, **kwargs: y[0] - 0.5, optx.Newton(1e-8, 1e-8))
    np.testing.assert_allclose(_run(event=event).ts[-1], np.arccos(0.5), rtol=1e-6)
    slow = lambda y: _run(y, 2.0).ys[-1]
    starts = jnp.array([[1.0, 1.0], [1.5, 0.0], [-3.0, 2.0]])
    np.testing.assert_allclose(jax.vmap(slow)(starts), [slow(y) for y in starts], rtol=1e-6)
    back = diffrax.ODETerm(lambda t, y, args: 1e4 * (y - jnp.cos(t)) - jnp.sin(t))
    start, controller = jnp.cos(jnp.array([5.0])), MultistepController(1e-8, 1e-8)
    solution = diffrax.diffeqsolve(back, Hermite(), 5.0, 0.0, None, start, stepsize_controller=controller)
    np.testing.assert_allclose(solution.ys[-1], [1.0], rtol=0, atol=1e-7)


# Bad input


REFUSED = [
    ({"family": "A"}, "families E, B, H, Y"),
    ({"past_points": (0, 1)}, "1 to 7 points"),
    ({"past_points": (4, 2)}, "increasing"),
    ({"past_points": ()}, "increasing"),
    ({"family": "H", "past_points": (4,)}, "1 to 3 points"),
    ({"rtol": 1e-3}, "both of"),
]


def test_refused():
    for arguments, message in REFUSED:
        with pytest.raises(ValueError, match=message):
            Hermite(**arguments)
    with pytest.raises(ValueError, match="MultistepController"):
        _run(controller=diffrax.PIDController(1e-6, 1e-6))


@pytest.mark.slow
def test_field_that_is_not_finite_ends_the_solve():
    term, controller = diffrax.ODETerm(lambda t, y, args: jnp.sqrt(0.5 - t) * y), MultistepController(1e-6, 1e-6)
    options = {"stepsize_controller": controller, "throw": False}
    solution = diffrax.diffeqsolve(term, Hermite(), 0.0, 1.0, None, jnp.ones(1), **options)
    assert solution.result == diffrax.RESULTS.dt_min_reached


def test_prediction_extrapolates_states_and_their_slope():
    solver, end, family = Hermite(), 0.9, FAMILIES[Hermite().family]
    states = lambda t: jnp.stack([t**2 - t, 3.0 * t])
    times = np.array([0.0, 0.2, 0.35, 0.6, 0.7])

    @jax.jit
    def predicted(times):
        differences = jnp.zeros((family.length, 2)).at[0].set(states(times[0]))
        history = History(differences, times[0] - 0.1 * np.arange(family.length), jnp.array(1))
        for t in times[1:]:
            weights = before_each(family.length) * basis(history.mesh, t[None]).T
            history = advance(history, t, states(t), weights @ history.differences)
        values = basis(history.mesh, jnp.array([end]))[:, 0]
        formula: Any = SimpleNamespace(nodes=1, values=values, end=end)
        return solver._predicted(formula, history, 2)

    state, slope = predicted(times)
    np.testing.assert_allclose(state, [end**2 - end, 3 * end], rtol=1e-12)
    np.testing.assert_allclose(slope, [2 * end - 1, 3.0], rtol=1e-12)
