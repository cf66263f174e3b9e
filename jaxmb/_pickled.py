"""The package in pickled functions."""

import copyreg
import sys
from importlib import import_module
from types import ModuleType


def pickled_by_name(package: str) -> None:
    """Let a package be pickled by its name, as modules of the usual class are.

    Functions of scripts and notebooks that name the package can then be sent to other processes. lazy_loader gives a
    package another class, which `pickle` and `cloudpickle` do not know.
    """
    kind = type(sys.modules[package])
    if kind is not ModuleType:
        copyreg.pickle(kind, lambda module: (import_module, (module.__name__,)))
