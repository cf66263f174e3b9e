"""The Magic Formula, versions 5.2 and 6.1: the steady forces and moments of a tyre as functions of its slip.

Axes (ISO): x forwards along the ground, y to the left, z along the normal, with the origin in the contact's centre. The
slip κ is positive for driving; the slip angle α if the contact moves to the left; the inclination γ if the wheel's top
leans to the right. Angles are in radians, without the sines and tangents for large angles.

Sources: I. J. M. Besselink, A. J. C. Schmeitz and H. B. Pacejka, "An improved Magic Formula/Swift tyre model that can
handle inflation pressure changes", Vehicle System Dynamics 48 (2010); H. B. Pacejka, "Tyre and Vehicle Dynamics", 3rd
ed., Butterworth-Heinemann 2012, section 4.3.2, whose numbers of equations stand beside them; for 5.2 also its 1st ed.,
2002.
"""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax.numpy as jnp

from .kinks import clipped
from .tir import DEFAULTS, Version

Number = Any
# The factor A_μ of the digressive friction (4.E8).
_DIGRESSION = 10.0
# Of the nominal load: below this share forces are proportional to the load.
_LEAST_LOAD = 1e-3
# Of the square of an angle, so that its root has derivatives at zero.
_TINY = 1e-20
# Added to coefficients of friction, and to peaks over the nominal load, that divide (ε of 4.E16, 26, 37, 40): the road
# may be without friction. Rounding hides it elsewhere.
_EPSILON = 1e-17
# Of the radius: the least relaxation length, of a contact that is about to lift off.
_LEAST_RELAXATION = 0.1


class Forces(NamedTuple):
    """Forces [N] and moments [N m] on the wheel at the contact's centre, along the axes of the contact."""

    fx: Number
    fy: Number
    mx: Number
    my: Number
    mz: Number


class Lateral(NamedTuple):
    """The lateral force of pure side slip, and terms of it for the moments and combined slip.

    **Fields:** `force` [N]; `friction` μ_y; `stiffness` K_yα [N/rad]; `turn` B_y C_y; `shift` S_Hf [rad].
    """

    force: Number
    friction: Number
    stiffness: Number
    turn: Number
    shift: Number


