"""What a user's function reads is changed and the system is built anew: it moves by the new number, and the old system,
which is still there, by the old one.
"""

import copy
import os
import sysconfig

import changing_numbers
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from changing_numbers import BALL, PIN, PLACES, WAYS

import jaxmb as mb
from jaxmb import planar
from jaxmb._captured import Captured
from jaxmb.simulate.captured import captured_event

MOST_PROGRAMS = 90


def check(place, way, first, second):
    """The law is proportional to its number, or adds to a part without it; a height changes directions as well."""
    build, compute, change = place(way)
    change(first)
    old = build()
    before = np.asarray(compute(old))
    change(second)
    after = np.asarray(compute(build()))
    change(0.5 * (first + second))
    between = np.asarray(compute(build()))
    assert np.max(np.abs(after - before)) > 1e-3
    near = 0.02 if "terrain" in place.__name__ else 1e-12
    np.testing.assert_allclose(between, 0.5 * (before + after), rtol=near, atol=1e-13)
    # The old system is still there, also in a program that it had no part in before.
    np.testing.assert_array_equal(compute(old), before)
    return old, compute, before


# One place of each way by which functions enter a system, of bodies, of forces, of joints, and of coordinates.
@pytest.mark.slow(but=("force", "driver", "velocity_constraint", "signal", "own_force", "potential", "own_holonomic"))
@pytest.mark.parametrize("place", PLACES, ids=lambda place: place.__name__)
def test_each_place_of_a_function(place):
    old, compute, before = check(place, changing_numbers.in_global, 1.5, 2.5)
    late = jax.jit(lambda own: own * compute(old))(1.0)
    np.testing.assert_allclose(late, before, rtol=1e-12)


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.__name__)
def test_each_way_to_hold_a_number(way):
    """Of a function of a user that is traced alone; a force of a scene is traced in the same way."""
    law, change = way(lambda k, x: k * x)

    def kept(value):
        change(value)
        own = Captured(law)
        own.trace(jnp.ones(2))
        own.keep()
        return own

    first, second = kept(1.5), kept(2.5)
    x = np.array([1.0, 2.0])
    np.testing.assert_array_equal(first(x), 1.5 * x)
    np.testing.assert_array_equal(second(x), 2.5 * x)
    assert first == kept(1.5) != second and hash(first) == hash(kept(1.5))


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.__name__)
def test_each_way_in_a_place(way):
    check(PLACES[WAYS.index(way)], way, 1.5, 2.5)


def test_the_same_functions_are_the_same_programs():
    def build(k):
        numbers, traced = {"k": k}, []

        def law(poses, velocities, t, p):
            traced.append(t)
            return -numbers["k"] * poses

        system = mb.Scene([BALL], forces=[mb.Force("law", "ball", law)]).compile()
        traced.clear()
        return system, traced

    compiled = []
    force = eqx.filter_jit(lambda system: compiled.append(1) or changing_numbers.of_force(system))
    (first, traced), (again, more), (other, _) = build(2.0), build(2.0), build(3.0)
    assert jax.tree.structure(first) == jax.tree.structure(again) != jax.tree.structure(other)
    assert hash(jax.tree.structure(first)) == hash(jax.tree.structure(again))
    np.testing.assert_array_equal(force(first), force(again))
    assert compiled == [1] and traced == more == []
    assert np.any(force(first) != force(other)) and compiled == [1, 1]


def test_scenes_without_functions_are_traced_by_nothing(monkeypatch):
    monkeypatch.setattr(Captured, "trace", lambda *given: pytest.fail("traced"))
    mb.Scene([BALL], joints=[PIN], forces=[mb.Gravity((0.0, -9.81))]).compile()


