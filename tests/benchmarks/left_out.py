"""Costs of features that a scene does not use, measured by switching each of them on.

python tests/benchmarks/left_out.py four_bar
"""

import dataclasses
import sys
import time
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb import State, simulate
from jaxmb.bodies.groups import ConstraintGroup, ForceGroup, Group, VelocityConstraintGroup, stack
from jaxmb.bodies.structure import with_structure
from jaxmb.manifold import Partition
from jaxmb.manifold.default import default_manifold
from jaxmb.mechanisms import Mechanism
from jaxmb.parts import AbstractConstraint, AbstractVelocityConstraint
from jaxmb.parts.forces import Damper
from jaxmb.report import Table
from jaxmb.report.evaluations import evaluations
from jaxmb.report.subject import subject
from jaxmb.report.timing import interleaved
from jaxmb.report.variants import doubled, first_joint, with_constraints
from jaxmb.solvers import Adams
from jaxmb.system import AbstractSystem
from jaxmb.system.description import LEFT_OUT

COLUMNS = {
    "put in": "",
    "lines of HLO": "d",
    "trace [s]": ".2f",
    "compile [s]": ".2f",
    "evaluation [µs]": ".1f",
    "evaluations": "d",
    "run [ms]": ".2f",
}


def left_out(
    system: AbstractSystem | Mechanism, state: State | None = None, *, t1: float | None = None, repeats: int = 5
) -> Table:
    """Measure the time saved by leaving unused features out of the compiled program.

    Each thing that the motion does not need is put in, in a form that does not change the motion: a joint twice, a term
    in time of amplitude zero, with which the joint is known by its residual alone, rows between velocities that a joint
    implies, a damper of zero, an event that does not occur, dense output, and a dense Jacobian with charts where blocks
    do. Only what is put in is measured. A persistent cache of compiled programs shortens the compile times of a second
    report.

    **Arguments:** `system`, `state`, `t1` [s]: as in `simulate`, or a mechanism of the library alone; `repeats`: timed
    runs, in turns.

    **Returns:** a row for the motion as it is, and for it with one thing put in: lines of HLO, before XLA optimises;
    times to trace, the shortest of three, and to compile, both of the processor, which other programs disturb less than
    that of a clock; the shortest warm run by the clock, and that time by the number of evaluations.
    """
    mechanism = subject(system, state, t1)
    own, start, end = mechanism.system, mechanism.state, mechanism.t1
    without_charts = own.acceleration_rows > 0 and not default_manifold(own, Adams(), None).uses_charts
    events: dict[str, Any] = {"event": diffrax.Event(lambda t, y, args, **kwargs: t - 2 * end)}
    # What is put in, whether the motion does without it, the system that has it, and options of `simulate`.
    possible: list[tuple[str, bool, Callable[..., Any] | None, dict[str, Any]]] = [
        ("nothing", True, None, {}),
        ("a joint twice", own.acceleration_rank == own.acceleration_rows, doubled, {}),
        ("a term in time", own.drift_free, in_time, {}),
        ("rows between velocities", own.velocity_rows == own.position_rows, nonholonomic, {}),
        ("a damper of zero", True, with_damper, {}),
        ("an event", True, None, events),
        ("dense output", True, None, {"saveat": diffrax.SaveAt(t1=True, dense=True)}),
        ("charts, a dense Jacobian", without_charts, None, {"manifold": Partition()}),
    ]
    remarks, compiled, programs = [], [], []
    for what, free, change, options in possible:
        if not free:
            remarks.append(f"{what}: the motion has that, or has no use for it.")
            continue
        try:
            changed = own if change is None else change(own, start)
        except ValueError as reason:
            remarks.append(f"{what}: not put in, {str(reason).splitlines()[0].rstrip('.')}.")
            continue
        program, *cost = _compiled(changed, start, end, options)
        compiled.append(lambda program=program, changed=changed: program(changed, start))
        programs.append((what, *cost))
    # Each twice in a row: the second does not find the memory as dense output left it.
    twice = iter(interleaved([run for run in compiled for _ in range(2)], repeats))
    times = [next(twice) + next(twice) for _ in compiled]
    cases = []
    for (what, trace, seconds, lines), run, seen in zip(programs, compiled, times, strict=True):
        count = evaluations(Adams(), run().stats)
        assert count is not None
        cases.append((what, lines, trace, seconds, 1e6 * min(seen) / count, count, 1e3 * min(seen)))
    title = f"{mechanism.name}, {end:g} s: what the motion costs with parts that it does not need"
    return Table(title, COLUMNS, cases, [f"not needed: {text}" for text in own.describe().remarks[LEFT_OUT]] + remarks)


