"""Figures show what moves, by name, and mechanisms in the shapes of their parts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from trajectories import bounced, motion_of

import jaxmb as mb
from jaxmb import planar, spatial, terrain, viz
from jaxmb.linalg.rotations import rotate
from jaxmb.parts import contact
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.parts.spatial.kinematics import SPACE
from jaxmb.trajectory import at_rows
from jaxmb.viz.motion_nodes import chosen

TS = np.linspace(0.0, 1.0, 5)


def sliding(**slide):
    """A piston whose mass centre moves along x, on a slide through the origin."""
    piston = planar.Body("piston", mass=2.0, inertia=0.1, position=(0.3, 0.0))
    joint = {"body_a": "ground", "body_b": "piston", "point": (0.0, 0.0), "axis": (1.0, 0.0)} | slide
    system = mb.Scene([piston], joints=[planar.Prismatic("slide", **joint)]).compile()
    x = 0.3 + 0.1 * np.sin(TS)
    return motion_of(
        system,
        TS,
        np.column_stack([x, np.zeros((5, 2))]),
        np.column_stack([0.1 * np.cos(TS), np.zeros((5, 2))]),
    )


@pytest.fixture(scope="module")
def piston():
    return sliding()


def drawn(axes):
    return {line.get_label(): line.get_ydata() for line in axes.lines}


def test_a_sliding_piston_shows_its_place_and_its_stroke(piston):
    """Its height and angle stay zero and are left out; the displacement counts from the given pose."""
    position, velocity, displacement, rate, energy, residual = viz.plot_motion(piston).axes
    assert list(drawn(position)) == list(drawn(velocity)) == ["piston x"]
    np.testing.assert_allclose(drawn(position)["piston x"], 0.3 + 0.1 * np.sin(TS))
    np.testing.assert_allclose(drawn(displacement)["slide"], 0.1 * np.sin(TS), atol=1e-15)
    np.testing.assert_allclose(drawn(rate)["slide"], 0.1 * np.cos(TS))
    labels = ["position [m]", "velocity [m/s]", "displacement [m]", "rate of displacement [m/s]", "energy [J]"]
    assert [axes.get_ylabel() for axes in (position, velocity, displacement, rate, energy)] == labels
    assert list(drawn(residual)) == ["position", "velocity [1/s]"]
    np.testing.assert_allclose(drawn(energy)["sum"], (0.1 * np.cos(TS)) ** 2)


def padded(motion, value=np.inf):
    """The same motion as of a run that ended before two more times at which it was to be saved."""
    more = lambda x: jnp.concatenate([x, jnp.full((2, *x.shape[1:]), value)])
    return dataclasses.replace(motion, ts=more(motion.ts), ys=mb.State(more(motion.ys.q), more(motion.ys.u)))


def test_times_that_a_run_did_not_reach_are_left_out(piston):
    """Of a run that failed or ended at an event, saved under `jit`."""
    early = padded(piston)
    for axes, other in zip(viz.plot_motion(early).axes, viz.plot_motion(piston).axes, strict=True):
        for name, values in drawn(other).items():
            np.testing.assert_array_equal(drawn(axes)[name], values)
    (poses, *_), (same, *_) = viz.plot_mechanism(early).axes, viz.plot_mechanism(piston).axes
    assert poses.get_title() == same.get_title() == "t = 0, 0.25, 0.5, 0.75, 1 s"
    assert chosen(early, 10).ts.size == 5
    stuck = dataclasses.replace(early, ts=early.ts.at[1:].set(jnp.inf), result=mb.RESULTS.newton_failed)
    for picture in (viz.plot_motion, lambda motion: chosen(motion, 10)):
        with pytest.raises(ValueError, match="two times or more at which it is saved: Newton's method found no state"):
            picture(stuck)


@pytest.mark.slow
def test_a_batch_is_refused_with_the_way_to_its_members(piston):
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), piston)
    for picture in (viz.plot_motion, viz.plot_mechanism, lambda motion: chosen(motion, 10)):
        with pytest.raises(ValueError, match=r"batch of shape \(2,\); choose members of it, such as batch\[0\]"):
            picture(batch)
        picture(batch[1])


def test_a_state_is_drawn_as_a_motion_with_one_time(piston):
    state = piston.end
    last = at_rows(piston, np.array([4]))
    for own, other in zip(
        viz.plot_mechanism(state, system=piston.system).axes, viz.plot_mechanism(last).axes, strict=True
    ):
        assert [line.get_label() for line in own.lines] == [line.get_label() for line in other.lines]
        for line, same in zip(own.lines, other.lines, strict=True):
            np.testing.assert_array_equal(line.get_xydata(), same.get_xydata())
    with pytest.raises(ValueError, match="needs its system: give system=system"):
        viz.plot_mechanism(state)
    with pytest.raises(ValueError, match="plot_motion shows a motion, got a State"):
        viz.plot_motion(state)
    with pytest.raises(ValueError, match="a motion has its own system"):
        viz.plot_mechanism(piston, system=piston.system)
    with pytest.raises(ValueError, match=r"got state\.q of shape"):
        viz.plot_mechanism(mb.State(state.q[:1], state.u), system=piston.system)


def test_states_that_are_not_finite_are_named(piston):
    ys = mb.State(piston.ys.q.at[3].set(jnp.nan), piston.ys.u)
    for picture in (viz.plot_mechanism, lambda motion: chosen(motion, 10)):
        with pytest.raises(ValueError, match=r"The state at 0\.75 s is not finite"):
            picture(dataclasses.replace(piston, ys=ys))


@pytest.mark.parametrize("frames", [0, 2.0, True])
def test_poses_are_counted(piston, frames):
    with pytest.raises(ValueError, match="frames must be an integer of at least 1"):
        viz.plot_mechanism(piston, frames=frames)


def test_a_cell_of_a_notebook_shows_a_figure(piston):
    for figure in (viz.plot_motion(piston, "energy"), viz.plot_mechanism(piston, frames=np.int64(2))):
        assert figure._repr_png_().startswith(b"\x89PNG")


@pytest.mark.slow
def test_events_are_lines_in_every_panel():
    """They do not change the limits of the panels; the first one has a legend of them."""
    figure = viz.plot_motion(bounced())
    for axes in figure.axes:
        (marks,) = axes.collections
        np.testing.assert_allclose(marks.get_segments(), [[(1.0, 0.0), (1.0, 1.0)]])
        assert marks.get_linestyle()[0][1] is None
    height, velocity, *_ = figure.axes
    assert [text.get_text() for text in height.get_legend().get_texts()] == ["impact", "ball y"]
    low, high = velocity.get_ylim()
    assert -11.5 < low < -10.0 and 4.0 < high < 6.5


def test_a_constant_rate_is_shown_and_a_body_at_rest_is_not():
    bodies = [planar.Body(name, mass=1.0, inertia=0.1) for name in ("wheel", "stone")]
    system = mb.Scene(bodies).compile()
    q, u = np.zeros((5, 6)), np.zeros((5, 6))
    q[:, 2], u[:, 2] = 3.0 * TS, 3.0
    angle, rate, _ = viz.plot_motion(motion_of(system, TS, q, u)).axes
    assert list(drawn(angle)) == list(drawn(rate)) == ["wheel"]
    np.testing.assert_allclose(drawn(rate)["wheel"], 3.0)


def test_quantities_are_chosen_by_name(piston):
    (one,) = viz.plot_motion(piston, "slide.displacement").axes
    np.testing.assert_allclose(drawn(one)["slide"], 0.1 * np.sin(TS), atol=1e-15)
    # All of a part that describes its motion, also what stays at zero.
    found = [list(drawn(axes)) for axes in viz.plot_motion(piston, ["piston", "energy"]).axes]
    assert found == [["piston x", "piston y"]] * 2 + [["piston"]] * 2 + [["kinetic", "potential", "sum"]]
    force, residuals = viz.plot_motion(piston, ["residuals", "slide.force"]).axes
    assert force.get_ylabel() == "force [N]" and list(drawn(force)) == ["slide x", "slide y"]
    assert residuals.get_yscale() == "log"
    with pytest.raises(ValueError, match=r"Unknown body, joint or quantity 'slid'; did you mean 'slide'"):
        viz.plot_motion(piston, ["slid"])
    with pytest.raises(ValueError, match="two times or more"):
        viz.plot_motion(dataclasses.replace(piston, ts=piston.ts[:1]))


def test_a_slide_is_drawn_at_the_body_that_slides(piston):
    """The joint's point is at the origin when the piston is 0.3 m away, and no bar leads back to there."""
    picture = piston.system.catalogue.picture(piston.ts, piston.ys)
    np.testing.assert_allclose(picture.parts["slide"].points[1], 0.0, atol=1e-15)
    ends = picture.paths["slide"].points
    np.testing.assert_allclose(ends[:, 0], 0.0, atol=1e-15)
    np.testing.assert_allclose(ends[:, 1, 0], 0.3 + 0.1 * np.sin(TS))
    ((body, sleeve),) = picture.shapes
    assert body == "piston" and np.allclose(sleeve.position, 0.0)
    # A sleeve on the ground stays where it was given.
    fixed = sliding(body_a="piston", body_b="ground", point=(0.5, 0.0))
    still = fixed.system.catalogue.picture(fixed.ts, fixed.ys)
    np.testing.assert_allclose(still.parts["slide"].points[1], (0.5, 0.0, 0.0))


