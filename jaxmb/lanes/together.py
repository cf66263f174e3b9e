"""A function of one member for several members, as `jax.vmap` gives it."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._compat import ClosedJaxpr, jaxpr_as_function
from .evaluate import in_lanes


def together(program: Any) -> Callable[..., list[Any]]:
    """`jax.vmap` of a closed program of one member, evaluated with members along the last axis; its derivatives are
    those of `jax.vmap`.
    """

    @eqx.filter_custom_jvp
    def of_members(constants, arrays):
        evaluated = in_lanes(ClosedJaxpr(program.jaxpr, constants), arrays[0].shape[0])
        return [jnp.moveaxis(x, -1, 0) for x in evaluated(*[jnp.moveaxis(x, 0, -1) for x in arrays])]

    @of_members.def_jvp
    def _(primals, tangents):
        # Programs of derivatives have rules of their own, which are not in the equations.
        alone = lambda constants, *arrays: jaxpr_as_function(ClosedJaxpr(program.jaxpr, constants))(*arrays)
        by_vmap = lambda constants, arrays: jax.vmap(lambda *arrays: alone(constants, *arrays))(*arrays)
        return eqx.filter_jvp(by_vmap, primals, tangents)

    return lambda *arrays: of_members(list(program.consts), list(arrays))
