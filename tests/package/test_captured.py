"""What a user's function reads is changed and the system is built anew: it moves by the new number, and the old system,
which is still there, by the old one.
"""

import copy
import functools
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


def plain(k):
    """The way of a function that holds nothing that could change."""
    return lambda formula: (lambda *given: formula(k, *given), None)


@functools.cache
def expected(place, k):
    build, compute, _ = place(plain(k))
    return np.asarray(compute(build()))


def check(place, way, first, second):
    build, compute, change = place(way)
    change(first)
    old = build()
    np.testing.assert_allclose(compute(old), expected(place, first), rtol=1e-12)
    change(second)
    new = expected(place, second)
    assert np.max(np.abs(new - compute(old))) > 1e-3
    np.testing.assert_allclose(compute(build()), new, rtol=1e-12)
    return old, compute


@pytest.mark.slow("terrain", "own_constraint", "own_terrain", "own_holonomic")
@pytest.mark.parametrize("place", PLACES, ids=lambda place: place.__name__)
def test_each_place_of_a_function(place):
    check(place, changing_numbers.in_global, 1.5, 2.5)


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.__name__)
def test_each_way_to_hold_a_number(way):
    check(changing_numbers.force, way, 1.5, 2.5)


@pytest.mark.slow
def test_random_places_ways_and_numbers():
    generator = np.random.default_rng(0)
    for case in range(200):
        # The numbers are those of five systems, to compile less.
        place, way = PLACES[case % len(PLACES)], WAYS[generator.integers(len(WAYS))]
        first, second = generator.choice([0.5, 1.0, 1.5, 2.0, 2.5], 2, replace=False)
        old, compute = check(place, way, first, second)
        # What the old system has not computed before is by the old number as well.
        late = jax.jit(lambda own, system=old, compute=compute: own * compute(system))(1.0)
        np.testing.assert_allclose(late, expected(place, first), rtol=1e-12, err_msg=f"{place} {way}")


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
def test_motions_and_their_views(monkeypatch):
    """A view that is first asked for after the change is that of its own motion."""
    numbers = {"k": 3.0}
    law = lambda poses, velocities, t, p: jnp.array([[-numbers["k"] * poses[0, 0], 0.0, 0.0]])

    def motion():
        bob = planar.Body("bob", mass=1.0, inertia=1.0, position=(1.0, 0.0))
        system = mb.Scene([bob], forces=[mb.Force("law", "bob", law)]).compile()
        return mb.simulate(system, mb.assemble(system), t1=1.0, rtol=1e-9)

    soft = motion()
    numbers["k"] = 12.0
    stiff = motion()
    for own, k in ((soft, 3.0), (stiff, 12.0)):
        x = own["bob"].position[-1, 0]
        np.testing.assert_allclose(x, np.cos(np.sqrt(k)), atol=1e-8)
        np.testing.assert_allclose(own.forces["law"][-1, 0, 0], -k * x, rtol=1e-14)


@pytest.mark.slow
def test_functions_of_a_run():
    """Of events, of what is saved, of a sweep without a store, and in a gradient by what they close over."""
    numbers = {"k": 1.0}
    system = mb.Scene([BALL], forces=[planar.Torque("motor", "ball", torque=2.0)]).compile()
    start = mb.assemble(system)
    reached = diffrax.Event(lambda t, y, args, **_: y.q[2] - 0.1 * numbers["k"], optx.Newton(1e-12, 1e-12))
    saveat = diffrax.SaveAt(t1=True, fn=lambda t, y, args: numbers["k"] * y.q[2])
    inputs = lambda x: {"motor.torque": lambda t: numbers["k"] * x}
    angle = lambda x: mb.simulate(system, start, t1=1.0, inputs=inputs(x))["ball"].angle[-1]

    def swept():
        law = lambda poses, velocities, t, p: jnp.array([[0.0, 0.0, numbers["k"]]])
        pushed = mb.Scene([BALL], forces=[mb.Force("push", "ball", law)]).compile()
        end = lambda t1: mb.simulate(pushed, mb.assemble(pushed, throw=False), t1=t1, throw=False)["ball"].angle[-1]
        return float(mb.sweep(lambda t1: {"angle": end(t1)}, mb.cases.table(t1=[1.0]), progress=False)["angle"][0])

    for k in (1.0, 4.0):
        numbers["k"] = k
        np.testing.assert_allclose(mb.simulate(system, start, t1=2.0, event=reached).ts[-1], np.sqrt(0.1 * k))
        np.testing.assert_allclose(mb.simulate(system, start, t1=1.0, saveat=saveat).ys[-1], k, rtol=1e-9)
        np.testing.assert_allclose(jax.grad(angle)(3.0), 0.5 * k, rtol=1e-8)
        np.testing.assert_allclose(swept(), 0.5 * k, rtol=1e-8)


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


@pytest.mark.slow
def test_motion_to_an_event_that_needs_the_rates():
    numbers = {"k": 1.0}
    system = mb.Scene([BALL]).compile()
    start = mb.State(jnp.zeros(3), jnp.array([1.0, 0.0, 0.0]))
    place = lambda t, y, args, *, terms, t1, **_: (y.q[0] - numbers["k"]) * terms.vf(t, y, args).q[0] * t1
    for k in (1.0, 2.0):
        numbers["k"] = k
        motion = mb.simulate(system, start, t1=10.0, event=diffrax.Event(place, optx.Newton(1e-10, 1e-10)))
        np.testing.assert_allclose(motion.ts[-1], k, atol=1e-8)
