"""Losses in gears and in the threads of screws by dry friction, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly

import jaxmb as mb
from jaxmb import planar, spatial

LOSS, RATIO, LOAD, RAMP, END = 0.1, 0.5, 2.0, 0.4, 1.5
OF_MOTOR, OF_LOAD = 0.3, 0.8


def gearbox(coefficient=LOSS, **options):
    """A motor that drives a loaded shaft by a gear, at rest in balance."""
    bodies = [
        planar.Body(name, mass=1.0, inertia=inertia) for name, inertia in (("motor", OF_MOTOR), ("shaft", OF_LOAD))
    ]
    joints = [
        planar.Revolute("motor pin", "ground", "motor", point=(0.0, 0.0)),
        planar.Revolute("shaft pin", "ground", "shaft", point=(0.0, 0.0)),
        mb.JointCoupling("gear", "shaft pin.angle", "motor pin.angle", coefficients=(0.0, RATIO)),
    ]
    forces = [
        mb.DryFriction("loss", "gear", coefficient=coefficient, **options),
        mb.JointForce("load", "shaft pin.angle", force=-LOAD),
        mb.JointForce("drive", "motor pin.angle", force=0.0),
    ]
    return mb.Scene(bodies, joints=joints, forces=forces).compile()


GEARBOX = gearbox()


def driven(system, sign):
    ramp = {"drive.force": lambda t: RATIO * LOAD + sign * RAMP * t}
    return mb.simulate(system, mb.assemble(system), t1=END, inputs=ramp, saveat=[END], rtol=1e-10)


def breaks_away(loss, sign):
    """When the motor's moment is that of the load through the efficiency of the gear, and its angle at the end."""
    efficiency = 1 - sign * loss
    start = sign * RATIO * LOAD * (1 / efficiency - 1) / RAMP
    inertia = OF_MOTOR + RATIO**2 * OF_LOAD / efficiency
    return start, sign * RAMP * (END - start) ** 3 / (6 * inertia)


@pytest.mark.slow
@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["the motor drives", "the load drives"])
def test_a_gear_with_losses(sign):
    motion = driven(GEARBOX, sign)
    start, angle = breaks_away(LOSS, sign)
    (slip,) = motion.events
    assert (slip.part, slip.kind) == ("loss", "slip") and 0 < start < 0.5 * END
    np.testing.assert_allclose(slip.time, start, rtol=1e-9)
    np.testing.assert_allclose(motion["motor pin"].angle[0], angle, rtol=1e-8)


@pytest.mark.slow
def test_derivatives_by_the_loss():
    end = lambda loss: driven(mb.with_parameters(GEARBOX, {"loss.coefficient": loss}), 1.0)["motor pin"].angle[0]
    exact = jax.grad(lambda loss: breaks_away(loss, 1.0)[1])(LOSS)
    np.testing.assert_allclose(jit_quickly(jax.grad(end))(LOSS), exact, rtol=1e-7)
    forward = jit_quickly(lambda loss: jax.jvp(end, (loss,), (jnp.ones(()),))[1])(jnp.asarray(LOSS))
    np.testing.assert_allclose(forward, exact, rtol=1e-7)


def test_friction_in_a_gear_is_given_by_its_name():
    assert list(GEARBOX.friction_rows) == [k for k, (name, _) in enumerate(GEARBOX.rows) if name == "gear"]
    with pytest.raises(ValueError, match="'loss': friction in JointCoupling 'gear' is given by its name, without a"):
        gearbox(radius=0.1)


@pytest.mark.slow
def test_a_nut_climbs_and_locks_itself_or_runs_down():
    mass, inertia, pitch, radius, spin, g = 2.0, 1e-3, 0.005, 0.01, 40.0, 9.81
    lead = pitch / (2 * np.pi)
    nut = spatial.Body("nut", mass=mass, inertia=(inertia,) * 3, angular_velocity=(0.0, 0.0, spin))
    nut = nut.with_fields(velocity=np.array([0.0, 0.0, lead * spin]))
    screw = spatial.Screw("screw", "ground", "nut", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), pitch=pitch)
    thread = mb.DryFriction("thread", "screw.angle", coefficient=0.2, radius=radius)
    system = mb.Scene([nut], joints=[screw], forces=[thread, mb.Gravity((0.0, 0.0, -g))]).compile()
    slowing = lambda arm: arm * mass * g / (inertia + arm * mass * lead)
    for coefficient in (0.2, 0.05):
        changed = mb.with_parameters(system, {"thread.coefficient": coefficient})
        motion = mb.simulate(changed, mb.assemble(changed), t1=4.0, saveat=[4.0], rtol=1e-9)
        up = slowing(lead + coefficient * radius)
        stop, angle = spin / up, 0.5 * spin**2 / up
        (event,) = motion.events
        locks = coefficient * radius > lead
        assert event.kind == ("stick" if locks else "slip")
        np.testing.assert_allclose(event.time, stop, rtol=1e-8)
        if not locks:
            angle -= 0.5 * slowing(lead - coefficient * radius) * (4.0 - stop) ** 2
        np.testing.assert_allclose(motion["screw"].displacement[0], lead * angle, rtol=1e-7)
    # The coefficient by which the moment that raises a load is that of the textbooks.
    slope, friction = lead / radius, 0.12
    raised = friction * (1 + slope**2) / (1 - friction * slope)
    np.testing.assert_allclose(slope + raised, (slope + friction) / (1 - friction * slope), rtol=1e-12)
