"""The command line: `jaxmb mechanisms | run | report | sweep`."""

from .commands import main as main
