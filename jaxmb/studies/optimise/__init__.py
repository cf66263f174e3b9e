"""Optimal designs under constraints."""

from .optimise import Optimum as Optimum, optimise as optimise
from .robust import robust as robust
