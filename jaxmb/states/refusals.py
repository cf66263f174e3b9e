"""Why a mechanism cannot be assembled or moved as prescribed, in words, and where its constraints lose rank."""

from collections.abc import Callable, Iterable
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

# Singular values of rows of unit length below this count as zero.
_DEPENDENT = 1e-8
# Entries of a vector of unit length below this count as zero.
_ZERO = 1e-6
# The displacement to a pose beside a singular pose, relative to the mechanism's size, and its number of Newton steps.
_BESIDE, _ITERATIONS = 0.03, 8
# Constraints lose rank if rows of unit length have a singular value below this: at the end of a motion, and at the end
# of a search for a configuration that does not exist.
_LOST, _LOST_IN_SEARCH = 1e-3, 1e-2
# The smallest share of a joint that counts in a loss of rank, relative to the largest share.
_SHARE = 0.05
# The largest number of joints that are left out one after the other; the number of steps of each search for the others,
# and the longest step; and the share of a displacement that is much less.
_MOST_JOINTS, _SEARCHED, _LONGEST, _NEARER = 30, 60, 0.3, 0.1
# The largest number of rows of a matrix that is decomposed for a message.
_MOST_ROWS = 2000


def violated_joints(system: AbstractSystem, t: Scalar, q: Coordinates, least: float = 1e-9) -> str:
    """The violated joints of a configuration with their largest residuals, the largest first, for messages.

    **Arguments:** `least`: the smallest residual that counts, relative to the system's size.
    """
    residual = np.nan_to_num(np.abs(np.asarray(system.position_residual(t, q))), nan=np.inf)
    return listed(system, residual >= least * float(system.length), residual)


def without_a_joint(system: AbstractSystem, t: Scalar, q: Coordinates) -> str:
    """Which joint, left out, lets the rest of a mechanism close, and how far it then is from closing, as sentences;
    empty if no single joint does. In a loop the closest configuration spreads a gap over all joints.

    **Arguments:** `q`: the poses from which the search starts.
    """
    rows = system.rows[: system.position_rows]
    names = list(dict.fromkeys(name for name, _ in rows))
    if not 2 <= len(names) <= _MOST_JOINTS:
        return ""
    start: Any = np.asarray(q)
    of_joint = {name: np.array([k for k, (other, _) in enumerate(rows) if other == name]) for name in names}
    scale, host = np.asarray(system.coordinate_scale()), system.on_host(t)
    if host is None:
        at = lambda q: (np.asarray(x) for x in _linearised(system, t, q))
    else:
        at = lambda q: (host.coordinate_residual(q), host.coordinate_jacobian(q) * scale)
    closing = _Closing(at, scale, _ZERO * float(system.length))
    found = {}
    for name in names:
        closed = closing.without(start, of_joint[name])
        if closed is not None:
            found[name] = float(np.max(np.abs((closed - start) / scale))), closed
    if not found:
        return ""
    nearest = min(found, key=lambda name: found[name][0])
    least, closed = found[nearest]
    gap = f"by about {closing.least_gap(closed, of_joint[nearest]):.3g} [m, rad]"
    if all(least < _NEARER * moved for name, (moved, _) in found.items() if name != nearest):
        return f" Without {nearest} the other joints close, and it then misses {gap}: check it first."
    return f" Without any one of {', '.join(found)} the others close; the lengths between them miss {gap}."


class _Closing(NamedTuple):
    """The search for configurations in which constraints hold.

    **Fields:** `at(q)`: residuals, and their Jacobian in scaled coordinates; the `scale` of the coordinates; residuals
    up to `zero` vanish.
    """

    at: Callable[[Any], Iterable[Any]]
    scale: Float[np.ndarray, "nq"]
    zero: float

    def without(self, q: Any, rows: Int[np.ndarray, "k"]) -> Any:
        """The configuration near another in which all but these rows hold; None if the search finds none."""
        for _ in range(_SEARCHED):
            residual, jacobian = (np.delete(x, rows, axis=0) for x in self.at(q))
            if np.max(np.abs(residual), initial=0.0) < self.zero:
                return q
            if not np.all(np.isfinite(jacobian)):
                break
            q = self._moved(q, np.linalg.lstsq(jacobian, -residual, rcond=_DEPENDENT)[0])
        return None

    def _moved(self, q, step):
        return q + self.scale * step * min(1.0, _LONGEST / max(np.max(np.abs(step)), 1e-300))

    def least_gap(self, q: Any, rows: Int[np.ndarray, "k"]) -> float:
        """The smallest norm of the residuals of these rows while the others hold, from a configuration where these do:
        by the method of Gauss and Newton along the motions that they allow.
        """
        least = np.inf
        for _ in range(_SEARCHED):
            residual, jacobian = self.at(q)
            size = float(np.linalg.norm(residual[rows]))
            if size >= least * (1 - _ZERO):
                break
            least = size
            others = np.delete(jacobian, rows, axis=0)
            allowed = np.eye(q.size) - np.linalg.pinv(others, rcond=_DEPENDENT) @ others
            step = allowed @ np.linalg.lstsq(jacobian[rows] @ allowed, -residual[rows], rcond=_DEPENDENT)[0]
            back = self.without(self._moved(q, step), rows)
            if back is None:
                break
            q = back
        return least


