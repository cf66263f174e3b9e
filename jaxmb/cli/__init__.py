"""The command line: `jaxmb mechanisms | run | doctor | help`."""

from .commands import main as main
