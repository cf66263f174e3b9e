"""The rail wheelset of the test set for initial value problem solvers: it hunts between two rails.

Source: B. Simeon, C. Führer and P. Rentrop, "Differential-algebraic equations in vehicle system dynamics", Surv. Math.
Ind. 1, 1991, as in F. Mazzia and C. Magherini, "Test Set for Initial Value Problem Solvers", 2008. Two conical wheels
on one axle run at 30 m/s on straight rails of circular profile; the axle is held by springs, and creep forces after
Kalker depend on the normal forces, which are constraint forces.

Coordinates are the axle's displacements x (lateral), y (up) and z (forward) [m], its yaw θ and roll φ [rad], and the
angle β [rad] that it has turned beyond 300 rad/s. The source's four contact variables are functions of them: wheels are
cones, so the direction of the normal does not depend on the place of the contact.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxmb as mb
from jaxmb.lagrangian import Holonomic, LagrangianSystem, NonIdealForce

T1 = 10.0
START = np.array([0.14941e-2, 0.40089e-6, 0.11241e-5, -0.28573e-3, 0.26459e-3, 0.0])
ACCELERATIONS = np.array(
    [-1.975258894011285, -1.0898297102811276e-3, 7.8855083626142589e-2, -5.533362821731549, -0.3487021489546511]
)
# The published end: x, y, z, θ, φ and their rates, the rate of β, and the contacts' ψ and ξ, left and right; by DASSL
# at a tolerance of 1e-9. RADAU5 and jaxmb agree with it to 5e-6.
COORDINATES = np.array(
    [0.86355386965811e-2, 0.13038281022727e-4, -0.93635784016818e-4, -0.13642299804033e-1, 0.15292895005422e-2]
)
RATES = np.array(
    [
        -0.76985374142666e-1,
        -0.25151106429207e-3,
        0.20541188079539e-2,
        -0.23904837703692,
        -0.13633468454173e-1,
        -0.24421377661131,
    ]
)
CONTACTS = np.array([[-0.33666751972196e-3, -0.15949425684022], [0.37839614386969e-3, 0.14173214964613]])

MASS, AXIAL, TRANSVERSE, GRAVITY = 16.08, 0.0605, 0.366, 9.81
SPEED, RADIUS, CONE, GAUGE, RAIL = 30.0, 0.1, 0.0262, 0.1506, 0.06
STIFFNESS, ARM, FRICTION = 6400.0, 0.19, 0.12
# Kalker's coefficients, the shear modulus [Pa] and Poisson's ratio, and two integrals of the contact ellipse.
KALKER, SHEAR, POISSON, ELLIPSE = (4.72772197, 4.27526987, 1.97203505), 7.92e10, 0.28, (1.3537956, 0.7115218)
SPIN, SLOPE = SPEED / RADIUS, np.tan(CONE)
SIDES = {"left": -1.0, "right": 1.0}


class Contact(NamedTuple):
    """Where a wheel touches: `psi` around the wheel [rad], `xi` along the axle [m], the wheel's `radius` there [m], the
    `angle` of the tangent plane [rad] and the `gap` between wheel and rail [m].
    """

    psi: Array
    xi: Array
    radius: Array
    angle: Array
    gap: Array


def contact(side: float, q: Array) -> Contact:
    """`side`: −1 for the left wheel, 1 for the right one."""
    x, y, _, yaw, roll, _ = q
    s, c, sr, cr = jnp.sin(yaw), jnp.cos(yaw), jnp.sin(roll), jnp.cos(roll)
    slope = -side * SLOPE
    psi = jnp.arcsin(slope * s * cr / jnp.hypot(c, s * sr)) - jnp.arctan2(s * sr, c)
    sp, cp = jnp.sin(psi), jnp.cos(psi)
    across = c * sr * cp - s * sp
    tangent = (across - slope * c * cr) / (slope * sr + cr * cp)
    # The rail is a circle, whose slope tells the place on it.
    rise = jnp.sqrt(1 + tangent**2)
    at = side * (GAUGE + np.sin(CONE) * RAIL) - RAIL * tangent / rise
    xi = (at - x - (RADIUS + SLOPE * GAUGE) * across) / (c * cr + slope * across)
    radius = RADIUS + SLOPE * (GAUGE - side * xi)
    gap = RAIL / rise - RADIUS - np.cos(CONE) * RAIL - y - xi * sr + radius * cr * cp
    return Contact(psi, xi, radius, jnp.arctan(tangent), gap)


def creep(side: float, q: Array, v: Array, multiplier: Array) -> Array:
    """The generalized force of the creep of one wheel."""
    _, _, _, yaw, roll, _ = q
    dx, dy, dz, dyaw, droll, turn = v
    psi, xi, r, angle, _ = contact(side, q)
    sr, cr, sp, cp, sd, cd = jnp.sin(roll), jnp.cos(roll), jnp.sin(psi), jnp.cos(psi), jnp.sin(angle), jnp.cos(angle)
    s, c = jnp.sin(yaw / cd), jnp.cos(yaw / cd)
    spin, lever = SPIN + turn, xi * sr - r * cr * cp
    slip = jnp.stack(
        [
            -spin * r * (s * cp + c * sr * sp) + dx - dyaw * (r * (s * sr * cp + c * sp) + xi * s * cr)
            - droll * c * lever,
            spin * r * cr * sp + dy + droll * (xi * cr + r * sr * cp),
            -spin * r * (c * cp - s * sr * sp) + SPEED + dz - dyaw * (xi * c * cr + r * (c * sr * cp - s * sp))
            + droll * s * lever,
        ]
    )  # fmt: skip
    rolling = 0.5 * jnp.linalg.norm(slip - 2 * jnp.stack([dx, dy, dz + SPEED]))
    along, sideways = jnp.stack([s, jnp.zeros_like(s), c]), jnp.stack([c * cd, sd, -s * cd])
    creepage = jnp.stack([along @ slip, sideways @ slip, cd * dyaw - sd * spin]) / rolling

    normal = -multiplier / cd
    curvature = 0.5 / (r * np.sqrt(1 + SLOPE**2)) + 0.5 / RAIL
    cubed = 3 * normal * (1 - POISSON) * ELLIPSE[0] / (2 * np.pi * curvature * SHEAR * np.sqrt(ELLIPSE[1]))
    size = jnp.cbrt(cubed)
    bound = FRICTION * normal
    linear = SHEAR * size**2 / bound
    pull = -bound * jnp.tanh(linear * KALKER[0] * creepage[0])
    push = -bound * jnp.tanh(linear * (KALKER[1] * creepage[1] + KALKER[2] * size * creepage[2]))
    beyond = jnp.maximum(1.0, (pull**2 + push**2) / bound**2)
    force = (pull * along + push * sideways) / jnp.sqrt(beyond)

    s, c = jnp.sin(yaw), jnp.cos(yaw)
    about_yaw = jnp.stack([-xi * s - r * sp * c * cr, -r * sp * sr, -xi * c + r * sp * s * cr]) @ force
    about_roll = jnp.stack([r * cp * c * cr - xi * c * sr, xi * cr + r * cp * sr, s * (xi * sr - r * cp * cr)]) @ force
    about_axle = jnp.stack([-cp * s - sp * c * sr, sp * cr, sp * s * sr - cp * c]) @ force * r
    # The source's equation of yaw takes the moment of the rail about the tilted axis, without the cosine of the roll.
    rail = (cr - 1) * jax.grad(lambda yaw: contact(side, q.at[3].set(yaw)).gap)(yaw) * multiplier
    return jnp.stack([*force, cr * about_yaw + sr * about_axle + rail, about_roll, about_axle])


def lagrangian(t, q, v, parameters):
    s, c = jnp.sin(q[4]), jnp.cos(q[4])
    about = AXIAL * (SPIN + v[5] + v[3] * s) ** 2 + TRANSVERSE * ((v[3] * c) ** 2 + v[4] ** 2)
    kinetic = 0.5 * (MASS * jnp.dot(v[:3], v[:3]) + about)
    return kinetic - MASS * GRAVITY * q[1] - STIFFNESS * (q[0] ** 2 + q[2] ** 2 + (ARM * q[3]) ** 2)


def force(t, q, v, parameters):
    """The springs of the source act on the turning axle itself, not on its bearings."""
    return jnp.zeros(6).at[5].set(-2 * STIFFNESS * ARM**2 * q[3] * jnp.sin(q[4]))


def gaps(q: Array) -> Array:
    """Over those of the published start, which are small; the source's constraints between velocities keep them."""
    return jnp.stack([contact(side, q).gap - contact(side, jnp.asarray(START)).gap for side in SIDES.values()])


def system() -> mb.system.AbstractSystem:
    return LagrangianSystem(
        lagrangian,
        force=force,
        constraints=[Holonomic(name, lambda t, q, _, k=k: gaps(q)[k]) for k, name in enumerate(SIDES)],
        nonideal=[
            NonIdealForce(name, lambda t, q, v, multipliers, _, side=side: creep(side, q, v, multipliers[0]))
            for name, side in SIDES.items()
        ],
        q=START,
        coordinates=["x", "y", "z", "yaw", "roll", "beta"],
        length=RADIUS,
    )
