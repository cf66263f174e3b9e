"""Optimal control of machines against exact optima, Pontryagin's equations, and simulations by another method."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

import jaxmb as mb
from jaxmb import mechanisms, planar, spatial

pytestmark = pytest.mark.slow

# The exact least effort of the four-bar linkage below: Pontryagin's equations in one coordinate.
BARS = {"lengths": (1.0, 2.0, 1.8), "base": 2.5, "masses": (1.0, 1.0, 1.0), "gravity": 0.0, "angle": 1.57}
LEAST_EFFORT = 18.987353952
# The exact least time along a cycloid from (0, 10) to (10, 5), for g = 9.80665.
CYCLOID = 1.801603122453
# Two optima of the swing-up by collocation of order eight.
SWING_UP, BETTER_SWING_UP = 58.80766746, 57.94478031


def at_rest(**values):
    """Values of coordinates of joints or bodies, with rates that are zero; the names have `_` for the point."""
    named = {name.replace("__", "."): value for name, value in values.items()}
    return named | {f"{name}_rate": 0.0 for name in named}


def check_motion(plan, within=1e-6):
    """The plan converged; its motion is on the constraints, and by another method arrives at its end."""
    assert plan.success and plan.integration_error < 1e-8
    violation = plan.trajectory.constraint_violation
    largest = [float(np.max(np.abs(x), initial=0.0)) for x in jax.tree.leaves(violation)]
    assert max(largest) < 1e-12 * max(1.0, float(np.max(np.abs(plan.states.u))))
    start = jax.tree.map(lambda y: y[0], plan.states)
    driven, times = mb.with_inputs(plan.system, plan.controls), {"t0": plan.ts[0], "t1": plan.ts[-1]}
    motion = mb.simulate(driven, start, **times, solver=mb.solvers.Hermite(), rtol=1e-10)
    np.testing.assert_allclose(motion.ys.q[-1], plan.states.q[-1], rtol=0, atol=within)
    np.testing.assert_allclose(motion.ys.u[-1], plan.states.u[-1], rtol=0, atol=within)


def five_bar():
    """Two cranks with motors and two arms that meet at the tip; the tip's place."""
    A, D = np.zeros(2), np.array([1.0, 0.0])
    B, C = A + 0.5 * np.array([np.cos(2.0), np.sin(2.0)]), D + 0.5 * np.array([np.cos(1.0), np.sin(1.0)])
    distance = np.linalg.norm(C - B)
    along = (C - B) / distance
    tip = (B + C) / 2 + np.sqrt(0.9**2 - distance**2 / 4) * np.array([-along[1], along[0]])

    def bar(name, mass, start, end):
        length, angle = float(np.linalg.norm(end - start)), np.arctan2(*(end - start)[::-1])
        return planar.Body(name, mass=mass, inertia=planar.rod(mass, length), position=(start + end) / 2, angle=angle)

    bodies = [bar("left", 1.0, A, B), bar("left_arm", 0.8, B, tip), bar("right", 1.0, D, C)]
    bodies.append(bar("right_arm", 0.8, C, tip))
    pins = [("A", "ground", "left", A), ("B", "left", "left_arm", B), ("D", "ground", "right", D)]
    pins += [("C", "right", "right_arm", C), ("P", "left_arm", "right_arm", tip)]
    scene = mb.Scene(
        bodies,
        joints=[planar.Revolute(name, a, b, point=point) for name, a, b, point in pins],
        forces=[mb.JointForce("m1", "A.angle", force=0.0), mb.JointForce("m2", "D.angle", force=0.0)],
        frames=[planar.Frame("tip", "left_arm", position=(0.45, 0.0))],
    )
    return scene.compile(), tip


@pytest.mark.parametrize("objective", ["effort", "time"])
def test_plan_moves_the_tip_of_a_five_bar_linkage_from_rest_to_rest(objective):
    system, tip = five_bar()
    there, motors = tip + np.array([0.4, -0.3]), {"m1.force": (-4.0, 4.0), "m2.force": (-4.0, 4.0)}
    start, end = ({"tip.position": place, "tip.velocity": (0.0, 0.0)} for place in (tip, there))
    options = {"effort": {"duration": 1.0, "running": "effort"}}
    options["time"] = {"duration": (0.2, 2.0), "final": "time", "interpolation": "held", "moving": True}
    find = lambda **more: mb.plan(system, controls=motors, start=start, end=end, **options[objective], **more)
    plan = find(intervals=24)
    check_motion(plan)
    np.testing.assert_allclose(mb.evaluate(system, jax.tree.map(lambda y: y[-1], plan.states), "tip.position"), there)
    if objective == "effort":
        # The error falls as the fourth power of the interval.
        errors = np.array([find(intervals=n).objective for n in (6, 12)]) - plan.objective
        assert 0 < errors[1] < errors[0] / 8
    else:
        finer = find(intervals=36, guess=plan)
        np.testing.assert_allclose(finer.objective, plan.objective, rtol=1e-5)
        switches = np.abs([np.asarray(plan.controls[name].values) for name in motors])
        assert np.mean(np.isclose(switches, 4.0, rtol=1e-4)) > 0.9