class Point:
    """A tyre at a load, an inclination and a pressure, within the limits of its data.

    **Arguments:** the `version`; `coefficients` by name; `load` [N] ≥ 0; `inclination` [rad]; `pressure` [Pa], None in
    version 5.2.
    """

    def __init__(self, version: Version, coefficients: Mapping[str, Number], load, inclination, pressure):
        c = self.c = _all(coefficients)
        self.is_newer = version == "6.1"
        self.radius, self.nominal = c.UNLOADED_RADIUS, c.LFZO * c.FNOMIN  # (4.E1)
        least = jnp.maximum(c.FZMIN, _LEAST_LOAD * c.FNOMIN)
        self.load = clipped(load, least, c.FZMAX)
        # Below the least load forces are proportional to the load.
        self.share = jnp.where(load < least, load / least, 1.0)
        self.gamma = clipped(inclination, c.CAMMIN, c.CAMMAX)
        self.dfz = (self.load - self.nominal) / self.nominal  # (4.E2a)
        self.dpi = _excess(c, pressure)  # (4.E2b)

    # Stiffness and relaxation

    def longitudinal_stiffness(self):
        """K_xκ [N]."""
        c, dfz, dpi = self.c, self.dfz, self.dpi
        per_load = (c.PKX1 + c.PKX2 * dfz) * jnp.exp(c.PKX3 * dfz) * c.LKX
        return self.load * per_load * (1 + c.PPX1 * dpi + c.PPX2 * dpi**2)  # (4.E15)

    def cornering_stiffness(self, gamma):
        """K_yα [N/rad], with the sign of PKY1."""
        c, dpi = self.c, self.dpi
        reach = (c.PKY2 + c.PKY5 * gamma**2) * (1 + c.PPY2 * dpi)
        growth = jnp.sin(c.PKY4 * jnp.arctan(self.load / self.nominal / reach))
        camber = (1 - c.PKY3 * jnp.abs(gamma)) * c.LKY
        return c.PKY1 * self.nominal * (1 + c.PPY1 * dpi) * camber * growth  # (4.E25)

    def relaxation_lengths(self):
        """Relaxation lengths [m] of the longitudinal and the lateral deflection."""
        c, dfz = self.c, self.dfz
        if self.is_newer:
            carcass = lambda stiffness, a, b, p: stiffness * (1 + a * dfz + b * dfz**2) * (1 + p * self.dpi)
            along = carcass(c.LONGITUDINAL_STIFFNESS, c.PCFX1, c.PCFX2, c.PCFX3)
            across = carcass(c.LATERAL_STIFFNESS, c.PCFY1, c.PCFY2, c.PCFY3)
            sigma_x = jnp.abs(self.longitudinal_stiffness() / along)
            sigma_y = jnp.abs(self.cornering_stiffness(self.gamma) / across)
        else:
            share = self.load / self.nominal
            sigma_x = share * (c.PTX1 + c.PTX2 * dfz) * jnp.exp(-c.PTX3 * dfz) * self.radius
            growth = jnp.sin(2 * jnp.arctan(share / c.PTY2))
            sigma_y = c.PTY1 * growth * (1 - c.PKY3 * jnp.abs(self.gamma * c.LGAY)) * self.radius * c.LFZO
        return jnp.maximum(jnp.stack([c.LSGKP * sigma_x, c.LSGAL * sigma_y]), _LEAST_RELAXATION * self.radius)

    # Forces

    def forces(self, kappa, alpha, speed, slip_speed, travel) -> Forces:
        """Steady forces and moments.

        **Arguments:** `kappa`, `alpha` [rad]; `speed` [m/s] ≥ 0 of the wheel, and `slip_speed`; `travel`: 1 for a wheel
        that rolls forwards, −1 backwards, in between near standstill. There offsets of the forces at zero slip, the
        pneumatic trail and rolling resistance vanish.
        """
        c = self.c
        kappa, alpha = clipped(kappa, c.KPUMIN, c.KPUMAX), clipped(alpha, c.ALPMIN, c.ALPMAX)
        fading = 1 + c.LMUV * slip_speed / c.LONGVL  # (4.E7)
        mu_x, mu_y = c.LMUX / fading, c.LMUY / fading
        pure_x = self._longitudinal(kappa, mu_x, travel**2)
        lateral = self._lateral(alpha, self.gamma, mu_y, travel**2)
        fx = self._weight_x(kappa, alpha) * pure_x  # (4.E50)
        weight_y = self._weight_y(kappa, alpha)
        induced = self._induced(kappa, alpha, lateral.friction)
        fy = weight_y * lateral.force + induced  # (4.E58)
        # The lateral force without the parts due to κ and, in version 6.1, to γ (4.E74).
        upright = self._lateral(alpha, 0.0, mu_y, travel**2) if self.is_newer else lateral
        mz = self._aligning(kappa, alpha, mu_y, travel, lateral, weight_y * upright.force, fx, fy)
        forces = fx, fy, self._overturning(fy), self._rolling(fx, speed, travel), mz
        return Forces(*(self.share * force for force in forces))

    def _longitudinal(self, kappa, mu, offsets):
        c, dfz, dpi = self.c, self.dfz, self.dpi
        gamma = self.gamma if self.is_newer else self.gamma * c.LGAX
        x = kappa + (c.PHX1 + c.PHX2 * dfz) * c.LHX * offsets  # (4.E10, 17)
        shape = c.PCX1 * c.LCX  # (4.E11)
        friction = (c.PDX1 + c.PDX2 * dfz) * (1 + c.PPX3 * dpi + c.PPX4 * dpi**2) * (1 - c.PDX3 * gamma**2) * mu
        peak = friction * self.load  # (4.E12, 13)
        curvature = (c.PEX1 + c.PEX2 * dfz + c.PEX3 * dfz**2) * (1 - c.PEX4 * jnp.sign(x)) * c.LEX  # (4.E14)
        slope = self.longitudinal_stiffness() / (shape * peak + _EPSILON * self.nominal)  # (4.E16)
        offset = self.load * (c.PVX1 + c.PVX2 * dfz) * c.LVX * self._digressive(mu) * offsets  # (4.E18)
        return peak * jnp.sin(shape * _angle(x, slope, curvature)) + offset  # (4.E9)

    def _lateral(self, alpha, gamma, mu, offsets) -> Lateral:
        c, dfz, dpi = self.c, self.dfz, self.dpi
        gamma = gamma if self.is_newer else gamma * c.LGAY
        stiffness = self.cornering_stiffness(gamma)
        digressive = self._digressive(mu)
        camber = self.load * (c.PVY3 + c.PVY4 * dfz) * gamma * (c.LKYC * digressive if self.is_newer else mu)
        offset = self.load * (c.PVY1 + c.PVY2 * dfz) * c.LVY * digressive + camber  # (4.E28, 29)
        shift = (c.PHY1 + c.PHY2 * dfz) * c.LHY + c.PHY3 * gamma  # (4.E27)
        if self.is_newer:
            thrust = self.load * (c.PKY6 + c.PKY7 * dfz) * (1 + c.PPY5 * dpi) * c.LKYC  # (4.E30)
            shift = shift + (thrust * gamma - camber) / stiffness
        offset, shift = offset * offsets, shift * offsets
        y = alpha + shift  # (4.E20)
        shape = c.PCY1 * c.LCY  # (4.E21)
        friction = (c.PDY1 + c.PDY2 * dfz) * (1 + c.PPY3 * dpi + c.PPY4 * dpi**2) * (1 - c.PDY3 * gamma**2) * mu
        peak = friction * self.load  # (4.E22, 23)
        skew = 1 + c.PEY5 * gamma**2 - (c.PEY3 + c.PEY4 * gamma) * jnp.sign(y)
        curvature = (c.PEY1 + c.PEY2 * dfz) * skew * c.LEY  # (4.E24)
        least = jnp.where(c.PDY1 < 0, -_EPSILON, _EPSILON) * self.nominal
        slope, turn = stiffness / (shape * peak + least), stiffness / (peak + least)  # (4.E26)
        force = peak * jnp.sin(shape * _angle(y, slope, curvature)) + offset  # (4.E19)
        return Lateral(force, friction, stiffness, turn, shift + offset / stiffness)

    def _digressive(self, mu):
        return _DIGRESSION * mu / (1 + (_DIGRESSION - 1) * mu) if self.is_newer else mu  # (4.E8)

    # Combined slip

    def _weight_x(self, kappa, alpha):
        c = self.c
        slope = (c.RBX1 + c.RBX3 * self.gamma**2) * _cos_arctan(c.RBX2 * kappa) * c.LXAL  # (4.E54)
        return _weight(alpha, c.RHX1, slope, c.RCX1, c.REX1 + c.REX2 * self.dfz)  # (4.E51)

    def _weight_y(self, kappa, alpha):
        c, dfz = self.c, self.dfz
        slope = (c.RBY1 + c.RBY4 * self.gamma**2) * _cos_arctan(c.RBY2 * (alpha - c.RBY3)) * c.LYKA  # (4.E62)
        return _weight(kappa, c.RHY1 + c.RHY2 * dfz, slope, c.RCY1, c.REY1 + c.REY2 * dfz)  # (4.E59)

    def _induced(self, kappa, alpha, friction):
        """The lateral force S_Vyκ due to κ (4.E66, 67)."""
        c = self.c
        peak = friction * self.load * (c.RVY1 + c.RVY2 * self.dfz + c.RVY3 * self.gamma) * _cos_arctan(c.RVY4 * alpha)
        return peak * jnp.sin(c.RVY5 * jnp.arctan(c.RVY6 * kappa)) * c.LVYKA

    # Moments

    def _aligning(self, kappa, alpha, mu, travel, lateral: Lateral, force, fx, fy):
        c, dfz = self.c, self.dfz
        gamma = self.gamma if self.is_newer else self.gamma * c.LGAZ
        along = travel * jnp.cos(alpha)  # (4.E6)
        by_slip = (self.longitudinal_stiffness() / lateral.stiffness * kappa) ** 2
        # The sign of these angles does not matter (4.E77, 78).
        equivalent = lambda angle: jnp.arctan(jnp.sqrt(jnp.tan(angle) ** 2 + by_slip + _TINY))

        angle = alpha + c.QHZ1 + c.QHZ2 * dfz + (c.QHZ3 + c.QHZ4 * dfz) * gamma  # (4.E34, 35)
        slope = c.QBZ1 + c.QBZ2 * dfz + c.QBZ3 * dfz**2
        slope = slope * (1 + c.QBZ4 * gamma + c.QBZ5 * jnp.abs(gamma)) * c.LKY / (mu + _EPSILON)  # (4.E40)
        size = (c.QDZ1 + c.QDZ2 * dfz) * (1 - c.PPZ1 * self.dpi) * (1 + c.QDZ3 * gamma + c.QDZ4 * gamma**2)
        size = size * self.load * self.radius / self.nominal * c.LTR  # (4.E42, 43)
        curvature = c.QEZ1 + c.QEZ2 * dfz + c.QEZ3 * dfz**2
        skew = (c.QEZ4 + c.QEZ5 * gamma) * (2 / jnp.pi) * jnp.arctan(slope * c.QCZ1 * angle)
        cosine = jnp.cos(c.QCZ1 * _angle(equivalent(angle), slope, curvature * (1 + skew)))
        trail = size * cosine * along  # (4.E44, 73)

        residual = (c.QDZ6 + c.QDZ7 * dfz) * c.LRES
        by_camber = (c.QDZ8 + c.QDZ9 * dfz) * (1 + c.PPZ2 * self.dpi) + (c.QDZ10 + c.QDZ11 * dfz) * jnp.abs(gamma)
        residual = residual + by_camber * gamma * c.LKZC  # (4.E47)
        turn = c.QBZ9 * c.LKY / (mu + _EPSILON) + c.QBZ10 * lateral.turn  # (4.E45)
        fading = _cos_arctan(turn * equivalent(alpha + lateral.shift))  # (4.E37, 75)
        residual = residual * self.load * self.radius * mu * along * fading

        lever = c.SSZ1 + c.SSZ2 * fy / self.nominal + (c.SSZ3 + c.SSZ4 * dfz) * self.gamma
        return residual - trail * force + lever * self.radius * c.LS * fx  # (4.E71, 72, 76)

    def _overturning(self, fy):
        c, gamma = self.c, self.gamma
        load, side = self.load / c.FNOMIN, fy / c.FNOMIN
        terms = c.QSX1 * c.LVMX - c.QSX2 * gamma * (1 + c.PPMX1 * self.dpi) + c.QSX3 * side
        terms = terms + c.QSX10 * jnp.arctan(c.QSX11 * load) * gamma - c.QSX12 * gamma * jnp.abs(gamma)
        by_load = c.QSX4 * jnp.cos(c.QSX5 * jnp.arctan((c.QSX6 * load) ** 2))
        terms = terms + by_load * jnp.sin(c.QSX7 * gamma + c.QSX8 * jnp.arctan(c.QSX9 * side))
        direct = fy * (c.QSX13 + c.QSX14 * jnp.abs(gamma))
        return self.radius * c.LMX * (self.load * terms + direct)  # (4.E69)

    def _rolling(self, fx, speed, travel):
        c, load = self.c, self.load / self.c.FNOMIN
        terms = c.QSY1 + c.QSY2 * fx / c.FNOMIN + c.QSY3 * speed / c.LONGVL + c.QSY4 * (speed / c.LONGVL) ** 4
        terms = terms + (c.QSY5 + c.QSY6 * load) * self.gamma**2
        size = self.radius * c.FNOMIN * c.LMY * load**c.QSY7 * (1 + self.dpi) ** c.QSY8
        return -travel * size * terms  # (4.E70)