AXIS = np.array([0.6, 0.0, 0.8])
# Beside the axis.
PLACE = 2.0 * AXIS + (0.0, 0.1, 0.0)


@pytest.mark.parametrize("kind", [spatial.Prismatic, spatial.Cylindrical, spatial.Screw])
def test_slides_in_space_are_drawn_at_the_body_that_slides(kind):
    """At the point of the line next to the mass centre."""
    options = {"pitch": 0.01} if kind is spatial.Screw else {}
    poses = np.array([[0, 0, 0, 1, 0, 0, 0], [*PLACE, 0.5, 0.5, 0.5, 0.5]], float)
    joint = kind("slide", "ground", "nut", point=(0.0, 0.0, 0.0), axis=AXIS, **options).resolve(SPACE, poses)
    shown = joint.pictured(SPACE)
    np.testing.assert_allclose(SPACE.point(poses[1], shown.point_b), 2.0 * AXIS, atol=1e-12)
    np.testing.assert_allclose(shown.residual(SPACE, poses, 0.0), 0.0, atol=1e-12)


@pytest.mark.slow
def test_in_space_the_angles_are_those_of_joints():
    nut = spatial.Body("nut", mass=1.0, inertia=np.eye(3), position=PLACE)
    pin = spatial.Cylindrical("pin", "ground", "nut", point=(0.0, 0.0, 0.0), axis=AXIS)
    system = mb.Scene([nut], joints=[pin]).compile()
    motion = motion_of(system, [0.0, 1.0], np.tile(np.asarray(system.guess.q), (2, 1)), np.zeros((2, 6)))
    first, rate = viz.plot_motion(motion, "pin").axes[:2]
    assert list(drawn(first)) == list(drawn(rate)) == ["pin"]
    axes = viz.plot_mechanism(motion).axes[0]
    bars = [np.stack(line.get_data_3d(), axis=1) for line in axes.lines]
    bars = [points for points in bars if len(points) == 2]
    for ends in ([PLACE, 2.0 * AXIS], [(0.0, 0.0, 0.0), 2.0 * AXIS]):
        assert any(np.allclose(bar, ends, atol=1e-12) for bar in bars)
    assert axes.get_zlabel() == "z [m]"
    with pytest.raises(ValueError, match="at least 1"):
        viz.plot_mechanism(motion, frames=0)


