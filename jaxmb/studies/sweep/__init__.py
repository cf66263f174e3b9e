"""A function of named parameters over many cases, in chunks, on several processes, with a store on disk."""

from . import cases as cases
from .load import load_sweep as load_sweep
from .sweep import sweep as sweep
