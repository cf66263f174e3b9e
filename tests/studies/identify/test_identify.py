"""Parameters from measured motion: recovery, deviations, what the data do not determine, and trials that fail."""

import diffrax
import equinox as eqx
import identifying
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from identifying import free_parameters, pendulum
from scipy.optimize import least_squares, minimize
from trajectories import motion_of

import jaxmb as mb
from jaxmb import planar
from jaxmb.lagrangian import LagrangianSystem
from jaxmb.studies.identify.covariance import covariance
from jaxmb.studies.identify.loss import LOSSES
from jaxmb.studies.identify.unknowns import unknowns
from jaxmb.studies.minimise import Linearised, _step, levenberg_marquardt

MOST_PROGRAMS = 90

TS = np.linspace(0.0, 1.0, 31)[1:]
TRUE = {"spring.stiffness": 6.0, "spring.damping": 0.3}
SIGMA = {"rod.angle": 1e-3}
# Compiles faster than Adams, where the solver does not matter.
TSIT5 = diffrax.Tsit5()


@pytest.fixture(scope="module")
def system():
    return pendulum()


@pytest.fixture(scope="module")
def motion(system):
    return mb.simulate(system, system.guess, t1=TS[-1], saveat=TS)


def test_an_initial_state_that_no_unknown_moves_is_assembled_once(system):
    held = {"fix": {"rod.angle": 0.3}, "rates": {"rod.angle": 1.0}}
    for free, given, is_assembled, is_compared in (
        (("rod.mass", "spring.stiffness"), {}, True, False),
        (("rod.mass",), held, True, True),
        (("rod.mass",), {"fix": {"pin.angle": 0.3}}, False, False),
        (("rod.mass",), {"free_initial": ["rod.angle"]}, False, True),
        (("rod.mass", "pin.point_b"), {}, False, False),
    ):
        experiment = mb.Experiment(ts=[1.0], residual=lambda trajectory: trajectory.ts, **given)
        found = unknowns(system, {"": experiment}, {}, free, None, None, None, LOSSES["linear"])
        (trial,) = found.trials
        assert trial.assembled == is_assembled
        if not is_compared:
            continue
        theta = {"rod.mass": jnp.asarray(2.2), "initial.rod.angle": jnp.asarray(0.2)}
        changed, state = trial.start(system, theta)
        fix = given.get("fix", {}) | ({"rod.angle": 0.2} if "free_initial" in given else {})
        exact = mb.assemble(changed, fix=fix, rates=given.get("rates"))
        np.testing.assert_allclose(state.q, exact.q, atol=1e-12)
        np.testing.assert_allclose(state.u, exact.u, atol=1e-12)


def noisy(motion, seed):
    """Measured angles, two of them missing."""
    noise = np.random.default_rng(seed).standard_normal(TS.shape)
    noise[[3, 7]] = np.nan
    return {"rod.angle": np.asarray(motion["rod"].angle) + SIGMA["rod.angle"] * noise}


