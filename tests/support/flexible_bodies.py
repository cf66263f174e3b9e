"""Bodies with a bob that slides in them on a spring, as flexible bodies and as two rigid bodies with a guide."""

import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb import parts, planar, spatial

SLIDE = (parts.ScalarCoordinate("slide", is_length=True, moves=True),)
AXIS = np.array([0.48, 0.64, 0.6])
CASE, BOB = np.diag([0.02, 0.03, 0.025]) + 0.003, np.diag([0.002, 0.001, 0.003])


class PlanarSlider(planar.AbstractRigidBody, parts.AbstractFlexibleBody):
    """A body whose bob slides along its x axis."""

    mass: parts.Number = parts.parameter(unit="kg", sign="positive")
    inertia: parts.Number = parts.parameter(unit="kg m²", sign="positive")
    bob: parts.Number = parts.parameter(unit="kg", sign="positive")
    stiffness: parts.Number = parts.parameter(unit="N/m", sign="positive")
    damping: parts.Number = parts.parameter(unit="N s/m", sign="non-negative", default=0.0)
    modes = SLIDE

    def mass_matrix(self, space, zeta):
        case, nothing = self.mass - self.bob, jnp.zeros_like(self.bob)
        along = jnp.array([[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0]]).at[1, 2].set(zeta[0])
        return jnp.diag(jnp.stack([case, case, self.inertia, nothing])) + self.bob * along.T @ along

    def energy(self, space, zeta):
        return 0.5 * self.stiffness * zeta[0] ** 2

    def internal_force(self, space, zeta, rates):
        return -self.damping * rates


class SpatialSlider(spatial.AbstractRigidBody, parts.AbstractFlexibleBody):
    """A body whose bob, with an inertia of its own, slides along an axis."""

    mass: parts.Number = parts.parameter(unit="kg", sign="positive")
    inertia: parts.Number = parts.parameter(unit="kg m²", shape=(3, 3))
    bob: parts.Number = parts.parameter(unit="kg", sign="positive")
    stiffness: parts.Number = parts.parameter(unit="N/m", sign="positive")
    damping: parts.Number = parts.parameter(unit="N s/m", sign="non-negative", default=0.0)
    modes = SLIDE

    def mass_matrix(self, space, zeta):
        x, y, z = (zeta[0] * a for a in AXIS)
        o = jnp.zeros_like(x)
        arm = jnp.stack([jnp.stack([o, -z, y]), jnp.stack([z, o, -x]), jnp.stack([-y, x, o])])
        of_bob = jnp.concatenate([jnp.eye(3), -arm, jnp.asarray(AXIS)[:, None]], axis=1)
        of_case, turning = jnp.eye(3, 7), jnp.eye(3, 7, 3)
        out = (self.mass - self.bob) * of_case.T @ of_case + turning.T @ self.inertia @ turning
        return out + self.bob * of_bob.T @ of_bob

    def energy(self, space, zeta):
        return 0.5 * self.stiffness * zeta[0] ** 2

    def internal_force(self, space, zeta, rates):
        return -self.damping * rates


class OnSlide(parts.AbstractFlexibleFrame):
    """The place of the bob."""

    def pose_at(self, space, pose, zeta):
        along = jnp.asarray(AXIS) if space.dimension == 3 else jnp.array([1.0, 0.0])
        return jnp.concatenate([space.point(pose, zeta[0] * along), pose[space.dimension : space.pose_size]])


