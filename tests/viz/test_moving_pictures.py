"""Moving pictures show each saved state where it is; what they cannot show is refused by name."""

import base64
import dataclasses
import html
import re
import sys

import diffrax
import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
import zstandard
from every_part import SPACES, compiled as built
from trajectories import bounced, motion_of

import jaxmb as mb
from jaxmb import planar, shapes, spatial, terrain, viz
from jaxmb.cli.folders import check_picture, show_motion
from jaxmb.linalg import rotations as rot
from jaxmb.parts import contact
from jaxmb.viz.motion_nodes import chosen
from jaxmb.viz.one_motion import as_motion
from jaxmb.viz.solids import solids

MOST_PROGRAMS = 70

G, MASS, INERTIA, ARM, TIP = 9.81, 2.0, 0.3, 0.6, (0.4, 0.3)
# Of the pendulum: the node of the plate through its points.
PLATE = "/solids/mesh 0 of bar"


class Page:
    """The messages of a page, with their times, that viser plays; `duration` [s] of playing."""

    def __init__(self, html):
        found = re.search(r'__VISER_EMBED_DATA__="([^"]*)"', html)
        assert found is not None
        raw = zstandard.ZstdDecompressor().decompressobj().decompress(base64.b64decode(found.group(1))[8:])
        start = 8 + int.from_bytes(raw[:8], "little")
        content = msgspec.msgpack.decode(raw[8:start])
        self.duration, self.messages = content["durationSeconds"], content["messages"]
        self._buffers = []
        for length in content["binaryBufferLengths"]:
            start += -start % 8
            self._buffers.append(raw[start : start + length])
            start += length

    def names(self):
        """Nodes that the page shows."""
        return {message["name"] for _, message in self.messages if "props" in message}

    def values(self, name, field):
        """The times at which a property of a node is given, and its values from then on."""
        found = [
            (time, held[field])
            for time, message in self.messages
            if message.get("name") == name and field in (held := message.get("props") or message.get("updates") or {})
        ]
        return np.array([time for time, _ in found]), [self._read(value) for _, value in found]

    def _read(self, value):
        if isinstance(value, dict):
            return np.frombuffer(self._buffers[value["__binary_index"]], value["dtype"])
        return value


def at_rest(system, ts=(0.0, 1.0)):
    """A trajectory that stays in the state that a system was given."""
    still = lambda values: np.tile(np.asarray(values), (len(ts), 1))
    return motion_of(system, ts, still(system.guess.q), still(0 * system.guess.u))


