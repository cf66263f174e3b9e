"""Motions as files of moving pictures."""

import itertools
import stat
import sys

import numpy as np
import pytest
from PIL import Image
from trajectories import motion_of

import jaxmb as mb
from jaxmb import planar, shapes, viz

TS = np.linspace(0.0, 3.0, 7)


@pytest.fixture(scope="module")
def swing():
    bar = planar.Body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    system = mb.Scene([bar], joints=[planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))]).compile()
    q = np.column_stack([0.5 * np.cos(TS), 0.5 * np.sin(TS), TS])
    return motion_of(system, TS, q, np.zeros((7, 3)))


def test_save_movie_draws_the_saved_states_in_their_time(swing, tmp_path):
    path = viz.save_movie(swing, tmp_path / "swing.gif", speed=1.5)
    with Image.open(path) as picture:
        assert picture.n_frames == 7 and picture.info["loop"] == 0
        seen = []
        for k in range(7):
            picture.seek(k)
            # 3 s at one and a half times real time.
            assert abs(picture.info["duration"] - 2000 / 6) <= 10
            seen.append(np.asarray(picture.convert("L"), float))
    assert len({frame.shape for frame in seen}) == 1
    assert all(np.mean(np.abs(a - b)) > 0.5 for a, b in itertools.pairwise(seen))


def test_save_movie_draws_given_shapes(swing, tmp_path):
    """A large box hides the pin, and fills much of the picture."""
    filled = []
    for given in ({}, {"bar": shapes.Box((1.0, 1.0, 0.1))}):
        with Image.open(viz.save_movie(swing, tmp_path / "swing.gif", frames=2, shapes=given)) as picture:
            filled.append(np.mean(np.asarray(picture.convert("L")) < 200))
    assert filled[1] > 3 * filled[0]


def test_save_movie_leaves_out_states_beyond_a_number_of_frames(swing, tmp_path):
    with Image.open(viz.save_movie(swing, tmp_path / "swing.gif", frames=3, trails=False)) as picture:
        assert picture.n_frames == 3


def test_save_movie_gives_frames_to_ffmpeg(swing, tmp_path, monkeypatch):
    program, seen = tmp_path / "ffmpeg", tmp_path / "seen"
    program.write_text(
        f"#!{sys.executable}\nimport sys\nopen({str(seen)!r}, 'wb').write(sys.stdin.buffer.read())\n"
        "open(sys.argv[-1], 'w').write(' '.join(sys.argv[1:-1]))\n"
    )
    program.chmod(program.stat().st_mode | stat.S_IEXEC)
    monkeypatch.setenv("PATH", str(tmp_path))
    path = viz.save_movie(swing, tmp_path / "swing.mp4", frames=3)
    assert "-framerate 0.666667 -i -" in path.read_text()
    assert seen.read_bytes().count(b"\x89PNG") == 3


def test_moving_pictures_in_files_say_what_is_missing(swing, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RuntimeError, match=r"needs the program ffmpeg, which is not found; a \.gif needs none"):
        viz.save_movie(swing, "swing.mp4")
    with pytest.raises(ValueError, match=r"writes \.gif and \.mp4, got 'swing\.avi'"):
        viz.save_movie(swing, "swing.avi")
    with pytest.raises(ValueError, match=r"speed must be a positive number, got -1\.0"):
        viz.save_movie(swing, "swing.gif", speed=-1.0)
    with pytest.raises(ValueError, match=r"shows bodies, and a LagrangianSystem has none"):
        system = mb.mechanisms.appell_hamel().system
        viz.save_movie(motion_of(system, TS, np.zeros((7, system.nq)), np.zeros((7, system.nu))), "swing.gif")
