"""Keys of static index arrays, by which compiled programs are found again."""

import dataclasses
import hashlib
from collections.abc import Iterable
from typing import Any

import numpy as np


def digest(parts: Iterable[np.ndarray | bytes]) -> bytes:
    """A key that is equal for equal sequences of arrays and of other keys."""
    out = hashlib.sha256()
    for part in parts:
        if isinstance(part, bytes):
            out.update(part)
        else:
            out.update(repr(part.shape).encode() + np.ascontiguousarray(part).tobytes())
    return out.digest()


def digest_of_fields(order: Any) -> bytes:
    """A key that is equal for dataclasses with equal arrays, and equal keys of other orders, in their fields."""
    values = (getattr(order, field.name) for field in dataclasses.fields(order))
    keyed = (value if isinstance(value, np.ndarray) else getattr(value, "key", None) for value in values)
    return digest(value for value in keyed if value is not None)
