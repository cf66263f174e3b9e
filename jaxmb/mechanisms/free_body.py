"""A rigid body that tumbles freely."""

import numpy as np

from .. import spatial
from ..scene import Scene
from .mechanism import Mechanism, References, build, mechanism


@mechanism()
def free_body(
    *,
    mass: float = 1.0,
    inertia: tuple[float, float, float] = (1.0, 2.0, 3.0),
    angular_velocity: tuple[float, float, float] = (0.1, 2.0, 0.1),
) -> Mechanism:
    """A rigid body without forces, spinning about its middle axis, which is unstable: it turns over again and again.

    The reference values are Jacobi's elliptic functions (angular velocity), and a quaternion solution in extended
    precision.

    **Arguments:** `mass` [kg]; `inertia` [kg m²], principal moments, shape (3,); `angular_velocity` [rad/s] at the
    start, body frame, shape (3,).

    **Labels:** `q0` … `q3`, Euler parameters, scalar first, from (1, 0, 0, 0); `w1`, `w2`, `w3` [rad/s], angular
    velocity in the body frame.
    """
    body = spatial.Body("body", mass=mass, inertia=np.asarray(inertia, dtype=float))
    return build(
        "free_body",
        Scene([body]),
        t1=20.0,
        observe=_observe,
        description="A free rigid body that tumbles about its unstable middle axis.",
        references=_REFERENCES,
        rates={"body.angular_velocity": angular_velocity},
    )


def _observe(trajectory):
    body = trajectory["body"]
    observed = {f"q{k}": body.orientation[:, k] for k in range(4)}
    return observed | {f"w{k + 1}": body.angular_velocity[:, k] for k in range(3)}


_REFERENCES = References(
    times=np.array([5.0, 10.0, 20.0]),
    labels=("q0", "q1", "q2", "q3", "w1", "w2", "w3"),
    values=np.array(
        [
            [
                0.07412350700324709,
                0.20907947706036978,
                -0.2727237260413123,
                -0.9361694543381797,
                -1.2067742211780683,
                -1.5980287791839256,
                0.7014993516033908,
            ],
            [
                -0.2979669611086061,
                0.9453572901864222,
                0.11484622844040698,
                -0.06576950503159311,
                1.1050666344174247,
                -1.6699783631823937,
                0.643213874876948,
            ],
            [
                0.13043801333414295,
                -0.9233489807593129,
                0.037863237240628365,
                -0.35913640817082254,
                -0.3845290271823763,
                -1.9652321560706705,
                0.23654638216484092,
            ],
        ]
    ),
    source="Jacobi's elliptic functions and a quaternion solution in extended precision",
    tolerance=1e-14,
)
