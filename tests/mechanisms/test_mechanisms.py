"""The library of mechanisms against published and independent values, their structure, and the behaviour of charts."""

import functools
import types
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_as_users_do
from oracles import linkages, trains
from scipy.optimize import curve_fit
from scipy.special import roots_laguerre
from trajectories import motion_of

import jaxmb as mb
from jaxmb import mechanisms, planar
from jaxmb.mechanisms.four_bar import circles_meet

MOST_PROGRAMS = 120

RTOL = 1e-10

# By a method that is compiled sooner than the default.
LINKAGES = ("swash_plate", "bennett", "double_wishbone", "five_link")
QUICKLY = {"rtol": 1e-11, "solver": diffrax.Dopri8(), "manifold": mb.manifold.Projection()}


@functools.cache
def library(name, **parameters):
    return mechanisms.get(name, **parameters)


@functools.cache
def run(name, **parameters):
    """The mechanism, and its motion saved at the times of its references; one compilation for all tests."""
    mechanism = library(name, **parameters)
    times = mechanism.references.times
    method = QUICKLY if name in (*LINKAGES, "hanging_chain") else {"rtol": RTOL}
    return mechanism, mb.simulate(mechanism.system, mechanism.state, t1=times[-1], saveat=times, **method)


def energy_at_start(mechanism):
    system, state = mechanism.system, mechanism.state
    return system.kinetic_energy(0.0, state.q, state.u) + system.potential_energy(0.0, state.q)


def test_four_bar_closes_where_circles_meet():
    """On the left of the line between their centres, at both distances."""
    B, D = np.array([0.4, 0.3]), np.array([1.5, -0.2])
    found = circles_meet(B, D, 1.1, 0.7)
    np.testing.assert_allclose([np.linalg.norm(found - B), np.linalg.norm(found - D)], [1.1, 0.7], rtol=1e-13)
    assert (D - B)[0] * (found - B)[1] > (D - B)[1] * (found - B)[0]


ANGLES = ("beta", "Theta", "gamma", "Phi", "delta", "Omega", "epsilon")
# With the largest relative error, and whether the energy is conserved.
CASES = [
    ("pendulum", {}, 1e-8, True),
    ("rod_chain", {"n": 2}, 1e-6, False),
    ("rod_chain", {"n": 10}, 1e-6, False),
    ("rod_chain", {"n": 50}, 1e-5, False),
    ("train", {}, 1e-5, False),
    ("four_bar", {}, 1e-7, True),
    ("slider_crank", {}, 1e-7, True),
    ("n_four_bar", {}, 1e-8, True),
    ("hanging_chain", {}, 1e-8, True),
    ("andrews", {}, 1e-8, False),
    ("car_axis", {}, 1e-8, False),
    ("tracked_vehicle", {}, 1e-8, False),
    ("knife_edge", {}, 1e-8, False),
    ("chaplygin_sleigh", {}, 1e-8, True),
    ("free_body", {}, 1e-7, True),
    ("heavy_top", {}, 1e-7, True),
    ("rolling_disc", {}, 1e-8, True),
    ("spatial_slider_crank", {}, 1e-7, False),
    ("bricard", {}, 1e-6, True),
    *((name, {}, 1e-8, name in ("swash_plate", "bennett")) for name in LINKAGES),
    ("roller_racer", {}, 1e-7, True),
    ("nonholonomic_cart", {}, 1e-7, True),
    ("three_platform_snake", {}, 1e-6, True),
    ("spherical_four_bar", {}, 1e-7, False),
    ("constant_speed_particle", {}, 1e-9, False),
    ("appell_hamel", {}, 1e-9, False),
    ("benenti", {}, 1e-8, True),
    ("rough_ring", {}, 1e-9, False),
    ("tracking_chain", {}, 1e-7, False),
]


