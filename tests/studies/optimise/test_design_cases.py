"""Designs as users write them, which start infeasible: a four-bar path from the literature, a camber curve."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb

pytestmark = pytest.mark.slow

# A. Kunjur and S. Krishnamurty, "Genetic algorithms in mechanism synthesis", J. Applied Mechanisms and Robotics 4(2),
# 1997: five points with prescribed crank angles.
ARC = np.array([(3.0, 3.0), (2.759, 3.363), (2.372, 3.663), (1.890, 3.862), (1.355, 3.943)])
ANGLES = np.deg2rad([30.0, 45.0, 60.0, 75.0, 90.0])
LENGTHS = ("base", "crank", "coupler", "rocker")
# The best designs of this paper, of J. A. Cabrera et al., Mechanism and Machine Theory 37, 2002 and 46, 2011, and of
# S. Nguyen-Van et al., Symmetry 14, 381, 2022: the lengths and the point of the coupler.
PUBLISHED = {
    "Kunjur 1997": (3.509643, 1.857606, 4.725835, 3.518721, 1.959538, 1.558898),
    "Cabrera 2002": (3.0630424, 1.9959624, 3.305823, 2.524706, 1.645158, 1.708959),
    "Cabrera 2011": (3.77326856, 2.00000403, 4.11697104, 2.74615671, 1.67848787, 1.67098007),
    "Nguyen-Van 2022": (4.2930812, 1.9978324, 4.7374099, 2.9417301, 1.7074051, 1.6441696),
}


def four_bar(lengths, scale, angle):
    """A four-bar linkage whose lengths are design variables."""
    mechanism = mb.mechanisms.four_bar(lengths=lengths[1:], base=lengths[0], angle=angle)
    variables = {n: mb.Variable(x, (0.01, 60.0), scale, "m") for n, x in zip(LENGTHS, lengths, strict=True)}

    def points(v):
        end = lambda name, sign: jnp.stack([0.5 * sign * v[name], jnp.zeros(())])
        out = {"A.point_b": end("crank", -1), "B.point_a": end("crank", 1), "B.point_b": end("coupler", -1)}
        out |= {"C.point_a": end("coupler", 1), "C.point_b": end("rocker", 1), "D.point_b": end("rocker", -1)}
        return out | {"D.point_a": jnp.stack([v["base"], jnp.zeros(())])}

    return mb.design(mechanism.system, variables, points), mechanism.state


def path_error(system, state, v):
    """Squared distances of the coupler's point from the arc at crank angles, one after the other, the root of their
    mean, and the gap.
    """
    own = mb.parameters(system)
    system = mb.with_parameters(system, {name: x for name, x in v.items() if name in own})

    def turn(guess, angle):
        fix = {"crank.angle": angle}
        new = mb.assemble(system, guess, fix=fix, throw=False)
        ahead = jax.tree.map(lambda new, old: jnp.where(jnp.isnan(new), old, new), new, guess)
        return ahead, (new.q[3:6], mb.assembly_gap(system, guess, fix=fix))

    _, (coupler, gap) = jax.lax.scan(turn, state, jnp.asarray(ANGLES))
    x, y, c, s = v["point"][0] - 0.5 * v["coupler"], v["point"][1], jnp.cos(coupler[:, 2]), jnp.sin(coupler[:, 2])
    path = coupler[:, :2] + jnp.stack([c * x - s * y, s * x + c * y], axis=1)
    error = jnp.sum((path - ARC) ** 2)
    return {"error": error, "distance": jnp.sqrt(error / len(ARC)), "gap": jnp.sum(gap)}


def closed_form_error(base, crank, coupler, rocker, x, y):
    """The same of the better branch, by complex numbers."""
    B = crank * np.exp(1j * ANGLES)
    way = base - B
    distance = np.abs(way)
    along = (coupler**2 - rocker**2 + distance**2) / (2 * distance)
    across = 1j * np.sqrt(coupler**2 - along**2)
    paths = [B + way / distance * (along + side * across) / coupler * (x + 1j * y) for side in (1, -1)]
    return min(np.sum(np.abs(path - ARC @ [1, 1j]) ** 2) for path in paths)


def test_four_bar_along_an_arc():
    """From a start that cannot be assembled, to an error below those of the literature."""
    system, state = four_bar((6.0, 2.0, 5.0, 5.0), 5.0, ANGLES[0])
    best = mb.optimise(
        lambda v: path_error(system, state, v),
        {"base": 6.0, "crank": 2.0, "coupler": 2.5, "rocker": 1.5, "point": [1.0, 1.0]},
        objective="distance",
        constraints={"gap": (None, 0)},
        system=system,
        bounds={"point": (-50.0, 50.0)},
        max_iterations=500,
    )
    p = best.parameters
    again = closed_form_error(*(p[n] for n in LENGTHS), *p["point"])
    assert np.isnan(best.before["error"])
    np.testing.assert_allclose(again, best.outputs["error"], rtol=1e-4, atol=1e-12)
    assert best.outputs["error"] <= min(closed_form_error(*own) for own in PUBLISHED.values()) < 2e-6


def test_camber_curve_of_a_double_wishbone():
    """The upper ball joint and the tie rod for a camber proportional to the wheel's travel, with little bump steer."""
    m = mb.mechanisms.get("double_wishbone")
    known, place = mb.parameters(m.system), m.system.guess.q
    ball, rack = np.asarray(known["upper_ball.point_a"] + place[7:10]), np.asarray(known["tie_rod.point_a"])
    near = lambda x: mb.Variable(x, (x - 0.05, x + 0.05), unit="m")
    variables = {"ball": near(ball), "rack": near(rack), "rod": mb.Variable(0.2, (0.05, 0.6), unit="m")}
    suspension = mb.design(
        m.system,
        variables,
        lambda v: {
            "upper_ball.point_a": v["ball"] - place[7:10],
            "upper_ball.point_b": v["ball"] - place[14:17],
            "tie_rod.point_a": v["rack"],
            "tie_rod.length": v["rod"],
        },
    )
    travel = jnp.linspace(-0.06, 0.06, 7)

    def curve(v):
        s = mb.with_parameters(suspension, v)

        def at(z):
            fix = {"upright.z": place[16] + z}
            p = mb.assemble(s, m.state, fix=fix, throw=False).q[17:21]
            axle = 2 * jnp.stack([p[1] * p[2] - p[0] * p[3], p[0] ** 2 + p[2] ** 2 - 0.5, p[2] * p[3] + p[0] * p[1]])
            return -jnp.arcsin(axle[2]), jnp.arctan2(axle[0], axle[1]), mb.assembly_gap(s, m.state, fix=fix)

        camber, toe, gap = jax.vmap(at)(travel)
        return {"error": jnp.sum((camber + 0.6 * travel) ** 2), "toe": toe, "camber": camber, "gap": jnp.sum(gap)}

    limits = {"toe": (-5e-3, 5e-3), "gap": (None, 0)}
    best = mb.optimise(curve, list(variables), system=suspension, objective="error", constraints=limits)
    assert best.success and np.isnan(best.before["error"])
    assert np.max(np.abs(best.outputs["toe"])) < 5.001e-3
    assert np.max(np.abs(best.outputs["camber"] + 0.6 * travel)) < np.deg2rad(0.2)
