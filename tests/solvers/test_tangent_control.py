"""Runs that are differentiated resolve their derivatives, also those of modes that the motion does not excite."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly

import jaxmb as mb
from jaxmb import planar
from jaxmb.lagrangian import LagrangianSystem

SOLVERS = {"Adams": mb.solvers.Adams(), "Dopri8": diffrax.Dopri8(), "Hermite": mb.solvers.Hermite()}
RATE, END = 100.0, 3.0


def two_masses():
    """A slow and a fast mass, each on a spring of its own."""
    return LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * jnp.dot(v, v),
        potential=lambda t, q, p: 0.5 * (q[0] ** 2 + (p["rate"] * q[1]) ** 2),
        q=(1.0, 0.0),
        parameters={"rate": RATE},
    )


def at_rest(offset):
    """The slow mass moves; the fast one is at rest, but for an offset."""
    return mb.State(jnp.stack([jnp.ones_like(offset), offset]), jnp.zeros(2))


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_derivatives_of_a_fast_mode_at_rest(solver):
    system = two_masses()

    def end(offset, rtol):
        sol = mb.simulate(system, at_rest(offset), t1=END, rtol=rtol, solver=SOLVERS[solver])
        return sol.ys.q[-1, 1]

    reverse = jax.jit(jax.grad(end))
    forward = jax.jit(lambda x, rtol: jax.jvp(lambda x: end(x, rtol), (x,), (1.0,))[1])
    for rtol, error in ((1e-6, 1e-2), (1e-8, 2e-4), (1e-10, 2e-6)):
        assert abs(reverse(0.0, rtol) - np.cos(RATE * END)) < error
        np.testing.assert_allclose(forward(0.0, rtol), reverse(0.0, rtol), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_only_runs_that_are_differentiated_resolve_the_tangent():
    system = two_masses()

    def run(offset):
        sol = mb.simulate(system, at_rest(offset), t1=END, rtol=1e-6, saveat=[1.0, END])
        return sol.ys.q, sol.stats["num_steps"]

    derivative = jax.jit(jax.value_and_grad(lambda x: (run(x)[0][-1, 0], run(x)), has_aux=True))
    (_, (values, resolved)), _ = derivative(0.0)
    plain, steps = run(jnp.array(0.0))
    inside = jax.jit(run)(0.0)
    assert inside[1] == steps < 100 < resolved
    np.testing.assert_array_equal(inside[0], plain)
    np.testing.assert_allclose(values, plain, atol=1e-5)


@pytest.mark.slow
def test_derivatives_in_batches_at_events_between_steps_and_of_second_order():
    system = two_masses()
    crossing = diffrax.Event(lambda t, y, args, **kw: y.q[0], root_finder=None)

    @jax.jit
    def between(offset):
        dense = diffrax.SaveAt(dense=True)
        return mb.simulate(system, at_rest(offset), t1=END, rtol=1e-9, saveat=dense).at(2.0).q[1]

    def until(offset):
        stop = mb.simulate(system, at_rest(offset), t1=END, rtol=1e-9, event=crossing)
        return stop.ys.q[-1, 1], stop.ts[-1]

    def end(rate):
        changed = mb.with_parameters(system, {"rate": rate})
        return mb.simulate(changed, at_rest(jnp.array(0.1)), t1=0.3, rtol=1e-10).ys.q[-1, 1]

    gradients = jax.jit(jax.vmap(jax.grad(between)))(jnp.array([0.0, 1e-3]))
    np.testing.assert_allclose(gradients, np.cos(2 * RATE), atol=1e-4)
    slope, time = jax.jit(jax.grad(until, has_aux=True))(0.0)
    np.testing.assert_allclose(slope, np.cos(RATE * time), atol=1e-4)
    second = jax.jit(jax.jacfwd(jax.jacfwd(end)))(20.0)
    np.testing.assert_allclose(second, -0.1 * 0.3**2 * np.cos(20 * 0.3), rtol=1e-6)


def cart():
    """A mass on which a force of strength zero acts."""
    return LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * jnp.dot(v, v),
        force=lambda t, q, v, p: p["strength"] * jnp.sin(12.0 * t)[None],
        q=(0.0,),
        parameters={"strength": 0.0},
    )


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_force_of_strength_zero_on_a_mass_at_rest(solver):
    """The motion is none, and its derivative is a function of time; also by strengths that nothing is seen of."""
    system = cart()

    def end(strength, rtol):
        changed = mb.with_parameters(system, {"strength": strength})
        return mb.simulate(changed, system.guess, t1=1.5, rtol=rtol, solver=SOLVERS[solver]).ys.q[-1, 0]

    exact, strengths = 1.5 / 12 - np.sin(18) / 144, jnp.array([0.0, 1e-12, 1e-6, 1.0])
    reverse = jax.jit(lambda rtol: jax.vmap(jax.grad(end), (0, None))(strengths, rtol))
    # A program that is differentiated as a whole.
    whole = jax.grad(jax.jit(end))
    forward = jax.jit(lambda x, rtol: jax.jvp(lambda x: end(x, rtol), (x,), (1.0,))[1])
    for rtol, error in ((1e-6, 1e-4), (1e-10, 1e-8)):
        np.testing.assert_allclose(reverse(rtol), exact, rtol=error)
        np.testing.assert_allclose(whole(0.0, rtol), exact, rtol=error)
        np.testing.assert_allclose(forward(0.0, rtol), whole(0.0, rtol), rtol=1e-12)


@pytest.mark.slow
def test_a_force_of_strength_zero_beside_constraints():
    """Derivatives of a cart on a rail at rest, by the strength alone and beside those by where it starts."""
    rail = planar.Prismatic("rail", "ground", "cart", point=(0.0, 0.0), axis=(1.0, 0.0))

    def push(poses, velocities, t, parameters):
        return parameters["strength"] * jnp.sin(12.0 * t) * jnp.array([[1.0, 0.0, 0.0]])

    force = mb.Force("push", "cart", push, parameters={"strength": 0.0})
    system = mb.Scene([planar.Body("cart", mass=1.0, inertia=0.1)], joints=[rail], forces=[force]).compile()
    start = mb.assemble(system)

    def end(strength, offset):
        changed = mb.with_parameters(system, {"push.strength": strength})
        moved = mb.State(start.q.at[0].add(offset), start.u)
        return mb.simulate(changed, moved, t1=1.5, rtol=1e-8, throw=False)["cart"].position[-1, 0]

    exact = 1.5 / 12 - np.sin(18) / 144
    np.testing.assert_allclose(jax.grad(jax.jit(end))(0.0, 0.0), exact, rtol=1e-6)
    both = jax.jit(jax.grad(end, argnums=(0, 1)))(0.0, 0.0)
    np.testing.assert_allclose(both, [exact, 1.0], rtol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(end, argnums=(0, 1)))(0.0, 0.0), both, rtol=1e-12)


@pytest.mark.slow
def test_a_body_that_is_held():
    """Of its tangents constraints leave nothing but rounding, which steps do not resolve."""
    weld = planar.Fixed("weld", "ground", "plate", point_a=(0.2, 0.1), point_b=(-0.3, 0.1))
    plate = planar.Body("plate", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    system = mb.Scene([plate], joints=[weld], forces=[mb.Gravity((0.0, -9.81))]).compile()

    def end(angle):
        changed = mb.with_parameters(system, {"weld.angle": angle})
        start = mb.assemble(changed, throw=False)
        sol = mb.simulate(changed, start, t1=0.2, rtol=1e-6, throw=False, manifold=mb.manifold.Projection())
        return sol.ys.q[-1], sol.stats["num_steps"]

    angles = jnp.linspace(-1.0, 1.0, 10)
    derivative = lambda angle: jax.jvp(end, (angle,), (jnp.ones(()),))
    (q, steps), (slope, _) = jit_quickly(jax.vmap(derivative))(angles)
    c, s = jnp.cos(angles), jnp.sin(angles)
    np.testing.assert_allclose(q, jnp.stack([0.2 + 0.3 * c + 0.1 * s, 0.1 + 0.3 * s - 0.1 * c, angles], -1), atol=1e-12)
    np.testing.assert_allclose(slope, jnp.stack([-0.3 * s + 0.1 * c, 0.3 * c + 0.1 * s, jnp.ones(10)], -1), atol=1e-9)
    assert jnp.max(steps) < 30
    reverse = jit_quickly(jax.vmap(jax.jacrev(lambda angle: end(angle)[0])))(angles)
    np.testing.assert_allclose(reverse, slope, atol=1e-12)


@pytest.mark.slow
def test_a_mode_that_is_kicked_late():
    # The random part of the tangent has died away, by the factor exp(-40), when the kick comes.
    system = LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * jnp.dot(v, v),
        potential=lambda t, q, p: 0.5 * (q[0] ** 2 + (RATE * q[1]) ** 2),
        force=lambda t, q, v, p: jnp.stack([0.0 * t, p["kick"] * jnp.exp(-(((t - 10.0) / 0.02) ** 2)) - 8.0 * v[1]]),
        q=(1.0, 0.0),
        parameters={"kick": 0.0},
    )

    def end(kick, direction):
        kicked = mb.with_parameters(system, {"kick": kick})
        sol = mb.simulate(kicked, at_rest(jnp.array(0.0)), t1=10.1, rtol=1e-8, direction=direction)
        return sol.ys.q[-1, 1]

    # The response to the kick, by quadrature of Green's function.
    damped = np.sqrt(RATE**2 - 4.0**2)
    s = np.linspace(9.8, 10.1, 200001)
    green = np.exp(-4.0 * (10.1 - s)) * np.sin(damped * (10.1 - s)) / damped
    exact = np.trapezoid(green * np.exp(-(((s - 10.0) / 0.02) ** 2)), s)
    for direction in (None, {"kick": 1.0}):
        slope = jax.jit(lambda x, direction=direction: jax.grad(end)(x, direction))(0.0)
        np.testing.assert_allclose(slope, exact, rtol=1e-5)


@pytest.mark.slow
def test_no_direction_leaves_the_steps_of_the_motion():
    # A slow mode beside a fast one at rest, which a method for stiff systems damps, and so does its derivatives.
    system = LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * jnp.dot(v, v),
        potential=lambda t, q, p: 0.5 * (p["slow"] * q[0] ** 2 + p["fast"] * q[1] ** 2),
        q=(1.0, 0.0),
        parameters={"slow": 1.0, "fast": 1e6},
    )

    def end(x, direction):
        own = mb.with_parameters(system, {"slow": x**2, "fast": 1e6 * x})
        start = mb.State(q=jnp.stack([x, jnp.zeros(())]), u=jnp.zeros(2))
        sol = mb.simulate(own, start, t1=2.0, rtol=1e-8, solver=mb.solvers.Hermite(), direction=direction)
        return sol.ys.q[-1, 0], sol.stats["num_steps"]

    def gradient(direction):
        return jax.jit(jax.value_and_grad(lambda x: end(x, direction), has_aux=True))(1.0)

    (_, steps), slope = gradient({})
    (_, more), controlled = gradient(None)
    assert steps == end(1.0, None)[1] < more
    exact = np.cos(2.0) - 2.0 * np.sin(2.0)
    np.testing.assert_allclose([slope, controlled], exact, rtol=2e-7)
    forward = jax.jit(lambda x: jax.jvp(lambda x: end(x, {})[0], (x,), (1.0,))[1])(1.0)
    np.testing.assert_allclose(forward, slope, rtol=1e-11)


def test_directions_are_checked():
    for direction, message in (
        ({"rat": 1.0}, "rat"),
        ({"rate": [1.0, 2.0]}, r"direction\['rate'\] must"),
        (1.0, "direction must be a dictionary"),
    ):
        with pytest.raises(ValueError, match=message):
            mb.simulate(two_masses(), at_rest(np.array(0.0)), t1=0.1, direction=direction)