@pytest.mark.slow
def test_a_motion_in_space_shows_places_of_bodies_and_coordinates_of_joints():
    """Of a nut that turns at 0.3 rad/s and moves by 0.1 m/s along its axis."""
    nut = spatial.Body("nut", mass=1.0, inertia=np.eye(3), position=PLACE)
    pin = spatial.Cylindrical("pin", "ground", "nut", point=(0.0, 0.0, 0.0), axis=AXIS)
    turn = lambda t: jnp.append(jnp.cos(0.15 * t), jnp.sin(0.15 * t) * AXIS)
    q = np.stack([np.append(rotate(turn(t), jnp.asarray(PLACE)) + 0.1 * t * AXIS, turn(t)) for t in TS])
    velocity = 0.1 * AXIS + np.cross(0.3 * AXIS, q[:, :3])
    system = mb.Scene([nut], joints=[pin]).compile()
    motion = motion_of(system, TS, q, np.column_stack([velocity, np.tile(0.3 * AXIS, (5, 1))]))
    *panels, energy, _ = viz.plot_motion(motion).axes
    shown = {axes.get_ylabel(): drawn(axes) for axes in panels}
    of_body = ["nut x", "nut y", "nut z"]
    expected = {
        "position [m]": of_body,
        "velocity [m/s]": of_body,
        "angle [rad]": ["pin"],
        "angular velocity [rad/s]": ["pin"],
        "displacement [m]": ["pin"],
        "rate of displacement [m/s]": ["pin"],
    }
    assert {label: list(lines) for label, lines in shown.items()} == expected
    for label, rate in (("angle [rad]", 0.3 * TS), ("angular velocity [rad/s]", 0.3), ("displacement [m]", 0.1 * TS)):
        np.testing.assert_allclose(shown[label]["pin"], rate, rtol=0, atol=1e-14)
    assert energy.get_ylabel() == "energy [J]"


