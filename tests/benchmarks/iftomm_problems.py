"""The rigid problems of the IFToMM Library of Computational Benchmark Problems, with the library's own errors.

Sources: M. González, D. Dopico, U. Lugrís and J. Cuadrado, "A benchmarking system for MBS simulation software:
problem standardization and performance measurement", Multibody System Dynamics 16, 2006 (A01 to A05); F. González, P.
Masarati, J. Cuadrado and M. A. Naya, "Assessment of linearization approaches for multibody dynamics formulations", J.
Comput. Nonlinear Dynam. 12, 2017 (the four-bar with a diagonal spring). The times of OpenSim 3.2 were published with
MBSbenchmarksInOpenSim, on an Intel Core i5-4570 at 3.2 GHz.
"""

from collections.abc import Callable
from typing import NamedTuple

import diffrax
import numpy as np
from scipy.special import ellipj, ellipk

import jaxmb as mb
from jaxmb import planar
from jaxmb.mechanisms import Mechanism


class Case(NamedTuple):
    """`error(mechanism, trajectory)` is the largest one of the `measure` over all saved `times`, in its unit;
    `opensim` a published time [s], or None.
    """

    title: str
    mechanism: Callable[[], Mechanism]
    measure: str
    error: Callable[[Mechanism, mb.Trajectory], float]
    times: np.ndarray
    opensim: float | None = None
    solver: diffrax.AbstractSolver | None = None


def largest(x) -> float:
    return float(np.max(np.abs(x)))


def energy_drift(mechanism, trajectory):
    return largest(trajectory.energy - trajectory.energy[0])


def energy_balance(mechanism, trajectory):
    """What the energy changes by other than by the work of the torque on the crank."""
    torque = float(mb.parameters(mechanism.system)["drive.torque"])
    turned = trajectory["K1"].angle - trajectory["K1"].angle[0]
    return largest(trajectory.energy - trajectory.energy[0] - torque * turned)


def pendulum_error(mechanism, trajectory):
    """Of x and y, released at (−1, 0) m: with Jacobi's elliptic functions, sin(θ/2) = k sn(K − ω t), k² = 1/2."""
    k2, omega = 0.5, np.sqrt(9.81)
    sn, _, dn, _ = ellipj(ellipk(k2) - omega * np.asarray(trajectory.ts), k2)
    half = np.sqrt(k2) * sn
    exact = np.stack([-2 * half * dn, 2 * half**2 - 1], axis=1)
    return largest(trajectory["bob"].position - exact)


def slider_error(mechanism, trajectory):
    """Of s at the times of the reference values."""
    known = mechanism.references
    return largest(mechanism.errors(trajectory)["s"]) * float(known.scales[known.labels.index("s")])


def library(name, **parameters):
    return lambda: mb.mechanisms.get(name, **parameters)


# The library asks for results every hundredth of a second.
TABLE = np.linspace(0.0, 10.0, 1001)
CASES = {
    "A01": Case("pendulum", library("pendulum"), "position [m]", pendulum_error, TABLE[:-1], 0.637),
    "A02": Case("N four-bar, N = 2", library("n_four_bar"), "energy [J]", energy_drift, TABLE, 0.455),
    "A03": Case(
        "Andrews",
        library("andrews", problem="iftomm"),
        "energy balance [J]",
        energy_balance,
        np.linspace(0.0, 0.05, 51),
        0.384,
    ),
    "A04": Case("Bricard", library("bricard"), "energy [J]", energy_drift, TABLE, 0.258),
    "A05": Case(
        "stiff governor", library("flyball"), "position s [m]", slider_error, TABLE, solver=mb.solvers.Hermite()
    ),
}

# Eigenvalues [1/s] of the four-bar with its diagonal spring, without and with a damper beside the spring.
EIGENVALUES = {0.0: 2.14767663837j, 1.0: -0.2423858093 + 2.1339550282j}


def sprung_four_bar(damping: float) -> tuple[mb.system.AbstractSystem, mb.State]:
    """A rhombus of three bars of 1 m and 1 kg on ground pivots (0, 0) and (1, 0), which a spring of 25 N/m and √2 m
    along its diagonal holds against gravity, with a damper [N s/m] beside it; and its equilibrium.
    """
    half, angle = 0.5, 2.234
    across, along = np.array([np.cos(angle), np.sin(angle)]), np.array([1.0, 0.0])
    inertia = planar.rod(1.0, 1.0)
    bodies = [
        planar.Body("crank", mass=1.0, inertia=inertia, position=half * across, angle=angle),
        planar.Body("coupler", mass=1.0, inertia=inertia, position=across + half * along, angle=0.0),
        planar.Body("rocker", mass=1.0, inertia=inertia, position=along + half * across, angle=angle),
    ]
    joints = [
        planar.Revolute("A", "ground", "crank", point_a=(0.0, 0.0), point_b=(-half, 0.0)),
        planar.Revolute("B", "crank", "coupler", point_a=(half, 0.0), point_b=(-half, 0.0)),
        planar.Revolute("C", "coupler", "rocker", point_a=(half, 0.0), point_b=(half, 0.0)),
        planar.Revolute("D", "ground", "rocker", point_a=(1.0, 0.0), point_b=(-half, 0.0)),
    ]
    diagonal = {"stiffness": 25.0, "damping": damping, "free_length": np.sqrt(2.0)}
    spring = planar.SpringDamper("diagonal", "ground", "rocker", **diagonal, point_a=(0.0, 0.0), point_b=(half, 0.0))
    system = mb.Scene(bodies, joints=joints, forces=[spring, mb.Gravity((0.0, -9.81))]).compile()
    return system, mb.equilibrium(system)


def eigenvalue_error(damping: float) -> tuple[complex, float]:
    """The eigenvalue [1/s] with a positive imaginary part, and its relative error against the published one."""
    values = np.asarray(mb.linearise(*sprung_four_bar(damping)).eigenvalues)
    found = complex(values[np.argmax(values.imag)])
    return found, abs(found - EIGENVALUES[damping]) / abs(EIGENVALUES[damping])
