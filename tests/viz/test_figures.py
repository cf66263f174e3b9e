"""Figures show what moves, by name, and mechanisms in the shapes of their parts."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from trajectories import bounced, motion_of

import jaxmb as mb
from jaxmb import planar, shapes, spatial, terrain, viz
from jaxmb.linalg.rotations import rotate
from jaxmb.parts import contact
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.parts.spatial.kinematics import SPACE
from jaxmb.viz.meshes import unit_mesh
from jaxmb.viz.motion_nodes import chosen
from jaxmb.viz.silhouettes import area

MOST_PROGRAMS = 70

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


def test_plot_motion_shows_the_place_and_the_stroke_of_a_piston(piston):
    """Its height and angle stay zero and are left out; the displacement counts from the given pose."""
    place, rate, energy, residual = viz.plot_motion(piston).axes
    assert list(drawn(place)) == list(drawn(rate)) == ["piston x", "slide"]
    np.testing.assert_allclose(drawn(place)["piston x"], 0.3 + 0.1 * np.sin(TS))
    np.testing.assert_allclose(drawn(place)["slide"], 0.1 * np.sin(TS), atol=1e-15)
    np.testing.assert_allclose(drawn(rate)["slide"], 0.1 * np.cos(TS))
    labels = ["position, displacement [m]", "velocity [m/s]", "energy [J]"]
    assert [axes.get_ylabel() for axes in (place, rate, energy)] == labels
    assert list(drawn(residual)) == ["position", "velocity [1/s]"]
    np.testing.assert_allclose(drawn(energy)["sum"], (0.1 * np.cos(TS)) ** 2)


def test_plot_motion_shows_quantities_by_name(piston):
    # All of a part that describes its motion, but the components of a vector that are zero.
    *of_piston, energy = viz.plot_motion(piston, ["piston", "energy"]).axes
    assert [list(drawn(axes)) for axes in of_piston] == [["piston x"]] * 2 + [["piston"]] * 2
    assert list(drawn(energy)) == ["kinetic", "potential", "sum"]
    (one,) = (figure := viz.plot_motion(piston, "slide.displacement")).axes
    assert one.get_ylabel() == "displacement [mm]"
    np.testing.assert_allclose(drawn(one)["slide"], 100.0 * np.sin(TS), atol=1e-12)
    assert figure._repr_png_().startswith(b"\x89PNG")


def test_plot_motion_shows_a_constant_rate_and_not_a_body_at_rest():
    bodies = [planar.Body(name, mass=1.0, inertia=0.1) for name in ("wheel", "stone")]
    system = mb.Scene(bodies).compile()
    q, u = np.zeros((5, 6)), np.zeros((5, 6))
    q[:, 2], u[:, 2] = 3.0 * TS, 3.0
    angle, rate, _ = viz.plot_motion(motion_of(system, TS, q, u)).axes
    assert list(drawn(angle)) == list(drawn(rate)) == ["wheel"]
    np.testing.assert_allclose(drawn(rate)["wheel"], 3.0)


def padded(motion):
    """The same motion as of a run that ended before two more times at which it was to be saved."""
    more = lambda x: np.concatenate([x, np.full((2, *x.shape[1:]), np.inf)])
    return dataclasses.replace(motion, ts=more(motion.ts), ys=mb.State(more(motion.ys.q), more(motion.ys.u)))


def test_figures_leave_out_times_that_a_run_did_not_reach(piston):
    """Of a run that failed or ended at an event, saved under `jit`; a state is a motion with one time."""
    early = padded(piston)
    (axes,), (other,) = (viz.plot_motion(own, "slide.displacement").axes for own in (early, piston))
    np.testing.assert_array_equal(drawn(axes)["slide"], drawn(other)["slide"])
    assert viz.plot_mechanism(early).axes[0].get_title() == "t = 0, 0.25, 0.5, 0.75, 1 s"
    assert chosen(early, 10).ts.size == 5
    last = dataclasses.replace(piston, ts=piston.ts[-1:], ys=jax.tree.map(lambda y: y[-1:], piston.ys))
    own, other = viz.plot_mechanism(piston.end, system=piston.system).axes[0], viz.plot_mechanism(last).axes[0]
    assert (own.get_title(), other.get_title()) == ("", "t = 1 s")
    for line, same in zip(own.lines, other.lines, strict=True):
        assert line.get_label() == same.get_label()
        np.testing.assert_array_equal(line.get_xydata(), same.get_xydata())
    start = jax.tree.map(lambda y: y[0], piston.ys)
    both = viz.plot_mechanism([start, piston.end], system=piston.system).axes[0]
    assert both.get_title() == "" and len(both.patches) == len(own.patches) + 1  # The ground is drawn once.
    np.testing.assert_array_equal(both.patches[-1].get_xy(), own.patches[-1].get_xy())


def test_figures_of_what_they_cannot_show_are_refused(piston):
    state, ys = piston.end, jax.tree.map(np.asarray, piston.ys)
    batch = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), piston)
    q = ys.q.copy()
    q[3] = np.nan
    lost, early = dataclasses.replace(piston, ys=mb.State(q, ys.u)), padded(piston)
    stuck = dataclasses.replace(early, ts=np.where(np.arange(7) < 1, early.ts, np.inf), result=mb.RESULTS.newton_failed)
    nodes = lambda motion: chosen(motion, 10)
    members = r"batch of shape \(2,\); choose members of it, such as batch\[0\]"
    for picture, shown, options, message in (
        *((own, batch, {}, members) for own in (viz.plot_motion, viz.plot_mechanism, nodes)),
        *(
            (own, stuck, {}, "two times or more at which it is saved: Newton's method found no state")
            for own in (viz.plot_motion, nodes)
        ),
        *((own, lost, {}, r"The state at 0\.75 s is not finite") for own in (viz.plot_mechanism, nodes)),
        *(
            (viz.plot_mechanism, piston, {"frames": frames}, "frames must be an integer of at least 1")
            for frames in (0, 2.0, True)
        ),
        (viz.plot_motion, dataclasses.replace(piston, ts=piston.ts[:1]), {}, "two times or more"),
        (viz.plot_motion, piston, {"names": ["slid"]}, "Unknown body, joint or quantity 'slid'; did you mean 'slide'"),
        (viz.plot_motion, state, {}, "plot_motion shows a motion, got a State"),
        (viz.plot_mechanism, state, {}, "needs its system: give system=system"),
        (viz.plot_mechanism, [state, piston], {"system": piston.system}, "each of a list must be a state"),
        (viz.plot_mechanism, piston, {"system": piston.system}, "a motion has its own system"),
        (
            viz.plot_mechanism,
            mb.State(np.asarray(state.q)[:1], state.u),
            {"system": piston.system},
            r"got state\.q of shape",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            picture(shown, **options)


@pytest.mark.slow
def test_plot_motion_shows_events_as_lines_in_every_panel():
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


def test_slide_is_drawn_at_the_body_that_slides(piston):
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


def test_slide_in_space_is_drawn_at_the_body_that_slides():
    """At the point of the line next to the mass centre."""
    poses = np.array([[0, 0, 0, 1, 0, 0, 0], [*PLACE, 0.5, 0.5, 0.5, 0.5]], float)
    kinds = (spatial.Prismatic, spatial.Cylindrical, functools.partial(spatial.Screw, pitch=0.01))
    joints = [kind("slide", "ground", "nut", point=(0.0, 0.0, 0.0), axis=AXIS).resolve(SPACE, poses) for kind in kinds]

    @jax.jit
    def evaluate(joints, poses):
        shown = [joint.pictured(SPACE) for joint in joints]
        return [(SPACE.point(poses[1], own.point_b), own.residual(SPACE, poses, 0.0)) for own in shown]

    for point, residual in evaluate(joints, poses):
        np.testing.assert_allclose(point, 2.0 * AXIS, atol=1e-12)
        np.testing.assert_allclose(residual, 0.0, atol=1e-12)


@pytest.mark.slow
def test_figures_in_space_show_places_of_bodies_and_coordinates_of_joints():
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
        "position, displacement [m]": [*of_body, "pin"],
        "velocity [m/s]": [*of_body, "pin"],
        "angle [rad]": ["pin"],
        "angular velocity [rad/s]": ["pin"],
    }
    assert {label: list(lines) for label, lines in shown.items()} == expected
    for label, rate in (
        ("angle [rad]", 0.3 * TS),
        ("angular velocity [rad/s]", 0.3),
        ("position, displacement [m]", 0.1 * TS),
    ):
        np.testing.assert_allclose(shown[label]["pin"], rate, rtol=0, atol=1e-14)
    assert energy.get_ylabel() == "energy [J]"
    force, residuals = viz.plot_motion(motion, ["residuals", "pin.force"]).axes
    assert force.get_ylabel() == "force [N]" and list(drawn(force)) == ["pin x", "pin y", "pin z"]
    assert residuals.get_yscale() == "log"
    axes = viz.plot_mechanism(motion, frames=1).axes[0]
    bars = [np.stack(line.get_data_3d(), axis=1) for line in axes.lines]
    assert any(np.allclose(bar, [(0.0, 0.0, 0.0), 2.0 * AXIS], atol=1e-12) for bar in bars if len(bar) == 2)
    # The middles of the ends of a bar are corners of faces.
    corners = axes.collections[0]._faces.reshape(-1, 3)
    for end in (PLACE, 2.0 * AXIS):
        assert np.any(np.all(np.isclose(corners, end, atol=1e-12), axis=1))
    assert axes.get_zlabel() == "z [m]"


def test_plot_mechanism_of_the_plane_shows_shapes_of_parts():
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
    *springs, path, end, edge = axes.lines
    np.testing.assert_allclose(np.column_stack(path.get_data()), q[:, :2])
    assert end.get_label() == "ball"
    for line, x in zip(springs, (0.0, 1.0), strict=True):
        points = np.column_stack(line.get_data())
        np.testing.assert_allclose(points[[0, -1]], [(0.0, 1.0), (x, 0.4)], atol=1e-12)
    (ground,) = axes.collections
    assert np.max(ground.get_paths()[0].vertices[:, 1]) == pytest.approx(0.3, abs=0.05)
    # The edge of the ground hides behind no body.
    assert np.max(edge.get_ydata()) == pytest.approx(0.3, abs=0.05)
    assert edge.zorder > max(patch.zorder for patch in axes.patches)


def test_plot_mechanism_draws_given_shapes():
    system = mb.Scene([planar.Body("ball", mass=1.0, inertia=0.1)]).compile()
    rest = mb.State(np.zeros(3), np.zeros(3))
    given = {"ball": shapes.Sphere(0.3, color=(255, 0, 0)), "ground": shapes.Cylinder(2.0, 0.1)}
    axes = viz.plot_mechanism(rest, system=system, shapes=given).axes[0]
    assert [line.get_color() for line in axes.lines if line.get_label() == "ball"] == [(1.0, 0.0, 0.0)]
    widths = [np.ptp(patch.get_xy()[:, 0]) for patch in axes.patches]
    np.testing.assert_allclose(widths, [4.0, 0.6])
    with pytest.raises(ValueError, match="Unknown body 'bal'; did you mean 'ball'"):
        viz.plot_mechanism(rest, system=system, shapes={"bal": shapes.Sphere(0.3)})


def test_disc_contact_is_drawn_as_wheels():
    others = {"radii": [0.2, 0.0], "centres": [(0.3, 0.1), (0.0, 0.0)]}
    part = planar.DiscContact("touch", ["a", "b", "c"], normal=contact.Linear(1e3), radius=0.5, **others)
    resolved = part.resolve(PLANE, np.zeros((3, 3)))
    discs = [(k, shape) for k, shape in resolved.shapes(PLANE, 0.01) if shape.primitive == "cylinder"]
    assert [k for k, _ in discs] == [0, 1]
    np.testing.assert_allclose([shape.scale[0] for _, shape in discs], [0.5, 0.2])
    np.testing.assert_allclose([shape.position for _, shape in discs], [(0, 0, 0), (0.3, 0.1, 0.0)])


def test_shapes_are_drawn_in_the_plane_as_they_are_turned():
    turn = np.radians(30.0)
    place = {"position": (1.0, 0.5, 0.0), "orientation": (np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2))}
    corners = area(shapes.Box((2.0, 1.0, 0.5), **place))[:, :2]
    c, s = np.cos(turn), np.sin(turn)
    expected = np.array([(x, y) for x in (-1.0, 1.0) for y in (-0.5, 0.5)]) @ np.array([[c, s], [-s, c]]) + (1.0, 0.5)
    for corner in expected:
        assert np.min(np.linalg.norm(corners - corner, axis=1)) < 1e-12
    # A coil has eight turns.
    wire = unit_mesh("coil").vertices.reshape(-1, 6, 3).mean(axis=1)
    wound = wire[np.hypot(*wire[:, :2].T) > 0.8]
    assert 7.0 < np.ptp(np.unwrap(np.arctan2(wound[:, 1], wound[:, 0]))) / (2 * np.pi) <= 8.0