@pytest.fixture(scope="module")
def pendulum():
    """A pendulum of the plane that turns once, with a spring, at uneven times."""
    bar = planar.Body("bar", mass=MASS, inertia=INERTIA, position=(ARM, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(-ARM, 0.0))
    spring = planar.SpringDamper("spring", "ground", "bar", stiffness=0.0, point_a=(0.0, 2.0), free_length=1.0)
    tip = planar.Frame("tip", "bar", position=TIP)
    system = mb.Scene([bar], joints=[pin], forces=[spring, mb.Gravity((0.0, -G))], frames=[tip]).compile()
    ts = np.array([0.0, 0.4, 1.0, 1.5, 2.6, 4.0])
    angle, rate = 2 * np.pi * ts / ts[-1], np.full_like(ts, 2 * np.pi / ts[-1])
    out = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    q = np.column_stack([ARM * out, angle])
    u = np.column_stack([ARM * rate[:, None] * np.stack([-out[:, 1], out[:, 0]], axis=1), rate])
    return motion_of(system, ts, q, u), ts, angle, rate


@pytest.fixture(scope="module")
def page(pendulum):
    return viz.show(pendulum[0], points=["tip", "pin", "bar"], reactions=["pin"], forces=["spring"])


@pytest.fixture(scope="module")
def read(page):
    return Page(page.html)


def test_page_is_complete(page, pendulum, tmp_path):
    """Nothing in it is fetched, and its size is that of viser's client and little more; in a notebook it is a frame."""
    assert not re.search(r"""(src|href)=["']?(https?:)?//|@import|url\(http""", page.html)
    assert page.html.count("<script") >= 2 and "http-equiv" not in page.html
    assert 0.5e6 < len(page.html) < 1.2e6
    assert page.frames == 6 and repr(page) == "MovingPicture(height=480, frames=6)"
    shown = re.fullmatch(r'<iframe srcdoc="([^"]*)" style="[^"]*height: 480px[^"]*"></iframe>', page._repr_html_())
    assert shown is not None and html.unescape(shown.group(1)) == page.html
    assert page.save(tmp_path / "a.html").read_text(encoding="utf-8") == page.html
    assert viz.save_html(pendulum[0], tmp_path / "b.html", frames=2).stat().st_size > 5e5


def test_bodies_are_where_they_were_at_the_saved_times(read, pendulum):
    """With springs between their points."""
    _, ts, angle, _ = pendulum
    assert {PLATE, "/solids/coils", "/reactions/pin", "/forces/spring", "/clock", "/grid"} <= read.names()
    assert read.duration == pytest.approx(ts[-1], rel=0.02)
    times, centres = read.values(PLATE, "batched_positions")
    assert np.allclose(times, ts)
    # One plate through the mass centre, the pin and the frame.
    out = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert np.allclose(np.array(centres)[:, :2], ARM * out, atol=3e-4)
    _, turns = read.values(PLATE, "batched_wxyzs")
    axis = np.array([np.asarray(rot.rotation_matrix(np.asarray(p, float)))[:, 0] for p in turns])
    assert np.allclose(axis[:, :2], out, atol=3e-4)
    corners = np.reshape(read.values(PLATE, "vertices")[1][0], (-1, 3))[:, :2]
    for corner in ((0.0, 0.0), (-ARM, 0.0), TIP):
        assert np.min(np.linalg.norm(corners - corner, axis=1)) < 1e-3
    clock = read.values("/clock", "text")
    assert np.allclose(clock[0], ts) and [float(text[4:8]) for text in clock[1]] == list(ts)
    start = np.array(read.values("/solids/coils", "batched_positions")[1])
    assert np.allclose(start, (0.0, 2.0, 0.0), atol=3e-4)
    length = np.array(read.values("/solids/coils", "batched_scales")[1])[:, 2]
    assert np.allclose(length, np.hypot(ARM * np.cos(angle), ARM * np.sin(angle) - 2.0), atol=3e-4)


@pytest.mark.slow
def test_event_is_named_for_half_a_second_of_playing():
    """The motion of 1.5 s is shown in 2 s."""
    times, texts = Page(viz.show(bounced()).html).values("/clock", "text")
    shown = np.array(["floor: impact" in text for text in texts])
    np.testing.assert_array_equal(shown, (np.array(times) >= 4 / 3 - 1e-6) & (np.array(times) < 4 / 3 + 0.5 - 1e-6))
    assert shown.any()


def test_trails_lead_to_the_points(read, pendulum):
    """So far a trail joins the places of the point; the rest has no length."""
    _, ts, angle, _ = pendulum
    own = {"tip": (ARM + 0.4, 0.3), "pin": (0.0, 0.0), "bar": (ARM, 0.0)}
    for name, (x, y) in own.items():
        places = np.stack([x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)], axis=1)
        times, segments = read.values(f"/trails/{name}", "points")
        for time, values in zip(times, segments, strict=True):
            k = int(np.argmin(np.abs(ts - time)))
            drawn = values.reshape(-1, 2, 3)[..., :2]
            assert np.allclose(drawn[:k, 0], places[:k], atol=3e-4)
            assert np.allclose(drawn[:k, 1], places[1 : k + 1], atol=3e-4)
            assert np.allclose(drawn[k:], places[k], atol=3e-4)


def test_arrows_are_the_forces(read, pendulum):
    """The reaction of a pendulum in closed form, m (a − g), to the scale that the picture names."""
    _, ts, angle, rate = pendulum
    times, ends = read.values("/reactions/pin", "points")
    assert np.allclose(times, ts)
    cell = read.values("/grid", "cell_size")[1][0]
    note = re.search(r"arrows (\S+) N a square", read.values("/clock", "text")[1][0])
    assert note is not None
    acceleration = -G * MASS * ARM * np.cos(angle) / (INERTIA + MASS * ARM**2)
    along, across = np.stack([np.cos(angle), np.sin(angle)]), np.stack([-np.sin(angle), np.cos(angle)])
    force = MASS * (ARM * (acceleration * across - rate**2 * along) + np.array([[0.0], [G]]))
    drawn = np.array(ends).reshape(-1, 2, 3)
    assert np.allclose(drawn[:, 0, :2], 0.0, atol=3e-4)
    assert np.allclose(drawn[:, 1, :2] * float(note.group(1)) / cell, force.T, atol=1e-3 * np.abs(force).max())


