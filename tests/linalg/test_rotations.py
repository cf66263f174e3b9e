"""Euler-parameter algebra against SciPy's rotations and the textbook identities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmb import spatial
from jaxmb.linalg import rotations as rot

RNG = np.random.default_rng(1)
UNIT = RNG.normal(size=(6, 4))
UNIT /= np.linalg.norm(UNIT, axis=1, keepdims=True)
V, OMEGA, G = RNG.normal(size=(6, 3)), RNG.normal(size=(6, 3)), RNG.normal(size=(6, 4))
TWO = {"cross": (V, OMEGA), "rotate": (UNIT, V), "unrotate": (UNIT, V), "multiply": (UNIT, UNIT[::-1])}
TWO |= {"rates": (UNIT, OMEGA), "pull_back": (UNIT, G)}
NO_TURN = [(0, 0, 0), (np.pi, 0, 0), (0, np.pi, 0), (0, 0, np.pi), (0.1, np.pi, 0.2)]


@pytest.fixture(scope="module")
def traced():
    """What the functions give in a program, of all of the numbers."""

    def of_one(p, v, omega, R):
        pdot = rot.rates(p, omega)
        turned = jax.jvp(lambda p: rot.rotate(p, v), (p,), (pdot,))[1]
        back = rot.unrotate(p, rot.rotate(p, v))
        return rot.rotation_matrix(p), back, rot.from_matrix(R), rot.angular_velocity(p, pdot), pdot, turned

    def every(numbers, two, R, degenerate):
        two = {name: jax.vmap(getattr(rot, name))(*given) for name, given in two.items()}
        return jax.vmap(of_one)(*numbers, R), two, jax.vmap(rot.from_matrix)(degenerate)

    others, degenerate = Rotation.from_quat(np.roll(UNIT, -1, axis=1)), Rotation.from_euler("xyz", NO_TURN)
    given = (UNIT, V, OMEGA), TWO, others.as_matrix(), degenerate.as_matrix()
    return others, *jax.device_get(jax.jit(every)(*given))


def test_rotations_are_those_of_scipy(traced):
    others, (matrices, back, parameters, *_), two, degenerate = traced
    close = lambda a, b, atol=1e-14: np.testing.assert_allclose(a, b, rtol=0, atol=atol)
    close(matrices, others.as_matrix(), 1e-15)
    close(two["rotate"], others.apply(V))
    close(back, V)
    close(np.abs(np.sum(parameters * UNIT, axis=1)), 1.0)
    close([rot.rotation_matrix(p) for p in two["multiply"]], matrices @ matrices[::-1])
    # Where a formula for a rotation matrix degenerates.
    close([rot.rotation_matrix(p) for p in degenerate], Rotation.from_euler("xyz", NO_TURN).as_matrix())
    close(np.roll(UNIT[0], -1), rot.to_xyzw(UNIT[0]), 0)
    close(rot.from_xyzw(rot.to_xyzw(UNIT[0])), UNIT[0], 0)


def test_rates_and_angular_velocity(traced):
    _, (*_, omega, rates, turned), two, _ = traced
    np.testing.assert_allclose(omega, OMEGA, rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.sum(UNIT * rates, axis=1), 0.0, atol=1e-15)
    # dR/dt v = R (ω′ × v)
    expected = [rot.rotate(p, np.cross(w, v)) for p, w, v in zip(UNIT, OMEGA, V, strict=True)]
    np.testing.assert_allclose(turned, expected, rtol=0, atol=1e-14)
    # pull_back is the adjoint of rates.
    np.testing.assert_allclose(np.sum(G * rates, 1), np.sum(two["pull_back"] * OMEGA, 1), rtol=0, atol=1e-14)


def test_known_numbers_are_left_to_numpy(traced):
    for name, found in traced[2].items():
        for a, b, expected in zip(*TWO[name], found, strict=True):
            known = getattr(rot, name)(a, b)
            assert isinstance(known, np.ndarray), name
            np.testing.assert_allclose(known, expected, rtol=0, atol=1e-14, err_msg=name)


def test_axes_of_any_length():
    """A turn by 90 degrees about (1, 1, 0), against SciPy; the derivative along the axis itself is zero."""
    axis = np.array([1.0, 1.0, 0.0])
    expected = Rotation.from_rotvec(np.pi / 2 * axis / np.sqrt(2)).as_matrix()
    for length in (1.0, 0.01, 300.0):
        p = rot.from_axis_angle(length * axis, np.pi / 2)
        np.testing.assert_allclose(rot.rotation_matrix(p), expected, rtol=0, atol=1e-15)
    body = spatial.Body("body", mass=1.0, inertia=(1, 1, 1), orientation=p)
    np.testing.assert_allclose(rot.rotation_matrix(np.asarray(body.orientation)), expected, rtol=0, atol=1e-15)
    turned = lambda x: rot.from_axis_angle(x, 0.7)
    along, none = jax.jit(lambda x: (jax.jvp(turned, (x,), (x,))[1], turned(0.0 * x)))(axis)
    np.testing.assert_allclose(along, 0.0, rtol=0, atol=1e-15)
    assert np.isnan(none[1:]).all()
    with pytest.raises(ValueError, match="zero vector"):
        rot.from_axis_angle((0.0, 0.0, 0.0), 1.0)


@pytest.mark.parametrize("function", [rot.from_matrix, lambda x: rot.from_axis_angle(x[0], x[1, 0])])
def test_derivatives_of_euler_parameters(function):
    """Forward and reverse mode and central differences, with each formula for a rotation matrix."""
    units = np.eye(4) + 0.3 * UNIT[:4]
    R = np.stack([rot.rotation_matrix(p / np.linalg.norm(p)) for p in units])
    assert [np.argmax(np.abs(rot.from_matrix(own))) for own in R] == [0, 1, 2, 3]
    along, h = RNG.normal(size=(4, 3, 3)), 1e-3

    @jax.jit
    @jax.vmap
    def run(R, along):
        forward = jax.jvp(function, (R,), (along,))[1]
        reverse = jnp.sum(jax.jacrev(function)(R) * along[None], axis=(1, 2))
        return forward, reverse, [function(R + k * h * along) for k in (1.0, -1.0, 2.0, -2.0)]

    forward, reverse, values = jax.device_get(run(R, along))
    central = (8 * (values[0] - values[1]) - (values[2] - values[3])) / (12 * h)
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-14)
    np.testing.assert_allclose(central, forward, rtol=0, atol=1e-9)
    known = np.stack([function(own) for own in R + h * along])
    np.testing.assert_allclose(values[0], known, rtol=0, atol=1e-15)


def test_norm_and_its_derivative_at_zero():
    value, slope = jax.jit(jax.vmap(jax.value_and_grad(rot.norm)))(np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0]]))
    np.testing.assert_array_equal(value, [0.0, 5.0])
    np.testing.assert_allclose(slope, [[0.0, 0.0, 0.0], [0.6, 0.0, 0.8]], rtol=0, atol=1e-15)
    assert (rot.norm(np.zeros(3)), rot.norm(np.array([3.0, 0.0, -4.0]))) == (0.0, 5.0)


def test_single_precision_stays():
    """Of arrays of NumPy as of those of JAX: scenes are checked with the former."""
    p = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
    assert rot.rotation_matrix(p).dtype == jax.eval_shape(rot.rotation_matrix, p).dtype == np.float32


def test_rotation_vectors():
    """Those of SciPy, of Euler parameters of both signs and any length."""
    others = Rotation.from_quat(np.roll(UNIT, -1, axis=1)).as_rotvec()
    for p, expected in zip(UNIT, others, strict=True):
        for own in (p, -p, 2.0 * p):
            np.testing.assert_allclose(rot.rotation_vector(own), expected, rtol=0, atol=1e-14)
        half = Rotation.from_rotvec(expected / 2).as_quat(scalar_first=True)
        np.testing.assert_allclose(rot.half_turn(p), half * np.sign(half[0]), rtol=0, atol=1e-14)
    # After a small turn about another axis.
    p, w = UNIT[0] * np.sign(UNIT[0, 0]), np.array([0.3, -0.2, 0.5])
    turned = lambda e: Rotation.from_quat(p, scalar_first=True) * Rotation.from_rotvec(e * w)
    difference = (turned(1e-5).as_rotvec() - turned(-1e-5).as_rotvec()) / 2e-5
    found = jax.jit(lambda p, w: jax.jvp(rot.rotation_vector, (p,), (rot.rates(p, w),))[1])(p, w)
    np.testing.assert_allclose(found, difference, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_derivatives_of_rotation_vectors():
    """Of turns about one axis, of all orders: also at zero, and where the series ends."""
    axis = np.array([0.6, 0.0, -0.8])

    def along(angle):
        turn = jnp.concatenate([jnp.cos(angle / 2)[None], jnp.sin(angle / 2) * axis])
        return rot.dot(rot.rotation_vector(turn), axis)

    angles = np.array([0.0, 1e-9, 1e-4, 0.8, 0.88, 0.89, 2.0, 3.1])
    first, second, third = jax.grad(along), jax.grad(jax.grad(along)), jax.jacfwd(jax.grad(jax.grad(along)))
    every = lambda x: (along(x), first(x), jax.jacfwd(along)(x), second(x), third(x))
    for found, expected in zip(jax.jit(jax.vmap(every))(angles), (angles, 1.0, 1.0, 0.0, 0.0), strict=True):
        np.testing.assert_allclose(found, np.broadcast_to(expected, 8), rtol=1e-14, atol=1e-12)
