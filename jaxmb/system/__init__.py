"""The equation of constrained motion, and what can be asked of any model by name.

A system of one's own derives from `AbstractSystem`, here a point mass on a rod of 1 m:

```python
from typing import ClassVar

class Swing(jaxmb.system.AbstractSystem):
    mass: jax.Array
    guess: jaxmb.State
    length: float = 1.0
    design: tuple = ()
    nq: ClassVar[int] = 1
    nu: ClassVar[int] = 1

    def coordinate_names(self):
        return {"angle": [0]}

    def coordinate_scale(self):
        return jnp.ones(1)

    def velocity_scale(self):
        return jnp.ones(1)

    def inertia(self, t, q, u):
        return jaxmb.system.DiagonalInertia(self.mass * jnp.ones(1))

    def force(self, t, q, u):
        return -9.81 * self.mass * jnp.sin(q)

    def kinetic_energy(self, t, q, u):
        return 0.5 * self.mass * jnp.vdot(u, u)

    def potential_energy(self, t, q):
        return -9.81 * self.mass * jnp.cos(q[0])

swing = Swing(jnp.ones(()), jaxmb.State(jnp.array([0.5]), jnp.zeros(1)))
jaxmb.simulate(swing, jaxmb.assemble(swing), t1=1.0)["angle"]
# A full mass matrix, and `ranks` of a system with one constraint between positions.
jaxmb.system.DenseInertia(jnp.eye(2)), jaxmb.system.Ranks(position=1, coordinate=1, velocity=1, acceleration=1)
```
"""

from .._moved import tell_of_moved as _tell_of_moved
from ..linalg.inertia import DenseInertia as DenseInertia, DiagonalInertia as DiagonalInertia
from .design import design as design
from .design_variables import Variable as Variable
from .equation import Ranks as Ranks
from .inputs import with_inputs as with_inputs
from .parameters import modules as modules, parameters as parameters, with_parameters as with_parameters
from .system import AbstractSystem as AbstractSystem

_tell_of_moved(__name__)
