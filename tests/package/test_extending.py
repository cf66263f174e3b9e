"""What a user adds: a joint, a force with an internal state, a solver, a formulation and a system that is not made of
bodies, each in a few lines against the public classes, simulated and compared with a closed form or the library's own.
"""

from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular

import jaxmb as mb
from jaxmb import mechanisms, parts, planar, solvers
from jaxmb.formulations import AbstractFormulation, Multipliers, accelerations
from jaxmb.system import AbstractSystem, DiagonalInertia, Ranks

G = 9.81


class Rolling(parts.AbstractPlanarPart, parts.AbstractPair, parts.AbstractConstraint):
    """A wheel (`body_b`) that rolls on the x axis of `body_a`. Rows 2: `y − radius`, `x + radius · angle`.

    **Arguments:** `radius` [m] > 0 of the wheel.
    """

    radius: parts.Number = parts.length(sign="positive")
    rows: ClassVar[int] = 2
    rheonomic: ClassVar[bool] = False

    def residual(self, space, poses, t):
        x, y = space.body_point(poses[0], space.point(poses[1], jnp.zeros(2)))
        return jnp.stack([y - self.radius, x + self.radius * (poses[1, 2] - poses[0, 2])])


class Maxwell(parts.AbstractPair, parts.AbstractDynamicForce):
    """A spring and a damper in succession between the origins of two bodies, in the plane and in space.

    **Arguments:** `stiffness` [N/m] > 0; `damping` [N s/m] > 0; `tension` [N] at the start, the internal state.
    """

    stiffness: parts.Number = parts.parameter(unit="N/m", sign="positive")
    damping: parts.Number = parts.parameter(unit="N s/m", sign="positive")
    tension: parts.Number = parts.internal_state(unit="N")
    point_a: parts.Number = parts.point(body=0, default="origin")
    point_b: parts.Number = parts.point(body=1, default="origin")

    def wrenches(self, space, poses, velocities, t):
        d = parts.separation(space, self, poses)
        return parts.force_pair(space, self, poses, -self.tension * d / jnp.linalg.norm(d))

    def state_rates(self, space, poses, velocities, t):
        d, rate = parts.separation(space, self, poses), parts.separation_rate(space, self, poses, velocities)
        return {"tension": self.stiffness * (jnp.dot(d, rate) / jnp.linalg.norm(d) - self.tension / self.damping)}


class TwoStepState(solvers.AbstractMultistepState):
    """The last two times and derivatives."""

    ts: jax.Array
    rates: jax.Array
    chart: Any
    sizes: Any
    tangents: Any

    @property
    def memory(self):
        return self.rates

    @property
    def chosen(self):
        return None


class TwoStepAttempt(solvers.AbstractAttempt):
    predicted: jax.Array
    after: jax.Array
    rates: jax.Array
    failed: jax.Array
    chart: Any

    @property
    def memory(self):
        return self.rates


