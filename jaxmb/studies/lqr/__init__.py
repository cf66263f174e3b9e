"""Linear-quadratic regulators at equilibria and along plans."""

from .lqr import lqr as lqr
from .regulator import Regulator as Regulator
