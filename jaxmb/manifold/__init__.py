"""Policies that keep the state on its constraints.

`Partition` integrates independent coordinates with dense linear algebra, for up to some tens of bodies. `Projection`
uses sparse elimination for scenes of many joints, which follows the graph of bodies and joints. Its time is
proportional to the number of bodies if loops are local: chains, trees, rings, nets, bodies with many branches.
`simulate` chooses `Projection` with `Adams` from 30 constraint rows on (150 if rows are redundant), and with `Hermite`
from 40 velocities on. `Hermite` eliminates bodies on stiff springs along with the joints. `print(system)` reports this
choice and the order of elimination. Joint friction costs O(n³) in the number n of constraint rows with friction.
`Hermite` needs dense matrices for friction, servos and internal states. `Chart` gives the equations of motion in
independent coordinates to other programs.

```python
on_constraints = jaxmb.manifold.project(system, 0.0, jaxmb.State(state.q + 1e-3, state.u))
```
"""

from .._moved import tell_of_moved as _tell_of_moved
from .baumgarte import Baumgarte as Baumgarte
from .chart import Chart as Chart
from .manifold import AbstractManifold as AbstractManifold
from .orthogonal_projection import project as project
from .partition import Partition as Partition
from .projection import Projection as Projection

_tell_of_moved(__name__)
