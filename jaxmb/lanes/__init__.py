"""Programs of one member evaluated for several members, which lie along the last axis of every array.

`jax.vmap` puts members on the first axis of matrices of a few rows, where an operation is a short loop over entries for
each member. With members on the last axis it is a loop over members for each entry, which fills the registers of a
processor. A program is traced for one member, and its equations are evaluated again, each by its rule.
"""

from . import control as control, indexing as indexing, shapes as shapes, sums as sums
from .evaluate import in_lanes as in_lanes
from .together import together as together
