"""A mechanism of the library: a system with a consistent state, and reference values of its motion."""

import dataclasses
import functools
import inspect
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import equinox as eqx
import numpy as np
from jax.core import Tracer

from .._types import State, VectorLike
from ..bodies.scene import Scene
from ..parts.names import unknown
from ..states.assembly import assemble
from ..system import AbstractSystem, with_parameters
from ..trajectory import Trajectory
from .observe import Observation

_DATA = Path(__file__).parent / "data"

# The models of a mechanism with a known Lagrangian.
Model = Literal["lagrangian", "rigid_bodies"]


@dataclasses.dataclass(frozen=True)
class References:
    """Reference values of a motion, from a source independent of this package.

    **Fields:**

    - `times` [s]: ascending, shape (times,).
    - `labels`: names of the quantities, as in `Mechanism.observe`.
    - `values`: shape (times, labels), in SI units.
    - `source` of the values.
    - `tolerance`: relative accuracy of the values.
    - `sizes` of the labels, the scales of relative errors, shape (labels,); default the largest value of each.
    """

    times: np.ndarray
    labels: tuple[str, ...]
    values: np.ndarray
    source: str
    tolerance: float
    sizes: np.ndarray | None = None

    def __post_init__(self):
        object.__setattr__(self, "labels", tuple(self.labels))
        object.__setattr__(self, "times", np.asarray(self.times, dtype=float))
        object.__setattr__(self, "values", np.asarray(self.values, dtype=float))
        if self.values.shape != (len(self.times), len(self.labels)):
            raise ValueError(
                f"References need a value for each of {len(self.times)} times and {len(self.labels)} labels, "
                f"got shape {self.values.shape}."
            )

    @classmethod
    def load(cls, name: str) -> "References":
        """The values in the file `data/<name>.json` of the library."""
        return cls(**json.loads((_DATA / f"{name}.json").read_text(encoding="utf-8")))

    @property
    def scales(self) -> np.ndarray:
        """The scale of the errors of each label: its size, or 1 if that is zero; shape (labels,)."""
        largest = np.max(np.abs(self.values), axis=0) if self.sizes is None else self.sizes
        return np.where(largest > 1e-12, largest, 1.0)


@dataclasses.dataclass(frozen=True)
class Mechanism:
    """A mechanism of the library, ready to run: `simulate(m.system, m.state, t1=m.t1)`.

    **Fields:**

    - `name`: as in `names()`.
    - `scene`: its parts, to which `m.scene.extended(joints=[more])` adds others; None for a system from a Lagrangian.
    - `system`, `state`: the system, and a consistent state at t = 0.
    - `t1`: the end of its usual motion [s].
    - `references`: reference values, or None if they do not apply to the parameters.
    - `observe(trajectory)`: quantities by label, arrays with time as axis 0, including the labels of the references.
    - `description`: the mechanism and the source of its data.
    - `fix`, `rates`: coordinates and rates that the state was assembled with, as in `assemble`.
    - `start(system, guess)`: computes the state; None if `assemble` does.
    """

    name: str
    scene: Any
    system: Any
    state: State
    t1: float
    references: References | None
    observe: Callable[[Trajectory], Observation]
    description: str
    fix: Mapping[str, VectorLike] = dataclasses.field(default_factory=dict)
    rates: Mapping[str, VectorLike] = dataclasses.field(default_factory=dict)
    start: Callable[[Any, State], State] | None = None

    def errors(self, trajectory: Trajectory) -> dict[str, np.ndarray]:
        """Relative errors against the references, by label, at every saved reference time.

        Errors are relative to `references.scales`: the sizes of the labels, by default their largest reference values.

        **Raises:** `ValueError` if there are no references, or the trajectory saved none of their times.
        """
        if self.references is None:
            raise ValueError(f"There are no reference values for {self.name!r} with these parameters.")
        times, saved = self.references.times, np.asarray(trajectory.ts)
        near = np.isclose(saved[None, :], times[:, None], rtol=0.0, atol=1e-12 * max(1.0, float(times[-1])))
        rows, where = np.nonzero(near)
        if rows.size == 0:
            raise ValueError(
                f"The trajectory of {self.name!r} was saved at none of the reference times {times.tolist()}; "
                "use simulate(..., saveat=mechanism.references.times)."
            )
        observed = self.observe(trajectory)
        return {
            label: np.abs(np.asarray(observed[label])[where] - self.references.values[rows, k]) / scale
            for k, (label, scale) in enumerate(zip(self.references.labels, self.references.scales, strict=True))
        }

    def until(self, t1: float) -> "Mechanism":
        """The same motion with another end `t1` [s], and the reference values up to there."""
        if not 0 < t1 < float("inf"):
            raise ValueError(f"t1 must be positive and finite, got {t1:g}.")
        references = self.references
        if references is not None:
            keep = references.times <= t1
            kept = dataclasses.replace(references, times=references.times[keep], values=references.values[keep])
            references = kept if keep.any() else None
        return dataclasses.replace(self, t1=float(t1), references=references)

    def with_parameters(self, values: Mapping[str, VectorLike]) -> "Mechanism":
        """The same mechanism with some parameters replaced and the state recomputed near the present state; also under
        `jit`.

        **Arguments:** `values`: new numbers by name, as in `jaxmb.with_parameters`.
        """
        system = with_parameters(self.system, values)
        if self.start is None:
            state = assemble(system, self.state, fix=self.fix, rates=self.rates)
        else:
            state = self.start(system, self.state)
        return dataclasses.replace(self, system=system, state=state, references=None)


