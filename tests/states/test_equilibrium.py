"""Static equilibrium: closed forms, balance of forces, derivatives, and what has none."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import mechanisms, planar, spatial
from jaxmb.formulations import Partitioned, accelerations
from jaxmb.states import equilibrium
from jaxmb.states.balance import Balance

# Most are of single operations, outside of `jit`.
MOST_PROGRAMS = 80
G = 9.81


def cart():
    """A cart on a level rail, with a pendulum that a spring at its pin turns."""
    bodies = [
        planar.Body("cart", mass=3.0, inertia=1.0, position=(0.4, 0.0)),
        planar.Body("bob", mass=2.0, inertia=0.1, position=(0.4, -1.0), angle=-np.pi / 2),
    ]
    joints = [
        planar.Prismatic("rail", "ground", "cart", point=(0.0, 0.0), axis=(1.0, 0.0)),
        planar.Revolute("pin", "cart", "bob", point=(0.4, 0.0)),
    ]
    spring = planar.TorsionalSpringDamper("spring", "cart", "bob", stiffness=5.0, free_angle=0.0)
    return mb.Scene(bodies, joints=joints, forces=[spring, mb.Gravity((0.0, -G))]).compile()


def bob_angle(stiffness, mass):
    """From the balance of moments, k angle = −m g l cos(angle), by Newton's method."""
    angle = -1.2
    for _ in range(50):
        angle -= (stiffness * angle + mass * G * np.cos(angle)) / (stiffness - mass * G * np.sin(angle))
    return angle


def balanced(system, state):
    """Largest acceleration of a state at rest."""
    solve = jax.jit(lambda system, q: accelerations(system, Partitioned(), 0.0, q, jnp.zeros(system.nu))[0])
    return np.max(np.abs(solve(system, state.q)))


@functools.cache
def solver():
    system = cart()

    def solve(stiffness, mass, throw=False):
        changed = mb.with_parameters(system, {"spring.stiffness": stiffness, "bob.mass": mass})
        return mb.equilibrium(changed, throw=throw)

    return solve


@pytest.mark.slow
def test_equilibrium_of_a_pendulum_on_a_spring_and_its_derivatives():
    solve = solver()
    state = solve(5.0, 2.0, throw=True)
    angle = bob_angle(5.0, 2.0)
    # The cart could be anywhere; short steps leave the middle between it and the bob about where it was.
    x = float(state.q[0])
    assert abs(x + 0.5 * np.cos(angle) - 0.4) < 1e-3
    np.testing.assert_allclose(state.q, [x, 0.0, 0.0, x + np.cos(angle), np.sin(angle), angle], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(state.u, 0.0)

    stiff = 5.0 - 2.0 * G * np.sin(angle)
    slopes = [-angle / stiff, -G * np.cos(angle) / stiff]
    of = lambda stiffness, mass: solve(stiffness, mass).q[5]
    np.testing.assert_allclose(jax.jit(jax.jacfwd(of, (0, 1)))(5.0, 2.0), slopes, rtol=1e-10)
    np.testing.assert_allclose(jax.jit(jax.jacrev(of, (0, 1)))(5.0, 2.0), slopes, rtol=1e-10)


def test_equilibrium_of_known_numbers_has_derivatives_without_a_search_in_a_program(monkeypatch):
    """In forward and reverse mode, by a stiffness, a mass and a held coordinate; the search is in NumPy."""
    monkeypatch.setattr(equilibrium, "_balanced", None)
    system = cart()

    def end(x):
        changed = mb.with_parameters(system, {"spring.stiffness": x[0], "bob.mass": x[1]})
        return mb.equilibrium(changed, fix={"cart.x": x[2]}).q

    angle, stiff = bob_angle(5.0, 2.0), 5.0 - 2.0 * G * np.sin(bob_angle(5.0, 2.0))
    by_angle = np.array([-angle / stiff, -G * np.cos(angle) / stiff, 0.0])
    known = np.zeros((6, 3))
    known[3:] = np.outer([-np.sin(angle), np.cos(angle), 1.0], by_angle)
    known[[0, 3], 2] += 1.0
    x = jnp.array([5.0, 2.0, 0.3])
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(end)(x), known, rtol=0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["double_wishbone", "five_link"])
def test_equilibrium_of_a_machine_has_the_derivatives_of_a_program(name):
    """First and second ones, by all masses and stiffnesses together."""
    built = mechanisms.get(name)
    system, known = built.system, mb.parameters(built.system)
    names = [key for key in known if key.endswith(("mass", "stiffness"))]

    def end(x):
        changed = {key: known[key] * (1 + x * (k + 1) / len(names)) for k, key in enumerate(names)}
        state = mb.equilibrium(mb.with_parameters(system, changed), built.state)
        return jnp.sum(state.q * np.arange(1.0, system.nq + 1))

    np.testing.assert_allclose(jax.grad(end)(0.0), jax.jit(jax.grad(end))(0.0), rtol=1e-9)
    near, far = ((end(h) - end(-h)) / (2 * h) for h in (1e-3, 2e-3))
    np.testing.assert_allclose(jax.grad(end)(0.0), (4 * near - far) / 3, rtol=1e-5)
    slope = jax.grad(end)
    near, far = ((slope(h) - slope(-h)) / (2 * h) for h in (1e-3, 2e-3))
    np.testing.assert_allclose(jax.grad(slope)(0.0), (4 * near - far) / 3, rtol=1e-4)


