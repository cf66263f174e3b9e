"""The command line: `jaxmb mechanisms | run | report | sweep | doctor | help | reference`."""

from .commands import main as main
