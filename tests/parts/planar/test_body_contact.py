"""Contact between bodies: against closed forms, against contact with terrain, and at the ends of plates."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly

import jaxmb as mb
from jaxmb import planar
from jaxmb.parts import contact, terrain
from jaxmb.parts.planar.kinematics import PLANE

LAWS = {
    "normal": contact.Linear(4e4),
    "friction": contact.Coulomb(0.6, transition_speed=0.2),
    "damping": 300.0,
    "smoothing": 1e-3,
}
SHARP = {"normal": contact.Linear(4e4), "smoothing": 1e-9}


def plate(bodies=("disc", "plate"), **options):
    return planar.PlateContact("touch", bodies, radius=0.2, **({"start": (-1.0, 0.0), "end": (1.0, 0.0)} | options))


ROOF = np.array([[-1.0, -0.5], [0.0, 0.0], [1.0, -0.5]])


def roof(edge=0.1, **options):
    """Two sides and a base, a closed chain, each of its own body; the disc comes from above."""
    corners = {"start": ROOF, "end": np.roll(ROOF, -1, axis=0)}
    return planar.PlateContact("touch", ("disc", "left", "right", "base"), radius=0.2, edge=edge, **corners, **options)


def states(rng, k):
    return jnp.asarray(rng.normal(size=(k, 3)))


@pytest.mark.slow
def test_a_plate_in_the_ground_is_a_slope_of_terrain():
    """And from below as from above."""
    pose, velocity = jnp.array([[0.3, 0.1, 0.7]]), jnp.array([[1.0, -0.5, 2.0]])
    slope = planar.Contact("soil", "disc", terrain=terrain.Slope(0.2), radius=0.2, **LAWS).resolve(PLANE, pose)
    expected = slope.wrenches(PLANE, pose, velocity, 0.0)[0]
    both, still = jnp.concatenate([pose, jnp.zeros((1, 3))]), jnp.zeros((1, 3))
    for ends in ({"start": (-5.0, -1.0), "end": (5.0, 1.0)}, {"start": (5.0, 1.0), "end": (-5.0, -1.0)}):
        part = plate(**ends, **LAWS).resolve(PLANE, both)
        found = part.wrenches(PLANE, both, jnp.concatenate([velocity, still]), 0.0)
        np.testing.assert_allclose(found[0], expected, rtol=1e-12)
        np.testing.assert_allclose(part.energy(PLANE, both, 0.0), slope.energy(PLANE, pose, 0.0), rtol=1e-12)


def test_energy_fades_at_both_ends_of_a_plate():
    """From all of it inside to none behind the ends, and half of it at the ends."""
    part = plate(edge=0.1, **SHARP).resolve(PLANE, np.zeros((2, 3)))
    poses = np.zeros((9, 2, 3))
    poses[:, 0, 0] = -1.3, -1.1, -1.0, -0.9, 0.0, 0.9, 1.0, 1.1, 1.3
    poses[:, 0, 1] = 0.15
    energies = jax.jit(jax.vmap(lambda q: part.energy(PLANE, q, 0.0)))(poses)
    whole = 0.5 * 4e4 * 0.05**2
    np.testing.assert_allclose(energies, whole * np.array([0, 0, 0.5, 1, 1, 1, 0.5, 0, 0]), rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_plates_in_line_bear_as_one():
    """Wherever a disc is, and whichever body they are of: its wrench is that of one long plate."""
    ends = np.array([-1.0, -0.2, 0.3, 1.0])
    names = ("disc", "first", "second", "third")
    three = planar.PlateContact(
        "three",
        names,
        radius=0.2,
        start=np.stack([ends[:-1], np.zeros(3)], axis=1),
        end=np.stack([ends[1:], np.zeros(3)], axis=1),
        edge=0.25,
        **LAWS,
    )
    one = plate(edge=0.25, **LAWS)
    own = [part.resolve(PLANE, np.zeros((k, 3))) for part, k in ((three, 4), (one, 2))]
    moving, still = jnp.array([1.0, -0.3, 2.0]), jnp.zeros((4, 3))

    @jax.jit
    @jax.vmap
    def wrenches(place):
        poses, velocities = still.at[0].set(place), still.at[0].set(moving)
        return [part.wrenches(PLANE, poses[: len(part.bodies)], velocities[: len(part.bodies)], 0.0) for part in own]

    places = [(x, y, 0.4) for x in np.linspace(-0.7, 0.7, 15) for y in (0.19, 0.1, -0.15)]
    found, expected = wrenches(jnp.array(places))
    assert np.all(np.abs(expected[:, 0, 1]) > 100.0)
    np.testing.assert_allclose(found[:, 0], expected[:, 0], rtol=0, atol=1e-9 * 4e4)
    np.testing.assert_allclose(jnp.sum(found[:, 1:], axis=1), expected[:, 1], rtol=0, atol=1e-9 * 4e4)


@pytest.mark.slow
def test_the_force_is_twice_differentiable_over_the_end_of_a_plate():
    part = plate(edge=0.1, **LAWS).resolve(PLANE, jnp.zeros((2, 3)))
    force = lambda x: part.wrenches(PLANE, jnp.zeros((2, 3)).at[0, 0].set(x).at[0, 1].set(0.15), jnp.ones((2, 3)), 0.0)
    x = jnp.linspace(0.85, 1.15, 2001)
    value, slope, curvature = (jax.jit(jax.vmap(f))(x) for f in (force, jax.jacfwd(force), jax.hessian(force)))
    assert np.all(np.asarray(value)[-300:] == 0.0)
    h = float(x[1] - x[0])
    # Jumps would show as differences that do not become small with the distance.
    assert np.max(np.abs(np.diff(value, axis=0))) <= 1.1 * h * np.max(np.abs(slope))
    assert np.max(np.abs(np.diff(slope, axis=0))) <= 1.1 * h * np.max(np.abs(curvature))


def collision(part, place, velocity=(0.0, -3.0)):
    """Disc of 2 kg and targets of 5 kg, without weight; the disc comes down."""
    disc = planar.Body("disc", mass=2.0, inertia=0.04, position=place, velocity=velocity)
    others = [planar.Body(name, mass=5.0, inertia=0.5) for name in part.bodies[1:]]
    return mb.Scene([disc, *others], forces=[part]).compile()


@pytest.mark.slow
def test_derivatives_of_an_oblique_collision_with_friction():
    """On a corner of a chain: forward mode, reverse mode and differences, under `jit` and `vmap`."""
    part = roof(edge=0.15, chain=True, **(LAWS | {"smoothing": 5e-3}))
    system = collision(part, (0.04, 0.35), (1.0, -3.0))
    names = ("touch.normal.stiffness", "touch.radius", "touch.friction.coefficient", "disc.mass")
    start = jnp.stack([mb.parameters(system)[name] for name in names])

    def end(share, dt):
        """At steps that do not depend on anything."""
        own = mb.with_parameters(system, dict(zip(names, start * (1.0 + share), strict=True)))
        steps = {"solver": diffrax.Dopri8(), "stepsize_controller": diffrax.ConstantStepSize(), "dt0": dt}
        y = mb.simulate(own, system.guess, t1=0.1, max_steps=1024, **steps).ys
        last = jnp.concatenate([y.q[-1], y.u[-1]])
        return jnp.cos(jnp.arange(float(last.size))) @ last

    still, unit = jnp.zeros(4), jnp.eye(4)
    along = lambda s, d, dt: jax.jvp(lambda s: end(s, dt), (s,), (d,))
    forward = jit_quickly(jax.vmap(along, (0, 0, None)))
    _, found = forward(jnp.zeros((4, 4)), unit, 2e-4)
    reverse = jit_quickly(jax.grad(lambda s: end(s, 2e-4)))(still)
    h = 1e-3
    value = lambda k: np.asarray(forward(k * h * unit, unit, 1e-4)[0])
    difference = (8 * (value(1) - value(-1)) - (value(2) - value(-2))) / (12 * h)
    assert np.all(np.abs(found) > 1e-3)
    np.testing.assert_allclose(reverse, found, rtol=1e-9)
    np.testing.assert_allclose(found, difference, rtol=1e-5)


@pytest.mark.parametrize(
    "part, message",
    [
        (lambda: plate(("disc",), **SHARP), "the disc's body and then at least one other"),
        (lambda: plate(edge=1.1, **SHARP), "edge must be at most half as long as a plate, got 1.1 m, with 2 m"),
        (lambda: plate(start=(1.0, 0.0), **SHARP), "with 0 m from start to end"),
        (lambda: plate(start=(0.0, 0.0, 0.0), **SHARP), r"start must have shape \(2,\) or \(1, 2\), got \(3,\)"),
        (lambda: plate(normal=3.0), "normal must be a law from jaxmb.contact"),
        (
            lambda: planar.DiscContact("touch", ("a", "b", "c"), radius=0.1, radii=(1.0, 1.0, 1.0), **SHARP),
            r"radii must have shape \(\) or \(2,\), got \(3,\)",
        ),
        (
            lambda: planar.DiscContact("touch", ("a", "b"), radius=0.1, radii=-1.0, **SHARP),
            "radii must be non-negative",
        ),
    ],
)
def test_what_cannot_touch_is_refused(part, message):
    with pytest.raises(ValueError, match=f"'touch': .*{message}"):
        own = part()
        own.resolve(PLANE, jnp.zeros((len(own.bodies), 3)))


@pytest.mark.slow
def test_the_corners_of_a_chain_bear():
    """On the ridge of a roof a disc rests as on a point; no side alone bears it there."""
    poses = jnp.zeros((4, 3)).at[0, 1].set(0.19)
    on_disc = lambda part: part.resolve(PLANE, poses).wrenches(PLANE, poses, jnp.zeros((4, 3)), 0.0)[0]
    np.testing.assert_allclose(on_disc(roof(edge=0.05, chain=True, **SHARP)), [0.0, 4e4 * 0.01, 0.0], atol=1e-6)
    np.testing.assert_allclose(on_disc(roof(edge=0.05, **SHARP)), 0.0, atol=1e-6)
    # On a side, away from its ends, the chain makes no difference.
    poses = poses.at[0, :2].set(jnp.array([0.5, -0.25]) + 0.19 * jnp.array([1.0, 2.0]) / np.sqrt(5.0))
    np.testing.assert_allclose(on_disc(roof(chain=True, **LAWS)), on_disc(roof(**LAWS)), rtol=1e-12)


@pytest.mark.slow
def test_forces_at_corners_follow_from_the_energy_and_balance():
    """Also where the plates are not quite joined; and those of friction and damping balance, too, and take energy."""
    rng, still = np.random.default_rng(3), jnp.zeros((4, 3))
    places = jnp.asarray([(x, y, 0.3) for x in (-0.08, -0.02, 0.0, 0.03, 0.09) for y in (0.1, 0.13, 0.16)])
    poses = jnp.zeros((len(places), 4, 3)).at[:, 0].set(places)
    poses = poses.at[:, 1:].add(0.01 * jnp.asarray(rng.normal(size=(len(places), 3, 3))))
    velocities = jnp.asarray(rng.normal(size=poses.shape))
    laws = (SHARP | {"smoothing": 1e-3}, LAWS)
    elastic, losing = (roof(chain=True, **own).resolve(PLANE, still) for own in laws)

    @jax.jit
    @jax.vmap
    def found(poses, velocities):
        falls = -jax.grad(lambda poses: elastic.energy(PLANE, poses, 0.0))(poses)
        return elastic.wrenches(PLANE, poses, still, 0.0), falls, losing.wrenches(PLANE, poses, velocities, 0.0)

    pushes, falls, losses = map(np.asarray, found(poses, velocities))
    assert np.all(np.abs(pushes[:, 0, 1]) > 10.0)
    np.testing.assert_allclose(pushes, falls, rtol=0, atol=1e-9 * 4e4)
    for wrenches in (pushes, losses):
        moment = poses[:, :, 0] * wrenches[:, :, 1] - poses[:, :, 1] * wrenches[:, :, 0] + wrenches[:, :, 2]
        np.testing.assert_allclose(np.sum(wrenches[:, :, :2], axis=1), 0.0, atol=1e-9 * 4e4)
        np.testing.assert_allclose(np.sum(moment, axis=1), 0.0, atol=1e-9 * 4e4)
    assert np.all(np.sum((losses - pushes) * velocities, axis=(1, 2)) < 0.0)


def test_what_is_no_chain_is_refused():
    with pytest.raises(ValueError, match="closed chain has at least three plates, got 1"):
        collision(plate(chain=True, **LAWS), (0.0, 0.25))
    corners = {"start": ROOF, "end": np.roll(ROOF, 1, axis=0)}
    backwards = planar.PlateContact("touch", ("disc", "a", "b", "c"), radius=0.2, chain=True, **corners, **SHARP)
    with pytest.raises(
        ValueError, match=r"'touch': .* the plate of 'c' begins 2 m from the end of the plate of 'b'; join them"
    ):
        backwards.resolve(PLANE, jnp.zeros((4, 3)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        ("ball", "box", "box"),
        pytest.param(("ball", "box", "lid"), marks=pytest.mark.slow),
        pytest.param(("ball", "box", "ground"), marks=pytest.mark.slow),
    ],
)
def test_several_plates_of_one_body_bear_as_one_contact_each(names):
    """Named for each of them, or by its frames; and the ground beside it."""
    ball = planar.Body("ball", mass=1.0, inertia=0.01, position=(0.91, 0.095), velocity=(0.1, -0.3))
    box = planar.Body("box", mass=1.0, inertia=0.1, angular_velocity=-0.3)
    plates = [{"start": (-1.0, 0.0), "end": (1.0, 0.0)}, {"start": (1.0, -0.2), "end": (1.0, 1.0)}]
    both = {key: [own[key] for own in plates] for key in ("start", "end")}
    laws = {"radius": 0.1, **LAWS}
    single = [
        planar.PlateContact(f"touch {k}", ("ball", name), **laws, **own)
        for k, (name, own) in enumerate(zip(names[1:], plates, strict=True))
    ]
    lid = planar.Frame("lid", "box")
    found, expected = (
        jax.jit(lambda q, u, system=system: (udot(system, q, u), system.potential_energy(0.0, q)))(*start)
        for forces in ([planar.PlateContact("touch", names, **laws, **both)], single)
        for system in [mb.Scene([box, ball], forces=forces, frames=[lid]).compile()]
        for start in [(system.guess.q, system.guess.u)]
    )
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-12)
    assert abs(float(found[0][-1])) > 1.0


def udot(system, q, u):
    return mb.formulations.accelerations(system, mb.formulations.Multipliers(), 0.0, q, u)[0]


def test_a_disc_and_a_plate_of_one_body():
    """Touch each other nowhere, whatever other bodies there are."""
    bodies = [planar.Body(name, mass=1.0, inertia=0.1, position=(k, 0.0)) for k, name in enumerate(("ball", "box"))]
    both = {"start": [(-1.0, 0.0)] * 2, "end": [(1.0, 0.0)] * 2}
    for names in (("ball", "ball", "box"), ("ball", "box", "ball")):
        part = planar.PlateContact("touch", names, radius=0.1, **SHARP, **both)
        with pytest.raises(ValueError, match="PlateContact 'touch' connects 'ball' with itself"):
            mb.Scene(bodies, forces=[part]).compile()


def test_plates_are_drawn_from_start_to_end():
    ends = {"start": [(0.0, 0.1), (1.0, 0.0), (0.0, 0.0)], "end": [(0.6, 0.9), (-1.0, 0.0), (0.0, 3.0)]}
    part = plate(["a", "b", "b", "c"], **ends, **SHARP).resolve(PLANE, np.zeros((4, 3)))
    plates = [(k, shape) for k, shape in part.shapes(PLANE, 0.01) if k > 0]
    assert [k for k, _ in plates] == [1, 2, 3]
    for (_, shape), start, end in zip(plates, *ends.values(), strict=True):
        e0, _, _, e3 = shape.orientation
        direction = np.array([e0**2 - e3**2, 2 * e0 * e3])
        np.testing.assert_allclose(shape.scale[0] * direction, np.subtract(end, start), atol=1e-12)
        np.testing.assert_allclose(shape.position[:2], np.add(start, end) / 2)
    assert all(k == 0 for k, _ in roof(**SHARP, chain=True).resolve(PLANE, np.zeros((4, 3))).shapes(PLANE, 0.01))