@pytest.mark.slow
def test_equilibrium_in_a_batch_with_members_that_have_none():
    masses = jnp.array([2.0, jnp.nan, 3.0])
    solve = solver()
    angle_and_state = lambda mass: ((state := solve(5.0, mass)).q[5], state)
    (angles, states), slopes = jax.jit(jax.vmap(jax.value_and_grad(angle_and_state, has_aux=True)))(masses)
    expected = np.array([bob_angle(5.0, mass) for mass in masses[::2]])
    np.testing.assert_allclose(angles[::2], expected, rtol=1e-11)
    np.testing.assert_allclose(
        slopes[::2], -G * np.cos(expected) / (5.0 - masses[::2] * G * np.sin(expected)), rtol=1e-9
    )
    for values in jax.tree.leaves(states):
        np.testing.assert_array_equal(np.isnan(values).all(axis=1), [False, True, False])


@pytest.mark.slow
def test_equilibrium_is_searched_downwards():
    """From nearly upright to hanging, and not to the near equilibrium on top; also from a guess without forces."""
    system = mb.with_parameters(cart(), {"spring.stiffness": 0.0})
    near = mb.assemble(system, fix={"cart.x": -0.7, "bob.angle": 0.45 * np.pi})
    state = mb.equilibrium(system, near, fix={"cart.x": -0.7})
    np.testing.assert_allclose(state.q[:2], [-0.7, 0.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.sin(state.q[5]), -1.0, rtol=0, atol=1e-12)
    upright = mb.State(jnp.array([-0.7, 0.0, 0.0, -0.7, 1.0, 0.5 * np.pi]), jnp.zeros(6))
    hanging = lambda own: mb.equilibrium(own, upright, fix={"cart.x": -0.7})
    np.testing.assert_allclose(np.sin(hanging(system).q[5]), -1.0, rtol=0, atol=1e-12)
    # What is asked for is found, also from a guess beside it.
    asked = mb.equilibrium(system, near, fix={"cart.x": -0.7}, stable=False)
    np.testing.assert_allclose(asked.q[5], 0.5 * np.pi, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_equilibrium_derivatives_where_the_guess_was_left():
    system = mb.with_parameters(cart(), {"spring.free_angle": 0.5 * np.pi})
    upright = mb.State(jnp.array([-0.7, 0.0, 0.0, -0.7, 1.0, 0.5 * np.pi]), jnp.zeros(6))

    def lean(k, stable=True):
        own = mb.with_parameters(system, {"spring.stiffness": k})
        return mb.equilibrium(own, upright, fix={"cart.x": -0.7}, stable=stable, throw=False).q[5] - 0.5 * np.pi

    stiffness = jnp.array([8.0, 15.0, 30.0])
    tilt = np.asarray(jax.jit(jax.vmap(lean))(stiffness))
    np.testing.assert_allclose(stiffness * tilt, 2.0 * G * np.sin(tilt), rtol=0, atol=1e-10)
    assert np.all(np.abs(tilt[:2]) > 0.5) and abs(tilt[2]) < 1e-12
    expected = -tilt / (stiffness - 2.0 * G * np.cos(tilt))
    for derivative in (jax.jacfwd(lean), jax.jacrev(lean)):
        np.testing.assert_allclose(jax.jit(jax.vmap(derivative))(stiffness), expected, rtol=1e-9, atol=1e-12)
    # Upright, where the mass and the spring do not turn the bob whatever they are.
    asked = jax.jit(jax.value_and_grad(lambda k: lean(k, stable=False)))(15.0)
    np.testing.assert_allclose(asked, 0.0, rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def pushed():
    """A free body with a force `c − K x`, of any stiffness and constant."""
    law = lambda x, v, t, p: (p["c"] - p["K"] @ x[0])[None]
    numbers = {"K": np.zeros((3, 3)), "c": np.zeros(3)}
    body = planar.Body("body", mass=1.0, inertia=1.0)
    system = mb.Scene([body], forces=[mb.Force("push", "body", law, parameters=numbers)]).compile()
    return lambda K=((0.0,) * 3,) * 3, c=(0.0,) * 3: mb.with_parameters(
        system, {"push.K": np.array(K), "push.c": np.array(c)}
    )


def test_equilibrium_that_only_falls_is_told(pushed):
    """A spring of a coordinate that pushes away from its middle."""
    system = pushed(np.diag([-3.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match=r"not stable, which falls along body\.x .*stable=False"):
        mb.equilibrium(system)
    np.testing.assert_allclose(mb.equilibrium(system, stable=False).q, 0.0, rtol=0, atol=1e-12)


def test_equilibrium_of_forces_without_potential_that_lead_back_is_stable(pushed):
    """Of the stiffness ((1, 10), (0, 1)) the symmetric part is negative, but displacements die out."""
    system = pushed([[1.0, 10.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(mb.equilibrium(system).q, 0.0, rtol=0, atol=1e-9)


def test_equilibrium_names_what_nothing_balances(pushed):
    for c, message in (((0.0, -19.6, 0.0), r"body\.y \(-19\.6\)"), ((0.0, 0.0, 3.0), r"body\.angle \(3\)")):
        with pytest.raises(ValueError, match=f"No static equilibrium.*{message}"):
            mb.equilibrium(pushed(c=c))


def test_equilibrium_balances_applied_forces_by_those_of_rows():
    """A bar that hangs from its pin, whose force is the weight."""
    bar = planar.Body("bar", mass=2.0, inertia=0.1, position=(0.0, -0.5), angle=-np.pi / 2)
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    system = mb.Scene([bar], joints=[pin], forces=[mb.Gravity((0.0, -G))]).compile()
    balance = Balance(system, jnp.zeros(()), jnp.zeros(0), ())
    q, scale = system.guess.q, np.asarray(system.velocity_scale())

    @jax.jit
    def sums(multipliers):
        return balance.forces(q, 0 * multipliers), balance.of_rows(q, multipliers), balance.forces(q, multipliers)

    applied, _, _ = sums(np.ones(2))
    np.testing.assert_allclose(applied, scale * np.array([0.0, -2.0 * G, 0.0]), rtol=0, atol=1e-13)
    columns = np.stack([sums(unit)[1] for unit in np.eye(2)], axis=1)
    multipliers = np.linalg.lstsq(columns, scale * np.array([0.0, 2.0 * G, 0.0]))[0]
    np.testing.assert_allclose(sums(multipliers)[2], 0.0, atol=1e-13)


def test_equilibrium_of_a_bar_on_a_pin():
    """A spring turns it against its weight, to where moments balance: k angle = −m g l cos(angle)."""
    bar = planar.Body("bar", mass=2.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    spring = planar.TorsionalSpringDamper("spring", "ground", "bar", stiffness=20.0, free_angle=0.0)
    system = mb.Scene([bar], joints=[pin], forces=[spring, mb.Gravity((0.0, -G))]).compile()
    x, y, angle = np.asarray(mb.equilibrium(system).q)
    np.testing.assert_allclose([x, y], [0.5 * np.cos(angle), 0.5 * np.sin(angle)], rtol=0, atol=1e-12)
    np.testing.assert_allclose(20.0 * angle, -G * np.cos(angle), rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["parallelogram", "bricard"])
def test_equilibrium_of_redundant_joints(name):
    """The potential is least where nothing accelerates."""
    mechanism = mechanisms.get(name)
    system = mechanism.system
    state = mb.equilibrium(system, mechanism.state)
    assert balanced(system, state) <= 1e-8
    assert np.max(np.abs(system.coordinate_residual(0.0, state.q))) <= 1e-12
    energy = lambda q: system.potential_energy(0.0, q)
    assert energy(state.q) < energy(mechanism.state.q) - 1e-3


@pytest.mark.slow
def test_equilibrium_of_what_cannot_rest_is_refused():
    turn = lambda t, p: p["rate"] * t
    drive = planar.Driver("drive", "ground", "bob", quantity="angle", motion=turn, parameters={"rate": 1.0})
    pin = planar.Revolute("pin", "ground", "bob", point=(0.0, 0.0))
    driven = mb.Scene([planar.Body("bob", mass=1.0, inertia=1.0)], joints=[pin, drive]).compile()
    with pytest.raises(ValueError, match="velocity at this time"):
        mb.equilibrium(driven)
    with pytest.raises(ValueError, match=r"cart\.y"):
        mb.equilibrium(cart(), fix={"cart.y": 1.0})
    with pytest.raises(ValueError, match="Unknown coordinate"):
        mb.equilibrium(cart(), fix={"cart.z": 1.0})
    with pytest.raises(ValueError, match="ideal"):
        mb.equilibrium(mechanisms.get("rough_ring").system)


def hung_on_a_floor(*forces, stiffness=5.0):
    """A ball of radius 0.1 above a floor, on a spring to a point 1 m above it."""
    ball = planar.Body("ball", mass=1.0, inertia=0.1, position=(0.0, 1.0))
    floor = mb.RigidContact("floor", "ball", terrain=mb.terrain.Flat(), radius=0.1)
    spring = planar.SpringDamper("spring", "ground", "ball", stiffness=stiffness, free_length=0.0, point_a=(0.0, 1.0))
    return mb.Scene([ball], joints=[floor], forces=[spring, *forces]).compile()


@pytest.mark.slow
def test_equilibrium_holds_contacts():
    heavy = hung_on_a_floor(mb.Gravity((0.0, -G)))
    with pytest.raises(ValueError, match=r"floor is open and overlapped: .*fix=\{'floor.mode': 1\}"):
        mb.equilibrium(heavy)
    rests = mb.equilibrium(heavy, fix={"floor.mode": 1})
    np.testing.assert_allclose(rests.q[:3], [0.0, 0.1, 0.0], atol=1e-12)
    assert np.all(np.isnan(jax.jit(lambda: mb.equilibrium(heavy).q)()))
    # Hung high enough it does not touch.
    np.testing.assert_allclose(mb.equilibrium(hung_on_a_floor(mb.Gravity((0.0, -G)), stiffness=20.0)).q[1], 1 - G / 20)
    light = hung_on_a_floor()
    with pytest.raises(ValueError, match=r"floor would have to pull: .*fix=\{'floor.mode': 0\}"):
        mb.equilibrium(light, fix={"floor.mode": 1})
    np.testing.assert_allclose(mb.equilibrium(light, fix={"floor.mode": 0}).q[:3], [0.0, 1.0, 0.0], atol=1e-12)
    with pytest.raises(ValueError, match=r"'floor\.mode' is 1 to close the contact, or 0 to open it; got 0\.5"):
        mb.equilibrium(light, fix={"floor.mode": 0.5})


@pytest.mark.slow
def test_equilibrium_of_legs_that_share_a_weight():
    """Of four legs only the sum of the forces is known."""
    top = spatial.Body("top", mass=4.0, inertia=(1.0, 1.0, 1.0), position=(0.0, 0.0, 0.5))
    places = [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)]
    legs = [
        mb.RigidContact(f"leg{k}", "top", terrain=mb.terrain.Flat(), radius=0.0, centre=(*place, -0.5))
        for k, place in enumerate(places)
    ]
    table = mb.Scene([top], joints=legs, forces=[mb.Gravity((0.0, 0.0, -G))]).compile()
    rests = mb.equilibrium(table, fix={f"leg{k}.mode": 1 for k in range(4)})
    np.testing.assert_allclose(rests.q[2], 0.5, atol=1e-9)


def on_rope(slack=0.0, length=1.0):
    """A mass of 1 kg below the end of a rope of 10 kN/m; a length of None is that of the given pose."""
    bob = planar.PointMass("bob", mass=1.0, position=(0.0, slack - 1.0))
    rope = mb.Rope("rope", [("ground", (0.0, 0.0)), ("bob", (0.0, 0.0))], length=length, stiffness=1e4)
    return mb.Scene([bob], joints=[rope], forces=[mb.Gravity((0.0, -G))]).compile()


@pytest.mark.slow
def test_equilibrium_of_a_load_on_an_elastic_rope_from_any_slack():
    for slack, length in ((0.0, None), (1e-3, 1.0), (0.3, 1.0), (-1e-3, 1.0)):
        state = mb.equilibrium(on_rope(slack, length))
        np.testing.assert_allclose(state.q, [0.0, -1.0 - G / 1e4], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_equilibrium_derivatives_where_a_rope_just_tightens():
    system = on_rope(1e-3)
    height = lambda mass: mb.equilibrium(mb.with_parameters(system, {"bob.mass": mass})).q[1]
    masses = jnp.array([0.5, 1.0, 2.0])
    np.testing.assert_allclose(jax.jit(jax.vmap(height))(masses), -1.0 - masses * G / 1e4, rtol=0, atol=1e-12)
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(derivative(height))(1.0), -G / 1e4, rtol=1e-10)


@pytest.mark.slow
def test_equilibrium_of_equal_loads_on_a_rope_over_a_pulley():
    """They balance in a family of poses, which the search reaches up to rounding errors."""
    loads = [
        planar.PointMass(name, mass=1.0, position=at) for name, at in (("left", (-0.1, -1.0)), ("right", (0.1, -1.3)))
    ]
    over = mb.Pulley("ground", radius=0.1, turn="right", centre=(0.0, 0.0))
    rope = mb.Rope("rope", [("left", (0.0, 0.0)), over, ("right", (0.0, 0.0))], stiffness=1e4)
    system = mb.Scene(loads, joints=[rope], forces=[mb.Gravity((0.0, -G))]).compile()
    state = mb.equilibrium(system)
    stretch = G / 1e4
    np.testing.assert_allclose(state.q, [-0.1, -1.0 - stretch / 2, 0.1, -1.3 - stretch / 2], rtol=0, atol=1e-12)
