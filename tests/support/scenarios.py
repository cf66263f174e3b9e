"""Motions with contacts and dry friction, beside what closed forms know of them."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from compiling import jit_quickly
from derivative_checks import central_differences, in_both_modes

import jaxmb as mb


@dataclasses.dataclass
class Scenario:
    """A motion of `system` until `t1`.

    `events`: part, kind and time of each; `impulses` and `lost`, energy, of each, where they are given; `values` by
    the names of quantities, at the times `ts`, or at the end. `start`: of `mb.assemble`; `options`: of `mb.simulate`.
    Times and values are compared to `near`, relative to numbers beyond one.
    """

    system: Any
    t1: float
    events: Sequence[tuple[str, str, float]] = ()
    values: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    ts: Sequence[float] | None = None
    impulses: Any = None
    lost: Any = None
    start: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    near: float = 1e-9

    def check(self, **options: Any) -> Any:
        """The motion, which has these events and values."""
        state, ts = mb.assemble(self.system, **self.start), [self.t1] if self.ts is None else self.ts
        own = {"saveat": np.asarray(ts), "rtol": 1e-10} | dict(self.options) | options
        motion = mb.simulate(self.system, state, t1=self.t1, **own)
        found = list(motion.events)
        near = lambda a, b, name: np.testing.assert_allclose(a, b, rtol=self.near, atol=self.near, err_msg=name)
        assert [(event.part, event.kind) for event in found] == [(part, kind) for part, kind, _ in self.events]
        near([event.time for event in found], [time for *_, time in self.events], "times")
        for known, name in ((self.impulses, "impulse"), (self.lost, "kinetic_energy_lost")):
            if known is not None:
                near([getattr(event, name) for event in found], known, name)
        for name, known in self.values.items():
            value = motion.quantity(name)
            near(value[-1] if self.ts is None else value, known, name)
        return motion


@dataclasses.dataclass
class Derived:
    """Numbers of a motion as a function `end(x, rtol)` of a vector.

    `exact`: their closed form; None where differences of a tighter solution stand for it; not `traced` by JAX if it is
    of NumPy. `many`: vectors of a batch, of which `at` is the first. Values and derivatives are compared to `values`
    and `near`.
    """

    end: Callable[..., Any]
    at: Any
    exact: Callable[[Any], Any] | None = None
    traced: bool = True
    many: Any = None
    values: float = 1e-9
    near: float = 1e-7

    def check(self) -> Any:
        """The derivative at `at`: forward mode is reverse mode, and both are that of the closed form."""
        end, many = (lambda x: self.end(x, 1e-10)), None if self.many is None else np.array(self.many)
        points, found = [np.array(self.at)] if many is None else many, in_both_modes(end, np.array(self.at), many)
        for k, x in enumerate(points):
            value, derivative = found if many is None else (found[0][k], found[1][k])
            if self.exact is not None:
                np.testing.assert_allclose(value, self.exact(x), rtol=self.values, atol=self.values)
            known = jax.jacfwd(self.exact)(x) if self.exact and self.traced else self._differences(x)
            np.testing.assert_allclose(derivative, known, rtol=self.near, atol=self.near)
        return found[1] if many is None else found[1][0]

    def _differences(self, x):
        return central_differences(self.exact or jit_quickly(lambda x: self.end(x, 1e-12)), x)
