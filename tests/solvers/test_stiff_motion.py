"""Stiff mechanisms by `Hermite`: accuracy for few steps, extreme cases, derivatives, and how stiffness is found."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import linkages

import jaxmb as mb
from jaxmb import mechanisms, planar
from jaxmb.solvers import Hermite


@functools.cache
def library(name):
    return mechanisms.get(name)


@functools.cache
def bushing():
    """The library's stiff four-bar as one program: stiffness, damping, mass of the coupler, tolerance -> its end."""
    mechanism = library("stiff_four_bar")
    rigid = np.array([1.0, 1.0, 0.0])

    @jax.jit
    def run(stiffness, damping, mass, rtol, atol):
        values = {"D.stiffness": stiffness * rigid, "D.damping": damping * rigid, "coupler.mass": mass}
        changed = mb.with_parameters(mechanism.system, values)
        options = {"rtol": rtol, "atol": atol, "solver": Hermite(), "max_steps": 30000, "throw": False}
        out = mb.simulate(changed, mechanism.state, t1=1.0, **options)
        return out.ys, out.stats, out.result == mb.RESULTS.successful

    def bounded(stiffness=1e8, damping=1e2, mass=3.0, rtol=1e-6, of_velocities=None):
        atol = np.full(mechanism.system.nq + mechanism.system.nu, rtol / 100)
        if of_velocities is not None:
            atol[mechanism.system.nq :] = of_velocities
        ys, stats, successful = run(stiffness, damping, mass, rtol, atol)
        assert successful and np.all(np.isfinite(ys.q)) and np.all(np.isfinite(ys.u))
        return np.asarray(ys.q)[-1, 2::3], stats

    return bounded


@pytest.mark.slow
def test_stiff_four_bar_takes_few_steps_at_every_tolerance():
    references = library("stiff_four_bar").references
    assert references.labels[:3] == ("crank", "coupler", "rocker") and references.times[-1] == 1.0
    # The number of steps varies by some per cent from one tolerance to the next.
    for rtol, steps, bound in ((1e-4, 800, 1e-4), (1.5e-6, 2000, 1e-6), (1e-8, 6000, 1e-8)):
        # Steps err by a twentieth of the tolerance, so at 20 times as much each may err by `rtol`.
        for coarser in (1, 20):
            angles, stats = bushing()(rtol=coarser * rtol)
            error = np.max(np.abs((angles - references.values[-1, :3]) / references.scales[:3]))
            assert error < bound, (coarser * rtol, error, stats)
        assert stats["num_accepted_steps"] <= steps, (rtol, stats)
        assert stats["num_rejected_steps"] < 0.1 * int(stats["num_accepted_steps"])


@pytest.mark.slow
def test_steps_do_not_become_shorter_with_stiffness():
    """Where the vibration that the start excites is below the tolerance of a step, a twentieth, or nearly so.

    A vibration that shows in velocities only is stepped over where these may be wrong by it.
    """
    for rtol, of_velocities in ((2e-2, None), (2e-3, None), (1e-5, 2e-2), (1e-7, 2e-2)):
        runs = [bushing()(stiffness=k, rtol=rtol, of_velocities=of_velocities) for k in (1e8, 1e10)]
        steps = [int(stats["num_accepted_steps"]) for _, stats in runs]
        assert steps[1] < 1.15 * steps[0]
    # The mean over several tolerances: errors and steps vary from one to the next.
    expected = library("stiff_four_bar").references.values[-1, :3]
    counts = {1e8: [], 1e10: []}
    for of_velocities in np.geomspace(1e-2, 4e-2, 9):
        for stiffness in counts:
            angles, stats = bushing()(stiffness=stiffness, rtol=2e-5, of_velocities=of_velocities)
            counts[stiffness].append(int(stats["num_accepted_steps"]))
            # The softer one is the linkage of the reference, the other a rigid one to 1e-8 m.
            np.testing.assert_allclose(angles, expected, rtol=2e-5 if stiffness == 1e8 else 1e-4)
    assert np.mean(counts[1e8]) < 120
    assert np.mean(counts[1e10]) < 1.15 * np.mean(counts[1e8])


def test_stiff_four_bar_is_accurate():
    """In its own motion, near the rigid joint, and with a coupler that is almost without mass."""
    expected = library("stiff_four_bar").references.values[-1, :3]
    np.testing.assert_allclose(bushing()(rtol=1e-5)[0], expected, rtol=2e-4)
    rigid = linkages.four_bar(np.array([1.0]))[0, :3]
    np.testing.assert_allclose(bushing()(stiffness=1e14, damping=0.0, rtol=1e-5)[0], rigid, rtol=0, atol=2e-4)
    loose, tight = (bushing()(mass=3e-8, rtol=rtol)[0] for rtol in (2e-4, 2e-6))
    np.testing.assert_allclose(loose, tight, rtol=0, atol=2e-4 * np.max(np.abs(tight)))


