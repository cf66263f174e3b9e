"""The pictures that results draw of themselves: their functions in `viz` are imported at first use."""

import importlib
from typing import Any


def picture(function: str, shown: Any, *arguments: Any, **options: Any) -> Any:
    """The figure of a result by a function of `viz`, `"loads.plot"`, which stands above the result."""
    module, _, name = function.partition(".")
    return getattr(importlib.import_module(f"{__package__}.viz.{module}"), name)(shown, *arguments, **options)
