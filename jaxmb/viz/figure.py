"""Figures; matplotlib is imported when needed."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def new_figure(width: float, height: float) -> "Figure":
    """An empty figure of a size in inches, without a window or any global state.

    **Raises:** `ImportError` that names the extra to install if matplotlib is missing.
    """
    try:
        import matplotlib.figure  # noqa: F401

        from .shown import ShownFigure
    except ImportError as error:
        raise ImportError('Figures need matplotlib; install it with: pip install "jaxmb[plot]"') from error
    return ShownFigure(figsize=(width, height), layout="constrained")
