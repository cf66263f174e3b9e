"""A train on a straight track in relative coordinates, after V. A. Lazaryan and others.

Coordinates are the position of the leading vehicle and the extensions of the couplers, `q = (x₁, y₁, …, yₙ₋₁)`, and
velocities are their rates. A slack of a centimetre is then not computed as the difference of positions ten kilometres
along the track. With the forces F_j on the vehicles and the tensions S_j of the couplers

    ÿ_j = −S_j (1/m_j + 1/m_{j+1}) + S_{j−1}/m_j + S_{j+1}/m_{j+1} + F_j/m_j − F_{j+1}/m_{j+1}

so the mass matrix is full, but its inverse is tridiagonal.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import State
from ..linalg.inertia import AbstractInertia
from ..planar import DraftGear
from ..system import AbstractSystem, DenseInertia
from ..system.description import Description, count_independent, remarks, shorten
from ..system.design_variables import DesignVariables, description_rows
from ..system.parameter_table import ParameterPath, ParameterTable


class RelativeInertia(AbstractInertia):
    """`Bᵀ m B` with B the map from relative to absolute velocities. `mass`: shape (n,) [kg]."""

    mass: Float[Array, "n"]

    def product(self, v):
        return forces_along(_scaled(self.mass, velocities(v)))

    def solve(self, f):
        ahead = jnp.concatenate([f[1:], jnp.zeros_like(f[:1])])
        absolute = _scaled(1 / self.mass, ahead - jnp.concatenate([-f[:1], f[1:]]))
        return jnp.concatenate([absolute[:1], absolute[:-1] - absolute[1:]])

    def root(self):
        # A full matrix, needed by formulations in frames only.
        return DenseInertia(self.product(jnp.eye(self.mass.size, dtype=self.mass.dtype))).root()

    def transpose(self):
        return self


def velocities(u: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """Velocities of the vehicles, from the first vehicle's and the rates of extension."""
    return jnp.cumsum(jnp.concatenate([u[:1], -u[1:]]), axis=0)


def forces_along(f: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """Generalized forces along the relative coordinates of forces on the vehicles."""
    behind = jnp.cumsum(f[::-1], axis=0)[::-1]
    return jnp.concatenate([behind[:1], -behind[1:]])


def _scaled(by, v):
    return (by if v.ndim == 1 else by[:, None]) * v


class _TrainParameters(ParameterTable):
    def positive(self):
        return frozenset(f"car{k + 1}.mass" for k in range(self.system.nq))


class RelativeTrain(AbstractSystem):
    """A train on a straight track; every number is a leaf.

    **Fields:** `mass` [kg], shape (n,); `couplers`, a draft gear whose numbers have shape (n − 1,); `law(t, v,
    numbers)`, the forces [N] on vehicles at absolute velocities v [m/s]; its `numbers` by part and field, shape (n,),
    or () if all vehicles share a number; `slope` [m/s²], the acceleration of gravity along the track, backwards;
    `guess`; `length` [m].
    """

    mass: Float[Array, "n"]
    couplers: DraftGear
    law: Callable[..., Array] = eqx.field(static=True)
    numbers: dict[str, dict[str, Array]]
    slope: Float[Array, ""]
    guess: State
    length: Float[Array, ""]
    design: tuple[DesignVariables, ...] = ()

    def describe(self):
        facts = (
            ("system", f"train of {self.nq} vehicles on a straight track, in relative coordinates"),
            ("velocities", f"{self.nu}, rates of the coordinates: {shorten(self.coordinate_names())}"),
            ("degrees of freedom", str(self.nu)),
            ("independent", count_independent(self)),
        )
        tables = {"design variables": tuple(description_rows(self.design))}
        return Description(facts, tables, remarks(self))

    @property
    def nq(self) -> int:
        return self.mass.shape[-1]

    @property
    def nu(self) -> int:
        return self.nq

    def coordinate_names(self):
        return {"x1": [0]} | {f"y{k}": [k] for k in range(1, self.nq)}

    def parameter_paths(self):
        paths: dict[str, list[ParameterPath]] = {}
        for k in range(self.nq):
            paths[f"car{k + 1}.mass"] = [(lambda s: s.mass, k)]
            for part, numbers in self.numbers.items():
                for name, value in numbers.items():
                    index = k if value.ndim else None
                    paths[f"{part}{k + 1 if value.ndim else ''}.{name}"] = [(_number(part, name), index)]
        for k in range(self.nq - 1):
            for name in self.couplers.__dataclass_fields__:
                if eqx.is_inexact_array(getattr(self.couplers, name)) and name not in _ATTACHMENT:
                    paths[f"coupler{k + 1}.{name}"] = [(_gear(name), k)]
        return paths

    @property
    def parameter_table(self):
        return _TrainParameters(self)

    def inertia(self, t, q, u):
        return RelativeInertia(self.mass)

    def force(self, t, q, u):
        force = self.law(t, velocities(u), self.numbers) - self.mass * self.slope
        tension = self.couplers.tension(q[1:], u[1:])
        return forces_along(force) - jnp.concatenate([jnp.zeros_like(q[:1]), tension])

    def tensions(self, y: State) -> Float[Array, "n-1"]:
        """Forces [N] of the couplers, positive in draft."""
        return self.couplers.tension(y.q[1:], y.u[1:])

    def kinetic_energy(self, t, q, u):
        return 0.5 * jnp.sum(self.mass * velocities(u) ** 2)

    def potential_energy(self, t, q):
        # Positions along the track up to constants, the lengths of couplers without extension.
        return jnp.sum(self.couplers.stored(q[1:])) + self.slope * jnp.sum(self.mass * velocities(q))

    def coordinate_scale(self):
        return jnp.ones(self.nq)

    def velocity_scale(self):
        return jnp.ones(self.nu)


# Attachment of a coupler, which has no effect on a straight track.
_ATTACHMENT = ("point_a", "point_b", "free_length")


def _number(part, name):
    return lambda system: system.numbers[part][name]


def _gear(name):
    return lambda system: getattr(system.couplers, name)
