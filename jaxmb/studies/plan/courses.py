"""Controls between nodes: held, linear or cubic functions of time, from numbers at the nodes."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...parts.series import AbstractSignal, Series


class AbstractCourse(eqx.Module):
    """A kind of function of time on intervals, by a vector of numbers for all intervals.

    `local`: the count of numbers of one interval; `continuous`: whether values, or rates as well (`smooth`), are
    continuous at nodes.
    """

    name: ClassVar[str]
    local: ClassVar[int]
    continuous: ClassVar[bool]
    smooth: ClassVar[bool] = False

    @abc.abstractmethod
    def places(self, intervals: int) -> np.ndarray:
        """The places of each interval's numbers among all, shape (intervals, local)."""

    @abc.abstractmethod
    def powers(self, numbers: Float[Array, "local *shape"]) -> list[Array]:
        """The coefficients of powers of the share of the interval, 0 to 1, from its weighted numbers."""

    def weights(self, shares: np.ndarray) -> np.ndarray:
        """The weights of each interval's numbers, shape (intervals, local), for nodes at shares of the duration."""
        return np.ones((shares.size - 1, self.local))

    def values(self, intervals: int) -> np.ndarray:
        """The places of the values at the nodes, shape (intervals + 1,)."""
        places = self.places(intervals)
        return np.append(places[:, 0], places[-1, min(self.local, 2) - 1])

    def count(self, intervals: int) -> int:
        """The count of numbers of all intervals."""
        return int(np.max(self.places(intervals))) + 1

    @abc.abstractmethod
    def series(self, ts: np.ndarray, numbers: np.ndarray) -> Series:
        """The function of time with nodes at `ts`."""

    @abc.abstractmethod
    def numbers(self, values: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """All numbers, from values and rates at nodes, by the share of the duration."""


class Held(AbstractCourse):
    """Constant on each interval."""

    name, local, continuous = "held", 1, False

    def places(self, intervals):
        return np.arange(intervals)[:, None]

    def powers(self, numbers):
        return [numbers[0]]

    def series(self, ts, numbers):
        return Series(ts, np.concatenate([numbers, numbers[-1:]]), "held")

    def numbers(self, values, rates):
        return values[:-1]


class Linear(AbstractCourse):
    """Continuous, and linear on each interval."""

    name, local, continuous = "linear", 2, True

    def places(self, intervals):
        return np.arange(intervals)[:, None] + np.arange(2)

    def powers(self, numbers):
        return [numbers[0], numbers[1] - numbers[0]]

    def series(self, ts, numbers):
        return Series(ts, numbers, "linear")

    def numbers(self, values, rates):
        return values


class Cubic(AbstractCourse):
    """Cubic on each interval, with continuous rates; the numbers are the values at all nodes, and then the rates by the
    share of the duration.
    """

    name, local, continuous, smooth = "cubic", 4, True, True

    def places(self, intervals):
        values = np.arange(intervals)[:, None] + np.arange(2)
        return np.concatenate([values, values + intervals + 1], axis=1)

    def weights(self, shares):
        lengths = np.diff(shares)[:, None]
        return np.concatenate([np.ones((lengths.size, 2)), np.repeat(lengths, 2, axis=1)], axis=1)

    def powers(self, numbers):
        a, b, rate_a, rate_b = numbers
        return [a, rate_a, 3 * (b - a) - 2 * rate_a - rate_b, 2 * (a - b) + rate_a + rate_b]

    def series(self, ts, numbers):
        values, slopes = np.split(numbers, 2)
        series = Series(ts, values, "cubic")
        return eqx.tree_at(lambda series: series.slopes, series, jnp.asarray(slopes / (ts[-1] - ts[0])))

    def numbers(self, values, rates):
        return np.concatenate([values, rates])


COURSES: dict[str, AbstractCourse] = {kind.name: kind for kind in (Held(), Linear(), Cubic())}


class Piece(AbstractSignal):
    """A control on one interval: a polynomial of the share `(t − start) / length` of the interval."""

    powers: list[Array]
    start: Any
    length: Any
    is_continuous: bool = eqx.field(static=True)

    def __call__(self, t):
        share = (t - self.start) / self.length
        value = self.powers[-1]
        for power in self.powers[-2::-1]:
            value = value * share + power
        return value

    def samples(self, t0, t1):
        return jnp.stack([jnp.asarray(t0), jnp.asarray(t1)])

    @property
    def continuous(self):
        return self.is_continuous
