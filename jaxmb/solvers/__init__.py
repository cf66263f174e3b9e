"""Multistep methods as diffrax solvers, with variable order and step, on vector fields and on manifolds.

```python
jaxmb.simulate(system, state, t1=0.1, solver=jaxmb.solvers.Adams(), adjoint=jaxmb.solvers.MeshAdjoint())
```

Any solver of diffrax is one for `simulate`. A multistep method of one's own derives from `AbstractMultistep`, where it
states its order and tolerances, and is made of evaluations at predicted and at corrected states:

```python
import diffrax
from jaxmb import solvers
tolerances: solvers.Tolerances = solvers.tolerances_of("Heun")  # A field of the method.
term, t, h, y = diffrax.ODETerm(lambda t, y, args: -y), jnp.zeros(()), 0.1, jnp.ones(2)
chart = solvers.next_chart(term, t, y, None, None)
now = solvers.evaluate(term, t, solvers.ravel(y), y, chart, None)
predicted = solvers.evaluate(term, t + h, now.y + h * now.f, y, chart, None)
end = solvers.project_near(term, t + h, now.y + h * (now.f + predicted.f) / 2, y, predicted, None)
error, never = jnp.max(jnp.abs(end.y - predicted.y)), jnp.array(False)
errors, limits = jnp.stack([jnp.inf, error, jnp.inf]), {"target": 0.5, "work": jnp.array([2, 0])}
may = {"may_fall": never, "may_rise": never, "known": ~never}
change, estimate = solvers.choose_order(errors, jnp.full(3, 2.0), jnp.ones(()), **may, **limits)
y = solvers.unravel_like(y, end.y)
```
"""

from .._moved import tell_of_moved as _tell_of_moved
from . import stability as stability
from .adams import Adams as Adams
from .controller import MultistepController as MultistepController
from .evaluation import (
    evaluate as evaluate,
    next_chart as next_chart,
    project_near as project_near,
    ravel as ravel,
    unravel_like as unravel_like,
)
from .hermite import Hermite as Hermite
from .mesh import MeshAdjoint as MeshAdjoint
from .multistep import (
    AbstractAttempt as AbstractAttempt,
    AbstractMultistep as AbstractMultistep,
    AbstractMultistepState as AbstractMultistepState,
    tolerances_of as tolerances_of,
)
from .order import choose_order as choose_order
from .tolerances import Tolerances as Tolerances

_tell_of_moved(__name__)
