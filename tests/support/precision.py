"""The precision of floating-point numbers, which is double in all tests but those that ask for single."""

from contextlib import contextmanager

import jax


@contextmanager
def single_precision():
    """Numbers of single precision, as users have who do not switch on `jax_enable_x64`."""
    jax.config.update("jax_enable_x64", False)
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", True)
