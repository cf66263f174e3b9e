"""From a state to a motion: every way to ask for it and to look at it."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.formulations import Multipliers, Partitioned

G = 9.81


@pytest.fixture(scope="module")
def rod():
    """A rod of 2 m on a pin at the origin, held level."""
    body = planar.Body("rod", mass=3.0, inertia=planar.rod(3.0, 2.0), position=(1.0, 0.0))
    pin = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    return mb.Scene([body], joints=[pin], forces=[mb.Gravity((0.0, -G))]).compile()


@pytest.fixture(scope="module")
def dense(rod):
    return mb.simulate(
        rod, mb.assemble(rod), t1=2.0, rtol=1e-10, saveat=diffrax.SaveAt(dense=True, steps=True, t0=True)
    )


@pytest.mark.slow
def test_dense_output_is_on_the_constraints_and_accurate(rod, dense):
    ts = jnp.linspace(0.0, 2.0, 17)
    states = dense.at(ts)
    saved = mb.simulate(rod, mb.assemble(rod), t1=2.0, rtol=1e-12, saveat=ts)
    np.testing.assert_allclose(states.q, saved.ys.q, rtol=0, atol=1e-7)
    np.testing.assert_allclose(dense.at(0.7).q, dense.at(jnp.array([0.7])).q[0], rtol=0, atol=1e-14)
    violation = jax.vmap(lambda q: rod.position_residual(0.0, q))(states.q)
    assert float(jnp.max(jnp.abs(violation))) < 1e-13


def test_steps_are_trimmed(dense):
    steps = int(dense.stats["num_accepted_steps"])
    ts = np.asarray(dense.ts)
    assert ts.shape == (steps + 1,) and ts[0] == 0.0 and ts[-1] == 2.0
    assert np.all(np.diff(ts) > 0)
    assert int(np.sum(np.asarray(dense.stats["orders"]))) == steps
    first, names = repr(dense).splitlines()
    assert first == f"Trajectory: {steps + 1} saved from t = 0 to 2 in {dense.stats['num_steps']} steps; successful"
    assert names == "Names: rod, pin" and repr(dense.reactions) == "<of each joint: pin>"


def test_energy_momenta_and_save(dense, tmp_path):
    energy, motion = np.asarray(dense.energy), dense["rod"]
    np.testing.assert_allclose(energy, energy[0], rtol=0, atol=1e-7)
    (x, y), velocity = np.asarray(motion.position).T, np.asarray(motion.velocity)
    spin = 3.0 * (x * velocity[:, 1] - y * velocity[:, 0]) + 1.0 * np.asarray(motion.angular_velocity)
    np.testing.assert_allclose(dense.angular_momentum, spin, rtol=0, atol=1e-12)
    np.testing.assert_allclose(dense.linear_momentum, 3.0 * velocity, rtol=0, atol=1e-14)
    dense.save(tmp_path / "motion.npz")
    back = mb.load(tmp_path / "motion.npz")
    np.testing.assert_array_equal(back["rod.angle"], motion.angle)
    assert int(back["stats.num_steps"]) == int(dense.stats["num_steps"])


def test_reactions_balance_the_motion(dense):
    reaction, acceleration = dense.reactions["pin"], np.asarray(dense.accelerations)[:, :2]
    np.testing.assert_allclose(reaction.force, 3.0 * (acceleration - [0.0, -G]), rtol=0, atol=1e-9)
    np.testing.assert_allclose(reaction.moment, 0.0, atol=1e-12)
    # Released level: a quarter of the weight (R. C. Hibbeler, the falling rod).
    np.testing.assert_allclose(reaction.force[0], [0.0, 3.0 * G / 4], rtol=0, atol=1e-12)
    assert list(dense.reactions) == ["pin"]


@pytest.mark.slow
def test_backward_in_time_returns(rod):
    there = mb.simulate(rod, mb.assemble(rod), t1=1.5, rtol=1e-11)
    end = jax.tree.map(lambda y: y[-1], there.ys)
    back = mb.simulate(rod, end, t0=1.5, t1=0.0, rtol=1e-11, saveat=jnp.array([1.0, 0.5, 0.0]))
    np.testing.assert_allclose(back.ys.q[-1], mb.assemble(rod).q, rtol=0, atol=1e-8)
    np.testing.assert_allclose(back.ts, [1.0, 0.5, 0.0])


@pytest.mark.slow
def test_event_stops_the_motion(rod):
    hanging = lambda t, y, args, **kwargs: y.q[2] + np.pi / 2
    event = diffrax.Event(hanging, optx.Newton(rtol=1e-10, atol=1e-10))
    sol = mb.simulate(rod, mb.assemble(rod), t1=5.0, rtol=1e-10, event=event)
    assert sol.result == mb.RESULTS.event_occurred
    np.testing.assert_allclose(sol["rod"].angle[-1], -np.pi / 2, rtol=0, atol=1e-8)
    # ω² = 3 g / l at the bottom of a rod released level.
    np.testing.assert_allclose(sol["rod"].angular_velocity[-1], -np.sqrt(3 * G / 2.0), rtol=1e-8)


@pytest.mark.slow
def test_any_solver_gives_the_same_motion(rod):
    state = mb.assemble(rod)
    adams = mb.simulate(rod, state, t1=1.0, rtol=1e-10)
    for options in (
        {"solver": diffrax.Dopri8()},
        {"solver": diffrax.Tsit5(), "formulation": Partitioned()},
        {"formulation": Multipliers(), "manifold": mb.manifold.Projection()},
    ):
        other = mb.simulate(rod, state, t1=1.0, rtol=1e-10, **options)
        np.testing.assert_allclose(other.ys.q, adams.ys.q, rtol=0, atol=1e-8)
        assert float(other.constraint_violation.position[-1]) < 1e-13
    assert 0.5 < other.stats["newton_iterations"] / other.stats["num_steps"] < 5


@pytest.mark.slow
def test_what_was_given_may_change_later(rod):
    """Arrays that start where JAX could share their memory instead of copying them."""

    def shareable(values):
        raw = np.zeros(8 * len(values) + 64, np.uint8)
        start = -raw.ctypes.data % 64
        out = raw[start : start + 8 * len(values)].view(float)
        out[:] = values
        return out

    gravity, place, times, q = map(shareable, ([0.0, -5.0], [1.0, 0.0], [0.1, 0.2], [0.3]))
    heavy = mb.with_parameters(rod, {"gravity.acceleration": gravity})
    body = planar.Body("body", mass=1.0, inertia=1.0, position=place)
    points = mb.lagrangian.LagrangianSystem(kinetic=lambda t, q, v, p: v @ v, q=q, parameters={"k": place})
    trajectory = mb.simulate(rod, mb.assemble(rod), t1=0.2, saveat=times, throw=False)
    for given in (gravity, place, times, q):
        given[:] = np.nan
    np.testing.assert_array_equal(mb.parameters(heavy)["gravity.acceleration"], [0.0, -5.0])
    np.testing.assert_array_equal(body.position, [1.0, 0.0])
    np.testing.assert_array_equal(points.guess.q, [0.3])
    np.testing.assert_array_equal(points.parameters["k"], [1.0, 0.0])
    np.testing.assert_array_equal(trajectory.ts, [0.1, 0.2])
    with pytest.raises(ValueError, match="read-only"):
        body.position[0] = 2.0


@pytest.mark.slow
def test_states_of_all_steps_have_derivatives(rod):
    """Their number is known after the run, also where it is differentiated outside `jit`."""

    def last(inertia, saveat):
        changed = mb.with_parameters(rod, {"rod.inertia": inertia})
        return mb.simulate(changed, rod.guess, t1=0.5, saveat=saveat)["rod"].angle[-1]

    slope = jax.grad(last)(1.0, diffrax.SaveAt(steps=True))
    np.testing.assert_allclose(slope, jax.grad(last)(1.0, None), rtol=1e-10)


@pytest.mark.slow
def test_saved_times_that_are_traced_are_inside_the_interval(rod):
    state = mb.assemble(rod)

    @jax.jit
    def run(end, times):
        motion = mb.simulate(rod, state, t1=end, saveat=times)
        return motion["rod"].angle, motion.result._value

    for end in (0.3, -0.3):
        # Also as the end is computed in another way.
        for times in (end * np.array([0.5, 1.0]), np.array([0.5 * end, np.sign(end) * 0.1 * 3])):
            angles, ended = run(end, times)
            assert ended == mb.RESULTS.successful._value and np.all(np.isfinite(angles))
        for times in ([0.5, 1.1], [-0.1, 0.5], [0.5, np.nan], [0.9, 0.5]):
            angles, ended = run(end, end * np.array(times))
            assert ended == mb.RESULTS.saved_outside._value and np.all(np.isnan(angles))


@pytest.mark.slow
def test_constraint_nonlinear_in_velocity():
    """A particle held at constant speed under gravity, closed form: tan(φ/2) grows exponentially (Appell's type)."""
    speed = 2.0
    hold = lambda poses, velocities, t, p: jnp.sum(velocities[0, :2] ** 2) - p["speed"] ** 2
    particle = planar.PointMass("p", mass=1.0, velocity=(speed, 0.0))
    constant = mb.VelocityConstraint("speed", "p", hold, parameters={"speed": speed})
    system = mb.Scene([particle], joints=[constant], forces=[mb.Gravity((0.0, -G))]).compile()
    assert not system.linear
    sol = mb.simulate(system, mb.assemble(system), t1=0.3, rtol=1e-10, saveat=jnp.linspace(0.0, 0.3, 4))
    velocity = sol["p"].velocity
    np.testing.assert_allclose(jnp.sum(velocity**2, axis=1), speed**2, rtol=1e-12)
    # The constraint force is along the velocity, so the direction turns with φ' = −g cos(φ) / v.
    angle = jnp.arctan2(velocity[:, 1], velocity[:, 0])
    np.testing.assert_allclose(angle, -2 * jnp.arctan(jnp.tanh(G * sol.ts / (2 * speed))), rtol=0, atol=1e-8)


@pytest.mark.slow
def test_driven_in_everything():
    """No degree of freedom: the motion is the driver's, and the torque it needs is its reaction."""
    body = planar.Body("rod", mass=3.0, inertia=1.0, position=(1.0, 0.0))
    turn = lambda t, p: p["a"] * jnp.sin(p["w"] * t)
    joints = [
        planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0)),
        planar.Driver("drive", "ground", "rod", quantity="angle", motion=turn, parameters={"a": 0.5, "w": 3.0}),
    ]
    system = mb.Scene([body], joints=joints).compile()
    sol = mb.simulate(system, mb.assemble(system), t1=2.0, saveat=jnp.linspace(0.0, 2.0, 9))
    np.testing.assert_allclose(sol["rod"].angle, 0.5 * jnp.sin(3.0 * sol.ts), rtol=0, atol=1e-10)
    about_pin = (1.0 + 3.0 * 1.0**2) * -4.5 * jnp.sin(3.0 * sol.ts)
    np.testing.assert_allclose(sol.reactions["drive"].moment, about_pin, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_spring_of_zero_length_is_linear():
    """A motion that starts where a spring of no free length has zero length: derivatives are right there."""
    body = planar.PointMass("p", mass=2.0)
    system = mb.Scene(
        [body], forces=[planar.SpringDamper("s", "ground", "p", stiffness=8.0, free_length=0.0)]
    ).compile()

    def end(x0, k):
        changed = mb.with_parameters(system, {"s.stiffness": k})
        state = mb.State(jnp.stack([x0, 0.0 * x0]), jnp.array([1.0, 0.0]))
        return mb.simulate(changed, state, t1=1.0, rtol=1e-11).ys.q[-1, 0]

    slope, stiffness = jax.grad(end, argnums=(0, 1))(jnp.array(0.0), jnp.array(8.0))
    np.testing.assert_allclose(slope, np.cos(2.0), rtol=0, atol=1e-8)
    # x = sin(ω t) / ω with ω² = k / m.
    np.testing.assert_allclose(stiffness, (2.0 * np.cos(2.0) - np.sin(2.0)) / 4.0 / (2 * 2.0 * 2.0), rtol=0, atol=1e-8)


@pytest.mark.slow
def test_baumgarte_brings_a_state_back_as_its_rate_says():
    """A pendulum 1 cm off its pin: Φ̈ + 2 rate Φ̇ + rate² Φ = 0, so Φ0 (1 + rate t) e^(−rate t)."""
    pendulum = mb.mechanisms.get("pendulum").system
    q = np.array(pendulum.guess.q)
    q[0] += 0.01
    off = np.asarray(pendulum.position_residual(0.0, jnp.asarray(q)))
    start = mb.State(jnp.asarray(q), jnp.zeros(pendulum.nu))
    times = jnp.linspace(0.0, 1.0, 5)
    manifold = mb.manifold.Baumgarte(5.0)
    motion = mb.simulate(pendulum, start, t1=1.0, rtol=1e-10, manifold=manifold, saveat=times)
    residual = jax.vmap(pendulum.position_residual)(times, motion.ys.q)
    decay = (1 + 5.0 * times) * jnp.exp(-5.0 * times)
    np.testing.assert_allclose(residual, decay[:, None] * off[None, :], rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match="rate must be positive"):
        mb.manifold.Baumgarte(0.0)


@pytest.mark.slow
def test_derivatives_of_violations_with_baumgarte():
    """A pin that is moved away from a pendulum by p: Φ = −p (1 + r t) e^(−r t), and its rate p r² t e^(−r t)."""
    rate, t1 = 5.0, 0.5
    rod = planar.Body("rod", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "rod", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    scene = mb.Scene([rod], joints=[pin], forces=[mb.Gravity((0.0, -9.81))]).compile()
    state = mb.assemble(scene)

    def violations(p):
        system = mb.with_parameters(scene, {"pin.point_a": p})
        options = {"solver": diffrax.Dopri8(), "manifold": mb.manifold.Baumgarte(rate)}
        y = mb.simulate(system, state, t1=t1, rtol=1e-11, throw=False, **options).ys
        q, u = y.q[-1], y.u[-1]
        return jnp.concatenate([system.position_residual(t1, q), system.velocity_residual(t1, q, u)])

    off = jnp.array([0.01, 0.02])
    reverse = jax.jit(jax.vmap(jax.jacrev(violations)))(off[None])[0]
    forward = jax.jit(jax.jacfwd(violations))(off)
    value = violations(off)
    decay = np.exp(-rate * t1)
    sign = np.sign(value[0] / off[0])
    expected = sign * np.concatenate([(1 + rate * t1) * decay * np.eye(2), -(rate**2) * t1 * decay * np.eye(2)])
    np.testing.assert_allclose(value, expected @ off, rtol=0, atol=1e-10)
    np.testing.assert_allclose(forward, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_system_without_bodies_has_the_same_views(tmp_path):
    """A train in relative coordinates is neither a scene nor a Lagrangian system."""
    train = mb.mechanisms.longitudinal_train(n=3)
    system = train.system
    motion = mb.simulate(system, train.state, t1=0.2, rtol=1e-6, saveat=[0.0, 0.1, 0.2])
    for name, own in system.quantities().items():
        assert motion.quantity(name).shape == (3, *own.shape)
    np.testing.assert_array_equal(motion["y1"], motion.ys.q[:, 1])
    np.testing.assert_array_equal(motion.quantity("x1_rate"), motion.ys.u[:, 0])
    assert system.catalogue.position_quantities() == ("x1", "y1", "y2")
    assert {"car1.mass", "car3.mass"} <= system.parameter_table.positive() <= set(mb.parameters(system))
    motion.save(tmp_path / "motion.npz")
    assert {"x1", "y2", "energy"} <= set(mb.load(tmp_path / "motion.npz"))
    assert "3 vehicles" in str(system) and "no constraints" in system._repr_html_()
    with pytest.raises(ValueError, match="Unknown coordinate 'y3'"):
        motion["y3"]
    with pytest.raises(ValueError, match="has none; plot_motion"):
        mb.viz.plot_mechanism(motion)
    coordinates = mb.viz.plot_motion(motion).axes[0]
    assert [line.get_label() for line in coordinates.lines] == ["x1", "y1", "y2"]


@pytest.mark.slow
def test_moment_of_a_blade_is_about_its_point():
    """A blade exerts a force at its contact point and no moment there."""
    sleigh = mb.mechanisms.chaplygin_sleigh()
    sol = mb.simulate(sleigh.system, sleigh.state, t1=0.5, rtol=1e-9)
    (name,) = sol.reactions
    reaction = sol.reactions[name]
    assert float(jnp.max(jnp.abs(reaction.force))) > 0.1
    np.testing.assert_allclose(reaction.moment, 0.0, atol=1e-12)


@pytest.mark.slow
def test_no_time_at_all(rod):
    """Saved once and several times, of whole numbers."""
    for count in (1, 3):
        saveat = diffrax.SaveAt(ts=np.ones(count, int))
        motion = mb.simulate(rod, mb.assemble(rod), t0=1.0, t1=1.0, saveat=saveat)
        np.testing.assert_array_equal(motion.ts, np.ones(count))


# What a function of `SaveAt` sees


def top():
    body = spatial.Body("top", mass=1.0, inertia=np.diag([1.0, 2.0, 3.0]), angular_velocity=(1.0, 2.0, 3.0))
    return mb.Scene([body]).compile()


TS = np.linspace(0.0, 1.0, 7)
OTHER = {"solver": diffrax.Tsit5()}
TURNED = diffrax.Event(lambda t, y, args, **kwargs: y.q[2] + 0.5, optx.Newton(1e-9, 1e-9))
SAVED = {
    "times": ({"ts": TS, "dense": True}, {}),
    "subs": ({"subs": diffrax.SubSaveAt(ts=TS, t1=True)}, {}),
    "steps to an event": ({"steps": True, "t1": True}, {"event": TURNED}),
    "Projection": ({"ts": TS}, {"manifold": mb.manifold.Projection()}),
    "steps of Tsit5": ({"steps": True}, OTHER),
}


def with_function(options, function):
    if "subs" not in options:
        return diffrax.SaveAt(fn=function, **options)
    return diffrax.SaveAt(subs=diffrax.SubSaveAt(ts=TS, t1=True, fn=function))


@pytest.mark.slow
@pytest.mark.parametrize("case", SAVED)
def test_function_sees_the_states_that_are_saved(rod, case):
    """They are on the constraints, to the last bit as those without a function."""
    options, others = SAVED[case]
    run = lambda saveat: mb.simulate(rod, mb.assemble(rod), t1=1.0, rtol=1e-4, saveat=saveat, **others)
    plain = run(diffrax.SaveAt(**options))
    # Whole numbers as well; those of steps that are not taken diffrax makes of infinity, with a warning.
    whole = (lambda x: x) if "steps" in case else lambda x: x.astype(int)
    seen = run(with_function(options, lambda t, y, args: (t, y, whole(jnp.round(y.q[2])))))
    times, states, turns = seen.ys
    np.testing.assert_array_equal(times, plain.ts)
    np.testing.assert_array_equal(states.q, plain.ys.q)
    np.testing.assert_array_equal(states.u, plain.ys.u)
    np.testing.assert_array_equal(turns, np.round(plain.ys.q[:, 2]))
    violation = jax.vmap(lambda q: rod.position_residual(0.0, q))(states.q)
    # Ends of steps are as near to them as Newton's method leaves them.
    assert float(jnp.max(jnp.abs(violation))) < (1e-7 if "steps" in case else 1e-12)


@pytest.mark.slow
def test_function_sees_euler_parameters_of_unit_length():
    body = spatial.Body("top", mass=1.0, inertia=np.diag([1.0, 2.0, 3.0]), angular_velocity=(1.0, 2.0, 3.0))
    system, size = mb.Scene([body]).compile(), diffrax.SaveAt(ts=TS, fn=lambda t, y, args: jnp.linalg.norm(y.q[3:7]))
    for solver in (mb.solvers.Adams(), diffrax.Tsit5()):
        found = mb.simulate(system, mb.assemble(system), t1=1.0, rtol=1e-4, saveat=size, solver=solver)
        np.testing.assert_allclose(found.ys, 1.0, rtol=0, atol=1e-14)


REFUSED = {
    **{
        name: ({"saveat": diffrax.SaveAt(t1=True, **{name: True})}, rf"SaveAt\({name}=True\)")
        for name in ("solver_state", "controller_state", "made_jump")
    },
    "several series": (
        {"saveat": diffrax.SaveAt(subs=(diffrax.SubSaveAt(t1=True), diffrax.SubSaveAt(t0=True)))},
        "saves one series",
    ),
    "a matrix of times": ({"saveat": np.zeros((2, 2))}, "saveat must be a vector"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_saved_is_refused(rod, name):
    options, message = REFUSED[name]
    for error in (False, True):
        with pytest.raises(ValueError, match=message):
            mb.simulate(rod, rod.guess, t1=1.0, error=error, **options)


@pytest.mark.slow
@pytest.mark.parametrize("redundant", [False, True])
def test_too_few_steps_with_a_choice_for_runge_kutta_methods(rod, redundant):
    """The method that then looks for stiffness has a manifold and a formulation that suit it."""
    system = rod
    if redundant:
        body = planar.Body("rod", mass=3.0, inertia=planar.rod(3.0, 2.0), position=(1.0, 0.0))
        pins = [planar.Revolute(name, "ground", "rod", point=(0.0, 0.0)) for name in ("pin", "other")]
        system = mb.Scene([body], joints=pins, forces=[mb.Gravity((0.0, -G))]).compile()
    own = {"manifold": mb.manifold.Projection()} | ({} if redundant else {"formulation": mb.formulations.NullSpace()})
    with pytest.raises(RuntimeError, match=r"in max_steps = 250 steps.*A larger max_steps"):
        mb.simulate(system, mb.assemble(system), t1=50.0, solver=diffrax.Tsit5(), max_steps=250, rtol=1e-6, **own)
