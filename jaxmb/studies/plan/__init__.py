"""Optimal control: the best controls, durations and parameters of a motion between two ends."""

from .plan import plan as plan
from .result import Plan as Plan
