"""A track of shoes on pins around a sprocket, road wheels and an idler on a tensioner."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from .. import planar
from .._types import State
from ..linalg.rotations import norm
from ..parts import contact
from ..simulate import simulate
from ..states.assembly import assemble
from ..system import parameters, with_parameters
from .ride import PREFIXES

# Distance [m] of the tensioner's fixed end before the idler in its design position.
_TENSIONER = 0.5
# Largest distance [m] of the idler from its design position to fit a number of shoes.
_REACH = 0.2
# Time [s] in which a vehicle comes to rest before it starts, and the largest number of steps.
_SETTLING, _STEPS = 1.0, 100_000


@dataclasses.dataclass(frozen=True)
class Shoes:
    """A track of rigid shoes on pins, for `tracked_vehicle(track=Shoes(...))`. One body represents a left and right
    pair.

    ```python
    track = jaxmb.mechanisms.Shoes(pitch=0.1524, mass=36.0, tensioner_damping=2e4)
    vehicle = jaxmb.mechanisms.tracked_vehicle(track=track)
    ```

    Shoes touch sprocket, idler and wheels on their inner side and at the corners between them, and the ground at two
    points, a quarter of their pitch from their middle. Stiffness and damping are per shoe, not per length of track.

    **Fields:** `number` of shoes, default with the idler closest to its design position; `pitch` [m], the distance of
    their pins, and `height` [m]; `mass` [kg] of a shoe; radii [m] and masses [kg] of `sprocket` and `idler`, which are
    discs; `rim_stiffness` [N/m] of the contact of shoes with these and with wheels; `sprocket_friction`, the
    coefficient on the sprocket, which models its teeth; `ground_damping` [N s/m] under a shoe; `pin_damping` [N m
    s/rad]; `tensioner_damping` [N s/m].
    """

    number: int | None = None
    pitch: float = 0.1524
    height: float = 0.06
    mass: float = 36.0
    sprocket_radius: float = 0.2
    sprocket_mass: float = 200.0
    idler_radius: float = 0.2
    idler_mass: float = 200.0
    rim_stiffness: float = 3e6
    sprocket_friction: float = 2.0
    ground_damping: float = 2e3
    pin_damping: float = 2.0
    tensioner_damping: float = 1e4

    def __post_init__(self):
        if self.number is not None and not isinstance(self.number, int | np.integer):
            raise ValueError(f"Shoes: number must be an integer, got {self.number!r}.")
        # Without these numbers no track can be laid; bodies and forces check theirs.
        for name in ("pitch", "height", "sprocket_radius", "idler_radius"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"Shoes: {name} must be positive and finite, got {getattr(self, name)!r}.")


def shoe_track(
    shoes, prefix, *, place, sprocket, idler, wheels, radius, stiffness, pretension, friction, speed, damping
):
    """Bodies, joints and forces of a track around discs of a hull, taut and without sag.

    **Arguments:** `place`, of the hull; `sprocket`, `idler` [m] in the hull; `wheels` [m], centres in the world, front
    wheel first, of `radius` [m]; `stiffness` [N/m] and `pretension` [N] along the loop, both by the tensioner;
    `friction`, the coefficient of wheels and idler on shoes; its transition `speed` and the `damping` of all discs.
    """
    p, hull = prefix, f"{prefix}hull"
    offset, pins = laid(shoes, place + sprocket, place + idler, wheels, radius)
    middle = np.array([-offset, 0.0])
    disc = lambda mass, radius: {"mass": mass, "inertia": planar.disc(mass, radius)}
    bodies = [
        planar.Body(f"{p}sprocket", position=place + sprocket, **disc(shoes.sprocket_mass, shoes.sprocket_radius)),
        planar.Body(f"{p}idler", position=place + idler + middle, **disc(shoes.idler_mass, shoes.idler_radius)),
    ]
    ends = np.roll(pins, -1, axis=0)
    names = [f"{p}shoe{k}" for k in range(1, len(pins) + 1)]
    inertia = planar.box(shoes.mass, shoes.pitch, shoes.height)
    for name, start, end in zip(names, pins, ends, strict=True):
        way = end - start
        pose = {"position": (start + end) / 2, "angle": np.arctan2(way[1], way[0])}
        bodies.append(planar.Body(name, mass=shoes.mass, inertia=inertia, **pose))

    half = (shoes.pitch / 2, 0.0)
    spring = 4 * stiffness
    joints: list[Any] = [
        planar.Revolute(f"{p}final_drive", hull, f"{p}sprocket", point_a=sprocket, point_b=(0.0, 0.0)),
        planar.PointOnLine(f"{p}slide", hull, f"{p}idler", point_a=idler, point_b=(0.0, 0.0), axis_a=(1.0, 0.0)),
    ]
    forces: list[Any] = [
        # The idler moves by half of the length that it gives to the loop, against the tension of both strands.
        planar.SpringDamper(
            f"{p}tensioner",
            hull,
            f"{p}idler",
            stiffness=spring,
            damping=shoes.tensioner_damping,
            free_length=_TENSIONER + offset + 2 * pretension / spring,
            point_a=idler + np.array([_TENSIONER, 0.0]),
        )
    ]
    for k, (name, other) in enumerate(zip(names, [*names[1:], names[0]], strict=True), start=1):
        joints.append(planar.Revolute(f"{p}pin{k}", name, other, point_a=half, point_b=(-half[0], 0.0)))
        bushing = {"stiffness": 0.0, "damping": shoes.pin_damping, "free_angle": 0.0}
        forces.append(planar.TorsionalSpringDamper(f"{p}bushing{k}", name, other, **bushing))
    rims = [
        (f"{p}sprocket", shoes.sprocket_radius, shoes.sprocket_friction),
        (f"{p}idler", shoes.idler_radius, friction),
        *((f"{p}wheel{k}", radius, friction) for k in range(1, len(wheels) + 1)),
    ]
    for body, rim_radius, coefficient in rims:
        forces.append(
            planar.PlateContact(
                f"{body}_rim",
                (body, *names),
                radius=rim_radius,
                start=(-half[0], shoes.height / 2),
                end=(half[0], shoes.height / 2),
                edge=shoes.pitch / 4,
                chain=True,
                normal=contact.Linear(shoes.rim_stiffness),
                friction=contact.Coulomb(coefficient, transition_speed=speed),
                damping=damping,
            )
        )
    return bodies, joints, forces


def running(system, guess, speed):
    """The state of a vehicle on tracks of shoes, from near rest, that moves forward with rolling wheels and shoes that
    lie on the ground.

    Without drive, shoes hang down, and vehicle and tracks lose their motion in a second. They continue to creep, since
    dry friction is regularised: there are many equilibria in which friction holds the shoes.
    """
    names, values = system.body_names, parameters(system)
    undriven_system = undriven(system)
    start = assemble(undriven_system, State(guess.q, jnp.zeros_like(guess.u)))
    q = simulate(undriven_system, start, t1=_SETTLING, rtol=1e-4, max_steps=_STEPS).ys.q[-1]
    discs = {name: _rolling_radius(name, values) for name in names if f"{name}_rim.radius" in values}
    radii = jnp.stack([discs.get(name, jnp.ones(())) for name in names])
    turn = jnp.where(np.array([name in discs for name in names]), -speed / radii, 0.0)
    u = jnp.stack([jnp.full_like(turn, speed), jnp.zeros_like(turn), turn], axis=1)
    for p in PREFIXES:
        places = np.array([k for k, name in enumerate(names) if name.startswith(f"{p}shoe")])
        if places.size:
            pitch = -2 * values[f"{p}idler_rim.start"][0]
            u = u.at[places].add(_circulation(q.reshape(-1, 3)[places], speed, pitch))
    return assemble(system, State(q, u.reshape(-1)))


def _rolling_radius(name, values):
    """Length of track per angle [m/rad] of a disc: straight under wheels, and around sprocket and idler a polygon whose
    sides touch the disc in their middle.
    """
    radius, (start, height) = values[f"{name}_rim.radius"], values[f"{name}_rim.start"]
    return radius if "wheel" in name else -start / jnp.arctan2(-start, radius + height)


def undriven(system):
    """A vehicle without torque of its drives."""
    drives = [name for name in parameters(system) if name.endswith("drive.torque")]
    return with_parameters(system, dict.fromkeys(drives, 0.0))


def _circulation(poses, speed, pitch):
    """Velocities of shoes that run through the shape of their track at a speed [m/s], backwards along the ground.
    Velocities and `poses` have shape (shoes, 3); `pitch` [m].
    """
    turn = lambda v: jnp.stack([-v[:, 1], v[:, 0]], axis=1)
    along = jnp.stack([jnp.cos(poses[:, 2]), jnp.sin(poses[:, 2])], axis=1)
    at_pin = along + jnp.roll(along, -1, axis=0)
    at_pin *= -speed / norm(at_pin)[:, None]
    before = jnp.roll(at_pin, 1, axis=0)
    rate = jnp.sum(turn(along) * (at_pin - before), axis=1) / pitch
    return jnp.concatenate([0.5 * (at_pin + before), rate[:, None]], axis=1)


def laid(shoes, sprocket, idler, wheels, radius):
    """The distance of the idler behind its design position, and the pins of the taut loop, counter-clockwise."""
    radii = np.array([shoes.sprocket_radius, shoes.idler_radius, *[radius] * len(wheels)]) + shoes.height / 2
    # Around sprocket and idler, shoes touch in their middle, and pins lie farther out.
    radii[:2] = np.hypot(radii[:2], shoes.pitch / 2)

    def loop(offset):
        return _Loop(np.array([sprocket, idler - np.array([offset, 0.0]), *wheels]), radii)

    fitting = loop(0.0).number(shoes.pitch)
    number = round(fitting) if shoes.number is None else shoes.number
    offset = 0.5 * (number - fitting) * shoes.pitch
    for _ in range(20):
        if abs(offset) > _REACH:
            raise ValueError(
                f"Shoes: the idler cannot stand where {number} shoes of {shoes.pitch:g} m fit; about {fitting:.1f} do "
                "in the design position."
            )
        offset += 0.5 * (number - loop(offset).number(shoes.pitch)) * shoes.pitch
    return offset, loop(offset).pins(number, shoes.pitch)


class _Loop:
    """The shortest closed line around discs, as a polygon of many sides from its foremost point, counter-clockwise."""

    def __init__(self, centres, radii):
        angle = np.linspace(0.0, 2 * np.pi, 8193)
        normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        outermost = np.argmax(normal @ centres.T + radii, axis=1)
        self.points = centres[outermost] + radii[outermost, None] * normal
        sides = np.sqrt(np.sum(np.diff(self.points, axis=0) ** 2, axis=1))
        self.lengths = np.concatenate([[0.0], np.cumsum(sides)])

    def at(self, s):
        return np.stack([np.interp(s, self.lengths, self.points[:, k]) for k in range(2)], axis=-1)

    def next(self, s, pitch):
        """The place of the next pin: a chord's length ahead."""
        here, ahead = self.at(s), s + pitch
        for _ in range(30):
            short = pitch - np.linalg.norm(self.at(ahead % self.lengths[-1]) - here)
            ahead += short
            if abs(short) < 1e-13 * pitch:
                break
        return ahead

    def number(self, pitch):
        """The number of chords that fit around, including the fraction of the last chord."""
        s, n = 0.0, 0
        while (ahead := self.next(s, pitch)) <= self.lengths[-1]:
            s, n = ahead, n + 1
        return n + float(np.linalg.norm(self.points[-1] - self.at(s))) / pitch

    def pins(self, number, pitch):
        s = [0.0]
        while len(s) < number:
            s.append(self.next(s[-1], pitch))
        return self.at(np.array(s))
