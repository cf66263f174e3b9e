"""The equation of constrained motion; parameters, inputs and quantities of any model by name."""

from ..linalg.inertia import (
    AbstractInertia as AbstractInertia,
    BlockInertia as BlockInertia,
    DenseInertia as DenseInertia,
    DiagonalInertia as DiagonalInertia,
)
from .design import design as design
from .design_variables import Variable as Variable
from .equation import AbstractEquation as AbstractEquation, Ranks as Ranks
from .inputs import with_inputs as with_inputs
from .parameters import modules as modules, parameters as parameters, with_parameters as with_parameters
from .quantities import BodyMotion as BodyMotion, Quantity as Quantity, Reaction as Reaction, Solved as Solved
from .system import AbstractSystem as AbstractSystem