@pytest.mark.parametrize(("kind", "order", "most"), [("held", 2, 2e-3), ("linear", 4, 2e-7), ("cubic", 5, 1e-10)])
def test_plan_converges_with_the_order_of_its_controls(kind, order, most):
    scene = mechanisms.four_bar(**BARS).scene
    system = scene.extended(forces=[mb.JointForce("motor", "A.angle", force=0.0)]).compile()
    start, end = (at_rest(crank__angle=angle) for angle in (1.57, 1.57 + np.pi))
    options = {"controls": {"motor.force": None}, "duration": 2.0, "running": "effort", "start": start, "end": end}
    plans = [mb.plan(system, intervals=intervals, interpolation=kind, **options) for intervals in (8, 16, 32)]
    errors = np.array([plan.objective for plan in plans]) / LEAST_EFFORT - 1
    assert errors[0] > errors[1] > errors[2] and errors[2] < most
    assert np.log2(errors[0] / errors[2]) / 2 > order - 0.1


def test_plan_of_a_redundant_loop_in_space_is_the_plan_of_the_plane():
    """The bars are so thin that their moments of inertia are those of rods."""
    scene = mechanisms.spatial_loop(**BARS, section=1e-4).scene
    system = scene.extended(forces=[mb.JointForce("motor", "A.angle", force=0.0)]).compile()
    still = lambda angle, near: mb.assemble(system, near, fix={"A.angle": angle}, rates={"A.angle": 0.0})
    start = still(0.0, None)
    end = functools.reduce(lambda near, angle: still(angle, near), np.linspace(0.0, np.pi, 5)[1:], start)
    plan = mb.plan(
        system,
        controls={"motor.force": None},
        duration=2.0,
        start=start,
        end=end,
        running="effort",
        intervals=16,
        interpolation="cubic",
        guess={"A.angle": lambda t: 0.5 * np.pi * t},
    )
    check_motion(plan)
    np.testing.assert_allclose(plan.objective, LEAST_EFFORT, rtol=1e-8)


def stewart():
    """A platform of 20 kg on six cylinders, between universal joints on the ground and balls on the platform."""
    angles = np.deg2rad(np.repeat([0.0, 120.0, 240.0], 2) + np.outer([50.0, 15.0], [-1, 1] * 3))
    feet, heads = (
        np.stack([radius * np.cos(own), radius * np.sin(own), np.full(6, height)], axis=1)
        for own, radius, height in zip(angles, (1.0, 0.6), (0.0, 1.0), strict=True)
    )
    bodies = [spatial.Body("platform", mass=20.0, inertia=(1.5, 1.5, 3.0), position=(0.0, 0.0, 1.0))]
    joints: list[Any] = []
    forces: list[Any] = [mb.Gravity((0.0, 0.0, -9.81))]
    for k, (foot, head) in enumerate(zip(feet, heads, strict=True)):
        along = (head - foot) / np.linalg.norm(head - foot)
        across = np.cross(along, [0.0, 0.0, 1.0])
        across /= np.linalg.norm(across)
        ends = ((f"barrel{k}", 2.0, foot + 0.3 * along), (f"rod{k}", 1.0, head - 0.3 * along))
        bodies += [spatial.Body(name, mass=mass, inertia=(0.04,) * 3, position=at) for name, mass, at in ends]
        axes = {"axis_a_W": across, "axis_b_W": np.cross(along, across)}
        joints.append(spatial.Universal(f"foot{k}", "ground", f"barrel{k}", point=foot, **axes))
        joints.append(spatial.Prismatic(f"slide{k}", f"barrel{k}", f"rod{k}", point=foot, axis=along))
        joints.append(spatial.Spherical(f"head{k}", f"rod{k}", "platform", point=head))
        forces.append(mb.JointForce(f"drive{k}", f"slide{k}.displacement", force=0.0))
    return mb.Scene(bodies, joints=joints, forces=forces).compile()


