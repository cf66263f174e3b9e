"""The library of mechanisms against published and independent values, their structure, and the behaviour of charts."""

import functools
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_as_users_do
from oracles import linkages, one_freedom, trains
from scipy.optimize import curve_fit
from scipy.special import roots_laguerre

import jaxmb as mb
from jaxmb import mechanisms

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


ANGLES = ("beta", "Theta", "gamma", "Phi", "delta", "Omega", "epsilon")
CASES = [
    ("pendulum", {}, 1e-8),
    ("rod_chain", {"n": 2}, 1e-6),
    ("rod_chain", {"n": 5}, 1e-6),
    ("rod_chain", {"n": 10}, 1e-6),
    pytest.param("rod_chain", {"n": 50}, 1e-5, marks=pytest.mark.slow),
    ("train", {}, 1e-5),
    ("four_bar", {}, 1e-7),
    ("slider_crank", {}, 1e-7),
    ("n_four_bar", {}, 1e-8),
    ("hanging_chain", {}, 1e-8),
    ("andrews", {}, 1e-8),
    ("car_axis", {}, 1e-8),
    ("tracked_vehicle", {}, 1e-8),
    ("knife_edge", {}, 1e-8),
    ("chaplygin_sleigh", {}, 1e-8),
    ("free_body", {}, 1e-7),
    ("heavy_top", {}, 1e-7),
    ("rolling_disc", {}, 1e-8),
    pytest.param("spatial_slider_crank", {}, 1e-7, marks=pytest.mark.slow),
    pytest.param("bricard", {}, 1e-6, marks=pytest.mark.slow),
    *((name, {}, 1e-8) for name in LINKAGES),
    ("roller_racer", {}, 1e-7),
    ("nonholonomic_cart", {}, 1e-7),
    ("three_platform_snake", {}, 1e-6),
    ("spherical_four_bar", {}, 1e-7),
    ("constant_speed_particle", {}, 1e-9),
    ("appell_hamel", {}, 1e-9),
    ("benenti", {}, 1e-8),
    ("rough_ring", {}, 1e-9),
    ("tracking_chain", {}, 1e-7),
]


def test_every_file_of_reference_values_belongs_to_a_mechanism():
    for path in (Path(mechanisms.__file__).parent / "data").iterdir():
        assert path.suffix == ".json" and path.stem.startswith(mechanisms.names())
        known = mechanisms.References.load(path.stem)
        assert known.source and 0 < known.tolerance < 1e-6 and np.all(np.diff(known.times) > 0)


@pytest.mark.slow
@pytest.mark.parametrize("name, parameters, bound", CASES)
def test_motion_agrees_with_reference_values_on_the_constraints(name, parameters, bound):
    mechanism, trajectory = run(name, **parameters)
    assert bound >= 10 * mechanism.references.tolerance
    errors = mechanism.errors(trajectory)
    assert set(errors) == set(mechanism.references.labels)
    labels = ANGLES if name == "andrews" else errors
    assert {label: errors[label][-1] for label in labels if not errors[label][-1] <= bound} == {}
    assert np.all(trajectory.constraint_violation.position <= 1e-10)
    assert np.all(trajectory.constraint_violation.velocity <= 1e-10)


CONSERVATIVE = [
    "pendulum",
    "four_bar",
    "slider_crank",
    "n_four_bar",
    "hanging_chain",
    "swash_plate",
    "bennett",
    "chaplygin_sleigh",
    "free_body",
    "heavy_top",
    "rolling_disc",
    "roller_racer",
    "nonholonomic_cart",
    "three_platform_snake",
    "benenti",
]


@pytest.mark.slow(but=("roller_racer", "nonholonomic_cart"))
@pytest.mark.parametrize("name", CONSERVATIVE)
def test_energy_is_conserved(name):
    mechanism, trajectory = run(name)
    system, state = mechanism.system, mechanism.state
    start = system.kinetic_energy(0.0, state.q, state.u) + system.potential_energy(0.0, state.q)
    size = np.max(np.abs(trajectory.kinetic_energy))
    np.testing.assert_allclose(trajectory.energy, start, rtol=0, atol=1e-9 * size)


@pytest.mark.slow
def test_work_of_the_torque_is_the_energy_of_andrews_mechanism():
    mechanism, trajectory = run("andrews")
    system, state = mechanism.system, mechanism.state
    start = system.kinetic_energy(0.0, state.q, state.u) + system.potential_energy(0.0, state.q)
    turned = trajectory["K1"].angle - state.q[2]
    np.testing.assert_allclose(trajectory.energy - start, 0.033 * turned, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [1, 3, 5])
