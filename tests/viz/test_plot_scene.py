"""Scenes drawn before they move: names, points, and joints that do not close."""

import matplotlib.colors
import numpy as np
import pytest
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.proj3d import proj_transform

import jaxmb as mb
from jaxmb import planar, shapes, spatial, viz
from jaxmb.parts.shapes import DARK
from jaxmb.viz.mechanism import front_view
from jaxmb.viz.silhouettes import faces

MOST_PROGRAMS = 70


def bar(name, length, position, angle):
    return planar.Body(name, mass=1.0, inertia=planar.rod(1.0, length), position=position, angle=angle)


def four_bar(angle=0.6):
    """A scene whose given poses leave gaps."""
    return mb.Scene(
        [bar("crank", 1.0, (0.5, 0.0), 0.0), bar("rod", 2.0, (1.5, 0.8), angle), bar("rocker", 2.0, (2.2, 0.8), 1.2)],
        joints=[
            planar.Revolute("A", "ground", "crank", point_a=(0.0, 0.0), point_b=(-0.5, 0.0)),
            planar.Revolute("B", "crank", "rod", point_a=(0.5, 0.0), point_b=(-1.0, 0.0)),
            planar.Revolute("C", "rod", "rocker", point_a=(1.0, 0.0), point_b=(1.0, 0.0)),
            planar.Revolute("D", "rocker", "ground", point_a=(-1.0, 0.0), point_b=(2.0, 0.0)),
        ],
        forces=[planar.SpringDamper("spring", "ground", "rod", stiffness=10.0, free_length=1.0, point_a=(0.0, 2.0))],
    )


def read(figure):
    """The texts, the red lines as pairs of points, and the title."""
    (axes,) = figure.axes
    red = [line.get_xydata() for line in axes.lines if matplotlib.colors.to_rgb(line.get_color())[0] > 0.75]
    return {text.get_text() for text in axes.texts}, [line for line in red if len(line) == 2], axes.get_title()


def test_plot_scene_shows_the_gaps_of_the_given_poses():
    texts, gaps, title = read(viz.plot_scene(four_bar()))
    rod = np.array([1.5, 0.8]) - np.array([np.cos(0.6), np.sin(0.6)])
    assert {"crank", "rod", "rocker", "A", "spring"} <= texts
    assert f"B: {np.linalg.norm(rod - [1.0, 0.0]):.3g} m apart" in texts
    assert any(np.allclose(gap, [[1.0, 0.0], rod]) for gap in gaps) and len(gaps) == 3
    assert title == "open joints [m, rad]: C by 0.437, B by 0.402, D by 0.209"


def test_plot_scene_shows_an_assembled_system():
    system = four_bar().compile()
    texts, gaps, title = read(viz.plot_scene(system, mb.assemble(system, fix={"crank.angle": 1.0})))
    assert texts == {"crank", "rod", "rocker", "A", "B", "C", "D", "spring"}
    assert gaps == [] and title == "all joints are closed"


def test_plot_scene_writes_chosen_names_and_those_of_open_joints():
    texts, gaps, _ = read(viz.plot_scene(four_bar(), names=["rod", "A"]))
    assert {"rod", "A"} == {text for text in texts if "apart" not in text} and len(texts) == 5 and len(gaps) == 3
    system = four_bar().compile()
    state = mb.assemble(system, fix={"crank.angle": 1.0})
    assert read(viz.plot_scene(system, state, names=[]))[0] == set()
    with pytest.raises(ValueError, match=r"Unknown body or joint .rood.*rod"):
        viz.plot_scene(system, names=["rood"])


def test_given_shapes_stand_in_place_of_blocks_of_joints():
    """A slide's sleeve would hide the car that it carries."""
    car = planar.Body("car", mass=1.0, inertia=1.0, position=(0.0, 0.0))
    rail = planar.Prismatic("rail", "ground", "car", axis=(1.0, 0.0), point=(0.0, 0.0))
    system = mb.Scene([car], joints=[rail]).compile()
    sleeve, box = (*(np.array(DARK) / 255), 1.0), shapes.Box((2.0, 1.0, 1.0))
    is_sleeve = lambda patch: np.allclose(patch.get_facecolor(), sleeve) and patch.get_xy()[:, 1].max() > 0
    for given, count in (({}, 1), ({"car": box}, 0)):
        patches = viz.plot_scene(system, shapes=given).axes[0].patches
        assert sum(map(is_sleeve, patches)) == count