@pytest.mark.slow
def test_result(system, motion, tmp_path):
    """The result carries the fitted system, its state, and a table; NaN samples are left out.

    Without sigma the noise is estimated. Mass, inertia, stiffness and damping scaled together leave the motion as it
    is. Few iterations do not end at the minimum.
    """
    measured, start = noisy(motion, 0), {"spring.stiffness": 10.0, "spring.damping": 0.1}
    common = {"ts": TS, "solver": TSIT5}
    fit = mb.identify(system, measured, free=start, sigma=SIGMA, **common)
    for name, true in TRUE.items():
        assert abs(fit.parameters[name] - true) < 4 * fit.deviations[name]
    assert fit.converged and fit.residuals.size == TS.size - 2 and 0.5 < fit.rms < 1.5
    again = mb.simulate(fit.system, fit.state, t1=TS[-1], saveat=TS)["rod"].angle
    residuals = (np.asarray(again) - measured["rod.angle"]) / SIGMA["rod.angle"]
    np.testing.assert_allclose(residuals[np.isfinite(residuals)], fit.residuals, rtol=0, atol=1e-4)
    np.testing.assert_allclose(np.sqrt(np.diag(fit.covariance)), np.concatenate([[v] for v in fit.deviations.values()]))
    assert "spring.stiffness" in str(fit) and "converged" in str(fit) and str(fit) in fit._repr_html_()
    assert repr([fit]).startswith("[Identification of spring.stiffness, spring.damping: converged")
    assert str(fit.predict("rod.angle")) == f"Prediction: rod.angle ({TS.size},), with bands of 95%"

    estimated = mb.identify(system, measured, free=start, **common)
    for name in TRUE:
        np.testing.assert_allclose(fit.parameters[name], estimated.parameters[name], rtol=1e-5)
        assert 0.6 < estimated.deviations[name] / fit.deviations[name] < 1.5
    assert f"rms {estimated.rms:.3g} of the range, " in str(estimated) and f"rms {fit.rms:.3g}, " in str(fit)

    free = ["rod.mass", "rod.inertia", "spring.stiffness", "spring.damping"]
    lost = mb.identify(system, measured, free=free, sigma=SIGMA, **common)
    assert "spring.stiffness" in lost.undetermined and "rod.mass" in lost.undetermined
    assert np.isinf(lost.deviations["rod.mass"]) and "do not determine" in str(lost)
    # Without warnings of NumPy.
    assert "Correlations" in lost.report(tmp_path).read_text()

    few = mb.identify(system, measured, free=start, sigma=SIGMA, max_iterations=2, **common)
    assert not few.converged and "did not converge" in str(few)


@pytest.mark.slow
def test_lengths_with_the_state_assembled_anew(system):
    """A body-fixed point, with the initial angle and rate held."""
    true = mb.with_parameters(system, {"pin.point_b": jnp.array([-0.45, 0.02])})
    start = {"fix": {"rod.angle": 0.2}, "rates": {"rod.angle": 1.0}}
    motion = mb.simulate(true, mb.assemble(true, **start), t1=TS[-1], saveat=TS)
    measured = {"rod.velocity": motion["rod"].velocity, "rod.position": motion["rod"].position}
    fit = mb.identify(system, measured, ts=TS, free=["pin.point_b"], **start, solver=TSIT5)
    np.testing.assert_allclose(fit.parameters["pin.point_b"], [-0.45, 0.02], rtol=0, atol=1e-6)
    np.testing.assert_allclose(fit.state.u[2], 1.0)
    assert fit.components == ("pin.point_b[0]", "pin.point_b[1]")


def test_everything_listed_can_be_measured(system):
    along = lambda x: np.tile(np.asarray(x), (TS.size, 1))
    still = motion_of(system, TS, along(system.guess.q), along(system.guess.u))
    for name, own in system.quantities().items():
        assert eqx.filter_eval_shape(mb.Trajectory.quantity, still, name).shape == (TS.size, *own.shape)


@pytest.fixture(scope="module")
def swing():
    return identifying.swing()


@pytest.mark.slow
def test_lagrangian_system(swing):
    """A coordinate and its rate, at times of their own, from an angle and a rate that are given."""
    held = {"fix": {"theta": 0.5}, "rates": {"theta": 1.0}}
    motion = mb.simulate(swing, mb.assemble(swing, **held), t1=TS[-1], saveat=TS)
    own = {"theta": slice(None, None, 2), "theta_rate": slice(1, None, 3)}
    measured = {"theta": motion["theta"][own["theta"]], "theta_rate": motion.ys.u[own["theta_rate"], 0]}
    ts = {name: TS[where] for name, where in own.items()}
    fit = mb.identify(swing, measured, ts=ts, free={"length": 1.1, "damping": 0.1}, **held, solver=TSIT5)
    assert fit.converged and fit.components == ("length", "damping")
    assert fit.residuals.size == 25 and fit.problem.trials[0].ts.size == 20
    np.testing.assert_allclose(fit.parameters["length"], 0.8, rtol=1e-6)
    np.testing.assert_allclose(fit.parameters["damping"], 0.3, rtol=1e-5)
    np.testing.assert_allclose([fit.state.q[0], fit.state.u[0]], [0.5, 1.0])
    for name, own in swing.quantities().items():
        assert motion.quantity(name).shape == (TS.size, *own.shape)


