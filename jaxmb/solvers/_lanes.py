"""Branches that stay branches in a batch."""

from collections.abc import Callable
from typing import Any

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax


def cond_of_any_lane(pred: Any, true_fn: Callable, false_fn: Callable, operand: Any) -> Any:
    """`lax.cond` that stays a branch under `vmap`: computed if any lane takes it, and used only by those that do."""
    new = lax.cond(eqxi.unvmap_any(pred), true_fn, false_fn, operand)
    return jax.tree.map(lambda a, b: jnp.where(pred, a, b), new, false_fn(operand))
