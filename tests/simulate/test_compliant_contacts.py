"""Compliant contacts that close and open again within a step are not passed over."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from scenarios import Derived

import jaxmb as mb
from jaxmb import planar

SOLVERS = {
    "Adams": mb.solvers.Adams(),
    "Hermite": mb.solvers.Hermite(),
    "Dopri8": diffrax.Dopri8(),
    "Tsit5": diffrax.Tsit5(),
}


# A layer that pushes back a body which enters it, from either side, with the potential k (w² − d²)³.


def push(poses, velocities, t, p):
    d = poses[0, 0] - p["place"]
    force = 6 * p["strength"] * d * jnp.maximum(p["width"] ** 2 - d**2, 0.0) ** 2
    return jnp.zeros(3).at[0].set(force)


def layer(gap):
    ball = planar.Body("ball", mass=1.0, inertia=1.0, velocity=(1.0, 0.0))
    numbers = {"place": 0.5, "width": 1e-3, "strength": 1.0}
    return mb.Scene([ball], forces=[mb.Force("layer", "ball", push, parameters=numbers, gap=gap)]).compile()


LAYER = layer(lambda poses, t, p: jnp.abs(poses[0, 0] - p["place"]) - p["width"])


def with_layer(system, place, width, height):
    """The layer with the potential `height` [J] in its middle."""
    return mb.with_parameters(system, {"layer.place": place, "layer.width": width, "layer.strength": height / width**6})


def delayed(place, width, height):
    """Where a ball of 1 kg that starts with 1 m/s is after 1 s, by quadrature of its way through the layer."""
    x, weights = np.polynomial.legendre.leggauss(200)
    time = width * weights @ (1 / np.sqrt(1 - 2 * height * (1 - x**2) ** 3))
    return 1.0 - (time - 2 * width)


@pytest.mark.slow("Hermite", "Tsit5")
@pytest.mark.parametrize("solver", SOLVERS)
def test_ball_passes_a_thin_layer(solver):
    rtol = 1e-6
    for place, width in ((0.3, 0.03), (0.61, 1e-3)):
        system = with_layer(LAYER, place, width, 0.4)
        motion = mb.simulate(system, system.guess, t1=1.0, rtol=rtol, solver=SOLVERS[solver])
        assert abs(motion.ys.q[-1, 0] - delayed(place, width, 0.4)) < 100 * rtol
        assert abs(motion.ys.u[-1, 0] - 1) < 100 * rtol


def test_ball_that_a_thin_layer_throws_back_also_backwards_in_time():
    system = with_layer(LAYER, 0.5, 1e-3, 0.6)
    motion = mb.simulate(system, system.guess, t1=1.0, rtol=1e-8)
    assert abs(motion.ys.u[-1, 0] + 1) < 1e-6
    back = mb.simulate(system, motion.end, t0=1.0, t1=0.0, rtol=1e-8)
    np.testing.assert_allclose(back.ys.q[-1], system.guess.q, atol=1e-6)
    np.testing.assert_allclose(back.ys.u[-1], system.guess.u, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["Adams", "Dopri8"])
def test_ball_that_passes_a_thin_layer_has_derivatives(solver):
    """By its height and place, in a batch."""

    def end(x, rtol):
        system = with_layer(LAYER, x[1], 1e-2, x[0])
        return mb.simulate(system, system.guess, t1=1.0, rtol=rtol, solver=SOLVERS[solver])["ball"].position[-1, :1]

    exact = lambda x: np.array([delayed(x[1], 1e-2, x[0])])
    # In a batch, diffrax's method may choose other steps.
    many = [[0.3, 0.37], [0.4, 0.2], [0.4, 0.8]] if solver == "Adams" else None
    Derived(end, [0.3, 0.37], exact, traced=False, many=many, values=3e-7, near=1e-5).check()


# A ball that bounces on a floor.


def bouncing():
    def floor(poses, velocities, t, p):
        return jnp.zeros(3).at[1].set(1e4 * jnp.maximum(-poses[0, 1], 0.0))

    ball = planar.Body("ball", mass=1.0, inertia=1.0, position=(0.0, 0.5))
    forces = [mb.Gravity((0.0, -9.81)), mb.Force("floor", "ball", floor)]
    return mb.Scene([ball], forces=forces).compile()


# A finger that a driver turns strikes a paddle at rest.


def strike():
    bodies = [
        planar.Body("finger", mass=0.5, inertia=5e-4, angle=np.pi),
        planar.Body("paddle", mass=0.5, inertia=5e-4, position=(0.1, 0.0)),
    ]
    joints = [
        planar.Revolute("shaft", "ground", "finger", point=(0.0, 0.0)),
        planar.Revolute("pin", "ground", "paddle", point=(0.1, 0.0)),
        mb.JointDriver("turn", "shaft.angle", value=np.pi, rate=6.0),
    ]
    ends = {"centre": (0.05, 0.0), "centres": (-0.055, 0.0), "radius": 0.005, "radii": 0.005}
    steel = {"normal": mb.contact.Linear(1e4), "smoothing": 1e-5}
    blow = planar.DiscContact("blow", ("finger", "paddle"), **ends, **steel)
    return mb.Scene(bodies, joints=joints, forces=[blow]).compile()


@pytest.mark.slow
def test_finger_that_is_driven_evenly_strikes_a_paddle():
    system = strike()
    for rtol in (1e-4, 1e-6, 1e-8):
        motion = mb.simulate(system, mb.assemble(system, fix={"pin.angle": 0.0}), t1=2.0, rtol=rtol)
        # With steps of at most 1 ms and rtol 1e-12.
        assert abs(motion["paddle"].angular_velocity[-1] + 10.0704758150) < 500 * rtol


# The longest step.


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["Adams", "Hermite", "Dopri8"])
def test_dtmax_bounds_steps_and_leaves_the_tolerances(solver):
    system, longest = bouncing(), 0.01
    steps = diffrax.SaveAt(t0=True, steps=True)
    bounded = mb.simulate(system, system.guess, t1=0.6, saveat=steps, solver=SOLVERS[solver], dtmax=longest)
    assert np.diff(bounded.ts).max() <= longest * (1 + 1e-12) and bounded.ts.size > 60
    free = mb.simulate(system, system.guess, t1=0.6, solver=SOLVERS[solver])
    np.testing.assert_allclose(bounded.ys.u[-1], free.ys.u[-1], atol=1e-5)
    # The same steps, as far as these do not depend on rounding errors at a kink.
    ends = [mb.simulate(system, system.guess, t1=0.3, solver=SOLVERS[solver], dtmax=dtmax) for dtmax in (None, np.inf)]
    np.testing.assert_allclose(*(end.ys.u for end in ends), rtol=1e-14)


def test_dtmax_that_cannot_work_is_refused():
    system = bouncing()
    control, adams = mb.solvers.MultistepController(1e-6, 1e-8), mb.solvers.Adams(rtol=1e-6, atol=1e-8)
    for options, message in (
        ({"dtmax": -1.0}, "dtmax must be positive, got -1"),
        ({"dtmax": 0.1, "stepsize_controller": control}, "give it to the stepsize_controller"),
        ({"dtmax": 0.1, "solver": adams}, "leave out the tolerances of Adams"),
    ):
        with pytest.raises(ValueError, match=message):
            mb.simulate(system, system.guess, t1=1.0, **options)
