"""Policies that keep the state on its constraints."""

from .baumgarte import Baumgarte as Baumgarte
from .default import Unconstrained as Unconstrained, default_manifold as default_manifold
from .impulse import after_jumps as after_jumps, find_jumps as find_jumps, next_number as next_number
from .internal_states import (
    natural_units as natural_units,
    state_blocks as state_blocks,
    with_internal_states as with_internal_states,
)
from .manifold import AbstractManifold as AbstractManifold
from .orthogonal_projection import project as project, project_normalized as project_normalized
from .partition import Partition as Partition
from .projection import Projection as Projection