def planar_pendulum(flexible, *, forces=(), frames=(), joints=()):
    """A pendulum with a bob that slides across it, and a spring on the bob."""
    pin = planar.Revolute("pin", "ground", "box", point_a=(0.0, 0.0), point_b=(0.0, 0.2))
    tie = planar.SpringDamper("tie", "ground", "bob", stiffness=20.0, free_length=0.5, point_a=(0.5, -0.5))
    forces, place = [mb.Gravity((0.0, -9.81)), tie, *forces], (0.0, -0.2)
    if flexible:
        box = PlanarSlider("box", mass=1.0, inertia=0.1, bob=0.3, stiffness=50.0, damping=0.4, position=place)
        return mb.Scene([box], joints=[pin, *joints], forces=forces, frames=[OnSlide("bob", "box"), *frames])
    box = planar.Body("box", mass=0.7, inertia=0.08, position=place)
    bob = planar.Body("bob", mass=0.3, inertia=0.02, position=place)
    guide = planar.Prismatic("guide", "box", "bob", point_a=(0.0, 0.0), point_b=(0.0, 0.0), axis_a=(1.0, 0.0))
    spring = mb.JointSpring("spring", "guide.displacement", stiffness=50.0, damping=0.4, free=0.0)
    return mb.Scene([box, bob], joints=[pin, guide, *joints], forces=[*forces, spring], frames=frames)


def spatial_loop(flexible, *, forces=(), frames=()):
    """A crank, a coupler with a sliding bob, and a rocker that hangs on the bob; both ends stand on the ground."""
    place = np.array([0.55, 0.1, 0.3])
    crank = spatial.Body("crank", mass=0.5, inertia=spatial.box(0.5, 0.3, 0.05, 0.05), position=(0.15, 0.0, 0.0))
    middle = place + np.array([0.05, 0.3, 0.1])
    rocker = spatial.Body("rocker", mass=0.8, inertia=spatial.box(0.8, 0.1, 0.5, 0.1), position=middle)
    joints = [
        spatial.Revolute("A", "ground", "crank", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0)),
        spatial.Spherical("B", "crank", "box", point_a=(0.15, 0.0, 0.0), point_b=(-0.25, -0.1, -0.3)),
        spatial.Universal(
            "C",
            "rocker",
            "bob",
            point_a=(-0.05, -0.3, -0.1),
            point_b=(0.0, 0.0, 0.0),
            axis_a=(1.0, 0.0, 0.0),
            axis_b=(0.0, 1.0, 0.0),
        ),
        spatial.Revolute("D", "rocker", "ground", point=middle + np.array([0.05, 0.3, 0.1]), axis=(0.6, 0.0, 0.8)),
    ]
    tie = spatial.SpringDamper(
        "tie",
        "ground",
        "bob",
        stiffness=30.0,
        damping=0.5,
        free_length=0.2,
        point_a=(0.5, -0.5, 0.6),
        point_b=(0.02, 0.03, 0.01),
    )
    forces = [mb.Gravity((0.0, 0.0, -9.81)), tie, *forces]
    if flexible:
        box = SpatialSlider("box", mass=1.3, inertia=CASE + BOB, bob=0.3, stiffness=60.0, damping=0.4, position=place)
        bodies, frames = [crank, box, rocker], [OnSlide("bob", "box"), *frames]
        return mb.Scene(bodies, joints=joints, forces=forces, frames=frames)
    box = spatial.Body("box", mass=1.0, inertia=CASE, position=place)
    bob = spatial.Body("bob", mass=0.3, inertia=BOB, position=place)
    guide = spatial.Prismatic("guide", "box", "bob", point_a=(0.0, 0.0, 0.0), point_b=(0.0, 0.0, 0.0), axis_a=AXIS)
    spring = mb.JointSpring("spring", "guide.displacement", stiffness=60.0, damping=0.4, free=0.0)
    return mb.Scene([crank, box, rocker, bob], joints=[*joints, guide], forces=[*forces, spring], frames=frames)


def as_flexible(rigid, state, slide, rate):
    """The state of the flexible scene, from the state of the rigid one and the bob's displacement."""
    last = rigid.layout.space.pose_size, rigid.layout.space.velocity_size
    return mb.State(np.append(np.asarray(state.q)[: -last[0]], slide), np.append(np.asarray(state.u)[: -last[1]], rate))