def test_plot_scene_shows_a_scene_that_cannot_be_compiled():
    """Its message names the picture."""
    short = mb.Scene(
        [bar("crank", 1.0, (0.5, 0.0), 0.0), bar("rod", 0.5, (1.2, 0.0), 0.0)],
        joints=[
            planar.Revolute("A", "ground", "crank", point_a=(0.0, 0.0), point_b=(-0.5, 0.0)),
            planar.Revolute("B", "crank", "rod", point_a=(0.5, 0.0), point_b=(-0.25, 0.0)),
            planar.Revolute("C", "rod", "ground", point_a=(0.25, 0.0), point_b=(4.0, 0.0)),
        ],
    )
    with pytest.raises(ValueError, match=r"cannot be assembled .* jaxmb\.viz\.plot_scene\(scene\) draws the gaps\."):
        short.compile()
    texts, gaps, _ = read(viz.plot_scene(short))
    assert "C: 2.55 m apart" in texts
    assert any(np.allclose(gap, [[1.45, 0.0], [4.0, 0.0]]) for gap in gaps)


def test_plot_scene_of_joints_whose_points_need_not_meet():
    """A slide is off its axis, whatever its displacement; in space a hinge may be turned only."""
    body = planar.Body("piston", mass=1.0, inertia=0.1, position=(0.5, 0.2))
    rail = planar.Prismatic("slide", "ground", "piston", axis=(1.0, 0.0), point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    texts, gaps, title = read(viz.plot_scene(mb.Scene([body], joints=[rail])))
    assert "slide: off by 0.2" in texts and gaps == [] and title.endswith("slide by 0.2")
    door = spatial.Body("door", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(0.0, 0.0, 0.0))
    hinge = spatial.Revolute(
        "hinge",
        "ground",
        "door",
        point=(0.0, 0.0, 0.0),
        axis_a=(0.0, 0.0, 1.0),
        axis_b=(0.0, 0.6, 0.8),
    )
    (axes,) = viz.plot_scene(mb.Scene([door], joints=[hinge], forces=[mb.Gravity((0.0, -9.81, 0.0))])).axes
    assert f"hinge: off by {np.sqrt(0.4):.3g}" in {text.get_text() for text in axes.texts}
    # Against gravity is up.
    x, y, _ = proj_transform([0.0, 0.0], [0.0, 0.1], [0.0, 0.0], axes.get_proj())
    assert y[1] > y[0] and abs(x[1] - x[0]) < 0.2 * (y[1] - y[0])


def test_plot_scene_of_parts_without_numbers_and_with_any_name_of_a_number():
    """The driver's angle is a function, and its points are the defaults; the gear has a number of the name `slack`."""
    scene = mb.Scene(
        [bar("crank", 1.0, (0.5, 0.0), 0.0)],
        joints=[
            planar.Revolute("A", "ground", "crank", point_a=(0.0, 0.0), point_b=(-0.5, 0.0)),
            planar.Driver("turn", "ground", "crank", quantity="angle", motion=lambda t, p: 2.0 * t),
        ],
        forces=[planar.DraftGear("gear", "ground", "crank", stiffness=1e5, preload=10.0, slack=0.02, unloading=0.4)],
    )
    texts, gaps, title = read(viz.plot_scene(scene))
    assert {"crank", "A", "gear"} <= texts and gaps == [] and title == "all joints are closed"


def test_plot_scene_refuses_what_it_cannot_draw():
    scene = four_bar()
    with pytest.raises(ValueError, match=r"at the poses of its bodies; a state needs a compiled system"):
        viz.plot_scene(scene, mb.State(np.zeros(9), np.zeros(9)))
    with pytest.raises(ValueError, match=r"draws a Scene or a compiled system, got a Body"):
        viz.plot_scene(scene.bodies[0])
    with pytest.raises(ValueError, match=r"draws bodies, and a LagrangianSystem has none"):
        viz.plot_scene(mb.mechanisms.appell_hamel().system)


def test_balls_of_a_chain_of_masses_do_not_touch():
    count = 12
    masses = [planar.PointMass(f"m{k}", mass=1.0, position=(float(k), 0.0)) for k in range(count)]
    rods = [planar.Distance(f"rod{k}", f"m{k}", f"m{k + 1}", length=1.0) for k in range(count - 1)]
    scene = mb.Scene(masses, joints=rods)
    (axes,) = viz.plot_scene(scene).axes
    balls = [np.ptp(patch.get_path().vertices[:, 0]) for patch in axes.patches]
    assert len(balls) == count and min(balls) > 0.05 and max(balls) < 0.5
    (axes,) = viz.plot_scene(scene, shapes={"m1": shapes.Box((0.9, 0.1, 0.1))}).axes
    assert any(np.ptp(patch.get_path().vertices[:, 0]) == pytest.approx(0.9) for patch in axes.patches)
    with pytest.raises(ValueError, match="Unknown body 'm99'"):
        viz.plot_scene(scene, shapes={"m99": shapes.Sphere(1.0)})


@pytest.mark.parametrize("flat", [False, True])
def test_plot_scene_has_room_beside_a_thin_machine(flat):
    way = np.array([1.0, 0.0] if flat else [0.0, 1.0])
    bodies = [planar.Body(f"b{k}", mass=1.0, inertia=0.1, position=(2 * k + 1) * way) for k in range(4)]
    ends = ["ground", *(body.name for body in bodies)]
    joints = [planar.Revolute(f"j{k}", ends[k], ends[k + 1], point=2 * k * way) for k in range(4)]
    (axes,) = viz.plot_scene(mb.Scene(bodies, joints=joints)).axes
    width, height = np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())
    assert height / width == pytest.approx(0.2 if flat else 2.5)


