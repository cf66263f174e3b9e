"""Accurate, differentiable dynamics of constrained mechanical systems in JAX."""

from typing import TYPE_CHECKING

from . import (
    formulations as formulations,
    manifold as manifold,
    parts as parts,
    solvers as solvers,
    system as system,
    trajectory as trajectory,
)
from ._faulty_versions import warn_of_jaxlib as _warn_of_jaxlib
from ._results import RESULTS as RESULTS
from ._setup import setup as setup
from ._types import State as State
from ._version import __version__ as __version__
from .bodies import RigidBodySystem as RigidBodySystem
from .bodies.scene import Scene as Scene
from .contacts.events import ContactEvents as ContactEvents, Event as Event
from .linalg import rotations as rotations
from .parts import contact as contact, shapes as shapes, terrain as terrain
from .parts.actuators import Actuator as Actuator, Motor as Motor
from .parts.combinations import (
    FixedTendon as FixedTendon,
    JointCoupling as JointCoupling,
    JointInertia as JointInertia,
    Tendon as Tendon,
)
from .parts.controller import Controller as Controller
from .parts.coordinate_parts import (
    JointDriver as JointDriver,
    JointForce as JointForce,
    JointFriction as JointFriction,
    JointSpring as JointSpring,
    JointStop as JointStop,
)
from .parts.dry_friction import DryFriction as DryFriction
from .parts.forces import Gravity as Gravity
from .parts.functions import (
    Constraint as Constraint,
    Force as Force,
    NonIdeal as NonIdeal,
    VelocityConstraint as VelocityConstraint,
)
from .parts.names import UnknownNameError as UnknownNameError
from .parts.series import Series as Series
from .parts.servo import Servo as Servo
from .parts.unilateral import (
    RigidBallContact as RigidBallContact,
    RigidBoxContact as RigidBoxContact,
    RigidContact as RigidContact,
    RigidPlaneContact as RigidPlaneContact,
    Slack as Slack,
    Stop as Stop,
)
from .simulate import simulate as simulate
from .states.assembly import assemble as assemble
from .states.equilibrium import equilibrium as equilibrium
from .states.gap import assembly_gap as assembly_gap
from .system import (
    Variable as Variable,
    design as design,
    modules as modules,
    parameters as parameters,
    with_inputs as with_inputs,
    with_parameters as with_parameters,
)
from .trajectory import Trajectory as Trajectory, load as load

# Parts that not every motion needs are imported at their first use (PEP 562). Only a type checker, which must see the
# names, imports them here.
_warn_of_jaxlib()

if TYPE_CHECKING:
    from . import (
        importers as importers,
        lagrangian as lagrangian,
        mechanisms as mechanisms,
        planar as planar,
        report as report,
        spatial as spatial,
        studies as studies,
        viz as viz,
    )
    from .studies.batch import batch as batch
    from .studies.identify import (
        Experiment as Experiment,
        Identification as Identification,
        Measurements as Measurements,
        Sensor as Sensor,
        identify as identify,
        read_measurements as read_measurements,
    )
    from .studies.linear import (
        Floquet as Floquet,
        Linearisation as Linearisation,
        RootLocus as RootLocus,
        floquet as floquet,
        linearise as linearise,
        linearize as linearize,
        root_locus as root_locus,
        steady_motion as steady_motion,
    )
    from .studies.optimise import Optimum as Optimum, optimise as optimise, optimize as optimize, robust as robust
    from .studies.sweep import cases as cases, load_sweep as load_sweep, sweep as sweep
else:
    _MODULES = ("importers", "lagrangian", "mechanisms", "planar", "report", "spatial", "studies", "viz")
    _NAMES = {
        "studies.batch": "batch",
        "studies.identify": "Experiment Identification Measurements Sensor identify read_measurements",
        "studies.linear": "Floquet Linearisation RootLocus floquet linearise linearize root_locus steady_motion",
        "studies.optimise": "Optimum optimise optimize robust",
        "studies.sweep": "cases load_sweep sweep",
    }
    # Names of the last release.
    _RENAMED = {
        "compile_quickly": "jaxmb.setup()",
        "run_quickly": 'jaxmb.setup(compile="for speed")',
        "keep_compiled": "jaxmb.setup(keep=folder)",
    }
    _SOURCES = {name: source for source, names in _NAMES.items() for name in names.split()}
    # Modules that Python puts here when it imports them, and which are no part of the interface.
    _INNER = {"TYPE_CHECKING", "bodies", "contacts", "lanes", "linalg", "states"}
    __all__ = sorted(name for name in {*globals(), *_MODULES, *_SOURCES} - _INNER if not name.startswith("_"))

    def __getattr__(name: str) -> object:
        """A module, or a name of one, at its first use; from then on it is found without this function."""
        import importlib
        import sys

        if name in _MODULES:
            return importlib.import_module(f".{name}", __name__)
        if name in _SOURCES:
            return globals().setdefault(name, getattr(importlib.import_module(f".{_SOURCES[name]}", __name__), name))
        if name in _RENAMED:
            raise AttributeError(f"jaxmb.{name} is {_RENAMED[name]} now.", name=name, obj=sys.modules[__name__])
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name, obj=sys.modules[__name__])

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__} - _INNER)