def test_a_mechanism_of_the_plane_is_drawn_in_its_shapes():
    ball = planar.Body("ball", mass=1.0, inertia=0.1, position=(0.0, 0.4))
    floor = planar.Contact(
        "floor", "ball", terrain=terrain.Bump(start=0.25, length=1.0, peak=0.3), normal=contact.Linear(1e4), radius=0.1
    )
    spring = planar.SpringDamper("spring", "ground", "ball", stiffness=1.0, point_a=(0.0, 1.0))
    system = mb.Scene([ball], forces=[floor, spring]).compile()
    q = np.column_stack([TS, 0.4 + 0 * TS, 0 * TS])
    axes = viz.plot_mechanism(motion_of(system, TS, q, np.zeros((5, 3))), frames=2).axes[0]
    assert axes.get_title() == "t = 0, 1 s"
    discs = [patch.get_xy() for patch in axes.patches if np.allclose(np.ptp(patch.get_xy(), axis=0), 0.2, atol=2e-3)]
    centres = [0.5 * (disc.min(axis=0) + disc.max(axis=0)) for disc in discs]
    np.testing.assert_allclose(centres, [(0.0, 0.4), (1.0, 0.4)], atol=2e-3)
    *springs, path, end = axes.lines
    np.testing.assert_allclose(np.column_stack(path.get_data()), q[:, :2])
    assert end.get_label() == "ball"
    for line, x in zip(springs, (0.0, 1.0), strict=True):
        points = np.column_stack(line.get_data())
        np.testing.assert_allclose(points[[0, -1]], [(0.0, 1.0), (x, 0.4)], atol=1e-12)
    (ground,) = axes.collections
    assert np.max(ground.get_paths()[0].vertices[:, 1]) == pytest.approx(0.3, abs=0.05)


def test_discs_in_contact_are_drawn_as_wheels():
    others = {"radii": [0.2, 0.0], "centres": [(0.3, 0.1), (0.0, 0.0)]}
    part = planar.DiscContact("touch", ["a", "b", "c"], normal=contact.Linear(1e3), radius=0.5, **others)
    resolved = part.resolve(PLANE, np.zeros((3, 3)))
    discs = [(k, shape) for k, shape in resolved.shapes(PLANE, 0.01) if shape.primitive == "cylinder"]
    assert [k for k, _ in discs] == [0, 1]
    np.testing.assert_allclose([shape.scale[0] for _, shape in discs], [0.5, 0.2])
    np.testing.assert_allclose([shape.position for _, shape in discs], [(0, 0, 0), (0.3, 0.1, 0.0)])
