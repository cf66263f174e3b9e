"""Assembly without dense matrices against assembly with them, with derivatives; and from rough guesses."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.bodies.joint_graph import joint_order
from jaxmb.states import closest
from jaxmb.system.instant import Instant


def planar_tree(n=15, **options):
    """Rods on pins, two on the end of each."""
    ends, bodies, joints = {}, [], []
    for k in range(n):
        above = (k - 1) // 2
        start, angle = ((0.0, 0.0), -1.5) if k == 0 else (ends[above][0], ends[above][1] + (0.5 if k % 2 else -0.5))
        step = np.array([np.cos(angle), np.sin(angle)])
        bodies.append(planar.Body(f"rod{k}", mass=1.0, inertia=0.1, position=tuple(start + 0.5 * step), angle=angle))
        ends[k] = start + step, angle
        joints.append(planar.Revolute(f"pin{k}", "ground" if k == 0 else f"rod{above}", f"rod{k}", point=start))
    return mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, -9.81))], **options).compile()


def hanging_net(n=3, m=3):
    """Balls joined by rods without mass, and bodies on ball joints at a corner."""
    bodies = [spatial.PointMass(f"p{i}{j}", mass=1.0, position=(i, j, 0.0)) for i in range(n) for j in range(m)]
    rods = [((i, j), (i + 1, j)) for i in range(n - 1) for j in range(m)]
    rods += [((i, j), (i, j + 1)) for i in range(n) for j in range(m - 1)]
    name = lambda at: f"p{at[0]}{at[1]}"
    joints = [spatial.Distance(f"{name(a)}-{name(b)}", name(a), name(b), length=1.0) for a, b in rods]
    for k, at in enumerate([(0, 0), (n - 1, 0)]):
        body = spatial.Body(f"hook{k}", mass=2.0, inertia=(0.1, 0.2, 0.25), position=(*at, 0.5))
        bodies.append(body)
        joints += [
            spatial.Spherical(f"eye{k}", "ground", f"hook{k}", point=(*at, 1.0)),
            spatial.Spherical(f"end{k}", f"hook{k}", name(at), point=(*at, 0.0)),
        ]
    return mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, 0.0, -9.81))]).compile()


def held_in(system, names):
    held = np.zeros(system.nq, bool)
    for name in names:
        held[system.coordinate_names()[name]] = True
    return held


@pytest.mark.slow
@pytest.mark.parametrize(
    ("build", "names"),
    [
        (planar_tree, ["rod3.angle", "rod9.x"]),
        (hanging_net, ["p22.z", "hook1.orientation"]),
    ],
)
def test_closest_state_and_its_derivatives(build, names):
    system, rng = build(), np.random.default_rng(0)
    structured = dataclasses.replace(system, elimination=joint_order(system))
    held = held_in(system, names)
    fixed = system.held_velocities(held)
    shift = lambda size, n: jnp.asarray(size * rng.normal(size=n))
    guess = mb.State(system.guess.q + jnp.where(held, 0.1, 1.0) * shift(0.1, system.nq), shift(1.0, system.nu))
    guess = mb.State(system.normalize_fixed(guess.q, held)[0], guess.u)
    direction = jax.tree.map(lambda x: 1e-2 * x * shift(1.0, x.shape), structured)
    rank = system.coordinate_rank - system.normalize_fixed(guess.q, held)[1]

    def found(system, guess, in_blocks):
        q, ok = closest.closest_configuration(system, 0.0, guess.q, tuple(held.tolist()), rank, in_blocks)
        u, also = closest.closest_velocities(Instant(system, 0.0, q, guess.u), tuple(fixed.tolist()), in_blocks)
        return jnp.concatenate([q, u]), ok & also

    sparse, dense = functools.partial(found, in_blocks=True), functools.partial(found, in_blocks=False)

    along = mb.State(jnp.where(held, 0.0, shift(0.1, system.nq)), shift(0.1, system.nu))

    @jax.jit
    def evaluate(system, guess):
        push = lambda f: jax.jvp(lambda s, g: f(s, g)[0], (system, guess), (direction, along))
        weights = jnp.cos(jnp.arange(system.nq + system.nu, dtype=float))
        back = jax.grad(lambda s, g: weights @ sparse(s, g)[0], (0, 1))(system, guess)
        pulled = sum(map(jnp.vdot, jax.tree.leaves(back), jax.tree.leaves((direction, along))))
        return push(sparse), push(dense), pulled, weights, sparse(system, guess)[1] & dense(system, guess)[1]

    (result, dfound), (expected, dexpected), pulled, weights, ok = evaluate(structured, guess)
    assert ok
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-10)
    np.testing.assert_allclose(dfound, dexpected, rtol=0, atol=1e-8 * np.max(np.abs(dexpected)))
    np.testing.assert_allclose(pulled, weights @ dfound, rtol=1e-10)


@pytest.mark.slow
def test_assembly_from_rough_guesses():
    """A tree of many rods, every coordinate off by some tenths: a minimum at which every change is along the rods."""
    system, rng, size = planar_tree(150), np.random.default_rng(1), 0.4
    assert system.elimination is not None
    rough, along = size * jnp.asarray(rng.normal(size=(2, system.nq)))
    start = mb.State(system.guess.q + rough, system.guess.u)
    at = jax.jit(lambda h: mb.assemble(system, mb.State(start.q + h * along, start.u), throw=False).q)
    q = at(0.0)
    assert np.max(np.abs(system.position_residual(0.0, q))) <= 1e-12
    gradient = (q - start.q) / system.coordinate_scale() ** 2
    A = system.jacobian(0.0, q, start.u)
    across = gradient - A.T @ jnp.linalg.lstsq(A.T, gradient)[0]
    assert np.max(np.abs(across)) <= 1e-8 * np.max(np.abs(gradient))
    _, push = jax.jit(lambda h: jax.jvp(at, (h,), (1.0,)))(0.0)
    h = 1e-4
    np.testing.assert_allclose(push, (at(h) - at(-h)) / (2 * h), rtol=0, atol=1e-6 * np.max(np.abs(push)))


def test_assembly_keeps_poses_that_close():
    """The given poses of a machine that closes are its closest configuration; others are not."""
    system = mb.mechanisms.get("tree", n=5).system
    kept = mb.assemble(system)
    np.testing.assert_array_equal(kept.q, system.guess.q)
    q = np.asarray(system.guess.q)
    opened = np.asarray(mb.assemble(system, mb.State(q + 1e-9 * np.eye(q.size)[0], system.guess.u)).q)
    np.testing.assert_allclose(system.on_host(0.0).residual(opened), 0.0, rtol=0, atol=1e-14)
    assert 0 < np.max(np.abs(opened - q)) <= 1e-9


def test_assembly_of_a_body_that_is_far_from_where_it_belongs():
    """A bar of a metre, put many lengths from its pin: the closest place on the circle around it is found."""
    distance = 150.0
    bar = planar.Body("bar", mass=1.0, inertia=planar.rod(1.0, 1.0), position=(distance, 0.2), angle=0.3)
    pin = planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    system = mb.Scene([bar], joints=[pin]).compile()
    x, y, angle = np.asarray(mb.assemble(system).q)
    np.testing.assert_allclose((x, y), (0.5 * np.cos(angle), 0.5 * np.sin(angle)), atol=1e-12)
    # The gradient of the sum of squares along the circle, in units of the system's size and of radians.
    size = np.asarray(system.coordinate_scale())
    gradient = (x - distance) * -y / size[0] ** 2 + (y - 0.2) * x / size[1] ** 2 + (angle - 0.3) / size[2] ** 2
    np.testing.assert_allclose(gradient * size[0] ** 2 / distance, 0.0, atol=1e-10)


def slide_of(random):
    """A block on a slide through a random point, along a random direction."""
    angle, point = random.uniform(-np.pi, np.pi), random.normal(size=2)
    block = planar.Body("block", mass=1.0, inertia=0.1, position=point)
    axis = np.array([np.cos(angle), np.sin(angle)])
    slide = planar.Prismatic("slide", "ground", "block", point=point, axis=axis)
    return mb.Scene([block], joints=[slide]).compile(), point, axis


def test_assembly_far_on_a_slide():
    """Every place on a slide is a configuration, also far from where the block was given."""
    for seed in range(4):
        random = np.random.default_rng(seed)
        system, point, axis = slide_of(random)
        distance = random.choice([-1, 1]) * 10 ** random.uniform(0, 5)
        state = mb.assemble(system, fix={"slide.displacement": distance})
        np.testing.assert_allclose(state.q, [*(point + distance * axis), 0.0], atol=1e-9 * abs(distance))


@pytest.mark.slow
def test_assembly_far_away_under_jit_and_in_other_systems():
    """A slide under `jit` and `vmap` and with its derivative, a cylindrical joint, and a Lagrangian system."""
    system, point, axis = slide_of(np.random.default_rng(7))
    place = lambda d: mb.assemble(system, fix={"slide.displacement": d}).q
    far = jnp.array([1.0, -4e3, 1e6])
    expected = np.append(point, 0.0) + np.outer(far, np.append(axis, 0.0))
    np.testing.assert_allclose(jax.jit(jax.vmap(place))(far), expected, atol=1e-8, rtol=1e-12)
    np.testing.assert_allclose(jax.jacfwd(place)(4e3), np.append(axis, 0.0), atol=1e-9)
    body = spatial.Body("body", mass=1.0, inertia=np.eye(3))
    joint = spatial.Cylindrical("joint", "ground", "body", point=(0.0, 0.0, 0.0), axis=(0.0, 0.6, 0.8))
    turned = mb.assemble(
        mb.Scene([body], joints=[joint]).compile(), fix={"joint.displacement": 1e4, "joint.angle": 1.0}
    ).q
    np.testing.assert_allclose(turned[:3], [0.0, 6e3, 8e3], atol=1e-8)
    np.testing.assert_allclose(turned[3:], [np.cos(0.5), 0.0, 0.6 * np.sin(0.5), 0.8 * np.sin(0.5)], atol=1e-9)
    line = mb.lagrangian.Holonomic("line", lambda t, q, p: q[:1] - 2 * q[1:] - p["d"])
    free = mb.lagrangian.LagrangianSystem(
        lambda t, q, v, p: 0.5 * v @ v, q=[0.0, 0.0], constraints=[line], parameters={"d": 1.0}
    )
    q = mb.assemble(mb.with_parameters(free, {"d": 1e6})).q
    np.testing.assert_allclose(q, [2e5, -4e5], rtol=1e-12)