@pytest.mark.slow(but=("free_body",))
@pytest.mark.parametrize(
    "name, parameters, bound, conserves",
    [pytest.param(*case, id="-".join([case[0], *map(str, case[1].values())])) for case in CASES],
)
def test_motion_agrees_with_reference_values_on_the_constraints(name, parameters, bound, conserves):
    mechanism, trajectory = run(name, **parameters)
    assert bound >= 10 * mechanism.references.tolerance
    errors = mechanism.errors(trajectory)
    assert set(errors) == set(mechanism.references.labels)
    labels = ANGLES if name == "andrews" else errors
    assert {label: errors[label][-1] for label in labels if not errors[label][-1] <= bound} == {}
    assert np.all(trajectory.constraint_violation.position <= 1e-10)
    assert np.all(trajectory.constraint_violation.velocity <= 1e-10)
    if conserves:
        size = np.max(np.abs(trajectory.kinetic_energy))
        np.testing.assert_allclose(trajectory.energy, energy_at_start(mechanism), rtol=0, atol=1e-9 * size)
    if name == "free_body":
        start = mechanism.system.angular_momentum(mechanism.state.q, mechanism.state.u)
        np.testing.assert_allclose(trajectory.angular_momentum, np.tile(start, (3, 1)), rtol=0, atol=1e-8)
    if name == "andrews":
        # What the torque does.
        turned = trajectory["K1"].angle - mechanism.state.q[2]
        np.testing.assert_allclose(trajectory.energy - energy_at_start(mechanism), 0.033 * turned, rtol=1e-8)
    if name == "bennett":
        # His relation of input and output, with tan(x/2) = sin x / (1 + cos x).
        alpha, beta = np.arcsin(0.3 * np.sin(np.radians(70.0)) / 0.5), np.radians(70.0)
        observed = mechanism.observe(trajectory)
        half = lambda end: np.asarray(observed[f"sin{end}"]) / (1 + np.asarray(observed[f"cos{end}"]))
        expected = np.sin((alpha + beta) / 2) / np.sin((beta - alpha) / 2)
        np.testing.assert_allclose(half("") * half("_out"), np.full(3, expected), rtol=1e-9)


# Reference values


def train_values(times):
    q, u, forces = trains.Train(4).motion(times)
    return np.concatenate([q[:, :, 0], u[:, :, 0], forces], axis=1)


CARRIED = {
    "train": (train_values, 1e-6),
    **{name: (getattr(linkages, name), 1e-9) for name in ("four_bar", "slider_crank", "n_four_bar", "hanging_chain")},
}


@pytest.mark.slow(but=("slider_crank",))
@pytest.mark.parametrize("name", CARRIED)
def test_references_are_the_values_of_an_independent_model(name):
    """In minimal coordinates."""
    (model, bound), references = CARRIED[name], library(name).references
    values = model(references.times)
    np.testing.assert_allclose(values / references.scales, references.values / references.scales, rtol=0, atol=bound)


def test_references_in_files_belong_to_mechanisms():
    for path in (Path(mechanisms.__file__).parent / "data").iterdir():
        assert path.suffix == ".json" and path.stem.startswith(mechanisms.names())
        known = mechanisms.References.load(path.stem)
        assert known.source and 0 < known.tolerance < 1e-6 and np.all(np.diff(known.times) > 0)


def test_references_hold_for_the_published_parameters_and_their_times_only():
    mechanism = library("pendulum")
    assert mechanism.references is not None
    other = mechanisms.pendulum(length=0.5)
    assert other.references is None
    with pytest.raises(ValueError, match="no reference values"):
        other.errors(None)
    with pytest.raises(ValueError, match=r"references\.times"):
        mechanism.errors(types.SimpleNamespace(ts=mechanism.references.times + 0.5))
    np.testing.assert_array_equal(mechanism.until(5.0).references.times, [1.0, 5.0])
    assert mechanism.until(0.5).references is None and mechanism.until(0.5).t1 == 0.5
    with pytest.raises(ValueError, match="t1 must be positive"):
        mechanism.until(0.0)


