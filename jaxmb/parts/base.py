"""What every part of a scene is: a name, the bodies it touches, and a pure residual or law of those bodies alone.

Numbers are array fields (the parameters, addressed as `"name.field"`), everything else is static. Parts of one type are
stacked and `vmap`ped, so a kernel here is written for a single part and for the poses of its own bodies, shape
`(len(bodies), pose size)`.
"""

import abc
from typing import TYPE_CHECKING, Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.arrays import as_array, is_traced
from .space import AbstractSpace

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

Poses = Float[Array, "k p"]
Velocities = Float[Array, "k v"]
Wrenches = Float[Array, "k v"]

GROUND = "ground"


def number(value: Any) -> Any:
    """A strongly typed float array: JAX's of a traced value, otherwise a constant one of NumPy's, so that nothing is
    compiled to build a scene.
    """
    if not is_traced(value) and np.asarray(value).dtype.kind not in "fiub":
        raise ValueError(f"expected a real number or an array of real numbers, got {value!r}")
    out = as_array(value, jnp.result_type(float))
    if isinstance(out, np.ndarray):
        out.flags.writeable = False
    return out


def array(value: Any) -> Array:
    """The same as an array of JAX's: for functions that may index it by what is traced."""
    if isinstance(value, Array) and value.dtype == jnp.result_type(float) and not value.aval.weak_type:
        return value
    value = number(value)
    return value if isinstance(value, Array) else jax.device_put(value)


def optional_number(value: Any) -> Any:
    """A strongly typed float array, or None where `resolve` is to work the value out; fields have the type they have
    after that.
    """
    return None if value is None else number(value)


class AbstractPart(eqx.Module):
    """Anything with a name in a scene."""

    name: AbstractVar[str]


class AbstractLink(AbstractPart):
    """A part that acts between bodies."""

    bodies: AbstractVar[tuple[str, ...]]

    def resolve(self, space: AbstractSpace, poses: Poses) -> Self:
        """The same part with every number filled in: world points and axes turned into body-fixed ones at the given
        poses.
        """
        del space, poses
        return self

    def components(self) -> "tuple[AbstractLink, ...]":
        """The elementary parts it is made of, under the same name; called after `resolve`."""
        return (self,)


class AbstractConstraint(AbstractLink):
    """A constraint between positions, `residual = 0`.

    `rows` is the static number of scalar equations; `rheonomic` says whether the residual depends on time.
    """

    rows: AbstractVar[int]
    rheonomic: AbstractVar[bool]

    @abc.abstractmethod
    def residual(self, space: AbstractSpace, poses: Poses, t: Scalar) -> Float[Array, "rows"]:
        """Φ(poses, t) of this part."""


class AbstractVelocityConstraint(AbstractLink):
    """A constraint between velocities that is not the derivative of one between positions, `residual = 0`.

    `linear` says whether the residual is linear in the velocities (perhaps with a constant term), `homogeneous`
    whether it vanishes at rest.
    """

    rows: AbstractVar[int]
    linear: AbstractVar[bool]
    homogeneous: AbstractVar[bool]

    @abc.abstractmethod
    def residual(self, space: AbstractSpace, poses: Poses, velocities: Velocities, t: Scalar) -> Float[Array, "rows"]:
        """ψ(poses, velocities, t) of this part."""


class AbstractForce(AbstractLink):
    """A force law.

    `conservative` says whether `energy` holds a potential energy of this part; the rest of its power is dissipated or
    supplied.
    """

    conservative: AbstractVar[bool]

    @abc.abstractmethod
    def wrenches(self, space: AbstractSpace, poses: Poses, velocities: Velocities, t: Scalar) -> Wrenches:
        """The wrench on each of its bodies."""

    def energy(self, space: AbstractSpace, poses: Poses, t: Scalar) -> Float[Array, ""]:
        """Potential energy [J]; zero for a part without one."""
        del space, t
        return jnp.zeros((), poses.dtype)


class AbstractNonIdeal(AbstractPart):
    """What a joint does beyond d'Alembert's principle: forces that work in the motions it allows.

    `joint` is its name. They may depend on the joint's own reactions, those that it would exert if all joints were
    ideal; what of them the joint does not allow to move has no effect.
    """

    joint: AbstractVar[str]

    def resolve(self, space: AbstractSpace, joint: AbstractLink, poses: Poses) -> Self:
        """The same part with every number filled in, from its joint and the poses of the joint's bodies."""
        del space, joint, poses
        return self

    @abc.abstractmethod
    def wrenches(
        self, space: AbstractSpace, poses: Poses, velocities: Velocities, reactions: Wrenches, t: Scalar
    ) -> Wrenches:
        """The wrench on each of the joint's bodies; `reactions`: what the ideal joint does to them."""


def rows_of(part: AbstractConstraint | AbstractVelocityConstraint, space: AbstractSpace, poses: Poses) -> Array:
    """Derivative of a constraint's rows with respect to the velocities of its bodies, (rows, k, velocity size)."""
    velocities = jnp.ones((poses.shape[0], space.velocity_size), poses.dtype)
    if isinstance(part, AbstractVelocityConstraint):
        return jax.jacfwd(lambda v: part.residual(space, poses, v, jnp.zeros((), poses.dtype)))(velocities)

    def rate(v):
        rates = jax.vmap(space.rates)(poses, v)
        return jax.jvp(lambda x: part.residual(space, x, jnp.zeros((), poses.dtype)), (poses,), (rates,))[1]

    return jax.jacfwd(rate)(velocities)
