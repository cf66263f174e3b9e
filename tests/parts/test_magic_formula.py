"""The Magic Formula: against its equations in NumPy, its properties, and files of coefficients."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from every_part import TYRE_FILE
from oracles import magic_formula as oracle

import jaxmb as mb
from jaxmb import spatial
from jaxmb.parts import magic_formula, tir

FILES = {"5.2": Path(oracle.__file__).parents[1] / "example_52.tir", "6.1": TYRE_FILE}
VERSIONS = pytest.mark.parametrize("version", FILES)
SCALES = """LFZO LCX LMUX LEX LKX LHX LVX LCY LMUY LEY LKY LHY LVY LTR LRES LXAL LYKA LVYKA LS LMX LVMX LMY"""
OWN_SCALES = {"5.2": "LGAX LGAY LGAZ LSGKP LSGAL", "6.1": "LKYC LKZC"}
# Odd parts of the forces: offsets, and the parts of a tyre that is not symmetric.
SKEW = """
PHX1 PHX2 PVX1 PVX2 PHY1 PHY2 PVY1 PVY2 PEX4 PEY3 RHX1 RBY3 RHY1 RHY2 RVY1 RVY2 QHZ1 QHZ2 QDZ6 QDZ7 QEZ4 SSZ1 QSX1
QBZ4 QDZ3
"""


def data(version, **changes):
    return tir.read("tyre", FILES[version]).coefficients | changes


def symmetric(version):
    return data(version, **dict.fromkeys(SKEW.split(), 0.0))


def at(version, coefficients, load, gamma=0.0, pressure=2.2e5):
    return magic_formula.Point(version, coefficients, load, gamma, pressure if version == "6.1" else None)


def forces(version, coefficients, kappa, alpha, gamma, load, pressure=2.2e5, speed=20.0, travel=1.0):
    slip_speed = speed * jnp.hypot(kappa, jnp.tan(alpha))
    point = at(version, coefficients, load, gamma, pressure)
    return jnp.stack(point.forces(kappa, alpha, speed, slip_speed, travel))


MANY = 4000


@functools.partial(jax.jit, static_argnums=0)
def _along(version, own, rows):
    """One program for all coefficients of a version."""

    def single(x):
        return forces(version, own, *x), at(version, own, x[3], x[2], x[4]).relaxation_lengths()

    return jax.vmap(single)(rows)


def along(version, own, kappa=0.0, alpha=0.0, gamma=0.0, load=4000.0, pressure=2.2e5, speed=20.0, travel=1.0):
    """Forces and moments, and relaxation lengths, at as many values."""
    columns = np.broadcast_arrays(*np.atleast_1d(kappa, alpha, gamma, load, pressure, speed, travel))
    rows = np.ones((MANY, 7))
    rows[: len(columns[0])] = np.stack(columns, axis=1)
    own = {key: float(value) if isinstance(value, int | float) else value for key, value in own.items()}
    numbers = {key: value for key, value in own.items() if isinstance(value, float)}
    found = _along(version, numbers, rows)
    return [np.asarray(x)[: len(columns[0])] for x in found]


def grid(seed, count=MANY):
    """Slips, inclinations, loads, pressures and speeds, some of them zero."""
    rng = np.random.default_rng(seed)
    low, high = np.array([-1.0, -1.0, -0.25, 200.0, 1.5e5, 3.0]), np.array([1.0, 1.0, 0.25, 8000.0, 3.0e5, 50.0])
    values = rng.uniform(low, high, (count, 6))
    values[:, :3] *= rng.uniform(size=(count, 3)) ** 3 * (rng.uniform(size=(count, 3)) > 0.2)
    return values.T


def scaled(version, seed):
    """The coefficients of a file and its scaling factors, changed at random, in SI units and as the oracle has them."""
    rng = np.random.default_rng(seed)
    names = f"{SCALES} {OWN_SCALES[version]}".split()
    changes = dict(zip(names, rng.uniform(0.8, 1.2, len(names)), strict=True))
    changes["LVX"] = -0.7
    if version == "6.1":
        changes["LMUV"] = 0.2
    numbers = oracle.coefficients(FILES[version]) | changes
    own = data(version, **changes)
    return own, numbers | {key: own[key] for key in ("UNLOADED_RADIUS", "LONGVL")}


@VERSIONS
def test_forces_and_moments_are_those_of_the_equations(version):
    kappa, alpha, gamma, load, pressure, speed = grid(0)
    own, numbers = scaled(version, 1)
    if version == "6.1":
        expected, *sigma = oracle.version_61(numbers, load, kappa, alpha, gamma, pressure, speed)
    else:
        expected, *sigma = oracle.version_52(numbers, load, kappa, alpha, gamma, speed)
    found, lengths = along(version, own, kappa, alpha, gamma, load, pressure, speed)
    for value, reference in zip(found.T, expected, strict=True):
        np.testing.assert_allclose(value, reference, rtol=1e-12, atol=1e-12 * np.max(np.abs(reference)))
    np.testing.assert_allclose(lengths, np.maximum(np.stack(sigma, axis=1), 0.1 * 0.32), rtol=1e-13)


@VERSIONS
def test_a_symmetric_tyre_has_odd_forces(version):
    """Braking is driving turned round, and slip to the right that to the left, with the wheel leaning the other way."""
    own = symmetric(version)
    kappa, alpha, gamma, load, *_ = grid(3, 200)
    side = np.array([1.0, -1.0, -1.0, 1.0, -1.0])
    found, mirrored = (along(version, own, kappa, s * alpha, s * gamma, load)[0] for s in (1, -1))
    np.testing.assert_allclose(mirrored, side * found, rtol=1e-12, atol=1e-9)
    driven, braked = (along(version, own, s * kappa, alpha, 0.0, load)[0] for s in (1, -1))
    np.testing.assert_allclose(braked[:, 0], -driven[:, 0], rtol=1e-12, atol=1e-9)


@pytest.mark.slow
@VERSIONS
def test_slopes_and_peaks_are_those_of_the_equations(version):
    own = symmetric(version)
    by_slip = jax.jit(jax.jacfwd(lambda slip: forces(version, own, slip[0], slip[1], 0.0, 3000.0)))
    slopes, point = by_slip(jnp.zeros(2)), at(version, own, 3000.0)
    np.testing.assert_allclose(slopes[0, 0], point.longitudinal_stiffness(), rtol=1e-12)
    np.testing.assert_allclose(slopes[1, 1], point.cornering_stiffness(0.0), rtol=1e-12)
    # The pneumatic trail at zero slip, besides the residual moment.
    share = 1 - own.get("PPZ1", 0.0) * point.dpi
    trail = (own["QDZ1"] + own["QDZ2"] * point.dfz) * share * 0.32 * 3000.0 / 4000.0
    np.testing.assert_allclose(slopes[4, 1], -trail * slopes[1, 1], rtol=1e-12)
    slips = np.linspace(0.0, 1.2, 400)
    ahead = along(version, own, slips, load=3000.0)[0][:, 0]
    across = along(version, own, 0.0, slips, load=3000.0)[0]
    by_pressure = lambda a, b: 1 + own.get(a, 0.0) * point.dpi + own.get(b, 0.0) * point.dpi**2
    largest_x = 3000.0 * (own["PDX1"] + own["PDX2"] * point.dfz) * by_pressure("PPX3", "PPX4")
    largest_y = 3000.0 * (own["PDY1"] + own["PDY2"] * point.dfz) * by_pressure("PPY3", "PPY4")
    np.testing.assert_allclose(np.max(ahead), largest_x, rtol=1e-4)
    np.testing.assert_allclose(np.max(-across[:, 1]), largest_y, rtol=1e-4)
    # The aligning moment turns the wheel to where it moves, and changes its sign at large slip.
    moment = across[1:, 4]
    assert moment[0] > 0 and moment[-1] < 0 and np.sum(np.diff(np.sign(moment)) != 0) == 1


@VERSIONS
def test_combined_slip_leaves_less_of_each_force(version):
    own = symmetric(version)
    pure_x, pure_y, both = along(version, own, np.array([0.1, 0.0, 0.1]), np.array([0.0, 0.1, 0.1]))[0]
    assert 0 < both[0] < pure_x[0] and pure_y[1] < both[1] < 0
    assert np.hypot(*both[:2]) < 1.05 * max(pure_x[0], -pure_y[1])


@VERSIONS
def test_forces_beyond_the_limits(version):
    """As at the limits, and below the least load in proportion to it."""
    own = data(version)
    inside = np.array([1.5, 1.2, 0.3, 1e4, 4e5])
    beyond = np.array([2.5, 1.3, 0.9, 3e4, 9e5])
    found, _ = along(version, own, *np.stack([inside, beyond], axis=1))
    np.testing.assert_allclose(found[1], found[0], rtol=1e-14)
    loads = np.array([100.0, 25.0, 0.0])
    found, _ = along(version, own, 0.1, 0.1, 0.1, loads, 2e5)
    np.testing.assert_allclose(found, loads[:, None] / 100.0 * found[:1], rtol=1e-13, atol=1e-13)


@VERSIONS
def test_a_wheel_that_rolls_backwards(version):
    """The trail lies behind the contact, and the moments resist the motion; forces at a slip stay."""
    own = symmetric(version)
    forwards, backwards = along(version, own, alpha=0.05, travel=np.array([1.0, -1.0]))[0]
    np.testing.assert_allclose(backwards, forwards * [1.0, 1.0, 1.0, -1.0, -1.0], rtol=1e-12, atol=1e-9)
    (still,), _ = along(version, data(version), speed=0.0, travel=0.0)
    np.testing.assert_allclose(still[[0, 1, 3, 4]], 0.0, atol=1e-12)


@pytest.mark.slow
@VERSIONS
def test_derivatives_are_finite_everywhere(version):
    """At zero slip, load, inclination and speed, and at the limits."""
    own = jax.tree.map(jnp.asarray, data(version))
    function = lambda own, x: jnp.concatenate(
        [forces(version, own, *x[:5], x[5], x[6]), at(version, own, x[3], x[2], x[4]).relaxation_lengths()]
    )
    both = jax.jit(jax.vmap(jax.jacrev(function, argnums=(0, 1)), in_axes=(None, 0)))
    ordinary = np.array([0.05, 0.1, 0.02, 3000.0, 2.2e5, 10.0, 1.0])
    at_limits = np.array([1.5, 1.2, 0.3, 1e4, 4e5, 10.0, 1.0])
    points = [np.where(np.arange(7) == k, 0.0, ordinary) for k in (0, 1, 2, 3, 5, 6)]
    points += [ordinary, at_limits, np.zeros(7) + 2e5 * (np.arange(7) == 4), np.where(np.arange(7) < 3, 0.0, ordinary)]
    for leaf in jax.tree.leaves(both(own, jnp.array(points))):
        assert np.all(np.isfinite(leaf))


@pytest.mark.slow("6.1")
@VERSIONS
def test_a_road_without_friction(version):
    """At zero of each factor of friction and shape the forces and derivatives are finite, and the limits of those next
    to zero; without any friction there are only the parts that need none.
    """
    names, base = ("LMUX", "LMUY", "LCX", "LCY"), data(version)
    slips = np.array([(0.05, -0.02, 0.03), (0.0, 0.04, 0.0), (-0.2, 0.0, -0.05)])

    def seen(factors, slip):
        own = base | dict(zip(names, factors, strict=True))
        return forces(version, own, *slip, 4200.0)

    each = np.concatenate([1.0 - np.eye(4), np.zeros((1, 4))])
    both = jax.jit(jax.vmap(jax.vmap(lambda *x: (seen(*x), jax.jacrev(seen)(*x)), (None, 0)), (0, None)))
    values, slopes = map(np.asarray, both(each, slips))
    near, near_slopes = map(np.asarray, both(np.where(each == 0, 1e-9, each), slips))
    assert np.all(np.isfinite(values)) and np.all(np.isfinite(slopes))
    np.testing.assert_allclose(values, near, rtol=0, atol=1e-4)
    # By the factors that are zero, at slips that are not.
    zero = np.broadcast_to((each == 0)[:, None, None, :], slopes.shape) & (np.asarray(slips) != 0).any(1)[:, None, None]
    np.testing.assert_allclose(slopes[zero], near_slopes[zero], rtol=1e-4, atol=0.5)
    np.testing.assert_allclose(values[-1, :, :2], 0.0, atol=1e-9)


@pytest.mark.parametrize("key, value", [("LMUX", -0.1), ("LCY", -1.0), ("LKY", 0.0), ("LFZO", 0.0)])
def test_factors_out_of_their_range_are_refused(key, value):
    own = data("5.2") | {"FITTYP": 6, key: value}
    with pytest.raises(ValueError, match=f"'tyre': {key} must be"):
        spatial.MagicFormulaTyre("tyre", "wheel", own, terrain=mb.terrain.Flat()).check(3)


# The load and the radii


def test_the_load_of_a_wheel_that_stands_and_turns():
    own = data("6.1")
    ratio, first = 0.02 / 0.32, np.sqrt((2e5 * 0.32 / 4000) ** 2 - 4 * 14.0)

    @jax.jit
    def seen(pressure, depth):
        both = lambda depth: jnp.stack(magic_formula.elastic(own, pressure, depth))
        return both(depth), jax.jacfwd(both)(depth), jnp.stack(magic_formula.by_spin(own, -100.0))

    (load, _), (_, slope), by_spin = seen(2.2e5, 0.02)
    np.testing.assert_allclose(load, 4000 * 1.07 * (first * ratio + 14.0 * ratio**2), rtol=1e-12)
    np.testing.assert_allclose(slope, load, rtol=1e-12)
    np.testing.assert_allclose(by_spin, [1 + 0.04 * 2.0, 0.32 * 0.0008 * 4.0], rtol=1e-12)
    # At the nominal load the stiffness is that of the file.
    at_nominal = (np.sqrt(first**2 + 4 * 14.0) - first) / (2 * 14.0) * 0.32
    _, (stiffness, _), _ = seen(2e5, at_nominal)
    np.testing.assert_allclose(stiffness, 2e5, rtol=1e-12)


def test_the_load_of_version_5_2_is_linear():
    load, _ = magic_formula.elastic(data("5.2"), None, 0.02)
    np.testing.assert_allclose(load, 4000.0, rtol=1e-12)
    radius = magic_formula.rolling_radius("5.2", data("5.2"), None, 0.32, 0.02, 4000.0)
    np.testing.assert_allclose(radius, 0.32 - 0.02 * (0.25 * np.arctan(8.0) + 0.02), rtol=1e-12)


# Files


def tyre(given, **options):
    return spatial.MagicFormulaTyre("tyre", "wheel", given, terrain=mb.terrain.Flat(), **options)


def written(tmp_path, version, *changes):
    """A copy of the example, with some texts replaced."""
    text = FILES[version].read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "own.tir"
    path.write_text(text)
    return path


def test_a_file_in_other_units_has_the_same_numbers(tmp_path):
    metres = (("'mm'", "'meter'"), ("= 320", "= 0.32"), ("= 16000", "= 16.0"), ("= 200\n", "= 200.0E3\n"))
    changed = written(tmp_path, "5.2", *metres, ("VERTICAL_DAMPING = 0.1", "VERTICAL_DAMPING = 100"))
    assert tir.read("", changed).coefficients == pytest.approx(data("5.2"))
    newtons = ("FORCE = 'newton'", "FORCE = 'kN'  ! of forces only")
    loads = (("FNOMIN = 4000", "FNOMIN = 4"), ("FZMIN = 100", "FZMIN = 0.1"), ("FZMAX = 10000", "FZMAX = 10"))
    stiff = (("VERTICAL_STIFFNESS = 200", "VERTICAL_STIFFNESS = 0.2"), ("DAMPING = 0.1", "DAMPING = 1e-4"))
    assert tir.read("", written(tmp_path, "5.2", newtons, *loads, *stiff)).coefficients == pytest.approx(data("5.2"))


def test_a_mapping_is_a_file():
    for version, path in FILES.items():
        entries = {"FITTYP": {"5.2": 6, "6.1": 61}[version], "TYRESIDE": "LEFT", "MASS": 9.0, **data(version)}
        if version == "6.1":
            entries["INFLPRES"] = 2.2e5
        assert tyre(entries).coefficients == tyre(path).coefficients
    assert tyre(FILES["6.1"]).pressure == 2.2e5 and tyre(FILES["6.1"], pressure=2e5).pressure == 2e5
    assert tyre(FILES["6.1"], side="right").mirror == -1.0 and tyre(FILES["6.1"], side="left").mirror == 1.0
    assert tyre(FILES["5.2"]).pressure is None


@pytest.mark.parametrize(
    ("version", "change", "message"),
    [
        (
            "6.1",
            ("FITTYP = 61", "FITTYP = 62"),
            "versions of the Magic Formula that are read are 5.2 .* got FITTYP = 62",
        ),
        ("5.2", ("'MF_05'", "'FIALA'"), "got PROPERTY_FILE_FORMAT = 'FIALA'"),
        ("6.1", ("PKY4 = 2.0\n", ""), "version 6.1 of the Magic Formula needs PKY4 as well"),
        ("5.2", ("PTX1 = 0.9\nPTX2 = 0.2\n", ""), "needs PTX1, PTX2 as well"),
        ("6.1", ("ANGLE = 'radians'", "ANGLE = 'degrees'"), "ANGLE = 'degrees' is not a unit that is read"),
        ("6.1", ("PDX1 = 1.2", "PDX1 = much"), "PDX1 must be a number, got 'much'"),
        ("6.1", ("PDX1 = 1.2", "PDX1 1.2"), "line .*: expected KEY = value, got 'PDX1 1.2'"),
        ("6.1", ("PDX2 =", "PDX1 ="), "PDX1 stands there twice"),
        ("6.1", ("RVY6 =", "RVY7 = 1.0\nRVY6 ="), "unknown for version 6.1: RVY7; remove"),
        ("6.1", ("Q_FCX = 0", "Q_FCX = 0.1"), "Q_FCX: the load that depends on the horizontal forces is not modelled"),
        ("6.1", ("'LEFT'", "'TOP'"), "TYRESIDE must be 'LEFT' or 'RIGHT', got 'TOP'"),
    ],
)
def test_other_files_are_refused(tmp_path, version, change, message):
    with pytest.raises(ValueError, match=f"MagicFormulaTyre 'tyre': own.tir.*{message}"):
        tyre(written(tmp_path, version, change))


def test_arguments_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"side needs TYRESIDE"):
        tyre(written(tmp_path, "6.1", ("TYRESIDE = 'LEFT'", "")), side="left")
    with pytest.raises(ValueError, match=r"side must be 'left' or 'right', got 'rear'"):
        tyre(FILES["6.1"], side="rear")
    with pytest.raises(ValueError, match=r"version 5.2 does not depend on the pressure"):
        tyre(FILES["5.2"], pressure=2e5)
    wheel = spatial.Body("wheel", mass=1.0, inertia=(1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match=r"FNOMIN must be positive, got 0"):
        mb.Scene([wheel], forces=[tyre(written(tmp_path, "6.1", ("FNOMIN = 4000", "FNOMIN = 0")))]).compile()
    with pytest.raises(ValueError, match=r"Q_FZ2 is too large for VERTICAL_STIFFNESS; give Q_FZ1"):
        mb.Scene([wheel], forces=[tyre(written(tmp_path, "6.1", ("Q_FZ2 = 14.0", "Q_FZ2 = 99.0")))]).compile()


def test_effects_on_the_load_do_not_matter_for_a_law_of_the_user(tmp_path):
    path = written(tmp_path, "6.1", ("Q_FCX = 0", "Q_FCX = 0.1"))
    own = tyre(path, normal=mb.contact.Linear(2e5))
    assert "Q_FCX" not in own.coefficients and own.coefficients["LYKA"] == 1.0