class TwoStep(solvers.AbstractMultistep):
    """The Adams–Bashforth method of two steps with the trapezoidal rule as corrector, of order two, on any term."""

    tolerances: solvers.Tolerances = solvers.tolerances_of("TwoStep")
    tangent_control: Any = None
    solves_implicitly: ClassVar[bool] = False
    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return 2

    def statistics(self, solver_state, controller_state, stats):
        return {"num_evaluations": 1 + 2 * stats["num_steps"]}

    def initial_state(self, terms, t0, t1, y0, args, chart, before):
        chart = solvers.next_chart(terms, t0, y0, chart, args)
        start, _ = ravel_pytree(y0)
        first = solvers.evaluate(terms, t0, start, y0, chart, args)

        def numbers(terms, flat):
            near = solvers.evaluate(terms, t0, flat, y0, chart, args)
            there = solvers.project_near(terms, t0, flat, y0, near, args)
            return there.y, jnp.stack([there.f, there.f])

        sizes = self.first_sizes(start, first.f, before)
        tangents = self.first_tangents(numbers, terms, start, before)
        # As if the derivative had been the same one step ago.
        ts, rates = jnp.stack([t0, 2 * t0 - t1]), jnp.stack([first.f, first.f])
        return TwoStepState(ts, rates, first.chart, sizes, tangents)

    def attempt(self, terms, t1, before, like, args, state):
        h, ratio = t1 - state.ts[0], (t1 - state.ts[0]) / (2 * (state.ts[0] - state.ts[1]))
        predicted = before + h * ((1 + ratio) * state.rates[0] - ratio * state.rates[1])
        first = solvers.evaluate(terms, t1, predicted, like, state.chart, args)
        corrected = before + h / 2 * (state.rates[0] + first.f)
        second = solvers.project_near(terms, t1, corrected, like, first, args)
        rates = jnp.stack([second.f, state.rates[0]])
        return TwoStepAttempt(predicted, second.y, rates, first.failed | second.failed, second.chart)

    def advance(self, terms, t1, y0, args, state):
        before, unravel = ravel_pytree(y0)
        step, along = self.attempted(terms, t1, before, y0, args, state)
        tangents, scales = self.tangents_after(state.tangents, along)
        tolerated = self.tolerances.of_step(before, step.after, t1 - state.ts[0], state.sizes)
        errors = [((step.after - step.predicted) / 6, tolerated)]
        errors += [((end.after - end.predicted) / 6, own) for end, own in zip(along, scales, strict=True)]
        size = jnp.max(jnp.stack([self.weighted_norm(error, scale, y0) for error, scale in errors]))
        size = jnp.where(step.failed, jnp.inf, size)
        never, powers = jnp.array(False), jnp.full(3, 3.0)
        _, estimate = solvers.choose_order(
            jnp.stack([jnp.inf, size, jnp.inf]),
            powers,
            jnp.ones(()),
            may_fall=never,
            may_rise=never,
            known=~never,
            target=0.5,
            work=jnp.array([2, 0]),
        )
        y1 = unravel(step.after)
        chart, sizes = solvers.next_chart(terms, t1, y1, step.chart, args), self.grown_sizes(state.sizes, step.after)
        new = TwoStepState(jnp.stack([t1, state.ts[0]]), step.rates, chart, sizes, tangents)
        return y1, estimate, {"y0": y0, "y1": y1}, new, step.failed


class LeastConstraint(AbstractFormulation):
    """Gauss's principle in the norm of the mass matrix, M = L Lᵀ: the constraint force along the columns of L⁻¹ Aᵀ."""

    partitions: ClassVar[bool] = False
    inverts_mass: ClassVar[bool] = True

    def solve(self, inertia, force, jacobian, gamma):
        jacobian = jacobian.dense()
        A = jacobian.independent
        L = jnp.linalg.cholesky(inertia.product(jnp.eye(A.shape[1])))
        free = solve_triangular(L, force, lower=True)
        Q, R = jnp.linalg.qr(solve_triangular(L, A.T, lower=True))
        missing = solve_triangular(R.T, jacobian.gather_rows(gamma), lower=True) - Q.T @ free
        udot = solve_triangular(L.T, free + Q @ missing)
        return udot, jacobian.scatter_rows(solve_triangular(R, missing))


class SphericalPendulum(AbstractSystem):
    """A particle on a rod from the origin, in Cartesian coordinates; Φ = (q·q − l²) / 2l."""

    mass: jax.Array
    length: jax.Array
    gravity: jax.Array
    guess: mb.State
    design: tuple = ()
    nq: ClassVar[int] = 3
    nu: ClassVar[int] = 3
    position_rows: ClassVar[int] = 1
    rows: ClassVar = (("rod", 0),)
    ranks: ClassVar[Ranks] = Ranks(1, 1, 1, 1)

    def coordinate_names(self):
        return {"x": [0], "y": [1], "z": [2]}

    def parameter_paths(self):
        return {name: [(lambda s, name=name: getattr(s, name), None)] for name in ("mass", "length", "gravity")}

    def coordinate_scale(self):
        return jax.lax.stop_gradient(jnp.full(3, self.length))

    def velocity_scale(self):
        return self.coordinate_scale()

    def inertia(self, t, q, u):
        return DiagonalInertia(jnp.full(3, self.mass))

    def force(self, t, q, u):
        return jnp.array([0.0, 0.0, -1.0]) * self.mass * self.gravity

    def kinetic_energy(self, t, q, u):
        return 0.5 * self.mass * jnp.dot(u, u)

    def potential_energy(self, t, q):
        return self.mass * self.gravity * q[2]

    def position_residual(self, t, q):
        return (jnp.dot(q, q) - self.length**2)[None] / (2 * self.length)

    def velocity_residual(self, t, q, u):
        return jnp.dot(q, u)[None] / self.length

    def acceleration_residual(self, t, q, u, udot):
        return (jnp.dot(q, udot) + jnp.dot(u, u))[None] / self.length


