"""Batches of motions: `vmap` equals the loop, views by name, and members that fail and leave the others alone."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly

import jaxmb as mb
from jaxmb import planar

VIEWS = {
    "motion": lambda motion: motion["bob"],
    "energies": lambda motion: (motion.kinetic_energy, motion.potential_energy, motion.energy),
    "momenta": lambda motion: (motion.linear_momentum, motion.angular_momentum),
    "rates": lambda motion: (motion.rates, motion.accelerations, motion.multipliers),
    "reactions": lambda motion: (motion.reactions["bar"], motion.constraint_forces["bar"], motion.forces["spring"]),
    "violation": lambda motion: motion.constraint_violation,
    "quantities": lambda motion: (motion.quantity("bob.position"), motion.quantity("bar.force")),
    "dense output": lambda motion: (motion.at(0.05), motion.at(jnp.array([0.02, 0.03]))),
}


@pytest.fixture(scope="module")
def batch():
    """Pendulums of two masses under three gravities, with a spring."""
    bob = planar.PointMass("bob", mass=1.0, position=(1.0, 0.0))
    forces = [mb.Gravity((0.0, -9.81)), planar.SpringDamper("spring", "ground", "bob", stiffness=3.0, free_length=0.0)]
    system = mb.Scene([bob], joints=[planar.Distance("bar", "ground", "bob")], forces=forces).compile()
    saveat = diffrax.SaveAt(ts=jnp.linspace(0.0, 0.1, 4), dense=True)

    def run(mass, gravity):
        values = {"bob.mass": mass, "gravity.acceleration": jnp.stack([0.0 * gravity, -gravity])}
        options = {"saveat": saveat, "max_steps": 64, "solver": diffrax.Tsit5()}
        return mb.simulate(mb.with_parameters(system, values), system.guess, t1=0.1, **options)

    both = jax.vmap(jax.vmap(run, in_axes=(None, 0)), in_axes=(0, None))
    return jit_quickly(both)(jnp.array([1.0, 2.0]), jnp.array([3.0, 6.0, 9.0]))


SHORT = ("energies", "violation", "quantities")


@pytest.mark.slow
@pytest.mark.parametrize("names", [SHORT, tuple(VIEWS)], ids=["some", "all"])
def test_views_of_a_batch_are_those_of_its_members(batch, names):
    """One program for the views of the batch, and one for those of a member."""
    views = jit_quickly(lambda motion: [VIEWS[name](motion) for name in names])
    together = views(batch)
    for i, j in ((0, 1), (1, 2)):
        alone = views(jax.tree.map(lambda leaf, i=i, j=j: leaf[i, j], batch))
        equal = lambda a, b, i=i, j=j: np.testing.assert_allclose(a[i, j], b, rtol=1e-12, atol=1e-12)
        jax.tree.map(equal, together, alone)


@pytest.mark.slow
def test_batch_is_saved_as_its_members_are(batch, tmp_path):
    batch.save(tmp_path / "batch.npz")
    saved = mb.load(tmp_path / "batch.npz")
    member = jax.tree.map(lambda leaf: leaf[1, 2], batch).to_dict()
    assert saved.keys() == member.keys() and saved["bob.position"].shape == (2, 3, 4, 2)
    for name, value in member.items():
        np.testing.assert_allclose(saved[name][1, 2], value, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_coordinates_of_a_batch_by_name():
    kinetic, potential = lambda t, q, v, p: 0.5 * p["m"] * v @ v, lambda t, q, p: 0.5 * (q[0] ** 2 + 4.0 * q[1] ** 2)
    system = mb.lagrangian.LagrangianSystem(
        kinetic=kinetic, potential=potential, q=[1.0, 2.0], parameters={"m": 1.0}, coordinates=["slow", "fast"]
    )

    def run(mass):
        changed = mb.with_parameters(system, {"m": mass})
        return mb.simulate(changed, system.guess, t1=0.3, rtol=1e-10, saveat=jnp.array([0.1, 0.2, 0.3]))

    masses = np.array([1.0, 2.0])
    motion = jax.jit(jax.vmap(run))(jnp.asarray(masses))
    angle = 2.0 / np.sqrt(masses)[:, None] * np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(motion["fast"], 2.0 * np.cos(angle), rtol=0, atol=1e-9)
    rate = -4.0 / np.sqrt(masses)[:, None] * np.sin(angle)
    np.testing.assert_allclose(motion.quantity("fast_rate"), rate, rtol=0, atol=1e-9)


# Members that fail


@pytest.fixture(scope="module")
def mass_until():
    """A unit mass pushed by a force `√(end − t)`, which is not a number after `end`."""
    law = lambda poses, velocities, t, p: jnp.stack([jnp.sqrt(p["end"] - t), 0.0 * t, 0.0 * t])[None]
    push = mb.Force("push", "body", law, parameters={"end": 1.0})
    return mb.Scene([planar.PointMass("body", mass=1.0)], forces=[push]).compile()


def pushed(system, end, mass, speed, **options):
    changed = mb.with_parameters(system, {"push.end": end, "body.mass": mass})
    state = mb.State(jnp.zeros(2), jnp.stack([speed, 0.0 * speed]))
    options = {"saveat": jnp.array([0.1, 0.2, 0.9]), "max_steps": 256} | options
    return mb.simulate(changed, state, t1=0.9, throw=False, **options)


def test_single_run_that_fails_is_kept_as_far_as_it_came(mass_until):
    motion = pushed(mass_until, jnp.array(0.5), jnp.array(1.0), jnp.array(1.0), saveat=None)
    np.testing.assert_allclose(motion.ts, 0.5, rtol=0, atol=1e-8)
    # The integral of the force.
    np.testing.assert_allclose(motion.ys.u[-1, 0], 1.0 + 2.0 / 3.0 * 0.5**1.5, rtol=0, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacrev, jax.jacfwd])
def test_member_that_fails_is_not_a_number_throughout(mass_until, derivative):
    """Half way, from a start that is not finite, and from forces that are not: also what it depends on in no step."""
    one, nan = 1.0, np.nan
    members = jnp.array([[1.0, one, one], [0.5, one, one], [1.0, one, nan], [-1.0, one, one]])

    def run(x):
        motion = pushed(mass_until, *x)
        return (jnp.stack([motion.energy[-1], motion["body"].position[0, 0], motion.ys.u[1, 0]]),) * 2

    derivatives, values = map(np.asarray, jax.jit(jax.vmap(derivative(run, has_aux=True)))(members))
    for found in (derivatives, values):
        assert np.all(np.isfinite(found[0])) and np.all(np.isnan(found[1:]))
    # The velocity is that at the start and 2/3 (1 - (1 - t)^1.5) over the mass.
    np.testing.assert_allclose(derivatives[0, 2, 1], -2.0 / 3.0 * (1.0 - 0.8**1.5), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, mb.solvers.Hermite(), diffrax.Dopri8()])
def test_member_that_cannot_start_takes_no_step(mass_until, solver):
    run = jax.jit(jax.vmap(lambda speed: pushed(mass_until, jnp.array(1.0), jnp.array(1.0), speed, solver=solver)))
    motion = run(jnp.array([1.0, np.nan, 1.0]))
    steps, ended = np.asarray(motion.stats["num_steps"]), motion.result == mb.RESULTS.assembly_failed
    assert steps[1] == 0 and steps[0] == steps[2] > 0
    np.testing.assert_array_equal(ended, [False, True, False])
    np.testing.assert_array_equal(np.isinf(motion.ts), [[False] * 3, [True] * 3, [False] * 3])
    # Forces that are not finite at the start end a run; a multistep method sees at once that no step is short enough.
    motion = pushed(mass_until, jnp.array(-1.0), jnp.array(1.0), jnp.array(1.0), saveat=None, solver=solver)
    assert motion.result == mb.RESULTS.dt_min_reached
    assert isinstance(solver, diffrax.Dopri8) or motion.stats["num_steps"] == 1


@pytest.mark.slow
def test_loops_that_do_not_close_leave_the_others_alone():
    """A coupler of 40 m closes none; nor does its state have a derivative."""
    mechanism = mb.mechanisms.get("four_bar")

    def assembled(length):
        system = mb.with_parameters(mechanism.system, {"C.point_a": jnp.stack([length / 2, 0.0 * length])})
        return system, mb.assemble(system, mechanism.state, rates=mechanism.rates, throw=False)

    @jax.jit
    @jax.vmap
    def run(length):
        motion = mb.simulate(*assembled(length), t1=0.1, throw=False)
        return motion["crank"].angle[-1], motion.result == mb.RESULTS.successful, motion.result._value

    lengths = jnp.array([3.0, 40.0, 3.1])
    angles, fine, ended = run(lengths)
    np.testing.assert_array_equal(fine, [True, False, True])
    assert ended[1] == mb.RESULTS.assembly_failed._value
    np.testing.assert_allclose(angles[0], run(jnp.full(3, 3.0))[0][0], rtol=1e-9)
    for derivative in (jax.grad, jax.jacfwd):
        slopes = jax.jit(jax.vmap(derivative(lambda length: assembled(length)[1].q[2])))(lengths)
        np.testing.assert_array_equal(np.isnan(slopes), [False, True, False])


# Many members


@pytest.mark.slow
def test_gradient_of_a_sum_over_a_batch():
    """Of what the members share: the sum of theirs."""
    mechanism = mb.mechanisms.get("pendulum")
    system, state = mechanism.system, mechanism.state
    name = next(name for name in mb.parameters(system) if name.endswith(".mass"))

    def end(mass, spin):
        changed = mb.with_parameters(system, {name: mass})
        start = mb.assemble(changed, mb.State(state.q, state.u + spin), throw=False)
        own = {"solver": diffrax.Dopri8(), "stepsize_controller": diffrax.ConstantStepSize(), "dt0": 0.05}
        return mb.simulate(changed, start, t1=0.1, max_steps=4, throw=False, **own).energy[-1]

    mass, spins = mb.parameters(system)[name], jnp.array([0.1, 0.2])
    along = jax.vmap(end, in_axes=(None, 0))
    together = jax.jit(jax.grad(lambda mass: jnp.sum(along(mass, spins))))(mass)
    each = jax.jit(jax.vmap(jax.grad(end), in_axes=(None, 0)))(mass, spins)
    assert abs(together) > 1e-3
    np.testing.assert_allclose(together, jnp.sum(each), rtol=1e-12)


@pytest.mark.slow
def test_batch_over_lengths_equals_the_loop():
    mechanism = mb.mechanisms.get("four_bar")

    def crank_angle(length):
        half = jnp.stack([length / 2, jnp.zeros_like(length)])
        values = {"A.point_b": -half, "B.point_a": half, "crank.inertia": length**2 / 12}
        system = mb.with_parameters(mechanism.system, values)
        state = mb.assemble(system, mechanism.state, fix=mechanism.fix, rates=mechanism.rates, throw=False)
        return mb.simulate(system, state, t1=0.5, rtol=1e-12, throw=False)["crank"].angle[-1]

    lengths = jnp.linspace(0.8, 1.1, 64)
    together, single = jax.jit(jax.vmap(crank_angle))(lengths), jax.jit(crank_angle)
    np.testing.assert_allclose(together, [single(length) for length in lengths], rtol=1e-9)
