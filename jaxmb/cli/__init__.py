"""The command line: `jaxmb mechanisms | run | report | sweep | doctor`."""

from .commands import main as main