def test_a_hanging_chain_swings_in_its_classical_modes(mode):
    """After half a period of small oscillations every mass is on the other side."""
    frequency = np.sqrt(9.81 * 5 * roots_laguerre(5)[0][mode - 1])
    chain, times = library("hanging_chain", mode=mode, amplitude=1e-5), np.array([0.2, 0.5, 1.0]) * np.pi / frequency
    trajectory = mb.simulate(chain.system, chain.state, t1=times[-1], saveat=times, **QUICKLY)
    start, places = np.asarray(chain.state.q[::2]), trajectory.ys.q[:, ::2]
    np.testing.assert_allclose(places, np.cos(frequency * times)[:, None] * start, rtol=0, atol=1e-6 * 1e-5)


def test_free_body_keeps_its_angular_momentum():
    mechanism, trajectory = run("free_body")
    start = mechanism.system.angular_momentum(mechanism.state.q, mechanism.state.u)
    np.testing.assert_allclose(trajectory.angular_momentum, np.tile(start, (3, 1)), rtol=0, atol=1e-8)


@pytest.mark.slow
def test_steady_precession():
    """Started on it, a top keeps its tilt, whichever of the two rates it precesses with; and its energy."""
    across, along, mass, distance, tilt, spin = 0.0045, 0.004, 1.0, 0.05, np.pi / 6, 30.0
    about_tip, weight = across + mass * distance**2, mass * 9.81 * distance
    root = np.sqrt((along * spin) ** 2 - 4 * about_tip * weight * np.cos(tilt))
    times = np.linspace(0.0, 10.0, 101)
    for precession in (along * spin + np.array([-root, root])) / (2 * about_tip * np.cos(tilt)):
        inertia = across, along
        top = mechanisms.heavy_top(inertia=inertia, distance=distance, precession=precession, spin=spin)
        motion = mb.simulate(top.system, top.state, t1=10.0, rtol=1e-11, saveat=times, max_steps=200_000)
        height = np.asarray(motion["top"].position[:, 2]) / distance
        np.testing.assert_allclose(np.arccos(height), tilt, rtol=0, atol=1e-9)
        energy = np.asarray(motion.energy)
        np.testing.assert_allclose(energy, energy[0], rtol=1e-9)


@pytest.mark.slow
def test_linkages_lie_flat_in_passing_at_every_speed():
    """They keep their energy, and the level bars stay level: no step ends where round-off is larger than its error."""
    linkages = library("n_four_bar")
    system, start = linkages.system, linkages.state

    @jax.jit
    def run(factor):
        state, times = mb.State(start.q, factor * start.u), np.linspace(0.0, 10.0, 11)
        motion = mb.simulate(system, state, t1=10.0, rtol=1e-10, saveat=times, max_steps=3000, throw=False)
        return motion.energy / motion.energy[0] - 1.0, motion["level1"].angle, motion.stats["num_accepted_steps"]

    for factor in np.linspace(0.5, 3.0, 20):
        energy, level, steps = run(factor)
        assert steps < 1500
        np.testing.assert_allclose(energy, 0.0, atol=1e-8)
        np.testing.assert_allclose(level, 0.0, atol=1e-8)


@pytest.mark.slow
def test_values_of_the_train_are_those_of_an_independent_model():
    references = library("train").references
    q, u, forces = trains.Train(4).motion(references.times)
    found = np.concatenate([q[:, :, 0], u[:, :, 0], forces], axis=1)
    np.testing.assert_allclose(found / references.scales, references.values / references.scales, rtol=0, atol=1e-6)