def _angle(x, slope, curvature):
    """The argument of the Magic Formula, over its shape factor."""
    u = slope * x
    return jnp.arctan(u - jnp.where(curvature > 1.0, 1.0, curvature) * (u - jnp.arctan(u)))


def _cos_arctan(x):
    return 1 / jnp.sqrt(1 + x * x)


def _weight(x, shift, slope, shape, curvature):
    """The weight of combined slip, one without slip of the other kind."""
    cosine = lambda x: jnp.cos(shape * _angle(x, slope, curvature))
    return cosine(x + shift) / cosine(shift)


# The load, and radii


def elastic(coefficients: Mapping[str, Number], pressure, depth) -> tuple[Number, Number]:
    """Load [N] and energy [J] of a wheel that does not turn, at a depth [m] of its unloaded circle."""
    c = _all(coefficients)
    hardness, ratio = c.FNOMIN * (1 + c.PFZ1 * _excess(c, pressure)), depth / c.UNLOADED_RADIUS
    square = (c.VERTICAL_STIFFNESS * c.UNLOADED_RADIUS / c.FNOMIN) ** 2 - 4 * c.Q_FZ2
    first = jnp.sqrt(square) if c.Q_FZ1 is None else c.Q_FZ1
    energy = c.UNLOADED_RADIUS * ratio**2 * (first / 2 + c.Q_FZ2 * ratio / 3)
    return hardness * ratio * (first + c.Q_FZ2 * ratio), hardness * energy  # (4.E68)


