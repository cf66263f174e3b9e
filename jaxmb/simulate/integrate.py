"""The integration of a motion, on a mesh that also resolves derivatives if there are any."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
from jax import lax

from ..manifold.orthogonal_projection import project
from ..solvers.mesh import on_mesh
from ..solvers.one_step import with_tangents
from ..solvers.stepping import Carry, begun, loop, solution_of
from ..solvers.tangent import TangentControl
from .room import Room
from .saves import STATES, seen
from .watch import pushed


def integrated(
    integration: tuple[Any, Any, dict[str, Any]],
    control: TangentControl | None,
    room: Room,
    projects_steps: bool,
    differentiated: bool,
    carry: Carry | None,
) -> tuple[Any, Carry | None]:
    """The `diffrax.Solution`, with derivatives; and what the next call needs with a `carry` of the last.

    **Arguments:** `integration`: term, solver and options of `begun`; `control` of tangents, None for none;
    `projects_steps`: whether states return to constraints after steps; `differentiated`: whether derivatives are known
    to be taken.
    """
    if differentiated:
        # Then the run without derivatives is not traced.
        return _with_tangents(integration, control, room, projects_steps), None
    if carry is None:
        return _on_mesh(integration, control, room, projects_steps), None
    term, solver, options = integration
    solve, first = begun(term, solver, max_steps=room.rows, **options)
    last, carry = loop(solve, first, room.limit, carry)
    return solution_of(solve, last, first.y), carry


@eqx.filter_custom_jvp
def _on_mesh(integration, control, room, projects_steps):
    """The solution on a mesh that resolves the motion, and tangents as well if it is differentiated."""
    del control, projects_steps
    # At first use: an import of the package does not load batches.
    from ..lanes.members import of_one_or_more

    term, solver, options = integration
    return of_one_or_more(_solution, term, solver, options, room, None)


@_on_mesh.def_jvp
def _on_mesh_jvp(primals, tangents):
    integration, control, room, projects_steps = primals
    if control is not None and control.direction is None:
        used = jax.tree.map(lambda x: x is not None, tangents[0][0], is_leaf=lambda x: x is None)
        direction = pushed(lambda term: term, lax.stop_gradient(integration[0]), used)
        excites = bool(jax.tree.leaves(tangents[0][2]["y0"]))
        control = dataclasses.replace(control, direction=direction, excites=excites)
    solve = lambda integration: _with_tangents(integration, control, room, projects_steps)
    return eqx.filter_jvp(solve, (integration,), (tangents[0],))


def _with_tangents(integration, control, room, projects_steps):
    term, solver, options = integration
    without_tangents = lambda state: state
    if control is not None:
        if projects_steps:
            restore = lambda term, y: project(term.vector_field.system, options["t0"], y)
            control = control.on_constraints(restore, *lax.stop_gradient((term, options["y0"])))
        solver, controller, without_tangents = with_tangents(solver, options["stepsize_controller"], control)
        options = options | {"stepsize_controller": controller}
    solution = _solution(term, solver, options, room, room.kept)
    return eqx.tree_at(lambda s: s.solver_state, solution, replace_fn=without_tangents)


def _solution(term, solver, options, room, kept):
    """The solution. With derivatives, rows of this many steps are `kept`, and the user's function is applied after
    states are saved.
    """
    function = options["saveat"].subs[0].fn
    later = function is not STATES and kept is not None
    if later:
        options = options | {"saveat": eqx.tree_at(lambda saveat: saveat.subs[0].fn, options["saveat"], STATES)}
    solve, first = begun(term, solver, max_steps=room.rows, **options)
    last = loop(solve, first, room.limit)[0] if kept is None else on_mesh(solve, first, room.limit, kept)
    solution: Any = solution_of(solve, last, first.y)
    if not later:
        return solution
    ys = seen(function, solution.ts[0], solution.ys[0], (options["t0"], options["y0"]))
    return eqx.tree_at(lambda solution: solution.ys[0], solution, ys)
