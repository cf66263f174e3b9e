"""What comes and goes while a machine is at rest is not passed over by a long step."""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from scenarios import Derived

import jaxmb as mb
from jaxmb import planar, terrain
from jaxmb.system.inputs import turning_times

SOLVERS = {"Adams": mb.solvers.Adams(), "Dopri8": diffrax.Dopri8(), "Hermite": mb.solvers.Hermite()}
AT, END = 5.3, 10.0
TS = np.linspace(0.0, END, 201)
GRAVITY = mb.Gravity((0.0, -9.81))


def pulse(t, width):
    """A bell of height one, whose width is that of a tenth of the interval at most."""
    return jnp.exp(-(((t - AT) / width) ** 2))


def pendulum(*more):
    bob = planar.Body("bob", mass=1.0, inertia=0.02, position=(0.0, -1.0))
    return mb.Scene([bob], joints=[planar.Revolute("pin", "ground", "bob", point=(0.0, 0.0))], forces=[GRAVITY, *more])


TORQUE = pendulum(planar.Torque("motor", "bob", torque=0.0)).compile()
KICK = pendulum(
    mb.Force(
        "kick",
        "bob",
        lambda x, v, t, p: jnp.zeros((1, 3)).at[0, 2].set(pulse(t, p["width"])),
        parameters={"width": 1.0},
    )
).compile()


def shaken_pendulum():
    cart = planar.Body("cart", mass=1.0, inertia=1.0)
    bob = planar.Body("bob", mass=1.0, inertia=0.02, position=(0.0, -1.0))
    rail = planar.Prismatic("rail", "ground", "cart", point_a=(0.0, 0.0), point_b=(0.0, 0.0), axis=(1.0, 0.0))
    pin = planar.Revolute("pin", "cart", "bob", point=(0.0, 0.0))
    motion = {"motion": lambda t, p: 0.1 * pulse(t, p["width"]), "parameters": {"width": 1.0}}
    shake = planar.Driver("shake", "ground", "cart", quantity="x", **motion)
    return mb.Scene([cart, bob], joints=[rail, pin, shake], forces=[GRAVITY])


SHAKEN = shaken_pendulum().compile()


def of_input(signal, width):
    given = lambda t: pulse(t, width)
    return TORQUE, {"motor.torque": given if signal == "function" else mb.Series(TS, given(TS), signal)}


def of_force(width):
    return mb.with_parameters(KICK, {"kick.width": width}), None


def of_driver(width):
    return mb.with_parameters(SHAKEN, {"shake.width": width}), None


