"""Reports about a machine: error against run time, and stiff and extreme variants. Each is a `Table`.

- `work_precision(system, state, t1=)`: error against run time and evaluations, for solvers and tolerances.
- `stress_test(system, state, t1=)`: the true error, or the refusal, of stiff and extreme variants: springs, masses,
  lengths, speeds, redundant joints, tolerances.
- `check_elements(system, state)`: whether the elementary constraints that joints declare agree with their residuals.
"""

from .._moved import tell_of_moved as _tell_of_moved
from ..bodies.elementary import check_elements as check_elements
from .stress_test import stress_test as stress_test
from .table import Table as Table
from .work_precision import work_precision as work_precision

_tell_of_moved(
    __name__,
    left_out="a benchmark of jaxmb itself, tests/benchmarks/left_out.py of the checkout",
    formulation_costs="a benchmark of jaxmb itself, tests/benchmarks/formulation_costs.py of the checkout",
    every_formulation="part of tests/benchmarks/formulation_costs.py of the checkout",
    method_costs="a benchmark of jaxmb itself, tests/benchmarks/method_costs.py of the checkout",
    interleaved="jaxmb.report.timing.interleaved, which is not public",
    timed_compile="jax.jit(function).lower(…).compile()",
    WorkPrecision="jaxmb.report.Table",
    StressTest="jaxmb.report.Table",
    KINDS="the list of kinds that `jaxmb help report.stress_test` shows",
)
