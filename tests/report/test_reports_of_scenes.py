"""Reports of a user's own system and state: their errors are the true ones."""

import functools
import importlib
import json
import types

import diffrax
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.report import stress_test, work_precision

stress = importlib.import_module("jaxmb.report.stress_test")


@pytest.fixture(scope="module")
def oscillator():
    """A mass on a spring, x = 1 + cos(3 t): k / m = 9."""
    mass = planar.PointMass("mass", mass=1.0, position=(2.0, 0.0))
    forces = [planar.SpringDamper("spring", "ground", "mass", stiffness=9.0, free_length=1.0)]
    system = mb.Scene([mass], forces=forces).compile()
    return system, mb.assemble(system), 1.0


@pytest.mark.slow
def test_work_precision_has_the_true_error(oscillator):
    """Against the closed form, x = 1 + cos 3t; and an error that the reference cannot tell is no number."""
    system, state, t1 = oscillator
    tolerances = (1e-3, 1e-12)
    report = work_precision(
        system, state, t1=t1, solvers={"Dopri8": diffrax.Dopri8()}, tolerances=tolerances, repeats=1
    )
    loose, tight = report["error"]
    end = mb.simulate(system, state, t1=t1, rtol=1e-3, solver=diffrax.Dopri8()).ys
    # Relative to the largest coordinate and to the largest velocity, at any of the times that the reference knows.
    speeds = 3 * np.abs(np.sin(3 * np.linspace(0.0, t1, 21)))
    true = max(
        abs(float(end.q[-1, 0]) - 1 - np.cos(3.0)) / 2, abs(float(end.u[-1, 0]) + 3 * np.sin(3.0)) / speeds.max()
    )
    assert loose == pytest.approx(true, rel=1e-6)
    # The reference has a tolerance of 1e-13 itself.
    assert tight == "small" and report.notes[-1].startswith("small: below the reference's accuracy")


def test_reports_that_cannot_be_are_refused(oscillator):
    system, state, _ = oscillator
    with pytest.raises(ValueError, match="needs a state"):
        work_precision(system, state)
    with pytest.raises(ValueError, match="got Scene"):
        stress_test(mb.Scene([planar.Body("rod", mass=1.0, inertia=1.0)]))
    with pytest.raises(ValueError, match="between 0 and 1"):
        work_precision(system, state, t1=1.0, tolerances=(2.0,))
    with pytest.raises(ValueError, match="did you mean 'lengths'"):
        stress_test(system, state, t1=1.0, only=["length"])


def test_stress_test_judges_the_error_at_the_end(oscillator, monkeypatch):
    """Relative to the largest value along the motion; no number below ten times the accuracy of the reference."""
    system, state, t1 = oscillator
    trial = functools.partial(stress._Trial, "a case", lambda: (system, state, t1), 1e-8)
    truth = np.array([[0.0], [4.0], [2.0]])
    ended = lambda motion, result: types.SimpleNamespace(ys=(motion,), stats={"num_steps": 3}, result=result)
    monkeypatch.setattr(stress, "_natural", lambda system, ys: ys)

    def judged(end, known, result=mb.RESULTS.successful):
        motion = np.array([[9.0], [9.0], [end]])
        monkeypatch.setattr(stress, "_run", lambda *arguments: ended(motion, result))
        case = stress._judge("a kind", trial(truth=(known,)), None)
        return case.error, case.known_to

    assert judged(2.4, ((truth,), 1e-3)) == (pytest.approx(0.1), pytest.approx(1e-2))
    assert judged(2.004, ((truth,), 1e-3)) == ("small", pytest.approx(1e-2))
    assert judged(2.4, None) == ("unknown", None)
    assert judged(2.4, ((truth,), 1e-3), mb.RESULTS.max_steps_reached) == ("refused", None)


@pytest.mark.slow
def test_stress_test_of_a_scene(oscillator, tmp_path):
    """Errors of known motions; a spring too stiff for the steps allowed, and what does not apply."""
    system, state, t1 = oscillator
    report = stress_test(system, state, t1=t1, only=["rtol", "lengths", "initial speed", "doubled joint"])
    errors = {(kind, case): error for kind, case, error, *_ in report.rows}
    assert errors["rtol", "1e-04"] < 1e-2
    assert errors["rtol", "1e-10"] < 1e-7 < 1e3 * errors["rtol", "1e-06"]
    for kind, _, error, known_to, _ in report.rows:
        assert error == "small" or error >= known_to
        if kind == "lengths":
            assert error == pytest.approx(errors["rtol", "1e-08"], rel=0.5)
    text = str(report)
    assert "initial speed: left out" in text and "doubled joint: left out, there are no joints" in text
    assert json.loads(json.dumps(report.to_dict()))["rows"][0]["variant"] == "rtol"
    report.figure(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_stress_test_of_a_scene_with_internal_states():
    """A rod with a motor that lags: its force counts among the errors, and variants start with it."""
    rod = planar.Body("rod", mass=2.0, inertia=0.3)
    pin = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    motor = mb.Motor("motor", "pin.angle", command=1.2, lag=0.1)
    system = mb.Scene([rod], joints=[pin], forces=[motor]).compile()
    state = mb.assemble(system, fix={"motor.force": 4.0}, rates={"pin.angle": 1.0})
    report = stress_test(system, state, t1=0.5, rtol=1e-8, only=["rtol", "lengths", "initial speed", "doubled joint"])
    errors = {(kind, case): error for kind, case, error, *_ in report.rows}
    assert "lengths: left out, the internal states motor.force have an unknown power of length" in str(report)
    assert {kind for kind, _ in errors} == {"rtol", "initial speed", "doubled joint"}
    assert errors["rtol", "1e-04"] > errors["rtol", "1e-08"] > 0
    for key in (("rtol", "1e-08"), ("doubled joint", "the same"), ("initial speed", "× 1e+01")):
        assert errors[key] == "small" or errors[key] < 1e-6, key
    # A body too heavy for the motor moves uniformly, and what errors there are are those of the force.
    idle = mb.with_parameters(system, {"rod.inertia": 1e9})
    coarse = stress_test(idle, state, t1=0.5, only=["rtol"])["error"][0]
    assert coarse > 1e-8


@pytest.mark.slow
def test_stress_test_of_a_pendulum(pendulum):
    """Every kind of variant of one body; the position below the pin is no singular one, but can be named."""
    system, state = pendulum
    report = stress_test(system, state, t1=1.0, singular={"rod.angle": -np.pi / 2})
    kinds = {"rtol", "long horizon", "stiffness", "mass", "lengths", "initial speed", "near-singular", "doubled joint"}
    assert set(report["variant"]) == kinds
    assert report.notes[-1].startswith("alternating masses: left out, there are no two bodies")
    errors = {(kind, case): error for kind, case, error, *_ in report.rows}
    assert all(isinstance(error, str) or error < 1e-4 for error in errors.values()), report
    assert errors["doubled joint", "1e-06 off"] == "refused" and "pin again" in str(report)
    assert all(isinstance(errors["stiffness", f"× 1e+0{k}"], float) for k in (2, 4))
    assert errors["stiffness", "× 1e+14"] == "refused" and "maximum number of solver steps" in str(report)
