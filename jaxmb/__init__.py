"""Accurate, differentiable dynamics of constrained mechanical systems in JAX."""

from lazy_loader import attach_stub as _attach_stub

from ._faulty_versions import warn_of_jaxlib as _warn_of_jaxlib
from ._moved import tell_of_moved as _tell_of_moved
from ._pickled import pickled_by_name as _pickled_by_name
from ._version import __version__ as __version__

_warn_of_jaxlib()
# Every name is imported at its first use; `__init__.pyi` lists them.
__getattr__, __dir__, __all__ = _attach_stub(__name__, __file__)
_pickled_by_name(__name__)
_tell_of_moved(
    __name__,
    compile_quickly="jaxmb.setup()",
    run_quickly='jaxmb.setup(compile="for speed")',
    keep_compiled="jaxmb.setup(keep=folder)",
    linearize="jaxmb.linearise",
    optimize="jaxmb.optimise",
)
