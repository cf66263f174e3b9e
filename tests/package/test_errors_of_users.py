"""Errors of a user's own function pass with their type, message and traceback."""

import traceback
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb._traced_functions import asked_argument, is_of_user
from jaxmb.cli import main

TABLE = {"a": 1.0}


def missing_file(*_):
    return np.loadtxt("no such file.csv")


def missing_entry(*_):
    return TABLE["x"]


def entry_of_two(values):
    """Of two dictionaries, the user's, that have no such entry, neither has the function's argument."""
    table = {"b": 1.0}
    return values["a"] + table["x"]


def wrong_sum(*_):
    return None + 1


def error_of_its_own(*_):
    raise ValueError("the wind is too strong")


ERRORS = {
    missing_file: (OSError, "no such file.csv"),
    missing_entry: (KeyError, "x"),
    wrong_sum: (TypeError, "unsupported operand"),
    error_of_its_own: (ValueError, "the wind is too strong"),
}


def with_force(function):
    bob = planar.PointMass("bob", mass=1.0)
    return mb.Scene([bob], forces=[mb.Force("wind", "bob", lambda x, v, t, p: function())]).compile()


def with_drive(function):
    bob = planar.Body("bob", mass=1.0, inertia=0.1)
    turn = planar.Driver("turn", "ground", "bob", quantity="angle", motion=lambda t, p: function())
    return mb.Scene([bob], joints=[turn]).compile()


def with_lagrangian(function):
    potential = lambda t, q, p: function()
    return mb.lagrangian.LagrangianSystem(kinetic=lambda t, q, v, p: v @ v, potential=potential, q=[1.0])


def in_design(function):
    system = mb.mechanisms.get("pendulum").system
    return mb.design(system, {"a": 1.0}, lambda values: {"bob.mass": function()})


PLACES = {
    "Force 'wind'": with_force,
    "residual of Driver 'turn'": with_drive,
    "potential": with_lagrangian,
    "": in_design,
    " ": lambda function: mb.optimise(lambda v: v["a"] + function(), {"a": 1.0}),
}


@pytest.mark.parametrize("place", PLACES)
def test_an_error_passes(place):
    for function, (kind, message) in ERRORS.items():
        with pytest.raises(kind, match=message) as caught:
            PLACES[place](function)
        assert type(caught.value) is not ValueError or kind is ValueError
        assert function.__name__ in [own.name for own in traceback.extract_tb(caught.value.__traceback__)]
        notes = getattr(caught.value, "__notes__", [])
        assert not place.strip() or any(place in note for note in notes)


def test_the_dictionary_that_was_asked():
    """Of two the one in front of the brackets; an argument alone is said to have other names."""
    given = {"a": 1.0}
    with pytest.raises(KeyError) as caught:
        entry_of_two(given)
    assert asked_argument(caught.value) is None
    with pytest.raises(KeyError, match="'x'") as caught:
        mb.robust(entry_of_two, {"a": np.array([0.0, 0.1])})({"a": jnp.ones(())})
    assert not isinstance(caught.value, ValueError)
    with pytest.raises(mb.UnknownNameError, match="Unknown parameter 'y'"):
        mb.robust(lambda v: v["y"], {"a": np.array([0.0, 0.1])})({"a": jnp.ones(())})
    with pytest.raises(ValueError, match="asks for 'x', which the function of optimise does not get; v has 'a'"):
        mb.optimise(lambda v: v["a"] + v["x"], given)


def test_whose_an_error_is():
    """A line of the user's, the standard library or another package that it calls; not JAX on what it hands on."""
    for function, of_user in (
        (missing_file, True),
        (missing_entry, True),
        (lambda: Path("no such file.csv").read_text(), True),
        (lambda: jnp.ones(2) @ jnp.ones(3), False),
        (lambda: mb.mechanisms.get("pendulm"), False),
    ):
        with pytest.raises((OSError, KeyError, TypeError, ValueError)) as caught:
            function()
        assert is_of_user(caught.value) == of_user


def test_a_callback_that_fails_in_a_trial_is_no_failed_trial():
    def read(x):
        if x > 1.2:
            raise OSError("the disk is gone")
        return x

    def objective(v):
        a = jax.lax.stop_gradient(v["a"])
        return jax.pure_callback(read, jax.ShapeDtypeStruct((), a.dtype), a) + v["a"] ** 2

    with pytest.raises(RuntimeError, match="the disk is gone"):
        mb.optimise(objective, {"a": 1.5})


FILE = """
import jaxmb as mb
def wrong(mass=1.0):
    return None + mass
def own(mass=1.0):
    raise RuntimeError("no licence")
"""


def test_a_file_that_fails(capsys, tmp_path):
    file = tmp_path / "own.py"
    file.write_text(FILE)
    command = lambda name: ["run", f"{file}:{name}", "--out", str(tmp_path / "out"), "--set", "mass=2.0"]
    with pytest.raises(TypeError, match="unsupported operand"):
        main(command("wrong"))
    assert main(command("own")) == 1
    said = capsys.readouterr().err
    assert "RuntimeError: no licence" in said and 'own.py", line 6, in own' in said
    assert main(command("other")) == 2 and "has no 'other'; give module:function" in capsys.readouterr().err
    assert main(["run", f"{tmp_path}/none.py:own"]) == 2 and "there is no file" in capsys.readouterr().err
    assert main(["run", "no_such_module:own"]) == 2 and "No module named 'no_such_module'" in capsys.readouterr().err
    file.write_text("import no_such_package")
    with pytest.raises(ModuleNotFoundError, match="no_such_package"):
        main(command("own"))