def test_what_identify_refuses_of_a_lagrangian_system(swing):
    right = {"measured": {"theta": np.zeros(30)}, "ts": TS, "free": ["length"]}
    for change, message in (
        ({"free": ["lenght"]}, "did you mean 'length'"),
        ({"measured": {"thet": np.zeros(30)}}, "did you mean 'theta'"),
        ({"measured": {"theta": np.zeros((30, 1))}}, "must have shape"),
        ({"measured": {"theta.position": np.zeros(30)}}, "Unknown quantity"),
        ({"fix": {"thet": 0.1}}, "Unknown coordinate 'thet'; did you mean 'theta'"),
        ({"rates": {"thet": 0.1}}, "Unknown rate 'thet'; did you mean 'theta'"),
        ({"sigma": {"omega": 1.0}}, "Unknown quantity 'omega'"),
    ):
        with pytest.raises(ValueError, match=message):
            mb.identify(swing, **(right | change))


def test_names_of_a_lagrangian_system_mean_nothing():
    """A parameter that is called like the mass of a body may be negative."""
    named = LagrangianSystem(kinetic=lambda t, q, v, p: v @ v, q=[1.0], parameters={"added.mass": 1.0})
    assert free_parameters(named, {"added.mass": -1.0})(jnp.zeros(1))["added.mass"] == -1.0


@pytest.mark.slow
def test_own_residuals_and_bounds(system, motion):
    """The estimate ends at the bound that is nearest to the truth."""
    exact = motion["rod"].angle
    fit = mb.identify(
        system,
        ts=TS,
        free={"spring.stiffness": 8.0},
        bounds={"spring.stiffness": (7.0, 9.0)},
        residual=lambda trajectory: (trajectory["rod"].angle - exact) / 0.01,
        solver=TSIT5,
    )
    assert not fit.converged and "is at an end of its range" in fit.message
    assert 7.0 <= fit.parameters["spring.stiffness"] < 7.05


@pytest.mark.slow
def test_start_that_cannot_be_assembled():
    """A rope too long for its loop, under derivatives as well."""
    bodies = [
        planar.PointMass("a", mass=1.0, position=(0.0, -1.0)),
        planar.PointMass("b", mass=1.0, position=(1.0, -1.0)),
    ]
    ropes = [
        planar.Distance("left", "ground", "a", length=1.0),
        planar.Distance("middle", "a", "b", length=1.0),
        planar.Distance("right", "ground", "b", length=2.0, point_a=(2.0, 0.0)),
    ]
    system = mb.Scene(bodies, joints=ropes, forces=[mb.Gravity((0.0, -9.81))]).compile()
    with pytest.raises(ValueError, match=r"fails with the starting values: The mechanism cannot be assembled.*right"):
        mb.identify(system, {"a.position": np.zeros((30, 2))}, ts=TS, free={"right.length": 30.0}, solver=TSIT5)


@pytest.mark.slow
def test_no_effect(system):
    with pytest.raises(ValueError, match=r"'rod.mass' has no effect"):
        mb.identify(system, ts=TS, free=["rod.mass"], residual=lambda trajectory: trajectory.ts, solver=TSIT5)


