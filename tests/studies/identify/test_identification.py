"""Several experiments, sensors, priors, profiles, densities, shooting, predictions and reports of identification."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from identifying import free_parameters, pendulum, swing
from jax.scipy.special import ndtri

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.lagrangian import LagrangianSystem
from jaxmb.studies.identify.covariance import combinations, covariance
from jaxmb.studies.identify.density import LogDensity
from jaxmb.studies.identify.experiment import with_times
from jaxmb.studies.identify.loss import LOSSES
from jaxmb.studies.identify.prediction import predict
from jaxmb.studies.identify.profile import profile
from jaxmb.studies.identify.sensors import readings_of
from jaxmb.studies.minimise import Linearised, levenberg_marquardt, minimise_together

MOST_PROGRAMS = 200

TS = np.linspace(0.0, 1.0, 31)[1:]
# Compiles faster than Adams, where the solver does not matter.
TSIT5 = diffrax.Tsit5()


@pytest.fixture(scope="module")
def system():
    return pendulum()


@pytest.fixture(scope="module")
def motion():
    """Of the Lagrangian system, from an angle of 0.5 rad."""
    own = swing()
    start = mb.assemble(own, fix={"theta": 0.5})
    return np.asarray(mb.simulate(own, start, t1=TS[-1], saveat=TS, solver=TSIT5)["theta"])


DELAY, BIAS, GAIN, SIGMA = 0.02, 0.1, 1.1, {"encoder": 1e-3, "gyro": 0.01}


@pytest.fixture(scope="module")
def three(system):
    """A fit of two experiments with shared and own unknowns of every kind, and a third one held out."""
    random = np.random.default_rng(0)

    def measured(angle, damping):
        own = mb.with_parameters(system, {"spring.damping": damping})
        start = mb.assemble(own, fix={"rod.angle": angle})
        late = mb.simulate(own, start, t1=TS[-1], saveat=TS - DELAY, solver=TSIT5)
        exact = {"encoder": late["rod"].angle + BIAS, "gyro": GAIN * late["rod"].angular_velocity}
        return {name: np.asarray(x) + SIGMA[name] * random.standard_normal(x.shape) for name, x in exact.items()}

    experiments = [
        mb.Experiment(measured(0.1, 0.3), ts=TS, fix={"rod.angle": 0.0}, free_initial=("rod.angle",)),
        mb.Experiment(measured(-0.4, 0.5), ts=TS, fix={"rod.angle": -0.4}, own=("spring.damping",), name="worn"),
        mb.Experiment(
            measured(0.4, 0.2), ts=TS, fix={"rod.angle": 0.4}, parameters={"spring.damping": 0.2}, held_out=True
        ),
    ]
    sensors = [
        mb.Sensor("rod.angle", name="encoder"),
        mb.Sensor("rod.angular_velocity", name="gyro", delay=DELAY, sigma=SIGMA["gyro"]),
    ]
    free = {"spring.stiffness": 8.0, "spring.damping": 0.2, "encoder.bias": 0.0, "encoder.delay": 0.0}
    return mb.identify(
        system,
        experiments,
        free=free | {"gyro.gain": None, "encoder.sigma": None},
        sensors=sensors,
        prior={"spring.stiffness": (6.1, 0.5)},
        solver=TSIT5,
    )


TRUE = {
    "spring.stiffness": 6.0,
    "spring.damping": 0.3,
    "encoder.bias": BIAS,
    "encoder.delay": DELAY,
    "gyro.gain": GAIN,
    "encoder.sigma": SIGMA["encoder"],
    "exp1/initial.rod.angle": 0.1,
    "worn/spring.damping": 0.5,
}


@pytest.mark.slow
def test_unknowns_of_every_kind_from_two_experiments(three, tmp_path):
    assert three.converged and not three.undetermined and tuple(three.parameters) == tuple(TRUE)
    for name, true in TRUE.items():
        assert abs(three.parameters[name] - true) < 4 * three.deviations[name] < 0.5 * true, name
    assert 0.8 < three.rms < 1.2
    # The expected information on a noise level from 60 samples.
    np.testing.assert_allclose(three.deviations["encoder.sigma"], three.parameters["encoder.sigma"] / np.sqrt(120))
    np.testing.assert_allclose(
        mb.parameters(three.systems["worn"])["spring.damping"], three.parameters["worn/spring.damping"]
    )
    # What is held out is predicted.
    (own,) = three.held_out.values()
    assert own.residuals.size == 60 and 0.7 < own.rms < 1.3
    path = three.report(tmp_path / "out")
    text = path.read_text()
    assert path.name == "identification.html"
    assert text.count("<img") == 7 and "worn encoder" in text and "exp3 gyro (held out)" in text


class Parabola(eqx.Module):
    """An objective without a motion, and the volume of its unknowns."""

    free: Any
    half: float = 0.5

    def objective(self, z):
        return jnp.where(z[0] > 0, self.half * jnp.sum(z**2), jnp.nan)


class Exponential(eqx.Module):
    rate: float = 3.0

    def log_volume(self, z):
        return self.rate * z[1]


def test_density_is_the_volume_less_the_objective():
    """Where the objective fails it vanishes, with derivatives of zero."""
    z = jnp.array([[0.4, -0.3], [-1.0, 2.0]])
    density = LogDensity(Parabola(Exponential()), z[0])
    values, slopes = jax.vmap(jax.value_and_grad(density))(z)
    np.testing.assert_allclose(values, [3.0 * -0.3 - 0.125, -np.inf], rtol=1e-14)
    np.testing.assert_allclose(slopes, [[-0.4, 3.0 + 0.3], [0.0, 0.0]], rtol=1e-14)


def test_readings_of_a_sensor_and_their_misfit():
    """Of a gain, an offset and a missing sample, with a noise level that is known or sought."""
    sensor = mb.Sensor("x", bias=0.5, gain=2.0)
    data = np.array([1.0, np.nan, 3.0])
    channel = readings_of(sensor, data, 0.2, (), np.arange(3), 3, float, False)
    shown = channel.read(np.array([0.1, 0.2, 1.5]), {})
    np.testing.assert_allclose(shown, [0.7, 0.9, 3.5], rtol=1e-15)
    other = channel.read(np.array([0.1, 0.2, 1.5]), {"x.bias": np.asarray(1.0), "x.gain": np.asarray(3.0)})
    np.testing.assert_allclose(other, [1.3, 1.6, 5.5], rtol=1e-15)
    known = channel.rows(shown, {}, LOSSES["linear"])
    np.testing.assert_allclose(known.residuals, [-1.5, 0.0, 2.5], rtol=1e-14)
    np.testing.assert_allclose(known.objective, 0.5 * (1.5**2 + 2.5**2), rtol=1e-14)
    sought = channel.rows(shown, {"x.sigma": jnp.asarray(0.1)}, LOSSES["linear"])
    np.testing.assert_allclose(sought.objective, 0.5 * (3.0**2 + 5.0**2) + 2 * np.log(0.1), rtol=1e-14)
    np.testing.assert_allclose(channel.level(shown, np.asarray(0.1)), np.sqrt((0.3**2 + 0.5**2) / 2), rtol=1e-14)


def test_profile_of_a_linear_problem_is_that_of_its_deviations(monkeypatch):
    """Two parameters with correlated errors: the interval has 1.96 deviations on either side of the estimate."""
    named = LagrangianSystem(lambda t, q, v, p: v @ v, q=[1.0], parameters={"a": 1.0, "b": 2.0})
    free, slopes = free_parameters(named, ["a", "b"]), np.array([[1.0, 2.0], [0.5, -1.0], [0.3, 1.0]])
    at = lambda z: np.array([free(jnp.asarray(z))[name] for name in ("a", "b")])
    by_z = slopes @ np.stack([at(e) - at(np.zeros(2)) for e in np.eye(2)], axis=1)
    model = lambda problem, z: SimpleNamespace(linearised=Linearised(by_z @ np.asarray(z), by_z))
    monkeypatch.setattr("jaxmb.studies.identify.profile.linearise", model)
    deviations = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    fit: Any = SimpleNamespace(
        problem=SimpleNamespace(free=free, known_noise=True),
        components=("a", "b"),
        parameters={"a": np.asarray(1.0), "b": np.asarray(2.0)},
        uncertainty=SimpleNamespace(deviations=deviations),
        whole_motions=lambda what: None,
        z=jnp.zeros(2),
        success=True,
        objective=0.0,
        dispersion=1.0,
        tol=1e-10,
        max_iterations=50,
    )
    for level, width in ((0.95, 1.959964), (0.99, 2.575829)):
        found = profile(fit, "a", level=level)
        np.testing.assert_allclose(found.interval, 1.0 + width * deviations[0] * np.array([-1.0, 1.0]), rtol=1e-6)
        np.testing.assert_allclose(found.ratios, ((found.values - 1.0) / deviations[0]) ** 2, rtol=1e-6, atol=1e-9)
        assert found.fits.all() and np.all(np.diff(found.values) > 0)


def test_segments_have_the_minimum_of_the_whole_motion():
    """A free mass: unknown mass and speed at the start; the motion in three pieces is continuous."""
    own = LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * p["mass"] * v @ v,
        potential=lambda t, q, p: -q[0],
        q=[0.0],
        coordinates=("x",),
        parameters={"mass": 2.0},
    )
    ts = np.linspace(0.0, 1.5, 7)[1:]
    fit = mb.identify(
        own,
        {"x": 0.3 * ts + ts**2 / (2 * 0.8)},
        ts=ts,
        free={"mass": 1.0},
        free_initial=("x_rate",),
        sigma={"x": 1e-3},
        segments=3,
        solver=TSIT5,
    )
    assert fit.converged and fit.continuity < 1e-9
    np.testing.assert_allclose([fit.parameters["mass"], fit.parameters["initial.x_rate"]], [0.8, 0.3], rtol=1e-6)


@pytest.mark.slow
def test_derivatives_of_a_density(motion):
    """By both modes and as differences, with a prior and a volume; of a batch with a member whose simulation fails."""
    data = {"theta": motion + 0.1 + 0.02 * np.random.default_rng(3).standard_normal(TS.size)}
    free = {"length": 0.82, "damping": 0.2, "theta.bias": 0.1, "theta.sigma": 0.02}
    bounds, prior = {"damping": (0.0, 1.0)}, {"length": (0.8, 0.05)}
    common = {"fix": {"theta": 0.5}, "bounds": bounds, "prior": prior, "solver": TSIT5, "rtol": 1e-9}
    fit = mb.identify(swing(), data, ts=TS, free=free, **common)
    density, h = fit.logdensity(), 1e-5
    z = np.asarray(density.start) + 0.01
    near = np.vstack([z[None], z + h * np.eye(4), z - h * np.eye(4), np.where(np.arange(4) == 1, np.nan, z)[None]])
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(density)))(near)
    of_problem = lambda z: density.problem.free.log_volume(z) - density.problem.objective(z)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(of_problem))(z), gradients[0], rtol=1e-7)
    np.testing.assert_allclose((values[1:5] - values[5:9]) / (2 * h), gradients[0], rtol=1e-5, atol=1e-3)
    assert values[9] == -np.inf and not np.any(gradients[9])
    chain = density.parameters(density.start[None])
    assert list(chain) == list(density.parameters(density.start)) == list(fit.parameters)
    np.testing.assert_allclose(chain["length"][0], fit.parameters["length"])


@pytest.mark.slow
def test_bands_of_predictions(three):
    """Deviations as by hand, from central differences and the covariance."""
    found = three.predict(["rod.angle", "pin.force"], experiment="worn", level=0.9)
    number, z = 1, three.z
    problem = three.problem

    def by_hand(z):
        own, state = problem.start(number, z)
        return np.asarray(mb.simulate(own, state, t1=TS[-1], saveat=TS, rtol=1e-10, solver=TSIT5).quantity("pin.force"))

    h = 1e-4
    jacobian = np.stack([(by_hand(z + h * e) - by_hand(z - h * e)) / (2 * h) for e in np.eye(z.size)], axis=-1)
    ahead = np.asarray(jax.jacfwd(problem.free.flat)(z))
    jacobian = jacobian @ np.linalg.inv(ahead)
    deviations = np.sqrt(np.einsum("tci,ij,tcj->tc", jacobian, three.covariance, jacobian))
    np.testing.assert_allclose(found.deviations["pin.force"], deviations, rtol=1e-3, atol=1e-9)
    width = found.high["rod.angle"] - found.low["rod.angle"]
    np.testing.assert_allclose(width, 2 * float(ndtri(0.95)) * found.deviations["rod.angle"])


def test_a_level_is_a_probability():
    """It is looked at before the fit is."""
    fit: Any = None
    for level, message in ((95, "got 95: for 95 % give 0.95"), (0.0, r"got 0\.0"), (1.0, r"got 1\.0"), (np.nan, "NaN")):
        for ask in (predict, profile):
            with pytest.raises(ValueError, match=f"level must.*{message}"):
                ask(fit, "rod.angle", level=level)


@pytest.mark.slow
def test_intervals_cover_the_truth(motion):
    """95 % intervals of each parameter of 100 synthetic data sets, all by one compiled program."""
    own, random, inside = swing(), np.random.default_rng(0), {"length": 0, "damping": 0}
    common = {"fix": {"theta": 0.5}, "free": {"length": 0.9, "damping": 0.2}, "sigma": {"theta": 0.01}}
    for _ in range(100):
        data = {"theta": motion + 0.01 * random.standard_normal(TS.size)}
        fit = mb.identify(own, data, ts=TS, solver=TSIT5, **common)
        assert fit.converged
        for name, true in (("length", 0.8), ("damping", 0.3)):
            inside[name] += int(abs(fit.parameters[name] - true) < 1.96 * fit.deviations[name])
    assert all(89 <= count <= 99 for count in inside.values())


@pytest.mark.slow
def test_several_starts_find_the_best_minimum():
    """A pendulum's length from many swings: too long or too short a start misses some of them."""
    own = mb.with_parameters(swing(), {"damping": 0.0})
    ts = jnp.linspace(0.0, 8.0, 81)[1:]
    true = mb.simulate(own, mb.assemble(own, fix={"theta": 0.5}), t1=ts[-1], saveat=ts, solver=TSIT5)
    common = {
        "ts": ts,
        "fix": {"theta": 0.5},
        "free": {"length": 1.4},
        "bounds": {"length": (0.4, 1.6)},
        "sigma": {"theta": 0.01},
        "solver": TSIT5,
    }
    data = {"theta": true["theta"]}
    alone = mb.identify(own, data, **common)
    assert abs(alone.parameters["length"] - 0.8) > 0.1
    several = mb.identify(own, data, starts=24, **common)
    np.testing.assert_allclose(several.parameters["length"], 0.8, rtol=1e-5)
    assert len(several.objectives) == 24 and list(several.objectives) == sorted(several.objectives)
    given = mb.identify(own, data, starts=[{"length": 0.9}], **common)
    np.testing.assert_allclose(given.parameters["length"], 0.8, rtol=1e-5)


