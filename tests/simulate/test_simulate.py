"""From a state to a motion: every way to ask for it and to look at it."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from compiling import jit_quickly
from derivative_checks import central_differences, in_both_modes

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


@pytest.mark.slow
def test_steps_are_trimmed(dense):
    steps = int(dense.stats["num_accepted_steps"])
    assert dense.ts.shape == (steps + 1,) and float(dense.ts[0]) == 0.0 and float(dense.ts[-1]) == 2.0
    assert np.all(np.diff(dense.ts) > 0)
    assert int(np.sum(dense.stats["orders"])) == steps
    first, names = repr(dense).splitlines()
    assert first == f"Trajectory: {steps + 1} saved from t = 0 to 2 in {dense.stats['num_steps']} steps; successful"
    assert names == "Names: rod, pin" and repr(dense.reactions) == "<of each joint: pin>"


@pytest.mark.slow
def test_saved_times_may_be_integers(rod):
    saveat = diffrax.SaveAt(ts=jnp.array([0, 1, 2]))
    found = mb.simulate(rod, rod.guess, t1=2.0, saveat=saveat)
    other = mb.simulate(rod, rod.guess, t1=2.0, saveat=[0.0, 1.0, 2.0])
    np.testing.assert_array_equal(found.ys.q, other.ys.q)


def test_energy_momenta_and_save(dense, tmp_path):
    np.testing.assert_allclose(dense.energy, dense.energy[0], rtol=0, atol=1e-7)
    motion = dense["rod"]
    spin = 3.0 * (motion.position[:, 0] * motion.velocity[:, 1] - motion.position[:, 1] * motion.velocity[:, 0])
    np.testing.assert_allclose(dense.angular_momentum, spin + 1.0 * motion.angular_velocity, rtol=0, atol=1e-12)
    np.testing.assert_allclose(dense.linear_momentum, 3.0 * motion.velocity, rtol=0, atol=1e-14)
    dense.save(tmp_path / "motion.npz")
    back = mb.load(tmp_path / "motion.npz")
    np.testing.assert_array_equal(back["rod.angle"], motion.angle)
    assert int(back["stats.num_steps"]) == int(dense.stats["num_steps"])


@pytest.mark.slow
def test_reactions_balance_the_motion(dense):
    reaction = dense.reactions["pin"]
    acceleration = dense.accelerations[:, :2]
    np.testing.assert_allclose(
        reaction.force, 3.0 * (np.asarray(acceleration) - np.array([0.0, -G])), rtol=0, atol=1e-9
    )
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
        {"formulation": Multipliers()},
    ):
        other = mb.simulate(rod, state, t1=1.0, rtol=1e-10, **options)
        np.testing.assert_allclose(other.ys.q, adams.ys.q, rtol=0, atol=1e-8)
        assert float(other.constraint_violation.position[-1]) < 1e-13


@pytest.mark.slow
def test_other_numbers_do_not_compile_anew(rod):
    traces = []

    @jax.jit
    def run(mass, t1, rtol):
        traces.append(1)
        system = mb.with_parameters(rod, {"rod.mass": mass})
        return mb.simulate(system, mb.assemble(system, throw=False), t1=t1, rtol=rtol, throw=False)["rod"].angle[-1]

    values = [run(m, t, r) for m, t, r in [(1.0, 0.2, 1e-6), (2.0, 0.3, 1e-8), (3.0, 0.1, 1e-10)]]
    assert len(traces) == 1 and np.all(np.isfinite(values))


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
def test_a_gradient_through_a_failed_run_is_not_a_number(rod):
    """Taken alone, without the value that the error goes with."""

    def end(mass, max_steps):
        changed = mb.with_parameters(rod, {"rod.inertia": mass})
        return mb.simulate(changed, mb.assemble(rod), t1=1.0, max_steps=max_steps).ys.q[-1, 2]

    gradient = jax.jit(jax.vmap(jax.grad(end), in_axes=(0, None)), static_argnums=1)
    assert np.all(np.isfinite(gradient(jnp.array([1.0, 2.0]), 200)))
    assert np.all(np.isnan(gradient(jnp.array([1.0, 2.0]), 5)))


@pytest.mark.slow
def test_a_derivative_of_the_states_of_all_steps(rod):
    """Their number is known after the run, also where it is differentiated outside `jit`."""
    state = mb.assemble(rod)

    def last(inertia, saveat):
        changed = mb.with_parameters(rod, {"rod.inertia": inertia})
        return mb.simulate(changed, state, t1=0.5, saveat=saveat)["rod"].angle[-1]

    slope = jax.grad(last)(1.0, diffrax.SaveAt(steps=True))
    np.testing.assert_allclose(slope, jax.grad(last)(1.0, None), rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("end", [0.3, -0.3])
def test_times_that_are_traced_are_inside_the_interval(rod, end):
    state = mb.assemble(rod)

    @jax.jit
    def run(times):
        motion = mb.simulate(rod, state, t1=end, saveat=times)
        return motion["rod"].angle, motion.result._value

    _, ended = run(end * jnp.array([0.5, 1.0]))
    assert ended == mb.RESULTS.successful._value
    # As the end is computed in another way.
    angles, ended = run(jnp.array([0.5 * end, np.sign(end) * 0.1 * 3]))
    assert ended == mb.RESULTS.successful._value and np.all(np.isfinite(angles))
    for times in ([0.5, 1.1], [-0.1, 0.5], [0.5, np.nan], [0.9, 0.5]):
        angles, ended = run(end * jnp.array(times))
        assert ended == mb.RESULTS.saved_outside._value and np.all(np.isnan(angles))


@pytest.mark.slow
def test_trajectory_outside_its_use_is_an_error(rod):
    with pytest.raises(ValueError, match="saveat must be a vector"):
        mb.simulate(rod, mb.assemble(rod), t1=1.0, saveat=jnp.zeros((2, 2)))
    with pytest.raises(RuntimeError, match="max_steps"):
        mb.simulate(rod, mb.assemble(rod), t1=1.0, max_steps=5)


@pytest.mark.slow
def test_own_constraints_and_forces():
    """User functions against the library's parts: a rod as a distance, a blade, a spring."""
    masses = [
        planar.PointMass("a", mass=1.0, position=(1.0, 0.0)),
        planar.PointMass("b", mass=2.0, position=(2.0, 0.5)),
    ]
    gravity = mb.Gravity((0.0, -G))
    length = float(np.hypot(1.0, 0.5))
    rods = [planar.Distance("r1", "ground", "a"), planar.Distance("r2", "a", "b")]
    spring = planar.SpringDamper("s", "ground", "b", stiffness=5.0, damping=0.3, free_length=1.0)
    library = mb.Scene(masses, joints=rods, forces=[gravity, spring]).compile()

    gap = lambda poses, t, p: jnp.sum((poses[1, :2] - poses[0, :2]) ** 2) - p["length"] ** 2

    def law(poses, velocities, t, p):
        l = jnp.sqrt(jnp.sum(poses[0, :2] ** 2))
        rate = jnp.dot(poses[0, :2], velocities[0, :2]) / l
        pull = -(p["k"] * (l - 1.0) + p["c"] * rate) * poses[0, :2] / l
        return jnp.concatenate([pull, jnp.zeros(1)])[None]

    own = mb.Scene(
        masses,
        joints=[
            mb.Constraint("r1", ["ground", "a"], gap, parameters={"length": 1.0}, rheonomic=False),
            mb.Constraint("r2", ["a", "b"], gap, parameters={"length": length}),
        ],
        forces=[gravity, mb.Force("s", "b", law, parameters={"k": 5.0, "c": 0.3})],
    ).compile()
    assert {"r1.length", "s.k"} <= set(mb.parameters(own))
    ends = [mb.simulate(s, mb.assemble(s), t1=1.0, rtol=1e-10)["b"].position for s in (library, own)]
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-8)


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
def test_derivatives_with_baumgarte():
    """Forward, reverse and central differences of a tighter solution, compiled and in a batch."""
    pendulum = mb.mechanisms.get("pendulum")
    start = jnp.array([9.81, 0.3])

    def end(x, rtol):
        gravity = {"gravity.acceleration": jnp.stack([jnp.zeros(()), -x[0]])}
        system = mb.with_parameters(pendulum.system, gravity)
        state = mb.State(pendulum.state.q, pendulum.state.u.at[1].add(x[1]))
        options = {"manifold": mb.manifold.Baumgarte(5.0), "max_steps": 512}
        return jnp.sum(mb.simulate(system, state, t1=0.5, rtol=rtol, **options).ys.q[-1, :2])

    batch = lambda f: jax.jit(jax.vmap(f, in_axes=(0, None)))
    twice = lambda x, rtol: (end(x, rtol),) * 2
    forward_and_value = batch(jax.jacfwd(twice, has_aux=True))
    forward = forward_and_value(start[None], 1e-9)[0][0]
    reverse = batch(jax.grad(end))(start[None], 1e-9)[0]
    assert np.all(np.abs(forward) > 1e-3)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    h = 1e-4
    value = lambda x: forward_and_value(x[None], 1e-12)[1][0]
    central = [(value(start + h * e) - value(start - h * e)) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(forward, central, rtol=1e-5)


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
def test_a_system_without_bodies_has_the_same_views(tmp_path):
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
@pytest.mark.parametrize("count", [1, 3])
def test_no_time_at_all(rod, count):
    motion = mb.simulate(rod, mb.assemble(rod), t0=1.0, t1=1.0, saveat=np.ones(count))
    np.testing.assert_array_equal(motion.ts, np.ones(count))


# What a function of `SaveAt` sees


def top():
    body = spatial.Body("top", mass=1.0, inertia=np.diag([1.0, 2.0, 3.0]), angular_velocity=(1.0, 2.0, 3.0))
    return mb.Scene([body]).compile()


TS = np.linspace(0.0, 1.0, 7)
OTHER = {"solver": diffrax.Tsit5()}
TURNED = diffrax.Event(lambda t, y, args, **kwargs: y.q[2] + 0.5, optx.Newton(1e-9, 1e-9))
SAVED = {
    "times": ({"ts": TS}, {}),
    "subs": ({"subs": diffrax.SubSaveAt(ts=TS, t1=True)}, {}),
    "dense": ({"ts": TS, "dense": True}, {}),
    "steps": ({"steps": True}, {}),
    "steps to an event": ({"steps": True, "t1": True}, {"event": TURNED}),
    "Projection": ({"ts": TS}, {"manifold": mb.manifold.Projection()}),
    "Tsit5": ({"ts": TS}, OTHER),
    "steps of Tsit5": ({"steps": True}, OTHER),
}


def with_function(options, function):
    if "subs" not in options:
        return diffrax.SaveAt(fn=function, **options)
    return diffrax.SaveAt(subs=diffrax.SubSaveAt(ts=TS, t1=True, fn=function))


@pytest.mark.slow
@pytest.mark.parametrize("case", ["times", *(pytest.param(name, marks=pytest.mark.slow) for name in list(SAVED)[1:])])
def test_a_function_sees_the_states_that_are_saved(rod, case):
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
@pytest.mark.parametrize("solver", [mb.solvers.Adams(), pytest.param(diffrax.Tsit5(), marks=pytest.mark.slow)])
def test_a_function_sees_euler_parameters_of_unit_length(solver):
    system = top()
    size = diffrax.SaveAt(ts=TS, fn=lambda t, y, args: jnp.linalg.norm(y.q[3:7]))
    found = mb.simulate(system, mb.assemble(system), t1=1.0, rtol=1e-4, saveat=size, solver=solver)
    np.testing.assert_allclose(found.ys, 1.0, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_derivatives_of_what_a_function_returns(rod):
    """In both modes those of central differences, with times that move as well, under `jit` and in batches."""

    def seen(x, rtol=1e-8):
        gravity, end = x
        system = mb.with_parameters(rod, {"gravity.acceleration": jnp.stack([0.0 * gravity, -gravity])})
        length = lambda t, y, args: y.q[0] * jnp.sin(y.q[2]) + t * y.u[1]
        saveat = diffrax.SaveAt(ts=end * jnp.array([0.3, 0.7, 1.0]), fn=length)
        return mb.simulate(system, mb.assemble(rod), t1=end, rtol=rtol, saveat=saveat).ys

    def after(x):
        gravity, end = x
        system = mb.with_parameters(rod, {"gravity.acceleration": jnp.stack([0.0 * gravity, -gravity])})
        ts = end * jnp.array([0.3, 0.7, 1.0])
        motion = mb.simulate(system, mb.assemble(rod), t1=end, rtol=1e-8, saveat=ts)
        return motion.ys.q[:, 0] * jnp.sin(motion.ys.q[:, 2]) + motion.ts * motion.ys.u[:, 1]

    at = jnp.array([9.0, 1.2])
    _, derivative = in_both_modes(seen, at)
    np.testing.assert_allclose(derivative, central_differences(jit_quickly(lambda x: seen(x, 1e-12)), at), rtol=1e-5)
    np.testing.assert_allclose(derivative, jit_quickly(jax.jacfwd(after))(at), rtol=1e-9)
    batch = jit_quickly(jax.vmap(jax.jacfwd(seen)))(jnp.stack([at, 1.1 * at]))
    np.testing.assert_allclose(batch[0], derivative, rtol=1e-9)


@pytest.mark.parametrize("name", ["solver_state", "controller_state", "made_jump"])
def test_states_of_the_solver_are_not_saved(rod, name):
    with pytest.raises(ValueError, match=rf"SaveAt\({name}=True\)"):
        mb.simulate(rod, mb.assemble(rod), t1=1.0, saveat=diffrax.SaveAt(t1=True, **{name: True}))


@pytest.mark.parametrize("error", [False, True])
def test_several_series_are_refused(rod, error):
    several = diffrax.SaveAt(subs=(diffrax.SubSaveAt(t1=True), diffrax.SubSaveAt(t0=True)))
    with pytest.raises(ValueError, match="saves one series"):
        mb.simulate(rod, mb.assemble(rod), t1=1.0, saveat=several, error=error)


@pytest.mark.slow
def test_newton_iterations_of_a_projection_are_counted(rod):
    found = mb.simulate(rod, mb.assemble(rod), t1=1.0, manifold=mb.manifold.Projection())
    assert 0.5 < found.stats["newton_iterations"] / found.stats["num_steps"] < 5


@pytest.mark.slow
@pytest.mark.parametrize("redundant", [False, pytest.param(True, marks=pytest.mark.slow)])
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
