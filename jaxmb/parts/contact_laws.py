"""Laws of contacts: the force in each of their modes, when a mode ends, and what an impact does.

A law binds one row of A: the rate of a gap, or a velocity of slip. Each law is of one of two kinds (Ch. Glocker,
"Set-Valued Force Laws", Springer, 2001), and its numbers are the answers of its methods:

| | along the normal, `AbstractImpactLaw` | along the slip, `AbstractSlipLaw` |
| --- | --- | --- |
| the row binds | closed: no gap, a force that pushes | stick: no slip, a force within its limit |
| otherwise | open: no force | slip: a force against it |
| a mode ends | where the gap, or the force, is zero | where the slip, or the rest of the limit, is zero |
| an impact | opens the gap again, or pushes again | has an impulse within the cone |
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class AbstractContactLaw(eqx.Module):
    """The law of one row of a contact or of dry friction; see `AbstractImpactLaw` and `AbstractSlipLaw`.

    **Fields:** `asked`: the number of arguments of each method that events ask, by name.
    """

    asked: ClassVar[dict[str, int]]


class AbstractImpactLaw(AbstractContactLaw):
    """The law of a contact along its normal. It is the `contact_law` of a part, and defines the `ratio`:

    ```python
    class Softened(jaxmb.parts.AbstractImpactLaw):
        slow: jax.Array
        speed: jax.Array

        def ratio(self, closing):
            return self.slow / (1 + closing / self.speed)

    class SoftContact(jaxmb.RigidContact):
        speed: jaxmb.parts.Number = jaxmb.parts.parameter(unit="m/s", sign="positive", default=1.0)

        @property
        def contact_law(self):
            return Softened(self.restitution, self.speed)

    floor = SoftContact("floor", "bar", terrain=jaxmb.terrain.Flat(-2.0), restitution=0.8, speed=3.0)
    ```

    The gap closes at the rate `closing` ≥ 0 [m/s, rad/s] before the impact.
    """

    asked: ClassVar[dict[str, int]] = {"ratio": 1, "rebound": 1, "pushed": 2}
    # The phases of an impact: compression alone, or an expansion too, in which a contact pushes again.
    phases: ClassVar[int] = 1

    @abc.abstractmethod
    def ratio(self, closing: Float[Array, ""]) -> Float[Array, ""]:
        """The ratio from 0 to 1 of the rates after and before the impact of a contact that strikes alone."""

    def rebound(self, closing: Float[Array, ""]) -> Float[Array, ""]:
        """Hook: the rate [m/s, rad/s] at which the gap at least opens again; by default by Newton's law of impact."""
        return self.ratio(closing) * closing

    def pushed(self, impulse: Float[Array, ""], closing: Float[Array, ""]) -> Float[Array, ""]:
        """Hook: the least impulse [N s, N m s] of the expansion, by the impulse of the compression; default zero."""
        del closing
        return jnp.zeros_like(impulse)


class Newton(AbstractImpactLaw):
    """Newton's law of impact: the gap opens at `restitution` times the rate at which it closed.

    ```python
    class WornContact(jaxmb.RigidContact):
        wear: jaxmb.parts.Number = jaxmb.parts.parameter(unit="1", default=0.0)

        @property
        def contact_law(self):
            kind = jaxmb.parts.Poisson if self.impact_law == "poisson" else jaxmb.parts.Newton
            return kind(self.restitution * (1 - self.wear))

    floor = WornContact("floor", "bar", terrain=jaxmb.terrain.Flat(-2.0), restitution=0.8, wear=0.2)
    ```
    """

    restitution: Float[Array, "*contacts"]

    def ratio(self, closing):
        return self.restitution


class Poisson(AbstractImpactLaw):
    """Poisson's law of impact: the contact pushes in the expansion at least `restitution` times as much again."""

    restitution: Float[Array, "*contacts"]
    phases: ClassVar[int] = 2

    def ratio(self, closing):
        return self.restitution

    def rebound(self, closing):
        return jnp.zeros_like(closing)

    def pushed(self, impulse, closing):
        return self.restitution * impulse


