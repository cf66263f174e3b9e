"""Reports of a user's own system and state: their errors are the true ones."""

import dataclasses
import json
import sys

import diffrax
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.cli import main
from jaxmb.report import left_out, stress_test, work_precision
from jaxmb.report.reference import MARGIN
from jaxmb.solvers import Adams

# A mass on a spring, x = cos(3 t): k / m = 9.
OSCILLATOR = """
import jaxmb as mb
from jaxmb import planar

def oscillator(stiffness=9.0):
    mass = planar.PointMass("mass", mass=1.0, position=(2.0, 0.0))
    forces = [planar.SpringDamper("spring", "ground", "mass", stiffness=stiffness, free_length=1.0)]
    system = mb.Scene([mass], forces=forces).compile()
    return system, mb.assemble(system), 1.0
"""


@pytest.fixture(scope="module")
def oscillator():
    names: dict = {}
    exec(OSCILLATOR, names)
    return names["oscillator"]()


def test_the_error_is_the_true_one(oscillator):
    """Against the closed form, x = 1 + cos 3t; and an error that the reference cannot tell is no number."""
    system, state, t1 = oscillator
    tolerances = (1e-3, 1e-12)
    report = work_precision(
        system, state, t1=t1, solvers={"Dopri8": diffrax.Dopri8()}, tolerances=tolerances, repeats=1
    )
    loose, tight = report.runs
    end = mb.simulate(system, state, t1=t1, rtol=1e-3, solver=diffrax.Dopri8()).ys
    # Relative to the largest coordinate and to the largest velocity, at any of the times that the reference knows.
    speeds = 3 * np.abs(np.sin(3 * np.linspace(0.0, t1, 21)))
    true = max(
        abs(float(end.q[-1, 0]) - 1 - np.cos(3.0)) / 2, abs(float(end.u[-1, 0]) + 3 * np.sin(3.0)) / speeds.max()
    )
    assert loose.error == pytest.approx(true, rel=1e-6)
    assert tight.error is None or tight.error >= MARGIN * report.disagreement
    hidden = dataclasses.replace(report, runs=(loose, dataclasses.replace(tight, error=None)))
    assert "small: below the reference's accuracy" in str(hidden) and "small" in str(hidden).splitlines()[-1]
    assert json.loads(json.dumps(hidden.to_dict()))["runs"][1]["error"] is None


def test_what_is_asked_of_a_report(oscillator):
    system, state, _ = oscillator
    with pytest.raises(ValueError, match="needs a state"):
        work_precision(system, state)
    with pytest.raises(ValueError, match="got Scene"):
        left_out(mb.Scene([planar.Body("rod", mass=1.0, inertia=1.0)]))
    with pytest.raises(ValueError, match="between 0 and 1"):
        work_precision(system, state, t1=1.0, tolerances=(2.0,))
    with pytest.raises(ValueError, match="did you mean 'lengths'"):
        stress_test(system, state, t1=1.0, only=["length"])


