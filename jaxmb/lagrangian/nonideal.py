"""Non-ideal constraint forces, which do virtual work.

A non-ideal constraint exerts the force `Aᵀ λ + C`. Its reaction `Aᵀ λ` does no work in admissible displacements; C
does. C may depend on the reaction; both are then solved for together. Components of C along the constraint's gradients
only reduce the reaction.
"""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Coordinates, Scalar
from ..linalg.rotations import norm
from ..parts.smooth import dry_friction
from .kinematics import Parameters

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractNonIdealForce(eqx.Module):
    """The force C of one constraint.

    `constraint`: the name of the constraint; `coefficients`: the names of the system's parameters that the law uses;
    `of_multipliers`: whether C depends on the constraint's multipliers.
    """

    constraint: AbstractVar[str]
    coefficients: AbstractVar[tuple[str, ...]]
    of_multipliers: ClassVar[bool] = True

    @abc.abstractmethod
    def force(
        self,
        t: Scalar,
        q: Coordinates,
        v: Float[Array, "nq"],
        reaction: Float[Array, "nq"],
        multipliers: Float[Array, "rows"],
        parameters: Parameters,
    ) -> Float[Array, "nq"]:
        """C as a generalized force on the coordinates.

        **Arguments:** `v`: q̇; `reaction`: the constraint's generalized force `Aᵀ λ`, from the `multipliers` λ of its
        rows.
        """


class NonIdealForce(AbstractNonIdealForce):
    """C from a function, `function(t, q, v, multipliers, parameters)`, shape (nq,).

    ```python
    ring = jaxmb.lagrangian.Holonomic("ring", lambda t, q, p: jnp.array([0.5 * (q @ q - 1.0)]))
    drag = jaxmb.lagrangian.NonIdealForce("ring", lambda t, q, v, multipliers, p: -p["c"] * multipliers[0] ** 2 * v)
    common = {"kinetic": lambda t, q, v, p: 0.5 * v @ v, "q": [0.6, 0.8], "u": [-0.8, 0.6], "parameters": {"c": 0.1}}
    bead = jaxmb.lagrangian.LagrangianSystem(**common, constraints=[ring], nonideal=[drag])
    ```
    """

    constraint: str = eqx.field(static=True)
    function: Callable[..., Array] = eqx.field(static=True)
    coefficients: ClassVar[tuple[str, ...]] = ()

    def force(self, t, q, v, reaction, multipliers, parameters):
        return jnp.asarray(self.function(t, q, v, multipliers, parameters))


class CoulombFriction(AbstractNonIdealForce):
    """Coulomb friction: a force of `coefficient` times the constraint's reaction, against the slip s(t, q, q̇).

    ```python
    ring = jaxmb.lagrangian.Holonomic("ring", lambda t, q, p: jnp.array([0.5 * (q @ q - 1.0)]))
    rub = jaxmb.lagrangian.CoulombFriction("ring", "mu")
    common = {"kinetic": lambda t, q, v, p: 0.5 * v @ v, "q": [0.6, 0.8], "u": [-0.8, 0.6], "parameters": {"mu": 0.3}}
    bead = jaxmb.lagrangian.LagrangianSystem(**common, constraints=[ring], nonideal=[rub])
    ```

    Its work is `−μ N s·δs/|s| tanh(|s| / transition_speed)`, which is smooth at rest. If no such N exists, or more than
    one (Painlevé's paradox), a simulation ends with `friction_undetermined`.

    **Arguments:**

    - `coefficient`: name of μ among the parameters.
    - `slip(t, q, v, parameters)`: velocity of slip [m/s], linear in v, shape (k,); default v, for a particle in
        Cartesian coordinates.
    - `normal(t, q, multipliers, parameters)`: the normal force N [N]; default the length of the constraint's
        generalized force, for a particle in Cartesian coordinates.
    - `transition_speed` [m/s], the slip at which 76 % of the friction acts.
    """

    constraint: str = eqx.field(static=True)
    coefficient: str = eqx.field(static=True)
    slip: Callable[..., Array] | None = eqx.field(static=True, default=None, kw_only=True)
    normal: Callable[..., Array] | None = eqx.field(static=True, default=None, kw_only=True)
    transition_speed: float = eqx.field(static=True, default=1e-4, kw_only=True)

    @property
    def coefficients(self):
        return (self.coefficient,)

    def force(self, t, q, v, reaction, multipliers, parameters):
        s, pull = jax.vjp(lambda v: _slip(self.slip, t, q, v, parameters), v)
        normal = norm(reaction) if self.normal is None else jnp.abs(self.normal(t, q, multipliers, parameters))
        return pull(dry_friction(parameters[self.coefficient] * normal, s, self.transition_speed))[0]


class Viscous(AbstractNonIdealForce):
    """Friction in proportion to the slip s(t, q, q̇): work `−coefficient s·δs`.

    ```python
    ring = jaxmb.lagrangian.Holonomic("ring", lambda t, q, p: jnp.array([0.5 * (q @ q - 1.0)]))
    oil = jaxmb.lagrangian.Viscous("ring", "c")
    common = {"kinetic": lambda t, q, v, p: 0.5 * v @ v, "q": [0.6, 0.8], "u": [-0.8, 0.6], "parameters": {"c": 0.2}}
    bead = jaxmb.lagrangian.LagrangianSystem(**common, constraints=[ring], nonideal=[oil])
    ```

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