def test_states_are_shown_at_one_time(pendulum):
    motion, _, angle, _ = pendulum
    states = [jax.tree.map(lambda y, k=k: np.asarray(y)[k], motion.ys) for k in (0, 1)]
    picture = viz.show(states, system=motion.system, points="tip", overlay=True)
    assert picture.frames == 1 and Page(picture.html).values("/clock", "text")[0] == [0.0]
    single = viz.motion_nodes.motion("", chosen(as_motion(states[1], motion.system), 4, 1), {}, None)
    np.testing.assert_allclose(single.point("bar")[0, :2], ARM * np.array([np.cos(angle[1]), np.sin(angle[1])]))


def test_speed_stretches_and_shortens_the_time_of_playing(pendulum):
    """The last frame comes after the motion's time over the speed; short motions are stretched.

    Fewer frames are the saved times nearest to evenly spaced ones, with the first and the last; a word is one name.
    """
    trajectory = pendulum[0]
    fast = Page(viz.show(trajectory, points="pin", speed=8.0, frames=3).html)
    times, texts = fast.values("/clock", "text")
    assert np.allclose(times, np.array([0.0, 1.5, 4.0]) / 8) and [float(text[4:8]) for text in texts] == [0.0, 1.5, 4.0]
    assert "/trails/pin" in fast.names()
    # The bodies move at the speed of the clock.
    assert np.allclose(fast.values(PLATE, "batched_positions")[0], times)
    short = dataclasses.replace(trajectory, ts=np.asarray(trajectory.ts) / 100)
    times, texts = Page(viz.show(short, points=["pin", "pin"]).html).values("/clock", "text")
    assert times[-1] == pytest.approx(2.0) and "0.02 × real time" in texts[0] and texts[-1].startswith("t = 0.0400 s")


def test_several_motions_stand_apart_or_together(pendulum):
    trajectory, _, _, _ = pendulum
    apart = Page(viz.show({"before": trajectory, "after": trajectory}, points=["tip"]).html)
    assert {"/before/trails/tip", "/after/trails/tip", "/names/before", "/names/after"} <= apart.names()
    first, second = (np.array(apart.values(f"/{k}{PLATE}", "batched_positions")[1]) for k in ("before", "after"))
    shift = second - first
    assert np.allclose(shift, shift[0], atol=3e-4)
    assert max(abs(shift[0])) > max(np.ptp(first, axis=0)[:2])
    together = Page(viz.show([trajectory, trajectory], overlay=True).html)
    first, second = (np.array(together.values(f"/{k}{PLATE}", "batched_positions")[1]) for k in ("1", "2"))
    assert np.array_equal(first, second)
    colors = [together.values(f"/{k}{PLATE}", "batched_colors")[1][0] for k in ("1", "2")]
    assert not np.array_equal(*colors)


def test_given_shapes_take_the_place_of_bars(pendulum, tmp_path):
    import trimesh

    trimesh.creation.box((1.0, 2.0, 3.0)).export(tmp_path / "box.stl")
    read = shapes.Mesh.read(tmp_path / "box.stl", scale=0.1, position=(0.5, 0.0, 0.0), color=(1, 2, 3))
    assert np.allclose(np.ptp(read.vertices, axis=0), (0.1, 0.2, 0.3))
    given = {"bar": [shapes.Sphere(0.2), read], "ground": shapes.Box((0.1, 0.1, 0.1))}
    page = Page(viz.show(pendulum[0], shapes=given).html)
    assert "/solids/cylinder" not in page.names()
    (mesh,) = [name for name in page.names() if "mesh" in name]
    centre = np.array(page.values(mesh, "batched_positions")[1])
    assert np.allclose(np.linalg.norm(centre, axis=1), ARM + 0.5, atol=3e-4)
    assert np.array_equal(page.values(mesh, "batched_colors")[1][0], (1, 2, 3))


