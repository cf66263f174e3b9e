"""The Whipple bicycle from spatial bodies, hinges and rolling wheels, against its published eigenvalues.

Source: J. P. Meijaard, J. M. Papadopoulos, A. Ruina and A. L. Schwab, "Linearized dynamics equations for the balance
and steer of a bicycle: a benchmark and review", Proc. R. Soc. A 463, 2007: the parameters of table 1, appendix A for
the linear equations.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import spatial, viz

W, TRAIL, TILT, G = 1.02, 0.08, np.pi / 10, 9.81
REAR, FRONT = 0.3, 0.35
# Lean and steer.
COORDINATES = ("frame.rotation_x", "head.angle")
RATES = ("frame.x", "frame.wx", "head.angle")
# Published, at 4 and 5 m/s: weave (a pair), capsize, castering.
PUBLISHED = {
    4.0: (0.413253315211239 + 3.07910818603205j, -1.42944427361326, -12.1586142657644),
    5.0: (-0.775341882195845 + 4.46486771378823j, -0.322866429004087, -14.0783896927982),
}


@functools.cache
def bicycle():
    """z up, x forward, rear contact in the origin; `trail` is a design variable."""
    mirror = lambda I: np.array(I) * np.array([[1, 1, -1], [1, 1, 1], [-1, 1, 1]])
    frame = mirror([[9.2, 0.0, 2.4], [0.0, 11.0, 0.0], [2.4, 0.0, 2.8]])
    fork = mirror([[0.05892, 0.0, -0.00756], [0.0, 0.06, 0.0], [-0.00756, 0.0, 0.00708]])
    bodies = [
        spatial.Body("rear", mass=2.0, inertia=(0.0603, 0.12, 0.0603), position=(0.0, 0.0, REAR)),
        spatial.Body("frame", mass=85.0, inertia=frame, position=(0.3, 0.0, 0.9)),
        spatial.Body("fork", mass=4.0, inertia=fork, position=(0.9, 0.0, 0.7)),
        spatial.Body("front", mass=3.0, inertia=(0.1405, 0.28, 0.1405), position=(W, 0.0, FRONT)),
    ]
    # The steering axis meets the ground ahead of the contact by the trail.
    origin, z, axle = np.zeros(3), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
    tilted = (np.cos(TILT / 2), 0.0, -np.sin(TILT / 2), 0.0)
    frames = [
        spatial.Frame("steer", "frame", position=(W + TRAIL - 0.3, 0.0, -0.9), orientation=tilted),
        spatial.Frame("stem", "fork", position=(W + TRAIL - 0.9, 0.0, -0.7), orientation=tilted),
    ]
    joints = [
        spatial.Revolute("rear_hub", "frame", "rear", point=(0.0, 0.0, REAR), axis=axle),
        spatial.Revolute("head", "steer", "stem", point_a=origin, point_b=origin, axis_a=z, axis_b=z),
        spatial.Revolute("front_hub", "fork", "front", point=(W, 0.0, FRONT), axis=axle),
        spatial.RollingDisc("rear_tyre", "rear", radius=REAR, axis=axle),
        spatial.RollingDisc("front_tyre", "front", radius=FRONT, axis=axle),
    ]
    scene = mb.Scene(bodies, joints=joints, frames=frames, forces=[mb.Gravity((0.0, 0.0, -G))])
    ahead = lambda v, x, z: jnp.stack([W + v["trail"] - x, jnp.zeros(()), jnp.full((), -z)])
    moved = lambda v: {"steer.position": ahead(v, 0.3, 0.9), "stem.position": ahead(v, 0.9, 0.7)}
    return mb.design(scene.compile(), {"trail": mb.Variable(TRAIL, unit="m")}, moved)


def running(speed, trail=TRAIL):
    """The bicycle with another trail that runs straight."""
    system = mb.with_parameters(bicycle(), {"trail": trail})
    return system, mb.assemble(system, rates={"frame.x": speed, "frame.wx": 0.0, "head.angle": 0.0}, throw=False)


def published(speed, trail=TRAIL):
    """The four eigenvalues from appendix A, z down as there."""
    m = np.array([2.0, 85.0, 4.0, 3.0])
    x, z = np.array([0.0, 0.3, 0.9, W]), np.array([-REAR, -0.9, -0.7, -FRONT])
    Ixx, Ixz = np.array([0.0603, 9.2, 0.05892, 0.1405]), np.array([0.0, 2.4, -0.00756, 0.0])
    Izz = np.array([0.0603, 2.8, 0.00708, 0.1405])
    total = np.sum(m)
    xT, zT = np.sum(m * x) / total, np.sum(m * z) / total
    Txx, Txz, Tzz = np.sum(Ixx + m * z**2), np.sum(Ixz - m * x * z), np.sum(Izz + m * x**2)
    mA = m[2] + m[3]
    xA, zA = (m[2] * x[2] + m[3] * x[3]) / mA, (m[2] * z[2] + m[3] * z[3]) / mA
    Axx = Ixx[2] + Ixx[3] + m[2] * (z[2] - zA) ** 2 + m[3] * (z[3] - zA) ** 2
    Axz = Ixz[2] - m[2] * (x[2] - xA) * (z[2] - zA) + Ixz[3] - m[3] * (x[3] - xA) * (z[3] - zA)
    Azz = Izz[2] + Izz[3] + m[2] * (x[2] - xA) ** 2 + m[3] * (x[3] - xA) ** 2
    c, s = np.cos(TILT), np.sin(TILT)
    uA = (xA - W - trail) * c - zA * s
    All = mA * uA**2 + Axx * s**2 + 2 * Axz * s * c + Azz * c**2
    Alx = -mA * uA * zA + Axx * s + Axz * c
    Alz = mA * uA * xA + Axz * s + Azz * c
    mu = trail / W * c
    SR, SF = 0.12 / REAR, 0.28 / FRONT
    ST, SA = SR + SF, mA * uA + mu * total * xT
    mass = np.array([[Txx, Alx + mu * Txz], [Alx + mu * Txz, All + 2 * mu * Alz + mu**2 * Tzz]])
    K0 = np.array([[total * zT, -SA], [-SA, -SA * s]])
    K2 = np.array([[0.0, (ST - total * zT) / W * c], [0.0, (SA + SF * s) / W * c]])
    C1 = np.array(
        [
            [0.0, mu * ST + SF * c + Txz / W * c - mu * total * zT],
            [-(mu * ST + SF * c), Alz / W * c + mu * (SA + Tzz / W * c)],
        ]
    )
    stiffness = np.linalg.solve(mass, G * K0 + speed**2 * K2)
    damping = np.linalg.solve(mass, speed * C1)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-stiffness, -damping]])
    return np.linalg.eigvals(A)


def essential(linear):
    """The eigenvalues of lean and steer; those of the places and of the speed are zero."""
    values = np.asarray(linear.eigenvalues)
    assert np.sum(np.abs(values) < 1e-9) == 6
    return np.sort_complex(values[np.abs(values) >= 1e-9])


def test_bicycle_oracle_has_the_published_eigenvalues():
    for speed, (weave, *others) in PUBLISHED.items():
        expected = np.sort_complex([weave, np.conj(weave), *others])
        np.testing.assert_allclose(np.sort_complex(published(speed)), expected, rtol=1e-12)


@pytest.mark.slow
def test_bicycle_has_its_published_eigenvalues():
    for speed, (weave, *others) in PUBLISHED.items():
        linear = mb.linearise(*running(speed), coordinates=COORDINATES)
        expected = np.sort_complex([weave, np.conj(weave), *others])
        np.testing.assert_allclose(essential(linear), expected, atol=1e-10)
    assert linear.states[:2] == COORDINATES


@pytest.mark.slow
def test_bicycle_root_locus_follows_weave_capsize_and_castering():
    speeds = np.linspace(0.5, 10.0, 39)
    found = mb.root_locus(running, "speed [m/s]", speeds, coordinates=COORDINATES)
    for speed, values in zip(found.values, found.eigenvalues, strict=True):
        own = np.sort_complex(values[np.abs(values) > 1e-7])
        np.testing.assert_allclose(own, np.sort_complex(published(speed)), atol=1e-10)
    # Between the weave speed of 4.292 m/s and the capsize speed of 6.024 m/s the bicycle is stable.
    np.testing.assert_array_equal(found.stable(), (found.values > 4.2923) & (found.values < 6.0243))
    assert np.max(np.abs(np.diff(found.eigenvalues[12:], axis=0))) < 2.0
    # The stable speeds end where the published eigenvalues cross zero, to the square of the step.
    np.testing.assert_allclose(found.boundaries(), [4.2924, 6.0243], atol=0.02)
    real, _, _ = viz.plot_root_locus(found, labels=["weave", "capsize", "castering"]).axes
    weave, _, capsize, castering, _ = real.lines
    assert [line.get_label() for line in (weave, capsize, castering)] == ["weave", "capsize", "castering"]
    last = np.sort(np.unique(published(found.values[-1]).real.round(9)))
    np.testing.assert_allclose([line.get_ydata()[-1] for line in (castering, weave, capsize)], last, atol=1e-8)
    with pytest.raises(ValueError, match="3 modes, got 1 labels"):
        viz.plot_root_locus(found, labels=["weave"])


@pytest.mark.slow
def test_bicycle_weave_speed_changes_with_the_trail():
    bicycle()

    def growth(x):
        linear = mb.linearise(*running(x[0], x[1]), coordinates=COORDINATES, rates=RATES)
        values = linear.eigenvalues
        return (values.real[jnp.argmax(values.imag)],) * 2

    def closed(x):
        values = published(x[0], x[1])
        return values.real[np.argmax(values.imag)]

    at = np.array([4.292382536341119, TRAIL])
    slopes, value = jax.jit(jax.jacfwd(growth, has_aux=True))(at)
    own = [(closed(at + 1e-5 * e) - closed(at - 1e-5 * e)) / 2e-5 for e in np.eye(2)]
    assert abs(value) < 1e-9
    np.testing.assert_allclose(slopes[1] / slopes[0], own[1] / own[0], rtol=1e-7)
