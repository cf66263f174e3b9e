"""Policies that keep the state on its constraints.

Dense linear algebra suits up to some tens of bodies: `Partition`, which integrates independent coordinates. Scenes of
many joints use sparse elimination, which follows the graph of bodies and joints. Its time is proportional to the number
of bodies if loops are local: chains, trees, rings, nets, bodies with many branches. From 30 constraint rows on (150 if
rows are redundant) `simulate` chooses `Projection` with `Adams`. From 40 velocities on it does so with `Hermite`, which
eliminates bodies on stiff springs along with the joints. `print(system)` reports this choice and the order of
elimination. Joint friction costs O(n³) in the number n of constraint rows with friction. `Hermite` needs dense matrices
for friction, servos and internal states.
"""

from ..contacts.guards import contact_guards as contact_guards
from .baumgarte import Baumgarte as Baumgarte
from .default import Unconstrained as Unconstrained, default_manifold as default_manifold
from .impulse import after_jumps as after_jumps, find_jumps as find_jumps, next_number as next_number
from .internal_states import (
    counted_components as counted_components,
    natural_units as natural_units,
    state_blocks as state_blocks,
)
from .manifold import AbstractManifold as AbstractManifold
from .orthogonal_projection import project as project, project_normalized as project_normalized
from .partition import Partition as Partition
from .projection import Projection as Projection