@pytest.mark.slow
def test_functions_of_a_run():
    """Of a force, of events, of what is saved, of a sweep without a store, and in a gradient by what they close over.

    A view that is first asked for after the change is that of its own motion.
    """
    numbers = {"k": 1.0}
    law = lambda poses, velocities, t, p: jnp.array([[0.0, 0.0, numbers["k"]]])
    system = mb.Scene([BALL], forces=[planar.Torque("motor", "ball", torque=2.0)]).compile()
    start = mb.assemble(system)
    reached = diffrax.Event(lambda t, y, args, **_: y.q[2] - 0.1 * numbers["k"], optx.Newton(1e-12, 1e-12))
    of_rates = lambda t, y, args, *, terms, t1, **_: (y.q[2] - 0.1 * numbers["k"]) * terms.vf(t, y, args).u[2] * t1
    saveat = diffrax.SaveAt(t1=True, fn=lambda t, y, args: numbers["k"] * y.q[2])
    inputs = lambda x: {"motor.torque": lambda t: numbers["k"] * x}
    angle = lambda x: mb.simulate(system, start, t1=1.0, inputs=inputs(x))["ball"].angle[-1]

    def pushed():
        own = mb.Scene([BALL], forces=[mb.Force("push", "ball", law)]).compile()
        return lambda t1: mb.simulate(own, mb.assemble(own, throw=False), t1=t1, throw=False)

    def swept():
        run = pushed()
        end = lambda t1: {"angle": run(t1)["ball"].angle[-1]}
        return float(mb.sweep(end, mb.cases.table(t1=[1.0]), progress=False)["angle"][0])

    soft = pushed()(1.0)
    for k in (1.0, 4.0):
        numbers["k"] = k
        for event in (reached, diffrax.Event(of_rates, optx.Newton(1e-10, 1e-10))):
            np.testing.assert_allclose(mb.simulate(system, start, t1=2.0, event=event).ts[-1], np.sqrt(0.1 * k))
        np.testing.assert_allclose(mb.simulate(system, start, t1=1.0, saveat=saveat).ys[-1], k, rtol=1e-9)
        np.testing.assert_allclose(jax.grad(angle)(3.0), 0.5 * k, rtol=1e-8)
        np.testing.assert_allclose(swept(), 0.5 * k, rtol=1e-8)
    np.testing.assert_allclose(soft.forces["push"][-1, 0, 2], 1.0, rtol=1e-14)
    np.testing.assert_allclose(pushed()(1.0).forces["push"][-1, 0, 2], 4.0, rtol=1e-14)


def test_a_function_of_other_shapes_is_called():
    numbers = {"k": 2.0}
    own = Captured(lambda x, power=1, more=None: numbers["k"] * x**power)
    np.testing.assert_array_equal(jax.eval_shape(own, jnp.ones(2)).shape, (2,))
    own.trace(jnp.ones(2), power=3)
    own.keep()
    numbers["k"] = 5.0
    x = jnp.array([1.0, 2.0])
    np.testing.assert_array_equal(own(x), [2.0, 4.0])
    np.testing.assert_array_equal(own(np.asarray(x), power=3), [2.0, 16.0])
    np.testing.assert_array_equal(own(x, power=2), [5.0, 20.0])
    np.testing.assert_array_equal(own(jnp.ones(3)), [5.0, 5.0, 5.0])
    # A number of Python's is an array without axes.
    of_time = Captured(lambda t: numbers["k"] * t)
    of_time.trace(jnp.zeros(()))
    of_time.keep()
    numbers["k"] = 7.0
    assert of_time(2.0) == of_time(2) == of_time(np.float64(2.0)) == 10.0
    np.testing.assert_array_equal(jax.vmap(own)(jnp.ones((4, 2))), np.full((4, 2), 2.0))
    assert copy.deepcopy(own) is own


def test_results_that_are_no_arrays_stay():
    own = Captured(lambda x: {"a": 1.0, "b": (x, np.ones(2), None, "word")})
    own.trace(jnp.zeros(()))
    own.keep()
    found = own(jnp.ones(()))
    assert found["a"] == 1.0 and isinstance(found["a"], float) and found["b"][2:] == (None, "word")
    np.testing.assert_array_equal(found["b"][1], np.ones(2))