def test_references_have_the_scale_of_their_largest_value():
    values = [[1.0, 0.0, 3.0], [-2.0, 0.0, 1.0]]
    make = functools.partial(mechanisms.References, [0.0, 1.0], "xyz", values, "here", 1e-10)
    np.testing.assert_array_equal(make().scales, [2.0, 1.0, 3.0])
    np.testing.assert_array_equal(make(sizes=np.array([5.0, 6.0, 7.0])).scales, [5.0, 6.0, 7.0])
    with pytest.raises(ValueError, match="shape"):
        mechanisms.References([0.0, 1.0], ("x",), [[1.0]], "nowhere", 1e-10)


# Structure

# Coordinates, velocities, rows on velocities and how many of them are independent, and what coordinates are free.
COUNTS = {
    "andrews": (21, 21, 20, 20, 1),
    "bricard": (35, 30, 30, 29, 1),
    "bennett": (21, 18, 20, 17, 1),
    # As the sources count them, with the ground as a body that six rows and its normalisation hold: 63 and 62.
    "swash_plate": (56, 48, 47, 47, 1),
    "spatial_loop": (28, 24, 26, 23, 1),
    "rolling_disc": (7, 6, 3, 3, 5),
    "flyball": (28, 24, 20, 20, 4),
    "stiff_four_bar": (9, 9, 6, 6, 3),
}


@pytest.mark.parametrize("name", COUNTS)
def test_degrees_of_freedom(name):
    """Also of linkages that move although counting rows forbids it."""
    system = library(name).system
    free = system.nq - system.coordinate_rank
    assert (system.nq, system.nu, system.velocity_rows, system.velocity_rank, free) == COUNTS[name]
    assert len(system.implied) == system.velocity_rows - system.velocity_rank
    # Each row of a part has a number of its own, also if a part is made of several, such as a disc that rolls.
    assert len(set(system.rows)) == len(system.rows)
    for implied in system.implied:
        assert {implied.name, *implied.by} <= {name for name, _ in system.rows}


@pytest.mark.slow
def test_parallelogram_moves_alike_with_a_redundant_rocker():
    three, twin = library("parallelogram"), library("parallelogram", rockers=2, spacing=2.0)
    # Two rockers carry the share of the third.
    own = {f"rocker{k}.{field}" for k in (1, 2) for field in ("mass", "inertia")}
    twin = twin.with_parameters({name: 1.5 * mb.parameters(twin.system)[name] for name in own})
    times = jnp.linspace(0.0, 2.0, 41)
    moved = lambda m: mb.simulate(m.system, m.state, t1=2.0, rtol=1e-12, saveat=times)
    trajectory = moved(three)
    expected = twin.observe(moved(twin))
    for label, value in three.observe(trajectory).items():
        np.testing.assert_allclose(value, expected[label], rtol=0, atol=1e-10, err_msg=label)
    system = three.system
    assert (system.nu, system.velocity_rows, system.velocity_rank) == (12, 12, 11)
    (implied,) = system.implied
    residual = jax.vmap(lambda y: system.position_residual(0.0, y.q))(trajectory.ys)
    assert np.max(np.abs(residual[:, system.rows.index((implied.name, implied.row))])) <= 1e-12


@pytest.mark.slow
def test_parallelogram_with_a_misplaced_pin_is_refused_with_the_names_of_the_joints():
    for offset, angle in ((1e-3, np.pi / 3), (-1e-3, 1.5), (1e-2, 1.5)):
        with pytest.raises(ValueError, match=r"cannot (move|be assembled)") as error:
            mechanisms.parallelogram(offset=offset, angle=angle)
        assert all(f"{end}{k}" in str(error.value) for end in ("foot", "head") for k in (1, 2, 3))


# Single mechanisms


@pytest.mark.slow
def test_hanging_chain_swings_in_its_classical_modes():
    """After half a period of small oscillations every mass is on the other side."""
    for mode in (1, 5):
        frequency = np.sqrt(9.81 * 5 * roots_laguerre(5)[0][mode - 1])
        chain, times = library("hanging_chain", mode=mode, amplitude=1e-5), np.array([0.2, 0.5, 1.0]) * np.pi
        times = times / frequency
        trajectory = mb.simulate(chain.system, chain.state, t1=times[-1], saveat=times, **QUICKLY)
        start, places = np.asarray(chain.state.q[::2]), trajectory.ys.q[:, ::2]
        np.testing.assert_allclose(places, np.cos(frequency * times)[:, None] * start, rtol=0, atol=1e-6 * 1e-5)