REFUSED = [
    ({"free": ["rod.mas"]}, "did you mean 'rod.mass'"),
    ({"free": []}, "Nothing is free"),
    ({"free": {"rod.mass": [1.0, 2.0]}}, "has shape"),
    ({"free": {"rod.mass": -1.0}}, "strictly between"),
    ({"bounds": {"rod.inertia": (0.0, 1.0)}}, "free parameter with bounds"),
    ({"bounds": {"rod.mass": (3.0, 1.0)}}, r"bounds of 'rod.mass' must be \(low, high\) with low < high"),
    ({"sensors": [mb.Sensor("rod.angle", name="encoder")]}, "data of sensor 'encoder' are missing.* 'rod.angle'"),
    ({"sensors": [mb.Sensor("rod.angle", sigma=1.0)], "sigma": SIGMA}, "sigma of 'rod.angle' is given twice"),
    ({"measured": {"rod.angl": np.zeros(30)}}, "did you mean 'rod.angle'"),
    ({"measured": {"rod.angle": np.zeros(29)}}, "must have shape"),
    ({"measured": {}}, "at least one quantity"),
    ({"measured": None}, "either measured quantities"),
    ({"sigma": {"rod.position": 1.0}}, "'rod.position', which is not measured"),
    ({"sigma": {"rod.angle": 0.0}}, "must be positive"),
    ({"ts": TS[::-1]}, "increasing"),
    ({"ts": {"rod.angle": TS[::-1]}}, r"ts\['rod.angle'\] must be a vector of increasing times"),
    ({"ts": {"rod.angl": TS}}, "did you mean 'rod.angle'"),
    ({"ts": {}}, "not for 'rod.angle'"),
    ({"ts": {"rod.angle": TS[1:]}}, r"must have shape \(29,\) for 29 times"),
    ({"measured": mb.Measurements(np.asarray(TS), {"rod.angle": np.zeros(30)})}, "have their own times"),
    ({"measured": None, "ts": {"a": TS}, "residual": lambda motion: motion.ts}, "needs one vector ts"),
    ({"loss": "cauchy"}, "must be one of 'linear', 'soft_l1', 'huber'"),
    ({"loss": "huber"}, "give sigma, as numbers"),
    ({"loss": "huber", "free": ["rod.mass", "rod.angle.sigma"]}, "give sigma, as numbers"),
    ({"t0": 0.5}, "after t0"),
    (
        {"measured": "run.csv"},
        "measured is given by name.*jaxmb.read_measurements reads files and tables; got an object of type str",
    ),
    ({"bounds": {"rod.mass": 3.0}}, r"bounds of 'rod.mass' must be a pair \(low, high\)"),
    ({"saveat": TS}, "identify sets 'saveat'"),
    ({"sigma": 0.01}, "sigma is given by name"),
    ({"bounds": [(0.0, 1.0)]}, "bounds is given by name"),
    ({"measured": np.zeros(30)}, "measured is given by name"),
    *(
        ({"starts": value}, f"starts must be an integer of at least 1.*, got {value!r}")
        for value in (0, 2.0, True, "two")
    ),
    *(({"segments": value}, f"segments must be an integer of at least 1.*, got {value!r}") for value in (0, 2.0, "x")),
    ({"max_iterations": 5.5}, r"max_iterations must be an integer of at least 1.*, got 5\.5"),
    ({"method": "lm"}, "no argument 'method' any more: it is Levenberg–Marquardt"),
]


def test_what_identify_refuses(system):
    for change, message in REFUSED:
        arguments = {"measured": {"rod.angle": np.zeros(30)}, "ts": TS, "free": ["rod.mass"]} | change
        with pytest.raises((ValueError, TypeError), match=message):
            mb.identify(system, **arguments)


def test_free_parameters_start_where_they_should(system):
    """Zero is the start; masses stay positive and bounded values within their bounds whatever the vector."""
    free = free_parameters(system, ["rod.mass", "spring.stiffness", "pin.point_b"], {"spring.stiffness": (5.0, 9.0)})
    random = np.random.default_rng(0).normal(scale=5.0, size=(20, free.size))
    values = jax.jit(jax.vmap(free))(np.vstack([np.zeros(free.size), random]))
    for name in ("rod.mass", "spring.stiffness", "pin.point_b"):
        np.testing.assert_allclose(values[name][0], mb.parameters(system)[name], rtol=1e-12)
    assert np.all(values["rod.mass"] > 0)
    assert np.all((values["spring.stiffness"] >= 5.0) & (values["spring.stiffness"] <= 9.0))


def slopes(residuals, z):
    """The Jacobian of residuals, by steps along the imaginary axis."""
    step = 1e-30
    columns = [residuals(z + 1j * step * e).imag / step for e in np.eye(z.size)]
    return np.stack(columns, axis=1)


