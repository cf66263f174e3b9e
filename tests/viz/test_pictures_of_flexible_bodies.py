"""Pictures of flexible bodies and of beams follow their deformation."""

from typing import Any

import numpy as np
import pytest
from matplotlib.patches import Polygon
from trajectories import motion_of

import jaxmb as mb
from jaxmb import planar, sections, shapes, spatial, viz
from jaxmb.trajectory import picture_of, still
from jaxmb.viz.motion_nodes import motion
from jaxmb.viz.solids import solids

MOST_PROGRAMS = 120

BAR: dict[str, Any] = {"length": 0.8, "young": 2e11, "density": 7800.0, "width": 0.03, "thickness": 0.01}
WIRE = sections.Section(bending_stiffness=1.0)


def bent(system, q, **changed):
    """The picture of a state, with given last coordinates."""
    state = np.array(system.guess.q)
    state[len(state) - len(q) :] = q
    return picture_of(still(system, mb.State(state, np.zeros(system.nu))), **changed)


def cantilever():
    rod = planar.ElasticBar("rod", angle=np.pi / 2, position=(0.5, 0.0), **BAR)
    clamp = planar.Fixed("clamp", "ground", "rod", point=(0.5, 0.0))
    pull = planar.PointForce("pull", "end", force=(1.0, 0.0), point=(0.0, 0.1))
    frames = [planar.BarFrame("tip", "rod"), planar.Frame("end", "tip", position=(0.05, 0.0))]
    return mb.Scene([rod], joints=[clamp], forces=[pull], frames=frames).compile()


@pytest.mark.slow
def test_bar_is_drawn_along_its_deflected_line():
    """A unit of the first mode bends a bar as a moment at its end does; parts are drawn where its frames are."""
    system = cantilever()
    picture = bent(system, (0.02, 0.0))
    ((kind, line),) = picture.paths.values()
    share = np.linspace(0.0, 1.0, line.shape[1])
    assert kind == "bar"
    np.testing.assert_allclose(line[0, :, 0], 0.5 - 0.02 * share**2, rtol=0, atol=1e-12)
    np.testing.assert_allclose(line[0, [0, -1], 1], [0.0, 0.8 - 2 / 3 * 0.02**2 / 0.8], rtol=0, atol=1e-9)
    np.testing.assert_allclose(picture.positions["tip"][0], line[0, -1], rtol=0, atol=1e-12)
    turn = np.pi / 2 + 2 * np.arctan(0.025)
    away = 0.05 * np.array([np.cos(turn), np.sin(turn), 0.0])
    np.testing.assert_allclose(picture.positions["end"][0], line[0, -1] + away, rtol=0, atol=1e-12)
    assert picture.parts["pull"].bodies == ("end",)
    np.testing.assert_allclose(picture.parts["pull"].points[0], [0.0, 0.1, 0.0])
    assert picture.bodies == ("rod",)
    assert picture.owners == {"tip": "rod", "end": "rod"}


