# ruff: noqa: I001
# All names of the package, for readers, type checkers and lazy_loader. The headings are the subjects of `jaxmb help`,
# and a name that several modules have belongs to the first of them.

__version__: str

## Scenes and their numbers
from .bodies.scene import Scene as Scene
from .bodies.rigid_bodies import RigidBodySystem as RigidBodySystem
from .system.parameters import parameters as parameters, with_parameters as with_parameters, modules as modules
from .system.inputs import with_inputs as with_inputs
from .system.design import design as design
from .system.design_variables import Variable as Variable
from .parts.units import deg as deg, bar as bar, rpm as rpm

## States and motions
from ._types import State as State
from .states.assembly import assemble as assemble
from .states.gap import assembly_gap as assembly_gap
from .states.equilibrium import equilibrium as equilibrium
from .simulate import simulate as simulate
from .studies.evaluate import evaluate as evaluate
from .studies.batch import batch as batch
from .trajectory import Trajectory as Trajectory, load as load
from .contacts.events import ContactEvents as ContactEvents, Event as Event
from ._results import RESULTS as RESULTS
from ._setup import setup as setup
from .parts.names import UnknownNameError as UnknownNameError

## Forces and drives of both spaces
from .parts.forces import Gravity as Gravity
from .parts.actuators import Motor as Motor, Actuator as Actuator
from .parts.controller import Controller as Controller
from .parts.servo import Servo as Servo
from .parts.series import Series as Series, smooth_step as smooth_step
from .parts.combinations import Tendon as Tendon, FixedTendon as FixedTendon
from .parts.rope import Rope as Rope, Pulley as Pulley
from .parts.coordinate_parts import (
    JointSpring as JointSpring,
    JointForce as JointForce,
    JointStop as JointStop,
)
from .parts.tables import TableSpring as TableSpring, TableDamper as TableDamper, TableMotor as TableMotor
from .parts.dry_friction import DryFriction as DryFriction, JointFriction as JointFriction
from .parts.coordinate_parts import JointDriver as JointDriver
from .parts.combinations import JointInertia as JointInertia, JointCoupling as JointCoupling

## Unilateral constraints
from .parts.unilateral import (
    Stop as Stop,
    RigidContact as RigidContact,
    RigidBallContact as RigidBallContact,
    RigidPlaneContact as RigidPlaneContact,
    RigidBoxContact as RigidBoxContact,
    Slack as Slack,
)

## Parts from functions
from .parts.functions import (
    Constraint as Constraint,
    VelocityConstraint as VelocityConstraint,
    Force as Force,
    NonIdeal as NonIdeal,
)

## Identification
from .studies.identify import (
    identify as identify,
    Identification as Identification,
    Experiment as Experiment,
    Measurements as Measurements,
    read_measurements as read_measurements,
    Sensor as Sensor,
)

## Optimisation
from .studies.optimise import optimise as optimise, Optimum as Optimum, robust as robust
from .studies.plan import plan as plan, Plan as Plan
from .studies.plan import plan_phases as plan_phases, Phase as Phase, PhasedPlan as PhasedPlan
from .studies.lqr import lqr as lqr, Regulator as Regulator

## Small motions
from .studies.linear import (
    linearise as linearise,
    Linearisation as Linearisation,
    root_locus as root_locus,
    RootLocus as RootLocus,
    steady_motion as steady_motion,
    floquet as floquet,
    Floquet as Floquet,
)

## Inverse dynamics and loads
from .studies.inverse import required_forces as required_forces, RequiredForces as RequiredForces
from .studies.loads import loads as loads, Loads as Loads

## Suspensions
from .studies.suspension import (
    kinematics_and_compliance as kinematics_and_compliance,
    KinematicsAndCompliance as KinematicsAndCompliance,
)

## Sweeps
from .studies.sweep import sweep as sweep, load_sweep as load_sweep

## Modules
from . import planar as planar, spatial as spatial
from .parts import contact as contact, terrain as terrain, shapes as shapes, sections as sections
from .linalg import rotations as rotations
from .studies.sweep import cases as cases
from . import mechanisms as mechanisms, importers as importers, viz as viz, report as report
from . import lagrangian as lagrangian, parts as parts, formulations as formulations, manifold as manifold
from . import solvers as solvers, system as system