def mechanism(*, variants: tuple[str, ...] = ()) -> Callable[[Callable[..., Mechanism]], Callable[..., Mechanism]]:
    """Decorate a builder of the library: it refuses unknown parameters, and drops the reference values if a parameter
    differs from its default.

    **Arguments:** `variants`: parameters for whose values the builder itself chooses the references.
    """

    def decorate(function: Callable[..., Mechanism]) -> Callable[..., Mechanism]:
        defaults = {name: parameter.default for name, parameter in inspect.signature(function).parameters.items()}

        @functools.wraps(function)
        def build(**parameters: Any) -> Mechanism:
            for name in parameters:
                if name not in defaults:
                    raise unknown(f"parameter of {function.__name__}", name, defaults)
            made = function(**parameters)
            published = all(name in variants or _same(value, defaults[name]) for name, value in parameters.items())
            return made if published else dataclasses.replace(made, references=None)

        return build

    return decorate


def _same(value: Any, default: Any) -> bool:
    if isinstance(value, Tracer):
        return False
    return value is default or (default is not None and value is not None and np.array_equal(value, default))


def build(
    name: str,
    scene: Scene | AbstractSystem,
    *,
    t1: float,
    observe: Callable[[Trajectory], Observation],
    description: str,
    references: References | None = None,
    fix: Mapping[str, VectorLike] | None = None,
    rates: Mapping[str, VectorLike] | None = None,
    start: Callable[[Any, State], State] | None = None,
) -> Mechanism:
    """Compile and assemble a scene, or assemble a system, into a mechanism."""
    fix, rates = fix or {}, rates or {}
    # Only a scene has parts to extend, and must be compiled.
    parts = None if isinstance(scene, AbstractSystem) else scene
    system: Any = scene if parts is None else parts.compile()
    state = assemble(system, fix=fix, rates=rates) if start is None else start(system, system.guess)
    observe = eqx.filter_jit(observe)
    return Mechanism(name, parts, system, state, float(t1), references, observe, description, fix, rates, start)


def is_rigid(model: Model, **defaults: bool) -> bool:
    """Whether to build a scene of rigid bodies instead of a system from a Lagrangian.

    **Arguments:** `defaults`: whether each parameter that selects the form of the Lagrangian's equations has its
    default value.

    **Raises:** `ValueError` for an unknown model, and for rigid bodies with a form of the Lagrangian's equations.
    """
    if model not in get_args(Model):
        raise ValueError(f"The models are {', '.join(get_args(Model))}; got {model!r}.")
    chosen = [name for name, default in defaults.items() if not default]
    if model == "rigid_bodies" and chosen:
        raise ValueError(f"model='rigid_bodies' has no Lagrangian: leave out {', '.join(chosen)}.")
    return model == "rigid_bodies"
