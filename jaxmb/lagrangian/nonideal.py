"""Non-ideal constraint forces, which do virtual work.

A constraint that is not ideal adds a force C, given by its work in displacements w that the constraints allow, `w · C`:
the components of C along the gradients of constraints have no effect. C may depend on the force that the constraint
would exert if it were ideal.

Source: F. E. Udwadia and P. Phohomsiri, "Explicit Poincaré equations of motion for general constrained systems", Proc.
R. Soc. A 463, 2007.
"""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.rotations import norm
from .kinematics import Parameters

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractNonIdealForce(eqx.Module):
    """The force C of one constraint.

    `constraint` is the name of the constraint, `coefficients` are the names of the system's parameters that the law
    uses, and `of_multipliers` says whether C depends on the constraint's multipliers.
    """

    constraint: AbstractVar[str]
    coefficients: AbstractVar[tuple[str, ...]]
    of_multipliers: ClassVar[bool] = True

    @abc.abstractmethod
    def force(
        self,
        t: Scalar,
        q: Float[Array, "nq"],
        v: Float[Array, "nq"],
        ideal: Float[Array, "nq"],
        multipliers: Float[Array, "rows"],
        parameters: Parameters,
    ) -> Float[Array, "nq"]:
        """C as a generalized force on the coordinates.

        **Arguments:** `v`: q̇; `ideal`: the generalized force that the constraint would exert if all were ideal, and
        `multipliers`: those of its rows then.
        """


class NonIdealForce(AbstractNonIdealForce):
    """C from a function, `function(t, q, v, multipliers, parameters)`, shape (nq,)."""

    constraint: str = eqx.field(static=True)
    function: Callable[..., Array] = eqx.field(static=True)
    coefficients: ClassVar[tuple[str, ...]] = ()

    def force(self, t, q, v, ideal, multipliers, parameters):
        return jnp.asarray(self.function(t, q, v, multipliers, parameters))


class CoulombFriction(AbstractNonIdealForce):
    """Coulomb friction: a force of `coefficient` times the constraint's own ideal force, against the slip s(t, q, q̇).

    Its work is `−μ N s·δs / √(s·s + ε²)`. Near rest it is smooth: full only where the slip is large against ε.

    **Arguments:**

    - `coefficient`: name of μ among the parameters.
    - `slip(t, q, v, parameters)`: velocity of slip [m/s], linear in v, shape (k,); default v, that of a particle in
        Cartesian coordinates.
    - `normal(t, q, multipliers, parameters)`: the normal force N [N]; default the length of the constraint's
        generalized force, that of a particle in Cartesian coordinates.
    - `smoothing`: ε [m/s].
    """

    constraint: str = eqx.field(static=True)
    coefficient: str = eqx.field(static=True)
    slip: Callable[..., Array] | None = eqx.field(static=True, default=None, kw_only=True)
    normal: Callable[..., Array] | None = eqx.field(static=True, default=None, kw_only=True)
    smoothing: float = eqx.field(static=True, default=1e-6, kw_only=True)

    @property
    def coefficients(self):
        return (self.coefficient,)

    def force(self, t, q, v, ideal, multipliers, parameters):
        s, pull = jax.vjp(lambda v: _slip(self.slip, t, q, v, parameters), v)
        normal = norm(ideal) if self.normal is None else jnp.abs(self.normal(t, q, multipliers, parameters))
        return -parameters[self.coefficient] * normal * pull(s / jnp.sqrt(s @ s + self.smoothing**2))[0]


class Viscous(AbstractNonIdealForce):
    """Friction in proportion to the slip s(t, q, q̇): work `−coefficient s·δs`.

    **Arguments:** `coefficient`: its name among the parameters [N s/m]; `slip` as in `CoulombFriction`.
    """

    constraint: str = eqx.field(static=True)
    coefficient: str = eqx.field(static=True)
    slip: Callable[..., Array] | None = eqx.field(static=True, default=None, kw_only=True)
    of_multipliers: ClassVar[bool] = False

    @property
    def coefficients(self):
        return (self.coefficient,)

    def force(self, t, q, v, reaction, multipliers, parameters):
        s, pull = jax.vjp(lambda v: _slip(self.slip, t, q, v, parameters), v)
        return -parameters[self.coefficient] * pull(s)[0]


def _slip(slip, t, q, v, parameters):
    return v if slip is None else jnp.ravel(slip(t, q, v, parameters))
