"""The hanging chain."""

import jax.numpy as jnp
import numpy as np

from .. import planar
from ..bodies.scene import Scene
from ..parts.forces import Gravity
from .mechanism import Mechanism, References, build, mechanism
from .observe import columns


@mechanism()
def hanging_chain(
    *,
    n: int = 5,
    length: float = 1.0,
    mass: float = 1.0,
    mode: int = 2,
    amplitude: float = 0.1,
    gravity: float = 9.81,
) -> Mechanism:
    """n equal masses on massless rods hang from the origin, released in the shape of a mode; y up.

    Small oscillations of the k-th mode have the frequency `√(g x_k / l)`, with l the length of a rod and x_k the k-th
    zero of Laguerre's polynomial L_n. The masses are displaced in proportion to `L_j(x_k)`, j counted from the lowest.
    For many masses the frequencies tend to a chain's, `j_k √(g / length) / 2`, with the zeros j_k of Bessel's J_0.

    Source: D. Bernoulli, Theoremata de oscillationibus corporum filo flexili connexorum et catenae verticaliter
    suspensae, Comm. Acad. Sci. Petropol. 6, 1738. The reference values, of large oscillations, come from a model in the
    rods' angles.

    **Arguments:** `n` ≥ 1; `length` [m] and `mass` [kg] of the whole chain; `mode` k, 1 … n; `amplitude` [m],
    the largest displacement to the side; `gravity` [m/s²].

    **Labels:** `x`, `y` [m] of the lowest mass; `angle1`, `angle2`, … [rad] of the rods from the downward vertical.
    """
    if n < 1 or not 1 <= mode <= n:
        raise ValueError(f"hanging_chain needs n ≥ 1 masses and a mode of 1 … n, got n = {n} and mode {mode}.")
    l = length / n
    # The matrix of the polynomials' recurrence, and of the chain's stiffness: L_0, L_1, … at zeros of L_n.
    j = np.arange(n)
    below = np.diag(j[1:], 1)
    shape = np.linalg.eigh(np.diag(2 * j + 1) - below - below.T)[1][:, mode - 1]
    x = amplitude * np.sign(shape[0]) * shape[::-1] / np.max(np.abs(shape))
    across = np.diff(x, prepend=0.0) / l
    if np.max(np.abs(across)) >= 1:
        raise ValueError(f"An amplitude of {amplitude} m is too much for rods of {l} m in mode {mode}.")
    y = -np.cumsum(l * np.sqrt(1 - across**2))
    masses = [planar.PointMass(f"mass{k + 1}", mass=mass / n, position=(x[k], y[k])) for k in range(n)]
    above = ["ground", *(body.name for body in masses)]
    rods = [planar.Distance(f"rod{k + 1}", above[k], above[k + 1], length=l) for k in range(n)]
    return build(
        "hanging_chain",
        Scene(masses, joints=rods, forces=[Gravity((0.0, -gravity))]),
        t1=2.0,
        observe=lambda trajectory: _observe(trajectory, n),
        description=f"Chain of {n} masses, released in its mode {mode} of small oscillations (Bernoulli).",
        references=References.load("hanging_chain"),
    )


def _observe(trajectory, n):
    places = jnp.stack([trajectory[f"mass{k + 1}"].position for k in range(n)])
    along = jnp.diff(places, axis=0, prepend=jnp.zeros_like(places[:1]))
    return columns("xy", places[-1]) | {f"angle{k + 1}": jnp.arctan2(along[k, :, 0], -along[k, :, 1]) for k in range(n)}
