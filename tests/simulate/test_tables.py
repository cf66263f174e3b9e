"""Motions as tables of pandas and xarray, and read again as measurements."""

import sys

import numpy as np
import pytest
from trajectories import motion_of

import jaxmb as mb
from jaxmb import planar, spatial

TS = np.linspace(0.0, 1.0, 5)


def turning():
    """A bar of the plane that turns and moves."""
    bar = planar.Body("bar", mass=2.0, inertia=0.3)
    system = mb.Scene([bar]).compile()
    q = np.column_stack([TS, 2 * TS, 3 * TS])
    return motion_of(system, TS, q, np.tile([1.0, 2.0, 3.0], (5, 1)))


def test_a_frame_has_a_column_for_each_component():
    motion = turning()
    frame = motion.to_pandas()
    assert list(frame.columns)[:2] == ["t", "energy"] and "bar.position.y" in frame.columns
    np.testing.assert_array_equal(frame["bar.position.y"], 2 * TS)
    np.testing.assert_array_equal(frame["bar.angle"], 3 * TS)
    assert list(motion.to_pandas(["bar.angle"]).columns) == ["t", "bar.angle"]
    read = mb.read_measurements(frame, {"bar.position": ["bar.position.x", "bar.position.y"]})
    np.testing.assert_array_equal(read.values["bar.position"], np.column_stack([TS, 2 * TS]))


def test_a_dataset_has_dimensions_for_components():
    motion = turning()
    dataset = motion.to_xarray()
    assert dataset["bar.position"].dims == ("t", "axis") and list(dataset["axis"].values) == ["x", "y"]
    np.testing.assert_array_equal(dataset["bar.velocity"].sel(axis="y"), 2.0)
    np.testing.assert_allclose(dataset["energy"], motion.energy)
    read = mb.read_measurements(motion.to_xarray(["bar.position", "bar.angle"]))
    np.testing.assert_array_equal(read.ts, TS)
    np.testing.assert_array_equal(read.values["bar.position"], np.column_stack([TS, 2 * TS]))


def test_euler_parameters_have_their_own_dimension():
    system = mb.Scene([spatial.Body("top", mass=1.0, inertia=(1.0, 1.0, 2.0))]).compile()
    q = np.tile([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0], (5, 1))
    motion = motion_of(system, TS, q, np.zeros((5, 6)))
    dataset = motion.to_xarray(["top.orientation", "top.position"])
    assert dataset.sizes == {"t": 5, "euler_parameter": 4, "axis": 3}
    assert list(motion.to_pandas("top.orientation").columns) == ["t", *(f"top.orientation.{k}" for k in range(4))]


def test_what_is_no_table_is_refused(monkeypatch):
    motion = turning()
    with pytest.raises(ValueError, match=r"Unknown quantity 'bar\.angel'.*bar\.angle"):
        motion.to_pandas(["bar.angel"])
    with pytest.raises(TypeError, match=r"got \['bar\.angle'\]\. Give several names one after the other"):
        motion.plot(["bar.angle"])
    batch = motion_of(motion.system, np.tile(TS, (2, 1)), np.zeros((2, 5, 3)), np.zeros((2, 5, 3)))
    with pytest.raises(ValueError, match=r"a batch of shape \(2,\); choose a member"):
        batch.to_pandas()
    dataset = motion.to_xarray()
    with pytest.raises(ValueError, match=r"Unknown coordinate of time 'time'.*'t'"):
        mb.read_measurements(dataset, time="time")
    with pytest.raises(ValueError, match=r"variable 'bar\.angle' of the Dataset must have the dimension 't'"):
        mb.read_measurements(dataset[["bar.angle"]].isel(t=0).expand_dims(other=2).assign_coords(t=TS))

    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match='pip install "pandas"'):
        motion.to_pandas()


def test_events_are_a_table_in_which_losses_of_energy_add_up():
    """A ball with friction strikes a floor, and again: the parts lose the energy of an impact together."""
    times, lost = np.array([0.5, 0.8]), np.array([2.0, 0.25])
    events = mb.ContactEvents(
        names=("floor", "rub"),
        contacts=1,
        times=times,
        impulses=np.array([[3.0, -0.5], [1.0, -0.25]]),
        kinetic_energy_lost=lost,
        before=np.array([[0.0, 0.0], [0.0, 0.0]]),
        after=np.array([[0.0, 0.0], [0.0, 0.0]]),
        rest=np.zeros((2, 2)),
    )
    head, *rows = str(events).splitlines()
    assert head.split("  ")[0] == "time [s]" and "impulse [N s]" in head and head.endswith("kinetic energy lost [J]")
    assert [row.split() for row in rows] == [
        ["0.5", "floor", "impact", "3", "2"],
        ["0.5", "rub", "impact", "-0.5"],
        ["0.8", "floor", "impact", "1", "0.25"],
        ["0.8", "rub", "impact", "-0.25"],
    ]
    frame = events.to_pandas()
    assert list(frame.columns) == list(mb.Event._fields) and list(frame["part"]) == ["floor", "rub"] * 2
    np.testing.assert_array_equal(frame.groupby("time")["kinetic_energy_lost"].first(), lost)
    first = events[0]
    assert isinstance(first, mb.Event) and first.kinetic_energy_lost == 2.0