def test_a_joint():
    """A wheel rolls down a slope, and rubs and presses on it, as the closed form says; also slopes by the radius."""
    mass, inertia, slope = 2.0, 0.05, 0.3
    wheel = planar.Body("wheel", mass=mass, inertia=inertia, position=(0.0, 0.3))
    weight = mb.Gravity((G * np.sin(slope), -G * np.cos(slope)))
    system = mb.Scene([wheel], joints=[Rolling("roll", "ground", "wheel", radius=0.3)], forces=[weight]).compile()
    assert system.nu - system.velocity_rank == 1

    def now(radius, rate):
        """Accelerations, and the joint's force and moment, where the wheel has turned by an angle."""
        own, angle = mb.with_parameters(system, {"roll.radius": radius}), 0.4
        q, u = jnp.stack([-radius * angle, radius, angle + 0.0 * radius]), rate * jnp.stack([-radius, 0.0, 1.0])
        udot, multipliers = accelerations(own, Multipliers(), 0.0, q, u)
        violated = jnp.append(own.position_residual(0.0, q), own.velocity_residual(0.0, q, u))
        return udot, own.constraint_force(0.0, q, u, multipliers), violated

    def closed(r):
        a = G * np.sin(slope) / (1 + inertia / (mass * r**2))
        force = mass * np.array([a - G * np.sin(slope), G * np.cos(slope)])
        return [a, 0.0, -a / r], [*force, r * force[0]], np.zeros(4)

    at = jax.jit(lambda r: jax.jvp(now, (r, jnp.asarray(-2.0)), (jnp.ones(()), jnp.zeros(()))))
    values, slopes = at(0.3)
    for found, expected in zip(values, closed(0.3), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    for slope_of, high, low in zip(slopes, closed(0.3 + 1e-5), closed(0.3 - 1e-5), strict=True):
        np.testing.assert_allclose(slope_of, (np.array(high) - np.array(low)) / 2e-5, rtol=1e-7, atol=1e-7)


@pytest.mark.slow
def test_a_force_with_an_internal_state():
    """A mass on a spring and a damper in succession: linear equations of third order."""
    mass, k, c, t1 = 1.5, 40.0, 6.0, 1.2
    bob = planar.PointMass("bob", mass=mass, position=(1.0, 0.0), velocity=(0.3, 0.0))
    element = Maxwell("element", "ground", "bob", stiffness=k, damping=c, tension=2.0)
    system = mb.Scene([bob], forces=[element]).compile()
    ts = np.linspace(0.0, t1, 5)
    motion = mb.simulate(system, mb.assemble(system), t1=t1, saveat=ts, rtol=1e-10)
    rates = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1 / mass], [0.0, k, -k / c]])
    exact = np.stack([scipy.linalg.expm(t * rates) @ [1.0, 0.3, 2.0] for t in ts])
    found = np.stack([motion["bob"].position[:, 0], motion["bob"].velocity[:, 0], motion["element"].tension], axis=1)
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_a_multistep_solver():
    """Errors in proportion to the tolerance, on a pendulum that is constrained and on a plain field; a derivative."""
    pendulum = mechanisms.get("pendulum")
    run = lambda **options: mb.simulate(pendulum.system, pendulum.state, t1=0.5, max_steps=2**16, **options)
    exact = run(rtol=1e-12).ys.q[-1]
    errors = []
    for rtol in (1e-4, 1e-6):
        motion = run(solver=TwoStep(), rtol=rtol)
        assert motion.stats["num_evaluations"] == 1 + 2 * motion.stats["num_steps"]
        assert np.max(motion.constraint_violation.position) <= 1e-9
        errors.append(np.max(np.abs(motion.ys.q[-1] - exact)))
    assert 1e-8 < errors[1] < 1e-4 and 20 < errors[0] / errors[1] < 500
    controller = solvers.MultistepController(rtol=1e-6, atol=1e-8)
    term = diffrax.ODETerm(lambda t, y, args: args * y)
    end = lambda rate: diffrax.diffeqsolve(
        term, TwoStep(), 0.0, 1.0, None, jnp.ones(2), rate, stepsize_controller=controller, max_steps=2**14
    ).ys[-1]
    value, slope = jax.jit(lambda rate: (end(rate), jax.jacrev(end)(rate)))(-2.0)
    np.testing.assert_allclose(value, np.exp(-2.0), rtol=1e-4)
    np.testing.assert_allclose(slope, np.exp(-2.0), rtol=1e-3)


