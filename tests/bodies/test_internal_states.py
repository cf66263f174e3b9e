"""Parts with internal states: motors with lag, controllers with memory, tyres with relaxation."""

import dataclasses
import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivative_checks import in_both_modes
from oracles import driven

import jaxmb as mb
from jaxmb import contact, formulations, manifold, mechanisms, planar, solvers, spatial, terrain
from jaxmb.manifold.impulse import after_impulse
from jaxmb.parts import (
    AbstractDynamicForce,
    AbstractForce,
    AbstractPotentialForce,
    Number,
    body_name,
    internal_state,
    name,
    parameter,
)

# Of the cart's place and speed, the pole's angle and its rate, and the integral of the place; a stable motion.
GAINS = {"place": 27.0, "speed": 27.0, "angle": -160.0, "rate": -45.0, "integral": 10.0}
METHODS = {
    "Adams": {},
    "Hermite": {"solver": solvers.Hermite()},
    "Dopri8": {"solver": diffrax.Dopri8()},
    "Adams, projection": {"manifold": manifold.Projection()},
    "Adams, Baumgarte": {"manifold": manifold.Baumgarte(20.0)},
}


def balance(t, measured, states, p):
    seen = measured | states
    return sum(p[f"of_{name}"] * seen[name] for name in GAINS), {"integral": measured["place"]}


@functools.cache
def plain_cart_and_pole():
    return cart_and_pole()


def cart_and_pole(**options):
    cart = planar.Body("cart", mass=2.0, inertia=1.0)
    pole = planar.Body("pole", mass=0.5, inertia=planar.rod(0.5, 1.2), position=(0.0, 0.6))
    joints = [
        planar.Prismatic("slide", "ground", "cart", point=(0.0, 0.0), axis=(1.0, 0.0)),
        planar.Revolute("hinge", "cart", "pole", point=(0.0, 0.0)),
    ]
    own = {
        "measures": {
            "place": "slide.displacement",
            "speed": "slide.displacement_rate",
            "angle": "hinge.angle",
            "rate": "hinge.angle_rate",
        },
        "acts_on": "slide.displacement",
        "states": {"integral": 0.0},
        "parameters": {f"of_{name}": gain for name, gain in GAINS.items()},
    }
    controller = mb.Controller("pid", balance, **own | options)
    return mb.Scene([cart, pole], joints=joints, forces=[mb.Gravity((0.0, -9.81)), controller]).compile()


def leaning(system, angle=0.1, **options):
    return mb.assemble(system, fix={"hinge.angle": angle, "slide.displacement": 0.0}, **options)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_controller_moves_a_pole_as_its_own_equations(method):
    system, times = plain_cart_and_pole(), np.array([0.7, 2.0])
    sol = mb.simulate(system, leaning(system), t1=2.0, saveat=times, rtol=1e-10, **METHODS[method])
    slide, hinge = sol["slide"], sol["hinge"]
    found = [slide.displacement, slide.displacement_rate, hinge.angle, hinge.angle_rate, sol["pid"].integral]
    expected = driven.cart_and_pole(times, list(GAINS.values()))
    np.testing.assert_allclose(np.stack(found, axis=1), expected, rtol=0, atol=1e-8)
    np.testing.assert_allclose(sol.ys.z[:, 0], expected[:, 4], rtol=0, atol=1e-8)
    assert np.max(sol.constraint_violation.position) < (1e-6 if "Baumgarte" in method else 1e-11)