@pytest.mark.slow
def test_heavy_top_precesses_steadily():
    """Started on it, a top keeps its tilt, whichever of the two rates it precesses with; and its energy."""
    across, along, mass, distance, tilt, spin = 0.0045, 0.004, 1.0, 0.05, np.pi / 6, 30.0
    about_tip, weight = across + mass * distance**2, mass * 9.81 * distance
    root = np.sqrt((along * spin) ** 2 - 4 * about_tip * weight * np.cos(tilt))
    times = np.linspace(0.0, 3.0, 31)
    for precession in (along * spin + np.array([-root, root])) / (2 * about_tip * np.cos(tilt)):
        inertia = across, along
        top = mechanisms.heavy_top(inertia=inertia, distance=distance, precession=precession, spin=spin)
        motion = mb.simulate(top.system, top.state, t1=3.0, rtol=1e-11, saveat=times, max_steps=100_000)
        height = np.asarray(motion["top"].position[:, 2]) / distance
        np.testing.assert_allclose(np.arccos(height), tilt, rtol=0, atol=1e-9)
        energy = np.asarray(motion.energy)
        np.testing.assert_allclose(energy, energy[0], rtol=1e-9)


@pytest.mark.slow
def test_n_four_bar_lies_flat_in_passing_at_every_speed():
    """It keeps its energy, and the level bars stay level: no step ends where round-off is larger than its error."""
    linkages = library("n_four_bar")
    system, start = linkages.system, linkages.state

    @jax.jit
    def run(factor):
        state, times = mb.State(start.q, factor * start.u), np.linspace(0.0, 10.0, 11)
        motion = mb.simulate(system, state, t1=10.0, rtol=1e-10, saveat=times, max_steps=3000, throw=False)
        return motion.energy / motion.energy[0] - 1.0, motion["level1"].angle, motion.stats["num_accepted_steps"]

    for factor in np.linspace(0.5, 3.0, 8):
        energy, level, steps = run(factor)
        assert steps < 1500
        np.testing.assert_allclose(energy, 0.0, atol=1e-8)
        np.testing.assert_allclose(level, 0.0, atol=1e-8)


@pytest.mark.slow
def test_double_wishbone_on_stiff_bushings_tends_to_that_on_hinges():
    """By the inverse of their stiffness."""
    exact, errors = library("double_wishbone").references.values[0], []
    for stiffness in (1e7, 1e8):
        soft = mechanisms.double_wishbone(joints="bushings", bushing=(stiffness, 0.0), bushing_damping=(1e4, 0.0))
        assert soft.system.nu - soft.system.velocity_rank == 11
        end = soft.observe(mb.simulate(soft.system, soft.state, t1=0.05, **(QUICKLY | {"rtol": 1e-8})))
        errors.append([float(end[label][-1]) for label in ("y", "toe")] - exact[[1, 3]])
    np.testing.assert_allclose(errors[0] / errors[1], 10.0, rtol=0.2)


@pytest.mark.slow
def test_rolling_disc_wobbles():
    """Upright at the frequency of small oscillations; inclined, it ends where an independent model does."""
    times = jnp.linspace(0.0, 4.0, 101)
    for spin, frequency in ((3.0, 2.429815), (8.0, 11.743253)):
        mechanism = mechanisms.rolling_disc(radius=0.5, lean=1e-4, roll=spin, turn=0.0)
        trajectory = mb.simulate(mechanism.system, mechanism.state, t1=4.0, rtol=1e-11, atol=1e-15, saveat=times)
        lean = 1e4 * np.asarray(mechanism.observe(trajectory)["theta"])
        wave = lambda t, middle, size, omega: middle + size * np.cos(omega * t)
        (_, _, omega), _ = curve_fit(wave, np.asarray(times), lean, p0=(0.5, 0.5, frequency))
        assert omega == pytest.approx(np.sqrt(0.8 * (3 * spin**2 - 9.81 / 0.5)), rel=1e-5)
        assert omega == pytest.approx(frequency, rel=1e-5)
    lean, spin, yaw = 0.3, 5.0, 0.8
    mechanism = mechanisms.rolling_disc(radius=0.5, lean=lean, roll=-spin + yaw * np.sin(lean), turn=yaw * np.cos(lean))
    trajectory = mb.simulate(mechanism.system, mechanism.state, t1=4.0, rtol=1e-11, atol=1e-15, saveat=times)
    np.testing.assert_allclose(
        trajectory["disc"].position[-1], [0.791621867, -5.441766623, 0.477285836], rtol=0, atol=1e-6
    )
    assert trajectory.stats["charts"] - 1 >= 3


