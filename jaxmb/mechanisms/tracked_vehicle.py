"""Tracked vehicles with sprung road wheels in the plane, one or two coupled."""

import dataclasses
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from .. import planar
from .._types import State, VectorLike
from ..bodies.scene import Scene
from ..parts import contact
from ..parts.coordinate_parts import JointStop
from ..parts.forces import Gravity
from ..parts.functions import Force
from ..parts.terrain import AbstractTerrain, Bump
from ..states.equilibrium import equilibrium
from ..system import parameters
from ._shoe_track import Shoes, running, shoe_track, undriven
from ._wheel_contact import WheelContact
from .mechanism import Mechanism, References, build, mechanism
from .ride import PREFIXES, arm_travel

# Arm pivots of five wheels, in the hull [m]; for other numbers of wheels the pivots lie evenly between the outer two.
_PIVOTS = np.array([(1.639, -0.487), (0.972, -0.487), (0.305, -0.487), (-0.362, -0.487), (-1.028, -0.487)])


@mechanism(variants=("units",))
def tracked_vehicle(
    *,
    n_wheels: int = 5,
    units: Literal[1, 2] = 1,
    track: Literal["loop", "shoes"] | Shoes = "loop",
    speed: float = 5.0,
    torque: float = 3000.0,
    terrain: AbstractTerrain | None = None,
    hull_mass: float = 7819.24,
    hull_inertia: float = 27287.61,
    arm_mass: float = 150.52,
    arm_inertia: float | None = None,
    wheel_mass: float = 300.0,
    wheel_inertia: float = 14.0,
    radius: float = 0.305,
    trail: float = 0.288,
    drop: float = 0.134,
    pivots: VectorLike | None = None,
    sprocket: VectorLike = (2.006, -0.406),
    idler: VectorLike = (-1.824, -0.526),
    torsion_stiffness: float = 5e4,
    torsion_damping: float = 5e3,
    stop_angle: float = 0.6,
    stop_stiffness: float = 2e6,
    pretension: float = 1.5e4,
    track_stiffness: float = 4e5,
    ground_stiffness: float = 8e5,
    ground_damping: float = 2e4,
    friction: float = 0.7,
    transition_speed: float = 0.3,
    hitch_rear: VectorLike = (-2.4, -0.2),
    hitch_front: VectorLike = (2.4, -0.2),
    hitch_stiffness: float = 2e5,
    hitch_damping: float = 2e4,
    gravity: float = 9.81,
) -> Mechanism:
    """A tracked carrier that drives over a bump, with 3 + 2 n_wheels degrees of freedom. The hull rests on trailing
    road arms with torsion bars and bump stops, and road wheels on compliant ground. The track is an elastic loop around
    wheels, sprocket and idler, all of one radius. With `units=2` it tows another carrier by a hitch, which removes two
    degrees of freedom.

    It starts in static equilibrium without drive, moving forward with rolling wheels. One body represents a left and
    right pair; x is forward, y up.

    With `track="shoes"` every shoe is a body. Shoes on pins run in a closed loop around a driven sprocket, an idler on
    a tensioner and the wheels. Contact on these and on the ground is compliant, with friction. With n shoes there are n
    + 6 + 2 n_wheels degrees of freedom. The shoes are laid around the discs without sag. A simulation without drive
    brings them nearly to rest, hanging down, and then they run at the vehicle's speed.

    Source: the kind of vehicle of R. A. Wehage and E. J. Haug, "Generalized Coordinate Partitioning for Dimension
    Reduction in Analysis of Constrained Dynamic Systems", J. Mech. Design 104(1), 1982, with 13 and 24 degrees of
    freedom; dimensions and masses close to the M113 model of Project Chrono. The reference values were computed in
    minimal coordinates by a Runge–Kutta method of order 8.

    **Arguments:**

    - `n_wheels` ≥ 1; `track`: `"loop"`, `"shoes"`, or `Shoes(...)` with numbers; `speed` [m/s].
    - `torque` [N m] of the drive of each unit, shared by its wheels, or on its sprocket, with its reaction on the hull.
    - `terrain`, default a bump of 0.12 m from 4 m to 5.5 m.
    - masses [kg] and inertias [kg m²]; the default `arm_inertia` is a rod's plus 1.54.
    - `radius` [m] of the wheels; `trail` and `drop` [m] of a wheel behind and below its pivot in the design position;
        `pivots` [m], shape (n_wheels, 2), `sprocket` and `idler` [m] in the hull.
    - `torsion_stiffness` [N m/rad] and `torsion_damping` [N m s/rad] of torsion bars that carry the design load in the
        design position; `stop_stiffness` [N m/rad³] of stops at ± `stop_angle` [rad] from there.
    - `pretension` [N] of the track in the design position, and `track_stiffness` [N/m]; of shoes by their tensioner.
    - `ground_stiffness` [N/m] under each wheel or shoe; `ground_damping` [N s/m] under each wheel, or between shoes and
        discs.
    - `friction` with its `transition_speed` [m/s].
    - `hitch_rear`, `hitch_front` [m], points of the hitch in the hulls; `hitch_stiffness` [N m/rad], `hitch_damping` [N
        m s/rad].
    - `gravity` [m/s²].

    **Labels:** `x`, `y` [m], `phi` [rad] of the hull, `a1`, … [rad] of the arms from their design position, upwards
    negative; of the towed unit `rear_x`, ….
    """
    if n_wheels < 1:
        raise ValueError(f"tracked_vehicle needs n_wheels ≥ 1, got {n_wheels}.")
    if units not in (1, 2):
        raise ValueError(f"tracked_vehicle: units must be 1 or 2, got {units!r}.")
    if track not in ("loop", "shoes") and not dataclasses.is_dataclass(track):
        raise ValueError(f"tracked_vehicle: track must be 'loop', 'shoes' or Shoes(...), got {track!r}.")
    forms: dict[Any, Any] = {"loop": None, "shoes": Shoes()}
    shoes = forms.get(track, track)
    if shoes is not None and not track_stiffness > 0:
        raise ValueError(f"tracked_vehicle(track='shoes') needs a track_stiffness > 0, got {track_stiffness}.")
    if pivots is None:
        pivots = _PIVOTS if n_wheels == 5 else np.linspace(_PIVOTS[0], _PIVOTS[-1], n_wheels)
    pivots = np.asarray(pivots, float)
    if pivots.shape != (n_wheels, 2):
        raise ValueError(f"tracked_vehicle: pivots must have shape ({n_wheels}, 2), got {pivots.shape}.")
    length, design = np.hypot(trail, drop), np.pi + np.arctan2(drop, trail)
    reach = np.array([-trail, -drop])
    if arm_inertia is None:
        arm_inertia = 1.54 + planar.rod(arm_mass, length)
    twist = (hull_mass / n_wheels + arm_mass) * gravity * trail / torsion_stiffness
    wheels = range(1, n_wheels + 1)

    bodies, joints, forces = [], [], []
    place = np.array([0.0, radius + drop - pivots[0, 1] + (0.0 if shoes is None else shoes.height)])
    for p in PREFIXES[:units]:
        hull = f"{p}hull"
        bodies.append(planar.Body(hull, mass=hull_mass, inertia=hull_inertia, position=place))
        arm, wheel = {"mass": arm_mass, "inertia": arm_inertia}, {"mass": wheel_mass, "inertia": wheel_inertia}
        for k, pivot in zip(wheels, place + pivots, strict=True):
            bodies.append(planar.Body(f"{p}arm{k}", position=pivot + reach / 2, angle=design, **arm))
        for k, pivot in zip(wheels, place + pivots, strict=True):
            bodies.append(planar.Body(f"{p}wheel{k}", position=pivot + reach, **wheel))
        for k, pivot in zip(wheels, pivots, strict=True):
            pair, half = (hull, f"{p}arm{k}"), (length / 2, 0.0)
            joints += [
                planar.Revolute(f"{p}pivot{k}", *pair, point_a=pivot, point_b=(-length / 2, 0.0)),
                planar.Revolute(f"{p}axle{k}", f"{p}arm{k}", f"{p}wheel{k}", point_a=half, point_b=(0.0, 0.0)),
            ]
            bar = {"stiffness": torsion_stiffness, "damping": torsion_damping, "free_angle": design + twist}
            stop = {"stiffness": stop_stiffness, "lower": design - stop_angle, "upper": design + stop_angle}
            forces += [
                planar.TorsionalSpringDamper(f"{p}bar{k}", *pair, **bar),
                JointStop(f"{p}stop{k}", f"{p}pivot{k}.angle", exponent=3.0, **stop),
            ]
        if shoes is None:
            path = [(hull, sprocket), (hull, idler), *((f"{p}wheel{k}", (0.0, 0.0)) for k in reversed(wheels))]
            # Around circles of one radius a loop is longer by their circumference than the polygon of their centres.
            loop = {"radii": np.full(len(path), radius), "pretension": pretension, "stiffness": track_stiffness}
            forces.append(planar.Track(f"{p}track", path, **loop))
            driven = (hull, *(f"{p}wheel{k}" for k in wheels))
        else:
            shoe_bodies, pins, laws = shoe_track(
                shoes,
                p,
                place=place,
                sprocket=np.asarray(sprocket, float),
                idler=np.asarray(idler, float),
                wheels=place + pivots + reach,
                radius=radius,
                stiffness=track_stiffness,
                pretension=pretension,
                friction=friction,
                speed=transition_speed,
                damping=ground_damping,
            )
            bodies, joints, forces = [*bodies, *shoe_bodies], [*joints, *pins], [*forces, *laws]
            driven = (hull, f"{p}sprocket")
        forces.append(Force(f"{p}drive", driven, _drive, parameters={"torque": torque}))
        place = place + np.asarray(hitch_rear) - np.asarray(hitch_front)
    if units == 2:
        pair = ("hull", "rear_hull")
        joints.append(planar.Revolute("hitch", *pair, point_a=hitch_rear, point_b=hitch_front))
        bend = {"stiffness": hitch_stiffness, "damping": hitch_damping, "free_angle": 0.0}
        forces.append(planar.TorsionalSpringDamper("hitch_spring", *pair, **bend))
    ground = {
        "terrain": Bump(start=4.0, length=1.5, peak=0.12) if terrain is None else terrain,
        "friction": contact.Coulomb(friction, transition_speed=transition_speed),
    }
    if shoes is None:
        tyres = [body.name for body in bodies if "wheel" in body.name]
        soil = {"normal": contact.Linear(ground_stiffness), "damping": ground_damping}
        forces.append(WheelContact("road", tyres, radius=radius, **soil, **ground))
    else:
        soles = [body.name for body in bodies if "shoe" in body.name]
        soil = {"normal": contact.Linear(ground_stiffness / 2), "damping": shoes.ground_damping / 2}
        for name, x in (("road", shoes.pitch / 4), ("road_behind", -shoes.pitch / 4)):
            forces.append(planar.Contact(name, soles, centres=(x, -shoes.height / 2), **soil, **ground))
    kind = "an elastic track" if shoes is None else "a track of shoes"
    return build(
        "tracked_vehicle",
        Scene(bodies, joints=joints, forces=[*forces, Gravity((0.0, -gravity))]),
        t1=1.5,
        observe=_observe,
        description=f"Tracked vehicle, {units} x {n_wheels} sprung road wheels in {kind}, over a bump.",
        references=References.load(f"tracked_vehicle_{units}"),
        fix={"hull.x": 0.0},
        start=lambda system, guess: (_rolling if shoes is None else running)(system, guess, speed),
    )


