"""What stands out of the course of a function, and what does not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly

import jaxmb as mb
from jaxmb import planar
from jaxmb.system.inputs import turning_times
from jaxmb.system.pulses import between_segments_on_one_line, on_straight_lines, pulses_of_samples

END, SAMPLES = 100.0, 513
TS, SPACING = np.linspace(0.0, END, SAMPLES), END / (SAMPLES - 1)
SHAPES = {
    "bell": lambda z: np.exp(-(z**2)),
    "triangle": lambda z: np.maximum(1 - np.abs(z), 0.0),
    "cosine": lambda z: np.where(np.abs(z) < 1, 0.5 + 0.5 * np.cos(np.pi * z), 0.0),
    "to and fro": lambda z: 2 * z * np.exp(-(z**2)),
}
COURSES = {
    "rest": lambda t, r: np.zeros_like(t),
    "ramp": lambda t, r: r.normal() * t,
    "parabola": lambda t, r: 0.01 * r.normal() * t**2,
    "wave": lambda t, r: np.sin(r.uniform(0.005, 0.02) * t + r.uniform(0.0, 6.0)),
    "step": lambda t, r: 100.0 * (t > 95.0),
}


def smooth_and_rough(rng):
    omega, phase = 10 ** rng.uniform(-2.0, 0.9, 3), rng.uniform(0.0, 6.0, 3)
    return [
        np.sin(omega[0] * TS + phase[0]),
        np.sin(omega[0] * TS) + 0.1 * np.sin(omega[1] * TS + phase[1]) + 0.01 * np.sin(omega[2] * TS),
        np.tanh((TS - rng.uniform(0.0, END)) / 10 ** rng.uniform(-1.0, 1.0)),
        np.exp(-TS / 10 ** rng.uniform(0.0, 2.0)),
        rng.normal(size=SAMPLES),
        np.abs(np.sin(omega[1] * TS)),
        np.maximum(TS - rng.uniform(0.0, END), 0.0),
        rng.normal() * TS**3 + rng.normal(),
    ]


def test_pulses_are_found_beside_anything_smooth_and_nowhere_else():
    """From the width of a spacing on, a ten-thousandth as high as the course of the function or a thousand times; and
    none in what is smooth or rough everywhere. Steps that end nearby show a pulse.
    """
    rng = np.random.default_rng(0)
    cases = [(course, shape) for _ in range(5) for course in COURSES.values() for shape in SHAPES.values()]
    widths, at = SPACING * 10 ** rng.uniform(0.0, 0.8, len(cases)), rng.uniform(5.0, 80.0, len(cases))
    sizes = 10 ** rng.uniform(-3.0, 3.0, len(cases))
    columns = [course(TS, rng) for course, _ in cases]
    pulses = [size * shape((TS - t) / w) for (_, shape), size, t, w in zip(cases, sizes, at, widths, strict=True)]
    rng = np.random.default_rng(1)
    others = [own for _ in range(12) for own in smooth_and_rough(rng)]
    peak = int(np.argmin(np.abs(TS - 50.0)))
    ends = np.eye(SAMPLES, dtype=bool)[peak + np.array([-1, 0, 1])]
    alone = np.exp(-(((TS - 50.0) / 0.4) ** 2))
    samples = np.concatenate([np.array(columns) + np.array(pulses), others, [alone] * 3])
    masks = np.concatenate([np.zeros((len(samples) - 3, SAMPLES), bool), ends])
    judge = lambda column, mask: pulses_of_samples(jnp.asarray(TS), column[:, None], mask)
    found = np.asarray(jit_quickly(jax.vmap(judge))(samples, masks))
    for peak, t, width in zip(found, at, widths, strict=False):
        assert np.min(np.abs(TS[peak] - t)) <= max(width, 0.6 * SPACING)
        assert np.sum(peak) <= 4
    assert np.sum(found[len(cases) : -3]) == 0
    np.testing.assert_array_equal(found[-3:], ends)


def test_pulses_in_many_columns_hide_none():
    """A pulse in one of a hundred waves, of which one is not finite."""
    phases = np.random.default_rng(2).uniform(0.0, 6.0, 100)
    waves = np.sin(0.05 * TS[:, None] + phases)
    waves[:, 67] += 1e-3 * np.exp(-(((TS - 40.0) / 0.3) ** 2))
    waves[7, 20] = np.nan
    found = jit_quickly(pulses_of_samples)(jnp.asarray(TS), jnp.asarray(waves), jnp.zeros(SAMPLES, bool))
    np.testing.assert_allclose(TS[np.asarray(found)], [40.0], atol=0.6 * SPACING)


def test_pulses_of_a_series_on_the_flank_of_a_large_one():
    """Of a piecewise linear series; values that are rough everywhere have none."""
    ts = np.array([0.0, 20.0, 43.9, 44.6, 44.7, 44.8, 45.0, 45.1, 46.2, 79.0])
    course = np.interp(ts, [0.0, 43.9, 45.1, 46.2, 79.0], [0.0, 0.0, -3.8, 0.0, 0.0])
    course[5] -= 0.005
    judge = jit_quickly(between_segments_on_one_line)
    assert ts[np.asarray(judge(ts, course[:, None], ts[0], ts[-1]))].tolist() == [44.8, 45.1]
    rough, times = np.random.default_rng(4).normal(size=(400, 1)), np.linspace(0.0, 1.0, 400)
    assert np.sum(judge(times, rough, 0.0, 1.0)) <= 4


def test_pulses_stand_out_of_straight_lines():
    ts = np.array([0.0, 1.0, 3.0, 4.0, 5.0, 7.0])
    values = np.array([0.0, 0.0, 0.0, 2.0, 4.0, 8.0])[:, None]
    assert jit_quickly(on_straight_lines)(ts, values).tolist() == [False, True, False, True, True, False]


def _pulse(t):
    return jnp.exp(-(((t - 50.0) / 0.3) ** 2))


def _row(force, size=3):
    return jnp.zeros((1, size)).at[0, 0].set(force)


FIRST = {"x": 0.0}
LAWS = {
    "stiffness": mb.Force("f", "b", lambda x, v, t, p: _row(-x[0, 0] * _pulse(t))),
    "damping": mb.Force("f", "b", lambda x, v, t, p: _row(-v[0, 0] * _pulse(t))),
    "products": mb.Force(
        "f", "b", lambda x, v, t, p: _row(-p["c"] * x[0, 0] * v[0, 0] * _pulse(t)), parameters={"c": 0.0}
    ),
    "near the start": mb.Force(
        "f", "b", lambda x, v, t, p: _row(x[0, 0] * jnp.exp(-((x[0, 0] / 0.1) ** 2)) * _pulse(t))
    ),
    "strengths that cancel": mb.Force(
        "f", "b", lambda x, v, t, p: _row((p["a"] - p["b"]) * _pulse(t)), parameters={"a": 2.0, "b": 2.0}
    ),
    "small": mb.Force("f", "b", lambda x, v, t, p: _row(jnp.exp(-(((t - 20.0) / 0.3) ** 2)) + 1e-3 * _pulse(t))),
    "ramp": mb.Force("f", "b", lambda x, v, t, p: _row(100.0 * t + 0.1 * _pulse(t))),
    "controller": mb.Controller(
        "f", lambda t, m, s, p: (m["x"] * _pulse(t), {}), {"x": "s.displacement"}, "s.displacement"
    ),
    "rate of a state": mb.Controller(
        "f",
        lambda t, m, s, p: (s["x"], {"x": m["x"] * _pulse(t) - s["x"]}),
        {"x": "s.displacement"},
        "s.displacement",
        states=FIRST,
    ),
    "nonideal": mb.NonIdeal("f", "s", lambda x, v, r, t, p: jnp.zeros((2, 3)).at[1, 0].set(r[1, 1] * _pulse(t))),
}


def sled(law):
    body = planar.Body("b", mass=1.0, inertia=0.1)
    slide = planar.Prismatic("s", "ground", "b", point=(0.0, 0.0), axis=(1.0, 0.0))
    return mb.Scene([body], joints=[slide], forces=[law]).compile()


@pytest.mark.slow(but=("products",))
@pytest.mark.parametrize("law", LAWS)
def test_pulses_in_a_law_at_rest(law):
    """Zero factors hide nothing: neither states nor strengths."""
    system = sled(LAWS[law])
    times = np.asarray(turning_times(system, mb.assemble(system), 0.0, END))
    assert np.any(np.abs(times - 50.0) < 0.3)
    assert np.sum(np.isfinite(times)) <= 4
