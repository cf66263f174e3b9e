"""What accuracy costs: error against run time and evaluations."""

from .timing import interleaved as interleaved, timed_compile as timed_compile
from .work_precision import Run as Run, WorkPrecision as WorkPrecision, work_precision as work_precision
