"""The numerical method of a motion: solver, manifold policy, formulation, tolerances."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jax import lax

from .._types import State
from ..formulations import AbstractFormulation
from ..manifold import AbstractManifold
from ..manifold.accuracy import Accuracy
from ..manifold.default import default_manifold
from ..manifold.internal_states import counted_components, natural_units, state_blocks
from ..solvers import AbstractMultistep, MultistepController
from ..solvers.one_step import OneStepController, with_counted
from ..solvers.scales import RunningScales
from ..system import AbstractSystem


class Method(NamedTuple):
    """The numerical method of a motion.

    **Fields:** `controller`, None for a controller by `rtol` and `atol`; `atol`, None for running scales; `dtmax`, the
    longest step, None for any.
    """

    solver: diffrax.AbstractSolver
    policy: AbstractManifold
    formulation: AbstractFormulation
    controller: Any
    rtol: Any
    atol: Any
    dtmax: Any

    @classmethod
    def chosen(
        cls,
        system: AbstractSystem,
        solver: diffrax.AbstractSolver,
        manifold: AbstractManifold | None,
        formulation: AbstractFormulation | None,
        **tolerances: Any,
    ) -> "Method":
        """The method, with defaults by the system and the solver for arguments that are None."""
        policy = default_manifold(system, solver, formulation) if manifold is None else manifold
        formulation = policy.default_formulation(system) if formulation is None else formulation
        return cls(solver, policy, formulation, **tolerances)

    def check_impulses(self, system: AbstractSystem, jumps: bool) -> None:
        """Raise a `ValueError` if the velocities after an impulse would not be known.

        **Arguments:** `jumps`: whether a run restarts at jumps of inputs or at announced jumps.
        """
        jumps = jumps and system.velocity_rows > 0
        if not jumps and not system.contacts:
            return
        if not (self.policy.takes_impulses and system.positive_definite_mass):
            needs = "jumps, or inputs that jump, a constrained system" if jumps else "contacts a system"
            raise ValueError(
                f"With {needs} needs manifold=Partition() or Projection(), and a mass matrix that has an inverse; got "
                f"{type(self.policy).__name__}() and positive_definite_mass = {system.positive_definite_mass}."
            )

    def projects_steps(self, system: AbstractSystem) -> bool:
        """Whether states return to constraints after the steps of a method that does not know of constraints."""
        return system.velocity_rows > 0 and not isinstance(self.solver, AbstractMultistep)

    def watches_gaps(self, system: AbstractSystem) -> bool:
        """Whether steps must not pass over a force that acts in a gap; steps of fixed length may."""
        return system.has_gaps and adapts(self.controller)

    def headings(self, system: AbstractSystem) -> Any:
        """The headings of parts as a function of time and state; None without any, and with steps of fixed length."""
        if not (system.catalogue.lost_headings and adapts(self.controller)):
            return None
        return eqx.Partial(_headings_at, system)

    @property
    def accuracy(self) -> Accuracy:
        """The tolerances of the motion on its constraints."""
        return self.policy.accuracy(self.rtol)

    def prepared(self, system: AbstractSystem) -> tuple[Any, Any]:
        """The term of a system, and the solver, prepared for the term."""
        return self.policy.prepare(system.prepared(), self.formulation, self.solver, self.accuracy)

    def controls(self, system: AbstractSystem, state: State, duration: Any) -> Any:
        """The controller of the steps of a motion from a state."""
        controller, absolute = self.controller, self.rtol / 100 if self.atol is None else self.atol
        if controller is None:
            scales = running_scales(system, state, duration) if self.atol is None else None
            if isinstance(self.solver, AbstractMultistep):
                controller = MultistepController(self.rtol, absolute, scales=scales, dtmax=self.dtmax)
            else:
                controller = diffrax.PIDController(self.rtol, absolute, dtmax=self.dtmax)
                controller = OneStepController.around(controller, scales)
        return with_counted(controller, counted_components(system))


def _headings_at(system, t, y):
    return system.headings(jnp.asarray(t, y.q.dtype), y.q)


def adapts(controller: Any) -> bool:
    """Whether a controller chooses steps by their errors, as the default (None) does."""
    return controller is None or isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)


def running_scales(system: AbstractSystem, state: State, duration: Any) -> RunningScales:
    """Scales in natural units of coordinates, velocities and internal states. Velocities are expected to reach at least
    one unit per `duration` [s].
    """
    units = natural_units(system, system.velocity_scale(), state.q.dtype)
    units, rate = lax.stop_gradient((units, 1 / jnp.where(duration > 0, duration, 1.0)))
    return RunningScales(units, state_blocks(system, rate), counted_components(system))