def test_bodies_on_which_nothing_acts_are_cuboids_of_their_inertia():
    moments = np.array([[2.0, 0.3, 0.1], [0.3, 1.5, -0.2], [0.1, -0.2, 1.2]])
    bodies = [spatial.Body("free", mass=3.0, inertia=moments), spatial.PointMass("mass", mass=1.0)]
    picture = at_rest(mb.Scene(bodies).compile())
    picture = picture.system.catalogue.picture(picture.ts, picture.ys)
    (_, box), (_, ball) = solids(picture, {}, None)
    x, y, z = box.scale
    own = np.diag([y**2 + z**2, z**2 + x**2, x**2 + y**2]) * 3.0 / 12
    turn = np.asarray(rot.rotation_matrix(box.orientation))
    assert np.allclose(turn @ own @ turn.T, moments) and ball.primitive == "sphere"


@pytest.mark.slow
def test_track_and_terrain_are_drawn():
    """A track wraps its circles: between equal ones two straight parts and one circumference."""
    wheels = [planar.Body(name, mass=1.0, inertia=0.1, position=(x, 0.5)) for name, x in (("a", 0.0), ("b", 3.0))]
    road = contact.Linear(1e4)
    touching = mb.planar.Contact(
        "road", ["a", "b"], terrain=terrain.Bump(start=1.0, length=1.0, peak=0.3), normal=road, radius=0.5
    )
    third = planar.Body("c", mass=1.0, inertia=0.1, position=(1.5, 1.5))
    points = [("a", (0.0, 0.0)), ("b", (0.0, 0.0)), ("c", (0.0, 0.0))]
    belt = planar.Track("belt", points, pretension=1.0, stiffness=10.0, radii=(0.5, 0.5, 0.5))
    system = mb.Scene([*wheels, third], forces=[touching, belt]).compile()
    still = at_rest(system)
    line = system.catalogue.picture(still.ts, still.ys).paths["belt"]
    corners = np.array([(0.0, 0.5), (3.0, 0.5), (1.5, 1.5)])
    around = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).sum() + np.pi
    drawn = np.linalg.norm(np.roll(line.points[0], -1, axis=0) - line.points[0], axis=1).sum()
    assert line.kind == "belt" and drawn == pytest.approx(around, rel=2e-3) and drawn < around
    assert np.allclose(np.min(np.linalg.norm(line.points[0][:, None, :2] - corners, axis=2), axis=1), 0.5)
    page = Page(viz.show(still).html)
    ground = page.values("/ground/0", "vertices")[1][0].reshape(-1, 3)
    assert ground[:, 1].max() == pytest.approx(0.3, abs=1e-3)


def test_parts_on_frames_are_drawn_there():
    hull = spatial.Body("hull", mass=1.0, inertia=np.eye(3), position=(1.0, 0.0, 0.0))
    turned = spatial.Frame(
        "corner", "hull", position=(0.0, 2.0, 0.0), orientation=(np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)
    )
    hinge = spatial.Revolute(
        "hinge", "corner", "ground", point_a=(0.0, 0.0, 0.5), point_b=(1.0, 1.5, 0.0), axis=(0.0, 1.0, 0.0)
    )
    system = mb.Scene([hull], joints=[hinge], frames=[turned]).compile()
    still = at_rest(system)
    picture = system.catalogue.picture(still.ts, still.ys)
    ((body, pin),) = picture.shapes
    # A quarter turn about x takes z to −y and y to z.
    assert body == "hull" and np.allclose(pin.position, (0.0, 1.5, 0.0))
    assert np.allclose(np.abs(rot.rotate(pin.orientation, np.array([0.0, 0.0, 1.0]))), (0.0, 1.0, 0.0))
    assert np.allclose(picture.parts["hinge"].points[0], (0.0, 1.5, 0.0))


@pytest.mark.parametrize("dimension", [2, 3])
def test_given_shapes_stand_in_the_frame_of_their_body(dimension):
    """Also where the origin of that frame is not the mass centre, as in files."""
    bodies = {
        2: planar.Body("arm", mass=1.0, inertia=1.0, position=(1.0, 2.0), angle=np.pi / 2, centre=(0.3, 0.1)),
        3: spatial.Body(
            "arm",
            mass=1.0,
            inertia=np.eye(3),
            position=(1.0, 2.0, 0.0),
            orientation=(np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)),
            centre=(0.3, 0.1, 0.0),
        ),
    }
    picture = at_rest(mb.Scene([bodies[dimension]]).compile())
    picture = picture.system.catalogue.picture(picture.ts, picture.ys)
    given = {"arm": shapes.Box((0.1, 0.1, 0.1), position=(0.5, 0.0, 0.0), orientation=(0.0, 1.0, 0.0, 0.0))}
    ((name, box),) = solids(picture, given, None)
    turn = np.asarray(rot.rotation_matrix(picture.orientations[name][0]))
    # The frame's origin is at (1, 2), and its x axis points upward.
    assert np.allclose(picture.positions[name][0] + turn @ box.position, (1.0, 2.5, 0.0))
    assert np.allclose(box.orientation, (0.0, 1.0, 0.0, 0.0))


