"""A figure of matplotlib that the cell of a notebook shows, whether or not `%matplotlib inline` was given."""

import io

from matplotlib.figure import Figure


class ShownFigure(Figure):
    """A figure without a window or any global state."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png")
        return file.getvalue()
