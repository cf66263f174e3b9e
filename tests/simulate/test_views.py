"""Views of a motion: one program for all parts of a kind, none for other numbers, and impacts that happened only."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled
from trajectories import motion_of

import jaxmb as mb
from jaxmb import planar, spatial

LINKS, LENGTH, TIMES = 4, 0.5, np.linspace(0.0, 0.3, 4)
# Of the k-th link, with its joint and its frame, or of the whole motion.
VIEWS = {
    "body": lambda motion, k: (motion[f"link{k}"].position, motion[f"link{k}"].angular_velocity),
    "angle": lambda motion, k: motion[f"pin{k}"].angle,
    "rate": lambda motion, k: motion[f"pin{k}"].angle_rate,
    "acceleration": lambda motion, k: motion[f"pin{k}"].angle_acceleration,
    "frame": lambda motion, k: (motion[f"tip{k}"].position, motion[f"tip{k}"].velocity),
    "felt by a frame": lambda motion, k: motion[f"tip{k}"].specific_force,
    "reaction": lambda motion, k: (motion.reactions[f"pin{k}"].force, motion[f"pin{k}"].moment),
    "generalized force": lambda motion, k: motion.constraint_forces[f"pin{k}"],
    "force": lambda motion, k: motion.forces[f"motor{k}"],
    "energy": lambda motion, k: (motion.energy, motion.rates, motion.linear_momentum, motion.angular_momentum),
    "violation": lambda motion, k: motion.constraint_violation,
}


@pytest.fixture(scope="module")
def chain():
    """A chain of links with a motor and a frame each."""
    bodies, joints, forces, frames = [], [], [mb.Gravity((0.0, -9.81))], []
    for k in range(LINKS):
        bodies.append(planar.Body(f"link{k}", mass=1.0 + k, inertia=0.1, position=((k + 0.5) * LENGTH, 0.0)))
        before = f"link{k - 1}" if k else "ground"
        joints.append(planar.Revolute(f"pin{k}", before, f"link{k}", point=(k * LENGTH, 0.0)))
        forces.append(planar.Torque(f"motor{k}", body=f"link{k}", torque=0.3 * (k + 1)))
        frames.append(planar.Frame(f"tip{k}", f"link{k}", position=(0.1 * k, 0.2), angle=0.3))
    return mb.Scene(bodies, joints=joints, forces=forces, frames=frames).compile()


def moved(system, turn=0.0):
    """A motion of the chain: link k turns at the rate k + 1, from the angle `turn`."""
    angles = turn + TIMES[:, None] * np.arange(1.0, LINKS + 1)
    rates = np.broadcast_to(np.arange(1.0, LINKS + 1), angles.shape)
    along = LENGTH * np.stack([np.cos(angles), np.sin(angles)], axis=2)
    across = LENGTH * rates[..., None] * np.stack([-np.sin(angles), np.cos(angles)], axis=2)
    middle = lambda arms: np.cumsum(arms, axis=1) - arms / 2
    q = np.concatenate([middle(along), angles[..., None]], axis=2).reshape(len(TIMES), -1)
    u = np.concatenate([middle(across), rates[..., None]], axis=2).reshape(len(TIMES), -1)
    return motion_of(system, jnp.asarray(TIMES), jnp.asarray(q), jnp.asarray(u))


@pytest.mark.slow
def test_view_is_one_program_for_all_parts_of_its_kind_and_all_numbers(chain):
    motion, other = moved(chain), moved(mb.with_parameters(chain, {"link1.mass": 7.0, "motor2.torque": 1.5}), turn=0.4)
    for name, view in VIEWS.items():
        view(motion, 0)
        with compiled() as names:
            values = [view(motion, k) for k in range(1, LINKS)] + [view(other, k) for k in range(LINKS)]
        assert names == [], name
        assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(values)), name


def test_views_are_those_of_their_own_parts(chain):
    motion = moved(chain)
    angles = TIMES[:, None] * np.arange(1.0, LINKS + 1)
    for k in range(LINKS):
        np.testing.assert_allclose(motion[f"link{k}"].angle, angles[:, k], rtol=1e-15)
        between = angles[:, k] - (angles[:, k - 1] if k else 0.0)
        np.testing.assert_allclose(motion[f"pin{k}"].angle, between, rtol=0, atol=1e-14)
        np.testing.assert_allclose(motion[f"pin{k}"].angle_rate, 1.0, rtol=1e-14)
        np.testing.assert_allclose(motion.forces[f"motor{k}"][:, 1], [[0.0, 0.0, 0.3 * (k + 1)]] * 4, rtol=1e-15)
        turn, arm = angles[:, k], np.array([0.1 * k, 0.2])
        place = np.stack([arm @ [np.cos(turn), -np.sin(turn)], arm @ [np.sin(turn), np.cos(turn)]], axis=1)
        np.testing.assert_allclose(motion[f"tip{k}"].position, motion[f"link{k}"].position + place, rtol=0, atol=1e-14)
    # Each joint carries the links from its own on.
    accelerations = np.stack([motion.quantity(f"link{k}.acceleration") for k in range(LINKS)], axis=1)
    loads = (1.0 + np.arange(LINKS))[:, None] * (accelerations - np.array([0.0, -9.81]))
    for k in range(LINKS):
        np.testing.assert_allclose(motion.reactions[f"pin{k}"].force, loads[:, k:].sum(axis=1), rtol=1e-10, atol=1e-10)


@pytest.mark.slow
def test_views_of_a_batch_compile_once_and_are_those_of_its_members(chain):
    members = [moved(chain, turn) for turn in (0.0, 0.5, 1.0)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)
    for name in ("body", "angle", "acceleration", "frame", "reaction", "force"):
        VIEWS[name](batch, 0)
        with compiled() as names:
            found = VIEWS[name](batch, LINKS - 1)
        assert names == []
        alone = jax.tree.map(lambda *x: np.stack(x), *[VIEWS[name](member, LINKS - 1) for member in members])
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12), found, alone)


def test_views_in_functions_that_are_differentiated(chain):
    def seen(q):
        motion = motion_of(chain, jnp.asarray(TIMES), q, jnp.zeros_like(q))
        return motion["pin2"].angle[1] + motion["tip3"].position[2, 0] + motion["link1"].position[3, 1]

    q = moved(chain).ys.q
    forward, reverse = jax.jit(jax.jacfwd(seen))(q), jax.jit(jax.grad(seen))(q)
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=1e-15)
    expected = np.zeros(q.shape).reshape(len(TIMES), LINKS, 3)
    expected[1, 2, 2], expected[1, 1, 2], expected[3, 1, 1], expected[2, 3, 0] = 1.0, -1.0, 1.0, 1.0
    turn = 4.0 * TIMES[2]
    expected[2, 3, 2] = -0.3 * np.sin(turn) - 0.2 * np.cos(turn)
    np.testing.assert_allclose(forward, expected.reshape(q.shape), rtol=0, atol=1e-14)


def test_views_are_those_of_the_function_that_a_system_has():
    """Systems with equal names and numbers, and different functions of the user."""

    def system_of(size):
        pull = mb.Force("pull", "ball", lambda poses, velocities, t, p: jnp.full((1, 6), size))
        return mb.Scene([spatial.Body("ball", mass=1.0, inertia=(1.0, 1.0, 1.0))], forces=[pull]).compile()

    one, other, still = system_of(1.0), system_of(2.0), np.zeros((1, 6))
    for system, size in ((one, 1.0), (other, 2.0), (one, 1.0)):
        np.testing.assert_array_equal(
            motion_of(system, np.zeros(1), system.guess.q[None], still).forces["pull"][0, 0, :3], size
        )


@pytest.fixture(scope="module")
def bouncing():
    """A ball on a guide above a stop, and its motion from a height, with room for so many events."""
    ball = planar.Body("ball", mass=1.0, inertia=0.1, position=(0.0, 0.3))
    guide = planar.Prismatic("guide", "ground", "ball", point=(0.0, 0.0), axis=(0.0, 1.0))
    stop = mb.Stop("stop", "guide.displacement", lower=-1.0, restitution=0.7)
    system = mb.Scene([ball], joints=[guide, stop], forces=[mb.Gravity((0.0, -9.81))]).compile()

    def run(height, most=1024):
        start = mb.assemble(system, fix={"ball.y": height})
        return mb.simulate(system, start, t1=1.5, rtol=1e-6, max_events=most)

    return run


@pytest.mark.slow
def test_events_are_computed_once_and_as_far_as_they_happened(bouncing):
    few, motion, many = bouncing(0.3), bouncing(-0.6), bouncing(-0.6, 16384)
    assert few.events is few.events
    with compiled() as names:
        assert len(motion.events) > 8 > len(few.events)
        np.testing.assert_array_equal(many.events.times, motion.events.times)
        np.testing.assert_array_equal(many.events.impulses, motion.events.impulses)
    assert names == []
    # The first fall, and the velocity at its end.
    fall = np.sqrt(2 * 1.0 / 9.81)
    np.testing.assert_allclose(few.events.times[0], fall, rtol=1e-6)
    np.testing.assert_allclose(few.events.impulses[0, 0], 1.7 * 9.81 * fall, rtol=1e-6)


@pytest.mark.slow
def test_events_of_a_batch_are_those_of_its_members(bouncing):
    members = [bouncing(height, 64) for height in (0.3, -0.3, -0.6)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *members).events
    assert batch.times.shape == (3, 64) and batch.impulses.shape == (3, 64, 1)
    for k, member in enumerate(members):
        happened = np.isfinite(batch.times[k])
        np.testing.assert_allclose(batch.times[k][happened], member.events.times, rtol=1e-12)
        np.testing.assert_allclose(batch.impulses[k][happened], member.events.impulses, rtol=1e-12)
        np.testing.assert_array_equal(batch.impulses[k][~happened], 0.0)
    # In a function that is traced: as its argument, and as a number.
    inside = jax.jit(lambda motion: motion.events.times)(members[1])
    np.testing.assert_allclose(inside[np.isfinite(inside)], members[1].events.times, rtol=1e-12)
    apart = bouncing(-0.3, 64)
    np.testing.assert_array_equal(jax.jit(lambda x: x + apart.events.times)(0.0), members[1].events.times)
    np.testing.assert_array_equal(apart.events.times, members[1].events.times)
