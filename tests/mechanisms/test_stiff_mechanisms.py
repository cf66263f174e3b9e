"""Mechanisms with stiff springs and dampers against independent models in minimal coordinates."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import linkages, stiff

import jaxmb as mb
from jaxmb import mechanisms
from jaxmb.formulations import Partitioned, accelerations
from jaxmb.linalg import rotations


@functools.cache
def library(name):
    return mechanisms.get(name)


def test_stiff_four_bar_references_stay_near_the_rigid_one():
    references = library("stiff_four_bar").references
    rigid = linkages.four_bar(references.times)[:, :3]
    distance = np.max(np.abs(references.values[:, :3] - rigid))
    assert 1e-6 < distance < 1e-5


# Right-hand sides


def placed(system, motions):
    """A state from position, orientation or angle, velocity and angular velocity of every body."""
    q, u = np.zeros(system.nq), np.zeros(system.nu)
    for body, (pose, velocity) in motions.items():
        k = system.body_names.index(body)
        q[system.layout.pose_index[k]] = pose
        u[system.layout.velocity_index[k]] = velocity
    assert np.max(np.abs(system.coordinate_residual(0.0, q))) < 1e-13
    assert np.max(np.abs(system.velocity_residual(0.0, q, u))) < 1e-12
    return jnp.asarray(q), jnp.asarray(u)


def chain(system, phi, rate):
    """Bars A→B→C and the rocker C→end, which points from its foot to C, at given angles."""
    e, n = np.stack([np.cos(phi), np.sin(phi)], axis=1), np.stack([-np.sin(phi), np.cos(phi)], axis=1)
    levers = np.array([[0.5, 0.0, 0.0], [1.0, 1.5, 0.0], [1.0, 3.0, -1.25]])
    bars = zip(("crank", "coupler", "rocker"), levers, phi, rate, strict=True)
    return placed(system, {name: ([*l @ e, p], [*(l * rate) @ n, r]) for name, l, p, r in bars})


def governor(system, q, rate):
    """Shaft, arms and cube at given ψ, α₁, α₂, s and their rates."""
    (psi, *alphas, s), (omega, *turns, slide) = q, rate
    shaft = rotations.from_axis_angle((0.0, 0.0, 1.0), psi)
    x, y = np.array([np.cos(psi), np.sin(psi), 0.0]), np.array([-np.sin(psi), np.cos(psi), 0.0])
    z = np.array([0.0, 0.0, 1.0])
    motions = {
        "shaft": ([0.0, 0.0, 0.5, *shaft], [0.0, 0.0, 0.0, 0.0, 0.0, omega]),
        "slider": ([0.0, 0.0, s, *shaft], [0.0, 0.0, slide, 0.0, 0.0, omega]),
    }
    centre = (0.3 * 0.5 + 5.0) / 5.3
    for k, (alpha, turn, side) in enumerate(zip(alphas, turns, (1.0, -1.0), strict=True), start=1):
        # An arm's own axes: along it, the shaft's y, and across.
        angle = alpha if side > 0 else np.pi - alpha
        about_y = side * turn
        along = side * np.cos(alpha) * x - np.sin(alpha) * z
        position = side * 0.05 * x + z + centre * along
        velocity = omega * np.cross(z, position) + about_y * centre * np.cross(y, along)
        p = rotations.multiply(shaft, rotations.from_axis_angle((0.0, 1.0, 0.0), angle))
        spin = [-omega * np.sin(angle), about_y, omega * np.cos(angle)]
        motions[f"arm{k}"] = ([*position, *p], [*velocity, *spin])
    return placed(system, motions)


@pytest.mark.slow
def test_stiff_four_bar_accelerations():
    system, model = library("stiff_four_bar").system, stiff.four_bar()
    solve = jax.jit(lambda q, u: accelerations(system, Partitioned(), 0.0, q, u)[0])
    rng = np.random.default_rng(1)
    # Rounding of positions of about 1 m, times the stiffness: all there is without a displacement.
    floor = 1e8 * 2.0**-52
    for size in (0.0, 1e-5, 1e-3, 0.1, 1.0):
        phi = model.q.astype(float) + size * rng.normal(size=3)
        rate = model.rates.astype(float) + size * rng.normal(size=3)
        expected = model.acceleration(phi.astype(np.longdouble), rate.astype(np.longdouble)).astype(float)
        found = np.asarray(solve(*chain(system, phi, rate)))[2::3]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.max(np.abs(expected)) + floor)


@pytest.mark.slow
def test_flyball_accelerations():
    """Also where the arms move differently."""
    system, model = library("flyball").system, stiff.flyball()
    solve = jax.jit(lambda q, u: accelerations(system, Partitioned(), 0.0, q, u)[0])
    arms = [system.layout.velocity_index[system.body_names.index(f"arm{k}")][4] for k in (1, 2)]
    shaft, slider = (system.layout.velocity_index[system.body_names.index(name)] for name in ("shaft", "slider"))
    where, sign = np.array([shaft[5], *arms, slider[2]]), np.array([1.0, 1.0, -1.0, 1.0])
    rng = np.random.default_rng(2)
    for size in (0.0, 1e-5, 1e-2, 0.3):
        q, rate = (value.astype(float) + size * rng.normal(size=4) for value in (model.q, model.rates))
        expected = model.acceleration(q.astype(np.longdouble), rate.astype(np.longdouble)).astype(float)
        found = sign * np.asarray(solve(*governor(system, q, rate)))[where]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.max(np.abs(expected)))


# Motions


@pytest.mark.slow
def test_flyball_moves_as_its_references_say():
    mechanism = library("flyball")
    trajectory = mb.simulate(mechanism.system, mechanism.state, t1=0.1, rtol=1e-10, saveat=np.array([0.0, 0.1]))
    assert max(float(error[0]) for error in mechanism.errors(trajectory).values()) < 1e-9
    momentum = np.asarray(trajectory.angular_momentum)
    np.testing.assert_allclose(momentum[1], momentum[0], rtol=0, atol=1e-10 * momentum[0, 2])
    other = trajectory["arm2"].angular_velocity[:, 1]
    np.testing.assert_allclose(other, -trajectory["arm1"].angular_velocity[:, 1], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_stiff_four_bar_moves_as_the_open_chain_does():
    """With the oscillation of the bushing, of some 10⁻⁷ m."""
    mechanism, times = library("stiff_four_bar"), [0.001, 0.01, 0.1]
    trajectory = mb.simulate(mechanism.system, mechanism.state, t1=0.1, rtol=1e-12, saveat=np.array(times))
    observed = mechanism.observe(trajectory)
    expected = stiff.motion(stiff.four_bar(), times, step=1e-4, columns=7).astype(float)
    labels = ("crank", "coupler", "rocker", "crank_rate", "coupler_rate", "rocker_rate", "pivot_x", "pivot_y")
    for k, label in enumerate(labels):
        bound = 1e-11 if k < 3 else 1e-8 if k < 6 else 1e-12
        np.testing.assert_allclose(observed[label], expected[:, k], rtol=0, atol=bound, err_msg=label)
    assert max(float(np.max(error)) for error in mechanism.errors(trajectory).values()) < 1e-9
    assert np.max(np.abs(expected[:, 6:])) > 1e-7
