"""Stiff mechanisms by `Hermite`: accuracy for few steps, extreme cases, derivatives, and how stiffness is found."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
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
        out = mb.simulate(
            changed,
            mechanism.state,
            t1=1.0,
            rtol=rtol,
            atol=atol,
            solver=Hermite(),
            max_steps=30000,
            throw=False,
        )
        return out.ys, out.stats, out.result == mb.RESULTS.successful

    def bounded(stiffness=1e8, damping=1e2, mass=3.0, rtol=1e-6, of_velocities=None):
        atol = np.full(mechanism.system.nq + mechanism.system.nu, rtol / 100)
        if of_velocities is not None:
            atol[mechanism.system.nq :] = of_velocities
        return run(stiffness, damping, mass, rtol, atol)

    return bounded


@pytest.mark.slow
def test_few_steps_at_every_tolerance():
    mechanism = library("stiff_four_bar")
    references = mechanism.references
    assert references.labels[:3] == ("crank", "coupler", "rocker") and references.times[-1] == 1.0
    # The number of steps varies by some per cent from one tolerance to the next.
    for rtol, steps, bound in ((1e-4, 800, 1e-4), (1.5e-6, 2000, 1e-6), (1e-8, 6000, 1e-8)):
        # Steps err by a twentieth of the tolerance, so at 20 times as much each may err by `rtol`.
        for coarser in (1, 20):
            ys, stats, successful = bushing()(rtol=coarser * rtol)
            error = np.max(np.abs((np.asarray(ys.q[-1])[2::3] - references.values[-1, :3]) / references.scales[:3]))
            assert successful and error < bound, (coarser * rtol, error, stats)
        assert stats["num_accepted_steps"] <= steps, (rtol, stats)
        assert stats["num_rejected_steps"] < 0.1 * int(stats["num_accepted_steps"])


@pytest.mark.slow
@pytest.mark.parametrize(
    "rtol, of_velocities", [(2e-2, None), (2e-3, None), (1e-5, 2e-2), (1e-6, 2e-2), (1e-7, 2e-2), (1e-8, 2e-2)]
)
def test_stiffness_does_not_make_steps_shorter(rtol, of_velocities):
    """Where the vibration that the start excites is below the tolerance of a step, a twentieth, or nearly so."""
    runs = [bushing()(stiffness=k, rtol=rtol, of_velocities=of_velocities) for k in (1e8, 1e10)]
    assert all(successful for _, _, successful in runs)
    steps = [int(stats["num_accepted_steps"]) for _, stats, _ in runs]
    assert steps[1] < 1.15 * steps[0]


@pytest.mark.slow
def test_velocities_that_need_not_be_known_so_well():
    """A vibration that shows in velocities only is stepped over where these may be wrong by it.

    For several tolerances: errors and steps vary from one to the next.
    """
    expected = library("stiff_four_bar").references.values[-1, :3]
    counts = {1e8: [], 1e10: []}
    for of_velocities in np.geomspace(1e-2, 4e-2, 9):
        for stiffness in counts:
            ys, stats, successful = bushing()(stiffness=stiffness, rtol=2e-5, of_velocities=of_velocities)
            assert successful
            counts[stiffness].append(int(stats["num_accepted_steps"]))
            # The softer one is the linkage of the reference, the other a rigid one to 1e-8 m.
            np.testing.assert_allclose(ys.q[-1, 2::3], expected, rtol=2e-5 if stiffness == 1e8 else 1e-4)
    assert np.mean(counts[1e8]) < 120
    assert np.mean(counts[1e10]) < 1.15 * np.mean(counts[1e8])


@pytest.mark.slow("100.0-0.0", "100.0-100.0", "10000.0-0.0", "100000000.0-0.0", "10000000000.0-0.0")
@pytest.mark.parametrize("damping", [0.0, 1e2])
@pytest.mark.parametrize("stiffness", [1e2, 1e4, 1e6, 1e8, 1e10, 1e12, 1e14])
def test_every_stiffness(stiffness, damping):
    """From a soft spring to the rigid joint, which the last ones are near."""
    ys, _, successful = bushing()(stiffness=stiffness, damping=damping, rtol=1e-5)
    assert successful and np.all(np.isfinite(ys.q)) and np.all(np.isfinite(ys.u))
    if stiffness >= 1e6:
        rigid = linkages.four_bar(np.array([1.0]))[0, :3]
        np.testing.assert_allclose(ys.q[-1, 2::3], rigid, rtol=0, atol=2e-4 + 1e3 / stiffness)


@pytest.mark.slow("100000000.0")
@pytest.mark.parametrize("ratio", [1e-8, 1e-4, 1e4, 1e8])
def test_every_ratio_of_masses(ratio):
    loose, tight = (bushing()(mass=3.0 * ratio, rtol=rtol) for rtol in (2e-4, 2e-6))
    assert loose[2] and tight[2]
    np.testing.assert_allclose(loose[0].q, tight[0].q, rtol=0, atol=2e-4 * np.max(np.abs(tight[0].q)))


@pytest.mark.slow(but=("0.001", "1e-05"))
@pytest.mark.parametrize("rtol", [1e-3, 1e-5, 1e-7, 1e-9, 1e-11])
def test_every_tolerance(rtol):
    ys, _, successful = bushing()(rtol=rtol)
    expected = library("stiff_four_bar").references.values[-1, :3]
    assert successful
    np.testing.assert_allclose(ys.q[-1, 2::3], expected, rtol=20 * rtol)


@pytest.mark.slow
def test_flyball_to_the_end():
    mechanism = library("flyball")
    trajectory = mb.simulate(
        mechanism.system, mechanism.state, t1=10.0, saveat=mechanism.references.times, rtol=1e-9, solver=Hermite()
    )
    errors = mechanism.errors(trajectory)
    assert max(float(np.max(error)) for error in errors.values()) < 1e-7
    assert trajectory.stats["num_accepted_steps"] < 1000


def overdamped(stiffness, t, x0):
    """Position of 1 kg on a spring with a damper of 1e6 N s/m that is let go at rest."""
    roots = np.roots([1.0, 1e6, stiffness])
    weights = np.linalg.solve([[1.0, 1.0], roots], [x0, 0.0])
    return weights @ np.exp(np.outer(roots, np.atleast_1d(t)))


def slider():
    body = planar.Body("mass", mass=1.0, inertia=1.0)
    spring = planar.Bushing(
        "spring", "mass", "ground", stiffness=(1e8, 1e8, 1.0), damping=(1e6, 1e6, 1.0), point=(0, 0)
    )
    return mb.Scene([body], forces=[spring]).compile()


@pytest.mark.slow
def test_a_start_on_a_fast_transient():
    """A millionth of a second after the start the motion is ten thousand times slower."""
    system, ts = slider(), np.array([1e-7, 1e-6, 1e-5, 1e-3, 0.05])
    start = mb.State(jnp.array([1e-3, 0.0, 0.0]), jnp.zeros(3))
    out = mb.simulate(system, start, t1=0.05, saveat=ts, rtol=1e-8, atol=1e-13, solver=Hermite())
    np.testing.assert_allclose(out.ys.q[:, 0], overdamped(1e8, ts, 1e-3), rtol=1e-6)
    assert out.stats["num_steps"] < 400


@pytest.mark.slow
def test_a_force_that_jumps():
    """A spring that becomes ten times as stiff where half the way is gone: to the event, and on from it."""
    system = slider()
    start = mb.State(jnp.array([1e-3, 0.0, 0.0]), jnp.zeros(3))
    event = diffrax.Event(lambda t, y, args, **kwargs: y.q[0] - 5e-4, optx.Newton(1e-12, 1e-12))
    options = {"rtol": 1e-9, "atol": 1e-14, "solver": Hermite()}
    first = mb.simulate(system, start, t1=1.0, event=event, **options)
    assert first.result == mb.RESULTS.event_occurred
    roots = np.roots([1.0, 1e6, 1e8])
    weights = np.linalg.solve([[1.0, 1.0], roots], [1e-3, 0.0])
    slow = np.argmax(roots)
    np.testing.assert_allclose(first.ts[-1], np.log(5e-4 / weights[slow]) / roots[slow], rtol=1e-6)

    stiffer = mb.with_parameters(system, {"spring.stiffness": jnp.array([1e9, 1e9, 1.0])})
    middle = jax.tree.map(lambda y: y[-1], first.ys)
    second = mb.simulate(stiffer, middle, t0=first.ts[-1], t1=first.ts[-1] + 1e-3, **options)
    roots = np.roots([1.0, 1e6, 1e9])
    weights = np.linalg.solve([[1.0, 1.0], roots], [middle.q[0], middle.u[0]])
    np.testing.assert_allclose(second.ys.q[-1, 0], weights @ np.exp(1e-3 * roots), rtol=1e-6)


# Derivatives


# Mechanism: stiffnesses, dampings, how far [s], tolerance of derivatives, steps of differences in logarithms.
DIFFERENTIATED = {
    "stiff_four_bar": (["D.stiffness"], ["D.damping"], 0.02, 1e-11, (1e-3, 1e-1)),
    "flyball": (
        ["spring1.stiffness", "spring2.stiffness"],
        ["spring1.damping", "spring2.damping"],
        0.1,
        1e-9,
        (1e-2,) * 2,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DIFFERENTIATED)
def test_forward_reverse_and_central_differences(name):
    """With respect to logarithms of stiffness and damping, while the four-bar's bushing vibrates."""
    mechanism, (stiffnesses, dampings, t1, rtol, steps) = library(name), DIFFERENTIATED[name]
    start = mb.parameters(mechanism.system)
    weights = jnp.cos(jnp.arange(mechanism.system.nq + mechanism.system.nu).astype(float))

    def loss(x, rtol):
        changed = {part: start[part] * jnp.exp(x[0]) for part in stiffnesses}
        changed |= {part: start[part] * jnp.exp(x[1]) for part in dampings}
        system = mb.with_parameters(mechanism.system, changed)
        end = mb.simulate(system, mechanism.state, t1=t1, rtol=rtol, solver=Hermite(), max_steps=4096).ys
        return weights @ jnp.concatenate([end.q[-1], end.u[-1]])

    # One program for derivatives and, at a tighter tolerance, for differences; in a batch, as the other one is.
    twice = lambda x, rtol: (loss(x, rtol),) * 2
    derivatives_and_value = jax.jit(jax.vmap(jax.jacfwd(twice, has_aux=True), in_axes=(0, None)))
    reverse = jax.jit(jax.vmap(jax.grad(lambda x: loss(x, rtol))))
    forward = lambda x: derivatives_and_value(x, rtol)[0]
    softer = np.array([[np.log(1e-2), 0.0]])
    np.testing.assert_allclose(reverse(softer), forward(softer), rtol=1e-8)
    reverse, forward = reverse(np.zeros((1, 2)))[0], forward(np.zeros((1, 2)))[0]
    assert np.all(forward != 0)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)
    steps = np.array(steps)
    value = lambda k: np.array([derivatives_and_value(k * h[None], 1e-12)[1][0] for h in np.diag(steps)])
    central = (8 * (value(1.0) - value(-1.0)) - (value(2.0) - value(-2.0))) / (12 * steps)
    # The four-bar's motion is less than a thousandth as sensitive to damping as to stiffness.
    np.testing.assert_allclose(forward, central, rtol=1e-5, atol=1e-6 * np.max(np.abs(forward)))


