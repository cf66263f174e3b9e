"""Stiff problems with accurate solutions.

Sources: van der Pol's equation, Robertson's reaction and HIRES are stated in E. Hairer and G. Wanner, *Solving Ordinary
Differential Equations II*, 2nd ed., sections IV.1 and IV.10, and in the Bari test set for initial value problem
solvers. Reference values: Radau's method of order 13 in long double (Robertson in `y1 + y2` and `y2`), confirmed by
that of order 9 and by the published end values.
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from jaxmb.solvers import Hermite, MultistepController


class Problem(NamedTuple):
    """`relative` is the absolute tolerance of each component over the relative one."""

    vector_field: object
    args: object
    y0: np.ndarray
    t1: float
    y1: np.ndarray
    relative: object


def van_der_pol(t, y, mu):
    return jnp.stack([y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]])


def scaled_van_der_pol(t, y, mu):
    return jnp.stack([y[1], mu * ((1 - y[0] ** 2) * y[1] - y[0])])


def robertson(t, y, rates):
    slow, middle, fast = rates[0] * y[0], rates[1] * y[1] * y[2], rates[2] * y[1] ** 2
    return jnp.stack([-slow + middle, slow - middle - fast, fast])


def hires(t, y, args):
    y1, y2, y3, y4, y5, y6, y7, y8 = y
    bound = 280.0 * y6 * y8
    return jnp.stack(
        [
            -1.71 * y1 + 0.43 * y2 + 8.32 * y3 + 0.0007,
            1.71 * y1 - 8.75 * y2,
            -10.03 * y3 + 0.43 * y4 + 0.035 * y5,
            8.32 * y2 + 1.71 * y3 - 1.12 * y4,
            -1.745 * y5 + 0.43 * y6 + 0.43 * y7,
            -bound + 0.69 * y4 + 1.71 * y5 - 0.43 * y6 + 0.69 * y7,
            bound - 1.81 * y7,
            -bound + 1.81 * y7,
        ]
    )


PROBLEMS = {
    "van der Pol 1e3": Problem(
        van_der_pol,
        1e3,
        np.array([2.0, 0.0]),
        2000.0,
        np.array([1.706167732170465, -0.0008928097010248172]),
        1.0,
    ),
    "van der Pol 1e6": Problem(
        scaled_van_der_pol,
        1e6,
        np.array([2.0, 0.0]),
        2.0,
        np.array([1.706167732170465, -0.8928097010248169]),
        1.0,
    ),
    "Robertson": Problem(
        robertson,
        np.array([0.04, 1e4, 3e7]),
        np.array([1.0, 0.0, 0.0]),
        100000000000.0,
        np.array([2.083340149701294e-08, 8.333360770334784e-14, 0.9999999791665152]),
        np.array([1e-8, 1e-14, 1e-8]),
    ),
    "HIRES": Problem(
        hires,
        None,
        np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0057]),
        321.8122,
        np.array(
            [
                0.0007371312573325542,
                0.00014424857263161596,
                5.888729740967339e-05,
                0.0011756513432831254,
                0.002386356198830949,
                0.0062389682527415995,
                0.002849998395185502,
                0.0028500016048144984,
            ]
        ),
        1e-5,
    ),
}


def solve(problem, rtol, solver=None, **kwargs):
    """A stiff problem to its end."""
    return diffrax.diffeqsolve(
        diffrax.ODETerm(problem.vector_field),
        Hermite() if solver is None else solver,
        0.0,
        problem.t1,
        None,
        jnp.asarray(problem.y0),
        stepsize_controller=MultistepController(rtol, rtol * problem.relative),
        saveat=diffrax.SaveAt(t1=True, solver_state=True),
        **{
            "args": jax.tree.map(jnp.asarray, problem.args),
            "adjoint": diffrax.ForwardMode(),
            "max_steps": 20000,
            **kwargs,
        },
    )