def test_plan_moves_a_stewart_platform_between_two_poses():
    """Twelve coordinates and rates, six forces: second derivatives of an interval by its 24 inputs are exact."""
    system = stewart()
    start, drives = mb.assemble(system), [f"drive{k}.force" for k in range(6)]
    pose = {"platform.position": (0.15, -0.1, 1.1), "platform.e1": 0.05, "platform.e2": 0.0, "platform.e3": 0.1}
    end = mb.assemble(system, start, fix=pose)
    plan = mb.plan(
        system,
        controls=dict.fromkeys(drives, (-200.0, 200.0)),
        duration=1.0,
        start=start,
        end=end,
        running=lambda at: sum(jnp.square(at[name] / 100.0) for name in drives),
        intervals=8,
        guess=dict.fromkeys(drives, 60.0),
    )
    check_motion(plan)
    ends = mb.evaluate(system, jax.tree.map(lambda y: y[-1], plan.states), "platform.position")
    np.testing.assert_allclose(ends, pose["platform.position"], rtol=0, atol=1e-9)
    assert plan.active == ()


def parked(intervals, **options):
    """A vehicle that rolls on a knife edge is parked a metre to its left, by a force along it and a torque."""
    car = planar.Body("car", mass=1.0, inertia=0.2)
    push = planar.PointForce("push", "car", force=(0.0, 0.0), frame="body")
    forces = [push, planar.Torque("steer", "car", torque=0.0)]
    system = mb.Scene([car], joints=[planar.KnifeEdge("edge", "car")], forces=forces).compile()
    pose = lambda y: {"car.x": 0.0, "car.y": y, "car.angle": 0.0, "car.x_rate": 0.0, "car.angle_rate": 0.0}
    controls = {"push.force": ((-5.0, 0.0), (5.0, 0.0)), "steer.torque": (-5.0, 5.0)}
    ends = {"start": pose(0.0), "end": pose(1.0), "duration": 2.0}
    return mb.plan(system, controls=controls, running="effort", intervals=intervals, **ends, **options)


def bends(size):
    """A guess forward to the left, and back."""
    wave = lambda t: size * np.sin(np.pi * t / 2)
    return {"car.x": lambda t: 0.5 * wave(t), "car.y": lambda t: 0.5 * t, "car.angle": wave}


def least_parking(plan):
    """The least effort by Pontryagin's equations of the vehicle's pose, speed and spin, near a plan."""

    def equations(t, s):
        del t
        _, _, angle, speed, spin, px, py, turn, pull, twist = s
        c, s = np.cos(angle), np.sin(angle)
        force, torque = -pull / 2, -twist / 2 / 0.2
        rates = [speed * c, speed * s, spin, force, torque / 0.2, 0 * px, 0 * py]
        return np.array([*rates, speed * (px * s - py * c), -(px * c + py * s), -turn])

    ends = np.array([0.0, 0.0, 0.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0, 0.0, 0.0])
    q, u, ts = plan.states.q, plan.states.u, plan.ts
    speed = u[:, 0] * np.cos(q[:, 2]) + u[:, 1] * np.sin(q[:, 2])
    force, torque = plan.controls["push.force"].values[:, 0], plan.controls["steer.torque"].values
    prices = [np.full(ts.size, -plan.prices[f"start car.{name}"]) for name in "xy"]
    twist = -0.4 * np.asarray(torque)
    guess = [*q.T, speed, u[:, 2], *prices, -np.gradient(twist, ts), -2 * np.asarray(force), twist]
    found = integrate.solve_bvp(
        equations, lambda a, b: np.append(a[:5] - ends[0], b[:5] - ends[1]), ts, guess, tol=1e-9, max_nodes=10**5
    )
    assert found.success
    times = np.linspace(0.0, 2.0, 4001)
    *_, pull, twist = found.sol(times)
    return integrate.simpson((pull / 2) ** 2 + (twist / 0.4) ** 2, x=times)


def test_plan_parks_a_vehicle_that_cannot_slip_sideways():
    plan = parked(32, guess=bends(1.0))
    check_motion(plan)
    least = least_parking(plan)
    np.testing.assert_allclose(plan.objective, least, rtol=5e-6)
    assert plan.objective > least
    other = parked(32, guess=bends(0.6), interpolation="cubic")
    np.testing.assert_allclose(other.objective, least, rtol=1e-8)
    # A component with equal bounds stays there, and its bound is none that is reached.
    np.testing.assert_array_equal(plan.controls["push.force"].values[:, 1], 0.0)
    assert plan.active == ()


