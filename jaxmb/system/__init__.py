"""The equation of constrained motion, and what can be asked of any model by name."""

from .._moved import tell_of_moved as _tell_of_moved
from ..linalg.inertia import DenseInertia as DenseInertia, DiagonalInertia as DiagonalInertia
from .design import design as design
from .design_variables import Variable as Variable
from .equation import Ranks as Ranks
from .inputs import with_inputs as with_inputs
from .parameters import modules as modules, parameters as parameters, with_parameters as with_parameters
from .system import AbstractSystem as AbstractSystem

_tell_of_moved(__name__)