WAYS = {
    "linear series": lambda width: of_input("linear", width),
    "cubic series": lambda width: of_input("cubic", width),
    "function": lambda width: of_input("function", width),
    "force": of_force,
    "driver": of_driver,
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "way, solver", [*((way, "Adams") for way in WAYS), ("linear series", "Dopri8"), ("function", "Hermite")]
)
def test_pulse_moves_a_machine_at_rest(way, solver):
    """As much as with steps that are shorter than the pulse."""
    for width in (0.3, 0.06):
        system, inputs = WAYS[way](width)
        run = lambda system=system, inputs=inputs, **options: mb.simulate(
            system, mb.assemble(system), t1=END, inputs=inputs, max_steps=20000, **options
        )
        bounded = mb.solvers.MultistepController(1e-9, 1e-11, dtmax=0.02)
        exact = run(stepsize_controller=bounded).ys
        found = run(rtol=1e-7, solver=SOLVERS[solver]).ys
        assert jnp.max(jnp.abs(exact.u)) > 1e-3
        np.testing.assert_allclose(found.q, exact.q, atol=1e-6)
        np.testing.assert_allclose(found.u, exact.u, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("signal", ["cubic", "function"])
def test_pulse_has_derivatives_by_its_height(signal):
    """In a batch with a member without any."""

    def rate(x, rtol):
        given = lambda t: x[0] * pulse(t, 0.2)
        inputs = {"motor.torque": given if signal == "function" else mb.Series(TS, given(TS), signal)}
        return mb.simulate(TORQUE, mb.assemble(TORQUE), t1=END, rtol=rtol, inputs=inputs).ys.u[-1, 2:]

    forward = Derived(rate, [1.0], near=1e-6).check()
    rates = jit_quickly(jax.vmap(lambda x: rate(x, 1e-9)))(np.array([[0.0], [1.0]]))
    assert rates[0] == 0 and abs(rates[1]) > 1e-2 and abs(forward) > 1e-2


class Thruster(mb.parts.AbstractForce):
    """A force of the user's own that fires once."""

    name: str = mb.parts.name()
    body: str = mb.parts.body_name()
    of_time = True

    def wrenches(self, space, poses, velocities, t):
        return jnp.zeros((1, 3)).at[0, 0].set(pulse(t, 0.1))

    def given_in_time(self, space, poses, velocities, t):
        return pulse(t, 0.1)


class Silent(Thruster):
    given_in_time = mb.parts.AbstractForce.given_in_time


@pytest.mark.slow
def test_part_of_ones_own_is_given_in_time():
    system = pendulum(Thruster("jet", "bob")).compile()
    assert jnp.max(jnp.abs(mb.simulate(system, mb.assemble(system), t1=END).ys.u)) > 1e-2
    with pytest.raises(NotImplementedError, match="Silent says of_time = True, and needs a method given_in_time"):
        pendulum(Silent("jet", "bob")).compile()


class Burst(mb.parts.AbstractDynamicForce):
    """A pulse of a force whose size is an internal state, and of the rate of another one."""

    name: str = mb.parts.name()
    body: str = mb.parts.body_name()
    size: mb.parts.Number = mb.parts.internal_state(unit="N", default=1.0)
    spent: mb.parts.Number = mb.parts.internal_state(unit="N s", default=0.0)
    of_time = True

    def wrenches(self, space, poses, velocities, t):
        return jnp.zeros((1, 3)).at[0, 0].set(self.size * pulse(jnp.abs(t), 0.02))

    def state_rates(self, space, poses, velocities, t):
        return {"size": jnp.zeros_like(self.size), "spent": self.size * pulse(jnp.abs(t), 0.02)}

    def given_in_time(self, space, poses, velocities, t):
        return jnp.append(
            self.wrenches(space, poses, velocities, t), self.state_rates(space, poses, velocities, t)["spent"]
        )


SLED = planar.Body("sled", mass=2.0, inertia=1.0)
BURST = mb.Scene(
    [SLED],
    joints=[planar.Prismatic("rail", "ground", "sled", point_a=(0.0, 0.0), point_b=(0.0, 0.0), axis=(1.0, 0.0))],
    forces=[Burst("burst", "sled")],
).compile()


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_pulse_of_a_force_with_internal_states(solver):
    """Of the force, whose size is a state, and of the rate of a state, in both directions of time."""
    for end, size in itertools.product((END, -END), (1.0, -40.0)):
        start = mb.assemble(BURST, fix={"burst.size": size})
        motion = mb.simulate(BURST, start, t1=end, rtol=1e-8, solver=SOLVERS[solver], max_steps=4000)
        impulse = size * np.sign(end) * 0.02 * np.sqrt(np.pi)
        np.testing.assert_allclose(motion.ys.u[-1, 0], impulse / 2.0, rtol=1e-6)
        np.testing.assert_allclose(motion["burst"].spent[-1], impulse, rtol=1e-6)


@pytest.mark.slow
def test_pulse_has_derivatives_by_an_internal_state():
    """The velocity is proportional to the state."""

    def rate(x, rtol):
        start = mb.assemble(BURST, fix={"burst.size": x[0]}, throw=False)
        return mb.simulate(BURST, start, t1=END, rtol=1e-8).ys.u[-1, :1]

    exact = lambda x: 0.01 * np.sqrt(np.pi) * x
    Derived(rate, [1.0], exact, many=[[1.0], [-40.0]], values=1e-6, near=1e-6).check()


@pytest.mark.slow
def test_steps_of_the_users_own_controller():
    """Tolerances of the user miss no pulse either; times of the user's own are left to them."""
    system, inputs = WAYS["cubic series"](0.1)
    control = mb.solvers.MultistepController(1e-8, 1e-10)
    run = lambda control: mb.simulate(system, mb.assemble(system), t1=END, inputs=inputs, stepsize_controller=control)
    assert jnp.max(jnp.abs(run(control).ys.u)) > 1e-2
    at_end = diffrax.ClipStepSizeController(control, step_ts=[9.0])
    assert int(run(at_end).stats["num_steps"]) < 20


def hidden(values):
    """How far values move on their way, beyond what their ends show."""
    return np.sum(np.abs(np.diff(values))) - abs(values[-1] - values[0])


def test_no_more_than_a_tenth_is_hidden_between_stops():
    for seed in range(4):
        rng = np.random.default_rng(seed)
        ts, values = np.sort(rng.uniform(-1.0, 11.0, 60)), np.cumsum(rng.normal(size=60)) * 10.0 ** rng.integers(-6, 6)
        ts[0], ts[-1] = -1.0, 11.0
        system = mb.with_inputs(TORQUE, {"motor.torque": mb.Series(ts, values)})
        stops = np.asarray(turning_times(system, system.guess, 0.0, END))
        stops = stops[np.isfinite(stops)]
        assert np.all(np.isin(stops, ts)) and np.all((stops > 0) & (stops < END))
        grid = np.unique(np.concatenate([[0.0, END], ts[(ts > 0) & (ts < END)]]))
        along = np.interp(grid, ts, values)
        most, ends = 0.1 * np.ptp(along), np.concatenate([[0.0], stops, [END]])
        for first, last in itertools.pairwise(ends):
            inside = (grid >= first) & (grid <= last)
            assert hidden(along[inside]) <= most * (1 + 1e-12)
            if last < END:  # No stop is too early: with the next value more is hidden.
                longer = (grid >= first) & (grid <= grid[np.searchsorted(grid, last) + 1])
                assert hidden(along[longer]) > most


def test_what_does_not_come_and_go_needs_no_stops():
    at = TORQUE.guess
    stops = lambda signal: turning_times(mb.with_inputs(TORQUE, {"motor.torque": signal}), at, 0.0, END)
    assert not np.any(np.isfinite(stops(lambda t: 3.0 + 0.0 * t)))
    assert not np.any(np.isfinite(stops(lambda t: jnp.tanh(t - 4.0))))
    assert not np.any(np.isfinite(stops(mb.Series(TS, np.full(201, 0.1) + TS))))
    assert turning_times(pendulum().compile(), at, 0.0, END) is None
    assert (
        turning_times(mb.with_inputs(TORQUE, {"motor.torque": mb.Series(TS, np.sin(TS), "held")}), at, 0.0, END) is None
    )


def bell(t, at, xp=jnp):
    return xp.exp(-(((t - at) / 0.3) ** 2))


CART = planar.Body("cart", mass=1.0, inertia=0.1)
RAIL = planar.Prismatic("rail", "ground", "cart", point=(0.0, 0.0), axis=(1.0, 0.0))
PUSHED = mb.Scene([CART], joints=[RAIL], forces=[mb.JointForce("push", "rail.displacement", force=0.0)]).compile()
BRAKED = mb.Scene(
    [CART],
    joints=[RAIL],
    forces=[
        mb.Force(
            "brake",
            "cart",
            lambda x, v, t, p: (
                jnp.zeros((1, 3)).at[0, 0].set(p["size"] * bell(t, p["at"]) - p["c"] * bell(t, 50.0) * v[0, 0])
            ),
            parameters={"size": 0.0, "at": 20.0, "c": 0.0},
        )
    ],
).compile()
IMPULSE = 0.3 * np.sqrt(np.pi)


@pytest.mark.slow
def test_strengths_of_zero_have_derivatives():
    """Of the speed at the end, by the size of a pulse and by the damping of a later one, which its speed excites."""

    def speed(x, rtol):
        system = mb.with_parameters(BRAKED, {"brake.size": x[0], "brake.c": x[1]})
        return mb.simulate(system, mb.assemble(BRAKED), t1=100.0, rtol=1e-9).ys.u[-1, :1]

    exact = lambda x: (x[0] * IMPULSE * jnp.exp(-x[1] * IMPULSE))[None]
    many = [[0.0, 0.0], [1.0, 0.0], [0.0, 2.0], [-3.0, 0.5]]
    Derived(speed, many[0], exact, many=many, values=1e-7, near=1e-6).check()


@pytest.mark.slow
def test_series_of_zeros_has_derivatives_by_its_values():
    """The start of an optimisation of a control: each value moves the sled by the area of its hat."""
    ts = np.array([0.0, 30.0, 30.4, 31.0, 60.0, 60.5, 61.0, 100.0])

    def speed(values):
        inputs = {"push.force": mb.Series(ts, values)}
        return mb.simulate(PUSHED, mb.assemble(PUSHED), t1=100.0, rtol=1e-9, inputs=inputs).ys.u[-1, 0]

    areas = 0.5 * np.diff(np.pad(ts, 1, "edge"))
    slopes = jit_quickly(jax.grad(speed))(jnp.zeros(ts.size))
    np.testing.assert_allclose(slopes, areas[:-1] + areas[1:], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["Adams", "Dopri8"])
def test_small_pulses_beside_large_ones(solver):
    """One program for both directions of time and for a member of a batch without any."""

    def speed(sizes, slope, end):
        force = lambda t: slope * t + sizes[0] * bell(jnp.abs(t), 20.0) + sizes[1] * bell(jnp.abs(t), 60.0)
        motion = mb.simulate(
            PUSHED, mb.assemble(PUSHED), t1=end, inputs={"push.force": force}, rtol=1e-8, solver=SOLVERS[solver]
        )
        return motion.ys.u[-1, 0]

    sizes = jnp.array([[10.0, 0.2], [0.0, 0.0], [1.0, 1e-3], [0.0, -50.0]])
    slopes = jnp.array([0.0, 0.0, 0.0, 100.0])
    of_each = jit_quickly(jax.vmap(speed, (0, 0, None)))
    for end in (100.0, -100.0):
        expected = np.asarray(slopes) * end**2 / 2 + np.sign(end) * IMPULSE * np.sum(np.asarray(sizes), axis=1)
        np.testing.assert_allclose(of_each(sizes, slopes, end), expected, atol=1e-5, rtol=1e-8)


@pytest.mark.slow
def test_small_stroke_strikes_after_a_large_one_away():
    """The ground moves away by one metre, and later up to a ball at rest, which leaves with twice its speed."""
    gap, height = 0.03, 0.04
    ball = planar.PointMass("ball", mass=1.0, position=(0.0, gap))
    paddle = mb.RigidContact("paddle", "ball", terrain=terrain.Flat(), restitution=1.0)
    system = mb.Scene([ball], joints=[paddle]).compile()
    level = lambda t: -bell(t, 20.0) + height * bell(t, 60.0)
    motion = mb.simulate(system, mb.assemble(system), t1=100.0, inputs={"paddle.terrain.level": level})
    time = 60.0 - 0.3 * np.sqrt(np.log(height / gap))
    np.testing.assert_allclose(motion["ball"].velocity[-1, 1], 2 * gap * 2 * (60.0 - time) / 0.09, rtol=1e-6)
    assert len(motion.events) == 1
    np.testing.assert_allclose(motion.events.times[0], time, rtol=1e-8)


@pytest.mark.slow
def test_one_pulse_among_many_parts():
    """One of forty free bodies is pushed for a moment, the others by forces that grow."""
    law = lambda x, v, t, p: jnp.array([p["slope"] * t + p["size"] * bell(t, 50.0), 0.0, 0.0])
    names = [f"b{k}" for k in range(40)]
    numbers = lambda k: {"slope": 0.01 * float(k > 0), "size": float(k == 0)}
    system = mb.Scene(
        [planar.Body(name, mass=1.0, inertia=1.0) for name in names],
        forces=[mb.Force(f"f{k}", name, law, parameters=numbers(k)) for k, name in enumerate(names)],
    ).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=100.0, rtol=1e-9)
    np.testing.assert_allclose(motion["b0"].velocity[-1, 0], IMPULSE, rtol=1e-6)
    np.testing.assert_allclose(motion["b7"].velocity[-1, 0], 50.0, rtol=1e-6)