def by_spin(coefficients: Mapping[str, Number], spin) -> tuple[Number, Number]:
    """For a spin [rad/s]: the factor of the load, and the growth [m] of the unloaded radius (4.E68, 7.E1)."""
    c = _all(coefficients)
    ratio = jnp.abs(spin) * c.UNLOADED_RADIUS / c.LONGVL
    return 1 + c.Q_V2 * ratio, c.UNLOADED_RADIUS * c.Q_V1 * ratio**2


def rolling_radius(version: Version, coefficients: Mapping[str, Number], pressure, radius, depth, load):
    """The effective rolling radius [m], from the radius and the depth [m] of the unloaded circle and the load [N]."""
    c = _all(coefficients)
    stiffness = c.VERTICAL_STIFFNESS * (1 + c.PFZ1 * _excess(c, pressure))
    share = load / c.FNOMIN if version == "6.1" else depth * stiffness / c.FNOMIN
    return radius - c.FNOMIN / stiffness * (c.DREFF * jnp.arctan(c.BREFF * share) + c.FREFF * share)


def _all(coefficients):
    return SimpleNamespace(**{**DEFAULTS, **coefficients})


def _excess(c, pressure):
    return 0.0 if pressure is None else clipped(pressure, c.PRESMIN, c.PRESMAX) / c.NOMPRES - 1.0
