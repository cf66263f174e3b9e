"""Derivatives on the mesh of a run: all modes and their combinations are one, in all forms of a run.

The reference is the derivative of the loop itself, step by step, in forward mode, with the same tangents controlled.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from sprung_pendulums import GRAVITY, SPRING, rod

import jaxmb as mb
from jaxmb import parts, planar
from jaxmb.simulate import integrate, run as of_runs, saves
from jaxmb.solvers import Adams, Hermite
from jaxmb.solvers.stepping import loop

SYSTEM = mb.Scene(
    [planar.Body("bar", mass=2.0, inertia=0.3, position=(0.5, 0.0))],
    joints=[planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))],
    forces=[
        mb.Gravity((0.0, -9.81)),
        planar.SpringDamper(
            "spring", "ground", "bar", stiffness=30.0, damping=0.4, free_length=0.3, point_a=(1, 1), point_b=(0.3, 0)
        ),
    ],
).compile()
STATE = mb.assemble(SYSTEM, fix={"bar.angle": 0.2}, rates={"bar.angle_rate": 1.0})
TIMES = np.linspace(0.0, 1.0, 7)
POINT = np.array([2.0, 30.0])


def run(p, **options):
    system = mb.with_parameters(SYSTEM, {"bar.mass": p[0], "spring.stiffness": p[1]})
    return mb.simulate(system, STATE, rtol=1e-9, throw=False, **({"t1": 1.0, "max_steps": 2048} | options))


def states(motion):
    return jnp.concatenate([jnp.ravel(motion.ys.q), jnp.ravel(motion.ys.u)])


def at_event(p, **options):
    event = diffrax.Event(lambda t, y, args, **_: y.u[2] - 0.1, optx.Newton(1e-11, 1e-11))
    motion = run(p, event=event, **options)
    return jnp.append(states(motion), motion.ts[-1])


def within(p, **options):
    motion = run(p, saveat=diffrax.SaveAt(dense=True), **options)
    return jnp.ravel(jax.vmap(lambda t: motion.at(t).q)(jnp.array([0.13, 0.77])))


def of_function(p, **options):
    saveat = diffrax.SaveAt(ts=TIMES, fn=lambda t, y, args: jnp.sin(t) * y.q[1] * y.u)
    return jnp.ravel(run(p, saveat=saveat, **options).ys)


def of_steps(p, **options):
    ys = run(p, saveat=diffrax.SaveAt(t0=True, steps=3, ts=TIMES), **options).ys
    # The number of steps does not matter to the last states.
    last = jnp.sum(jnp.isfinite(ys.q[:, 0])) - 1
    return jnp.concatenate([ys.q[last], ys.u[last]])


def steady(*laws):
    """A rod on a spring, whose speed is kept by a constraint that is not linear in it."""
    speed = lambda poses, velocities, t, p: velocities[0, 0] ** 2 + velocities[0, 1] ** 2 - p["speed"] ** 2
    pace = mb.VelocityConstraint("pace", "rod", speed, parameters={"speed": 1.2})
    return mb.Scene([rod()], joints=[pace], forces=[SPRING, GRAVITY, *laws])


def rubbing():
    """The same with a constraint that is not ideal: it turns the rod and its path, by a share of its force."""
    turning = lambda poses, velocities, reactions, t, p: (
        p["share"] * jnp.stack([-reactions[:, 1], reactions[:, 0], 0.3 * reactions[:, 0]], axis=1)
    )
    return steady(mb.NonIdeal("rub", "pace", turning, parameters={"share": 0.4}))


def driven():
    """Nothing is free: the driver says where the rod is."""
    turn = lambda t, p: p["amplitude"] * jnp.sin(p["rate"] * t)
    numbers = {"amplitude": 0.7, "rate": 3.0}
    pin = planar.Revolute("pin", "ground", "rod", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    drive = planar.Driver("drive", "ground", "rod", quantity="angle", motion=turn, parameters=numbers)
    return mb.Scene([rod()], joints=[pin, drive], forces=[GRAVITY])


def of_scene(scene, *names, **own):
    """The states of another machine, whose parameters the point multiplies."""
    system = scene().compile()
    given = mb.parameters(system)

    def observe(p, **options):
        changed = mb.with_parameters(system, {n: given[n] * x for n, x in zip(names, p / POINT, strict=True)})
        state = mb.assemble(changed, throw=False)
        return states(mb.simulate(changed, state, t1=0.5, rtol=1e-9, max_steps=512, throw=False, **(own | options)))

    return observe


with_options = lambda **own: lambda p, **options: states(run(p, **own, **options))
FORMS = {
    "end": with_options(),
    "times": with_options(saveat=diffrax.SaveAt(t0=True, ts=TIMES, t1=True)),
    "backward": with_options(t1=-1.0, saveat=-TIMES),
    "jumps": with_options(jumps=[0.3, 0.6], saveat=TIMES),
    "function": of_function,
    "steps": of_steps,
    "dense": within,
    "event": at_event,
    "projection": with_options(manifold=mb.manifold.Projection(), saveat=TIMES),
    "baumgarte": with_options(manifold=mb.manifold.Baumgarte(5.0), saveat=TIMES),
    "hermite": with_options(solver=Hermite(), saveat=TIMES),
    "explicit": with_options(solver=diffrax.Dopri5(), saveat=TIMES),
    "implicit": with_options(solver=diffrax.Kvaerno5(), saveat=TIMES),
    "multipliers": with_options(formulation=mb.formulations.Multipliers(), saveat=TIMES),
}
# Machines of other kinds.
MACHINES = {
    "nonlinear in velocity": (steady, "rod.mass", "pace.speed"),
    "not ideal": (rubbing, "rub.share", "spring.stiffness"),
    "fully driven": (driven, "drive.amplitude", "drive.rate"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [*FORMS, *MACHINES])
def test_forward_mode_is_reverse_mode_and_that_of_the_discrete_solution(name, monkeypatch):
    implicit = {} if name == "fully driven" else {"solver": Hermite()}
    observe = FORMS[name] if name in FORMS else of_scene(*MACHINES[name], **implicit)
    forward, reverse = (np.asarray(jax.jit(mode(observe))(POINT)) for mode in (jax.jacfwd, jax.jacrev))
    monkeypatch.setattr(integrate, "on_mesh", lambda solve, first, limit, kept: loop(solve, first, limit)[0])
    jax.clear_caches()
    exact = np.asarray(jax.jit(jax.jacfwd(observe))(POINT))
    jax.clear_caches()
    scale = np.max(np.abs(exact), axis=0)
    assert np.all(scale > 1e-4)
    np.testing.assert_allclose(forward / scale, reverse / scale, rtol=0, atol=5e-11)
    np.testing.assert_allclose(forward / scale, exact / scale, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_hessians_and_batches_need_no_option():
    """Against differences of gradients, and these against differences of values, for each member of a batch."""

    def energy(p):
        return jnp.sum(jnp.cos(jnp.arange(6.0)) * states(run(p, max_steps=300)))

    program = jax.jit(jax.vmap(lambda p, v: jax.jvp(jax.value_and_grad(energy), (p,), (v,))))
    step, axes = 1e-4, np.diag(POINT)
    shifts = step * np.stack([k * axis for axis in axes for k in (1, -1, 2, -2)])
    for member in POINT * np.array([[1.0, 1.0], [0.5, 2.0]]):
        # Two directions of the Hessian, and the points of the differences.
        points, directions = member + np.append(0 * axes, shifts, axis=0), np.append(np.eye(2), 0 * shifts, axis=0)
        (values, gradients), (_, hessians) = jax.tree.map(np.asarray, program(points, directions))
        gradient, hessian = gradients[0], hessians[:2]
        near, back, far, far_back = np.column_stack([values, gradients])[2:].reshape(2, 4, 3).swapaxes(0, 1)
        slopes = (8 * (near - back) - (far - far_back)) / (12 * step * POINT[:, None])
        np.testing.assert_allclose(gradient, slopes[:, 0], rtol=1e-5)
        np.testing.assert_allclose(hessian, slopes[:, 1:], rtol=1e-5, atol=1e-5 * np.max(np.abs(slopes[:, 1:])))
        np.testing.assert_allclose(hessian, hessian.T, rtol=1e-7)


def test_second_derivatives_are_in_forward_mode_over_reverse():
    stone = mb.Scene([planar.PointMass("stone", mass=1.0)], forces=[mb.Gravity((0.0, -9.81))]).compile()
    end = lambda y: mb.simulate(stone, mb.State(stone.guess.q.at[1].set(y), stone.guess.u), t1=1.0).ys.q[-1, 1]
    with pytest.raises(TypeError, match=r"in forward mode only: take jax\.hessian"):
        jax.jacrev(jax.grad(end))(1.0)


@pytest.fixture
def with_rows(monkeypatch):
    """A function with derivatives that keep so many rows."""

    def keeping(most, function):
        def kept(*x):
            monkeypatch.setattr(of_runs, "kept_steps", lambda *_: most)
            return function(*x)

        return kept

    return keeping


@pytest.mark.slow
def test_rows_of_long_runs_are_found_again(with_rows):
    """Rows of segments are found again from their starts."""
    end = lambda p, most: with_rows(most, lambda p: states(run(p, saveat=TIMES)))(p)
    of = lambda most: (
        jax.jit(jax.jacfwd(lambda p: end(p, most)))(POINT),
        jax.jit(jax.jacrev(lambda p: end(p, most)))(POINT),
    )
    whole, cut = of(2048), of(16)
    for a, b in zip(whole, cut, strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-11, atol=1e-11 * np.max(np.abs(a)))
    members = POINT[None] * np.array([[1.0, 1.0], [0.5, 2.0]])
    batch = jax.jit(jax.vmap(jax.jacrev(lambda p: end(p, 16))))(members)
    np.testing.assert_allclose(batch[0], whole[1], rtol=1e-8, atol=1e-8 * np.max(np.abs(whole[1])))


LONGER = ["backward", "jumps", "event", "projection", "hermite", "implicit"]


@pytest.mark.slow
@pytest.mark.parametrize("name", LONGER)
def test_steps_of_segments_are_taken_again(name, with_rows):
    """Also those of other solvers and manifolds, after jumps, and up to an event."""
    of = lambda most: jax.jit(jax.jacrev(with_rows(most, FORMS[name])))(POINT)
    whole, cut = of(2048), of(16)
    np.testing.assert_allclose(cut, whole, rtol=1e-9, atol=1e-9 * np.max(np.abs(whole)))


@pytest.mark.slow
def test_second_derivatives_of_a_run_that_is_too_long(with_rows):
    second = jax.hessian(with_rows(16, lambda p: jnp.sum(states(run(p)))))
    with pytest.raises(RuntimeError, match="Second derivatives need the rows of all steps, of which 16 are kept"):
        jax.block_until_ready(jax.jit(second)(POINT))


class Onset(parts.AbstractPair, parts.AbstractForce):
    """A force that sets in.

    **Arguments:** `time` [s]; `strength` [N].
    """

    time: parts.Number = parts.parameter(unit="s")
    strength: parts.Number = parts.parameter(unit="N")

    def wrenches(self, space, poses, velocities, t):
        force = jnp.where(t >= self.time, self.strength, 0.0)
        return jnp.stack([jnp.zeros(3), jnp.array([1.0, 0.0, 0.0]) * force])


@pytest.mark.slow
@pytest.mark.parametrize("solver", [pytest.param(Adams(), id="Adams"), pytest.param(Hermite(), id="Hermite")])
def test_derivatives_by_all_times(solver):
    """Start, end, saved times and times of jumps, first and second derivatives, against the solution in closed form."""
    system = mb.Scene(
        [planar.Body("body", mass=2.0, inertia=1.0)],
        forces=[mb.Gravity((0.0, -9.81)), Onset("onset", "ground", "body", time=0.4, strength=3.0)],
    ).compile()
    state = mb.State(jnp.zeros(3), jnp.array([1.0, 0.5, 0.0]))

    def motion(x):
        time, strength, start, middle, end = x
        changed = mb.with_parameters(system, {"onset.time": time, "onset.strength": strength})
        saveat = diffrax.SaveAt(ts=middle[None], t1=True)
        found = mb.simulate(
            changed, state, t0=start, t1=end, saveat=saveat, jumps=time[None], solver=solver, throw=False
        )
        return jnp.append(jnp.concatenate([found.ys.q[:, 0], found.ys.q[:, 1]]), found.ts[-1])

    def closed(x):
        time, strength, start, middle, end = x
        t = jnp.stack([middle, end])
        across = (t - start) + strength / 4 * jnp.maximum(t - time, 0.0) ** 2
        return jnp.append(jnp.concatenate([across, 0.5 * (t - start) - 9.81 / 2 * (t - start) ** 2]), end)

    x = jnp.array([0.4, 3.0, 0.1, 0.7, 1.0])
    np.testing.assert_allclose(motion(x), closed(x), rtol=1e-8)
    exact = jax.jacfwd(closed)(x)
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(motion))(x), exact, rtol=1e-7, atol=1e-7)
    loss = lambda motion: lambda x: jnp.sum(jnp.sin(motion(x)))
    hessian = jax.jit(jax.hessian(loss(motion)))(x)
    np.testing.assert_allclose(hessian, jax.hessian(loss(closed))(x), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("moves", [False, True])
def test_times_that_are_numbers_have_no_derivatives_to_compile(moves, monkeypatch):
    """Also under `jit`, where JAX traces what is made of them."""
    found = []
    monkeypatch.setattr(saves, "at_moving_times", lambda term, ts, moves, ys: found.append(ts) or ys)
    system = mb.Scene([planar.Body("body", mass=2.0, inertia=1.0)], forces=[mb.Gravity((0.0, -9.81))]).compile()

    def end(x):
        changed = mb.with_parameters(system, {"body.mass": x})
        saveat = [0.5 * x, 1.0] if moves else [0.5, 1.0]
        return jnp.sum(mb.simulate(changed, system.guess, t1=1.0, saveat=saveat).ys.q)

    jax.jit(end).trace(2.0)
    assert bool(found) == moves


@pytest.mark.slow
@pytest.mark.parametrize("solver", [pytest.param(Adams(), id="Adams"), pytest.param(Hermite(), id="Hermite")])
def test_the_time_of_an_impulse_has_a_derivative(solver):
    """A rail whose driver jumps from one rate to another at a time: the position of the load that it carries along."""
    swing = lambda t, p: jnp.where(t < p["when"], 0.5 * t, 0.5 * p["when"] + 2.0 * (t - p["when"]))
    system = mb.Scene(
        [
            planar.Body("sledge", mass=1.0, inertia=1.0),
            planar.Body("rod", mass=1.0, inertia=0.1, position=(0.0, -0.5)),
        ],
        joints=[
            planar.Prismatic("rail", "ground", "sledge", point=(0.0, 0.0), axis=(1.0, 0.0)),
            planar.Driver("drive", "ground", "sledge", quantity="x", motion=swing, parameters={"when": 0.3}),
            planar.Revolute("pin", "sledge", "rod", point=(0.0, 0.0)),
        ],
        forces=[mb.Gravity((0.0, -9.81))],
    ).compile()

    def angle(when, rtol=1e-9):
        changed = mb.with_parameters(system, {"drive.when": when})
        state = mb.assemble(changed, fix={"rod.angle": 0.1}, rates={"rod.angle_rate": 0.0}, throw=False)
        motion = mb.simulate(changed, state, t1=0.8, jumps=when[None], rtol=rtol, solver=solver, throw=False)
        return motion.ys.q[-1, 5]

    at, h = jnp.array(0.3), 1e-4
    value = jax.jit(angle)
    central = (value(at + h, 1e-12) - value(at - h, 1e-12)) / (2 * h)
    assert abs(central) > 0.1
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(angle))(at), central, rtol=1e-6)


@pytest.mark.slow
def test_the_times_of_jumps_have_no_derivatives_by_other_solvers():
    system = mb.Scene([planar.Body("body", mass=2.0, inertia=1.0)], forces=[mb.Gravity((0.0, -9.81))]).compile()

    def end(when):
        motion = mb.simulate(system, system.guess, t1=0.8, jumps=when[None], solver=diffrax.Tsit5(), throw=False)
        return motion.ys.q[-1, 1]

    with pytest.raises(ValueError, match=r"times of jumps are known to jaxmb\.solvers\.Adams and Hermite only"):
        jax.grad(end)(jnp.array(0.3))
