"""Why a mechanism cannot be assembled or moved as it was asked for, and where its constraints lose rank."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._types import Coordinates, Scalar, State
from ..system import AbstractSystem
from ..system.instant import Instant
from ..system.quantities import directions
from .consistency import listed

# Singular values, of rows of unit length, that count as zero.
_DEPENDENT = 1e-8
# Entries of a vector of unit length that count as zero.
_ZERO = 1e-6
# A mechanism is displaced by this part of its size to a pose beside a singular one, in so many Newton steps.
_BESIDE, _ITERATIONS = 0.03, 8
# Constraints are losing rank where rows of unit length have a singular value below this: at the end of a motion, and
# where a search for a configuration that does not exist has come to.
_LOST, _LOST_IN_SEARCH = 1e-3, 1e-2
# Joints take part in a loss of rank whose share of it is at least this part of the largest.
_SHARE = 0.05
# No matrix of more rows is decomposed for a message.
_MOST_ROWS = 2000


def violated_joints(system: AbstractSystem, t: Scalar, q: Coordinates, least: float = 1e-9) -> str:
    """The joints that a configuration violates with their largest residuals, the largest first, for messages.

    `least`: residuals below it, relative to the system's size, do not count.
    """
    residual = np.nan_to_num(np.abs(np.asarray(system.position_residual(t, q))), nan=np.inf)
    return listed(system, residual >= least * float(system.length), residual)


class _Held(NamedTuple):
    """Coordinates or rates that a user prescribed.

    **Fields:** the `names` of all; the `places` of the first of them in the vector; the `rows` of the constraints that
    hold the others, which are those of joints.
    """

    names: list[str]
    places: list[int]
    rows: list[int]

    def directions(self, jacobian: Float[np.ndarray, "m n"], least: float) -> Float[np.ndarray, "held free"]:
        """How they change in the motions that the constraints admit, from the Jacobian of all rows; singular values
        below the `least` are zero.
        """
        _, sizes, right = np.linalg.svd(np.delete(jacobian, self.rows, axis=0))
        motions = right[np.sum(sizes > least) :].T
        return np.concatenate([motions[self.places], jacobian[self.rows] @ motions])

    def dependent(self, jacobian: Float[np.ndarray, "m n"], least: float = _DEPENDENT) -> tuple[list[str], int]:
        """Those that the constraints determine, alone or from each other, and how many of them can be chosen.

        Rows of `directions` that depend on each other, or vanish, belong to numbers that cannot be chosen together.
        """
        left, sizes, _ = np.linalg.svd(self.directions(jacobian, least))
        combinations = left[:, np.sum(sizes > least) :]
        sizes = np.max(np.abs(combinations), axis=1, initial=0.0)
        together = [name for name, size in zip(self.names, sizes, strict=True) if size > _ZERO]
        return together, len(together) - combinations.shape[1]


def _unit_rows(matrix):
    return matrix / np.maximum(np.linalg.norm(matrix, axis=1, keepdims=True), 1e-300)


@eqx.filter_jit
def _linearised(system, t, q):
    """Residuals of coordinates, and their Jacobian in scaled coordinates."""
    return system.coordinate_residual(t, q), system.coordinate_jacobian(t, q) * system.coordinate_scale()[None, :]


def _directions(system, t, q):
    """Rows of the Jacobian of coordinates, in scaled coordinates and of unit length."""
    return _unit_rows(np.asarray(_linearised(system, t, q)[1]))


def _beside(system, t, q, free, rows=()):
    """A configuration near one that may be singular, on the constraints without these rows, and what remains of them.

    **Arguments:** `free`: a mask of the coordinates that may change.
    """
    scale = np.asarray(system.coordinate_scale()) * free
    q = np.asarray(q) + _BESIDE * scale * np.random.default_rng(0).uniform(-1.0, 1.0, q.size)
    for _ in range(_ITERATIONS):
        residual, jacobian = (np.delete(np.asarray(x), rows, axis=0) for x in _linearised(system, t, q))
        q = q - scale * np.linalg.lstsq(jacobian * free, residual, rcond=_DEPENDENT)[0]
    return q, np.max(np.abs(np.delete(_linearised(system, t, q)[0], rows)), initial=0.0)


def cannot_assemble(system: AbstractSystem, t: Scalar, q: Coordinates, fixed: Int[np.ndarray, "nq"]) -> str:
    """Why no configuration has the prescribed coordinates, from the closest one that was found.

    **Arguments:** the `system` with coordinates of joints held; `fixed`: a mask of the other prescribed coordinates.
    """
    names = system.coordinate_names()
    of_bodies = [name for name, index in names.items() if len(index) == 1 and fixed[index[0]]]
    # Coordinates of joints that are held are rows of their names.
    rows = [k for k, (name, _) in enumerate(system.rows) if name in system.joint_coordinates()]
    held = _Held([*of_bodies, *(system.rows[k][0] for k in rows)], [names[name][0] for name in of_bodies], rows)
    listing = ", ".join(dict.fromkeys(held.names))
    text = "The mechanism cannot be assembled" + (f" with {listing} fixed" if listing else "")
    violated = violated_joints(system, t, q)
    remain = f"residuals{' [m, rad]' if system.body_names else ''} remain in {violated}"
    if held.names:
        lost, _ = held.dependent(_directions(system, t, q), _LOST_IN_SEARCH)
        beside, _ = _beside(system, t, q, np.ones(q.size), rows)
        together, free = held.dependent(_directions(system, t, beside))
        if together:
            return f"{text}: {_dependence(together, free)}{f'; {remain}' if violated else ''}. Fix fewer of them."
        if lost and violated:
            if _beside(system, t, q, ~fixed)[1] < _ZERO * float(system.length):
                return (
                    f"{text}: the guess is at a dead centre of {' and '.join(lost)}, from which both sides are near; "
                    f"there {remain}. Give a guess beside it."
                )
            return (
                f"{text}: {_values(listing)} out of reach; in the closest configuration {remain}. Give other values, "
                "or check lengths, points and axes."
            )
        if lost:
            return (
                f"{text}: the configuration is singular there, at the end of the reach of {' and '.join(lost)} or at a "
                "dead centre, so that the motion from it is not determined. Give a value beside it, or fix another "
                "coordinate."
            )
    if violated:
        return f"{text}: {remain}. Check lengths, points and axes, or give a better guess."
    return (
        f"{text}: the configuration that is closest to the guess is singular, or not the only one. Give another guess "
        "of the positions."
    )


def _values(listing):
    return f"the values of {listing} are" if "," in listing else f"the value of {listing} is"


def _dependence(together, free):
    if len(together) == 1:
        return f"the constraints determine {together[0]} already"
    chosen = f"of these {len(together)} coordinates only {free} can be chosen" if free else "none of them can be chosen"
    return f"{', '.join(together[:-1])} and {together[-1]} depend on each other: {chosen}"


def cannot_move(at: Instant, fixed: Int[np.ndarray, "nu"]) -> str:
    """Why no velocities have the prescribed rates, from the closest ones that were found; arguments as in
    `cannot_assemble`.
    """
    system: Any = at.system
    of_system = directions(system.rate_names())
    places = [k for k in of_system if fixed[k]]
    coordinates = system.joint_coordinates()
    rows = [k for k, (name, _) in enumerate(system.rows[: system.velocity_rows]) if name in coordinates]
    held = _Held([*(of_system[k] for k in places), *(system.rows[k][0] for k in rows)], places, rows)
    residual = np.nan_to_num(np.abs(np.asarray(at.velocity_residual)), nan=np.inf)
    least = 1e-6 * np.max(residual)
    unmet = {name for (name, _), r in zip(system.rows, residual, strict=False) if r >= least} - set(held.names)
    unmet = ", ".join(sorted(unmet))
    text = f"No velocities satisfy {unmet}" if unmet else "There are no such velocities"
    if not held.names:
        return (
            f"{text}: the constraint rows are not independent in this configuration. Assemble another configuration, "
            "with fix or a guess."
        )
    text += f" with the rates {', '.join(dict.fromkeys(held.names))} fixed"
    scale = np.asarray(system.velocity_scale())
    jacobian, rates = np.asarray(at.jacobian) * scale, np.asarray(at.velocity_residual)
    at_rest = np.linalg.norm(held.directions(_unit_rows(jacobian), _DEPENDENT), axis=1) < _ZERO
    # How the rates that are held change on the way to velocities that satisfy the constraints alone.
    free_rows = np.setdiff1d(np.arange(rates.size), rows)
    change = np.linalg.lstsq(jacobian[free_rows], -rates[free_rows], rcond=_DEPENDENT)[0]
    changes = np.abs(np.append((scale * change)[places], jacobian[rows] @ change + rates[rows]))
    wrong = at_rest & (changes > _ZERO * np.max(changes, initial=0.0))
    if np.any(wrong):
        names = dict.fromkeys(name for name, is_wrong in zip(held.names, wrong, strict=True) if is_wrong)
        return (
            f"{text}: in this configuration the constraints determine {' and '.join(names)}, as at a dead centre. "
            "Assemble another configuration, with fix or a guess, or prescribe other rates."
        )
    return f"{text}: these contradict each other. Fix fewer rates, or others."


class LostRank(NamedTuple):
    """Where constraints lose rank.

    **Fields:** the `joints` whose rows become dependent there, the largest share first; those of them that are `drives`
    and prescribe a motion that the others cannot follow.
    """

    joints: list[str]
    drives: list[str]


def lost_rank(system: AbstractSystem, t: Scalar, y: State) -> LostRank | None:
    """Which rows become dependent at a state; None where the constraints keep their rank, or are too many.

    Rows n·A that nearly vanish are the combination of rows that is lost. Its right side is n·b, b the rates that drives
    prescribe: where it does not vanish with them, speeds grow without bound, and the drives are at the end of a reach.
    """
    if not 0 < system.acceleration_rank <= system.acceleration_rows <= _MOST_ROWS:
        return None
    q = system.normalize(y.q)
    jacobian = np.asarray(system.jacobian(t, q, y.u)) * np.asarray(system.velocity_scale())
    if not np.all(np.isfinite(jacobian)):
        return None
    lengths = np.maximum(np.linalg.norm(jacobian, axis=1), 1e-300)
    left, sizes, _ = np.linalg.svd(jacobian / lengths[:, None], full_matrices=False)
    if sizes[system.acceleration_rank - 1] >= _LOST:
        return None
    share = left[:, system.acceleration_rank - 1]
    prescribed = np.zeros_like(share)
    if system.linear and not system.drift_free:
        prescribed[: system.velocity_rows] = np.asarray(system.velocity_residual(t, q, jnp.zeros_like(y.u)))
    asked = np.abs(share * prescribed / lengths)
    # What the rows ask for together, relative to its terms.
    leaves = np.abs(np.sum(share * prescribed / lengths)) > _SHARE * np.sum(asked)
    of_drives = asked > _SHARE * np.max(asked, initial=0.0) if leaves else np.zeros(share.size, bool)
    by_share = lambda chosen: list(dict.fromkeys(system.rows[k][0] for k in np.argsort(-np.abs(share)) if chosen[k]))
    return LostRank(by_share(np.abs(share) > _SHARE * np.max(np.abs(share))), by_share(of_drives))
