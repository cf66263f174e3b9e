"""Parts that act on several other parts of the scene, given by their names."""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar

from .base import AbstractLink, AbstractPart


class AbstractOfSources(AbstractLink):
    """A part that acts on joints and tendons, or measures them, and if it `takes_bodies` bodies and frames as well."""

    takes_bodies: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def sources(self) -> tuple[str, ...]:
        """The names of these parts."""

    @abc.abstractmethod
    def of_sources(self, parts: Sequence[AbstractPart | None], places: Sequence[tuple[int, ...]]) -> Any:
        """A copy that holds its sources.

        **Arguments:** `parts`: a joint, tendon or frame for each of `sources`, None for a body; `places`: for each the
        numbers of its bodies among those of this part.
        """