def _compiled(system, state, t1, options) -> tuple[Callable[..., Any], float, float, int]:
    """A program, the times to trace and to compile it, and its lines."""
    lowered, traces = None, []
    for _ in range(3):
        # The first time JAX also traces functions that it keeps for other programs.
        motion = lambda system, state: simulate(system, state, t1=t1, throw=False, **options)
        begin = time.process_time()
        lowered = eqx.filter_jit(motion).lower(system, state)  # pyright: ignore[reportFunctionMemberAccess]
        traces.append(time.process_time() - begin)
    assert lowered is not None
    begin = time.process_time()
    program = lowered.compile()
    return program, min(traces), time.process_time() - begin, len(lowered.as_text().splitlines())


def in_time(system: Any, state: State) -> AbstractSystem:
    """A scene whose first joint has a term in time of amplitude zero."""
    joint = first_joint(system)
    if not isinstance(joint.part, AbstractConstraint):
        raise ValueError(f"{joint.names[0]!r} is no constraint between positions")
    part = _InTime("", (), joint.part, jnp.zeros(len(joint.names)))
    first = ConstraintGroup(Group(part, joint.names, joint.bodies, joint.layout))
    position = (first, *system.constraints.position[1:])
    return with_constraints(system, state, dataclasses.replace(system.constraints, position=position))


def nonholonomic(system: Any, state: State) -> AbstractSystem:
    """A scene with the rates of its first joint as constraints between velocities, which the joint implies."""
    joint = first_joint(system)
    if not isinstance(joint.part, AbstractConstraint):
        raise ValueError(f"{joint.names[0]!r} is no constraint between positions")
    part = _Rate("", (), jax.tree.map(lambda x: x[:1], joint.part))
    own = Group(part, (f"rate of {joint.names[0]}",), joint.bodies[:1], joint.layout)
    velocity = (*system.constraints.velocity, VelocityConstraintGroup(own))
    return with_constraints(system, state, dataclasses.replace(system.constraints, velocity=velocity))


def with_damper(system: Any, state: State) -> AbstractSystem:
    """A scene with a force element that exerts no force, a damper between its first body and the ground."""
    if not system.body_names:
        raise ValueError("there are no bodies")
    layout = system.layout
    origin = np.zeros(layout.space.dimension)
    part = Damper("a damper of zero", "ground", system.body_names[0], damping=0.0, point_a=origin, point_b=origin)
    own = stack([(part, (layout.ground, 0))], layout)
    forces = dataclasses.replace(system.forces, groups=(*system.forces.groups, *map(ForceGroup, own)))
    return with_structure(dataclasses.replace(system, guess=state, forces=forces))


class _InTime(AbstractConstraint):
    name: str = eqx.field(static=True)
    bodies: tuple = eqx.field(static=True)
    part: Any
    amplitude: Any
    rheonomic = True

    @property
    def rows(self):
        return self.part.rows

    def residual(self, space, poses, t):
        return self.part.residual(space, self.part.seen_poses(space, poses), t) + self.amplitude * jnp.sin(t)


class _Rate(AbstractVelocityConstraint):
    name: str = eqx.field(static=True)
    bodies: tuple = eqx.field(static=True)
    part: Any
    linear = True

    @property
    def rows(self):
        return self.part.rows

    @property
    def homogeneous(self):
        return not self.part.rheonomic

    def residual(self, space, poses, velocities, t):
        rates, t = jax.vmap(space.rates)(poses, velocities), jnp.asarray(t, poses.dtype)
        residual = lambda t, x: self.part.residual(space, self.part.seen_poses(space, x), t)
        return jax.jvp(residual, (t, poses), (jnp.ones_like(t), rates))[1]


if __name__ == "__main__":
    mb.setup(keep=False)
    for own in sys.argv[1:] or ("four_bar",):
        print(left_out(mb.mechanisms.get(own)))
