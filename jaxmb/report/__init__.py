"""Reports: error against run time, stiff and extreme variants, and the costs of formulations and of methods."""

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
