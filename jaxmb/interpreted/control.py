"""Rules of conditions, loops and systems of equations."""

import numpy as np

from .._compat import ShapedArray, sizes_of_scan
from .lines import Append, Assign, Branch, Break, Let, Loop
from .translate import rule

_TURN = ShapedArray((), np.dtype(np.int64))


@rule("custom_linear_solve")
def _linear_solve(t, e, values):
    counts, programs = e.params["const_lengths"], e.params["jaxprs"]
    first = counts.matvec + counts.vecmat
    right = values[first + counts.solve + counts.transpose_solve :]
    return t.program(programs.solve, [*values[first : first + counts.solve], *right])


@rule("cond")
def _cond(t, e, values):
    (index, *operands), branches = values, e.params["branches"]
    if index.constant is not None:
        return t.program(branches[min(max(int(index.constant), 0), len(branches) - 1)], operands)
    truth = t.truths.get(index.name) if len(branches) == 2 else None
    out, bodies = [t.variable(variable.aval, t.block.level) for variable in e.outvars], []
    for branch in branches:
        with t.within(loop=False) as block:
            found = [t.full(x) for x in t.program(branch, operands)]
            if out:
                block.lines.append(Assign([x.name for x in out], [x.name for x in found]))
        bodies.append(block.lines)
    t.block.lines.append(Branch((truth or index).name, bodies, truth is not None))
    return out


def _carried(t, program, first, start):
    """The values that a loop carries, by variables; those that it leaves as they are, from the start."""
    jaxpr = program.jaxpr
    kept = [new is old for new, old in zip(jaxpr.outvars, jaxpr.invars[first:], strict=False)]
    return [
        x if same else t.variable(new.aval, t.block.level)
        for x, same, new in zip(start, kept, jaxpr.invars[first:], strict=False)
    ]


def _assign(block, targets, sources):
    pairs = [(a.name, b.name) for a, b in zip(targets, sources, strict=True) if a.name != b.name]
    if pairs:
        block.lines.append(Assign(*map(list, zip(*pairs, strict=True))))


@rule("while")
def _while(t, e, values):
    p = e.params
    for_test, for_body = p["cond_nconsts"], p["body_nconsts"]
    fixed, start = values[for_test : for_test + for_body], [t.full(x) for x in values[for_test + for_body :]]
    with t.within(loop=True) as block:
        carry = _carried(t, p["body_jaxpr"], for_body, start)
        (goes_on,) = t.program(p["cond_jaxpr"], [*values[:for_test], *carry])
        test = goes_on
        if goes_on.shape:
            whole = t.full(goes_on)
            test = t.put(f"{whole.name}.any()", [whole], (), np.dtype(bool))
        block.lines.append(Break(test.name))
        new = [t.full(x) for x in t.program(p["body_jaxpr"], [*fixed, *carry])]
        # Members of a batch that have ended stay as they are.
        new = [_where_going(t, goes_on, x, old) if goes_on.shape else x for x, old in zip(new, carry, strict=True)]
        _assign(block, carry, new)
    _assign(t.block, carry, start)
    t.block.lines.append(Loop("while True", block.lines))
    return [x._replace(level=min(x.level, t.block.level)) for x in carry]


def _where_going(t, goes_on, new, old):
    if new.name == old.name:
        return old
    shape = goes_on.shape + (1,) * (len(old.shape) - len(goes_on.shape))
    which = t.reshaped(t.full(goes_on), shape)
    return t.put(f"where({which.name}, {new.name}, {old.name})", [which, new, old], old.shape, old.dtype)


@rule("scan")
def _scan(t, e, values):
    p, length = e.params, int(e.params["length"])
    constants, count = sizes_of_scan(p)
    fixed, start = values[:constants], [t.full(x) for x in values[constants : constants + count]]
    scanned = [x if x.is_scalar else t.full(x) for x in values[constants + count :]]
    made = [variable.aval for variable in e.outvars[count:]]
    level = t.block.level
    rows = [t.variable(kind, level) for kind in made]
    with t.within(loop=True) as block:
        turn = t.variable(_TURN, block.level)
        carry = _carried(t, p["jaxpr"], constants, start)
        now = [
            x._replace(shape=x.shape[1:])
            if x.is_scalar
            else t.put(f"{x.name}[{turn.name}]", [x, turn], x.shape[1:], x.dtype)
            for x in scanned
        ]
        out = [t.full(x) for x in t.program(p["jaxpr"], [*fixed, *carry, *now])]
        block.lines += [Append(row.name, x.name) for row, x in zip(rows, out[count:], strict=True)]
        _assign(block, carry, out[:count])
    _assign(t.block, carry, start)
    t.block.lines += [Let(row.name, "[]", [], "", None) for row in rows]
    turns = f"range({length - 1}, -1, -1)" if p["reverse"] else f"range({length})"
    t.block.lines.append(Loop(f"for {turn.name} in {turns}", block.lines))
    ends = [x._replace(level=min(x.level, level)) for x in carry]
    return [*ends, *(_stacked(t, row, kind, p["reverse"]) for row, kind in zip(rows, made, strict=True))]


def _stacked(t, rows, kind, reverse):
    out = t.variable(kind, t.block.level)
    order = f"{rows.name}[::-1]" if reverse else rows.name
    text = f"array({order}, {t.type(kind.dtype)}).reshape({kind.shape})"
    t.block.lines.append(Let(out.name, text, [rows.name], "", None))
    return out
