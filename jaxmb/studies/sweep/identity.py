"""Identity of a study, as hashes: whether a store holds the results of this one or of another."""

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from .cases import Cases


def identity_of_cases(cases: Cases) -> str:
    """A hash of all parameters of all members."""
    digest = hashlib.sha256(repr(cases.grid).encode())
    for values in (cases.columns, cases.labels):
        for name, column in values.items():
            digest.update(f"{name} {column.dtype} {column.shape}".encode() + np.ascontiguousarray(column).tobytes())
    return digest.hexdigest()


def identity_of_outputs(variables: Mapping[str, Any], cases: Cases) -> str:
    """A hash of the names, dimensions, types, shapes and units of all outputs, and of the values along dimensions."""
    digest = hashlib.sha256()
    for name, (dims, values, shape, attributes) in variables.items():
        digest.update(f"{name} {attributes}".encode())
        if isinstance(values, np.dtype):
            digest.update(f"{dims} {values} {shape[1:]}".encode())
        elif name not in cases.columns:
            digest.update(f"{dims} {values.dtype} {shape}".encode() + np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()
