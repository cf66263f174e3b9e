"""Bodies with modal coordinates move as rigid bodies that slide in each other, and by Lagrange's equations."""

import contextlib
import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flexible_bodies import AXIS, OnSlide, PlanarSlider, as_flexible, planar_pendulum, spatial_loop
from precision import single_precision

import jaxmb as mb
from jaxmb import parts, planar, spatial
from jaxmb.bodies.joint_graph import joint_order
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.system.quantities import Solved

MOST_PROGRAMS = 190

TIP = spatial.Frame("tip", "bob", position=(0.1, 0.0, -0.05), orientation=mb.rotations.from_axis_angle(AXIS, 0.7))


def law(t, measured, states, numbers):
    return numbers["gain"] * measured["along"][0] + 0.1 * measured["turning"][1], {}


ON_TIP = (
    spatial.SpringDamper(
        "rope",
        "ground",
        "tip",
        stiffness=25.0,
        damping=2.0,
        free_length=0.3,
        point_a=(0.9, 0.2, 1.0),
        point_b=(0.0, 0.1, 0.0),
    ),
    spatial.Friction("rubbing", "C", coefficient=0.3, radius=0.05, transition_speed=0.1),
    mb.Controller(
        "drive",
        law,
        {"along": "tip.velocity", "turning": "tip.angular_velocity"},
        "A.angle",
        parameters={"gain": -0.2},
    ),
)
# Quantities that both loops have.
FEW = ("C.force", "C.moment", "tip.acceleration", "tip.angular_acceleration")
NAMES = (
    *(f"{joint}.{field}" for joint in "ABCD" for field in ("force", "moment")),
    *(f"{name}.{field}" for name in ("bob", "tip") for field in ("position", "velocity", "acceleration")),
    "tip.angular_acceleration",
    "tip.specific_force",
    "C.angle_a",
)


def loops(forces):
    return tuple(spatial_loop(flexible, frames=[TIP], forces=forces).compile() for flexible in (True, False))


def states(rigid):
    """Three states of both loops."""
    out = []
    for angle, slide, rates in ((0.02, 0.02, (1.0, 0.5)), (0.1, 0.01, (-2.0, 0.8)), (-0.05, 0.03, (3.0, -1.0))):
        fix = {"A.angle": angle, "guide.displacement": slide}
        state = mb.assemble(rigid, fix=fix, rates=dict(zip(fix, rates, strict=True)))
        out.append((as_flexible(rigid, state, slide, rates[1]), state))
    return tuple(jax.tree.map(lambda *x: np.stack(x), *of_system) for of_system in zip(*out, strict=True))


@functools.partial(jax.jit, static_argnames="names")
def told(system, ys, names=()):
    """Accelerations, energies and momenta at states, and quantities by name."""
    ts = jnp.zeros(len(ys.q))
    solved = Solved(*jax.vmap(lambda t, y: accelerations(system, Multipliers(), t, y.q, y.u))(ts, ys))
    out = {name: system.quantities()[name].value(ts, ys, solved) for name in names}
    single = lambda y: {
        "kinetic": system.kinetic_energy(0.0, y.q, y.u),
        "potential": system.potential_energy(0.0, y.q),
        "momentum": system.linear_momentum(y.q, y.u),
        "moment": system.angular_momentum(y.q, y.u),
        "unmet": system.velocity_residual(0.0, y.q, y.u),
    }
    return out | jax.vmap(single)(ys) | {"accelerations": solved.accelerations}


def compare(flexible, rigid, shared, slide, atol):
    """Everything that both tell."""
    for name in rigid:
        if name not in ("accelerations", "unmet"):
            np.testing.assert_allclose(flexible[name], rigid[name], rtol=0, atol=atol, err_msg=name)
    np.testing.assert_allclose(flexible["accelerations"][:, :shared], rigid["accelerations"][:, :shared], atol=atol)
    np.testing.assert_allclose(flexible["accelerations"][:, shared], slide, rtol=0, atol=atol)
    assert np.max(np.abs(flexible["unmet"])) < 1e-12


