"""The pictures that results draw of themselves: their functions in `viz` are imported at first use."""

import importlib
from typing import Any


def picture(module: str, shown: Any, *arguments: Any, **options: Any) -> Any:
    """The figure of a result by the function `plot` of a module of `viz`, which stands above the result."""
    return importlib.import_module(f"{__package__}.viz.{module}").plot(shown, *arguments, **options)