def test_deformation_is_magnified_from_the_undeformed_bar():
    system = cantilever()
    once, thrice = (bent(system, (0.02, 0.0), deformation=x).paths["rod"].points[0] for x in (1.0, 3.0))
    straight = np.linspace([0.5, 0.0, 0.0], [0.5, 0.8, 0.0], len(once))
    np.testing.assert_allclose(thrice - straight, 3 * (once - straight), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_deformation_between_joints_is_magnified_from_the_chord():
    rod = planar.ElasticBar("rod", **BAR)
    pins = [
        planar.Revolute("A", "ground", "rod", point=(0.0, 0.0)),
        planar.PointOnLine("B", "ground", "tip", point_a=(0.0, 0.0), point_b=(0.0, 0.0), axis_a=(1.0, 0.0)),
    ]
    system = mb.Scene([rod], joints=pins, frames=[planar.BarFrame("tip", "rod")]).compile()
    q = (-0.025, 0.02, 0.0)
    once, thrice = (bent(system, q, deformation=x) for x in (1.0, 3.0))
    (_, line), (_, magnified) = once.paths["rod"], thrice.paths["rod"]
    np.testing.assert_allclose(magnified[0, [0, -1]], line[0, [0, -1]], rtol=0, atol=1e-12)
    np.testing.assert_allclose(magnified[0, 8, 1] - line[0, 8, 1], 2 * (line[0, 8, 1] - line[0, -1, 1] / 2), rtol=1e-6)
    np.testing.assert_array_equal(thrice.positions["tip"], once.positions["tip"])


def test_elastic_body_is_drawn_to_its_frames():
    rng = np.random.default_rng(0)
    shape: dict[str, Any] = {"shapes": ((0.0,), (1.0,), (0.5,)), "turning": np.zeros((3, 1))}
    body = spatial.ElasticBody(
        "body",
        mass=2.0,
        first_moment=np.zeros(3),
        second_moment=np.eye(3),
        modal_moments=np.zeros((1, 3)),
        mixed_moments=np.zeros((1, 3, 3)),
        modal_products=0.1 * np.eye(3)[None, None],
        stiffness=((10.0,),),
    )
    places = {"left": (-1.0, 0.0, 0.0), "right": (1.0, 0.0, 0.0)}
    frames = [spatial.ModalFrame(name, "body", position=at, **shape) for name, at in places.items()]
    system = mb.Scene([body], frames=frames).compile()
    zeta = float(rng.normal())
    (kind, line), *_ = bent(system, (zeta,)).paths.values()
    moved = zeta * np.array([0.0, 1.0, 0.5])
    assert kind == "bar"
    np.testing.assert_allclose(
        line[0], [np.zeros(3), places["left"] + moved, np.zeros(3), places["right"] + moved], rtol=0, atol=1e-12
    )


@pytest.mark.slow("jaxmb.spatial")
@pytest.mark.parametrize("space", [planar, spatial])
def test_beam_is_drawn_along_its_sections(space):
    """The curve of a quarter turn is near an arc."""
    d = 2 if space is planar else 3
    section = WIRE if d == 2 else sections.Circle(radius=0.01, modulus=1e9, poisson_ratio=0.3)
    own = space.beam_chain("b", np.linspace(np.zeros(d), np.eye(d)[0], 2), section, mass=1.0, inextensible=True)
    system = mb.Scene(own.bodies, joints=own.joints, forces=own.forces).compile()
    half = np.sqrt(0.5)
    picture = bent(system, (1.0, 1.0, np.pi / 2) if d == 2 else (1.0, 1.0, 0.0, half, 0.0, 0.0, half))
    kind, line = picture.paths["b1"]
    assert kind == "bar"
    np.testing.assert_allclose(np.linalg.norm(line[0] - [0.0, 1.0, 0.0], axis=1), 1.0, rtol=0, atol=0.05)
    np.testing.assert_allclose(line[0, [0, -1]], [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]], rtol=0, atol=1e-12)
    # Nodes are no boxes.
    shown = [shape for name, shape in solids(picture, {}, None) if name.startswith("b_node")]
    assert all(isinstance(shape, shapes.Sphere) for shape in shown)


def test_pictures_of_a_bar():
    """Of both kinds, with a note about the scale."""
    system = cantilever()
    q = np.tile(np.asarray(system.guess.q), (3, 1))
    q[:, 3] = [0.0, 0.01, 0.02]
    moving = motion_of(system, (0.0, 0.5, 1.0), q, np.zeros((3, system.nu)))
    axes = viz.plot_mechanism(moving, frames=1, deformation=5.0).axes[0]
    assert axes.get_title() == "t = 0 s  ·  deformations × 5"
    assert len([patch for patch in axes.patches if isinstance(patch, Polygon)]) > 16
    page = viz.show(moving, deformation=5.0, forces="pull")
    assert page.frames == 3
    own = motion("", moving, {}, None, 5.0)
    np.testing.assert_allclose(own.bounds[0, 0], 0.4, rtol=0, atol=0.05)
    start, _ = own.force("pull")
    np.testing.assert_allclose(start[:, 0, 0], own.picture.positions["end"][:, 0] - 0.1, atol=0.01)
