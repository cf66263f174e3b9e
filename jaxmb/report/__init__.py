"""Reports: error against run time and evaluations, the costs of formulations, and those of integration methods."""

from .formulations import (
    FormulationCost as FormulationCost,
    FormulationCosts as FormulationCosts,
    every_formulation as every_formulation,
    formulation_costs as formulation_costs,
)
from .method_costs import MethodCost as MethodCost, MethodCosts as MethodCosts, method_costs as method_costs
from .timing import interleaved as interleaved, timed_compile as timed_compile
from .work_precision import Run as Run, WorkPrecision as WorkPrecision, work_precision as work_precision
