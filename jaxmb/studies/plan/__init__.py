"""Optimal control: the best controls, durations and parameters of a motion between two ends."""

from .phases import Phase as Phase, PhasedPlan as PhasedPlan, plan_phases as plan_phases
from .plan import plan as plan
from .result import Plan as Plan
