"""Multistep methods as diffrax solvers, with variable order and step, on vector fields and on manifolds.

`simulate` and `integrate` take any solver of diffrax, and `diffrax.diffeqsolve` takes these with a
`MultistepController`. A multistep method of your own derives from `AbstractMultistep`, with a field for its tolerances.
A step evaluates the term that it is given, at predicted and at corrected states:

```python
from jax.flatten_util import ravel_pytree
from jaxmb import solvers

tolerances: solvers.Tolerances = solvers.tolerances_of("Heun")

def heun(term, t, h, y, args, chart):
    flat, unravel = ravel_pytree(y)  # Methods compute with the components of a state in one vector.
    now = solvers.evaluate(term, t, flat, y, chart, args)
    predicted = solvers.evaluate(term, t + h, now.y + h * now.f, y, chart, args)
    end = solvers.project_near(term, t + h, now.y + h * (now.f + predicted.f) / 2, y, predicted, args)
    y1 = unravel(end.y)
    return y1, jnp.max(jnp.abs(end.y - predicted.y)), solvers.next_chart(term, t + h, y1, end.chart, args)

def next_step(error):  # For a method of fixed order, whose error is of second order in the step.
    never, errors = jnp.array(False), jnp.stack([jnp.inf, error, jnp.inf])
    may = {"may_fall": never, "may_rise": never, "known": ~never}
    return solvers.choose_order(errors, jnp.full(3, 2.0), jnp.ones(()), target=0.5, work=jnp.array([2, 0]), **may)

change, estimate = next_step(0.3)
```
"""

from .._moved import tell_of_moved as _tell_of_moved
from . import stability as stability
from .adams import Adams as Adams
from .controller import MultistepController as MultistepController
from .evaluation import evaluate as evaluate, next_chart as next_chart, project_near as project_near
from .hermite import Hermite as Hermite
from .integration import integrate as integrate
from .multistep import (
    AbstractAttempt as AbstractAttempt,
    AbstractMultistep as AbstractMultistep,
    AbstractMultistepState as AbstractMultistepState,
    tolerances_of as tolerances_of,
)
from .order import choose_order as choose_order
from .tolerances import Tolerances as Tolerances

_tell_of_moved(
    __name__,
    MeshAdjoint="jaxmb.solvers.integrate, in place of diffrax.diffeqsolve with this adjoint",
    ravel="the first result of jax.flatten_util.ravel_pytree",
    unravel_like="the second result of jax.flatten_util.ravel_pytree",
)