class AbstractSlipLaw(AbstractContactLaw):
    """The law of dry friction along its slip. It is the `contact_law` of a part, and defines `coefficient` and `limit`:

    ```python
    class Lubricated(jaxmb.parts.AbstractSlipLaw):
        dry: jax.Array
        viscous: jax.Array

        def coefficient(self, speed):
            return self.dry + self.viscous * speed

        def limit(self):
            return self.dry

    class OilyFriction(jaxmb.DryFriction):
        viscous: jaxmb.parts.Number = jaxmb.parts.parameter(unit="s/m", sign="non-negative", default=0.0)

        @property
        def contact_law(self):
            return Lubricated(self.coefficient, self.viscous)

    rub = OilyFriction("rub", "pin", coefficient=0.1, viscous=0.05, radius=0.02)
    ```

    The `speed` ≥ 0 [m/s] is the size of the slip. An impact takes the `coefficient` at speed zero.
    """

    asked: ClassVar[dict[str, int]] = {"coefficient": 1, "limit": 0, "resistance": 1, "hold": 0}
    # Whether the force of slip depends on the speed.
    varies: ClassVar[bool] = True
    # Whether `resistance` and `hold` are forces without a normal force; in joints only.
    resists: ClassVar[bool] = False

    @property
    def jumps(self) -> bool:
        """Whether the force jumps as slip begins."""
        return True

    @abc.abstractmethod
    def coefficient(self, speed: Float[Array, ""]) -> Float[Array, ""]:
        """The force of slip as a multiple of the normal force."""

    @abc.abstractmethod
    def limit(self) -> Float[Array, ""]:
        """The largest force of stick as a multiple of the normal force, not below the `coefficient` at speed zero."""

    def resistance(self, speed: Float[Array, ""]) -> Float[Array, ""]:
        """Hook: the force of slip [N, N m] besides."""
        return jnp.zeros_like(speed)

    def hold(self) -> Float[Array, ""]:
        """Hook: the largest force of stick [N, N m] besides."""
        return jnp.zeros_like(self.limit())


class Coulomb(AbstractSlipLaw):
    """Coulomb's law: the force is `slip` times the normal force in slip, and at most `stick` times in stick.

    **Fields:** `stick`: None for the same; otherwise stick has the larger of both, which may be inputs.
    """

    slip: Float[Array, "*frictions"]
    stick: Float[Array, "*frictions"] | None
    varies: ClassVar[bool] = False

    @property
    def jumps(self):
        return self.stick is not None

    def coefficient(self, speed):
        return self.slip

    def limit(self):
        return _of_stick(self)


class GivenForce(AbstractSlipLaw):
    """Friction of given size, without a normal force; see `Coulomb`."""

    slip: Float[Array, "*frictions"]
    stick: Float[Array, "*frictions"] | None
    varies: ClassVar[bool] = False
    resists: ClassVar[bool] = True

    @property
    def jumps(self):
        return self.stick is not None

    def coefficient(self, speed):
        return jnp.zeros_like(self.slip)

    def limit(self):
        return jnp.zeros_like(self.slip)

    def resistance(self, speed):
        return self.slip

    def hold(self):
        return _of_stick(self)


class Capstan(AbstractSlipLaw):
    """Euler's and Eytelwein's law of a rope on a pulley with the coefficient `friction` μ.

    The tension rises from T₁ to T₂ by at most 2 N tanh(μ φ / 2) on an angle φ of rope, where N is their mean: in slip
    that is `T₂ = T₁ e^(μ φ)`. The normal force in events is this limit, so the `coefficient` is one.
    """

    friction: Float[Array, "*frictions"]
    varies: ClassVar[bool] = False

    @property
    def jumps(self):
        return False

    def share(self, angle: Float[Array, "*frictions"]) -> Float[Array, "*frictions"]:
        """The largest rise of the tension as a multiple of the mean tension, by the angle of rope [rad]."""
        return 2.0 * jnp.tanh(0.5 * self.friction * angle)

    def coefficient(self, speed):
        return jnp.ones_like(self.friction)

    def limit(self):
        return jnp.ones_like(self.friction)


def _of_stick(law):
    return law.slip if law.stick is None else jnp.maximum(law.slip, law.stick)