@pytest.mark.slow
def test_stiff_four_bar_is_accurate_in_extreme_cases():
    """Of stiffness, from a soft spring to the rigid joint, of damping, of masses and of tolerances."""
    rigid = linkages.four_bar(np.array([1.0]))[0, :3]
    for stiffness in (1e2, 1e4, 1e6, 1e8, 1e10, 1e12):
        for damping in (0.0, 1e2):
            angles, _ = bushing()(stiffness=stiffness, damping=damping, rtol=1e-5)
            if stiffness >= 1e6:
                np.testing.assert_allclose(angles, rigid, rtol=0, atol=2e-4 + 1e3 / stiffness)
    for ratio in (1e-4, 1e4, 1e8):
        loose, tight = (bushing()(mass=3.0 * ratio, rtol=rtol)[0] for rtol in (2e-4, 2e-6))
        np.testing.assert_allclose(loose, tight, rtol=0, atol=2e-4 * np.max(np.abs(tight)))
    expected = library("stiff_four_bar").references.values[-1, :3]
    for rtol in (1e-3, 1e-7, 1e-9, 1e-11):
        np.testing.assert_allclose(bushing()(rtol=rtol)[0], expected, rtol=20 * rtol)


# A mass on a spring and a damper


def released(stiffness, damping, t, x=1e-3, v=0.0):
    """Position of 1 kg on a spring with a damper."""
    roots = np.roots([1.0, damping, stiffness]).astype(complex)
    weights = np.linalg.solve([[1.0, 1.0], roots], [x, v])
    return (np.exp(np.outer(np.atleast_1d(t), roots)) @ weights).real


@functools.cache
def slider():
    body = planar.Body("mass", mass=1.0, inertia=1.0)
    rates = {"stiffness": (1e8, 1e8, 1.0), "damping": (1e6, 1e6, 1.0)}
    return mb.Scene([body], forces=[planar.Bushing("spring", "mass", "ground", **rates, point=(0, 0))]).compile()


START = mb.State(np.array([1e-3, 0.0, 0.0]), np.zeros(3))


@pytest.mark.slow
def test_mass_on_a_spring_moves_by_its_closed_form():
    """Soft, vibrating, and on a transient after which the motion is ten thousand times slower."""
    system, times = slider(), np.array([1e-7, 1e-6, 1e-5, 1e-3, 0.05])

    @jax.jit
    def run(stiffness, damping):
        values = {"spring.stiffness": jnp.full(3, stiffness), "spring.damping": jnp.full(3, damping)}
        changed, options = mb.with_parameters(system, values), {"rtol": 1e-8, "atol": 1e-13, "solver": Hermite()}
        out = mb.simulate(changed, START, t1=0.05, saveat=times, **options)
        return out.ys.q[:, 0], out.stats["num_steps"]

    for stiffness, damping, most in ((1e2, 0.0, 40), (1e6, 10.0, 900), (1e8, 1e6, 400), (1e12, 1e9, 700)):
        found, steps = run(stiffness, damping)
        assert steps < most
        exact = released(stiffness, damping, times)
        np.testing.assert_allclose(found, exact, rtol=1e-6, atol=1e-12 if damping > 100 else 1e-9)


@pytest.mark.slow
def test_derivatives_while_the_bushing_vibrates():
    """Forward, reverse and central differences, by logarithms of stiffness and damping."""
    mechanism, steps = library("stiff_four_bar"), np.array([1e-3, 1e-1])
    start = mb.parameters(mechanism.system)
    weights = jnp.cos(jnp.arange(mechanism.system.nq + mechanism.system.nu).astype(float))

    def loss(x, rtol):
        changed = {f"D.{part}": start[f"D.{part}"] * jnp.exp(x[k]) for k, part in enumerate(("stiffness", "damping"))}
        system = mb.with_parameters(mechanism.system, changed)
        end = mb.simulate(system, mechanism.state, t1=0.02, rtol=rtol, solver=Hermite(), max_steps=4096).ys
        return weights @ jnp.concatenate([end.q[-1], end.u[-1]])

    # One program for derivatives and, at a tighter tolerance, for differences; in a batch, as the other one is.
    twice = lambda x, rtol: (loss(x, rtol),) * 2
    derivatives_and_value = jax.jit(jax.vmap(jax.jacfwd(twice, has_aux=True), in_axes=(0, None)))
    reverse = jax.jit(jax.vmap(jax.grad(lambda x: loss(x, 1e-11))))
    forward = lambda x: derivatives_and_value(x, 1e-11)[0]
    softer = np.array([[np.log(1e-2), 0.0]])
    np.testing.assert_allclose(reverse(softer), forward(softer), rtol=1e-8)
    reverse, forward = reverse(np.zeros((1, 2)))[0], forward(np.zeros((1, 2)))[0]
    assert np.all(forward != 0)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)
    value = lambda k: np.array([derivatives_and_value(k * h[None], 1e-12)[1][0] for h in np.diag(steps)])
    central = (8 * (value(1.0) - value(-1.0)) - (value(2.0) - value(-2.0))) / (12 * steps)
    # The motion is less than a thousandth as sensitive to damping as to stiffness.
    np.testing.assert_allclose(forward, central, rtol=1e-5, atol=1e-6 * np.max(np.abs(forward)))


