"""Euler-parameter algebra against SciPy's rotations and the textbook identities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmb import spatial
from jaxmb.linalg import rotations as rot

RNG = np.random.default_rng(1)
UNIT = [jnp.asarray(p / np.linalg.norm(p)) for p in RNG.normal(size=(6, 4))]


@pytest.mark.parametrize("p", UNIT)
def test_against_scipy(p):
    other = Rotation.from_quat(np.asarray(rot.to_xyzw(p)))
    v = jnp.asarray(RNG.normal(size=3))
    np.testing.assert_allclose(rot.rotation_matrix(p), other.as_matrix(), rtol=0, atol=1e-15)
    np.testing.assert_allclose(rot.rotate(p, v), other.apply(np.array(v)), rtol=0, atol=1e-14)
    np.testing.assert_allclose(rot.unrotate(p, rot.rotate(p, v)), v, rtol=0, atol=1e-14)
    back = rot.from_matrix(other.as_matrix())
    np.testing.assert_allclose(jnp.abs(jnp.dot(back, p)), 1.0, rtol=0, atol=1e-14)
    q = UNIT[0]
    np.testing.assert_allclose(
        rot.rotation_matrix(rot.multiply(p, q)), rot.rotation_matrix(p) @ rot.rotation_matrix(q), rtol=0, atol=1e-14
    )


@pytest.mark.parametrize("name", ["cross", "rotate", "unrotate", "multiply", "rates", "pull_back"])
def test_known_numbers_are_left_to_numpy(name):
    function = getattr(rot, name)
    sizes = {"cross": (3, 3), "multiply": (4, 4), "pull_back": (4, 4)}.get(name, (4, 3))
    for _ in range(5):
        a, b = (RNG.normal(size=size) for size in sizes)
        known, traced = function(a, b), jax.jit(function)(a, b)
        assert isinstance(known, np.ndarray)
        np.testing.assert_allclose(known, traced, rtol=0, atol=1e-14)


@pytest.mark.parametrize("p", UNIT[:3])
def test_rates_and_angular_velocity(p):
    omega = jnp.asarray(RNG.normal(size=3))
    pdot = rot.rates(p, omega)
    np.testing.assert_allclose(rot.angular_velocity(p, pdot), omega, rtol=0, atol=1e-14)
    np.testing.assert_allclose(jnp.dot(p, pdot), 0.0, atol=1e-15)
    # dR/dt v = R (ω′ × v)
    v = jnp.asarray(RNG.normal(size=3))
    _, rate = jax.jvp(lambda p: rot.rotate(p, v), (p,), (pdot,))
    np.testing.assert_allclose(rate, rot.rotate(p, jnp.cross(omega, v)), rtol=0, atol=1e-14)
    # pull_back is the adjoint of rates.
    g = jnp.asarray(RNG.normal(size=4))
    np.testing.assert_allclose(jnp.dot(g, pdot), jnp.dot(rot.pull_back(p, g), omega), rtol=0, atol=1e-14)


def test_axis_angle_and_orders():
    p = rot.from_axis_angle((0.0, 0.0, 1.0), np.pi / 2)
    np.testing.assert_allclose(rot.rotate(p, jnp.array([1.0, 0.0, 0.0])), [0.0, 1.0, 0.0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(rot.from_xyzw(rot.to_xyzw(p)), p, rtol=0, atol=0)


def test_axes_of_any_length():
    """A turn by 90 degrees about (1, 1, 0), against SciPy; the derivative along the axis itself is zero."""
    axis = np.array([1.0, 1.0, 0.0])
    expected = Rotation.from_rotvec(np.pi / 2 * axis / np.sqrt(2)).as_matrix()
    for length in (1.0, 0.01, 300.0):
        p = rot.from_axis_angle(length * axis, np.pi / 2)
        np.testing.assert_allclose(rot.rotation_matrix(p), expected, rtol=0, atol=1e-15)
    body = spatial.Body("body", mass=1.0, inertia=(1, 1, 1), orientation=p)
    np.testing.assert_allclose(rot.rotation_matrix(body.orientation), expected, rtol=0, atol=1e-15)
    along = jax.jvp(lambda x: rot.from_axis_angle(x, 0.7), (jnp.asarray(axis),), (jnp.asarray(axis),))[1]
    np.testing.assert_allclose(along, 0.0, rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match="zero vector"):
        rot.from_axis_angle((0.0, 0.0, 0.0), 1.0)
    assert np.isnan(jax.jit(lambda x: rot.from_axis_angle(x, 1.0))(jnp.zeros(3))[1:]).all()


@pytest.mark.parametrize("angles", [(0, 0, 0), (np.pi, 0, 0), (0, np.pi, 0), (0, 0, np.pi), (0.1, np.pi, 0.2)])
def test_from_matrix_where_a_formula_degenerates(angles):
    R = Rotation.from_euler("xyz", angles).as_matrix()
    np.testing.assert_allclose(rot.rotation_matrix(rot.from_matrix(R)), R, rtol=0, atol=1e-14)


@pytest.mark.slow("0-from_matrix")
@pytest.mark.parametrize("function", [rot.from_matrix, lambda x: rot.from_axis_angle(x[0], x[1, 0])])
@pytest.mark.parametrize("largest", range(4))
def test_derivatives_of_euler_parameters(function, largest):
    """Forward and reverse mode and central differences, with each formula for a rotation matrix."""
    p = rot.normalize(jnp.eye(4)[largest] + 0.3 * UNIT[largest])
    R, along = rot.rotation_matrix(p), jnp.asarray(RNG.normal(size=(3, 3)))
    assert np.argmax(np.abs(rot.from_matrix(R))) == largest
    forward = jax.jit(lambda R: jax.jvp(function, (R,), (along,))[1])(R)
    reverse = jnp.sum(jax.jit(jax.jacrev(function))(R) * along[None], axis=(1, 2))
    h = 1e-3
    value = lambda k: np.asarray(function(R + k * h * along))
    central = (8 * (value(1.0) - value(-1.0)) - (value(2.0) - value(-2.0))) / (12 * h)
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-14)
    np.testing.assert_allclose(central, forward, rtol=0, atol=1e-9)
    batch = jax.jit(jax.vmap(function))(jnp.stack([R, R + h * along]))
    np.testing.assert_allclose(batch, np.stack([value(0.0), value(1.0)]), rtol=0, atol=1e-15)


def test_norm_at_zero():
    zero = jnp.zeros(3)
    assert float(rot.norm(zero)) == float(rot.norm(np.zeros(3))) == 0.0
    assert float(rot.norm(np.array([3.0, 0.0, -4.0]))) == 5.0
    np.testing.assert_array_equal(jax.grad(rot.norm)(zero), 0.0)
    np.testing.assert_allclose(jax.grad(rot.norm)(jnp.array([3.0, 0.0, 4.0])), [0.6, 0.0, 0.8], rtol=0, atol=1e-15)


def test_single_precision_stays():
    """Of arrays of NumPy as of those of JAX: scenes are checked with the former."""
    p = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
    assert rot.rotation_matrix(p).dtype == rot.rotation_matrix(jnp.asarray(p)).dtype == np.float32