def test_plan_turns_a_free_body_by_an_arm_alone():
    base = spatial.Body("base", mass=4.0, inertia=(0.4, 0.5, 0.6))
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.8, 0.0, 0.0))
    axes = {"axis_a_W": (0.0, 0.0, 1.0), "axis_b_W": (0.0, 1.0, 0.0)}
    shoulder = spatial.Universal("shoulder", "base", "arm", point=(0.3, 0.0, 0.0), **axes)
    motors = [mb.JointForce(name, f"shoulder.angle_{side}", force=0.0) for name, side in (("yaw", "a"), ("pitch", "b"))]
    system = mb.Scene([base, arm], joints=[shoulder], forces=motors).compile()
    swing = lambda t: 0.8 * np.sin(0.5 * np.pi * t)
    # The first component of the vector part is given, and the others are free.
    rolled = tuple(np.array([side, np.sin(0.1), side, side]) for side in (-np.inf, np.inf))
    plan = mb.plan(
        system,
        controls={"yaw.force": None, "pitch.force": None},
        duration=4.0,
        start=mb.assemble(system),
        end=at_rest(shoulder__angle_a=0.0, shoulder__angle_b=0.0) | {"base.orientation": rolled},
        running="effort",
        intervals=24,
        guess={"shoulder.angle_a": swing, "shoulder.angle_b": lambda t: swing(t) * np.sin(0.25 * np.pi * t)},
    )
    check_motion(plan)
    # Without forces from outside the mass centre stays, and at rest nothing moves.
    centre = np.asarray(plan.trajectory["base"].position) * 4 + np.asarray(plan.trajectory["arm"].position)
    np.testing.assert_allclose(centre / 5, np.broadcast_to(centre[0] / 5, centre.shape), rtol=0, atol=1e-7)
    np.testing.assert_allclose(plan.states.u[-1], 0.0, atol=1e-6)


def test_plan_swings_up_a_pole_to_the_optima_near_two_guesses():
    """The pole is a point mass: its moment of inertia is negligible."""
    cart = planar.Body("cart", mass=1.0, inertia=1.0)
    pole = planar.Body("pole", mass=0.3, inertia=1e-12, position=(0.0, -0.5))
    rail = planar.Prismatic("rail", "ground", "cart", point=(0.0, 0.0), axis=(1.0, 0.0))
    pin = planar.Revolute("pin", "cart", "pole", point=(0.0, 0.0))
    forces = [mb.JointForce("motor", "rail.displacement", force=0.0), mb.Gravity((0.0, -9.81))]
    system = mb.Scene([cart, pole], joints=[rail, pin], forces=forces).compile()
    start, end = (at_rest(cart__x=x, pole__angle=angle) for x, angle in ((0.0, 0.0), (1.0, np.pi)))
    options = {"controls": {"motor.force": None}, "duration": 2.0, "running": "effort", "start": start, "end": end}
    find = lambda guess: mb.plan(system, intervals=32, interpolation="cubic", guess=guess, **options)
    np.testing.assert_allclose(find(None).objective, SWING_UP, rtol=1e-6)
    swing = lambda t: np.interp(t, [0.0, 0.4, 1.2, 2.0], [0.0, 0.6, -1.5, np.pi])
    plan = find({"cart.x": lambda t: 0.5 * t - 0.1 * np.sin(np.pi * t), "pole.angle": swing})
    check_motion(plan)
    np.testing.assert_allclose(plan.objective, BETTER_SWING_UP, rtol=1e-6)
    places = np.asarray(plan.trajectory["cart"].position)[:, 0]
    force = plan.controls["motor.force"].values[0]
    np.testing.assert_allclose([force, places.min(), places.max()], [-6.861147, -0.103, 1.0], rtol=0, atol=2e-3)