def test_what_closes_over_traced_values_is_called():
    kept = []

    @jax.jit
    def run(k):
        own = Captured(lambda x: k * x)
        own.trace(jnp.ones(()))
        own.keep()
        kept.append(own)
        return own(2.0 * jnp.ones(())), jax.grad(own)(jnp.ones(()))

    assert run(3.0) == (6.0, 3.0)
    assert kept[0] != Captured(kept[0].function) and kept[0] == kept[0]


def test_callbacks_are_told_apart_by_the_function_that_is_called():
    shape = jax.ShapeDtypeStruct((), float)

    def captured(called):
        own = Captured(lambda x: jax.pure_callback(called, shape, x))
        own.trace(jnp.ones(()))
        own.keep()
        return own

    double, same = lambda x: 2 * x, lambda x: 2 * x
    assert captured(double) == captured(double) != captured(same)
    assert captured(double)(jnp.ones(())) == 2.0


def test_rules_of_derivatives_count():
    def captured(rule):
        @jax.custom_jvp
        def bent(x):
            return jnp.abs(x)

        bent.defjvp(lambda primals, tangents: (bent(*primals), rule(primals[0]) * tangents[0]))
        own = Captured(bent)
        own.trace(jnp.ones(()))
        own.keep()
        return own

    assert captured(jnp.sign) == captured(jnp.sign) != captured(jnp.tanh)
    np.testing.assert_allclose(jax.grad(captured(jnp.tanh))(1.0), np.tanh(1.0))


def scaled(x, numbers={"k": 2.0}):  # noqa: B006
    return numbers["k"] * x


def test_functions_sent_to_another_process():
    cloudpickle = pytest.importorskip("cloudpickle")
    own = Captured(scaled)
    own.trace(jnp.ones(2))
    own.keep()
    sent = cloudpickle.dumps(own)
    assert cloudpickle.loads(sent) == own
    scaled.__defaults__[0]["k"] = 3.0
    try:
        with pytest.raises(ValueError, match="a value that it reads has changed since"):
            cloudpickle.loads(sent)
    finally:
        scaled.__defaults__[0]["k"] = 2.0


FACTORY = """
import functools
def called(k):
    return lambda x: k * x
def by_default(k):
    def scaled(x, k=k):
        return k * x
    return scaled
def through_another(k):
    inner = called(k)
    return lambda x: inner(x)
def wrapped(k):
    return functools.wraps(called)(called(k))
"""


@pytest.mark.parametrize("factory", ["called", "by_default", "through_another", "wrapped"])
def test_callbacks_of_a_package(factory):
    """Two functions of one factory in an installed package are two functions, and the same one is one."""
    space = {"__name__": "some_package"}
    exec(compile(FACTORY, os.path.join(sysconfig.get_paths()["purelib"], "some_package.py"), "exec"), space)

    def captured(k):
        called, shape = space[factory](k), jax.ShapeDtypeStruct((), float)
        own = Captured(lambda x: jax.pure_callback(called, shape, x))
        own.trace(jnp.ones(()))
        own.keep()
        return own

    assert captured(2.0) == captured(2.0) != captured(3.0)
    assert captured(2.0).digests == captured(2.0).digests
    assert captured(np.ones(2)) != captured(np.full(2, 2.0))


def test_events_by_what_they_compute_now():
    """Events that need the rates, or times of the run; and events that cannot be traced before the run."""
    numbers, state = {"k": 1.0}, mb.State(jnp.zeros(2), jnp.zeros(2))
    rates = lambda t, y, args, *, terms, **more: y.q[0] - numbers["k"] + jnp.sum(terms.vf(t, y, args).q)
    times = lambda t, y, args, *, t1, **more: y.q[0] - numbers["k"] * t1
    solver = lambda t, y, args, *, solver, **more: y.q[0] - numbers["k"] * solver.order(None)
    kept = lambda function: captured_event(diffrax.Event(function), 0.0, state).cond_fn
    for function, may_be_same in ((rates, True), (times, True), (solver, False)):
        numbers["k"] = 1.0
        before, again = kept(function), kept(function)
        assert (before == again) == may_be_same
        numbers["k"] = 2.0
        assert kept(function) != before
