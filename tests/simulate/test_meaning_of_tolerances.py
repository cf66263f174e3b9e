"""At equal tolerance the error of a result is about the same with every method."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from compiling import jit_quickly

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.manifold.internal_states import counted_components
from jaxmb.simulate.method import running_scales
from jaxmb.solvers.tolerances import NormOfCounted

TOLERANCES = 10.0 ** -np.array([4.0, 6.0, 8.0, 10.0])
SOLVERS = {"Adams": mb.solvers.Adams(), "Dopri8": diffrax.Dopri8(), "Hermite": mb.solvers.Hermite()}

# Mechanisms, with the end of a short motion [s]; planar, spatial, nonholonomic and from Lagrangians.
MOTIONS = {
    "four_bar": 2.0,
    "andrews": 0.03,
    "hanging_chain": 1.0,
    "knife_edge": 3.0,
    "heavy_top": 1.0,
    "rolling_disc": 1.0,
    "roller_racer": 2.0,
    "benenti": 2.0,
    "rough_ring": 2.0,
}
IMPLICIT = ("four_bar", "heavy_top", "roller_racer", "benenti")


@functools.cache
def mechanism(name):
    return mb.mechanisms.get(name)


def states(name, solver, rtol):
    """Coordinates and velocities in natural units at five times."""
    system, end = mechanism(name).system, MOTIONS[name]
    times = np.linspace(0.0, end, 6)[1:]
    sol = mb.simulate(
        system, mechanism(name).state, t1=end, saveat=times, rtol=rtol, solver=SOLVERS[solver], max_steps=20000
    )
    return np.asarray(sol.ys.q / system.coordinate_scale()[None]), np.asarray(sol.ys.u / system.velocity_scale()[None])


@functools.cache
def errors(name, solver):
    """The largest error relative to the largest coordinate, or velocity, at each tolerance."""
    exact = states(name, "Adams", 2e-14)
    largest = lambda found: max(np.max(np.abs(a - b)) / np.max(np.abs(b)) for a, b in zip(found, exact, strict=True))
    return np.array([largest(states(name, solver, rtol)) for rtol in TOLERANCES])


def check(ratios):
    assert np.median(ratios) <= 3 and np.max(ratios) <= 15, np.round(ratios, 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", MOTIONS)
def test_errors_of_all_methods_are_those_of_a_runge_kutta_method(name):
    for solver in ("Adams", *["Hermite"] * (name in IMPLICIT)):
        check(errors(name, solver) / errors(name, "Dopri8"))


@pytest.mark.slow
@pytest.mark.parametrize("solver, finest", [("Adams", 1e-13), ("Hermite", 1e-12)])
def test_steps_do_not_creep_where_rounding_limits_them(solver, finest):
    system, state = mechanism("four_bar").system, mechanism("four_bar").state
    run = lambda rtol: mb.simulate(system, state, t1=1.0, rtol=rtol, solver=SOLVERS[solver], max_steps=5000)
    steps = [int(run(rtol).stats["num_steps"]) for rtol in (100 * finest, 10 * finest, finest)]
    assert steps[0] < steps[1] <= steps[2] < 2 * steps[0]


def pendulum(*more):
    bar = planar.Body("bar", mass=1.0, inertia=1 / 12, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    return mb.Scene([bar], joints=[pin, *more], forces=[mb.Gravity((0.0, -9.81))]).compile()


def stops(count):
    """With one end, and with two."""
    one = [mb.Stop(f"end{k}", "pin.angle", lower=-50.5 - k, restitution=0.5) for k in range(count)]
    return [*one, *(mb.Stop(f"ends{k}", "pin.angle", lower=-60.5, upper=50.5 + k) for k in range(count))]


PENDULUM, AMONG_STOPS = pendulum(), pendulum(*stops(4))


WAYS = {
    "Adams": {},
    "Projection": {"manifold": mb.manifold.Projection()},
    "MultistepController": {"stepsize_controller": mb.solvers.MultistepController(1e-6, 1e-8)},
    "Hermite": {"solver": mb.solvers.Hermite()},
    "PIDController": {"solver": diffrax.Tsit5(), "stepsize_controller": diffrax.PIDController(1e-6, 1e-8)},
}


def test_modes_are_left_out_of_norms():
    """The norm of an error is that without stops."""
    assert counted_components(PENDULUM) is None
    own = counted_components(AMONG_STOPS)
    assert own == (0, 1, 2, 11, 12, 13)
    norm = NormOfCounted(optimistix.rms_norm, own)
    error = jnp.array([1.0, -2.0, 3.0])
    none = jnp.zeros(8)
    among = mb.State(jnp.append(error, none), jnp.append(2 * error, none))
    np.testing.assert_allclose(norm(among), optimistix.rms_norm(mb.State(error, 2 * error)), rtol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_stops_that_are_never_reached_change_no_step(way):
    """The modes of contacts are no components whose errors count."""
    runs = [
        mb.simulate(system, mb.assemble(system, fix={"bar.angle": 0.5}), t1=4.0, rtol=1e-6, **WAYS[way])
        for system in (PENDULUM, AMONG_STOPS)
    ]
    alone, among = (int(motion.stats["num_steps"]) for motion in runs)
    assert alone == among
    np.testing.assert_allclose(runs[0].ys.q[-1], runs[1].ys.q[-1, :3], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver, name",
    [(mb.solvers.Adams(), "bar.mass"), (mb.solvers.Adams(), "bar.angle"), (diffrax.Tsit5(), "bar.mass")],
    ids=["Adams by a mass", "Adams by the start", "Tsit5 by a mass"],
)
def test_stops_that_are_never_reached_change_no_step_of_a_derivative(solver, name):
    """Neither where tangents by parameters are controlled, nor those by the state."""

    def run(system, x):
        system = mb.with_parameters(system, {name: x}) if name == "bar.mass" else system
        start = mb.assemble(system, fix={"bar.angle": 0.5 if name == "bar.mass" else x})
        motion = mb.simulate(system, start, t1=2.0, rtol=1e-6, solver=solver)
        return motion.ys.q[-1, 2], motion.stats["num_steps"]

    runs = [
        jit_quickly(jax.jacfwd(functools.partial(run, system), has_aux=True))(1.3) for system in (PENDULUM, AMONG_STOPS)
    ]
    assert runs[0][1] == runs[1][1]
    np.testing.assert_allclose(runs[0][0], runs[1][0], rtol=1e-6)


@pytest.mark.slow
def test_stops_change_no_step_beside_internal_states():
    drive = mb.Motor("drive", "pin.angle", command=0.5, lag=0.2)
    bar = planar.Body("bar", mass=1.0, inertia=1 / 12, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    steps = []
    for own in ([], [mb.Stop(f"end{k}", "pin.angle", lower=-50.5 - k) for k in range(2)]):
        system = mb.Scene([bar], joints=[pin, *own], forces=[mb.Gravity((0.0, -9.81)), drive]).compile()
        start = mb.assemble(system, fix={"bar.angle": 0.5})
        steps.append(int(mb.simulate(system, start, t1=4.0, rtol=1e-6).stats["num_steps"]))
    assert steps[0] == steps[1]


@pytest.mark.slow
def test_modes_of_friction_do_not_count():
    """In space they are two, and its velocities as many."""
    top = spatial.Body("top", mass=1.0, inertia=np.diag([1.0, 2.0, 3.0]), position=(0.0, 0.0, 1.0))
    foot = mb.RigidContact("foot", "top", terrain=mb.terrain.Flat())
    system = mb.Scene([top], joints=[foot], forces=[mb.DryFriction("rub", "foot", coefficient=0.3)]).compile()
    assert (system.nq, system.nu) == (10, 9)
    assert counted_components(system) == (*range(7), *range(10, 16))


@pytest.mark.slow
def test_a_contact_that_is_closed_is_no_size_of_a_motion():
    """A small motion stays small where a mode is one."""
    start = mb.assemble(AMONG_STOPS, fix={"bar.angle": 0.5})
    scales = running_scales(AMONG_STOPS, start, 1.0)
    modes = jnp.arange(AMONG_STOPS.nq) >= PENDULUM.nq
    at = lambda mode: jnp.concatenate([jnp.where(modes, mode, 1e-3), jnp.zeros(AMONG_STOPS.nu)])
    sizes = [scales.start(at(mode), jnp.zeros_like(at(mode))) for mode in (0.0, 1.0)]
    np.testing.assert_array_equal(*sizes)
    assert sizes[0][0] < 0.01