@pytest.mark.slow("four_bar")
@pytest.mark.parametrize("name", ["four_bar", "slider_crank", "n_four_bar", "hanging_chain"])
def test_carried_values_are_those_of_a_model_in_minimal_coordinates(name):
    references = library(name).references
    np.testing.assert_allclose(getattr(linkages, name)(references.times), references.values, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", LINKAGES)
def test_carried_values_are_those_of_a_model_of_where_the_bodies_are(name):
    references = library(name).references
    np.testing.assert_allclose(getattr(one_freedom, name)(references.times), references.values, rtol=0, atol=1e-12)


# Structure


def test_andrews_mechanism_has_one_degree_of_freedom():
    system = library("andrews").system
    assert (system.nu, system.velocity_rows, system.velocity_rank) == (21, 20, 20)


def test_bricard_linkage_moves_although_counting_rows_forbids_it():
    system = library("bricard").system
    assert (system.nu, system.velocity_rows, system.velocity_rank) == (30, 30, 29)
    (implied,) = system.implied
    assert {implied.name, *implied.by} == {"P0", "P1", "P2", "P3", "P4", "P5"}


@pytest.mark.slow
def test_bennetts_linkage_moves_by_his_relation_of_input_and_output():
    system = library("bennett").system
    assert (system.nu, system.velocity_rows, system.velocity_rank) == (18, 20, 17)
    a, b, beta = 0.3, 0.5, np.radians(70.0)
    alpha = np.arcsin(a * np.sin(beta) / b)
    mechanism, trajectory = run("bennett")
    observed = mechanism.observe(trajectory)
    # tan(x/2) = sin x / (1 + cos x)
    half = lambda end: observed[f"sin{end}"] / (1 + observed[f"cos{end}"])
    expected = np.sin((alpha + beta) / 2) / np.sin((beta - alpha) / 2)
    np.testing.assert_allclose(half("") * half("_out"), np.full(3, expected), rtol=1e-9)


@pytest.mark.slow
def test_coordinates_and_rows_of_the_compressor():
    """As its source counts them, with the ground as a body that six rows and its normalisation hold."""
    system = library("swash_plate").system
    bodies = len(system.body_names) + 1
    assert (bodies, system.nq + 7) == (9, 63)
    assert (system.coordinate_rows + 7, system.coordinate_rank + 7) == (62, 62)


@pytest.mark.slow
def test_planar_loop_in_space_has_27_independent_rows_of_30():
    system = library("spatial_loop").system
    assert (system.nq, system.coordinate_rows, system.coordinate_rank) == (28, 30, 27)
    assert system.nu - system.velocity_rank == 1
    assert len(system.implied) == 3
    for implied in system.implied:
        assert {implied.name, *implied.by} <= {"A", "B", "C", "D"}


def test_rolling_disc_has_five_coordinates_and_three_velocities():
    system = library("rolling_disc").system
    assert (system.nq - system.coordinate_rank, system.nu - system.velocity_rank) == (5, 3)


# Redundant rockers


@pytest.mark.slow
def test_a_redundant_rocker_does_not_change_the_motion():
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


PINS = {f"{end}{k}" for end in ("foot", "head") for k in (1, 2, 3)}


@pytest.mark.slow("0.001-1.0471975511965976")
@pytest.mark.parametrize("offset, angle", [(1e-3, np.pi / 3), (-1e-3, np.pi / 3), (1e-3, 1.5), (1e-2, 1.5)])
def test_a_misplaced_pin_is_refused_with_the_names_of_the_joints(offset, angle):
    with pytest.raises(ValueError, match=r"cannot (move|be assembled)") as error:
        mechanisms.parallelogram(offset=offset, angle=angle)
    assert all(pin in str(error.value) for pin in PINS)


@pytest.mark.slow
def test_a_rigid_frame_with_a_load_is_not_refused():
    corner = (0.5, 0.8)
    angle = np.arctan2(corner[1], 0.5)
    bars = [
        mb.planar.Body(f"bar{k}", mass=1.0, inertia=0.1, position=(x, 0.4), angle=a)
        for k, x, a in ((1, 0.25, angle), (2, 0.75, np.pi - angle))
    ]
    pins = [
        mb.planar.Revolute("left", "ground", "bar1", point=(0.0, 0.0)),
        mb.planar.Revolute("right", "ground", "bar2", point=(1.0, 0.0)),
        mb.planar.Revolute("top", "bar1", "bar2", point=corner),
    ]
    system = mb.Scene(bars, joints=pins).compile()
    assert system.nu == system.velocity_rank


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
def test_steps_do_not_shrink_where_the_chart_changes():
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


# The suspension


@pytest.mark.slow
def test_stiff_bushings_tend_to_hinges():
    """By the inverse of their stiffness."""
    exact, errors = library("double_wishbone").references.values[0], []
    for stiffness in (1e7, 1e8):
        soft = mechanisms.double_wishbone(joints="bushings", bushing=(stiffness, 0.0), bushing_damping=(1e4, 0.0))
        assert soft.system.nu - soft.system.velocity_rank == 11
        end = soft.observe(mb.simulate(soft.system, soft.state, t1=0.05, **(QUICKLY | {"rtol": 1e-8})))
        errors.append([float(end[label][-1]) for label in ("y", "toe")] - exact[[1, 3]])
    np.testing.assert_allclose(errors[0] / errors[1], 10.0, rtol=0.2)


# The rolling disc beyond steady motion


@pytest.mark.slow
@pytest.mark.parametrize("spin, frequency", [(3.0, 2.429815), (5.0, 6.656125), (8.0, 11.743253)])
def test_an_upright_rolling_disc_wobbles_at_the_frequency_of_small_oscillations(spin, frequency):
    mechanism = mechanisms.rolling_disc(radius=0.5, lean=1e-4, roll=spin, turn=0.0)
    times = jnp.linspace(0.0, 4.0, 101)
    trajectory = mb.simulate(mechanism.system, mechanism.state, t1=4.0, rtol=1e-11, atol=1e-15, saveat=times)
    lean = 1e4 * np.asarray(mechanism.observe(trajectory)["theta"])
    wave = lambda t, middle, size, omega: middle + size * np.cos(omega * t)
    (_, _, omega), _ = curve_fit(wave, np.asarray(times), lean, p0=(0.5, 0.5, frequency))
    assert omega == pytest.approx(np.sqrt(0.8 * (3 * spin**2 - 9.81 / 0.5)), rel=1e-5)
    assert omega == pytest.approx(frequency, rel=1e-5)


@pytest.mark.slow
def test_a_wobbling_disc_ends_where_an_independent_model_does():
    lean, spin, yaw = 0.3, 5.0, 0.8
    mechanism = mechanisms.rolling_disc(radius=0.5, lean=lean, roll=-spin + yaw * np.sin(lean), turn=yaw * np.cos(lean))
    trajectory = mb.simulate(mechanism.system, mechanism.state, t1=4.0, rtol=RTOL, saveat=jnp.array([1.0, 2.0, 4.0]))
    np.testing.assert_allclose(
        trajectory["disc"].position[-1], [0.791621867, -5.441766623, 0.477285836], rtol=0, atol=1e-6
    )
    assert trajectory.stats["charts"] - 1 >= 3


# The library itself


@pytest.mark.slow(
    "tree",
    "tracked_vehicle",
    "cable",
    "net",
    "spatial_slider_crank",
    "spatial_loop",
    "bennett",
    "swash_plate",
    "double_wishbone",
    "five_link",
    "flyball",
    "spherical_four_bar",
)
@pytest.mark.parametrize("name", mechanisms.names())
def test_every_mechanism_starts_on_its_constraints(name):
    mechanism = library(name)
    system, state = mechanism.system, mechanism.state
    assert mechanism.name == name
    assert mechanism.description and mechanism.t1 > 0
    assert np.max(np.abs(system.coordinate_residual(0.0, state.q)), initial=0.0) <= 1e-12
    assert np.max(np.abs(system.velocity_residual(0.0, state.q, state.u)), initial=0.0) <= 1e-11


def test_names_are_checked():
    with pytest.raises(ValueError, match="four_bar"):
        mechanisms.get("four_bars")
    with pytest.raises(ValueError, match="colour"):
        mechanisms.get("pendulum", colour="red")
    with pytest.raises(ValueError, match="iftomm"):
        mechanisms.andrews(problem="ode")


@pytest.mark.parametrize(
    "name, parameters, message",
    [
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
    ],
)
def test_dimensions_are_checked(name, parameters, message):
    with pytest.raises(ValueError, match=message):
        mechanisms.get(name, **parameters)


@pytest.mark.slow
def test_references_hold_for_the_published_parameters_only():
    assert mechanisms.pendulum(length=1.0).references is not None
    other = mechanisms.pendulum(length=0.5)
    assert other.references is None
    with pytest.raises(ValueError, match="no reference values"):
        other.errors(run("pendulum")[1])


@pytest.mark.slow
def test_errors_need_a_trajectory_saved_at_the_times():
    mechanism, trajectory = run("pendulum")
    with pytest.raises(ValueError, match=r"references\.times"):
        mechanism.errors(eqx.tree_at(lambda t: t.ts, trajectory, trajectory.ts + 0.5))


def test_references_of_the_wrong_shape_are_refused():
    with pytest.raises(ValueError, match="shape"):
        mechanisms.References([0.0, 1.0], ("x",), [[1.0]], "nowhere", 1e-10)


@pytest.mark.slow
def test_mechanisms_are_rebuilt_with_other_parameters_under_jit():
    mechanism = library("four_bar")
    longer = mb.parameters(mechanism.system)["C.point_a"] * 1.01

    @jax.jit
    def rebuilt(point):
        return mechanism.with_parameters({"C.point_a": point}).state

    state = rebuilt(longer)
    again = mechanism.with_parameters({"C.point_a": longer})
    np.testing.assert_allclose(state.q, again.state.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(state.u, again.state.u, rtol=0, atol=1e-12)
    assert np.max(np.abs(again.system.position_residual(0.0, state.q))) <= 1e-12
    assert float(state.q[2]) == pytest.approx(np.pi / 2)
    assert float(state.u[2]) == pytest.approx(4.0)
