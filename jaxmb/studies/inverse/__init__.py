"""Inverse dynamics: the forces that make a machine follow a motion."""

from .required import RequiredForces as RequiredForces, required_forces as required_forces
