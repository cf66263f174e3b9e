"""Chains of rods: a pendulum of many links."""

import numpy as np

from .. import planar
from ..parts.forces import Gravity
from ..scene import Scene
from .mechanism import Mechanism, References, build, mechanism, point_motion


@mechanism(variants=("n",))
def rod_chain(*, n: int = 10, length: float = 1.0, mass: float = 1.0, gravity: float = 9.81) -> Mechanism:
    """A hanging chain of n equal uniform slender rods, released from rest with all links horizontal; y up, the pin in
    the origin.

    The motion is chaotic: errors grow by orders of magnitude a second. The reference values, for n = 2, 5, 10 and 50,
    are solutions in absolute angles in extended precision, checked by a solution with Lagrange multipliers.

    **Arguments:** `n` ≥ 1, the number of links; `length` [m] and `mass` [kg] of the whole chain; `gravity` [m/s²].

    **Labels:** `tip_x`, `tip_y` [m], of the free end; `th1`, `th2`, … [rad], angles of the links from the downward
    vertical, counter-clockwise; `w1`, `w2`, … [rad/s], their rates.
    """
    if n < 1:
        raise ValueError(f"rod_chain needs n ≥ 1 links, got {n}.")
    l, m = length / n, mass / n
    links = [
        planar.Body(f"link{k}", mass=m, inertia=planar.rod(m, l), position=((k - 0.5) * l, 0.0))
        for k in range(1, n + 1)
    ]
    pins = [planar.Revolute("pin1", "ground", "link1", point_a=(0.0, 0.0), point_b=(-l / 2, 0.0))]
    pins += [
        planar.Revolute(f"pin{k}", f"link{k - 1}", f"link{k}", point_a=(l / 2, 0.0), point_b=(-l / 2, 0.0))
        for k in range(2, n + 1)
    ]
    scene = Scene(links, joints=pins, forces=[Gravity((0.0, -gravity))])
    references = _REFERENCES.get(n)
    return build(
        "rod_chain",
        scene,
        t1=1.0 if references is None else references.times[-1],
        observe=lambda trajectory: _observe(trajectory, n, l),
        description=f"Chain of {n} uniform slender rods, released horizontally from rest.",
        references=references,
    )


def _observe(trajectory, n, l):
    tip, _ = point_motion(trajectory, f"link{n}", (0.5 * l, 0.0))
    observed = {"tip_x": tip[:, 0], "tip_y": tip[:, 1]}
    for k in range(1, n + 1):
        link = trajectory[f"link{k}"]
        observed[f"th{k}"] = link.angle + 0.5 * np.pi
        observed[f"w{k}"] = link.angular_velocity
    return observed


_SOURCE = "absolute angles, extrapolation method in extended precision"
_REFERENCES = {
    2: References(
        times=np.array([1.0, 2.0]),
        labels=("tip_x", "tip_y", "th1", "th2", "w1", "w2"),
        values=np.array(
            [
                [
                    -0.9644093773117354,
                    0.04204958572456186,
                    -1.350261778148876,
                    -1.878478450966098,
                    2.9735499306733817,
                    -4.376269959417478,
                ],
                [
                    0.8079119780633186,
                    -0.403485219760747,
                    1.5515638990145482,
                    0.663666071803835,
                    -2.4521542786375345,
                    -3.255392814378145,
                ],
            ]
        ),
        source=_SOURCE,
        tolerance=1e-11,
    ),
    5: References(
        times=np.array([0.5, 1.0]),
        labels=("tip_x", "tip_y", "th1", "th2", "th3", "th4", "th5"),
        values=np.array(
            [
                [
                    -0.2574823505190386,
                    -0.8908970005529215,
                    0.003294966148637124,
                    -0.04659848084514216,
                    0.03136363203791448,
                    -0.4651543219366872,
                    -0.9736131778837868,
                ],
                [
                    -0.8845809500604355,
                    -0.1080054547367171,
                    -1.0563006542088123,
                    -1.5924899271792905,
                    -2.3077354773008776,
                    -1.3876914181266224,
                    -0.9769363720738655,
                ],
            ]
        ),
        source=_SOURCE,
        tolerance=1e-12,
    ),
    10: References(
        times=np.array([0.5, 1.0]),
        labels=("tip_x", "tip_y", "th1", "th2", "th3", "th4", "th5", "th6", "th7", "th8", "th9", "th10"),
        values=np.array(
            [
                [
                    -0.26464511200183777,
                    -0.8635467547502826,
                    0.043169386820875205,
                    -0.07842155331928528,
                    0.02273066454750015,
                    0.03157121780399717,
                    -0.19325454296502312,
                    -0.08095807829821249,
                    -0.10653085311945527,
                    -0.49374646299654656,
                    -1.0058408908847083,
                    -1.3162074418197618,
                ],
                [
                    -0.89431685236128,
                    -0.14656506474688316,
                    -0.9249367092940258,
                    -1.2374257835120521,
                    -1.841369456773228,
                    -2.1494406949721325,
                    -1.7786527054824843,
                    -1.8546887549383713,
                    -1.0618102051655127,
                    -1.3761146355983798,
                    -1.0916286473406014,
                    -0.8018491093798432,
                ],
            ]
        ),
        source=_SOURCE,
        tolerance=1e-12,
    ),
    50: References(
        times=np.array([0.5]),
        labels=("tip_x", "tip_y", *(f"th{k}" for k in range(1, 51))),
        values=np.array(
            [
                [
                    -0.2624074637346561,
                    -0.8376926179907607,
                    0.010947924248163333,
                    -0.00724048842091053,
                    0.004281531326584893,
                    0.01606194689300801,
                    -0.00864980053992142,
                    -0.0025362854995771896,
                    0.013645186010647615,
                    -0.005064959397495275,
                    -0.016237604650500122,
                    0.008226358769482396,
                    -0.004835408135583827,
                    -0.024814010924470872,
                    -0.011780871550848613,
                    -0.009001576777814334,
                    -0.0274111105811607,
                    -0.03922844519642954,
                    -0.027386343136650105,
                    -0.025243624986769762,
                    -0.05570578707411734,
                    -0.06741259665565573,
                    -0.03375663168062124,
                    -0.05909402426251304,
                    -0.0997604490140036,
                    -0.0847932776024325,
                    -0.06584046482321526,
                    -0.09759978764841129,
                    -0.15387046967839202,
                    -0.12997352673382656,
                    -0.08712408891421566,
                    -0.166357472349345,
                    -0.24056881932882979,
                    -0.17893701580926072,
                    -0.1245754054176981,
                    -0.2806764579484632,
                    -0.37148032729046876,
                    -0.23636751262307504,
                    -0.22978813385396918,
                    -0.4656382880199251,
                    -0.5501231590159005,
                    -0.4250778933866645,
                    -0.4440753910894195,
                    -0.6971946554068714,
                    -1.0123144225902754,
                    -1.2503928726900748,
                    -1.4025203956756185,
                    -1.5173418772768223,
                    -1.6197156544857798,
                    -1.6327977888338019,
                    -1.5426955595737948,
                    -1.7201478151676222,
                ]
            ]
        ),
        source=_SOURCE,
        tolerance=1e-12,
    ),
}