# Stiffness that is found


@pytest.mark.slow
def test_auto_says_that_a_motion_is_stiff():
    """And `switch` goes on with the implicit method, whose error estimate it has."""
    mechanism = library("stiff_four_bar")
    run = lambda solver, **options: mb.simulate(mechanism.system, mechanism.state, t1=0.1, solver=solver, **options)
    with pytest.warns(UserWarning, match="Hermite"):
        found = run("auto", rtol=1e-6)
    assert found.stats["stiff"] and found.stats["stiff_steps"] > 100
    switched = run("switch", rtol=1e-6)
    assert switched.stats["stiff"] and "past_points" in switched.stats
    assert switched.stats["num_steps"] < found.stats["num_steps"]
    np.testing.assert_allclose(switched.ys.q, found.ys.q, rtol=0, atol=1e-6)
    switched, implicit = run("switch", rtol=1e-9, error=True), run(Hermite(), rtol=1e-9, error=True)
    assert switched.stats["num_steps"] == implicit.stats["num_steps"]
    assert switched.closer.stats["num_steps"] == implicit.closer.stats["num_steps"]


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_auto_leaves_other_motions_to_adams():
    mechanism = library("four_bar")
    plain = mb.simulate(mechanism.system, mechanism.state, t1=1.0, rtol=1e-6)
    for solver in ("auto", "switch"):
        found = mb.simulate(mechanism.system, mechanism.state, t1=1.0, rtol=1e-6, solver=solver)
        assert not found.stats["stiff"] and "orders" in found.stats
        np.testing.assert_allclose(found.ys.q, plain.ys.q, rtol=1e-9)


@pytest.mark.slow
def test_error_of_too_few_steps_says_whether_a_motion_is_stiff():
    """By some more steps with Adams' method, also where a Runge–Kutta method took the others."""
    stiff, other = library("stiff_four_bar"), library("four_bar")
    run = lambda mechanism, **options: mb.simulate(mechanism.system, mechanism.state, rtol=1e-6, **options)
    where = r"came to t = 0\.0\d+ of 0.1 in max_steps = 400 steps, with steps of about \S+ in the end"
    for options in ({}, {"solver": diffrax.Tsit5()}):
        with pytest.raises(RuntimeError, match=rf"{where}. It is stiff there.*solver=jaxmb.solvers.Hermite\(\)"):
            run(stiff, t1=0.1, max_steps=400, **options)
    with pytest.raises(RuntimeError, match=r"max_steps = 256 steps.*in the end. A larger max_steps or a coarser rtol"):
        run(other, t1=1e3, max_steps=256)


def test_switch_sees_every_number():
    """Whatever is traced, a motion is not seen before it ends."""
    mechanism = library("four_bar")
    with pytest.raises(ValueError, match="'auto' and 'switch'"):
        mb.simulate(mechanism.system, mechanism.state, t1=1.0, solver="stiff")  # pyright: ignore
    name, value = next((name, value) for name, value in mb.parameters(mechanism.system).items() if "point" in name)

    def run(x, traced):
        own = mb.with_parameters(mechanism.system, {name: value * x}) if traced == "parameter" else mechanism.system
        options = {
            "tolerance": {"rtol": 1e-6 * x},
            "saved time": {"saveat": jnp.array([0.5]) * x},
            "jump": {"jumps": jnp.array([0.5]) * x},
            "input": {"inputs": {name: lambda t: value * x}},
        }.get(traced, {})
        start = jax.tree.map(lambda y: y * x, mechanism.state) if traced == "state" else mechanism.state
        return mb.simulate(own, start, t1=1.0, solver="switch", **options).ys

    for traced in ("state", "tolerance", "saved time", "jump", "input"):
        with pytest.raises(ValueError, match="under jit"):
            jax.jit(run, static_argnums=1)(1.0, traced)
    for transform, x in ((lambda f: jax.vmap(f, axis_size=2), jnp.ones(2)), (jax.jacfwd, 1.0)):
        with pytest.raises(ValueError, match="under jit"):
            transform(lambda x: run(x, "parameter"))(x)