@pytest.mark.slow
def test_error_control_sees_internal_states():
    """A filter that nothing depends on is followed as accurately as the motion."""
    system = filtered()
    coarse = mb.simulate(system, mb.assemble(system), t1=3.0, rtol=1e-8)
    # ẏ = (cos 20t − y) / 0.1
    steady = lambda t: (np.cos(20 * t) + 2.0 * np.sin(20 * t)) / 5.0
    expected = steady(3.0) - steady(0.0) * np.exp(-30.0)
    np.testing.assert_allclose(coarse["filter"].value[-1], expected, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_small_states_that_start_at_zero_are_as_accurate():
    """A motor of nanonewton metres on a rotor as small moves it like one of newton metres a large one, to some `rtol`,
    since its force is too small at first to be controlled for its own sake.
    """
    unit, w, lag, t = 1e-9, 5.0, 0.05, 3.0
    rod = planar.Body("rod", mass=1.0, inertia=0.1 * unit)
    pin = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    motor = mb.Motor("motor", "pin.angle", command=0.0, lag=lag)
    system = mb.Scene([rod], joints=[pin], forces=[motor]).compile()
    command = {"motor.command": lambda t: unit * jnp.sin(w * t)}
    # Twice the integral of the lagging force.
    decay = lag * (1 - np.exp(-t / lag))
    angle = t / w - np.sin(w * t) / w**2 - lag * (1 - np.cos(w * t)) / w + w * lag**2 * (t - decay)
    expected = angle / (1 + (w * lag) ** 2) / 0.1
    for method in ("Adams", "Hermite"):
        sol = mb.simulate(system, mb.assemble(system), t1=t, inputs=command, **METHODS[method])
        np.testing.assert_allclose(sol["rod"].angle[-1], expected, rtol=1e-7)


class Filter(AbstractDynamicForce):
    """A signal that is filtered, and pushes nothing."""

    name: str = name()
    body: str = body_name()
    lag: Number = parameter(unit="s", sign="positive")
    value: Number = internal_state()

    def wrenches(self, space, poses, velocities, t):
        return jnp.zeros_like(velocities)

    def state_rates(self, space, poses, velocities, t):
        return {"value": (jnp.cos(20 * t) - self.value) / self.lag}


def filtered(part=None):
    body = planar.Body("body", mass=1.0, inertia=1.0, velocity=(1.0, 0.0))
    return mb.Scene([body], forces=[part or Filter("filter", "body", lag=0.1)]).compile()


class Maxwell(AbstractDynamicForce, AbstractPotentialForce):
    """A spring in series with a damper, along x."""

    name: str = name()
    body: str = body_name()
    stiffness: Number = parameter(unit="N/m", sign="positive")
    damping: Number = parameter(unit="N s/m", sign="positive")
    creep: Number = internal_state(unit="m")

    def stretch(self, poses):
        return poses[0, 0] - self.creep

    def wrenches(self, space, poses, velocities, t):
        return jnp.zeros_like(velocities).at[0, 0].set(-self.stiffness * self.stretch(poses))

    def energy(self, space, poses, t):
        return 0.5 * self.stiffness * self.stretch(poses) ** 2

    def state_rates(self, space, poses, velocities, t):
        return {"creep": self.stiffness * self.stretch(poses) / self.damping}


def test_energy_depends_on_internal_states():
    body = planar.Body("body", mass=1.0, inertia=1.0)
    system = mb.Scene([body], forces=[Maxwell("spring", "body", stiffness=10.0, damping=1.0)]).compile()
    ts, x, creep = np.array([0.0, 1.0]), np.array([0.1, 0.3]), np.array([0.0, -0.2])
    ys = mb.State(jnp.array([x, 0 * x, 0 * x]).T, jnp.zeros((2, 3)), jnp.array(creep)[:, None])
    sol = mb.Trajectory(system, formulations.Multipliers(), ts, ys, {}, mb.RESULTS.successful, None, None)
    np.testing.assert_allclose(sol.energy, 5.0 * (x - creep) ** 2, rtol=1e-12)


@pytest.mark.slow
def test_failure_of_friction_is_named_beside_internal_states():
    """A rod that slides on the floor swings up to Painlevé's angle, with a motor that stays without force."""
    rod = planar.Body("rod", mass=1.0, inertia=1 / 12, position=(0.5, 0.0))
    floor = planar.PointOnLine("floor", "ground", "rod", point_a=(0.0, 0.0), point_b=(-0.5, 0.0), axis_a=(1.0, 0.0))
    rub = planar.Friction("rub", "floor", coefficient=1.5, transition_speed=1e-2)
    motor = mb.Motor("motor", "floor.displacement", command=0.0, lag=0.1)
    forces = [mb.Gravity((0.0, -9.81)), rub, motor]
    system = mb.Scene([rod], joints=[floor], forces=forces).compile()
    state = mb.assemble(system, fix={"rod.angle": 0.5}, rates={"rod.x": -3.0, "rod.angle": 6.0})
    with pytest.raises(RuntimeError, match=r"friction of 'floor' came to a singular configuration"):
        mb.simulate(system, state, t1=1.0)


@pytest.mark.slow
def test_rate_of_a_state_that_is_not_finite_is_named():
    bad = lambda t, measured, states, p: (0.0, {"integral": jnp.sqrt(0.5 - t)})
    system = cart_with(bad)
    state = system.guess
    assert system.with_states(state.z).catalogue.not_finite(0.4, state.q, state.u) == ()
    assert system.with_states(state.z).catalogue.not_finite(0.6, state.q, state.u) == ("the rate of 'pid.integral'",)


@pytest.mark.slow
def test_controller_derivatives_by_gains_and_the_start():
    """Forward mode, reverse mode, and differences of a tighter motion."""
    system = plain_cart_and_pole()

    def run(x, rtol):
        changed = mb.with_parameters(system, {"pid.of_angle": x[0], "pid.of_integral": x[1]})
        start = mb.assemble(changed, fix={"hinge.angle": x[2], "slide.displacement": 0.0, "pid.integral": x[3]})
        sol = mb.simulate(changed, start, t1=1.0, rtol=rtol, throw=False)
        return jnp.stack([sol["hinge"].angle[-1], sol["pid"].integral[-1]])

    x = jnp.array([-160.0, 10.0, 0.1, 0.02])
    value, derivative = in_both_modes(lambda x: run(x, 1e-10), x)
    tight = jax.jit(jax.vmap(lambda x: run(x, 1e-12)))
    at = np.asarray(x)
    step = 1e-4 * np.diag(at)
    differences = np.asarray((tight(at + step) - tight(at - step)) / (2e-4 * at)[:, None]).T
    sizes = np.abs(differences).max(axis=1, keepdims=True)
    np.testing.assert_allclose(derivative / sizes, differences / sizes, rtol=0, atol=1e-6)
    np.testing.assert_allclose(value, tight(x[None])[0], atol=1e-8)


@pytest.mark.slow
def test_controller_in_linear_equations():
    system = plain_cart_and_pole()
    at_rest = mb.equilibrium(system, fix={"hinge.angle": 0.0, "slide.displacement": 0.0})
    linear = mb.linearise(system, at_rest, coordinates=["slide.displacement", "hinge.angle"], outputs=["pid.integral"])
    assert linear.states[-1] == "pid.integral"
    # M z̈ + K z = force, about the upright pole.
    inertia = np.array([[2.5, -0.3], [-0.3, 0.24]])
    accelerations = np.linalg.solve(inertia, [list(GAINS.values()), [0.0, 0.0, 0.3 * 9.81, 0.0, 0.0]])
    A = np.array([[0, 1, 0, 0, 0], accelerations[0], [0, 0, 0, 1, 0], accelerations[1], [1, 0, 0, 0, 0]])
    expected = np.linalg.eigvals(A)
    np.testing.assert_allclose(np.sort_complex(linear.eigenvalues), np.sort_complex(expected), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(linear.C, [[0, 0, 0, 0, 1]])
    mode = linear.mode(int(np.argmax(np.abs(expected))))
    assert mode.at(0.3, 0.01).z.shape == (1,)


def motor_on_four_bar(**changes):
    own = {"mode": "speed", "command": 6.0, "gain": 30.0, "lag": 0.05, "limit": 40.0} | changes
    return mechanisms.four_bar().scene.extended(forces=[mb.Motor("motor", "A.angle", **own)]).compile()


@pytest.mark.slow
def test_motor_with_lag_drives_a_four_bar():
    system, times, own = motor_on_four_bar(), np.array([0.4, 1.5]), mechanisms.four_bar()
    start = mb.assemble(system, own.state, fix=own.fix, rates=own.rates)
    sol = mb.simulate(system, start, t1=1.5, saveat=times, rtol=1e-10)
    found = np.stack([sol["crank"].angle, sol["crank"].angular_velocity, sol["motor"].force], axis=1)
    expected = driven.motor_of_four_bar(times, command=6.0, gain=30.0, lag=0.05, limit=40.0)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)
    # The wrench of the motor is that of its state, and the ground takes the reaction.
    np.testing.assert_allclose(sol.forces["motor"][:, 1, 2], sol["motor"].force, rtol=0, atol=1e-12)
    np.testing.assert_allclose(sol.to_dict()["motor.force"], sol.ys.z[:, 0])


@pytest.mark.slow
def test_motor_approaches_what_its_mode_demands():
    """The force approaches what the mode demands."""
    rod = planar.Body("rod", mass=1.0, inertia=0.1, angular_velocity=0.5)
    pin = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    for options, demand in (
        ({"mode": "force", "command": 2.0}, 2.0),
        ({"mode": "speed", "command": 2.0, "gain": 3.0}, 3.0 * (2.0 - 0.5)),
        ({"mode": "position", "command": 0.4, "gain": 3.0, "damping": 0.2}, 3.0 * 0.4 - 0.2 * 0.5),
        ({"mode": "position", "command": 5.0, "gain": 3.0}, 3.0 * (5.0 - 2 * np.pi)),
        ({"mode": "position", "command": -8.0, "gain": 3.0}, 3.0 * (-8.0 + 2 * np.pi)),
        ({"mode": "force", "command": 2.0, "limit": 1.5}, 1.5 * np.tanh(2.0 / 1.5)),
    ):
        system = mb.Scene([rod], joints=[pin], forces=[mb.Motor("m", "pin.angle", lag=0.1, **options)]).compile()
        state = mb.assemble(system, fix={"m.force": 0.3}, rates={"rod.angle": 0.5})
        rate = system.with_states(state.z).state_rates(0.0, state.q, state.u)
        np.testing.assert_allclose(rate, [(demand - 0.3) / 0.1], rtol=1e-12)


def car(p=driven.CAR):
    at = lambda corner: (corner[0], corner[1], corner[2] + 0.49)
    chassis = spatial.Body("chassis", mass=p["mass"], inertia=np.diag(p["inertia"]), position=at((0.0, 0.0, 0.0)))
    wheels, axles, tyres = [], [], []
    for k, corner in enumerate(p["corners"]):
        inertia = np.diag(p["wheel_inertia"])
        wheels.append(spatial.Body(f"wheel{k}", mass=p["wheel_mass"], inertia=inertia, position=at(corner)))
        axles.append(spatial.Revolute(f"axle{k}", "chassis", f"wheel{k}", point=at(corner), axis=(0.0, 1.0, 0.0)))
        tyre = spatial.Tyre(
            f"tyre{k}",
            f"wheel{k}",
            radius=p["radius"],
            terrain=terrain.Bump(**p["bump"]),
            normal=contact.Linear(p["stiffness"]),
            coefficient=p["coefficient"],
            slip_stiffness=p["slip_stiffness"],
            relaxation_length=p["relaxation"],
            transition_speed=p["transition_speed"],
            damping=p["damping"],
            damping_depth=p["damping_depth"],
            smoothing=p["smoothing"],
        )
        tyres.append(tyre)
    return mb.Scene([chassis, *wheels], joints=axles, forces=[mb.Gravity((0.0, 0.0, -9.81)), *tyres]).compile()


@pytest.mark.slow
def test_tyres_of_a_car_that_passes_a_bump():
    system, times = car(), np.array([0.5, 1.0])
    rates = {"chassis.velocity": (6.0, 0.0, 0.0), "chassis.angular_velocity": (0.0, 0.0, 0.1)}
    state = mb.assemble(system, rates=rates | {f"axle{k}.angle": 20.0 for k in range(4)})
    sol = mb.simulate(system, state, t1=1.0, saveat=times, rtol=1e-10)
    expected = driven.car(times, height=0.49, speed=6.0, turn=0.1)
    chassis = sol["chassis"]
    found = [chassis.position, chassis.velocity, chassis.orientation, chassis.angular_velocity]
    found += [sol[f"axle{k}"].angle_rate[:, None] for k in range(4)]
    found += [sol[f"tyre{k}"].deflection for k in range(4)]
    np.testing.assert_allclose(np.concatenate(found, axis=1), expected, rtol=0, atol=1e-8)


def chain_of_motors(n):
    """Rods in a row, each with a motor on its pin."""
    rods = [planar.Body(f"rod{k}", mass=1.0, inertia=1 / 12, position=(k + 0.5, 0.0)) for k in range(n)]
    pins = [
        planar.Revolute(f"pin{k}", "ground" if k == 0 else f"rod{k - 1}", f"rod{k}", point=(float(k), 0.0))
        for k in range(n)
    ]
    motor = lambda k: mb.Motor(f"motor{k}", f"pin{k}.angle", command=1.0 + 0.1 * k, lag=0.1, limit=3.0)
    forces = [mb.Gravity((0.0, -9.81)), *map(motor, range(n))]
    return mb.Scene(rods, joints=pins, forces=forces).compile()


@pytest.mark.slow
def test_motors_of_many_joints_move_as_with_dense_matrices():
    system = chain_of_motors(20)
    assert system.elimination is not None and system.nz == 20
    state = mb.assemble(system)
    sparse = mb.simulate(system, state, t1=0.3, rtol=1e-9)
    dense = mb.simulate(system, state, t1=0.3, rtol=1e-9, manifold=manifold.Partition())
    for a, b in zip(jax.tree.leaves(sparse.ys), jax.tree.leaves(dense.ys), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_jump_keeps_internal_states():
    system = chain_of_motors(15)
    assert system.elimination is not None
    before = dataclasses.replace(system.guess, z=system.guess.z + 1.0)
    after = eqx.filter_jit(after_impulse)(system, 0.0, before)
    np.testing.assert_array_equal(after.z, before.z)
    np.testing.assert_allclose(after.u, 0.0, atol=1e-12)


@pytest.mark.slow
def test_controllers_that_are_equal_are_computed_together():
    hold = lambda t, measured, states, p: (-p["gain"] * measured["angle"], {})
    rods = [planar.Body(f"rod{k}", mass=1.0, inertia=1 / 12, position=(2.0 * k + 0.5, 0.0)) for k in range(3)]
    pins = [planar.Revolute(f"pin{k}", "ground", f"rod{k}", point=(2.0 * k, 0.0)) for k in range(3)]
    angle = lambda k: f"pin{k}.angle"
    forces = [
        mb.Controller(f"hold{k}", hold, {"angle": angle(k)}, angle(k), parameters={"gain": 1.0 + k}) for k in range(3)
    ]
    system = mb.Scene(rods, joints=pins, forces=forces).compile()
    assert len(system.forces.groups) == 1
    angles = 0.1 * np.arange(1, 4)
    state = mb.assemble(system, fix=dict(zip(map(angle, range(3)), angles, strict=True)))
    found, _ = formulations.accelerations(system, formulations.Multipliers(), 0.0, state.q, state.u)
    np.testing.assert_allclose(found[2::3], -np.arange(1.0, 4.0) * angles / (1 / 12 + 1 / 4), rtol=1e-10)


@pytest.mark.slow
def test_controller_sees_frames_bodies_and_joints():
    """What the function is given is what the trajectory shows."""
    record = lambda t, measured, states, p: (0.0, measured)
    rod = planar.Body("rod", mass=1.0, inertia=0.1, centre=(0.4, 0.0), position=(0.0, 0.0))
    frames = [planar.Frame("tip", "rod", position=(0.9, 0.1), angle=0.3)]
    pin = planar.Revolute("hip", "ground", "rod", point=(0.0, 0.0))
    names = ["tip.position", "tip.velocity", "tip.angle", "rod.position", "rod.angular_velocity", "hip.angle_rate"]
    shapes = {"position": np.zeros(2), "velocity": np.zeros(2)}
    states = {f"seen{k}": shapes.get(quantity.split(".")[1], 0.0) for k, quantity in enumerate(names)}
    watcher = mb.Controller("watcher", record, dict(zip(states, names, strict=True)), "hip.angle", states=states)
    system = mb.Scene([rod], joints=[pin], frames=frames, forces=[watcher]).compile()
    state = mb.assemble(system, fix={"hip.angle": 0.5}, rates={"hip.angle": 1.5})
    sol = mb.simulate(system, state, t1=0.01, saveat=[0.0])
    rates = system.with_states(state.z).state_rates(0.0, state.q, state.u)
    for quantity, index in zip(names, system.state_names().values(), strict=True):
        np.testing.assert_allclose(rates[np.array(index)], np.ravel(sol.quantity(quantity)[0]), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_internal_states_at_events_in_dense_output_and_in_batches():
    system = plain_cart_and_pole()
    low = diffrax.Event(lambda t, y, args, **_: y.z[0] + 0.01)
    sol = mb.simulate(
        system, leaning(system), t1=2.0, rtol=1e-10, event=low, saveat=diffrax.SaveAt(t1=True, dense=True)
    )
    np.testing.assert_allclose(sol.ys.z[-1], -0.01, rtol=0, atol=1e-3)
    expected = driven.cart_and_pole(np.array([0.05]), list(GAINS.values()))
    np.testing.assert_allclose(sol.at(0.05).z, expected[0, 4:], rtol=0, atol=1e-9)

    def run(integral):
        state = leaning(system)
        state = mb.State(state.q, state.u, jnp.stack([integral]))
        return mb.simulate(system, state, t1=0.5, rtol=1e-9, throw=False).ys

    batch = jax.vmap(run)(jnp.array([0.0, jnp.nan, 0.05]))
    assert np.all(np.isnan(batch.q[1])) and np.all(np.isnan(batch.z[1]))
    for k in (0, 2):
        np.testing.assert_allclose(batch.z[k], run(jnp.array([0.0, 0.0, 0.05])[k]).z, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_error_of_internal_states_is_estimated():
    system = plain_cart_and_pole()
    sol = mb.simulate(system, leaning(system), t1=2.0, rtol=1e-6, error=True)
    expected = driven.cart_and_pole(np.array([2.0]), list(GAINS.values()))
    true = abs(float(sol["pid"].integral[-1]) - expected[0, 4])
    assert 0.1 < true / float(sol.error.quantity("pid.integral")[-1]) < 10


def test_state_without_internal_states_has_none():
    mechanism = mechanisms.four_bar()
    system, state = mechanism.system, mechanism.state
    assert state.z is None and system.nz == 0 and system.at(state) is system


class Forgetful(AbstractForce):
    """A part that declares a state without a rate."""

    name: str = name()
    body: str = body_name()
    value: Number = internal_state()

    def wrenches(self, space, poses, velocities, t):
        return jnp.zeros_like(velocities)


class Misnamed(Filter):
    def state_rates(self, space, poses, velocities, t):
        return {"other": 0.0}


class Misshapen(Filter):
    def state_rates(self, space, poses, velocities, t):
        return {"value": jnp.zeros(2)}


def cart_with(function):
    cart = planar.Body("cart", mass=2.0, inertia=1.0)
    slide = planar.Prismatic("slide", "ground", "cart", point=(0.0, 0.0), axis=(1.0, 0.0))
    controller = mb.Controller("pid", function, {}, "slide.displacement", states={"integral": 0.0})
    return mb.Scene([cart], joints=[slide], forces=[controller]).compile()


def run_without_states():
    system = plain_cart_and_pole()
    mb.simulate(system, mb.State(system.guess.q, system.guess.u), t1=1.0)


def run_with_states():
    own = mechanisms.four_bar()
    mb.simulate(own.system, mb.State(own.state.q, own.state.u, np.zeros(2)), t1=1.0)


TWICE, DOTTED = ["slide.displacement", "slide.displacement"], {"integral": 0.0, "a.b": 0.0}
REFUSED = [
    (lambda: filtered(Forgetful("f", "body")), "Forgetful 'f' has internal states; derive it from"),
    (lambda: filtered(Misnamed("f", "body", lag=1.0)), "a dictionary of the internal states, value"),
    (
        lambda: filtered(Misshapen("f", "body", lag=1.0)),
        r"state_rates\['value'\] must return shape \(\), got \(2,\)",
    ),
    (
        lambda: filtered(Filter("f", "body", lag=1.0, value=np.nan)),
        "initial values of the internal states f.value must be finite",
    ),
    (
        lambda: mb.assemble(plain_cart_and_pole(), fix={"pid.integrl": 0.1}),
        "Unknown coordinate 'pid.integrl'; did you mean 'pid.integral'",
    ),
    (
        lambda: mb.assemble(plain_cart_and_pole(), fix={"pid.integral": [0.1, 0.2]}),
        r"Internal state 'pid.integral' has 1 components, got shape \(2,\)",
    ),
    (run_without_states, "The system has 1 internal states, but the state has none"),
    (run_with_states, "The system has no internal states, but the state has some"),
    (
        lambda: cart_with(lambda t, m, s, p: (jnp.zeros(2), {"integral": 0.0})),
        r"must return a force of shape \(\) on 'slide.displacement', got \(2,\)",
    ),
    (
        lambda: cart_with(lambda t, m, s, p: 0.0),
        "the function of Controller 'pid' must return the forces and a dictionary of rates",
    ),
    (lambda: cart_with(lambda t, m, s, p: (0.0, {})), "must return the rates of its states, integral"),
    (
        lambda: cart_and_pole(measures={"angle": "hinge.angel"}),
        "Controller 'pid': Unknown quantity 'hinge.angel'; did you mean 'hinge.angle'",
    ),
    (
        lambda: cart_and_pole(measures={"angle": "hing.angle"}),
        "Controller 'pid': Unknown joint, body or frame 'hing'; did you mean 'hinge'",
    ),
    (lambda: cart_and_pole(acts_on="cart.position"), "it acts on coordinates of joints"),
    (lambda: cart_and_pole(acts_on=TWICE), "Controller 'pid': acts_on names a coordinate twice"),
    (
        lambda: cart_and_pole(states=DOTTED),
        "Controller 'pid': names of states must not be empty or contain a dot, got 'a.b'",
    ),
    (
        lambda: motor_on_four_bar(mode="force"),
        "Motor 'motor': gain and damping belong to the modes 'speed' and 'position'",
    ),
    (
        lambda: motor_on_four_bar(gain=None),
        "Motor 'motor': without a gain the command does nothing in the mode 'speed'; give gain",
    ),
    (
        lambda: motor_on_four_bar(mode="position", gain=None, damping=1.0),
        "Motor 'motor': without a gain the command does nothing in the mode 'position'",
    ),
    (
        lambda: motor_on_four_bar(command=[1.0, 2.0]),
        r"command must have the shape of 'A.angle', \(\), got \(2,\)",
    ),
    (
        lambda: mb.floquet(plain_cart_and_pole(), plain_cart_and_pole().guess, 1.0),
        "floquet does not support internal states; the system has pid.integral",
    ),
]


def test_internal_states_that_cannot_be_are_refused():
    for call, message in REFUSED:
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.slow
def test_internal_states_that_change_are_no_equilibrium():
    with pytest.raises(ValueError, match=r"In the equilibrium internal states change: motor.force"):
        mb.equilibrium(motor_on_four_bar(mode="force", gain=0.0, command=3.0))
