"""The command line, run in this process."""

import importlib
import subprocess
import sys
import types

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb.cli import main
from jaxmb.cli.commands import parser

run = importlib.import_module("jaxmb.cli.run")


def test_mechanisms(capsys):
    assert main(["mechanisms"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert tuple(line.split()[0] for line in lines) == mb.mechanisms.names()
    assert all(len(line.split()) > 3 for line in lines)


@pytest.mark.slow
def test_run(capsys, tmp_path):
    """A run prints errors against reference values and a fit next to the truth, and writes its files."""
    words = ["run", "pendulum", "--t1", "1", "--rtol", "1e-8", "--tolerances", "1e-6", "--out", str(tmp_path)]
    assert main(words) == 0
    out = capsys.readouterr().out
    for text in ("pendulum", "elliptic functions", "Error against run time", "Identifying bar.length", "true value 1"):
        assert text in out
    motion = mb.load(tmp_path / "motion.npz")
    assert motion["t"][-1] == 1.0 and motion["bob.position"].shape == (motion["t"].size, 2)
    for name in ("work_precision.png", "motion.png", "mechanism.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_run_of_a_lagrangian_system(capsys, tmp_path):
    """Coordinates take the place of positions, and of the picture of the mechanism."""
    assert main(["run", "roller_racer", "--rtol", "1e-8", "--tolerances", "1e-6", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    for text in (
        "QuasiVelocityFrame",
        "no constraints",
        "DOP853",
        "Identifying handle from coordinates",
        "true value 0.2",
    ):
        assert text in out
    assert mb.load(tmp_path / "motion.npz")["theta"][-1] == pytest.approx(6.2350455697, abs=1e-6)
    assert {path.name for path in tmp_path.iterdir()} == {"motion.npz", "motion.png", "work_precision.png"}


WRONG_RUNS = [
    (["pendulm"], "did you mean 'pendulum'"),
    (["pendulum", "--t1", "-1"], "--t1 must be positive"),
    (["pendulum", "--rtol", "2"], "rtol must be between"),
    (["pendulum", "--set", "mas=2.0"], "did you mean 'mass'"),
    (["pendulum", "--set", "mass=heavy"], "pendulum cannot be built with --set mass='heavy'"),
    (["pendulum", "--set", "mass=[1, 2]"], "pendulum cannot be built with --set mass=[1, 2]"),
    (["n_four_bar", "--set", "n=two"], "n_four_bar cannot be built with --set n='two'"),
    (["train", "--set", "n={}"], "train cannot be built with --set n={}"),
    # One line, whatever the mechanism did with the value.
    (["four_bar", "--set", "speed=fast"], "four_bar cannot be built with --set speed='fast'"),
]


def test_wrong_words_are_told(capsys, tmp_path):
    for words, message in WRONG_RUNS:
        assert main(["run", *words, "--out", str(tmp_path)]) == 2
        assert message in (told := capsys.readouterr().err) and told.count("\n") == 1


def test_run_fits_the_parameter_that_moves_most(monkeypatch):
    """Of the pendulum's mass, which moves it by one length per relative change here, and its length, by minus five."""
    at = lambda values: jnp.stack([100.0 + values["bob.mass"] - 5.0 * values["bar.length"]])
    moved = lambda system, state, **options: types.SimpleNamespace(quantity=lambda name: at(mb.parameters(system)))
    monkeypatch.setattr(run, "simulate", moved)
    monkeypatch.setattr(run, "assemble", lambda system, state, **options: state)
    assert run._most_sensitive(mb.mechanisms.get("pendulum"), np.linspace(0.0, 1.0, 3)) == "bar.length"


def test_run_of_a_function_with_arguments_says_which_it_needs(capsys, tmp_path):
    file = tmp_path / "own.py"
    file.write_text("def scene(mass, length=1.0):\n    raise ValueError('called')\n")
    words = ["run", f"{file}:scene", "--out", str(tmp_path / "out")]
    for given, message in (
        ([], "own.py:scene: missing a required argument: 'mass'; --set NAME=VALUE"),
        (["--set", "mas=2"], "missing a required argument: 'mass'"),
        (["--set", "mass=1", "--set", "lenth=2"], "got an unexpected keyword argument 'lenth'"),
        (["--set", "mass=1"], "called"),
    ):
        assert main([*words, *given]) == 2
        assert message in capsys.readouterr().err


def test_run_checks_first_where_to_write(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(mb.mechanisms, "get", lambda *args, **kwargs: pytest.fail("built before the check"))
    taken = tmp_path / "taken"
    taken.write_text("")
    for out in (taken, taken / "deeper"):
        assert main(["run", "pendulum", "--out", str(out)]) == 2
        assert "is a file and not a folder" in capsys.readouterr().err
    monkeypatch.setattr("os.access", lambda *args: False)
    assert main(["run", "pendulum", "--out", str(tmp_path / "new")]) == 2
    assert "is not writable" in capsys.readouterr().err


def test_help_on_a_name(capsys):
    assert main(["help", "Trajectory.reactions"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("jaxmb.Trajectory.reactions\n\nForces of the joints")
    assert main(["help", "Trajectory.reactions", "Event"]) == 0
    both = capsys.readouterr().out
    assert both.startswith(out) and "jaxmb.Event(" in both
    assert main(["help"]) == 0
    out = capsys.readouterr().out
    assert "jaxmb help planar" in out.split("\n\n")[0] and "jaxmb.studies" not in out
    assert "Scenes and their numbers" in out and "four_bar" in out and "Crank, coupler and rocker" not in out
    assert main(["help", "--all"]) == 0
    assert "  mechanisms.four_bar  Crank, coupler and rocker" in capsys.readouterr().out


def test_help_on_a_part_has_its_methods_with_all(capsys):
    assert main(["help", "JointSpring"]) == 0
    short = capsys.readouterr().out
    assert "with_numbers" not in short and short.endswith("jaxmb help --all JointSpring`\n")
    assert main(["help", "--all", "JointSpring", "parts.AbstractForce"]) == 0
    assert "  with_numbers  " in (out := capsys.readouterr().out) and "From parts.AbstractPart" in out
    assert main(["help", "parts.AbstractForce"]) == 0
    assert "From parts.AbstractPart" in capsys.readouterr().out


def test_help_on_names_that_differ_by_capitals(capsys):
    assert main(["help", "cylinder"]) == 0
    assert "jaxmb help planar.Cylinder`" in capsys.readouterr().out


def test_help_on_a_topic(capsys):
    assert main(["help", "tolerances", "planar.Revolute"]) == 0
    out = capsys.readouterr().out
    assert (
        out.startswith("Tolerances\n\n") and "\n    motion = jaxmb.simulate(" in out and "jaxmb.planar.Revolute(" in out
    )
    assert main(["help"]) == 0
    assert "\n  tolerances  `rtol` and `atol` bound the error of each step.\n" in capsys.readouterr().out


def test_help_on_an_unknown_name(capsys):
    assert main(["help", "simulat"]) == 2
    assert capsys.readouterr().err.startswith("jaxmb: Unknown name 'simulat'; did you mean 'simulate'")
    assert main(["help", "spring"]) == 2
    assert "'SpringDamper'" in capsys.readouterr().err
    assert main(["help", "restitution"]) == 2
    assert "Stop" in capsys.readouterr().err
    # Words that are no arguments, of names and topics.
    for word, found in (("belt", "planar.Track"), ("hydraulic", "which-force")):
        assert main(["help", word]) == 2
        assert found in capsys.readouterr().err.split("is explained in")[1]


def test_run_that_is_interrupted(capsys, monkeypatch):
    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(mb.mechanisms, "get", interrupt)
    assert main(["run", "pendulum"]) == 130
    assert capsys.readouterr().err == "jaxmb: interrupted\n"


def test_command_that_is_missing(capsys):
    assert main([]) == 0
    said = capsys.readouterr()
    assert said.out.startswith("usage: jaxmb") and "sweep" in said.out and said.err == ""


def test_parameters_of_a_mechanism():
    parse = parser().parse_args
    assert dict(parse(["run", "tracked_vehicle", "--set", "units=2", "--set", "model=bodies"]).set) == {
        "units": 2,
        "model": "bodies",
    }
    with pytest.raises(SystemExit):
        parse(["run", "pendulum", "--set", "mass"])


@pytest.mark.slow
def test_help_as_a_module():
    """It is no error if the program that reads the output ends before it has read all."""
    command = f"{sys.executable} -m jaxmb help | head -1"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("`jaxmb help NAME`") and done.stderr == ""