def test_plan_of_least_time_of_a_knife_edge_under_gravity_is_a_cycloid():
    """A blade that turns steadily glides on a cycloid, so the best torque is zero."""
    skate = planar.Body("skate", mass=1.0, inertia=0.1)
    forces = [planar.Torque("steer", "skate", torque=0.0), mb.Gravity((0.0, -9.80665))]
    system = mb.Scene([skate], joints=[planar.KnifeEdge("blade", "skate")], forces=forces).compile()
    turn = {"skate.x": lambda t: 5 * t, "skate.y": lambda t: 10 - 2.5 * t, "skate.angle": lambda t: 0.6 * t - 1.3}
    plan = mb.plan(
        system,
        controls={"steer.torque": None},
        duration=(0.5, 4.0),
        start={"skate.x": 0.0, "skate.y": 10.0, "skate.y_rate": 0.0},
        end={"skate.x": 10.0, "skate.y": 5.0},
        final="time",
        intervals=16,
        guess={"duration": 2.0, **turn},
    )
    check_motion(plan)
    np.testing.assert_allclose(plan.objective, CYCLOID, rtol=1e-9)


def test_plan_of_the_shape_of_a_slide_in_least_time_is_a_cycloid():
    """The slide is a distance from a place above its end as a function of the angle there. A series in the root of the
    angle can begin as a cycloid does, in a cusp; the bead is released 16 μm below it.
    """
    pole, below, above, share = np.array([10.0, 10.0]), 5.0, 10.0, 1e-6

    def slide(point, numbers):
        turned = jnp.arctan2(-point[1], -point[0]) / (np.pi / 2)
        bulge = turned * (1 - turned) * jnp.polyval(numbers["shape"], jnp.sqrt(turned))
        return jnp.linalg.norm(point) - above + (above - below) * turned - bulge

    begin = (above - (above - below) * share) * np.array([np.cos(share * np.pi / 2), np.sin(share * np.pi / 2)])
    bead = planar.Body("bead", mass=1.0, inertia=1.0, position=pole - begin)
    rail = planar.PointOnCurve("rail", "pole", "bead", slide, parameters={"shape": np.zeros(6)})
    forces, frames = [mb.Gravity((0.0, -9.80665))], [planar.Frame("pole", "ground", position=pole)]
    system = mb.Scene([bead], joints=[rail], forces=forces, frames=frames).compile()
    rest = {"bead.y": bead.position[1], "bead.y_rate": 0.0, "bead.angle": 0.0, "bead.angle_rate": 0.0}
    plan = mb.plan(
        system,
        controls={},
        design={"rail.shape": (-20.0 * np.ones(6), 20.0 * np.ones(6))},
        duration=(1.0, 3.0),
        start={**rest, "bead.x": (-1.0, 1.0)},
        end={"bead.x": pole[0]},
        final="time",
        intervals=16,
        guess=mb.simulate(system, mb.assemble(system), t1=1.9, saveat=np.linspace(0.0, 1.9, 101)),
    )
    check_motion(plan)
    np.testing.assert_allclose(plan.objective, CYCLOID, rtol=1e-6)
    # The bottom of the cycloid is twice the radius of its circle below the start.
    np.testing.assert_allclose(np.min(plan.trajectory["bead"].position[:, 1]), 4.828000783, rtol=0, atol=2e-3)


def test_plan_of_a_crane_in_least_time_leaves_no_swing():
    """A heavy trolley is at rest as soon as without its load if it accelerates for a period of small swings, and then
    brakes as long: T = 4 π / ω.
    """
    period, acceleration, mass = 2 * np.pi / np.sqrt(9.81), 0.01, 1e4
    trolley = planar.Body("trolley", mass=mass, inertia=1.0)
    load = planar.PointMass("load", mass=1e-3, position=(0.0, -1.0))
    joints = [
        planar.Prismatic("rail", "ground", "trolley", point=(0.0, 0.0), axis=(1.0, 0.0)),
        planar.Distance("rope", "trolley", "load", point_a=(0.0, 0.0), point_b=(0.0, 0.0)),
    ]
    forces = [mb.Gravity((0.0, -9.81)), mb.JointForce("drive", "rail.displacement", force=0.0)]
    crane = mb.Scene([trolley, load], joints=joints, forces=forces).compile()
    names, way = ("trolley.x", "load.x"), acceleration * period**2
    rest = {f"{name}_rate": 0.0 for name in names}
    here, there = (dict.fromkeys(names, x) | rest for x in (0.0, way))
    plan = mb.plan(
        crane,
        controls={"drive.force": (-acceleration * mass, acceleration * mass)},
        duration=(period, 4 * period),
        start=here,
        end=there,
        final="time",
        interpolation="held",
        intervals=16,
    )
    assert plan.success
    np.testing.assert_allclose(plan.duration, 2 * period, rtol=1e-5)
    assert plan.arrival < 1e-6