def test_flyball_shows_the_angle_of_its_arm_below_the_horizontal():
    mechanism = library("flyball")
    start = motion_of(mechanism.system, [0.0], mechanism.state.q[None], mechanism.state.u[None])
    observed = {label: float(value[0]) for label, value in mechanism.observe(start).items()}
    expected = {"cos": 1.0, "sin": 0.0, "alpha": np.pi / 6, "s": 0.5, "omega": 2 * np.pi, "alpha_dot": 0.0}
    assert observed == pytest.approx(expected | {"s_dot": 0.0}, abs=1e-13)


def test_stiff_four_bar_starts_in_the_state_of_the_rigid_one():
    rigid, made = library("four_bar"), library("stiff_four_bar")
    np.testing.assert_allclose(made.state.q, rigid.state.q, rtol=0, atol=1e-14)
    np.testing.assert_allclose(made.state.u, rigid.state.u, rtol=0, atol=1e-13)


# Charts


@pytest.mark.slow
def test_charts_change_without_a_restart():
    mechanism = library("free_body")
    saved = mb.simulate(
        mechanism.system,
        mechanism.state,
        t1=20.0,
        rtol=RTOL,
        manifold=mb.manifold.Partition(max_influence=2.0),
        saveat=diffrax.SaveAt(ts=mechanism.references.times),
    )
    assert max(float(error[-1]) for error in mechanism.errors(saved).values()) <= 1e-7
    stats, (_, free) = saved.stats, run("free_body")
    assert stats["charts"] - 1 >= 5
    assert stats["num_evaluations"] == 2 * stats["num_steps"]
    # Low orders belong to the start. The motion without charts visits them as often.
    low = slice(0, 7)
    assert np.sum(stats["orders"][low]) <= np.sum(free.stats["orders"][low]) + 2
    assert stats["num_steps"] <= 1.1 * free.stats["num_steps"]


@pytest.mark.slow
def test_charts_change_without_shorter_steps():
    mechanism = library("pendulum")
    steps = diffrax.SaveAt(steps=True, t0=True)
    # As users compile: that rounding makes the solver repeat a step, here or there, is another matter.
    run = jit_as_users_do(lambda state: mb.simulate(mechanism.system, state, t1=9.99, rtol=RTOL, saveat=steps))
    trajectory = run(mechanism.state)
    assert trajectory.stats["charts"] - 1 >= 10
    steps = np.diff(trajectory.ts[np.isfinite(trajectory.ts)])[30:-1]
    assert np.min(steps[1:] / steps[:-1]) > 0.4
    low = int(np.sum(trajectory.stats["orders"][:6]))
    assert low <= 20


# The library itself


@pytest.mark.slow("tracked_vehicle", "car_axis", "three_platform_snake", "spherical_four_bar")
@pytest.mark.parametrize("name", mechanisms.names())
def test_mechanism_starts_on_its_constraints(name):
    mechanism = library(name)
    system, state = mechanism.system, mechanism.state
    assert mechanism.name == name and mechanism.description and mechanism.t1 > 0
    q, u = np.asarray(state.q), np.asarray(state.u)
    if (host := system.on_host(0.0)) is None:
        positions = system.coordinate_residual(0.0, q)
        velocities = system.velocity_residual(0.0, q, u)
    else:
        positions, (velocities, _) = host.coordinate_residual(q), host.velocity_rows_at(q, u)
    assert np.max(np.abs(positions), initial=0.0) <= 1e-12
    assert np.max(np.abs(velocities), initial=0.0) <= 1e-11


