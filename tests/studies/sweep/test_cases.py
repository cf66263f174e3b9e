"""Cases of a sweep: grids, tables, samples, and what pandas and xarray hold."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import jaxmb as mb
from jaxmb.studies.sweep.cases import grid, sobol, table


def test_a_grid_has_all_combinations_and_the_last_parameter_runs_fastest():
    cases = grid({"rod.mass": [1.0, 2.0]}, b=[10, 20, 30])
    assert len(cases) == 6 and cases.grid == (("rod.mass", 2), ("b", 3))
    np.testing.assert_array_equal(cases.columns["rod.mass"], [1, 1, 1, 2, 2, 2])
    np.testing.assert_array_equal(cases.columns["b"], [10, 20, 30, 10, 20, 30])
    assert repr(cases) == "Cases: 6 members, a grid of rod.mass (2) × b (3)"
    points = grid(point=np.arange(6.0).reshape(3, 2), k=[1, 2])
    assert points.columns["point"].shape == (6, 2)


def test_a_table_repeats_single_numbers():
    cases = table({"a": [1.0, 2.0], "p": np.zeros((2, 3))}, g=9.81)
    assert len(cases) == 2 and cases.columns["p"].shape == (2, 3)
    np.testing.assert_array_equal(cases.columns["g"], [9.81, 9.81])
    assert table(cases) is cases


def test_a_sobol_sample_fills_its_box_evenly():
    cases = sobol(64, a=(1.0, 3.0), p=([0.0, -1.0], [1.0, 1.0]), k=(1e2, 1e6), log=["k"], seed=3)
    assert cases.columns["p"].shape == (64, 2)
    for values, low, high in (
        (cases.columns["a"], 1, 3),
        (cases.columns["p"][:, 1], -1, 1),
        (np.log(cases.columns["k"]), np.log(1e2), np.log(1e6)),
    ):
        # A net of base two has one point in each of 64 equal intervals.
        places = np.floor((values - low) / (high - low) * 64).astype(int)
        assert sorted(places) == list(range(64))
    again, other = (sobol(64, a=(1.0, 3.0), seed=seed).columns["a"] for seed in (3, 4))
    np.testing.assert_array_equal(again, sobol(64, a=(1.0, 3.0), seed=3).columns["a"])
    assert np.any(again != other)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("members", [1, 100, np.int64(64)])
def test_any_number_of_sobol_points_begins_the_same_sequence(members):
    found = sobol(members, a=(1.0, 3.0), b=(0.0, 1.0), seed=3)
    assert len(found) == members
    for name, column in sobol(128, a=(1.0, 3.0), b=(0.0, 1.0), seed=3).columns.items():
        np.testing.assert_array_equal(found.columns[name], column[:members])


def test_a_frame_and_a_dataset():
    frame = pd.DataFrame({"a": [1.0, 2.0, 3.0], "n": [1, 2, 3]})
    cases = table(frame)
    assert list(cases.columns) == ["a", "n"] and cases.columns["n"].dtype == np.int64
    data = xr.Dataset(
        {"a": ("run", [1.0, 2.0], {"units": "m"}), "b": ("side", [5.0, 6.0, 7.0])}, coords={"side": [7, 8, 9]}
    )
    cases = table(data)
    assert cases.grid == (("run", 2), ("side", 3)) and cases.units == {"a": "m"}
    np.testing.assert_array_equal(cases.columns["b"], [5, 6, 7, 5, 6, 7])
    found = mb.sweep(lambda a, b: {"c": a * b}, data, progress=False)
    np.testing.assert_array_equal(found["c"], data["a"] * data["b"])
    np.testing.assert_array_equal(found["side"], [7, 8, 9])
    only = xr.Dataset(coords={"a": [1.0, 2.0], "b": [3.0]})
    assert list(table(only).columns) == ["a", "b"] and len(table(only)) == 2
    assert list(table(xr.DataArray([1.0, 2.0], dims="run", name="a")).columns) == ["a"]


REFUSED = [
    (lambda: grid(), "at least one parameter"),
    (lambda: grid(a=[]), "'a' must be a list of at least one"),
    (lambda: grid(a=3.0), "'a' must be a list"),
    (lambda: grid({"a": [1.0]}, a=[2.0]), "'a' is given twice"),
    (lambda: grid({1: [1.0]}), "must be a string"),
    (lambda: grid(a=["x"]), "'a' must be real numbers"),
    (lambda: table(a=[1.0, np.nan]), "'a' is not finite in member 1"),
    (lambda: table(a=[1.0, 2.0], b=[1.0, 2.0, 3.0]), "one length, got 2 of 'a', 3 of 'b'"),
    (lambda: table(a=[[1.0], [1.0, 2.0]]), "'a' are not an array"),
    (lambda: table([1.0, 2.0]), "values by the parameter's name"),
    (lambda: table(pd.DataFrame([[1.0, 2.0]], columns=["a", "a"])), "'a' of the cases is there more than once"),
    (lambda: table(pd.DataFrame({"a": [1.0]}, index=[5])), "reset_index"),
    (lambda: table(pd.DataFrame({"a": [1.0, None]})), "'a' is not finite in member 1"),
    (lambda: table(xr.DataArray([1.0])), "has no name"),
    (lambda: table(xr.Dataset({"a": ("r", [1.0])}, coords={"t": ("r", [2.0])})), "reset_coords"),
    (lambda: sobol(0, a=(0, 1)), "members must be"),
    (lambda: sobol(True, a=(0, 1)), "members must be an integer"),
    (lambda: sobol(4, a=(1, 0)), "range of 'a' must be finite, the lowest"),
    (lambda: sobol(4, a=3.0), "range of 'a' must be the lowest"),
    (lambda: sobol(4, a=(0, 1), log=["a"]), "must be positive"),
    (lambda: sobol(4, alpha=(1, 2), log=["alfa"]), "did you mean 'alpha'"),
]


def test_cases_that_do_not_fit_are_named():
    for make, message in REFUSED:
        with pytest.raises(ValueError, match=message):
            make()
