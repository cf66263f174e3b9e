"""Systems whose parameters are identified, and the vector of unknowns that an identification has."""

import jax.numpy as jnp

import jaxmb as mb
from jaxmb import planar
from jaxmb.lagrangian import LagrangianSystem
from jaxmb.studies.identify.loss import LOSSES
from jaxmb.studies.identify.unknowns import unknowns


def free_parameters(system, free, bounds=None):
    """Free parameters as a function of a vector, of one experiment that measures nothing yet."""
    experiment = mb.Experiment(ts=[1.0], residual=lambda trajectory: trajectory.ts)
    return unknowns(system, {"": experiment}, {}, free, bounds, None, None, LOSSES["linear"]).free


def pendulum():
    """A rod on a pin with a torsional spring and damper."""
    rod = planar.Body("rod", mass=2.0, inertia=planar.rod(2.0, 1.0), position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "rod", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    spring = planar.TorsionalSpringDamper("spring", "ground", "rod", stiffness=6.0, damping=0.3)
    return mb.Scene([rod], joints=[pin], forces=[spring, mb.Gravity((0.0, -9.81))]).compile()


def swing():
    """The rod's angle alone, as a Lagrangian system with damping."""
    return LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * p["length"] ** 2 * (v @ v),
        potential=lambda t, q, p: -9.81 * p["length"] * jnp.cos(q[0]),
        force=lambda t, q, v, p: -p["damping"] * v,
        q=[1.0],
        coordinates=("theta",),
        parameters={"length": 0.8, "damping": 0.3},
    )


def slider_crank():
    """A crank that turns freely and drives a piston against a spring."""
    bodies = [
        planar.Body("crank", mass=1.0, inertia=planar.rod(1.0, 0.2), position=(0.05, 0.0)),
        planar.Body("rod", mass=0.5, inertia=planar.rod(0.5, 0.3), position=(0.25, 0.0)),
        planar.Body("piston", mass=0.8, inertia=1e-3, position=(0.4, 0.0)),
    ]
    joints = [
        planar.Revolute("A", "ground", "crank", point_a=(0.0, 0.0), point_b=(-0.05, 0.0)),
        planar.Revolute("B", "crank", "rod", point_a=(0.05, 0.0), point_b=(-0.15, 0.0)),
        planar.Revolute("C", "rod", "piston", point_a=(0.15, 0.0), point_b=(0.0, 0.0)),
        planar.Prismatic("cylinder", "ground", "piston", point=(0.4, 0.0), axis=(1.0, 0.0)),
    ]
    spring = planar.SpringDamper("spring", "ground", "piston", stiffness=200.0, point_a=(0.7, 0.0), free_length=0.35)
    return mb.Scene(bodies, joints=joints, forces=[spring]).compile()
