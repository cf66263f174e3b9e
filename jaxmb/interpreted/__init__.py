"""Programs of JAX run by NumPy, without a compiler.

A traced program becomes the source of one Python function, line by line a call of NumPy for an equation of the program.
It is there a tenth of a second later, where XLA compiles for seconds, and takes about a microsecond a line: the way to
a first result, and no way to a second that matters.
"""

from . import (
    control as control,
    elementary as elementary,
    indexing as indexing,
    operators as operators,
    shapes as shapes,
    sums as sums,
)
from .source import Interpreted as Interpreted, interpreted as interpreted
from .translate import Unsupported as Unsupported
