"""What a REPL, a notebook's cell and `print` show of results, alone and in lists, dictionaries and classes."""

import dataclasses
import inspect
from typing import Any

import jax
import jax.numpy as jnp
import pytest

import jaxmb as mb
from jaxmb import planar, report
from jaxmb._printed import Printed
from jaxmb.contacts.events import ContactEvents
from jaxmb.studies.linear.floquet import Floquet


@dataclasses.dataclass
class Kept:
    """As a user keeps results together."""

    result: Any


def bar():
    body = planar.Body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    return mb.Scene([body], joints=[pin], forces=[mb.Gravity((0.0, -9.81))])


def one_impact():
    return ContactEvents(
        ("floor",),
        1,
        times=jnp.array([1.0, jnp.inf]),
        impulses=jnp.array([[3.0], [0.0]]),
        kinetic_energy_lost=jnp.array([0.5, 0.0]),
        before=jnp.zeros((2, 1)),
        after=jnp.zeros((2, 1)),
        rest=jnp.zeros((2, 1)),
    )


def shown_of(kind):
    """An object, what its line begins with, and words of its table."""
    if kind == "scene":
        return bar(), "Scene: 1 bodies, 1 joints, 1 forces", ("Revolute 'pin'", "compile()")
    if kind == "system":
        return (
            bar().compile(),
            "RigidBodySystem: planar, 1 body, 1 degree of freedom",
            ("Revolute", "degrees of freedom"),
        )
    if kind == "optimum":
        return mb.optimise(lambda v: (v["x"] - 1) ** 2, {"x": 0.0}), "Optimum: objective 0, converged", ("iteration",)
    if kind == "events":
        return one_impact(), "ContactEvents: 1 of floor", ("impulse [N s]", "impact")
    two = Floquet(jnp.diag(jnp.array([0.5, 2.0])), ("a", "b"), 1, jnp.eye(2), jnp.asarray(3.0))
    return two, "Floquet: 2 states", ("period 3 s",)


@pytest.mark.slow("floquet")
@pytest.mark.parametrize("kind", ["scene", "system", "optimum", "events", "floquet"])
def test_a_line_in_lists_and_a_table_alone(kind):
    shown, begin, words = shown_of(kind)
    line, text, page = repr(shown), str(shown), shown._repr_html_()
    assert line.startswith(begin) and "\n" not in line and len(line) < 200
    assert repr([shown]) == f"[{line}]" and repr({"a": shown}) == f"{{'a': {line}}}" and repr((shown,)) == f"({line},)"
    assert f"result={line})" in repr(Kept(shown))
    for word in words:
        assert word in text
    assert "\n" in text and page.startswith("<")


def test_what_is_traced_is_a_line_as_well():
    system, found = bar().compile(), {}

    @jax.jit
    def run(mass):
        own = mb.with_parameters(system, {"bar.mass": mass})
        found["system"] = repr(own)
        return mass

    run(2.0)
    assert found["system"].startswith("RigidBodySystem: planar")
    events = jax.tree.map(lambda x: jnp.stack([x, x]), one_impact())
    assert repr(events) == str(events) == "ContactEvents: of floor, times of shape (2, 2)"


def test_a_good_result_says_so():
    assert repr(mb.RESULTS.successful) == "jaxmb._results.RESULTS<successful>"
    assert mb.RESULTS[mb.RESULTS.successful] == "successful"


def test_tables_of_reports_are_shown_in_cells():
    tables = [x for _, x in inspect.getmembers(report, inspect.isclass) if "__str__" in x.__dict__]
    assert tables == [report.Table]
    assert issubclass(report.Table, Printed) and "__repr__" not in report.Table.__dict__

    class Two(Printed):
        def __str__(self):
            return "a < b\nc"

    assert (
        Two()._repr_html_() == "<pre>a &lt; b\nc</pre>" and repr(Two()) == "Two: a table of 2 lines, which print shows"
    )
