"""Reports: error against run time, stiff and extreme variants, and the costs of formulations and of methods.

- `work_precision(system, state, t1=)`: error against run time and evaluations, for solvers and tolerances, against two
  methods that agree.
- `stress_test(system, state, t1=)`: the true error, or the refusal, of stiff and extreme variants: springs, masses,
  lengths, speeds, redundant joints, tolerances.
- `left_out(system, state, t1=)`: what specialisation saves: each unused feature is switched on in turn, and tracing,
  compiling and evaluating are timed.
- `formulation_costs(mechanism)`: run time and program size of every formulation, with derivatives.
- `method_costs(mechanism)`: coordinate partitioning compared with integrating all coordinates: evaluations, linear
  algebra and time at equal error.
- `check_elements(system, state)`: whether the elementary constraints that joints declare are those of their residuals.

`jaxmb report KIND NAME` writes one of them from the command line; NAME is a mechanism or `file.py:function`, where the
function returns a scene, or a system and a state.
"""

from ..bodies.elementary import check_elements as check_elements
from .formulations import (
    FormulationCost as FormulationCost,
    FormulationCosts as FormulationCosts,
    every_formulation as every_formulation,
    formulation_costs as formulation_costs,
)
from .left_out import LeftOut as LeftOut, Measured as Measured, left_out as left_out
from .method_costs import MethodCost as MethodCost, MethodCosts as MethodCosts, method_costs as method_costs
from .stress_test import KINDS as KINDS, Case as Case, StressTest as StressTest, stress_test as stress_test
from .timing import interleaved as interleaved, timed_compile as timed_compile
from .work_precision import Run as Run, WorkPrecision as WorkPrecision, work_precision as work_precision