def overlaps(boxes):
    pairs = ((a, b) for k, a in enumerate(boxes) for b in boxes[:k])
    return [max(0.0, min(a.x1, b.x1) - max(a.x0, b.x0)) * max(0.0, min(a.y1, b.y1) - max(a.y0, b.y0)) for a, b in pairs]


def crowded(own, way, **axis):
    """Five bodies on one axle, and another one away."""
    at, inertia = 0.0 * np.array(way), 0.1 if own is planar else np.eye(3)
    bodies = [own.Body(f"wheel {k}", mass=1.0, inertia=inertia, position=at) for k in range(5)]
    bodies.append(own.Body("arm", mass=1.0, inertia=inertia, position=way))
    joints = [own.Revolute(f"axle {x.name}", "ground", x.name, point=at, **axis) for x in bodies]
    figure = viz.plot_scene(mb.Scene(bodies, joints=joints))
    figure.draw_without_rendering()
    return figure, figure.axes[0]


@pytest.mark.parametrize("way", [(1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
def test_names_neither_overlap_nor_leave_the_figure(way):
    figure, axes = crowded(planar, way) if len(way) == 2 else crowded(spatial, way, axis=(0.0, 0.0, 1.0))
    boxes = [super(type(text), text).get_window_extent() for text in axes.texts]
    assert len(boxes) == 12 and max(overlaps(boxes)) == 0.0
    for box in boxes:
        assert box.x0 >= 0 and box.y0 >= 0 and (box.max <= figure.bbox.max).all()


@pytest.mark.parametrize("way", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
def test_a_machine_in_space_fills_its_figure(way):
    figure, axes = crowded(spatial, way, axis=(0.0, 0.0, 1.0))
    shown = [*(axis.get_tightbbox() for axis in (axes.xaxis, axes.yaxis, axes.zaxis)), axes.title.get_window_extent()]
    low, high = np.min([box.min for box in shown], axis=0), np.max([box.max for box in shown], axis=0)
    size = figure.bbox.max
    assert (low >= 0).all() and (high <= size).all()
    assert (high - low)[1] > 0.9 * size[1] and ((high - low)[0] > 0.9 * size[0] or size[1] > 600)
    assert shown[-1].y0 > max(box.y1 for box in shown[:-1])


@pytest.mark.parametrize(
    "sizes, view", [((0.1, 2, 1), 20.0), ((2, 0.1, 1), 290.0), ((2, 1, 0.1), None), ((2, 1, 1), None)]
)
def test_a_machine_in_an_upright_plane_is_seen_from_its_front(sizes, view):
    limits = dict(zip(("xlim", "ylim", "zlim"), ((0.0, float(size)) for size in sizes), strict=True))
    axes = Figure().add_subplot(projection="3d", **limits)
    assert front_view(axes, np.array([0.0, 0.0, 1.0])).get("azim") == view


@pytest.mark.parametrize(
    "shape, area, rounding",
    [
        (shapes.Box((1.0, 2.0, 3.0)), 22.0, 1e-12),
        (shapes.Cylinder(0.5, 2.0), 2.5 * np.pi, 0.01),
        (shapes.Sphere(2.0), 16 * np.pi, 0.03),
        (shapes.Mesh(np.eye(3), [(0, 1, 2)]), np.sqrt(0.75), 1e-12),
    ],
)
def test_faces_of_shapes_have_their_areas(shape, area, rounding):
    """Also where shapes are turned; the ground has no faces."""
    polygons = faces(shape.moved((1.0, 2.0, 3.0), shapes.along((1.0, 1.0, 0.0))))
    arms = polygons - polygons[:, :1]
    areas = np.linalg.norm(0.5 * np.cross(arms[:, :-1], arms[:, 1:]).sum(axis=1), axis=1)
    assert areas.sum() == pytest.approx(area, rel=rounding)
    assert len(faces(shapes.Ground())) == 0


def test_faces_of_joints_and_of_the_ground_let_bodies_be_seen():
    _, axes = crowded(spatial, (1.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    (drawn,) = axes.collections
    opacities = drawn.get_facecolor()[:, 3]
    assert 0 < np.mean(opacities == 1.0) < 1 and opacities.min() == 0.25