@pytest.mark.slow
def test_a_formulation():
    """The same accelerations, constraint forces and motion as by multipliers, of a machine with a redundant row."""
    mechanism = mechanisms.get("parallelogram")
    system, state = mechanism.system, mechanism.state
    both = [accelerations(system, own, 0.0, state.q, state.u) for own in (LeastConstraint(), Multipliers())]
    for udot, multipliers in both:
        np.testing.assert_allclose(udot, both[1][0], rtol=1e-10, atol=1e-10)
        forces = [system.constraint_force(0.0, state.q, state.u, own) for own in (multipliers, both[1][1])]
        np.testing.assert_allclose(*forces, rtol=1e-9, atol=1e-9)
    ends = [mb.simulate(system, state, t1=0.3, rtol=1e-10, formulation=own).ys for own in (LeastConstraint(), None)]
    np.testing.assert_allclose(ends[0].q, ends[1].q, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_system_that_is_not_made_of_bodies():
    """A particle that goes around on a cone, with the period and the tension of the closed form."""
    mass, length, tilt, t1 = 0.7, 1.3, 0.6, 2.0
    rate = np.sqrt(G / (length * np.cos(tilt)))
    at = lambda t: length * np.array([np.sin(tilt) * np.cos(rate * t), np.sin(tilt) * np.sin(rate * t), -np.cos(tilt)])
    # Off the sphere, so that the start is assembled.
    guess = mb.State(jnp.asarray(1.1 * at(0.0)), jnp.zeros(3))
    system = SphericalPendulum(*(jnp.asarray(x) for x in (mass, length, G)), guess)
    state = mb.assemble(system, fix={"x": at(0.0)[0], "y": 0.0}, rates={"y": rate * at(0.0)[0], "z": 0.0})
    ts = np.linspace(0.0, t1, 9)
    motion = mb.simulate(system, state, t1=t1, saveat=ts, rtol=1e-10)
    exact = np.stack([at(t) for t in ts])
    np.testing.assert_allclose(motion.ys.q, exact, rtol=0, atol=1e-10)
    np.testing.assert_allclose(motion["z"], exact[:, 2], rtol=0, atol=1e-10)
    np.testing.assert_allclose(motion.energy, motion.energy[0], rtol=0, atol=1e-9)
    other = mb.simulate(system, state, t1=t1, rtol=1e-10, solver=diffrax.Dopri8())
    np.testing.assert_allclose(other.ys.q[-1], exact[-1], rtol=0, atol=1e-10)
    pull = np.linalg.norm(motion.constraint_forces["rod"], axis=1)
    np.testing.assert_allclose(pull, mass * G / np.cos(tilt), rtol=1e-10)
    assert set(mb.parameters(system)) == {"mass", "length", "gravity"} and "x, y, z" in str(system)
    # A small swing about the lowest place, from the same class: its frequency by linear equations.
    linear = mb.linearise(system, mb.equilibrium(system))
    np.testing.assert_allclose(np.abs(linear.eigenvalues), np.sqrt(G / length), rtol=1e-9)