def _drive(poses, velocities, t, p):
    n = poses.shape[0] - 1
    moments = jnp.concatenate([p["torque"][None], jnp.full(n, -1 / n, poses.dtype) * p["torque"]])
    return jnp.zeros((n + 1, 3), poses.dtype).at[:, 2].set(moments)


def _rolling(system, guess, speed):
    """The state in static equilibrium without drive, moving forward with rolling wheels."""
    rest = equilibrium(undriven(system), guess, fix={"hull.x": 0.0})
    wheels = np.array(["wheel" in name for name in system.body_names])
    turn = jnp.where(wheels, -speed / parameters(system)["road.radius"], 0.0)
    u = jnp.stack([jnp.full_like(turn, speed), jnp.zeros_like(turn), turn], axis=1)
    return State(rest.q, u.reshape(-1))


def _observe(trajectory):
    observed = {}
    for unit, p in enumerate(PREFIXES, start=1):
        if f"{p}hull" in trajectory.system.body_names:
            hull, travel = trajectory[f"{p}hull"], arm_travel(trajectory, unit=unit)
            observed |= {f"{p}x": hull.position[:, 0], f"{p}y": hull.position[:, 1], f"{p}phi": hull.angle}
            observed |= {f"{p}a{k + 1}": travel[:, k] for k in range(travel.shape[1])}
    return observed
