"""What an identification says of its own fit: right ones are not accused, and wrong ones never end as converged."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled
from identifying import slider_crank, swing
from scipy.stats import binom

import jaxmb as mb
from jaxmb.studies.identify import verdict
from jaxmb.studies.identify.loss import LOSSES
from jaxmb.studies.identify.residuals import Bias, Series, outliers
from jaxmb.studies.ranges import HalfLine, Inertia, Interval, WholeLine

MOST_PROGRAMS = 140

# Compiles faster than Adams, where the solver does not matter.
TSIT5 = diffrax.Tsit5()
# All data sets of the swing have the same times and lack some of them: all fits share one compiled program.
TS = np.linspace(0.0, 4.0, 2001)[1:]
START = {"fix": {"theta": 0.5}}
TRUE = {"length": 0.8, "damping": 0.3}
NOISE = 0.01


@pytest.fixture(scope="module")
def system():
    return swing()


@pytest.fixture(scope="module")
def exact(system):
    return np.asarray(mb.simulate(system, mb.assemble(system, **START), t1=TS[-1], saveat=TS, solver=TSIT5)["theta"])


def samples(exact, count, noise, seed):
    """Some of the times, evenly; the others are missing."""
    chosen = np.linspace(0, exact.size - 1, count).round().astype(int)
    out = np.full(exact.size, np.nan)
    out[chosen] = exact[chosen] + noise * np.random.default_rng(seed).standard_normal(count)
    return {"theta": out}


def fitted(system, measured, sigma, **change):
    known = {} if sigma is None else {"sigma": {"theta": sigma}}
    arguments = {"free": {"length": 0.9, "damping": 0.2}, "solver": TSIT5} | START | known | change
    return mb.identify(system, measured, ts=TS, **arguments)


# Samples, noise of the data, sigma that is given.
RIGHT = [
    (30, NOISE, NOISE),
    (30, NOISE, None),
    (100, 0.0, NOISE),
    (300, 0.1, 0.1),
    (300, 0.1, None),
    (2000, NOISE, None),
    (2000, 0.0, None),
]


@pytest.mark.slow("30-0.01-0.01", "300-0.1-0.1", "30-0.01-None", "100-0.0-0.01", "2000-0.01-None", "300-0.1-None")
@pytest.mark.parametrize("count, noise, sigma", RIGHT)
def test_a_right_fit_is_not_accused(system, exact, count, noise, sigma):
    check_right_fit(system, exact, (count, noise, sigma), count)


def check_right_fit(system, exact, case, seed):
    count, noise, sigma = case
    fit = fitted(system, samples(exact, count, noise, seed), sigma)
    assert fit.converged and not fit.warnings, fit
    assert fit.message == "converged" and str(fit).startswith("converged\n")
    for name, true in TRUE.items():
        assert abs(fit.parameters[name] - true) <= 5 * fit.deviations[name] + 1e-6, name


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 6))
def test_right_fits_of_a_swing_are_not_accused(system, exact, seed):
    case = RIGHT[seed]
    check_right_fit(system, exact, case, 1000 * seed + case[0])


def test_measurements_have_their_own_times(system, exact):
    data = samples(exact, 100, NOISE, 3)
    arguments = {"free": {"length": 0.9, "damping": 0.2}, "sigma": {"theta": NOISE}, "solver": TSIT5}
    direct = fitted(system, data, NOISE)
    read = mb.identify(system, mb.Measurements(TS, data), **START, **arguments)
    listed = mb.identify(system, [mb.Experiment(mb.Measurements(TS, data), **START)], **arguments)
    assert read.parameters == direct.parameters == listed.parameters


WRONG = {
    "another zero": (lambda x: x + 0.1, {}),
    "a delay": (lambda x: np.roll(x, 60), {}),
    "a gain": (lambda x: 1.2 * x, {}),
    "a drift": (lambda x: x + 0.02 * TS, {}),
    "bounds without the truth": (lambda x: x, {"bounds": {"length": (0.85, 1.0)}}),
    "no damping": (lambda x: x, {"free": {"length": 0.9, "damping": 0.0}, "bounds": {"damping": (-1e-3, 1e-3)}}),
    "another start of the motion": (lambda x: x, {"fix": {"theta": 0.65}}),
    "too few iterations": (lambda x: x, {"max_iterations": 3}),
    # It ends in motions that are fast, and take long to simulate.
    "another motion": (lambda x: np.sin(40 * TS), {}),
}


@pytest.mark.slow(
    but=(
        "another zero-with sigma",
        "a delay-without",
        "a drift-with sigma",
        "bounds without the truth-without",
        "no damping-with sigma",
        "too few iterations-with sigma",
    )
)
@pytest.mark.parametrize("sigma", [NOISE, None], ids=["with sigma", "without"])
@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_fit_says_so(system, exact, name, sigma):
    change, arguments = WRONG[name]
    fit = fitted(system, samples(change(exact), 200, NOISE, 5), sigma, **arguments)
    assert not fit.converged and fit.warnings and not fit.message.startswith("converged")
    assert str(fit).startswith("These estimates are not to be trusted")
    assert np.isnan(fit.deviations["length"]) and "nan" not in str(fit)
    words = fit.message
    if name == "too few iterations":
        assert "did not converge" in words
        return
    assert "starts=" in words and "segments=" in words and "bounds=" in words
    assert "not noise" in words or "explains nothing" in words
    assert ("far beyond sigma" in words) == (sigma is not None)
    if name == "another zero":
        assert "'theta.bias'" in words
    if name == "bounds without the truth":
        assert "length = 0.85 is at an end of its range" in words and "it is held by bounds=(" in words


# The speed is such that the phase of the crank depends much on the spring.
FAST = {"fix": {"crank.angle": 0.8}, "rates": {"crank.angle": 25.0}}
CRANK_TS = np.linspace(0.0, 6.0, 102)[1:]
STROKE = "cylinder.displacement"


@pytest.fixture(scope="module")
def crank():
    return slider_crank()


@pytest.fixture(scope="module")
def stroke(crank):
    """What is measured without noise: the error of a motion at the tolerance of the fits would move these."""
    motion = mb.simulate(crank, mb.assemble(crank, **FAST), t1=CRANK_TS[-1], saveat=CRANK_TS, solver=TSIT5, rtol=1e-11)
    return np.asarray(motion[STROKE.split(".")[0]].displacement)


def spring_of(crank, measured, start, **change):
    arguments = {"sigma": {STROKE: 2e-4}, "solver": TSIT5, "rtol": 1e-7} | FAST | change
    return mb.identify(crank, {STROKE: measured}, ts=CRANK_TS, free={"spring.stiffness": start}, **arguments)


@pytest.mark.slow
@pytest.mark.parametrize("zero, known", [(0.0, True), (0.4, False)], ids=["another minimum", "another zero"])
def test_the_spring_of_a_fast_slider_crank(crank, stroke, zero, known):
    """From half its stiffness, and from data that count from another zero than the joint."""
    measured = stroke + zero + 2e-4 * np.random.default_rng(0).standard_normal(stroke.size)
    change = {} if known else {"sigma": None}
    fit = spring_of(crank, measured, 100.0, **change)
    assert not fit.converged and abs(fit.parameters["spring.stiffness"] - 200) > 1
    assert "starts=" in fit.message and "segments=" in fit.message and "bounds=" in fit.message
    assert np.isnan(fit.deviations["spring.stiffness"])


@pytest.mark.slow
def test_right_fits_of_a_slider_crank_are_not_accused(crank, stroke):
    for seed in range(3):
        measured = stroke + 2e-4 * (seed > 0) * np.random.default_rng(seed).standard_normal(stroke.size)
        fit = spring_of(crank, measured, 199.5, **({} if seed % 2 else {"sigma": None}))
        assert fit.converged, fit
        assert abs(fit.parameters["spring.stiffness"] - 200) <= 5 * fit.deviations["spring.stiffness"] + 1e-4


FIXED = Bias(free=False)


def series(residuals, known=True, predicted=None, label="x", bias=FIXED):
    """Residuals as of a sensor at times 0, 1, …."""
    n = len(residuals)
    return Series(
        label,
        "",
        label,
        (),
        np.asarray(residuals, float),
        np.ones(n),
        known,
        0.5 if known else 1e-3,
        np.zeros(n) if predicted is None else predicted,
        np.arange(n, dtype=float),
        np.arange(n),
        bias,
    )


def said(own, loss="linear", starts=1, segments=1):
    tried = verdict.Tried(starts, segments)
    return "; ".join(verdict.of_residuals(own, outliers(tuple(own)), 1, LOSSES[loss], tried))


def test_what_was_tried_already_is_not_advised():
    shifted = 5 + np.random.default_rng(0).standard_normal(50)
    assert "(does the sensor count from another zero? Its offset, 'x.bias', can be free)" in said([series(shifted)])
    free = {name: said([series(shifted, bias=Bias(True, **{name: True}))]) for name in ("components", "experiments")}
    assert "one number for all components" in free["components"] and "own=" in free["experiments"]
    for words in (*free.values(), said([series(shifted, bias=Bias(True))])):
        assert "can be free" not in words and "'x.bias', is" in words and "or the model" in words
    first = said([series(shifted)])
    assert "try other starts (starts=), a range of plausible values (bounds=)" in first and "than these" not in first
    several = said([series(shifted)], starts=8)
    assert "Either the best of 8 starts ended" in several and "more starts (starts=)" in several
    pieces = said([series(shifted)], segments=16)
    assert "shorter pieces than these 16 (segments=)" in pieces and "starts=" not in pieces and "free=" in pieces


OFFSETS = np.array([0.1, -0.2])


@pytest.mark.slow
def test_an_offset_that_is_free_for_all_experiments_together(system, exact):
    start = START | {"ts": TS}
    data = [samples(exact + offset, 200, NOISE, 5) for offset in OFFSETS]
    fits = [
        mb.identify(
            system,
            [mb.Experiment(own, own=each, **start) for own in data],
            sigma={"theta": NOISE},
            free=[*TRUE, *shared],
            solver=TSIT5,
        )
        for shared, each in ((["theta.bias"], []), ([], ["theta.bias"]))
    ]
    assert not fits[0].converged and "not noise" in fits[0].message and "can be free" not in fits[0].message
    assert "its offset, 'theta.bias', is one for all experiments: name it in their own=" in fits[0].message
    assert fits[1].converged
    estimates = [fits[1].parameters[f"exp{k}/theta.bias"] for k in (1, 2)]
    np.testing.assert_allclose(estimates, OFFSETS, atol=0.01)


def test_what_does_not_matter_is_not_accused():
    """Systematic differences of a third of the noise, of a ten-thousandth of the range, and a slightly wrong sigma."""
    noise, wave = np.random.default_rng(0).standard_normal(20_000), np.sin(np.arange(20_000) / 50)
    assert not said([series(noise + 0.3 * wave)])
    assert not said([series(0.3 * wave)])
    assert not said([series(1.2 * noise)])
    assert not said([series(1e-4 * wave, known=False)])
    assert "far beyond sigma" in said([series(1.4 * noise)])
    assert "not noise" in said([series(noise + 0.8 * wave)])
    assert "not noise" in said([series(1e-2 * wave, known=False)])


def test_one_bad_sensor_among_good_ones_is_named():
    random = np.random.default_rng(0)
    own = [series(random.standard_normal(50), label=name) for name in "abcdefghij"]
    assert not said(own)
    own[3] = own[3]._replace(residuals=4 * own[3].residuals)
    assert "those of d by a factor of" in said(own)


def test_residuals_that_are_no_noise():
    """By their signs, by their correlation over some samples, and with what is predicted."""
    random = np.random.default_rng(1)
    noise, t = 0.02 * random.standard_normal(400), np.arange(400)
    assert "change their sign 0 times" in said([series(noise + 0.5, known=False)])
    assert "are correlated over" in said([series(noise + 0.05 * np.sign(np.sin(t * np.pi / 2 + 0.1)), known=False)])
    wild = random.standard_normal(400)
    assert "are correlated with the prediction" in said([series(noise + 0.02 * wild, known=False, predicted=wild)])
    # A prediction that has nothing to do with the data.
    assert "explains nothing" in said([series(noise + 3, known=False, predicted=0 * t)])


def test_a_robust_loss_expects_outliers():
    random = np.random.default_rng(2)
    noise = random.standard_normal(500)
    noise[::5] *= 40
    assert "beyond 5 σ: if these are outliers, take loss='soft_l1'" not in said([series(noise)])
    assert "far beyond sigma" in said([series(noise)]) and not said([series(noise)], "huber")
    assert "far beyond sigma" in said([series(30 * noise)], "soft_l1")
    # Outliers may follow each other.
    burst = np.where(np.arange(500) // 20 == 7, 40.0, random.standard_normal(500))
    assert "not noise" in said([series(burst)]) and not said([series(burst)], "soft_l1")
    few = np.where(np.arange(500) % 50, random.standard_normal(500), 40.0)
    assert "10 of 500 are beyond 5 σ: if these are outliers, take loss='soft_l1'" in said([series(few)])


def test_outliers_are_measured_by_the_median_of_many_residuals_or_the_square_of_few():
    many = np.append(np.random.default_rng(0).uniform(-1.0, 1.0, 40), 30.0)
    (found,) = outliers((series(many, known=False),))
    np.testing.assert_allclose(found.residual, 30.0 / (np.median(np.abs(many)) / 0.6745), rtol=1e-14)
    assert (found.sample, found.t) == ((40,), 40.0)
    assert not outliers((series(many[-8:], known=False),))
    (found,) = outliers((series(many),))
    assert found.residual == 30.0


@pytest.mark.parametrize("count, directions", [(10, 1), (30, 10), (100, 20)])
@pytest.mark.parametrize("rough", [False, True])
def test_probabilities_hold(count, directions, rough):
    """Chances below one in a hundred are as rare as that, for noise that any directions were fitted to."""
    random, draws, t = np.random.default_rng(0), 1000, (np.arange(count) + 0.5) / count
    frequencies = (count - 1 - np.arange(directions)) if rough else np.arange(directions)
    basis = np.linalg.qr(np.cos(np.pi * frequencies * t[:, None]))[0]
    accused = np.zeros(4)
    for _ in range(draws):
        noise = random.standard_normal(count)
        residuals = noise - basis @ (basis.T @ noise)
        own = series(residuals, predicted=30 * basis[:, -1] + residuals - noise)
        chances = [chance for *_, chance in verdict.dependences(own, residuals, directions)]
        chances.append(verdict.chi_squared(float(np.sum(residuals**2)), count - directions))
        accused += np.array(chances) < 1e-2
    assert np.all(accused <= binom.isf(1e-6, draws, 1e-2))


@pytest.mark.slow
def test_estimates_at_the_ends_of_their_ranges():
    """Close to a bound, and not determined well enough to tell; or so far away that nothing tells how far."""
    positive = HalfLine(jnp.asarray(100.0), jnp.asarray(0.0))
    at = lambda r, value, deviation: bool(np.all(r.at_end(r.locate(jnp.asarray(value)), np.asarray(deviation))))
    assert at(positive, 1.2e-6, 0.025) and at(positive, 1.2e-6, np.nan) and at(positive, 1.2e-6, np.inf)
    assert not at(positive, 1.2e-6, 1e-8) and not at(positive, 2.0, 3.0)
    assert at(positive, 1e6, 1e8) and not at(positive, 1e6, 1e3)
    between = Interval(jnp.asarray(1.0), jnp.asarray(0.0), jnp.asarray(1e4))
    assert at(between, 1e4 - 1e-3, 1.0) and at(between, 1e-3, 1.0) and not at(between, 2.0, 1.0)
    line = WholeLine(jnp.asarray(1.0), jnp.asarray(1.0))
    assert at(line, -1e5, 1e6) and not at(line, -1e5, 1.0)
    matrix = Inertia(2 * jnp.eye(3))
    thin = lambda share: matrix.at_end(matrix.locate(jnp.diag(jnp.array([1 + share, 1 + share, 2.0]))), np.ones((3, 3)))
    assert np.all(thin(1e-8)) and not np.any(thin(1e-3))


def test_starts_that_contradict_each_other():
    best, others = np.array([1.0, 2.0]), np.array([-1.0, 2.0])
    tell = lambda ends, count=None: list(verdict.of_starts(ends, ("a", "b"), np.array([0.01, 0.01]), count, 1.0))
    (words,) = tell([(10.0, best), (50.0, others), (10.5, others)])
    assert "another start fits as well with a = -1 instead of 1" in words and "bounds=" in words
    # One that fits worse; one that ends at the same estimates; data without noise, where only rounding is left.
    assert not tell([(10.0, best), (50.0, others)]) and not tell([(10.0, best), (10.0, best + 0.01)])
    assert not tell([(1e-20, best), (1e-2, others)], count=100) and tell([(1e-20, best), (1e-16, others)], count=100)
    # Estimates that are exact, or without a deviation, decide nothing.
    for deviation in (0.0, np.nan, np.inf):
        ends = [(10.0, best), (10.5, others)]
        assert not list(verdict.of_starts(ends, ("a", "b"), np.array([deviation, 0.01]), None, 1.0))


def test_outliers_are_marked(system, exact):
    """With their places in the data. Where the noise is estimated, it contains them, and they are only mentioned."""
    measured = samples(exact, 200, NOISE, 9)
    there = np.flatnonzero(np.isfinite(measured["theta"]))[[20, 77]]
    measured["theta"][there] += [0.09, -0.08]
    fitted(system, samples(exact, 200, NOISE, 1), None)
    for sigma in (NOISE, None):
        # Other data have the same programs.
        with compiled() as programs:
            fit = fitted(system, measured, sigma)
        assert not programs
        assert [own.sample for own in fit.outliers] == [(int(k),) for k in there]
        assert [own.t for own in fit.outliers] == list(TS[there])
        assert fit.outliers[0].residual < -5 < 5 < fit.outliers[1].residual
        assert fit.converged is (sigma is None)
        assert "beyond 5 σ" in fit.message and "loss='soft_l1'" in fit.message


@pytest.mark.slow
def test_no_bands_where_the_fit_explains_nothing(system, exact, tmp_path):
    fit = fitted(system, samples(exact + 0.1, 200, NOISE, 5), NOISE)
    page = fit.report(tmp_path / "page.html").read_text()
    assert (
        page.index("not to be trusted") < page.index("<table>") and "no fit" in page and "Residuals beyond 5 σ" in page
    )
    prediction = fit.predict("theta")
    assert np.all(np.isnan(prediction.low["theta"])) and np.all(np.isfinite(prediction.values["theta"]))