# Stiffness that is found


@pytest.mark.slow
def test_auto_says_that_a_motion_is_stiff():
    mechanism = library("stiff_four_bar")
    with pytest.warns(UserWarning, match="Hermite"):
        found = mb.simulate(mechanism.system, mechanism.state, t1=0.1, rtol=1e-6, solver="auto")
    assert found.stats["stiff"] and found.stats["stiff_steps"] > 100
    switched = mb.simulate(mechanism.system, mechanism.state, t1=0.1, rtol=1e-6, solver="switch")
    assert switched.stats["stiff"] and "past_points" in switched.stats
    assert switched.stats["num_steps"] < found.stats["num_steps"]
    np.testing.assert_allclose(switched.ys.q, found.ys.q, rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("solver", ["auto", "switch"])
def test_auto_leaves_other_motions_to_adams(solver):
    mechanism = library("four_bar")
    plain = mb.simulate(mechanism.system, mechanism.state, t1=1.0, rtol=1e-6)
    found = mb.simulate(mechanism.system, mechanism.state, t1=1.0, rtol=1e-6, solver=solver)
    assert not found.stats["stiff"] and "orders" in found.stats
    np.testing.assert_allclose(found.ys.q, plain.ys.q, rtol=1e-9)


@pytest.mark.slow
def test_the_error_of_too_few_steps_says_whether_a_motion_is_stiff():
    """By some more steps with Adams' method, also where a Runge–Kutta method took the others."""
    stiff, other = library("stiff_four_bar"), library("four_bar")
    run = lambda mechanism, **options: mb.simulate(mechanism.system, mechanism.state, rtol=1e-6, **options)
    where = r"came to t = 0\.0\d+ of 0.1 in max_steps = 400 steps, with steps of about \S+ in the end"
    with pytest.raises(RuntimeError, match=rf"{where}. It is stiff there.*solver=jaxmb.solvers.Hermite\(\)"):
        run(stiff, t1=0.1, max_steps=400)
    with pytest.raises(RuntimeError, match=rf"{where}. It is stiff there.*solver=jaxmb.solvers.Hermite\(\)"):
        run(stiff, t1=0.1, max_steps=400, solver=diffrax.Tsit5())
    with pytest.raises(RuntimeError, match=r"max_steps = 256 steps.*in the end. A larger max_steps or a coarser rtol"):
        run(other, t1=1e3, max_steps=256)


def test_bad_words():
    mechanism = library("four_bar")
    with pytest.raises(ValueError, match="'auto' and 'switch'"):
        mb.simulate(mechanism.system, mechanism.state, t1=1.0, solver="stiff")  # pyright: ignore
    with pytest.raises(ValueError, match="under jit"):
        jax.jit(lambda s: mb.simulate(mechanism.system, s, t1=1.0, solver="switch").ys)(mechanism.state)


@pytest.mark.slow("input")
@pytest.mark.parametrize("traced", ["parameter", "tolerance", "saved time", "jump", "input"])
def test_a_switch_sees_every_number(traced):
    """Whatever is traced, a motion is not seen before it ends."""
    mechanism = library("four_bar")
    name, value = next((name, value) for name, value in mb.parameters(mechanism.system).items() if "point" in name)

    def run(x):
        own = mb.with_parameters(mechanism.system, {name: value * x}) if traced == "parameter" else mechanism.system
        options = {
            "tolerance": {"rtol": 1e-6 * x},
            "saved time": {"saveat": jnp.array([0.5]) * x},
            "jump": {"jumps": jnp.array([0.5]) * x},
            "input": {"inputs": {name: lambda t: value * x}},
        }.get(traced, {})
        return mb.simulate(own, mechanism.state, t1=1.0, solver="switch", **options).ys

    for transform in (jax.jit, lambda f: jax.vmap(f, axis_size=2), jax.jacfwd):
        with pytest.raises(ValueError, match="under jit"):
            transform(run)(jnp.ones(2) if transform not in (jax.jit, jax.jacfwd) else 1.0)


@pytest.mark.slow
def test_the_error_estimate_of_a_switch_is_that_of_its_method():
    mechanism = library("stiff_four_bar")
    run = lambda solver: mb.simulate(mechanism.system, mechanism.state, t1=0.1, rtol=1e-9, solver=solver, error=True)
    switched, implicit = run("switch"), run(mb.solvers.Hermite())
    assert "past_points" in switched.stats
    assert switched.stats["num_steps"] == implicit.stats["num_steps"]
    assert switched.closer.stats["num_steps"] == implicit.closer.stats["num_steps"]


@pytest.mark.slow
def test_implicit_solvers_of_diffrax():
    mechanism = library("four_bar")
    other = mb.simulate(mechanism.system, mechanism.state, t1=0.1, rtol=1e-6, solver=diffrax.Kvaerno5())
    own = mb.simulate(mechanism.system, mechanism.state, t1=0.1, rtol=1e-10)
    np.testing.assert_allclose(other.ys.q, own.ys.q, rtol=0, atol=1e-6)
