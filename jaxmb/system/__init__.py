"""The equation of constrained motion, and the compiled rigid-body system."""

from ._base import AbstractSystem as AbstractSystem
from .inertia import (
    AbstractInertia as AbstractInertia,
)
from .inertia import (
    BlockInertia as BlockInertia,
)
from .inertia import (
    DenseInertia as DenseInertia,
)
from .inertia import (
    DiagonalInertia as DiagonalInertia,
)
from .parameters import parameters as parameters
from .parameters import with_parameters as with_parameters
from .rigid_bodies import RigidBodySystem as RigidBodySystem
