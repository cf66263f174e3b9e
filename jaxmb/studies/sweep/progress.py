"""Progress of a sweep, in one line."""

import contextlib
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from .cases import Cases
from .outputs import OK


@contextlib.contextmanager
def shown_progress(shown: bool, cases: Cases, done: Mapping[int, np.ndarray]) -> Iterator[Callable[[np.ndarray], None]]:
    """A line with the members that are done, the time that is left, and the number of failed members."""
    from tqdm import tqdm

    statuses = list(done.values())
    failed = sum(int(np.sum(own != OK)) for own in statuses)
    bar = tqdm(total=len(cases), initial=sum(own.size for own in statuses), unit="member", disable=not shown)

    def advance(own: np.ndarray) -> None:
        nonlocal failed
        failed += int(np.sum(own != OK))
        if failed:
            bar.set_postfix_str(f"{failed} failed", refresh=False)
        bar.update(own.size)

    with bar:
        yield advance
