"""Motions with contacts and dry friction, beside what closed forms know of them."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

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
