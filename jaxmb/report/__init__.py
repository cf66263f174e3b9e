"""What accuracy costs: error against run time and evaluations."""

from .timing import interleaved as interleaved
from .timing import timed_compile as timed_compile
from .work_precision import Run as Run
from .work_precision import WorkPrecision as WorkPrecision
from .work_precision import work_precision as work_precision
