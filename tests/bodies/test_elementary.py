"""Rows of joints by their elements, against the rows by derivatives of each joint's residual."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import parts, planar, spatial
from jaxmb.bodies.elementary import HostRows, is_elementary
from jaxmb.parts import coincident, perpendicular
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.report import check_elements
from jaxmb.states.consistency import consistent, is_consistent

MOST_PROGRAMS = 70

POINTS = {"point_a": (0.3, -0.2, 0.5), "point_b": (-0.4, 0.1, 0.2)}
PLACE = {"point": (0.2, 0.1, 0.4)}
AXIS = {"axis": (0.6, 0.0, 0.8)}
JOINTS = {
    "Spherical": (spatial.Spherical, PLACE),
    "Revolute": (spatial.Revolute, PLACE | AXIS),
    "Universal": (spatial.Universal, PLACE | {"axis_a_W": (0.6, 0.0, 0.8), "axis_b_W": (0.8, 0.0, -0.6)}),
    "Gimbal": (
        spatial.Gimbal,
        PLACE | {"axis_1_W": (1.0, 0.0, 0.0), "axis_2_W": (0.0, 1.0, 0.0), "axis_3_W": (0.0, 0.0, 1.0)},
    ),
    "Cylindrical": (spatial.Cylindrical, PLACE | AXIS),
    "Prismatic": (spatial.Prismatic, PLACE | AXIS),
    "Planar": (spatial.Planar, PLACE | AXIS),
    "Fixed": (spatial.Fixed, PLACE),
    "Distance": (spatial.Distance, POINTS),
    "PointOnPlane": (spatial.PointOnPlane, PLACE | AXIS),
    "PointOnLine": (spatial.PointOnLine, PLACE | AXIS),
}


TURNS = [
    mb.rotations.from_axis_angle(np.array(axis), angle)
    for axis, angle in (((0.6, 0.8, 0.0), 0.7), ((0.0, 0.28, 0.96), -1.1))
]


def bodies(number="", **of_b):
    """Two turned bodies."""
    inertia = spatial.box(2.0, 0.3, 0.8, 0.5)
    places = (
        {"position": (0.1, 0.2, 0.3), "orientation": TURNS[0]},
        {"position": (-0.5, 0.4, 0.9), "orientation": TURNS[1]},
    )
    a, b = places[0], places[1] | of_b
    return [
        spatial.Body(f"a{number}", mass=1.0, inertia=inertia, **a),
        spatial.Body(f"b{number}", mass=2.0, inertia=inertia, **b),
    ]


def states_of(system, many=3):
    """Consistent states, far from that of the scene."""
    keys = jax.random.split(jax.random.key(3), many)
    size = lambda x: 0.2 * jax.random.normal(keys[0], x.shape)
    for key in keys:
        q = system.guess.q + 0.1 * jax.random.normal(key, (system.nq,))
        u = jax.random.normal(jax.random.fold_in(key, 1), (system.nu,))
        yield mb.assemble(system, mb.State(q, u)), size(u)


def largest(x):
    return float(jnp.max(jnp.abs(x), initial=0.0))


@eqx.filter_jit
def both(system, state, acceleration):
    """All rows that a motion uses, by elements and by derivatives of the residuals."""
    near, t, (q, u) = system.prepared(), jnp.zeros(()), (state.q, state.u)
    assert near.constraints.elements is not None and system.constraints.elements is None
    multipliers = jnp.linspace(-1.0, 2.0, system.acceleration_rows)
    rates = system.rates(t, q, u)
    # Along motions of bodies; the length of Euler parameters may count otherwise, since it does not change.
    unit = jax.vmap(lambda v: system.rates(t, q, v))(jnp.eye(system.nu)).T

    def rows(own):
        accelerations = lambda q, u: own.acceleration_residual(t, q, u, acceleration)
        return {
            "values": own.position_residual(t, q),
            "Jacobian": own.jacobian(t, q, u),
            "rates": own.velocity_residual(t, q, acceleration),
            "second rates": accelerations(q, u),
            "their derivative": jax.jvp(accelerations, (q, u), (rates, jnp.zeros_like(u)))[1],
            "forces": own.constraint_force(t, q, u, multipliers),
            "Jacobian of coordinates": own.coordinate_jacobian(t, q) @ unit,
        }

    found, exact = rows(near), rows(system)
    # All of the rows' own derivatives.
    found["derivatives"] = near.coordinate_jacobian(t, q)
    exact["derivatives"] = jax.jacfwd(lambda q: near.coordinate_residual(t, q))(q)
    return found, exact


def assert_agree(system, state, acceleration, tol=1e-13):
    found, exact = both(system, state, acceleration)
    for what, own in found.items():
        assert largest(own - exact[what]) < tol * (1 + largest(exact[what])), what


def test_elements_along_a_motion_change_at_their_rates():
    """Of a rod and of a pin in a slot, where these are open: a rod's row is half of the square over the length."""
    a, b = (planar.Body(name, mass=1.0, inertia=0.1, position=x) for name, x in (("a", (0.0, 0.0)), ("b", (1.0, 0.5))))
    rod = planar.Distance("rod", "a", "b", point_a=(0.1, 0.2), point_b=(-0.2, 0.1), length=0.8)
    slot = planar.PointOnLine("slot", "a", "b", axis_a=(0.6, 0.8), point_a=(0.3, 0.0), point_b=(0.1, -0.3))
    system = mb.Scene([a, b], joints=[rod, slot]).compile()
    rows = HostRows.of(jax.tree.map(np.asarray, system.prepared().constraints.elements))
    start, (velocity, acceleration) = (
        np.array([[0.0, 0.0, 0.3], [1.0, 0.5, -0.4]]),
        np.random.default_rng(0).normal(size=(2, 2, 3)),
    )

    def at(t):
        moving = start + t * velocity + 0.5 * t**2 * acceleration, velocity + t * acceleration, acceleration
        poses, *rates = (np.append(values, np.zeros((1, 3)), axis=0) for values in moving)
        return np.stack([PLANE.prepare(pose) for pose in poses]), *rates

    h, now = 1e-5, at(0.0)
    difference = lambda function: (function(at(h)) - function(at(-h))) / (2 * h)
    rates, second = rows.velocity(*now[:2]), rows.acceleration(*now)
    np.testing.assert_allclose(rates, difference(lambda at: rows.residual(at[0])), rtol=0, atol=1e-8)
    np.testing.assert_allclose(second, difference(lambda at: rows.velocity(*at[:2])), rtol=0, atol=1e-8)
    turned = lambda angle, x, y: np.array(
        [np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y]
    )
    apart = start[1, :2] + turned(-0.4, -0.2, 0.1) - turned(0.3, 0.1, 0.2)
    np.testing.assert_allclose(rows.residual(now[0])[0], 0.5 * (apart @ apart / 0.8 - 0.8), rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("where", ["bodies", "frame", "ground"])
def test_elements_of_every_joint_give_the_rows_of_its_residual(where):
    """Also where the origin of a body's frame is not its mass centre."""
    pairs = [bodies(k, **({"centre": (0.1, 0.2, -0.1)} if where == "ground" else {})) for k in range(len(JOINTS))]
    turned = {"position": (0.1, -0.3, 0.2), "orientation": (0.8, 0.0, 0.6, 0.0)}
    frames = [spatial.Frame(f"tip{k}", f"b{k}", **turned) for k in range(len(pairs))] if where == "frame" else []
    ends = ("ground" if where == "ground" else "a{}", "tip{}" if where == "frame" else "b{}")
    joints = [
        kind(name, *(end.format(k) for end in ends), **given) for k, (name, (kind, given)) in enumerate(JOINTS.items())
    ]
    system = mb.Scene([one for pair in pairs for one in pair], joints=joints, frames=frames).compile()
    assert all(map(is_elementary, system.constraints.position))
    assert {type(g.group.part) for g in system.constraints.position} == {kind for kind, _ in JOINTS.values()}
    for state, acceleration in states_of(system):
        assert_agree(system, state, acceleration)
        check_elements(system, state)


@pytest.mark.slow
def test_elements_of_planar_joints_give_the_rows_of_their_residuals():
    point, axis = {"point": (0.5, 0.2)}, {"axis": (0.6, 0.8)}
    places = [{"position": (0.3 * k, 0.1 * k * k), "angle": 0.4 * k - 1.0} for k in range(10)]
    own = [planar.Body(f"b{k}", mass=1.0, inertia=0.1, **place) for k, place in enumerate(places)]
    frame = planar.Frame("tip", "b1", position=(0.1, -0.3), angle=0.4)
    joints = [
        planar.Revolute("pin", "b0", "tip", **point),
        planar.Fixed("weld", "b2", "b3", **point),
        planar.PointOnLine("slot", "b4", "b5", **point, **axis),
        planar.Prismatic("slide", "b6", "ground", **point, **axis),
        planar.Distance("rod", "b8", "b9", point_a=(0.1, 0.2), point_b=(-0.3, 0.4)),
    ]
    system = mb.Scene(own, joints=joints, frames=[frame]).compile()
    assert all(map(is_elementary, system.constraints.position))
    for state, acceleration in states_of(system):
        assert_agree(system, state, acceleration)
        check_elements(system, state)


class Loose(spatial.Revolute):
    """A hinge with a residual of its own, and the elements of a hinge."""

    def residual(self, space, poses, t):
        return 2.0 * super().residual(space, poses, t)


class Hinge(parts.AbstractSpatialPart, parts.AbstractJoint):
    """A hinge of a user's, whose elements are right or wrong."""

    axis_a: parts.Number = parts.axis(body=0, optional=True)
    axis_b: parts.Number = parts.axis(body=1, optional=True)
    axis: parts.Number = parts.axis(body=None, gives=("axis_a", "axis_b"))
    rows = 5
    wrong = False

    def residual(self, space, poses, t):
        b = space.direction(poses[1], self.axis_b)
        u, v = (space.direction(poses[0], x) for x in self._across)
        return jnp.concatenate([parts.separation(space, self, poses), jnp.stack([u @ b, v @ b])])

    @property
    def _across(self):
        u = jnp.cross(self.axis_a, jnp.array([0.0, 1.0, 0.0]))
        return u, jnp.cross(self.axis_a, u)

    @property
    def elements(self):
        u, v = self._across
        return coincident(self), perpendicular(u, self.axis_b), perpendicular(u if self.wrong else v, self.axis_b)


class WrongHinge(Hinge):
    wrong = True


class Short(Hinge):
    @property
    def elements(self):
        return (coincident(self),)


def system_with(kind):
    return mb.Scene(bodies(), joints=[kind("joint", "a", "b", **PLACE, **AXIS)]).compile()


@pytest.mark.slow
def test_elements_of_a_joint_of_the_users():
    """Those that differ from the residual are refused."""
    system = system_with(Hinge)
    assert all(map(is_elementary, system.constraints.position))
    ((state, acceleration),) = states_of(system, 1)
    assert_agree(system, state, acceleration)
    check_elements(system, state)
    with pytest.raises(ValueError, match=r"Joint 'joint': the Jacobians of row 4 .* differ by"):
        check_elements(system_with(WrongHinge), state)
    with pytest.raises(ValueError, match=r"Short 'joint': its elements have 3 rows, but rows = 5"):
        system_with(Short)


def test_elements_count_less_than_a_newer_residual():
    system = system_with(Loose)
    assert not any(map(is_elementary, system.constraints.position)) and system.prepared().constraints.elements is None


@pytest.mark.slow
def test_hinge_half_a_turn_away_is_not_consistent():
    # With a joint without elements, whose rows stand before.
    joints = [Loose("before", "ground", "a", **PLACE, **AXIS), spatial.Revolute("hinge", "a", "b", **PLACE, **AXIS)]
    system = mb.Scene(bodies(), joints=joints).compile()
    state = mb.State(system.guess.q, jnp.zeros(system.nu))
    assert consistent(system, 0.0, state) is state
    # About an axis across the hinge, through its point.
    turn, point = mb.rotations.from_axis_angle(np.array([0.0, 1.0, 0.0]), np.pi), np.array(PLACE["point"])
    r, p = state.q[7:10], state.q[10:14]
    turned = jnp.concatenate([point + mb.rotations.rotate(turn, r - point), mb.rotations.multiply(turn, p)])
    state = mb.State(state.q.at[7:14].set(turned), state.u)
    assert largest(system.prepared().position_residual(jnp.zeros(()), state.q)) < 1e-12
    with pytest.raises(ValueError, match=r"The state violates the constraints hinge \(2\)"):
        consistent(system, 0.0, state)


def test_weld_that_is_turned_by_a_third_is_not_consistent():
    """About diagonals, after which the axes are those of the body in another order."""
    weld = spatial.Fixed("weld", "ground", "bar", point=(0.0, 0.0, 0.0))
    system = mb.Scene([spatial.Body("bar", mass=1.0, inertia=(1.0, 1.0, 1.0))], joints=[weld]).compile()
    turns = [(1, 1, 1), (-1, -1, -1), (1, -1, 1), (-1, 1, 1)]
    for p, holds in ([1.0, 0.0, 0.0, 0.0], True), *((0.5 * np.array([1, *signs]), False) for signs in turns):
        assert bool(is_consistent(system, 0.0, mb.State(np.append(np.zeros(3), p), np.zeros(6)))) == holds


@pytest.mark.slow
def test_weld_that_is_turned_by_a_half_is_not_consistent():
    weld = planar.Fixed("weld", "ground", "bar", point=(0.0, 0.0))
    system = mb.Scene([planar.Body("bar", mass=1.0, inertia=1.0)], joints=[weld]).compile()
    for angle, holds in ((0.0, True), (np.pi, False), (2 * np.pi, False)):
        state = mb.State(np.array([0.0, 0.0, angle]), np.zeros(3))
        assert bool(is_consistent(system, 0.0, state)) == holds


@pytest.mark.slow
@pytest.mark.parametrize("name, t1", [("spatial_slider_crank", 0.2), ("slider_crank", 0.05)])
def test_elements_give_the_motions_and_gradients_of_the_residuals(name, t1, monkeypatch):
    built = mb.mechanisms.get(name)
    system, start = built.system, mb.parameters(built.system)
    # Masses, lengths, points and axes of all joints.
    names = [key for key in start if key.split(".")[-1] in ("mass", "length", "point_a", "point_b", "axis_b")]
    along = {key: 1e-2 * jax.random.normal(jax.random.key(k), start[key].shape) for k, key in enumerate(names)}

    def end(step):
        own = mb.with_parameters(system, {key: start[key] + step * along[key] for key in names})
        state = mb.assemble(own, built.state)
        motion = mb.simulate(own, state, t1=t1, rtol=1e-12, max_steps=1024)
        return jnp.concatenate([motion.ys.q[-1], motion.ys.u[-1]])

    weights = jnp.linspace(-1.0, 1.0, system.nq + system.nu)
    found = end(0.0), jax.jacfwd(end)(0.0), jax.grad(lambda step: weights @ end(step))(0.0)
    monkeypatch.setattr(type(system), "prepared", lambda self: self)
    jax.clear_caches()
    expected = end(0.0), jax.jacfwd(end)(0.0), jax.grad(lambda step: weights @ end(step))(0.0)
    for own, other in zip(found, expected, strict=True):
        assert largest(own - other) < 1e-10 * (1 + largest(other))
    assert largest(found[1]) > 1e-3 and abs(found[2] - weights @ found[1]) < 1e-9 * (1 + abs(found[2]))
