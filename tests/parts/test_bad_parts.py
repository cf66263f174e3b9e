"""Mistakes in a user's own part are refused when its scene is compiled; the error names the part and the cure."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import contact, parts, planar, spatial, terrain


def body(name="body", **changes):
    return planar.Body(name, **({"mass": 1.0, "inertia": 0.1} | changes))


def scene(*forces, joints=(), bodies=None):
    return mb.Scene([body()] if bodies is None else bodies, joints=joints, forces=forces).compile()


class Push(parts.AbstractForce):
    """A force that returns what its function does."""

    name: str = parts.name()
    cart: str = parts.body_name()
    returns: object = parts.function()
    gain: parts.Number = parts.parameter(unit="N", default=1.0)

    def wrenches(self, space, poses, velocities, t):
        return self.returns(poses, velocities)


class Stored(Push):
    """A force with an energy that its class does not announce."""

    def energy(self, space, poses, t):
        return jnp.zeros(())


class Spring(parts.AbstractPotentialForce):
    """A force whose energy has a shape."""

    name: str = parts.name()
    cart: str = parts.body_name()

    def wrenches(self, space, poses, velocities, t):
        return jnp.zeros((1, 3))

    def energy(self, space, poses, t):
        return poses[0, :2]


class Guide(parts.AbstractConstraint):
    """A constraint with a residual of some shape."""

    name: str = parts.name()
    cart: str = parts.body_name()
    returns: object = parts.function()
    rows = 2
    rheonomic = False

    def residual(self, space, poses, t):
        return self.returns(poses)


class Roll(parts.AbstractVelocityConstraint):
    """A constraint between velocities with a residual of some shape."""

    name: str = parts.name()
    cart: str = parts.body_name()
    rows = 1
    linear = True
    homogeneous = True

    def residual(self, space, poses, velocities, t):
        return velocities[0]


class SpaceOnly(parts.AbstractSpatialPart, parts.AbstractJoint):
    """A joint of space."""

    rows = 3

    def residual(self, space, poses, t):
        return parts.separation(space, self, poses)


class Marked(parts.AbstractForce):
    """A force with a number of every kind."""

    name: str = parts.name()
    cart: str = parts.body_name()
    gain: parts.Number = parts.parameter(sign="nonzero", default=1.0)
    radius: parts.Number = parts.length(sign="positive", default=1.0)
    at: parts.Number = parts.point(body=0, default="origin")
    along: parts.Number = parts.axis(body=0, default=(1.0, 0.0))
    mode: str = parts.choice("soft", "hard", default="soft")
    numbers: parts.Numbers = parts.numbers()

    def wrenches(self, space, poses, velocities, t):
        return jnp.zeros((1, space.velocity_size))


def ground(**changes):
    laws = {"terrain": terrain.Flat(), "normal": contact.Linear(1e4), "radius": 0.1}
    return planar.Contact("floor", "body", **(laws | changes))


def surface(height):
    return scene(ground(terrain=terrain.Surface(height)))


def wind(function, **options):
    return scene(mb.Force("wind", "body", function, **options))


TURN = ("turn", "ground", "body")
# What the kernels of `Push` and `Guide` return, and numbers of `Marked`.
PUSHES = {
    "without bodies": (lambda x, v: jnp.ones(3), r"must return shape \(1, 3\), got \(3,\)"),
    "of a spatial force": (lambda x, v: jnp.ones((1, 6)), r"must return shape \(1, 3\)"),
    "transposed": (lambda x, v: jnp.ones((3, 1)), "must return shape"),
    "of integers": (lambda x, v: jnp.ones((1, 3), int), "must return float64 numbers, got int"),
    "complex": (lambda x, v: v * 1j, "must return float64 numbers, got complex128"),
    "of nothing": (lambda x, v: None, ""),
    "that is text": (lambda x, v: "1 N", "cannot be evaluated"),
    "of a body that is not there": (lambda x, v: v[1:2] + v[1], "indexes out of bounds"),
    "of a coordinate that is not there": (lambda x, v: v * x[0, 7], "indexes out of bounds"),
    "of a velocity that is not there": (lambda x, v: v * v[0, 3], "indexes out of bounds"),
    "with an error of its own": (lambda x, v: v @ jnp.ones(7), "cannot be evaluated"),
}
ROWS = {
    "too many": (lambda x: x[0, :3], r"\(3,\)"),
    "as a matrix": (lambda x: x[:, :2], r"\(1, 2\)"),
    "a number for two": (lambda x: x[0, 0], r"\(\)"),
}
MARKS = {
    "zero": ({"gain": 0.0}, "gain must not be zero"),
    "negative length": ({"radius": -1.0}, "radius must be positive, got -1.0"),
    "point of space": ({"at": (0, 0, 0)}, r"at must have shape \(2,\), got \(3,\)"),
    "long direction": ({"along": (3, 4)}, "along must be a unit vector.*length 5"),
    "unknown word": ({"mode": "firm"}, r"mode must be one of \('soft', 'hard'\), got 'firm'"),
    "numbers without names": ({"numbers": (1.0,)}, "numbers must be a dictionary of numbers"),
    "text among numbers": ({"numbers": {"a": "b"}}, ".*'b'"),
    "infinite among numbers": ({"numbers": {"a": np.inf}}, "a must be finite"),
}
OTHERS = {
    "energy that is not announced": (
        lambda: scene(Stored("push", "body", lambda x, v: v)),
        "'push' .*energy.*AbstractPotentialForce",
    ),
    "energy with a shape": (lambda: scene(Spring("spring", "body")), r"'spring': energy must return shape \(\), got"),
    "rows between velocities": (
        lambda: scene(joints=[Roll("roll", "body")]),
        r"'roll': residual must return shape \(1,\)",
    ),
    "program of a servo": (
        lambda: scene(joints=[mb.Servo(Guide("guide", "body", lambda x: x[0, :3]))]),
        r"'guide': residual must return shape \(2,\)",
    ),
    # Functions.
    "function of a force": (
        lambda: wind(lambda x, v, t, p: jnp.ones((3, 2))),
        r"the function of Force 'wind' must return shape \(1, 3\), got \(3, 2\)",
    ),
    "function of a constraint": (
        lambda: scene(joints=[mb.Constraint("rail", "body", lambda x, t, p: x[0, :2])]),
        r"the function of Constraint 'rail' must return shape \(1,\), got \(2,\)",
    ),
    "potential of a force": (
        lambda: wind(lambda x, v, t, p: 0.0 * v, potential=lambda x, t, p: x[0, :2]),
        r"the function of Force 'wind' must return shape \(\), got \(2,\)",
    ),
    "motion of a driver": (
        lambda: scene(
            joints=[planar.Driver("turn", "ground", "body", quantity="angle", motion=lambda t, p: jnp.ones(2))]
        ),
        "'turn': residual cannot be evaluated",
    ),
    "place of a terrain": (lambda: surface(lambda x, p: x[1]), "'floor': terrain.height indexes out of bounds"),
    "height with a shape": (lambda: surface(lambda x, p: jnp.ones(2)), "'floor': terrain.height cannot be evaluated"),
    # The wrong space.
    "joint of space": (
        lambda: scene(joints=[SpaceOnly("pin", "ground", "body")]),
        "SpaceOnly 'pin' is spatial.*planar",
    ),
    "body of space": (
        lambda: scene(bodies=[body(), spatial.PointMass("drop", mass=1.0)]),
        "PointMass 'drop' is spatial.*planar",
    ),
    # Numbers, by the declarations of their fields.
    "vector for a number": (
        lambda: scene(planar.SpringDamper("spring", "ground", "body", stiffness=(1.0, 2.0))),
        r"'spring': stiffness must have shape \(\), got \(2,\)",
    ),
    "number for a vector": (
        lambda: scene(planar.PointForce("push", "body", force=1.0)),
        r"'push': force must have shape \(2,\), got \(\)",
    ),
    "text for a number": (lambda: body(mass="heavy"), "'body': mass: expected a real number.*'heavy'"),
    "nothing for a number": (lambda: body(mass=None), "'body': mass: expected a real number.*None"),
    "complex number": (lambda: body(inertia=1j), "'body': inertia: expected a real number"),
    "ragged array": (lambda: body(position=[(0.0,), 1.0]), "'body': position: expected a real number"),
    "number for a name": (lambda: planar.Body(3, mass=1.0, inertia=1.0), "name must be a name, got 3"),
    "number for a body": (lambda: Marked("mark", 7), "'mark': cart must be a name, got 7"),
    "no bodies": (lambda: mb.Force("wind", (), lambda x, v, t, p: v), "'wind': bodies must be the name of a body"),
    "number of a law": (
        lambda: scene(ground(normal=contact.Linear(0.0))),
        "'floor': normal.stiffness must be positive",
    ),
    "text for a number of a law": (lambda: contact.Linear("stiff"), "Linear: stiffness: expected a real number"),
    "no law": (lambda: ground(normal=1e4), "'floor': normal must be a law from jaxmb.contact"),
}
REFUSED = {
    **{
        f"wrench {name}": (lambda f=f: scene(Push("push", "body", f)), f"'push': wrenches {m}")
        for name, (f, m) in PUSHES.items()
    },
    **{
        f"rows: {name}": (
            lambda f=f: scene(joints=[Guide("guide", "body", f)]),
            rf"'guide': residual must return shape \(2,\), got {m}",
        )
        for name, (f, m) in ROWS.items()
    },
    **{name: (lambda x=x: scene(Marked("mark", "body", **x)), f"'mark': {m}") for name, (x, m) in MARKS.items()},
    **OTHERS,
}


@pytest.mark.parametrize("build, message", REFUSED.values(), ids=REFUSED)
def test_part_that_is_refused(build, message):
    """With its name and the cure."""
    with pytest.raises(ValueError, match=message) as caught:
        build()
    assert "\n" not in str(caught.value)


def test_parts_of_one_kind_are_stacked_whatever_their_fields_are_called():
    drags = [Marked(f"mark{k}", f"body{k}", gain=1.0 + k) for k in range(6)]
    system = mb.Scene([body(f"body{k}") for k in range(6)], forces=drags).compile()
    assert len(system.forces.groups) == 1
    assert float(mb.parameters(system)["mark3.gain"]) == 4.0


def test_a_body_of_ones_own_has_its_numbers_as_parameters():
    class Disc(planar.AbstractRigidBody):
        radius: parts.Number = parts.length(sign="positive")
        density: parts.Number = parts.parameter(unit="kg/m²", sign="positive")

        @property
        def mass(self):
            return jnp.pi * self.radius**2 * self.density

        @property
        def inertia(self):
            return 0.5 * self.mass * self.radius**2

    system = mb.Scene([Disc("disc", radius=0.5, density=2.0), body("other")]).compile()
    assert set(mb.parameters(system)) == {"disc.radius", "disc.density", "other.mass", "other.inertia"}
    np.testing.assert_allclose(system.mass, [np.pi * 0.25 * 2.0, 1.0], rtol=1e-15)
    heavier = mb.with_parameters(system, {"disc.density": 4.0})
    np.testing.assert_allclose(heavier.moments_of_inertia, [0.5 * np.pi * 0.25 * 4.0 * 0.25, 0.1], rtol=1e-15)
    assert "Disc  disc" in str(system)