def unstable():
    """A rod upright on a pin, whose motion passes the unstable equilibrium again and again."""
    rod = planar.Body("rod", mass=2.0, inertia=0.25, position=(0.0, 0.5), angle=np.pi / 2)
    pin = planar.Revolute("pin", "ground", "rod", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    damper = planar.TorsionalSpringDamper("damper", "ground", "rod", stiffness=0.0, damping=0.01)
    return mb.Scene([rod], joints=[pin], forces=[damper, mb.Gravity((0.0, -9.81))]).compile()


@pytest.mark.slow
def test_multiple_shooting_where_single_shooting_fails():
    """Both have the same minimum, which only the segments lead to."""
    own = unstable()
    ts = jnp.linspace(0.0, 8.0, 161)[1:]
    start = mb.assemble(own, fix={"rod.angle": np.pi / 2 + 0.01})
    exact = mb.simulate(own, start, t1=ts[-1], saveat=ts, solver=TSIT5)["rod"].angle
    data = {"rod.angle": exact + 0.01 * np.random.default_rng(0).standard_normal(ts.size)}
    common = {
        "ts": ts,
        "fix": {"rod.angle": np.pi / 2},
        "free_initial": ("rod.angle", "rod.angle_rate"),
        "sigma": {"rod.angle": 0.01},
        "solver": TSIT5,
    }
    free = {"rod.inertia": 0.5, "damper.damping": 0.05}
    fit = mb.identify(own, data, free=free, segments=16, **common)
    assert fit.converged and fit.continuity < 1e-8
    jumps = dataclasses.replace(fit, continuity=0.5)
    assert not jumps.converged and "another branch" in jumps.message
    assert 0.8 < fit.rms < 1.2
    for name, true in {"rod.inertia": 0.25, "damper.damping": 0.01, "initial.rod.angle": np.pi / 2 + 0.01}.items():
        assert abs(fit.parameters[name] - true) < 4 * fit.deviations[name], name
    assert fit.deviations["rod.inertia"] < 0.01
    alone = mb.identify(own, data, free=free, **common)
    assert not alone.converged or alone.rms > 10 * fit.rms
    again = mb.identify(own, data, free=fit.parameters, **(common | {"free_initial": ()}))
    for name, value in fit.parameters.items():
        np.testing.assert_allclose(again.parameters[name], value, atol=1e-3 * fit.deviations[name])
        np.testing.assert_allclose(again.deviations[name], fit.deviations[name], rtol=1e-3)


@pytest.mark.slow
def test_a_robust_loss_withstands_outliers(motion):
    """Every tenth sample is far off; the minimum of segments is that of whole motions."""
    loss = "soft_l1"
    own, random = swing(), np.random.default_rng(4)
    data = motion + 1e-3 * random.standard_normal(TS.size)
    data[::10] += 0.2
    common = {"ts": TS, "fix": {"theta": 0.5}, "sigma": {"theta": 1e-3}, "solver": TSIT5, "rtol": 1e-9, "atol": 1e-11}
    free = {"length": 0.9, "damping": 0.2}
    squares = mb.identify(own, {"theta": data}, free=free, **common)
    assert not squares.converged
    fit = mb.identify(own, {"theta": data}, free=free, loss=loss, **common)
    assert fit.converged and [outlier.sample for outlier in fit.outliers] == [(0,), (10,), (20,)]
    for name, true in {"length": 0.8, "damping": 0.3}.items():
        assert abs(fit.parameters[name] - true) < 4 * fit.deviations[name] < 0.05 * true, name
        assert abs(squares.parameters[name] - true) > 4 * fit.deviations[name], name
    function = LOSSES[loss]
    np.testing.assert_allclose(fit.objectives[0], 0.5 * float(jnp.sum(function.rho(fit.residuals**2))), rtol=1e-9)
    # The interval of a profile is that of the deviations.
    low, high = fit.profile("length").interval
    np.testing.assert_allclose((high - low) / (2 * 1.96 * fit.deviations["length"]), 1.0, atol=0.25)

    pieces = mb.identify(own, {"theta": data}, free=fit.parameters, loss=loss, segments=3, **common)
    assert pieces.converged
    for name, value in fit.parameters.items():
        np.testing.assert_allclose(pieces.parameters[name], value, atol=1e-2 * fit.deviations[name])
        np.testing.assert_allclose(pieces.deviations[name], fit.deviations[name], rtol=1e-2)


@pytest.mark.slow
def test_sensors_with_times_of_their_own(motion):
    """As the same samples among all times, with the others missing; with a delay, held out, and in segments."""
    own, random = swing(), np.random.default_rng(6)
    start = mb.assemble(own, fix={"theta": 0.5})
    encoder, gyro = TS[::2], np.linspace(0.1, 0.95, 18)
    late = mb.simulate(own, start, t1=1.0, saveat=encoder - DELAY, solver=TSIT5)["theta"]
    rate = mb.simulate(own, start, t1=1.0, saveat=gyro, solver=TSIT5).ys.u[:, 0]
    data = {"encoder": late + 1e-3 * random.standard_normal(encoder.size)}
    data["theta_rate"] = rate + 1e-2 * random.standard_normal(gyro.size)
    sensors = [mb.Sensor("theta", name="encoder", sigma=1e-3), mb.Sensor("theta_rate", sigma=1e-2)]
    common = {"free": {"length": 0.9, "damping": 0.2}, "sensors": sensors, "solver": TSIT5}
    ts = {"encoder": encoder, "theta_rate": gyro}
    fitted, unseen = (mb.Experiment(data, ts=ts, fix={"theta": 0.5}, held_out=out) for out in (False, True))
    fit = mb.identify(own, [fitted, unseen], **(common | {"free": common["free"] | {"encoder.delay": 0.01}}))
    assert fit.converged
    for name, true in {"length": 0.8, "damping": 0.3, "encoder.delay": DELAY}.items():
        assert abs(fit.parameters[name] - true) < 4 * fit.deviations[name], name
    readings = fit.held_out["exp2"].readings
    assert readings["encoder"].shape == encoder.shape and readings["theta_rate"].shape == gyro.shape
    np.testing.assert_allclose((readings["theta_rate"] - data["theta_rate"]) / 1e-2, fit.residuals[15:], atol=1e-6)

    whole = np.unique(np.concatenate([encoder, gyro]))
    among = {name: np.full(whole.size, np.nan) for name in ts}
    for name, times in ts.items():
        among[name][np.searchsorted(whole, times)] = data[name]
    for segments in (1, 3):
        several = {"fix": {"theta": 0.5}, "segments": segments}
        alone = mb.identify(own, data, ts=ts, **several, **common)
        same = mb.identify(own, among, ts=whole, **several, **common)
        assert alone.parameters == same.parameters


@pytest.mark.slow
def test_a_prior_is_one_more_measurement():
    """With a strong one the estimate is its mean; without data on a parameter, its deviation is the prior's."""
    own = swing()
    truth = mb.with_parameters(own, {"length": 0.7, "damping": 0.3})
    start = mb.assemble(truth, fix={"theta": 0.5})
    motion = mb.simulate(truth, start, t1=TS[-1], saveat=TS, solver=TSIT5)
    data = {"theta": np.asarray(motion["theta"]) + np.random.default_rng(0).normal(0.0, 1.0, TS.size)}
    common = {"ts": TS, "fix": {"theta": 0.5}, "free": ["length", "damping"], "sigma": {"theta": 1.0}, "solver": TSIT5}
    fit = mb.identify(own, data, prior={"length": (0.7, 1e-6), "damping": (0.3, 0.02)}, **common)
    np.testing.assert_allclose(fit.parameters["length"], 0.7, atol=1e-9)
    np.testing.assert_allclose(fit.deviations["length"], 1e-6, rtol=1e-6)
    np.testing.assert_allclose(fit.deviations["damping"], 0.02, rtol=1e-2)


def test_combinations_that_make_no_difference():
    """A product and a sum of three numbers, of which each pair can change alone."""
    jacobian = np.array([[2.0, 2.0, 0.0], [0.0, 0.0, 1.0], [2.0, 2.0, 1.0]])
    found = covariance(jacobian, np.eye(3), None, 3)
    assert found.undetermined.tolist() == [True, True, False]
    ((own),) = combinations(("a", "b", "c"), np.array([1.0, 2.0, 1.0]), found)
    assert set(own) == {"a", "b"}
    np.testing.assert_allclose([own["a"], own["b"]], [1.0, -0.5])
    np.testing.assert_allclose(found.matrix[2, 2], 2 / 3)
    # Of three residuals and two directions that are determined one is left for the noise.
    estimated = covariance(jacobian, np.eye(3), 0.25, 3)
    np.testing.assert_allclose([estimated.noise, estimated.matrix[2, 2]], [0.5, 0.25 * 2 / 3])


def test_what_the_tolerance_hides_is_not_determined():
    """Derivatives of motions are as exact as these, so a sensitivity of 1e-5 is none at rtol 1e-6; a prior's is."""
    jacobian = np.diag([1.0, 1e-5])
    assert not covariance(jacobian, np.eye(2), None, 2, rtol=1e-8).undetermined.any()
    assert covariance(jacobian, np.eye(2), None, 2, rtol=1e-6).undetermined.tolist() == [False, True]
    known = np.array([[1e3, 0.0], [0.0, 0.5]])
    assert not covariance(known, np.eye(2), None, 1, rtol=1e-4).undetermined.any()


def test_iterations_together_are_those_alone():
    residuals = lambda z: np.array([10 * (z[1] - z[0] ** 2), 1 - z[0]])
    jacobian = lambda z: np.array([[-20 * z[0], 10.0], [-1.0, 0.0]])
    linearised = lambda z: (residuals(np.asarray(z)), jacobian(np.asarray(z)))
    starts = [jnp.array([-1.2, 1.0]), jnp.array([3.0, -2.0])]
    both = minimise_together(lambda zs: list(map(linearised, zs)), starts, 1e-10, 100)
    for start, found in zip(starts, both, strict=True):
        alone = levenberg_marquardt(linearised, start, 1e-10, 100)
        assert alone.iterations == found.iterations and found.success
        np.testing.assert_array_equal(alone.z, found.z)
    held = levenberg_marquardt(linearised, starts[0], 1e-10, 100, np.array([True, False]))
    np.testing.assert_allclose(held.z, [-1.2, 1.44], rtol=1e-9)


def test_a_start_that_fails_leaves_the_others_alone():
    fails = lambda z: np.asarray(z)[0] > 2
    residuals = lambda z: np.full(2, np.inf) if fails(z) else np.array([10 * (z[1] - z[0] ** 2), 1 - z[0]])
    jacobian = lambda z: np.full((2, 2), np.nan) if fails(z) else np.array([[-20 * z[0], 10.0], [-1.0, 0.0]])
    linearised = lambda zs: [(residuals(np.asarray(z)), jacobian(np.asarray(z))) for z in zs]
    good, bad = minimise_together(linearised, [jnp.array([-1.2, 1.0]), jnp.array([3.0, -2.0])], 1e-10, 100)
    assert good.success and not bad.success and bad.value == np.inf
    np.testing.assert_allclose(good.z, [1.0, 1.0])


def test_ranges_of_unknowns_have_inverses_and_volumes(system):
    """Of every kind; second moments of mass stay positive, so principal moments satisfy the triangle inequalities."""
    top = mb.Scene([spatial.Body("top", mass=1.0, inertia=np.diag([2.0, 1.5, 1.0]))]).compile()
    names = {"rod.mass": 3.0, "spring.stiffness": 7.0, "pin.point_b": [-0.4, 0.1], "spring.damping": 0.2}
    bounds = {"spring.stiffness": (5.0, 9.0), "spring.damping": (None, 1.0)}
    several, of_matrix = free_parameters(system, names, bounds), free_parameters(top, ["top.inertia"])
    assert several.place("pin.point_b") == slice(2, 4) and of_matrix.size == 6
    # A symmetric matrix has six components.
    for free, rows in ((several, slice(None)), (of_matrix, [0, 1, 2, 4, 5, 8])):
        every = lambda z, free=free: (free(z), free.locate(free(z)), free.log_volume(z), jax.jacfwd(free.flat)(z))
        z = np.vstack([np.zeros(free.size), np.random.default_rng(0).normal(size=(5, free.size))])
        values, again, volumes, slopes = jax.jit(jax.vmap(every))(z)
        np.testing.assert_allclose(again, z, atol=1e-9)
        np.testing.assert_allclose(volumes, np.linalg.slogdet(np.asarray(slopes)[:, rows])[1], rtol=1e-10)
    inertia = np.asarray(values["top.inertia"])
    np.testing.assert_allclose(inertia[0], np.diag([2.0, 1.5, 1.0]), atol=1e-14)
    moments = np.linalg.eigvalsh(inertia)
    assert np.all(moments > 0) and np.all(moments[:, 2] < moments[:, 0] + moments[:, 1])
    with pytest.raises(ValueError, match="slightly thicker"):
        free_parameters(top, {"top.inertia": np.diag([1.0, 1.0, 2.0])})
    # An unknown moves to larger values with the vector.
    assert np.all(np.diag(jax.jit(jax.jacfwd(several.flat))(np.zeros(5)))[:4] > 0)


def test_measurements_from_files_and_tables(tmp_path):
    path = tmp_path / "data.csv"
    path.write_text("t;phi;x;y\n0.1;1;2;3\n0.2;;NaN;4\n0.4;1.5;2;5\n")
    own = mb.read_measurements(path, {"rod.angle": "phi", "rod.position": ["x", "y"]})
    np.testing.assert_array_equal(own.ts, [0.1, 0.2, 0.4])
    np.testing.assert_array_equal(own.values["rod.angle"], [1.0, np.nan, 1.5])
    np.testing.assert_array_equal(own.values["rod.position"], [[2.0, 3.0], [np.nan, 4.0], [2.0, 5.0]])
    frame = pytest.importorskip("pandas").DataFrame({"time": [0.0, 1.0], "rod.angle": [1.0, None]})
    table = mb.read_measurements(frame, time="time")
    np.testing.assert_array_equal(table.values["rod.angle"], [1.0, np.nan])
    own = with_times(mb.Experiment(table))
    np.testing.assert_array_equal(own.ts, [0.0, 1.0])
    for given in (path, str(path), frame):
        with pytest.raises(ValueError, match=r"jaxmb\.read_measurements reads files and tables"):
            with_times(mb.Experiment(given))


FILES = [
    ("t,phi\n0,1\n1,2\n", {"rod.angle": "ph"}, "did you mean 'phi'"),
    ("time,phi\n0,1\n1,2\n", None, "column of time 't'"),
    ("t,phi\n0,1\n1,two\n", None, "no number in line 3 of column 'phi', but 'two'"),
    ("t,phi\n\n0,1\n\n1,two\n", None, "no number in line 5 of column 'phi'"),
    ("t,phi\n0,1\n1\n", None, "1 cells in line 3"),
    ("t,phi,phi\n0,1,1\n1,1,2\n", None, "more than one column 'phi'"),
    ("t,phi\n0,1\n0,2\n", None, "must increase, but 0 in row 2 follows 0"),
    ("t,phi\n0,1\n,2\n", None, "no number in row 2"),
    ("t,phi\n0,1\n", None, "too few data"),
    ("t\n0\n1\n", None, "no column except time"),
    ("\n", None, "is empty"),
]


def test_what_is_no_file_of_measurements(tmp_path):
    path = tmp_path / "data.csv"
    for text, columns, message in FILES:
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            mb.read_measurements(path, columns)


ANGLE = {"rod.angle": np.linspace(0.0, 1.0, 30)}


REFUSED = [
    ([mb.Experiment(ANGLE, ts=TS)], {"ts": TS}, r"ts belongs to each .*\(measured, ts=…\)"),
    ([mb.Experiment(ANGLE, ts=TS)], {"fix": {}}, r"fix belongs to each experiment: .*, ts=…, fix=…\)"),
    ([mb.Experiment(ANGLE, ts=TS), ANGLE], {}, "a jaxmb.Experiment"),
    ([mb.Experiment(ANGLE, ts=TS, held_out=True)], {}, "no experiment to fit"),
    ([mb.Experiment(ANGLE, ts=TS, name="a"), mb.Experiment(ANGLE, ts=TS, name="a")], {}, "'a' of an experiment"),
    ([mb.Experiment(ANGLE, ts=TS, own=("rod.mas",))], {}, "did you mean 'rod.mass'"),
    ([mb.Experiment(ANGLE, ts=TS, parameters={"rod.mas": 1.0})], {}, "did you mean 'rod.mass'"),
    ([mb.Experiment(ANGLE, ts=TS, parameters={"rod.mass": 1.0})], {}, "unknown to every experiment"),
    ([mb.Experiment(ANGLE, ts=TS, free_initial=("rod.angel",))], {}, "did you mean 'rod.angle'"),
    ([mb.Experiment(ANGLE, ts=TS), mb.Experiment(ANGLE, ts=TS, own=["rod.mass"], held_out=True)], {}, "held out"),
    (ANGLE, {}, "ts is missing"),
    (ANGLE, {"ts": np.where(np.arange(30) == 3, np.nan, TS)}, r"ts\[3\] is nan"),
    (ANGLE, {"ts": np.where(np.arange(30) == 3, 0.0, TS)}, r"ts\[3\] = 0 follows"),
    ({"rod.angle": np.full(30, np.inf)}, {"ts": TS}, "infinite at sample 0"),
    ({"rod.angle": np.full(30, np.nan)}, {"ts": TS}, "holds no number"),
    ({"encoder": np.zeros(30)}, {"ts": TS, "sensors": [mb.Sensor("rod.angel", name="encoder")]}, "quantity of a"),
    (ANGLE, {"ts": TS, "sensors": [mb.Sensor("rod.position", name="rod.angle")]}, "is taken"),
    (
        ANGLE,
        {"ts": TS, "free": ["rod.angle.delay"], "t0": 0.0, "fix": {}, "bounds": {"rod.angl": (0, 1)}},
        "bounds",
    ),
    (ANGLE, {"ts": TS, "free": {"rod.angle.delay": 0.1}}, "smaller than 0.0333333 s"),
    (ANGLE, {"ts": TS, "sensors": [mb.Sensor("rod.angle", delay=0.1)]}, "reading at 0.0333333 s .* before 0.1 s"),
    (ANGLE, {"ts": TS, "prior": {"rod.mass": (1.0, 0.1)}}, "noise of a known size"),
    (ANGLE, {"ts": TS, "prior": {"rod.mass": (1.0, 0.0)}, "sigma": {"rod.angle": 1.0}}, "positive deviation"),
    (ANGLE, {"ts": TS, "prior": {"rod.mass": 1.0}, "sigma": {"rod.angle": 1.0}}, r"must be \(mean, deviation\)"),
    (ANGLE, {"ts": TS, "starts": 0}, "at least 1"),
    (ANGLE, {"ts": TS, "starts": [{"rod.inertia": 1.0}]}, "not free"),
    (ANGLE, {"ts": TS, "segments": 31}, "number of times, 30"),
    (ANGLE, {"ts": TS, "segments": 3, "starts": 2}, "one start"),
    (ANGLE, {"ts": TS, "segments": 3, "free": ["rod.angle.delay"]}, "has a delay"),
    (ANGLE, {"ts": TS, "inputs": {}}, "give it to an Experiment"),
]


def test_what_is_refused_of_experiments_and_sensors(system):
    for measured, change, message in REFUSED:
        with pytest.raises(ValueError, match=message):
            mb.identify(system, measured, **({"free": ["rod.mass"]} | change))
    own = mb.Scene([spatial.Body("top", mass=1.0, inertia=np.diag([2.0, 1.5, 1.0]))]).compile()
    data = {"top.angular_velocity": np.zeros((30, 3))}
    with pytest.raises(ValueError, match="not independent of each other"):
        mb.identify(own, data, ts=TS, free_initial=["top.orientation"])


@pytest.mark.slow
def test_an_experiment_without_unknowns(system):
    """Its own parameters are all that is free; it is predicted all the same."""
    motion = mb.simulate(system, system.guess, t1=TS[-1], saveat=TS, solver=TSIT5)
    own = mb.Experiment({"rod.angle": motion["rod"].angle}, ts=TS)
    known = dataclasses.replace(own, parameters={"spring.stiffness": 6.0}, held_out=True)
    fit = mb.identify(system, [known, own], free={"spring.stiffness": 8.0}, solver=TSIT5)
    np.testing.assert_allclose(fit.parameters["spring.stiffness"], 6.0, rtol=1e-6)
    assert len(fit.held_out) == 1
    np.testing.assert_allclose(fit.predict("rod.angle", experiment="exp1").values["rod.angle"], motion["rod"].angle)
