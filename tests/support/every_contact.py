"""Every unilateral constraint in a small scene, where it is open."""

import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.parts import AbstractGeometricContact, AbstractRigidContact, AbstractSurfaceContact, fields, terrain


def _body_2d(name, x=0.4, y=0.9):
    moving = {"velocity": (0.5, -0.7), "angular_velocity": 0.6}
    return planar.Body(name, mass=1.5, inertia=0.2, position=(x, y), angle=0.2, **moving)


def _body_3d(name, x=0.4, z=0.9):
    moving = {"velocity": (0.5, 0.2, -0.7), "angular_velocity": (0.6, -0.3, 0.2)}
    return spatial.Body(name, mass=1.5, inertia=(0.2, 0.25, 0.3), position=(x, 0.1, z), **moving)


class InsideBowl(AbstractGeometricContact):
    """A user's own contact: a point stays inside a ball around the origin."""

    name: str = fields.name()
    body: str = fields.body_name()
    radius: fields.Number = fields.length(sign="positive")
    point: fields.Number = fields.point(body=0, default="origin")

    def gap(self, space, poses):
        x = space.point(poses[0], self.point)
        return (self.radius**2 - jnp.dot(x, x)) / (2 * self.radius)


class RingContact(AbstractRigidContact):
    """A user's own contact: a ring about the z-axis of its body, on the plane z = 0."""

    name: str = fields.name()
    body: str = fields.body_name()
    ring: fields.Number = fields.length(sign="positive")
    tube: fields.Number = fields.length(sign="positive")

    def lowest(self, space, poses):
        up = jnp.array([0.0, 0.0, 1.0])
        axis = space.direction(poses[0], up)
        across = up - jnp.dot(up, axis) * axis
        return poses[0, :3] - self.ring * across / jnp.linalg.norm(across)

    def gap(self, space, poses):
        return self.lowest(space, poses)[2] - self.tube

    def touching(self, space, poses):
        return self.lowest(space, poses) - jnp.array([0.0, 0.0, 1.0]) * self.tube


class DrumContact(AbstractSurfaceContact):
    """A user's own contact: a ball on a drum about the y-axis through the origin."""

    name: str = fields.name()
    body: str = fields.body_name()
    drum: fields.Number = fields.length(sign="positive")
    radius: fields.Number = fields.length(sign="positive")

    @property
    def ball(self):
        return jnp.array([0.05, 0.0, -0.1]), self.radius

    def clearance(self, place):
        return jnp.sqrt(place[0] ** 2 + place[2] ** 2) - self.drum - self.radius


