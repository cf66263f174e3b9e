"""Non-stiff problems with accurate solutions, and curves of work against precision.

Sources: Kepler's problem, the Pleiades and Arenstorf's orbit are stated in E. Hairer, S. P. Nørsett and G. Wanner,
*Solving Ordinary Differential Equations I*, 2nd ed., sections II.0 and II.10 (the Pleiades also in the Bari test set
for initial value problem solvers). Reference values: Kepler from the closed form in 50 digits; the others from the
Gragg-Bulirsch-Stoer method in 200-bit arithmetic, confirmed by a second run in long double and by the published end
values.
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from jaxmb.solvers import Adams, MultistepController


class Problem(NamedTuple):
    vector_field: object
    y0: np.ndarray
    ts: np.ndarray
    ys: np.ndarray


def kepler(t, y, args):
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return jnp.stack([y[2], y[3], -y[0] / r3, -y[1] / r3])


def pleiades(t, y, args):
    x, y, velocities = y[:7], y[7:14], y[14:]
    dx, dy = x[None, :] - x[:, None], y[None, :] - y[:, None]
    r2 = dx**2 + dy**2 + jnp.eye(7, dtype=x.dtype)
    weights = jnp.arange(1, 8).astype(x.dtype)[None, :] / (r2 * jnp.sqrt(r2))
    return jnp.concatenate([velocities, jnp.sum(weights * dx, axis=1), jnp.sum(weights * dy, axis=1)])


def arenstorf(t, y, args):
    mu = 0.012277471
    x, y, u, v = y
    d1 = ((x + mu) ** 2 + y**2) ** 1.5
    d2 = ((x - 1 + mu) ** 2 + y**2) ** 1.5
    return jnp.stack(
        [
            u,
            v,
            x + 2 * v - (1 - mu) * (x + mu) / d1 - mu * (x - 1 + mu) / d2,
            y - 2 * u - (1 - mu) * y / d1 - mu * y / d2,
        ]
    )


def _rows(columns, text):
    return np.array(text.split(), float).reshape(-1, columns)


PROBLEMS = {
    "kepler 0.6": Problem(
        kepler,
        np.array([0.4, 0.0, 0.0, 2.0]),
        np.array([1.0, 5.0, 10.0, 20.0]),
        _rows(
            4,
            """
            -0.6289481768266242 0.7996647309700393 -0.9825156909388113 -0.02276317009743042
            -0.8837707793862566 -0.7671137155927865 0.8193821223981331 -0.19398778461076005
            -1.5350235919098136 -0.28366840649978087 0.22715073207749834 -0.47918775820321957
            -0.7700755784112404 0.7883448169944244 -0.8941837319886915 -0.12346176415844096
            """,
        ),
    ),
    "kepler 0.9": Problem(
        kepler,
        np.array([0.1, 0.0, 0.0, 4.358898943540674]),
        np.array([1.0, 5.0, 10.0, 20.0]),
        _rows(
            4,
            """
            -1.1871884663458634 0.41752763873976423 -0.7611420105214913 -0.09947204787027349
            -1.380781260850224 -0.38220594193562857 0.6120183206915482 -0.1462743313071374
            -1.8538537094055791 -0.13088540483992556 0.16156945255843133 -0.2237192767918971
            -1.2952662509875743 0.4003938963792322 -0.6775390924707566 -0.12708381542786862
            """,
        ),
    ),
    "pleiades": Problem(
        pleiades,
        np.array([3, 3, -1, -3, 2, -2, 2, 3, -3, 2, 0, 0, -4, 4, 0, 0, 0, 0, 0, 1.75, -1.5, 0, 0, 0, -1.25, 1, 0, 0]),
        np.array([1.0, 2.0, 3.0]),
        _rows(
            28,
            """
            1.4870785157342021 2.7039177142659843 -0.6079760490031101 -2.622479773000867 1.7375571608154041
            -0.18030218239287416 0.544708655003836 3.3963540545071655 -2.7026408145154366 1.8786895377778814
            -1.2360283955156757 1.2252086953576529 -3.7069995626022716 3.490418063154019 -3.5963207421338668
            -0.6528831932578206 0.9973484969629244 0.7725982030167615 -0.642388833711975 1.8640148037476876
            -1.307499404033223 0.46178309196512884 0.545295959100122 -0.05967133846512632 -1.2076883070364257
            1.5371964735409338 0.6182096582841297 -1.1339782977191053 -0.7929207120460273 1.362639151238091
            -0.36851833505657156 -1.3969179557090432 0.3390993679259247 1.700536850184118 -0.1625498147369427
            0.4794025185477475 -2.740594876076597 3.79924157876518 -2.3272553453568636 2.316021904550835
            -2.4689769857382537 1.8781194672018158 -0.2358139538592481 1.4083472785667714 -3.227626141706306
            1.7155195669841492 -2.8429612343342927 0.6510052737890205 1.5069562975493382 -4.577666832372622
            -3.376899913486554 2.363009081627689 -0.8823881740812872 -0.32706147435745336 2.7727306129478295
            -1.032726313587414 0.37061391439705127 3.237284092057233 -3.2225590324183235 0.6597091455775308
            0.342558170715658 1.5621721014006311 -0.7003092922212495 -3.943437585517392 -3.27138097397255
            5.225081843456544 -2.5906124349774693 1.1982136933922747 -0.24296823449358235 1.0914492404289797
            3.4170038063143147 1.3545845016255011 -2.5900655978107756 2.025053734714241 -1.155815100160449
            -0.8072988170223022 0.5952396354208719 -3.7412449612340084 0.3773459685750629 0.9386858869551079
            0.36679222272005696 -0.3474046353808494 2.344915448180937 -1.947020434263292
            """,
        ),
    ),
    "arenstorf": Problem(
        arenstorf,
        np.array([0.994, 0.0, 0.0, -2.0015851063790824]),
        np.array([5.0, 10.0, 15.0, 17.0]),
        _rows(
            4,
            """
            0.022688783647977124 0.8665401401712473 -0.1177364786408644 -0.42178580416287775
            -0.8398071663389864 0.4468314170984721 0.37374253561439386 -0.14966964466689517
            -0.6055754904375742 -0.6258670291299465 0.36591446387862386 0.2704436108036588
            0.9412992937213113 0.035312350938413346 0.6983751692181785 -0.18529228333312175
            """,
        ),
    ),
}


def solve(problem, tolerance, solver, controller, saveat):
    return diffrax.diffeqsolve(
        diffrax.ODETerm(problem.vector_field),
        solver,
        0.0,
        problem.ts[-1],
        None,
        jnp.asarray(problem.y0),
        stepsize_controller=controller(rtol=tolerance, atol=tolerance),
        saveat=saveat,
        max_steps=None,
        adjoint=diffrax.ForwardMode(),
    )


def work_precision(problem, tolerances, *, solver="adams"):
    """`(largest error at the sample times, evaluations)` for each tolerance."""

    def run(tolerance):
        ts = jnp.asarray(problem.ts)
        if solver == "adams":
            solution = solve(problem, tolerance, Adams(), MultistepController, diffrax.SaveAt(ts=ts))
            evaluations = 2 * solution.stats["num_steps"]
        else:
            solution = solve(problem, tolerance, diffrax.Dopri8(), diffrax.PIDController, diffrax.SaveAt(ts=ts))
            # Fourteen stages, of which the first is the last of the step before.
            evaluations = 1 + 13 * solution.stats["num_steps"]
        return jnp.max(jnp.abs(solution.ys - problem.ys)), evaluations

    errors, evaluations = jax.jit(lambda: jax.lax.map(run, jnp.asarray(tolerances)))()
    return np.asarray(errors), np.asarray(evaluations, dtype=float)


def evaluations_at(errors_wanted, errors, evaluations):
    """Evaluations needed for an error, from a cubic through the logarithms: single runs are lucky or unlucky."""
    inside = (errors > 2e-11) & (errors < 3e-4)
    fit = np.polyfit(np.log10(errors[inside]), np.log10(evaluations[inside]), 3)
    return 10 ** np.polyval(fit, np.log10(errors_wanted))
