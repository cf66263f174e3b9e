"""Policies that keep the state on its constraints."""

from .baumgarte import Baumgarte as Baumgarte
from .block_projection import BlockProjection as BlockProjection
from .default import default_manifold as default_manifold
from .free import Free as Free
from .manifold import AbstractManifold as AbstractManifold
from .partition import Partition as Partition
from .projection import Projection as Projection, project as project, project_normalized as project_normalized