_TILTED = spatial.Body(
    "a",
    mass=1.5,
    inertia=(0.2, 0.25, 0.3),
    position=(0.4, 0.1, 1.9),
    orientation=tuple(np.array([0.8, 0.5, 0.2, 0.1]) / np.linalg.norm([0.8, 0.5, 0.2, 0.1])),
    velocity=(0.5, 0.2, -0.7),
    angular_velocity=(0.6, -0.3, 0.2),
)
_GROUND = {"terrain": terrain.Bump(start=0.0, length=2.0, peak=0.2), "radius": 0.1}
# Links that turn about their pins.
_LINK_2D = planar.Body(
    "link", mass=1.5, inertia=0.2, position=(0.4, 0.9), angle=0.2, velocity=(-0.24, 0.24), angular_velocity=0.6
)
_LINK_3D = spatial.Body(
    "link",
    mass=1.5,
    inertia=(0.2, 0.25, 0.3),
    position=(0.4, 0.1, 0.9),
    velocity=(0.24, 0.0, -0.24),
    angular_velocity=(0.0, 0.6, 0.0),
)
_PIN = planar.Revolute("pin", "ground", "link", point=(0.0, 0.5))
_HINGE = spatial.Revolute("pin", "ground", "link", point=(0.0, 0.1, 0.5), axis=(0.0, 1.0, 0.0))
# Parts with their bodies and with other joints.
CONTACTS = {
    "Stop in the plane": (mb.Stop("c", "pin.angle", lower=-2.0, upper=2.0), [_LINK_2D], [_PIN]),
    "Stop in space": (mb.Stop("c", "pin.angle", lower=-2.0, upper=2.5), [_LINK_3D], [_HINGE]),
    "Stop at one end": (mb.Stop("c", "pin.angle", upper=2.0), [_LINK_2D], [_PIN]),
    "RigidContact in the plane": (mb.RigidContact("c", "a", centre=(0.1, 0.2), **_GROUND), [_body_2d("a")], []),
    "RigidContact in space": (mb.RigidContact("c", "a", centre=(0.1, 0.2, 0.0), **_GROUND), [_body_3d("a")], []),
    "RigidBallContact": (
        mb.RigidBallContact("c", "a", "b", radius_a=0.1, radius_b=0.2, point_a=(0.1, 0.0), point_b=(0.0, 0.1)),
        [_body_2d("a"), _body_2d("b", x=1.5)],
        [],
    ),
    "RigidBallContact in space": (
        mb.RigidBallContact("c", "ground", "a", radius_a=0.1, radius_b=0.2, point_b=(0.1, 0.0, 0.1)),
        [_body_3d("a")],
        [],
    ),
    "RigidPlaneContact": (
        mb.RigidPlaneContact("c", "a", "b", normal=(0.0, 1.0), point_b=(0.1, 0.0), radius=0.1),
        [_body_2d("a", y=0.0), _body_2d("b")],
        [],
    ),
    "RigidPlaneContact in space": (
        mb.RigidPlaneContact("c", "a", "b", normal=(0.0, 0.6, 0.8), point_b=(0.1, 0.0, 0.0)),
        [_body_3d("a", z=0.0), _body_3d("b")],
        [],
    ),
    "RigidBoxContact": (
        mb.RigidBoxContact("c", "a", "b", size=(0.4, 0.6), point_a=(0.0, 0.1), point_b=(0.1, 0.0), radius=0.1),
        [_body_2d("a", y=0.0), _body_2d("b")],
        [],
    ),
    "RigidBoxContact at a corner": (
        mb.RigidBoxContact("c", "a", "b", size=(0.4, 0.6, 0.3), point_b=(0.1, 0.0, 0.0), radius=0.1),
        [_body_3d("a", z=0.0), _body_3d("b", x=1.0)],
        [],
    ),
    "Slack": (mb.Slack("c", "a", "b", length=2.0, point_a=(0.1, 0.2)), [_body_2d("a"), _body_2d("b", x=1.5)], []),
    "Slack in space": (mb.Slack("c", "ground", "a", length=2.0), [_body_3d("a")], []),
    "Rope": (
        mb.Rope(
            "c", [("ground", (-1.0, 0.4)), mb.Pulley("a", 0.1, "right"), ("b", (0.1, 0.0))], length=3.0, slack=True
        ),
        [_body_2d("a"), _body_2d("b", x=1.5)],
        [],
    ),
    "Rope in space": (
        mb.Rope(
            "c",
            [mb.Pulley("a", 0.1, "right", (0.1, 0.0, 0.0), (0.0, -1.0, 0.0)), ("ground", (1.5, 0.0, 0.2))],
            length=2.0,
            slack=True,
        ),
        [_body_3d("a")],
        [],
    ),
    "a contact of a user": (InsideBowl("c", "a", radius=3.0, point=(0.1, 0.0)), [_body_2d("a")], []),
    "a ring of a user": (RingContact("c", "a", ring=0.5, tube=0.1), [_TILTED], []),
    "a drum of a user": (DrumContact("c", "a", drum=0.7, radius=0.1), [_TILTED], []),
}


def system_of(name):
    part, bodies, joints = CONTACTS[name]
    down = (0.0, -9.81) if isinstance(bodies[0], planar.Body) else (0.0, 0.0, -9.81)
    return mb.Scene(bodies, joints=[*joints, part], forces=[mb.Gravity(np.array(down))]).compile()