def test_failed_trials_are_rejected():
    """A square root near its branch point, on whose far side the iteration tries to land."""
    trials = []
    residuals = lambda z: np.stack([np.sqrt(z[0]) - 0.1, 10 * (z[1] - z[0] ** 2)])

    def linearised(z):
        z = np.asarray(z)
        trials.append(z[0])
        return (residuals(z), slopes(residuals, z)) if z[0] > 0 else (np.full(2, np.inf), np.full((2, 2), np.nan))

    solution = levenberg_marquardt(linearised, jnp.array([3.0, 1.0]), tol=1e-10, limit=100)
    assert min(trials) < 0 and solution.success
    np.testing.assert_allclose(solution.z, [1e-2, 1e-4], rtol=1e-8)


@pytest.mark.parametrize(
    "residuals, start",
    [
        (lambda z: np.stack([10 * (z[1] - z[0] ** 2), 1 - z[0]]), [-1.2, 1.0]),
        (lambda z: np.stack([z[0] - 1e6, z[1] - 2e-6, z[0] * z[1] - 2]), [1.0, 1.0]),
        (lambda z: 3 * np.exp(-2 * TS) + 0.01 * np.sin(40 * TS) - z[0] * np.exp(-z[1] * TS), [1.0, 0.0]),
        (lambda z: np.stack([z[0] * z[1] - 2, (z[0] * z[1]) ** 2 - 3.9]), [1.0, 1.0]),
    ],
    ids=["curved valley", "badly scaled", "with noise", "undetermined"],
)
def test_least_squares_agree_with_scipy(residuals, start):
    """On the value of the objective; the minimum need not be unique."""
    jacobian = lambda z: slopes(residuals, z)
    linearised = lambda z: (residuals(np.asarray(z)), jacobian(np.asarray(z)))
    found = levenberg_marquardt(linearised, jnp.array(start), tol=1e-10, limit=100)
    known = least_squares(residuals, start, jacobian, xtol=1e-14, ftol=1e-14, gtol=1e-14, x_scale="jac")
    assert found.success and found.iterations < 50
    np.testing.assert_allclose(0.5 * np.sum(residuals(np.asarray(found.z)) ** 2), known.cost, rtol=1e-8, atol=1e-10)


def test_residuals_under_equations_agree_with_scipy():
    """A circle and a parabola, from starts on which they do not hold."""
    residuals = lambda z: np.array([z[0] - 2, z[1] - 1, z[2] * z[0]])
    jacobian = lambda z: np.array([[1.0, 0, 0], [0, 1.0, 0], [z[2], 0, z[0]]])
    gaps = lambda z: np.array([z[0] ** 2 - z[1], z @ z - 2])
    closing = lambda z: np.array([[2 * z[0], -1.0, 0], 2 * z])
    linearised = lambda z: Linearised(residuals(z), jacobian(z), None, gaps(z), closing(z))
    for start in ([0.5, 0.5, 1.0], [-3.0, 4.0, 0.1], [3.0, -2.0, -1.0]):
        found = levenberg_marquardt(lambda z: linearised(np.asarray(z)), jnp.array(start), tol=1e-10, limit=100)
        objective = lambda z: 0.5 * np.sum(residuals(z) ** 2)
        holds = {"type": "eq", "fun": gaps, "jac": closing}
        known = minimize(objective, found.z, method="SLSQP", constraints=holds, options={"ftol": 1e-14})
        assert found.success and found.iterations < 40
        np.testing.assert_allclose(gaps(np.asarray(found.z)), 0, atol=1e-9)
        np.testing.assert_allclose(found.value, known.fun, rtol=1e-8)
    # A step closes the gaps, and along these it goes to the minimum of the damped squares.
    model, damping = linearised(np.array([0.5, 0.5, 1.0])), 0.1
    step, _ = _step(model, damping)
    np.testing.assert_allclose(model.closing @ step, -model.gaps, atol=1e-14)
    weights = damping * np.sum(model.jacobian**2, axis=0)
    gradient = model.jacobian.T @ (model.residuals + model.jacobian @ step) + weights * step
    np.testing.assert_allclose(np.cross(*model.closing) @ gradient, 0.0, atol=1e-13)