def test_stress_of_a_scene(oscillator, tmp_path):
    """Errors of known motions; a spring too stiff for the steps allowed, and what does not apply."""
    system, state, t1 = oscillator
    report = stress_test(system, state, t1=t1, only=["rtol", "lengths", "initial speed", "doubled joint"])
    errors = {(case.kind, case.case): case for case in report.cases}
    assert errors["rtol", "1e-04"].error < 1e-2
    assert errors["rtol", "1e-10"].error < 1e-7 < 1e3 * errors["rtol", "1e-06"].error
    for case in report.cases:
        assert case.error is None or case.error >= case.known_to
        if case.kind == "lengths":
            assert case.error == pytest.approx(errors["rtol", "1e-08"].error, rel=0.5)
    text = str(report)
    assert "initial speed: left out" in text and "doubled joint: left out, there are no joints" in text
    assert json.loads(json.dumps(report.to_dict()))["cases"][0]["kind"] == "rtol"
    report.figure(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_stress_of_a_scene_with_internal_states():
    """A rod with a motor that lags: its force counts among the errors, and variants start with it."""
    rod = planar.Body("rod", mass=2.0, inertia=0.3)
    pin = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    motor = mb.Motor("motor", "pin.angle", command=1.2, lag=0.1)
    system = mb.Scene([rod], joints=[pin], forces=[motor]).compile()
    state = mb.assemble(system, fix={"motor.force": 4.0}, rates={"pin.angle": 1.0})
    report = stress_test(system, state, t1=0.5, rtol=1e-8, only=["rtol", "lengths", "initial speed", "doubled joint"])
    cases = {(case.kind, case.case): case for case in report.cases}
    assert "lengths: left out, the internal states motor.force are of no known power of a length" in str(report)
    assert {kind for kind, _ in cases} == {"rtol", "initial speed", "doubled joint"}
    assert cases["rtol", "1e-04"].error > cases["rtol", "1e-08"].error > 0
    for key in (("rtol", "1e-08"), ("doubled joint", "the same"), ("initial speed", "× 1e+01")):
        case = cases[key]
        assert not case.message and (case.error is None or case.error < 1e-6), case
    # A body too heavy for the motor moves uniformly, and what errors there are are those of the force.
    idle = mb.with_parameters(system, {"rod.inertia": 1e9})
    coarse = stress_test(idle, state, t1=0.5, only=["rtol"]).cases[0]
    assert coarse.error > 1e-8


@pytest.mark.long
def test_stress_of_a_pendulum(pendulum):
    """Every kind of variant of one body; the position below the pin is no singular one, but can be named."""
    system, state = pendulum
    report = stress_test(system, state, t1=1.0, singular={"rod.angle": -np.pi / 2})
    assert {case.kind for case in report.cases} == set(mb.report.KINDS) - {"alternating masses"}
    (remark,) = report.remarks
    assert remark.startswith("alternating masses: left out, there are no two bodies")
    for case in report.cases:
        assert case.message or case.error is None or case.error < max(1e-4, 1e3 * 1e-8), case
    (off,) = [case for case in report.cases if case.case == "1e-06 off" and case.kind == "doubled joint"]
    assert off.verdict == "refused" and "pin again" in off.message
    stiff = [case for case in report.cases if case.kind == "stiffness"]
    assert [case.case for case in stiff if case.error is not None][:2] == ["× 1e+02", "× 1e+04"]
    assert "maximum number of solver steps" in stiff[-1].message


@pytest.mark.long
def test_what_a_pendulum_leaves_out(pendulum, tmp_path):
    system, state = pendulum
    report = left_out(system, state, t1=1.0, repeats=1)
    cases = {case.what: case for case in report.cases}
    assert next(iter(cases)) == "nothing" and {"a joint twice", "rows between velocities", "an event"} < set(cases)
    for what, case in cases.items():
        assert case.trace > 0 and case.compile > 0 and case.run > 0
        assert what == "nothing" or case.lines > cases["nothing"].lines
        assert abs(case.evaluations - cases["nothing"].evaluations) <= 20
    assert "not needed: derivatives of constraints" in str(report) and "charts, a dense Jacobian: " in str(report)
    assert json.loads(json.dumps(report.to_dict()))["cases"][0]["what"] == "nothing"
    report.figure(tmp_path / "figure.png")


def test_reports_on_the_command_line(capsys, tmp_path, monkeypatch):
    """Of a function in a file and in a module, with its arguments; figures and data are written."""
    (tmp_path / "mine.py").write_text(OSCILLATOR)
    # The function of the same name hides the module.
    own = sys.modules["jaxmb.report.work_precision"]
    monkeypatch.setattr(own, "default_solvers", lambda: {"Adams": Adams()})
    where = f"{tmp_path / 'mine.py'}:oscillator"
    words = ["--tolerances", "1e-5", "--repeats", "1", "--out", str(tmp_path / "out"), "--set", "stiffness=16.0"]
    assert main(["report", "work_precision", where, *words]) == 0
    assert "oscillator, 1 s" in capsys.readouterr().out
    data = json.loads((tmp_path / "out" / "work_precision.json").read_text())
    assert data["mechanism"] == "oscillator" and data["runs"][0]["error"] < 1e-3
    assert (tmp_path / "out" / "work_precision.png").read_bytes().startswith(b"\x89PNG")
    for name, message in ((f"{where}s", "has no 'oscillators'"), ("no_such_module:scene", "No module named")):
        assert main(["report", "stress_test", name, "--out", str(tmp_path / "out")]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.long
def test_stress_of_a_machine_with_a_rotor_a_mimic_joint_and_a_servo():
    """Variants whose masses alone change, while numbers of no known unit leave out those of other lengths."""
    bodies = [planar.Body(name, mass=1.0, inertia=0.1, position=(x, 0.0)) for name, x in (("rod", 0.5), ("tip", 1.5))]
    joints = [
        planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0)),
        planar.Revolute("elbow", "rod", "tip", point=(1.0, 0.0)),
        mb.JointInertia("rotor", "pin.angle", inertia=0.7),
        mb.JointCoupling("mimic", "elbow.angle", "pin.angle", coefficients=(0.0, 0.5)),
    ]
    servo = mb.Actuator("servo", "pin.angle", control=0.3, gain=(50.0, 0.0, 0.0), bias=(0.0, -50.0, -5.0))
    system = mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, -9.81)), servo]).compile()
    report = stress_test(system, mb.assemble(system), t1=0.3, only=["mass", "lengths"])
    assert report.remarks[0].startswith("lengths: left out, the units of mimic.coefficients, servo.control, servo.gain")
    assert len(report.cases) == 6 and all(case.error < 1e-8 for case in report.cases)
