"""A track of shoes on pins around a sprocket, road wheels and an idler on a tensioner."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from .. import planar
from ..parts import contact

# Distance [m] of the tensioner's fixed end before the idler in its design position.
_TENSIONER = 0.5
# How far [m] the idler may stand from its design position to fit a number of shoes.
_REACH = 0.2


@dataclasses.dataclass(frozen=True)
class Shoes:
    """A track of rigid shoes on pins, for `tracked_vehicle(track=Shoes(...))`. One body stands for a left and right
    pair.

    Shoes touch sprocket, idler and wheels on their inner side, and the ground at two points, a quarter of their pitch
    from their middle.

    **Fields:** `number` of shoes, default the one for which the idler stands closest to its design position; `pitch`
    [m], the distance of their pins, and `height` [m]; `mass` [kg] of a shoe; radii [m] and masses [kg] of `sprocket`
    and `idler`, which are discs; `rim_stiffness` [N/m] of the contact of shoes with these and with wheels;
    `sprocket_friction`, the coefficient there, which stands for the sprocket's teeth; `ground_damping` [N s/m] under a
    shoe; `pin_damping` [N m s/rad]; `tensioner_damping` [N s/m].
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
    pin_damping: float = 10.0
    tensioner_damping: float = 1e4


def shoe_track(
    shoes, prefix, *, place, sprocket, idler, wheels, radius, stiffness, pretension, friction, speed, damping
):
    """Bodies, joints and forces of a track around discs of a hull, taut and without sag.

    **Arguments:** `place`, of the hull; `sprocket`, `idler` [m] in the hull; `wheels` [m], centres in the world, of
    `radius` [m], front one first; `stiffness` [N/m] and `pretension` [N] along the loop, both of which the tensioner
    has; `friction` with its transition `speed`, and `damping`, of wheels and idler on shoes.
    """
    p, hull = prefix, f"{prefix}hull"
    offset, pins = _laid(shoes, place + sprocket, place + idler, wheels, radius)
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
        own = {"position": (start + end) / 2, "angle": np.arctan2(way[1], way[0])}
        bodies.append(planar.Body(name, mass=shoes.mass, inertia=inertia, **own))

    half = (shoes.pitch / 2, 0.0)
    spring = 4 * stiffness
    joints = [
        planar.Revolute(f"{p}final_drive", hull, f"{p}sprocket", point_a=sprocket, point_b=(0.0, 0.0)),
        planar.PointOnLine(f"{p}slide", hull, f"{p}idler", point_a=idler, point_b=(0.0, 0.0), axis_a=(1.0, 0.0)),
    ]
    forces = [
        # The idler moves by half of what it gives to the loop, against the tension of both strands.
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
    for body, own, coefficient in rims:
        forces.append(
            planar.PlateContact(
                f"{body}_rim",
                (body, *names),
                radius=own,
                start=(-half[0], shoes.height / 2),
                end=(half[0], shoes.height / 2),
                edge=shoes.pitch / 4,
                normal=contact.Linear(shoes.rim_stiffness),
                friction=contact.Coulomb(coefficient, transition_speed=speed),
                damping=damping,
            )
        )
    return bodies, joints, forces


def circulation(shoes, q, u, speed):
    """Velocities [m/s, rad/s] of the shoes of a track, from their poses, in which it runs through its own shape at a
    `speed`, backwards along the ground, on top of velocities u; both of shape (shoes, 3).
    """
    along = jnp.stack([jnp.cos(q[:, 2]), jnp.sin(q[:, 2])], axis=1)
    at_pin = along + jnp.roll(along, -1, axis=0)
    at_pin = -speed * at_pin / jnp.sqrt(jnp.sum(at_pin**2, axis=1, keepdims=True))
    before = jnp.roll(at_pin, 1, axis=0)
    turn = along[:, 0] * (at_pin - before)[:, 1] - along[:, 1] * (at_pin - before)[:, 0]
    return u + jnp.concatenate([0.5 * (at_pin + before), turn[:, None] / shoes.pitch], axis=1)


def _laid(shoes, sprocket, idler, wheels, radius):
    """How far the idler stands behind its design position, and the pins of the taut loop, counter-clockwise."""
    half = shoes.height / 2
    radii = np.array([shoes.sprocket_radius, shoes.idler_radius, *[radius] * len(wheels)]) + half

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
        """How many chords fit around, with the fraction of the last one."""
        s, n = 0.0, 0
        while (ahead := self.next(s, pitch)) <= self.lengths[-1]:
            s, n = ahead, n + 1
        return n + float(np.linalg.norm(self.points[-1] - self.at(s))) / pitch

    def pins(self, number, pitch):
        s = [0.0]
        while len(s) < number:
            s.append(self.next(s[-1], pitch))
        return self.at(np.array(s))