DECAY = np.linspace(0.02, 1.0, 50)


def decays(z):
    """Two numbers of an exponential, and its derivatives."""
    z, shape = np.asarray(z), np.exp(-z[1] * DECAY)
    return z[0] * shape, np.stack([shape, -DECAY * z[0] * shape], axis=1)


@pytest.mark.parametrize("errors, more", [(1e-8, 1), (1e-6, 10)])
def test_errors_of_the_motions_cost_few_iterations(errors, more):
    """Residuals with errors that differ from trial to trial, as steps do, and that hide the last decrease."""
    measured = decays([3.0, 2.0])[0] + 0.05 * np.random.default_rng(0).standard_normal(DECAY.size)
    exact = lambda z: ((decays(z)[0] - measured) / 0.05, decays(z)[1] / 0.05)
    known = levenberg_marquardt(exact, jnp.array([1.0, 0.5]), tol=1e-8, limit=100)
    for seed in range(20):
        random = np.random.default_rng(seed)

        def linearised(z, random=random):
            residuals, jacobian = exact(z)
            return residuals + errors * random.standard_normal(DECAY.size), jacobian

        found = levenberg_marquardt(linearised, jnp.array([1.0, 0.5]), tol=1e-8, limit=100)
        assert found.success and found.iterations <= known.iterations + more
        deviations = np.sqrt(np.diag(np.linalg.inv(exact(found.z)[1].T @ exact(found.z)[1])))
        assert np.all(np.abs(found.z - known.z) <= 0.01 * deviations)


@pytest.mark.parametrize("name", ["soft_l1", "huber"])
def test_robust_losses_agree_with_scipy(name):
    """On estimates and objective; errors divided by their standard deviations have unit size, with outliers as well."""
    loss, random, scores = LOSSES[name], np.random.default_rng(0), []
    for draw in range(40 if name == "soft_l1" else 4):
        noise = 0.05 * random.standard_normal(DECAY.size)
        noise[random.integers(DECAY.size, size=5)] *= 30
        measured = decays([3.0, 2.0])[0] + noise
        residuals = lambda z, y=measured: (decays(z)[0] - y) / 0.05
        jacobian = lambda z: decays(z)[1] / 0.05

        def linearised(z, residuals=residuals, jacobian=jacobian):
            r = residuals(z)
            return Linearised(*loss.weighted(r, jacobian(z)), 0.5 * float(np.sum(loss.rho(r**2))))

        found = levenberg_marquardt(linearised, jnp.array([1.0, 0.5]), tol=1e-10, limit=100)
        assert found.success
        if draw < 4:
            known = least_squares(residuals, [1.0, 0.5], jacobian, loss=name, xtol=1e-14, ftol=1e-14, gtol=1e-14)
            np.testing.assert_allclose(found.value, known.cost, rtol=1e-10)
            np.testing.assert_allclose(found.z, known.x, rtol=1e-6)
        pull, slope = loss.influence(residuals(found.z))
        own = covariance(jacobian(found.z), np.eye(2), float(np.sum(pull**2)), DECAY.size, float(np.mean(slope)))
        scores.append((np.asarray(found.z) - np.array([3.0, 2.0])) / np.sqrt(np.diag(own.matrix)))
    assert name != "soft_l1" or np.all(np.abs(np.std(scores, axis=0) - 1) < 0.25)


def test_derivatives_of_losses():
    squares, h = np.array([0.0, 1e-12, 0.5, 1.5, 40.0]), 1e-6
    for loss in LOSSES.values():
        slope = np.broadcast_to(loss.slope(squares), squares.shape)
        of_both = lambda x, loss=loss: (jax.grad(loss.rho)(x), jax.jacfwd(loss.rho)(x))
        for found in jax.jit(jax.vmap(of_both))(squares):
            np.testing.assert_allclose(found, slope, rtol=1e-12)
        differences = (loss.slope(squares + h) - loss.slope(np.abs(squares - h))) / (2 * h)
        np.testing.assert_allclose(differences[2:], loss.curvature(squares)[2:], rtol=1e-6, atol=1e-9)
