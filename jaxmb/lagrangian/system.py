"""Systems given by a Lagrangian."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._types import State, VectorLike
from ..linalg.arrays import is_traced
from ..parts.fields import as_jax
from ..parts.module_weights import ModuleWeights, as_weights
from ..states.on_host import MOST
from ..system.equation import Ranks
from .constraints import check_names
from .host import HostLagrangian
from .kinematics import AbstractKinematics, Rates
from .model import AbstractEquations, AbstractLagrangian, Projected, Unanalysed
from .nonideal import AbstractNonIdealForce
from .structure import constraint_sizes, find_structure, with_programs

# Further names in a saved motion, and the argument of `numpy.savez` that cannot name an array.
_TAKEN = ("t", "q", "u", "energy", "file")
_NOT_IN_FILES = "/\\:\0"


class LagrangianSystem(AbstractLagrangian):
    """A mechanical system from its Lagrangian `L(t, q, q̇)`, forces, and constraints at any level.

    ```python
    pendulum = jaxmb.lagrangian.LagrangianSystem(
        lambda t, q, v, p: 0.5 * p["length"] ** 2 * v[0] ** 2 + 9.81 * p["length"] * jnp.cos(q[0]),
        q=[0.5],
        coordinates=["theta"],
        parameters={"length": 1.0},
    )
    jaxmb.simulate(pendulum, jaxmb.assemble(pendulum), t1=1.0)["theta"]
    ```

    With velocities u, `q̇ = K(t, q, u)` and `B = ∂K/∂u`, the equations are Lagrange's, projected on the columns of B:

    ```text
    Bᵀ (d/dt ∂L/∂q̇ − ∂L/∂q − Q) = Aᵀ λ
    ```

    Automatic differentiation gives every term; structure functions of quasi-velocities appear only in `Hamel()` and
    `Voronets()`.

    All functions are JAX functions. Their last argument is the dictionary of the system's parameters by name.

    **Arguments:**

    - `lagrangian(t, q, v, parameters)`: L, with `v = q̇`; or instead
    - `kinetic(t, q, v, parameters)` and `potential(t, q, parameters)`: energies [J], `L = T − V`; the potential may be
        left out.
    - `force(t, q, v, parameters)`: generalized forces Q without potential, shape (nq,).
    - `constraints`: `Holonomic`, `Nonholonomic`, `Pfaffian`, `AccelerationConstraint`, `ServoConstraint`; rows may
        imply others.
    - `nonideal`: constraint forces that do virtual work: `CoulombFriction`, `Viscous`, `NonIdealForce`.
    - `kinematics`: the meaning of u; default `Rates()`, u = q̇.
    - `equations`: the form of the equations; default `Projected()`, as above, or `Hamel()`, `Voronets()`.
    - `q`, `u`: a state near the constraints, the guess for `assemble`; ranks are found there. Default u is zero.
    - `parameters`: numbers by name. An equinox module, such as a network, is called in the functions,
        `parameters["net"](v)`; its weights are one parameter, a vector, as in `Force`.
    - `coordinates`: their names, default `q0`, `q1`, …. A saved motion uses these names: not `t`, `q`, `u`, `energy` or
        `file`, and without slashes, colons or a leading dot.
    - `length`: the scale of the residuals of position constraints.

    Functions keep the values that they read now: after a change of a global variable, make a new system.

    **Raises:** `ValueError` for functions of the wrong shape; an L that is not twice differentiable in q̇; constraints
    that no positions satisfy near the guess; contradictory constraints on velocities or accelerations; names that are
    not unique; friction of a constraint that others imply; and a guess at a singular position, where a row has no
    gradient or is implied by others, unlike nearby.
    """

    diagonal: bool = eqx.field(static=True)
    positive_definite_mass: bool = eqx.field(static=True)
    linear: bool = eqx.field(static=True)
    drift_free: bool = eqx.field(static=True)
    ranks: Ranks = eqx.field()  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(
        self,
        lagrangian: Callable[..., Array] | None = None,
        *,
        kinetic: Callable[..., Array] | None = None,
        potential: Callable[..., Array] | None = None,
        force: Callable[..., Array] | None = None,
        constraints: Sequence[Any] = (),
        nonideal: Sequence[AbstractNonIdealForce] = (),
        kinematics: AbstractKinematics | None = None,
        equations: AbstractEquations | None = None,
        q: VectorLike,
        u: VectorLike | None = None,
        parameters: Mapping[str, VectorLike | eqx.Module] | None = None,
        coordinates: Sequence[str] | None = None,
        length: VectorLike = 1.0,
    ):
        kinematics = Rates() if kinematics is None else kinematics
        guess = _guess(q, u, kinematics)
        names = _names(coordinates, guess.q.size)
        check_names(tuple(constraints), names)
        difference = _lagrangian(lagrangian, kinetic, potential)
        energies = {"lagrangian": lagrangian, "kinetic": kinetic, "potential": potential}
        # Φ, then the rest of ψ, then rows that bind accelerations only.
        constraints = tuple(sorted(constraints, key=lambda c: c.level))
        numbers = {name: _number(name, value) for name, value in (parameters or {}).items()}
        model = Unanalysed(
            lagrangian=difference,
            applied=force,
            constraints=constraints,
            nonideal=tuple(nonideal),
            kinematics=kinematics,
            equations=Projected() if equations is None else equations,
            parameters=numbers,
            guess=guess,
            length=as_jax(length),
            coordinates=names,
            sizes=constraint_sizes(energies, force, constraints, kinematics, guess, numbers),
            inputs=(),
            known=(),
        )
        model = with_programs(model)
        for field in dataclasses.fields(model):
            setattr(self, field.name, getattr(model, field.name))
        for name, value in find_structure(model)._asdict().items():
            setattr(self, name, value)
        self.equations.check(self)

    def on_host(self, t):
        is_concrete = not is_traced((self, t)) and self.guess.q.dtype == np.float64
        small = 0 < self.acceleration_rows <= MOST and self.nq <= MOST
        return HostLagrangian(self, t) if is_concrete and small else None


def _number(name: str, value: Any) -> Array | ModuleWeights:
    try:
        return as_weights(value) if isinstance(value, eqx.Module) else as_jax(value)
    except (ValueError, TypeError) as error:
        raise ValueError(f"Parameter {name!r}: {error}.") from None


def _guess(q: VectorLike, u: VectorLike | None, kinematics: AbstractKinematics) -> State:
    q = as_jax(q)
    if q.ndim != 1:
        raise ValueError(f"q is a vector, got shape {q.shape}.")
    nu = kinematics.count(q.size)
    u = as_jax(np.zeros(nu)) if u is None else as_jax(u)
    if u.shape != (nu,):
        raise ValueError(f"The system has {nu} velocities, got u of shape {u.shape}.")
    return State(q, u)


def _names(coordinates: Sequence[str] | None, count: int) -> tuple[str, ...]:
    """The coordinates' names, which become names of files in the archive of `Trajectory.save`."""
    names = tuple(f"q{k}" for k in range(count)) if coordinates is None else tuple(coordinates)
    for name in names:
        if not isinstance(name, str) or not name:
            raise ValueError(f"A coordinate's name must be a non-empty string, got {name!r} in coordinates={names}.")
    if len(names) != count or len(set(names)) != count:
        raise ValueError(f"{count} coordinates need as many names, all different; got {names}.")
    for name in names:
        if f"{name}_rate" in names:
            raise ValueError(
                f"'{name}_rate' is the name of the rate of {name!r}; choose another name for the coordinate."
            )
        if name in _TAKEN:
            raise ValueError(f"In a saved motion {name!r} has another meaning; choose another name for the coordinate.")
        if any(character in name for character in _NOT_IN_FILES) or name.startswith("."):
            raise ValueError(
                f"The coordinate {name!r} cannot be saved under its name: leave out slashes, colons and leading dots."
            )
    return names


def _lagrangian(lagrangian, kinetic, potential):
    if (lagrangian is None) == (kinetic is None):
        raise ValueError("A LagrangianSystem takes either `lagrangian` or `kinetic`, and `potential` with the latter.")
    if lagrangian is not None and potential is not None:
        raise ValueError("`lagrangian` already contains the potential energy; pass `kinetic` to give it separately.")
    return _Difference(kinetic if lagrangian is None else lagrangian, potential)


@dataclasses.dataclass(frozen=True)
class _Difference:
    """L = T − V, or L alone; equal for equal functions, so that a second system of them is not compiled again."""

    kinetic: Callable[..., Array]
    potential: Callable[..., Array] | None

    def __call__(self, t, q, v, parameters):
        value = self.kinetic(t, q, v, parameters)
        if self.potential is not None:
            value = value - self.potential(t, q, parameters)
        return jnp.reshape(value, ())
