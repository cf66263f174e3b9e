"""The command line: `jaxmb mechanisms | run | sweep | doctor | help`."""

from .commands import main as main
