"""The version of the package, which results that are kept record."""

__version__ = "0.2.0"