# What is refused


def test_show_refuses_what_it_cannot_show(pendulum):
    trajectory = pendulum[0]
    ys = jax.tree.map(np.asarray, trajectory.ys)
    batch = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), trajectory)
    member = jax.tree.map(lambda leaf: leaf[0], batch)
    assert viz.show(member, frames=2).frames == 2
    q = ys.q.copy()
    q[3] = np.nan
    once = dataclasses.replace(trajectory, ts=trajectory.ts[:1], ys=jax.tree.map(lambda y: y[:1], ys))
    still = at_rest(mb.Scene([spatial.PointMass("mass", mass=1.0)]).compile())
    plain = mb.lagrangian.LagrangianSystem(lambda t, q, v, p: 0.5 * v[0] ** 2, q=[0.0])
    # Nothing is computed before names of bodies are looked up.
    nothing = dataclasses.replace(trajectory, ys=None)
    for shown, options, message in (
        (batch, {}, r"batch of shape \(2,\).*choose members"),
        (once, {}, "saved at two times or more"),
        (dataclasses.replace(trajectory, ys=mb.State(q, ys.u)), {}, r"at 1\.5 s is not finite"),
        ([3], {}, "returned by simulate, or states, got int"),
        ([trajectory.end], {}, "needs its system: give system=system"),
        ([], {}, "no motion"),
        ([trajectory, still], {}, "Planar and spatial"),
        (motion_of(plain, [0.0, 1.0], [[0.0], [1.0]], [[1.0], [1.0]]), {}, r"shows bodies.*plot_motion"),
        (nothing, {"shapes": {"baar": shapes.Sphere(0.2)}}, "Unknown body 'baar'; did you mean 'bar'"),
        (trajectory, {"points": ["tipp"]}, "did you mean 'tip'"),
        (trajectory, {"reactions": ["pins"]}, "did you mean 'pin'"),
        (trajectory, {"forces": ["sprung"]}, "did you mean 'spring'"),
        (trajectory, {"frames": 1}, "frames"),
        (trajectory, {"frames": 2.5}, "frames"),
        *((trajectory, {"speed": speed}, "speed") for speed in (0.0, np.nan, "fast")),
        (trajectory, {"height": -1}, "height"),
        (trajectory, {"shapes": {"bar": 3}}, "shapes"),
    ):
        with pytest.raises(ValueError, match=message):
            viz.show(shown, **options)
    with pytest.raises(ValueError, match="this mechanism has none"):
        check_picture(plain)


@pytest.mark.slow
def test_show_takes_internal_states():
    follow = lambda t, measured, states, p: (states["lag"], {"lag": -measured["angle"]})
    joint = planar.Revolute("pin", "ground", "wheel", point=(0.0, 0.0))
    hold = mb.Controller("hold", follow, {"angle": "pin.angle"}, "pin.angle", states={"lag": 1.0})
    system = mb.Scene([planar.Body("wheel", mass=1.0, inertia=0.1)], joints=[joint], forces=[hold]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=0.1, saveat=[0.0, 0.05, 0.1])
    assert viz.show(motion).html.count("<script") >= 2
    ys = motion.ys
    lost = dataclasses.replace(motion, ys=mb.State(ys.q, ys.u, ys.z.at[1].set(jnp.nan)))
    with pytest.raises(ValueError, match=r"The state at 0\.05 s is not finite"):
        viz.show(lost)


def test_page_with_names_that_have_its_marks():
    body = planar.Body("</script><b>", mass=1.0, inertia=0.1)
    motion = at_rest(mb.Scene([body]).compile())
    shown = viz.show({"<i>one": motion, "two": motion}, points="</script><b>")
    assert "</script><b>" not in shown.html and "<i>one" not in shown.html
    assert "/<i>one/trails/</script><b>" in Page(shown.html).names()


