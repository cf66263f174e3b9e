"""Suspensions of wheels: kinematics, and compliance in static equilibria."""

from .kinematics import kinematics_and_compliance as kinematics_and_compliance
from .result import KinematicsAndCompliance as KinematicsAndCompliance
