"""The Magic Formula in NumPy, equation by equation, without any limits, for a wheel that rolls forwards.

Version 6.1 from Pacejka, "Tyre and Vehicle Dynamics", 2012, section 4.3.2 (with angles for their sines and tangents, as
Besselink, Schmeitz and Pacejka 2010); version 5.2 from its first edition, 2002.
"""

import re

import numpy as np
from numpy import abs, arctan, cos, exp, pi, sign, sin, sqrt, tan


def coefficients(path, **scale):
    """The numbers of a file as they stand there, some of them times a factor."""
    text = path.read_text()
    found = re.findall(r"^(\w+) *= *([-+.\dEe]+)", text, re.MULTILINE)
    return {key: float(value) * scale.get(key, 1.0) for key, value in found}


def version_61(p, Fz, kappa, alpha, gamma, pressure, V):
    """Fx, Fy, Mx, My, Mz, and the relaxation lengths."""
    R0, Fz0, p0, V0 = p["UNLOADED_RADIUS"], p["FNOMIN"], p["NOMPRES"], p["LONGVL"]
    lam = lambda name: p.get(name, 1.0)
    Fz0_ = lam("LFZO") * Fz0  # E1
    dfz = (Fz - Fz0_) / Fz0_  # E2a
    dpi = (pressure - p0) / p0  # E2b
    Vs = V * np.hypot(kappa, tan(alpha))
    mu_x = lam("LMUX") / (1 + p.get("LMUV", 0.0) * Vs / V0)  # E7
    mu_y = lam("LMUY") / (1 + p.get("LMUV", 0.0) * Vs / V0)
    mu_x_ = 10 * mu_x / (1 + 9 * mu_x)  # E8
    mu_y_ = 10 * mu_y / (1 + 9 * mu_y)

    # Longitudinal force
    SHx = (p["PHX1"] + p["PHX2"] * dfz) * lam("LHX")  # E17
    kx = kappa + SHx  # E10
    Cx = p["PCX1"] * lam("LCX")  # E11
    mux = (p["PDX1"] + p["PDX2"] * dfz) * (1 + p["PPX3"] * dpi + p["PPX4"] * dpi**2) * (1 - p["PDX3"] * gamma**2) * mu_x
    Dx = mux * Fz  # E12
    Ex = (p["PEX1"] + p["PEX2"] * dfz + p["PEX3"] * dfz**2) * (1 - p["PEX4"] * sign(kx)) * lam("LEX")  # E14
    Kxk = Fz * (p["PKX1"] + p["PKX2"] * dfz) * exp(p["PKX3"] * dfz) * (1 + p["PPX1"] * dpi + p["PPX2"] * dpi**2)
    Kxk = Kxk * lam("LKX")  # E15
    Bx = Kxk / (Cx * Dx)  # E16
    SVx = Fz * (p["PVX1"] + p["PVX2"] * dfz) * lam("LVX") * mu_x_  # E18
    Fx0 = Dx * sin(Cx * arctan(Bx * kx - Ex * (Bx * kx - arctan(Bx * kx)))) + SVx  # E9

    def lateral(g):
        Kya = p["PKY1"] * Fz0_ * (1 + p["PPY1"] * dpi) * (1 - p["PKY3"] * abs(g)) * lam("LKY")
        inner = (Fz / Fz0_) / ((p["PKY2"] + p["PKY5"] * g**2) * (1 + p["PPY2"] * dpi))
        Kya = Kya * sin(p["PKY4"] * arctan(inner))  # E25
        SVyg = Fz * (p["PVY3"] + p["PVY4"] * dfz) * g * lam("LKYC") * mu_y_  # E28
        SVy = Fz * (p["PVY1"] + p["PVY2"] * dfz) * lam("LVY") * mu_y_ + SVyg  # E29
        Kyg0 = Fz * (p["PKY6"] + p["PKY7"] * dfz) * (1 + p["PPY5"] * dpi) * lam("LKYC")  # E30
        SHy = (p["PHY1"] + p["PHY2"] * dfz) * lam("LHY") + (Kyg0 * g - SVyg) / Kya  # E27
        ay = alpha + SHy  # E20
        Cy = p["PCY1"] * lam("LCY")  # E21
        muy = (p["PDY1"] + p["PDY2"] * dfz) * (1 + p["PPY3"] * dpi + p["PPY4"] * dpi**2) * (1 - p["PDY3"] * g**2) * mu_y
        Dy = muy * Fz  # E22
        Ey = (
            (p["PEY1"] + p["PEY2"] * dfz) * (1 + p["PEY5"] * g**2 - (p["PEY3"] + p["PEY4"] * g) * sign(ay)) * lam("LEY")
        )
        By = Kya / (Cy * Dy)  # E26
        Fy0 = Dy * sin(Cy * arctan(By * ay - Ey * (By * ay - arctan(By * ay)))) + SVy  # E19
        return Fy0, muy, Kya, By * Cy, SHy + SVy / Kya  # E38

    Fy0, muy, Kya, ByCy, SHf = lateral(gamma)

    # Combined slip
    Bxa = (p["RBX1"] + p["RBX3"] * gamma**2) * cos(arctan(p["RBX2"] * kappa)) * lam("LXAL")  # E54
    Cxa, Exa, SHxa = p["RCX1"], p["REX1"] + p["REX2"] * dfz, p["RHX1"]  # E55, E56, E57
    G = lambda x: cos(Cxa * arctan(Bxa * x - Exa * (Bxa * x - arctan(Bxa * x))))
    Fx = G(alpha + SHxa) / G(SHxa) * Fx0  # E50 to E53
    Byk = (p["RBY1"] + p["RBY4"] * gamma**2) * cos(arctan(p["RBY2"] * (alpha - p["RBY3"]))) * lam("LYKA")  # E62
    Cyk, Eyk, SHyk = p["RCY1"], p["REY1"] + p["REY2"] * dfz, p["RHY1"] + p["RHY2"] * dfz  # E63, E64, E65
    H = lambda x: cos(Cyk * arctan(Byk * x - Eyk * (Byk * x - arctan(Byk * x))))
    Gyk = H(kappa + SHyk) / H(SHyk)  # E59 to E61
    DVyk = muy * Fz * (p["RVY1"] + p["RVY2"] * dfz + p["RVY3"] * gamma) * cos(arctan(p["RVY4"] * alpha))  # E67
    SVyk = DVyk * sin(p["RVY5"] * arctan(p["RVY6"] * kappa)) * lam("LVYKA")  # E66
    Fy = Gyk * Fy0 + SVyk  # E58

    # Aligning moment
    at = alpha + p["QHZ1"] + p["QHZ2"] * dfz + (p["QHZ3"] + p["QHZ4"] * dfz) * gamma  # E34, E35
    ar = alpha + SHf  # E37
    at_eq = arctan(sqrt(tan(at) ** 2 + (Kxk / Kya * kappa) ** 2)) * sign(at)  # E77
    ar_eq = arctan(sqrt(tan(ar) ** 2 + (Kxk / Kya * kappa) ** 2)) * sign(ar)  # E78
    Bt = (p["QBZ1"] + p["QBZ2"] * dfz + p["QBZ3"] * dfz**2) * (1 + p["QBZ4"] * gamma + p["QBZ5"] * abs(gamma))
    Bt = Bt * lam("LKY") / mu_y  # E40
    Ct = p["QCZ1"]  # E41
    Dt = Fz * (R0 / Fz0_) * (p["QDZ1"] + p["QDZ2"] * dfz) * (1 - p["PPZ1"] * dpi) * lam("LTR")  # E42
    Dt = Dt * (1 + p["QDZ3"] * gamma + p["QDZ4"] * gamma**2)  # E43
    Et = p["QEZ1"] + p["QEZ2"] * dfz + p["QEZ3"] * dfz**2
    Et = Et * (1 + (p["QEZ4"] + p["QEZ5"] * gamma) * 2 / pi * arctan(Bt * Ct * at))  # E44
    t = Dt * cos(Ct * arctan(Bt * at_eq - Et * (Bt * at_eq - arctan(Bt * at_eq)))) * cos(alpha)  # E73
    Br = p["QBZ9"] * lam("LKY") / mu_y + p["QBZ10"] * ByCy  # E45
    tilt = (p["QDZ8"] + p["QDZ9"] * dfz) * (1 + p["PPZ2"] * dpi) + (p["QDZ10"] + p["QDZ11"] * dfz) * abs(gamma)
    Dr = Fz * R0 * ((p["QDZ6"] + p["QDZ7"] * dfz) * lam("LRES") + tilt * gamma * lam("LKZC")) * mu_y * cos(alpha)  # E47
    Mzr = Dr * cos(arctan(Br * ar_eq))  # E75
    s = R0 * (p["SSZ1"] + p["SSZ2"] * Fy / Fz0_ + (p["SSZ3"] + p["SSZ4"] * dfz) * gamma) * lam("LS")  # E76
    Mz = -t * Gyk * lateral(0.0)[0] + Mzr + s * Fx  # E71, E72, E74

    # Overturning couple and rolling resistance
    Mx = p["QSX1"] * lam("LVMX") - p["QSX2"] * gamma * (1 + p["PPMX1"] * dpi) + p["QSX3"] * Fy / Fz0
    swing = sin(p["QSX7"] * gamma + p["QSX8"] * arctan(p["QSX9"] * Fy / Fz0))
    Mx = Mx + p["QSX4"] * cos(p["QSX5"] * arctan((p["QSX6"] * Fz / Fz0) ** 2)) * swing
    Mx = Mx + p["QSX10"] * arctan(p["QSX11"] * Fz / Fz0) * gamma
    Mx = R0 * Fz * Mx * lam("LMX")  # E69
    extra = Fy * (p["QSX13"] + p["QSX14"] * abs(gamma)) - Fz * p["QSX12"] * gamma * abs(gamma)
    Mx = Mx + R0 * lam("LMX") * extra
    My = p["QSY1"] + p["QSY2"] * Fx / Fz0 + p["QSY3"] * abs(V / V0) + p["QSY4"] * (V / V0) ** 4
    My = My + (p["QSY5"] + p["QSY6"] * Fz / Fz0) * gamma**2
    My = -R0 * Fz0 * My * (Fz / Fz0) ** p["QSY7"] * (pressure / p0) ** p["QSY8"] * lam("LMY")  # E70

    Cx = p["LONGITUDINAL_STIFFNESS"] * (1 + p["PCFX1"] * dfz + p["PCFX2"] * dfz**2) * (1 + p["PCFX3"] * dpi)
    Cy = p["LATERAL_STIFFNESS"] * (1 + p["PCFY1"] * dfz + p["PCFY2"] * dfz**2) * (1 + p["PCFY3"] * dpi)
    return np.stack(np.broadcast_arrays(Fx, Fy, Mx, My, Mz)), abs(Kxk / Cx), abs(Kya / Cy)