class _Held(NamedTuple):
    """Coordinates or rates that a user prescribed: first of the system, then of joints.

    **Fields:** all `names`; `places`: indices of the system's numbers in the vector; `rows`: constraint rows that hold
    the joints' numbers.
    """

    names: list[str]
    places: list[int]
    rows: list[int]

    def directions(self, jacobian: Float[np.ndarray, "m n"], least: float) -> Float[np.ndarray, "held free"]:
        """Rates of the prescribed numbers in the motions that the constraints admit.

        **Arguments:** the `jacobian` of all rows; `least`: the smallest singular value that is not zero.
        """
        _, sizes, right = np.linalg.svd(np.delete(jacobian, self.rows, axis=0))
        motions = right[np.sum(sizes > least) :].T
        return np.concatenate([motions[self.places], jacobian[self.rows] @ motions])

    def dependent(self, jacobian: Float[np.ndarray, "m n"], least: float = _DEPENDENT) -> tuple[list[str], int]:
        """Names of numbers that the constraints determine, alone or from each other, and how many of them are free.

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
    """The coordinates' residual, and its Jacobian in scaled coordinates."""
    return system.coordinate_residual(t, q), system.coordinate_jacobian(t, q) * system.coordinate_scale()[None, :]


def _directions(system, t, q):
    """Rows of unit length of the coordinates' Jacobian, in scaled coordinates."""
    return _unit_rows(np.asarray(_linearised(system, t, q)[1]))


def _beside(system, t, q, free, rows=()):
    """A configuration beside a possibly singular configuration, and the largest remaining residual.

    **Arguments:** `free`: a mask of the coordinates that may change; `rows`: constraint rows that need not hold.
    """
    scale = np.asarray(system.coordinate_scale()) * free
    q = np.asarray(q) + _BESIDE * scale * np.random.default_rng(0).uniform(-1.0, 1.0, q.size)
    for _ in range(_ITERATIONS):
        residual, jacobian = (np.delete(np.asarray(x), rows, axis=0) for x in _linearised(system, t, q))
        q = q - scale * np.linalg.lstsq(jacobian * free, residual, rcond=_DEPENDENT)[0]
    return q, np.max(np.abs(np.delete(_linearised(system, t, q)[0], rows)), initial=0.0)


def cannot_assemble(system: AbstractSystem, t: Scalar, q: Coordinates, fixed: Int[np.ndarray, "nq"]) -> str:
    """Why no configuration has the prescribed coordinates, as a message.

    **Arguments:** the `system` with coordinates of joints held; `q`: the closest configuration of the search; `fixed`:
    a mask of the prescribed coordinates of the system.
    """
    names = system.coordinate_names()
    of_bodies = [name for name, index in names.items() if len(index) == 1 and fixed[index[0]]]
    # Held coordinates of joints are rows with the coordinates' names.
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
        alone = "" if held.names else without_a_joint(system, t, system.guess.q)
        return f"{text}: {remain}. Check lengths, points and axes, or give a better guess.{alone}"
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
    """Why no velocities have the prescribed rates, as a message; arguments as in `cannot_assemble`."""
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
    # Changes of the held rates on the way to velocities that satisfy the constraints alone.
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
    """A loss of rank of constraints.

    **Fields:** the `joints` whose rows become dependent, the largest share first; `drives`: joints among them with a
    prescribed motion that the remaining joints cannot follow.
    """

    joints: list[str]
    drives: list[str]


def lost_rank(system: AbstractSystem, t: Scalar, y: State) -> LostRank | None:
    """The rows that become dependent at a state; None if the constraints keep their rank, or are too many.

    A nearly vanishing combination n·A of rows is lost. Its right side is n·b, with the rates b that drives prescribe.
    If n·b does not vanish, speeds grow without bound, and the drives are at the end of their reach.
    """
    if not 0 < system.acceleration_rank <= system.acceleration_rows <= _MOST_ROWS:
        return None
    q = system.normalize(t, y.q)
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
    # Whether n·b is not zero, relative to its terms.
    leaves = np.abs(np.sum(share * prescribed / lengths)) > _SHARE * np.sum(asked)
    of_drives = asked > _SHARE * np.max(asked, initial=0.0) if leaves else np.zeros(share.size, bool)
    by_share = lambda chosen: list(dict.fromkeys(system.rows[k][0] for k in np.argsort(-np.abs(share)) if chosen[k]))
    return LostRank(by_share(np.abs(share) > _SHARE * np.max(np.abs(share))), by_share(of_drives))
