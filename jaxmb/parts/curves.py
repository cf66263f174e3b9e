"""Laws of parts as functions of a few numbers, without a machine."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import real_array
from .._compat import canonical
from ..linalg.jitted import jitted


def over_arrays(label: str, law: Callable[..., Any], part: Any, **numbers: Any) -> Any:
    """`law(part, **numbers)` of numbers, for arrays that broadcast against each other; compiled once for all parts of a
    kind.

    **Arguments:** `label` of the part, for messages; `numbers` by their names.

    **Raises:** `ValueError` for anything but real numbers, and for shapes that do not fit.
    """
    arrays = {name: real_array(f"{label}: {name}", x, canonical(), None) for name, x in numbers.items()}
    try:
        shape = np.broadcast_shapes(*(x.shape for x in arrays.values()))
    except ValueError:
        shapes = ", ".join(f"{name} {x.shape}" for name, x in arrays.items())
        raise ValueError(f"{label}: the shapes of the numbers do not fit together: {shapes}.") from None
    return _over_arrays(law, part, arrays, shape)


def check_given(part: Any, *names: str) -> Any:
    """The part.

    **Raises:** `ValueError` for fields that are None, which a scene fills in from its poses.
    """
    for name in names:
        if getattr(part, name) is None:
            raise ValueError(f"{part.label}: give {name}, whose default is that of the poses of a scene.")
    return part


@jitted
def _over_arrays(law, part, arrays, shape):
    flat = {name: jnp.broadcast_to(x, shape).reshape(-1) for name, x in arrays.items()}
    values = jax.vmap(lambda numbers: law(part, **numbers))(flat)
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), values)