def version_52(p, Fz, kappa, alpha, gamma, V):
    """Fx, Fy, Mx, My, Mz, and the relaxation lengths."""
    R0, Fz0, V0 = p["UNLOADED_RADIUS"], p["FNOMIN"], p["LONGVL"]
    lam = lambda name: p.get(name, 1.0)
    Fn = Fz0 * lam("LFZO")
    dfz = (Fz - Fn) / Fn
    gx, gy, gz = gamma * lam("LGAX"), gamma * lam("LGAY"), gamma * lam("LGAZ")

    kx = kappa + (p["PHX1"] + p["PHX2"] * dfz) * lam("LHX")
    mux = (p["PDX1"] + p["PDX2"] * dfz) * (1 - p["PDX3"] * gx**2) * lam("LMUX")
    Cx, Dx = p["PCX1"] * lam("LCX"), mux * Fz
    Ex = (p["PEX1"] + p["PEX2"] * dfz + p["PEX3"] * dfz**2) * (1 - p["PEX4"] * sign(kx)) * lam("LEX")
    Kx = Fz * (p["PKX1"] + p["PKX2"] * dfz) * exp(p["PKX3"] * dfz) * lam("LKX")
    Bx = Kx / (Cx * Dx)
    SVx = Fz * (p["PVX1"] + p["PVX2"] * dfz) * lam("LVX") * lam("LMUX")
    Fx0 = Dx * sin(Cx * arctan(Bx * kx - Ex * (Bx * kx - arctan(Bx * kx)))) + SVx

    SHy = (p["PHY1"] + p["PHY2"] * dfz) * lam("LHY") + p["PHY3"] * gy
    ay = alpha + SHy
    muy = (p["PDY1"] + p["PDY2"] * dfz) * (1 - p["PDY3"] * gy**2) * lam("LMUY")
    Cy, Dy = p["PCY1"] * lam("LCY"), muy * Fz
    Ey = (p["PEY1"] + p["PEY2"] * dfz) * (1 - (p["PEY3"] + p["PEY4"] * gy) * sign(ay)) * lam("LEY")
    Ky = p["PKY1"] * Fz0 * sin(2 * arctan(Fz / (p["PKY2"] * Fz0 * lam("LFZO")))) * (1 - p["PKY3"] * abs(gy))
    Ky = Ky * lam("LFZO") * lam("LKY")
    By = Ky / (Cy * Dy)
    SVy = Fz * ((p["PVY1"] + p["PVY2"] * dfz) * lam("LVY") + (p["PVY3"] + p["PVY4"] * dfz) * gy) * lam("LMUY")
    Fy0 = Dy * sin(Cy * arctan(By * ay - Ey * (By * ay - arctan(By * ay)))) + SVy

    Bxa, Exa, Sxa = p["RBX1"] * cos(arctan(p["RBX2"] * kappa)) * lam("LXAL"), p["REX1"] + p["REX2"] * dfz, p["RHX1"]
    G = lambda x: cos(p["RCX1"] * arctan(Bxa * x - Exa * (Bxa * x - arctan(Bxa * x))))
    Fx = Fx0 * G(alpha + Sxa) / G(Sxa)
    Byk = p["RBY1"] * cos(arctan(p["RBY2"] * (alpha - p["RBY3"]))) * lam("LYKA")
    Eyk, Syk = p["REY1"] + p["REY2"] * dfz, p["RHY1"] + p["RHY2"] * dfz
    H = lambda x: cos(p["RCY1"] * arctan(Byk * x - Eyk * (Byk * x - arctan(Byk * x))))
    DVyk = muy * Fz * (p["RVY1"] + p["RVY2"] * dfz + p["RVY3"] * gamma) * cos(arctan(p["RVY4"] * alpha))
    SVyk = DVyk * sin(p["RVY5"] * arctan(p["RVY6"] * kappa)) * lam("LVYKA")
    Fy = Fy0 * H(kappa + Syk) / H(Syk) + SVyk

    at = alpha + p["QHZ1"] + p["QHZ2"] * dfz + (p["QHZ3"] + p["QHZ4"] * dfz) * gz
    ar = alpha + SHy + SVy / Ky
    at_eq = arctan(sqrt(tan(at) ** 2 + (Kx / Ky) ** 2 * kappa**2)) * sign(at)
    ar_eq = arctan(sqrt(tan(ar) ** 2 + (Kx / Ky) ** 2 * kappa**2)) * sign(ar)
    Bt = (p["QBZ1"] + p["QBZ2"] * dfz + p["QBZ3"] * dfz**2) * (1 + p["QBZ4"] * gz + p["QBZ5"] * abs(gz))
    Bt = Bt * lam("LKY") / lam("LMUY")
    Dt = Fz * (p["QDZ1"] + p["QDZ2"] * dfz) * (1 + p["QDZ3"] * gz + p["QDZ4"] * gz**2) * R0 / Fn * lam("LTR")
    Et = p["QEZ1"] + p["QEZ2"] * dfz + p["QEZ3"] * dfz**2
    Et = Et * (1 + (p["QEZ4"] + p["QEZ5"] * gz) * 2 / pi * arctan(Bt * p["QCZ1"] * at))
    t = Dt * cos(p["QCZ1"] * arctan(Bt * at_eq - Et * (Bt * at_eq - arctan(Bt * at_eq)))) * cos(alpha)
    Br = p["QBZ9"] * lam("LKY") / lam("LMUY") + p["QBZ10"] * By * Cy
    Dr = Fz * ((p["QDZ6"] + p["QDZ7"] * dfz) * lam("LRES") + (p["QDZ8"] + p["QDZ9"] * dfz) * gz) * R0 * lam("LMUY")
    Mzr = Dr * cos(arctan(Br * ar_eq)) * cos(alpha)
    s = R0 * (p["SSZ1"] + p["SSZ2"] * Fy / Fn + (p["SSZ3"] + p["SSZ4"] * dfz) * gamma) * lam("LS")
    Mz = -t * (Fy - SVyk) + Mzr + s * Fx

    Mx = R0 * Fz * (p["QSX1"] * lam("LVMX") - p["QSX2"] * gamma + p["QSX3"] * Fy / Fz0) * lam("LMX")
    My = p["QSY1"] + p["QSY2"] * Fx / Fz0 + p["QSY3"] * abs(V / V0) + p["QSY4"] * (V / V0) ** 4
    My = -R0 * Fz * My * lam("LMY")

    sigma_x = Fz * (p["PTX1"] + p["PTX2"] * dfz) * exp(-p["PTX3"] * dfz) * R0 / Fn * lam("LSGKP")
    sigma_y = p["PTY1"] * sin(2 * arctan(Fz / (p["PTY2"] * Fn))) * (1 - p["PKY3"] * abs(gy)) * R0 * lam("LFZO")
    return np.stack(np.broadcast_arrays(Fx, Fy, Mx, My, Mz)), sigma_x, sigma_y * lam("LSGAL")