REFUSED = [
    ("four_bars", {}, "four_bar"),
    ("pendulum", {"colour": "red"}, "colour"),
    ("andrews", {"problem": "ode"}, "iftomm"),
    ("swash_plate", {"pistons": 0}, "at least one piston"),
    ("swash_plate", {"rod": 0.01}, "do not reach the pistons"),
    ("n_four_bar", {"n": 0}, "n ≥ 1"),
    ("hanging_chain", {"mode": 6}, "1 … n"),
    ("hanging_chain", {"amplitude": 1.0}, "too much"),
    ("double_wishbone", {"joints": "rubber"}, "ideal, bushings"),
    ("double_wishbone", {"bushing": (1e6, 0.0)}, "no bushings"),
    ("double_wishbone", {"points": {"weel": (0.0, 0.0, 0.0)}}, "wheel"),
    ("five_link", {"points": {"tie_rod": (0.0, 0.0, 0.0)}}, "tie_rod_inner"),
    ("bennett", {"lengths": (1.0, 0.5)}, "leave no other twist"),
    ("tree", {"n": 0}, "n ≥ 1 rods"),
    ("tree", {"branching": 0}, "a branching ≥ 1"),
    ("cable", {"n": 1}, "n ≥ 2 rods"),
    ("cable", {"span": 0.0}, "between zero and its length of 1.0 m"),
    ("cable", {"span": 1.0}, "between zero and its length of 1.0 m"),
    ("net", {"n": 1}, "n ≥ 2 and m ≥ 2 knots"),
    ("net", {"m": 1}, "n ≥ 2 and m ≥ 2 knots"),
    ("net", {"spacing": 0.0}, "length must be positive"),
    *(
        (name, numbers, message)
        for name in ("train", "longitudinal_train")
        for numbers, message in (
            ({"n": 0}, "n ≥ 1"),
            ({"mass": (1.0, 2.0, 3.0)}, r"mass must be a number or one for each of 4 vehicles, got shape \(3,\)"),
            ({"resistance": 3.0}, "resistance must be"),
            ({"brake_rise": 0.0}, "brake_rise must be positive"),
        )
    ),
    *(
        ("train", {"n": 2, "coupler": functools.partial(planar.DraftGear, **numbers)}, f"'coupler1': {message}")
        for numbers, message in (
            ({"slack": -0.01}, "slack must be non-negative"),
            ({"unloading": 1.5}, "unloading .* at most 1"),
            ({"transition_speed": 0.0}, "transition_speed must be positive"),
            ({"smoothing": 0.0}, "smoothing must be positive"),
            ({"travel": 0.0}, "travel must be positive"),
        )
    ),
    ("tracked_vehicle", {"track": "belt"}, "track must be 'loop', 'shoes' or Shoes"),
    ("tracked_vehicle", {"track": 3}, "track must be 'loop', 'shoes' or Shoes"),
    ("tracked_vehicle", {"track": "shoes", "track_stiffness": 0.0}, "needs a track_stiffness > 0"),
]


def test_mechanism_that_cannot_be_built_is_refused():
    for name, parameters, message in REFUSED:
        with pytest.raises(ValueError, match=message):
            mechanisms.get(name, **parameters)


@pytest.mark.slow
def test_mechanism_is_built_again_with_other_parameters_under_jit():
    mechanism = library("four_bar")
    longer = mb.parameters(mechanism.system)["C.point_a"] * 1.01
    state = jax.jit(lambda point: mechanism.with_parameters({"C.point_a": point}).state)(longer)
    again = mechanism.with_parameters({"C.point_a": longer})
    np.testing.assert_allclose(state.q, again.state.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(state.u, again.state.u, rtol=0, atol=1e-12)
    assert np.max(np.abs(again.system.position_residual(0.0, state.q))) <= 1e-12
    assert float(state.q[2]) == pytest.approx(np.pi / 2)
    assert float(state.u[2]) == pytest.approx(4.0)