@pytest.mark.parametrize(
    "forces", [pytest.param(ON_TIP[:1], id="sprung"), pytest.param(ON_TIP, id="rubbing", marks=pytest.mark.slow)]
)
def test_flexible_body_in_a_loop_is_two_rigid_bodies(forces):
    """With a spring and a sensor, friction and a controller, on frames that move with its mode; by a full matrix, and
    with friction in blocks.
    """
    flexible, rigid = loops(forces)
    names = NAMES if len(forces) > 1 else FEW
    if len(forces) > 1:
        flexible = dataclasses.replace(flexible, elimination=joint_order(flexible))
    of_flexible, of_rigid = states(rigid)
    expected = told(rigid, of_rigid, (*names, "guide.displacement_acceleration"))
    slide = expected.pop("guide.displacement_acceleration")
    compare(told(flexible, of_flexible, names), expected, 18, slide, 1e-10)


def test_flexible_body_in_a_plane_moves_by_lagrange():
    """At states of a pendulum, with accelerations of a LagrangianSystem in its angle and its slide."""
    system = planar_pendulum(True).compile()

    def places(q):
        down = jnp.stack([jnp.sin(q[0]), -jnp.cos(q[0])])
        centre = 0.2 * down
        return centre, centre + q[1] * jnp.stack([jnp.cos(q[0]), jnp.sin(q[0])])

    def kinetic(t, q, v, p):
        (_, _), (centre, bob) = jax.jvp(places, (q,), (v,))
        return 0.35 * centre @ centre + 0.05 * v[0] ** 2 + 0.15 * bob @ bob

    def potential(t, q, p):
        centre, bob = places(q)
        stretch = mb.rotations.norm(bob - jnp.array([0.5, -0.5])) - 0.5
        return 9.81 * (0.7 * centre[1] + 0.3 * bob[1]) + 25.0 * q[1] ** 2 + 10.0 * stretch**2

    damping = lambda t, q, v, p: jnp.stack([jnp.zeros_like(v[1]), -0.4 * v[1]])
    oracle = mb.lagrangian.LagrangianSystem(kinetic=kinetic, potential=potential, force=damping, q=[0.0, 0.0])
    x = np.random.default_rng(0).normal(size=(5, 4)) * [1.0, 0.1, 2.0, 1.0]
    angle, slide, turning, sliding = x.T
    q = np.stack([0.2 * np.sin(angle), -0.2 * np.cos(angle), angle, slide], axis=1)
    u = np.stack([0.2 * np.cos(angle) * turning, 0.2 * np.sin(angle) * turning, turning, sliding], axis=1)

    @jax.jit
    def both(x, q, u):
        solve = lambda system, q, u: accelerations(system, Multipliers(), 0.0, q, u)[0]
        expected = jax.vmap(functools.partial(solve, oracle))(x[:, :2], x[:, 2:])
        lagrange = jax.vmap(lambda q, v: kinetic(0.0, q, v, {}) + potential(0.0, q, {}))(x[:, :2], x[:, 2:])
        energy = jax.vmap(lambda q, u: system.kinetic_energy(0.0, q, u) + system.potential_energy(0.0, q))(q, u)
        return jax.vmap(functools.partial(solve, system))(q, u), expected, energy, lagrange

    found, expected, energy, lagrange = both(x, q, u)
    np.testing.assert_allclose(found[:, 2:], expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(energy, lagrange, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_flexible_bodies_in_a_chain_are_eliminated_in_blocks():
    """Twelve links, each hung on the bob of the one before: as by a full matrix."""
    links = [
        PlanarSlider(f"{k}", mass=1.0, inertia=0.1, bob=0.3, stiffness=50.0 + k, position=(0.0, -0.2 - 0.4 * k))
        for k in range(16)
    ]
    frames = [OnSlide(f"bob{k}", f"{k}") for k in range(16)]
    hung = lambda k: "ground" if k == 0 else f"bob{k - 1}"
    pins = [planar.Revolute(f"pin{k}", hung(k), f"{k}", point=(0.0, -0.4 * k)) for k in range(16)]
    system = mb.Scene(links, joints=pins, forces=[mb.Gravity((0.0, -9.81))], frames=frames).compile()
    assert system.elimination is not None
    rng = np.random.default_rng(0)
    state = mb.State(np.asarray(system.guess.q), 0.3 * rng.normal(size=system.nu))
    dense = dataclasses.replace(system, elimination=None)

    @jax.jit
    def both(q, u):
        return [accelerations(s, Multipliers(), 0.0, q, u) for s in (system, dense)]

    (found, forces), (expected, of_dense) = both(state.q, state.u)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(forces, of_dense, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_flexible_motion_is_that_of_two_rigid_bodies():
    """The place of a frame, and its derivatives by stiffness, damping and places."""
    flexible, rigid = loops(())
    fix = {"A.angle": 0.02, "guide.displacement": 0.02}
    start = mb.assemble(rigid, fix=fix, rates={"A.angle": 1.0, "guide.displacement": 0.5})
    check_gradients(
        (flexible, as_flexible(rigid, start, 0.02, 0.5)),
        (rigid, start),
        lambda motion: motion["tip"].position[-1] @ jnp.array([1.0, 2.0, 3.0]),
        {"tie.point_b": np.array([0.02, 0.03, 0.01]), "tip.position": np.array([0.1, 0.0, -0.05])},
        {"t1": 0.4, "rtol": 1e-11},
    )


@pytest.mark.slow
def test_flexible_motion_by_an_implicit_method():
    flexible, rigid = (planar_pendulum(is_flexible).compile() for is_flexible in (True, False))
    start = mb.assemble(rigid, fix={"guide.displacement": 0.05}, rates={"pin.angle": 1.0, "guide.displacement": 0.0})
    check_gradients(
        (flexible, as_flexible(rigid, start, 0.05, 0.0)),
        (rigid, start),
        lambda motion: motion["pin"].angle[-1],
        {"tie.point_a": np.array([0.5, -0.5])},
        {"t1": 0.3, "rtol": 1e-9, "solver": mb.solvers.Hermite()},
    )


def check_gradients(flexible, rigid, measure, shared, options):
    """Ends of motions of a flexible system and a rigid one, each with its state, and their derivatives."""

    def end(system, state, p):
        return measure(mb.simulate(mb.with_parameters(system, p), state, **options))

    numbers = lambda at, spring: shared | {f"{at}.stiffness": spring, f"{at}.damping": 0.4}
    spring = float(mb.parameters(flexible[0])["box.stiffness"])
    value, gradient = jax.value_and_grad(lambda p: end(*flexible, p))(numbers("box", spring))
    expected, of_rigid = jax.value_and_grad(lambda p: end(*rigid, p))(numbers("spring", spring))
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-8)
    of_rigid = {name.replace("spring.", "box."): x for name, x in of_rigid.items()}
    for name, x in gradient.items():
        np.testing.assert_allclose(x, of_rigid[name], rtol=1e-6, atol=1e-8, err_msg=name)
    along = jax.jvp(lambda k: end(*flexible, {"box.stiffness": k}), (spring,), (1.0,))[1]
    np.testing.assert_allclose(along, gradient["box.stiffness"], rtol=1e-6)


@pytest.mark.slow
def test_flexible_body_has_loads_statics_and_modes():
    """Loads balance; equilibrium and eigenvalues are those of two rigid bodies."""
    flexible, rigid = (planar_pendulum(is_flexible).compile() for is_flexible in (True, False))
    motion = mb.simulate(flexible, mb.assemble(flexible, fix={"box.slide": 0.05}), t1=0.3)
    loads = mb.loads(motion, "box")
    for x in loads.balance:
        np.testing.assert_allclose(x, 0.0, atol=1e-9)
    np.testing.assert_allclose(loads["tie"].point[:, 0], motion.quantity("box.slide"), atol=1e-12)
    at_rest, of_rigid = (mb.equilibrium(system) for system in (flexible, rigid))
    np.testing.assert_allclose(at_rest.q[:3], of_rigid.q[:3], atol=1e-9)
    values = [np.sort_complex(mb.linearise(s, y).eigenvalues) for s, y in ((flexible, at_rest), (rigid, of_rigid))]
    np.testing.assert_allclose(*values, atol=1e-7)


@pytest.mark.slow
def test_flexible_body_strikes_and_rubs_with_its_bob():
    """Impacts, and dry friction, on a frame that moves with its mode."""
    floor = mb.RigidContact("floor", "bob", terrain=mb.terrain.Flat(-0.26), radius=0.05, restitution=0.6)
    rub = mb.DryFriction("rub", "floor", coefficient=0.3)
    ends = []
    for is_flexible in (True, False):
        system = planar_pendulum(is_flexible, joints=[floor], forces=[rub]).compile()
        slide = "box.slide" if is_flexible else "guide.displacement"
        start = mb.assemble(system, fix={slide: 0.1, "box.angle": 0.3}, rates={slide: 0.0, "box.angle_rate": -2.0})
        motion = mb.simulate(system, start, t1=0.8, rtol=1e-11)
        ends.append((motion.events.times, motion["pin"].angle, motion.quantity(slide)))
    assert np.sum(np.isfinite(ends[0][0])) > 0
    for x, y in zip(*ends, strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_flexible_bodies_in_a_batch():
    system = planar_pendulum(True).compile()
    start = mb.assemble(system, fix={"box.slide": 0.05})
    stiffness = jnp.array([30.0, 50.0, 90.0])
    end = lambda k: mb.simulate(mb.with_parameters(system, {"box.stiffness": k}), start, t1=0.2, rtol=1e-10).ys.q[-1]
    alone = np.stack([end(k) for k in stiffness])
    np.testing.assert_allclose(jax.vmap(end)(stiffness), alone, atol=1e-12)


def box(**changed):
    numbers = {"mass": 1.0, "inertia": 0.1, "bob": 0.3, "stiffness": 50.0}
    return PlanarSlider("box", **numbers | changed)


def unnamed(mode):
    class Unnamed(PlanarSlider):
        modes = (mode,)

    return Unnamed("box", mass=1.0, inertia=0.1, bob=0.3, stiffness=50.0)


class Asymmetric(PlanarSlider):
    def mass_matrix(self, space, zeta):
        return super().mass_matrix(space, zeta).at[0, 3].set(0.0)


class TooSmall(PlanarSlider):
    def mass_matrix(self, space, zeta):
        return super().mass_matrix(space, zeta)[:3, :3]


REFUSED = {
    "light": (lambda: [box(bob=1.2)], (), "positive definite"),
    "asymmetric": (lambda: [Asymmetric("box", mass=1.0, inertia=0.1, bob=0.3, stiffness=50.0)], (), "symmetric"),
    "small": (lambda: [TooSmall("box", mass=1.0, inertia=0.1, bob=0.3, stiffness=50.0)], (), r"shape \(4, 4\)"),
    "unnamed": (lambda: [unnamed(parts.ScalarCoordinate("", True, True))], (), "need one name each"),
    "still": (lambda: [unnamed(parts.ScalarCoordinate("slide", True))], (), "declare moves=True for slide"),
    "other": (lambda: [box(), planar.Body("rod", mass=1.0, inertia=0.1)], [OnSlide("bob", "rod")], "'rod' has none"),
    "ground": (lambda: [box()], [OnSlide("bob", "ground")], "'ground' has none"),
    "frame": (
        lambda: [box()],
        [planar.Frame("end", "box"), OnSlide("bob", "end")],
        "'end' has none; name a flexible body",
    ),
}


@pytest.mark.slow
def test_flexible_body_in_single_precision():
    """Accelerations of a pendulum, near those in double precision."""
    out = []
    for precision in (contextlib.nullcontext, single_precision):
        with precision():
            system = planar_pendulum(True).compile()
            q = jnp.array([0.2 * np.sin(0.3), -0.2 * np.cos(0.3), 0.3, 0.05], system.guess.q.dtype)
            out.append(np.asarray(jax.jit(lambda s, q: accelerations(s, Multipliers(), 0.0, q, 0 * q)[0])(system, q)))
    assert [x.dtype for x in out] == [np.float64, np.float32]
    np.testing.assert_allclose(out[1], out[0], rtol=1e-4, atol=1e-4)


def test_flexible_body_is_not_exported():
    """As a rigid body it would move in another way."""
    with pytest.raises(ValueError, match="box is flexible, and MJCF joins rigid bodies"):
        mb.importers.to_mjcf(spatial_loop(True).compile())


@pytest.mark.parametrize("case", REFUSED)
def test_flexible_body_is_refused(case):
    bodies, frames, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        mb.Scene(bodies(), frames=frames).compile()
