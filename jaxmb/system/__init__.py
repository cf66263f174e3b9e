"""The equation of constrained motion, and the compiled rigid-body system."""

from ..linalg.inertia import (
    AbstractInertia as AbstractInertia,
    BlockInertia as BlockInertia,
    DenseInertia as DenseInertia,
    DiagonalInertia as DiagonalInertia,
)
from .design import design as design
from .design_variables import Variable as Variable
from .equation import AbstractSystem as AbstractSystem
from .generalized import AbstractGeneralizedSystem as AbstractGeneralizedSystem
from .inputs import with_inputs as with_inputs
from .parameters import parameters as parameters, with_parameters as with_parameters
from .quantities import BodyMotion as BodyMotion, Quantity as Quantity, Reaction as Reaction, Solved as Solved
from .rigid_bodies import RigidBodySystem as RigidBodySystem
