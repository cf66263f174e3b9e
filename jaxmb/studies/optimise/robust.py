"""Designs for scattered parameters: mean and spread of outputs over samples."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._arguments import real_array
from ..._traced_functions import asked_argument
from ..._types import VectorLike
from ...parts.names import names_arguments, unknown
from ..batch import batch


@names_arguments
def robust(
    function: Callable[..., Any], samples: Mapping[str, VectorLike], *, weight: float | None = None
) -> Callable[..., dict[str, Array]]:
    """A function whose outputs are mean and spread of another function's outputs over samples of scattered parameters.

    ```python
    rng = np.random.default_rng(0)  # `fall` is the function in the example of `optimise`.
    samples = {"bar.inertia": 0.01 * rng.standard_normal(16), "bar.mass": rng.uniform(0.9, 1.1, 16)}
    worst = jaxmb.robust(fall, samples, weight=-2.0)({"bar.inertia": 0.3})  # Mean less two deviations.
    ```

    **Arguments:**

    - `function`: as for `optimise`, of named parameters to named outputs, or a number.
    - `samples`: numbers by name with samples as axis 0, the same number for all. For a parameter of the call they are
        deviations from its value; other names are additional parameters, with the samples as values.
    - `weight`: if given, each output also appears under its name: mean plus `weight` times spread.

    **Returns:** a function of the same parameters, with outputs `"comfort.mean"` and `"comfort.spread"`, the standard
    deviation of the samples, for an output `"comfort"`. All samples are evaluated in one program, in blocks as by
    `jaxmb.batch`; if a sample fails, the outputs are NaN.

    **Raises:** `ValueError` for samples of different number, or fewer than two.
    """
    if not isinstance(samples, Mapping) or not samples:
        raise ValueError(f"samples must be numbers by name, at least one; got {samples!r}.")
    arrays = {name: real_array(f"Samples of {name!r}", x, jnp.result_type(float), None) for name, x in samples.items()}
    counts = {name: x.shape[0] if x.ndim else 0 for name, x in arrays.items()}
    if len(set(counts.values())) > 1 or min(counts.values()) < 2:
        raise ValueError(f"samples must be equally many for every name, at least two; got {counts}.")
    if weight is not None and not np.isfinite(weight):
        raise ValueError(f"weight must be a finite number, got {weight!r}.")

    @functools.wraps(function)
    def scattered(values: Mapping[str, Array], **options: Any) -> dict[str, Array]:
        for name, drawn in arrays.items():
            if name in values and jnp.shape(values[name]) != drawn.shape[1:]:
                raise ValueError(
                    f"Samples of {name!r} have shape {drawn.shape[1:]} each, but the parameter has "
                    f"shape {jnp.shape(values[name])}."
                )

        def of_sample(sample):
            shifted = {name: values[name] + x if name in values else x for name, x in sample.items()}
            try:
                out = function({**values, **shifted}, **options)
            except KeyError as error:
                if asked_argument(error) is None:
                    raise
                raise unknown("parameter", str(error.args[0]), [*values, *arrays]) from None
            return out if isinstance(out, Mapping) else {"objective": out}

        outputs = batch(of_sample)({name: jnp.asarray(x) for name, x in arrays.items()})
        out: dict[str, Array] = {}
        for name, of_samples in outputs.items():
            mean, spread = jnp.mean(of_samples, axis=0), _deviation(of_samples)
            out |= {f"{name}.mean": mean, f"{name}.spread": spread}
            if weight is not None:
                out[name] = mean + weight * spread
        return out

    return scattered


def _deviation(values: Array) -> Array:
    """The standard deviation along axis 0; for equal values zero with a derivative of zero."""
    variance = jnp.var(values, axis=0, ddof=1)
    some = variance > 0
    root = jnp.where(some, jnp.sqrt(jnp.where(some, variance, jnp.ones_like(variance))), jnp.zeros_like(variance))
    return jnp.where(jnp.isnan(variance), variance, root)
