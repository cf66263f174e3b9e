"""Machines with sliders: motions are those of the same numbers given by hand, and the page follows its sliders."""

import time

import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.studies.variation import Variation
from jaxmb.viz import explore
from jaxmb.viz.explore import curves

MOST_PROGRAMS = 140
TS = np.linspace(0.0, 0.5, 6)
OPTIONS = {"t1": 0.5, "saveat": TS, "rtol": 1e-8}
GRAVITY = mb.Gravity((0.0, -9.81))


def of(system, bounds, *, state=None, fix=None, rates=None, options=None):
    return Variation.of(system, bounds, state=state, fix=fix, rates=rates, options=options)


@pytest.fixture(scope="module")
def linkage():
    return mb.mechanisms.get("four_bar")


@pytest.fixture(scope="module")
def driven():
    """A bar with a motor, whose torque is an input, and a designed length."""
    bar = planar.Body("bar", mass=1.0, inertia=planar.rod(1.0, 1.0), position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    system = mb.Scene([bar], joints=[pin], forces=[GRAVITY, mb.JointForce("motor", "pin.angle", force=1.0)]).compile()
    return mb.with_inputs(system, {"motor.force": mb.Series(TS, 1.0 + TS)})


@pytest.mark.slow
def test_motion_is_that_of_the_same_numbers(linkage):
    bounds = {"coupler.mass": (1.0, 5.0), "B.point_b[0]": (-3.0, -0.2), "crank.angle_rate": (0.0, 9.0)}
    variation = of(linkage.system, bounds, fix=linkage.fix, rates=linkage.rates, options=OPTIONS)
    values = {"coupler.mass": 1.3, "B.point_b[0]": -1.7, "crank.angle_rate": 2.0, "crank.angle": 1.2}
    system = mb.with_parameters(linkage.system, {"coupler.mass": 1.3, "B.point_b": np.array([-1.7, 0.0])})
    state = mb.assemble(system, fix={"crank.angle": 1.2}, rates={"crank.angle": 2.0})
    expected = mb.simulate(system, state, **OPTIONS)
    motion = variation.motion(values)
    np.testing.assert_allclose(motion["rocker"].angle, expected["rocker"].angle, rtol=1e-6)
    first = mb.simulate(linkage.system, linkage.state, **OPTIONS)
    np.testing.assert_allclose(variation.motion({})["rocker"].angle, first["rocker"].angle, rtol=1e-6)
    assert [slider.unit for slider in variation.sliders] == ["kg", "m", "rad/s", "rad"]


@pytest.mark.slow
def test_motion_with_an_input_is_that_of_a_constant(driven):
    variation = of(driven, {"motor.force": (0.0, 9.0)}, options=OPTIONS)
    assert variation.sliders[0].start == 1.0 and variation.sliders[1].name == "pin.angle"
    state = mb.assemble(driven, fix={"pin.angle": 0.4})
    expected = mb.simulate(mb.with_inputs(driven, {"motor.force": lambda t: 5.0 + 0 * t}), state, **OPTIONS)
    motion = variation.motion({"motor.force": 5.0, "pin.angle": 0.4})
    np.testing.assert_allclose(motion["bar"].angle, expected["bar"].angle, rtol=1e-7)


@pytest.mark.slow
def test_motion_keeps_to_a_way_of_assembly(linkage):
    """Once round, a linkage is where it was, and its joints are as fast as in the start."""
    pose = of(linkage.system, {"crank.angle": (-9.0, 9.0)}, state=linkage.state)
    start, round_ = pose.motion({}), pose.motion({"crank.angle": linkage.fix["crank.angle"] - 2 * np.pi})
    np.testing.assert_allclose(round_["rocker"].angle, start["rocker"].angle, atol=1e-8)
    np.testing.assert_allclose(round_["A"].angle_rate, start["A"].angle_rate, rtol=1e-8)
    assert start.ts.shape == (1,)


def chain(space, joints):
    body = space.Body
    inertia = {"inertia": 0.1} if space is planar else {"inertia": np.diag([0.1, 0.2, 0.3])}
    where = (0.0, 0.0) if space is planar else (0.0, 0.0, 0.0)
    bodies = [body(name, mass=1.0, position=where, **inertia) for name in ("one", "two", "free")]
    return mb.Scene(bodies, joints=joints).compile()


@pytest.mark.slow
def test_sliders_turn_the_joints_that_determine_the_pose(linkage):
    names = lambda system, **start: [slider.name for slider in of(system, {}, **start).sliders]
    assert names(linkage.system) == ["A.angle"]
    assert names(linkage.system, state=linkage.state, fix={"rocker.angle": 1.6}) == ["rocker.angle"]
    pins = [
        planar.Revolute("p", "ground", "one", point=(0.5, 0.0)),
        planar.Prismatic("s", "one", "two", point=(0.5, 0.0), axis=(1.0, 0.0)),
    ]
    assert names(chain(planar, pins)) == ["p.angle", "s.displacement"]
    # The second of two equal joints is redundant, and a free body has none.
    x, at = (1.0, 0.0, 0.0), (0.5, 0.0, 0.0)
    hinges = [spatial.Revolute(name, "ground", "one", point=at, axis=x) for name in ("h", "again")]
    found = names(chain(spatial, [*hinges, spatial.Cylindrical("c", "one", "two", point=at, axis=x)]))
    assert found == ["h.angle", "c.angle", "c.displacement"]


@pytest.mark.slow
def test_curves_are_components_of_quantities(linkage):
    motion = of(linkage.system, {}, state=linkage.state, options=OPTIONS).motion({})
    found = curves(motion, ["rocker.angle", "A.force"])
    assert {name: list(each) for name, each in found.items()} == {"rocker.angle": [""], "A.force": [" x", " y"]}
    np.testing.assert_array_equal(found["A.force"][" y"], motion["A"].force[:, 1])


@pytest.mark.parametrize(
    "bounds, options, message",
    [
        ({"coupler.mas": (1.0, 5.0)}, {}, "explore: Unknown parameter.*did you mean 'coupler.mass'"),
        ({"coupler.mass": (5.0, 1.0)}, {}, "bounds of 'coupler.mass' must be .low, high. with low < high"),
        ({"coupler.mass": (4.0, 5.0)}, {}, r"bounds of 'coupler.mass', \(4, 5\), do not contain its value, 3 kg"),
        ({"coupler.mass": (None, 5.0)}, {}, "must be two numbers"),
        ({}, {"quantities": ["rocker.angel"]}, "explore: Unknown quantity.*did you mean 'rocker.angle'"),
        ({"A.angle": (0.0, 2.0), "D.angle": (-1.0, 4.0)}, {}, "explore: 'D.angle' follows from A.angle; leave it out"),
        ({}, {"rtol": 1e-3}, "rtol belong to a motion; give its end, t1="),
        ({}, {"fix": {"crank.angle": 1.5, "rocker.angle": 0.0}}, "cannot be"),
    ],
)
def test_explore_refuses(bounds, options, message, linkage):
    with pytest.raises(ValueError, match=message) as told:
        explore(linkage.system, bounds, **options)
    assert len(str(told.value).split("\n")[0]) < 400


def test_explore_refuses_what_has_no_bodies():
    racer = mb.mechanisms.get("roller_racer").system
    with pytest.raises(ValueError, match="shows bodies, and a LagrangianSystem has none"):
        explore(racer)


def until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_explorer_follows_its_sliders(linkage):
    bounds = {"coupler.mass": (1.0, 5.0), "B.point_b[0]": (-3.0, 1.0)}
    explorer = explore(linkage.system, bounds, quantities="rocker.angle", state=linkage.state, t1=0.5)
    try:
        first = explorer.motion
        assert f'src="{explorer.url}"' in explorer._repr_html_()
        explorer.set({"coupler.mass": 1.3})
        until(lambda: explorer.motion is not first)
        assert explorer.values["coupler.mass"] == 1.3 and float(explorer.motion.system.bodies.mass[1]) == 1.3
        # Played to the end and on, without a computation.
        shown = explorer.motion
        explorer._playing.value = True
        until(lambda: explorer._time.value > 0.1)
        assert explorer.motion is shown
        # Too short to reach the rocker: the page says it, and keeps the last motion.
        explorer._playing.value = False
        explorer.set({"B.point_b[0]": 0.9, "A.angle": 3.1})
        until(lambda: "**No motion:**" in explorer._said.content)
        assert explorer.problem and explorer.motion is not first
        explorer.set({"B.point_b[0]": -1.5, "A.angle": 1.57})
        until(lambda: not explorer.problem)
        with pytest.raises(ValueError, match=r"Unknown slider 'coupler\.mas'"):
            explorer.set({"coupler.mas": 1.0})
        with pytest.raises(ValueError, match=r"has the bounds \(1.0, 5.0\), got 6.0"):
            explorer.set({"coupler.mass": 6.0})
    finally:
        explorer.close()
    assert not explorer._thread.is_alive()


def test_explorer_of_a_pose_turns_by_hand(linkage):
    explorer = explore(linkage.system, quantities="rocker.angle", state=linkage.state)
    try:
        explorer.set({"A.angle": 2.5})
        expected = mb.assemble(linkage.system, linkage.state, fix={"A.angle": 2.5})
        until(lambda: abs(float(explorer.motion["A"].angle[0]) - 2.5) < 1e-9)
        np.testing.assert_allclose(explorer.motion.ys.q[0], expected.q, atol=1e-8)
        assert f"rocker.angle = {float(explorer.motion['rocker'].angle[0]):.4g} rad" in explorer._said.content
    finally:
        explorer.close()