def test_shapes_are_checked():
    for build, message in (
        (lambda: shapes.Box((1.0, 2.0)), "three lengths"),
        (lambda: shapes.Sphere(0.0), "radius must be positive"),
        (lambda: shapes.Cylinder(1.0, np.nan), "length must be positive"),
        (lambda: shapes.Sphere(1.0, position=(0.0, 1.0)), "position must be 3 finite"),
        (lambda: shapes.Sphere(1.0, orientation=(0.0,) * 4), "orientation must not be zero"),
        (lambda: shapes.Mesh([[0.0, 0.0]], [[0, 0, 0]]), "shapes"),
        (lambda: shapes.Mesh(np.eye(3), [[0, 1, 3]]), "indices of vertices"),
    ):
        with pytest.raises(ValueError, match=message):
            build()


def test_shapes_along_a_direction_and_between_points():
    for axis in [*np.random.default_rng(0).standard_normal((5, 3)), (0.0, 0.0, -1.0), (0.0, 0.0, 2.0)]:
        turned = rot.rotate(shapes.along(axis), np.array([0.0, 0.0, 1.0]))
        assert np.allclose(turned, np.asarray(axis) / np.linalg.norm(axis))
    bar = shapes.Cylinder.between((1.0, 0.0, 0.0), (0.0, 2.0, 2.0), 0.1)
    place, turn = np.array([1.0, 2.0, 3.0]), rot.normalize(np.array([0.5, -0.2, 0.4, 0.8]))
    moved = bar.moved(place, turn)
    end = lambda shape: shape.position + rot.rotate(shape.orientation, np.array([0.0, 0.0, shape.length / 2]))
    assert np.allclose(end(bar), (0.0, 2.0, 2.0)) and np.allclose(end(moved), place + rot.rotate(turn, end(bar)))


def test_show_names_viser_where_it_is_missing(pendulum, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r'pip install "jaxmb\[view\]"'):
        viz.show(pendulum[0])
    with pytest.raises(RuntimeError, match=r"jaxmb\[view\]"):
        check_picture(pendulum[0].system)


def test_show_motion_opens_a_page_where_there_is_a_screen(pendulum, monkeypatch, tmp_path, capsys):
    opened = []
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or True)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    show_motion(tmp_path, pendulum[0])
    assert not opened and "motion.html" in (said := capsys.readouterr().out) and "no screen" in said
    monkeypatch.setenv("DISPLAY", ":0")
    show_motion(tmp_path, pendulum[0])
    assert opened == [(tmp_path / "motion.html").resolve().as_uri()] and "no screen" not in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("space", SPACES)
def test_part_has_its_picture(space):
    """Shapes and lines are finite, and lines between two points meet the anchors of the part."""
    for example in SPACES[space]:
        system = built(example)
        still = at_rest(system)
        picture = system.catalogue.picture(still.ts, still.ys)
        assert all(np.all(np.isfinite(shape.position)) for _, shape in picture.shapes), example.part.name
        for name, line in picture.paths.items():
            assert np.all(np.isfinite(line.points)), name
            if line.kind != "belt":
                part = picture.parts[name]
                for k, (body, point) in enumerate(zip(part.bodies, part.points, strict=True)):
                    turn = rot.rotate(picture.orientations[body][0], point)
                    assert np.allclose(line.points[0, k], picture.positions[body][0] + turn), name
        assert "/clock" in Page(viz.show(still).html).names()


@pytest.mark.slow
def test_show_takes_all_steps_of_a_simulation():
    """All steps, forwards and backwards in time."""
    body = spatial.Body("top", mass=1.0, inertia=np.diag([0.1, 0.1, 0.05]), position=(0.0, 0.1, 0.5))
    ball = spatial.Spherical("foot", "ground", "top", point=(0.0, 0.0, 0.0))
    system = mb.Scene([body], joints=[ball], forces=[mb.Gravity((0.0, 0.0, -G))]).compile()
    state = mb.assemble(system, rates={"top.angular_velocity": (0.0, 0.0, 20.0)})
    for t1 in (0.5, -0.5):
        steps = mb.simulate(system, state, t1=t1, rtol=1e-6, saveat=diffrax.SaveAt(t0=True, steps=True))
        assert viz.show(steps, points=["top"], reactions=["foot"]).frames == int(steps.stats["num_accepted_steps"]) + 1
