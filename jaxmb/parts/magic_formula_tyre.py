"""A tyre by the Magic Formula, with the coefficients of a tyre property file.

Source: H. B. Pacejka, "Tyre and Vehicle Dynamics", 3rd ed., Butterworth-Heinemann 2012, section 4.3.2, and chapter 7
(single contact point transient models).
"""

import os
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp

from .._types import Scalar, VectorLike
from ..linalg.arrays import is_traced
from ..linalg.rotations import cross, norm
from . import fields, magic_formula, tir as tyre_files
from .contact import AbstractNormalLaw
from .terrain import AbstractTerrain
from .tyre import AbstractTyre

_POSITIVE = (
    *("UNLOADED_RADIUS", "Q_RE0", "FNOMIN", "LONGVL", "NOMPRES", "PCX1", "PDX1", "PCY1"),
    *("VERTICAL_STIFFNESS", "LONGITUDINAL_STIFFNESS", "LATERAL_STIFFNESS", "LFZO", "LKY"),
)
_NON_NEGATIVE = ("LMUX", "LMUY", "LCX", "LCY", "LKX")
_NONZERO = ("PKX1", "PDY1", "PKY1", "PKY2", "PTY2")
# A change of these would move the circle.
_LENGTHS = ("UNLOADED_RADIUS", "Q_RE0")


class _Rolling(NamedTuple):
    """A wheel in contact.

    **Fields:** the wrench `push` of the elasticity; along the `normal` its force `spring` and the `damping` force [N];
    the directions `along` the ground; the vector `up` [m] from the lowest point of the circle to the contact's
    centre, and the contact's `centre` [m] in the body's frame; the `slip` velocity [m/s], the velocity forwards
    `rolling` and the regularised `speed`; the `point` of the Magic Formula.
    """

    push: Any
    spring: Any
    damping: Any
    normal: Any
    along: Any
    up: Any
    centre: Any
    slip: Any
    rolling: Any
    speed: Any
    point: magic_formula.Point


class MagicFormulaTyre(AbstractTyre):
    """A tyre by the Magic Formula, version 5.2 or 6.1, with the coefficients of a tyre property file (`.tir`).

    ```python
    upright = {"position": (0.0, 0.0, 0.3), "velocity": (20.0, 0.0, 0.0), "angular_velocity": (0.0, 66.0, 0.0)}
    wheel = spatial.Body("wheel", mass=20.0, inertia=(0.5, 0.9, 0.5), **upright)
    tyre = spatial.MagicFormulaTyre("tyre", "wheel", "tyre.tir", terrain=jaxmb.terrain.Flat(), side="right")
    system = jaxmb.Scene([wheel], forces=[tyre, jaxmb.Gravity((0.0, 0.0, -9.81))]).compile()
    slippery = jaxmb.with_parameters(system, {"tyre.LMUX": 0.5, "tyre.LMUY": 0.5})
    ```

    Forces and moments act at the contact's centre, where the wheel's middle plane meets the ground below its centre.
    They are the load, forces forwards and to the left, the overturning couple and rolling resistance about these
    directions, and the aligning moment about the normal (ISO axes). The slip κ is positive for driving. The slip angle
    α is positive for a wheel that moves to the left, and the inclination γ if its top leans to the right; so PKY1 is
    negative. Angles enter as such, without sines and tangents for large angles.

    The tread deflects in each direction as in `Tyre`, `ḋ = −v_s − (V/σ) d`. The slip velocity v_s belongs to the
    wheel's point at the effective rolling radius below the centre. The slips `κ = d/σ_κ` and `α = −arctan(d/σ_α)` enter
    the Magic Formula. The relaxation lengths σ depend on the load: in version 5.2 by PTX and PTY, in 6.1 as slip
    stiffness over the stiffness of the carcass. They are at least a tenth of the radius. The load is everywhere the
    force along the normal, of elasticity and damping.

    Slips, inclination, load and pressure are clipped at the limits of the file (KPUMIN, ALPMIN, CAMMIN, FZMIN, PRESMIN,
    …). Below FZMIN, and below a thousandth of FNOMIN, forces and moments are proportional to the load. Near standstill
    the offsets of forces at zero slip, the pneumatic trail and rolling resistance vanish. Turn slip is not modelled.

    A load that depends on the speed of rotation, by Q_V1 and Q_V2, has no potential. `potential_energy` of a motion
    contains the elastic energy at the speed of the moment, which is right while this speed does not change; with a
    change of it the tyre takes or gives energy without a force.

    The coefficients, and all scaling factors, are parameters, `"tyre.PDY1"`; `"tyre.mirror"` is −1 for a mirrored tyre.
    `tyre.forces(load=4e3, slip_angle=0.1, camber=0.02)` are the forces and moments without a machine.

    **Arguments:**

    - `tir`: the path of a file, or a mapping of its keys in SI units. `ValueError` for other versions and units, for
        missing keys, for unknown ones, and for effects that are not modelled; scaling factors may be missing.
    - `side`: `"left"` or `"right"`, where the tyre is mounted; it is mirrored if TYRESIDE is the other side. Default as
        in the file.
    - `pressure` [Pa] > 0 of inflation, version 6.1; default INFLPRES, or else NOMPRES.
    - `normal`: the load [N] as a function of the depth, from `jaxmb.contact`; default by the file's stiffness, and in
        version 6.1 by Q_FZ1, Q_FZ2, PFZ1 and Q_V2. Damping is VERTICAL_DAMPING.
    """

    version: tyre_files.Version = fields.choice("5.2", "6.1")
    coefficients: fields.Numbers = fields.numbers()
    # −1 for a mirrored tyre; a number, so that the tyres of both sides are computed together.
    mirror: fields.Number = fields.parameter(unit="1", sign="nonzero")
    pressure: fields.Number = fields.parameter(unit="Pa", sign="positive", optional=True)
    normal: AbstractNormalLaw | None = fields.law(AbstractNormalLaw | None, what="a law from jaxmb.contact")
    stores_by_speed: ClassVar[bool] = True
    dimensions: ClassVar[tuple[int, ...]] = (3,)

    def __init__(
        self,
        name: str,
        body: str,
        tir: str | os.PathLike[str] | Mapping[str, Any],
        *,
        terrain: AbstractTerrain,
        side: Literal["left", "right"] | None = None,
        pressure: Scalar | None = None,
        normal: AbstractNormalLaw | None = None,
        centre: VectorLike | None = None,
        axis: VectorLike | None = None,
        transition_speed: Scalar = 0.1,
        damping_depth: Scalar = 0.01,
        smoothing: Scalar = 1e-3,
        deflection: VectorLike = 0.0,
    ):
        label = f"MagicFormulaTyre {name!r}"
        data = tyre_files.read(label, tir, for_load=normal is None)
        if side is not None and data.side is None:
            raise ValueError(f"{label}: side needs TYRESIDE = 'LEFT' or 'RIGHT' in tir.")
        if side not in (None, "left", "right"):
            raise ValueError(f"{label}: side must be 'left' or 'right', got {side!r}.")
        if pressure is not None and data.version == "5.2":
            raise ValueError(f"{label}: version 5.2 does not depend on the pressure; leave it out.")
        coefficients = data.coefficients
        filled = coefficients.pop("INFLPRES", coefficients.get("NOMPRES"))
        self.name, self.body, self.version, self.coefficients = name, body, data.version, coefficients
        self.mirror = 1.0 if side in (None, data.side) else -1.0
        self.pressure = filled if pressure is None else pressure
        self.terrain, self.normal, self.centre, self.axis = terrain, normal, centre, axis
        self.transition_speed, self.damping_depth, self.smoothing = transition_speed, damping_depth, smoothing
        self.deflection = deflection

    def validate(self):
        # Of numbers that are not traced; operations on JAX arrays would compile here.
        c = {key: float(value) for key, value in self.coefficients.items() if not is_traced(value)}
        for keys, what, holds in (
            (_POSITIVE, "positive", lambda value: value > 0),
            (_NON_NEGATIVE, "at least 0", lambda value: value >= 0),
            (_NONZERO, "nonzero", lambda value: value != 0),
        ):
            for key in keys:
                if not holds(value := c.get(key, 1.0)):
                    raise ValueError(f"{self.label}: {key} must be {what}, got {value:g}.")
        if "Q_FZ1" not in self.coefficients and c.keys() >= {"VERTICAL_STIFFNESS", "UNLOADED_RADIUS", "FNOMIN"}:
            stiffness = c["VERTICAL_STIFFNESS"] * c["UNLOADED_RADIUS"] / c["FNOMIN"]
            if stiffness**2 <= 4 * c.get("Q_FZ2", 0.0):
                raise ValueError(f"{self.label}: Q_FZ2 is too large for VERTICAL_STIFFNESS; give Q_FZ1 as well.")

    @property
    def radius(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.coefficients["UNLOADED_RADIUS"] * self.coefficients.get("Q_RE0", 1.0)

    @property
    def damping(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.coefficients.get("VERTICAL_DAMPING", 0.0)

    def may_vary(self, keys):
        return super().may_vary(keys) and keys[-1] not in _LENGTHS

    def wrenches(self, space, poses, velocities, t):
        wheel = self._rolling(space, poses[0], velocities[0])
        fx, fy, mx, my, mz = self._forces(wheel)
        along, normal = wheel.along, wheel.normal
        force = fx * along[0] + fy * along[1] + wheel.damping * normal
        # The load acts at the contact's centre, not at the lowest point of the circle.
        moment = mx * along[0] + my * along[1] + mz * normal + cross(wheel.up, wheel.spring * normal)
        return (wheel.push + space.point_force(poses[0], wheel.centre, force) + space.moment(poses[0], moment))[None]

    def energy(self, space, poses, t):
        return self._elastic(self._depth(space, poses[0]))[1]

    def energy_in_motion(self, space, poses, velocities, t):
        factor, growth = self._by_spin(space, poses[0], velocities[0])
        return self._elastic(self._depth(space, poses[0], growth), factor)[1]

    def state_rates(self, space, poses, velocities, t):
        wheel = self._rolling(space, poses[0], velocities[0])
        return {"deflection": -wheel.slip - wheel.speed / wheel.point.relaxation_lengths() * self.deflection}

    def state_sizes(self):
        return {"deflection": 0.03 * self.radius}

    def _by_spin(self, space, pose, velocity):
        spin = jnp.dot(space.turning(pose, velocity), space.direction(pose, self.axis))
        return magic_formula.by_spin(self.coefficients, spin)

    def _elastic(self, depth, factor: Any = 1.0):
        """The load and the elastic energy at a depth, with the factor of the load by spin."""
        if self.normal is not None:
            return self.normal.force(depth), self.normal.energy(depth)
        load, energy = magic_formula.elastic(self.coefficients, self.pressure, depth)
        return factor * load, factor * energy

    def _rolling(self, space, pose, velocity) -> _Rolling:
        axle = space.direction(pose, self.axis)
        factor, growth = self._by_spin(space, pose, velocity)
        depth, gradient = jax.value_and_grad(lambda pose: self._depth(space, pose, growth))(pose)
        load = self._elastic(depth, factor)[0]
        push = space.pull_back(pose, -load * gradient)
        normal, spring, damping = self._normal_forces(space, pose, velocity, depth, load)
        load, radius = spring + damping, self.radius + growth
        reach = magic_formula.rolling_radius(self.version, self.coefficients, self.pressure, radius, depth, load)
        along, _, slip, rolling = self._contact(space, pose, velocity, normal, reach)
        upright = norm(cross(axle, normal))
        inclination = self.mirror * jnp.arctan2(jnp.dot(axle, normal), upright)
        loaded = radius - depth / upright
        upwards = self._upwards(space, pose, normal)
        centre = space.body_point(pose, space.point(pose, self.centre) - loaded * upwards)
        point = magic_formula.Point(self.version, self.coefficients, load, inclination, self.pressure)
        up = (self.radius - loaded) * upwards
        speed = self._speed(rolling)
        return _Rolling(push, spring, damping, normal, along, up, centre, slip, rolling, speed, point)

    def _forces(self, wheel: _Rolling) -> magic_formula.Forces:
        """Forces and moments at the contact's centre, along its axes."""
        slips = self.deflection / wheel.point.relaxation_lengths()
        return self._at_slips(wheel.point, slips, wheel.speed, norm(wheel.slip), wheel.rolling / wheel.speed)

    def _steady(self, load, slip_ratio, slip_angle, camber, speed):
        point = magic_formula.Point(self.version, self.coefficients, load, self.mirror * camber, self.pressure)
        slips = jnp.stack([slip_ratio, -jnp.tan(slip_angle)])
        return self._at_slips(point, slips, speed, speed * norm(slips), 1.0)

    def _usual_speed(self, speed):
        return self.coefficients["LONGVL"] if speed is None else speed

    def _at_slips(self, point, slips, speed, slip_speed, travel) -> magic_formula.Forces:
        x, y = slips
        alpha = -self.mirror * jnp.arctan(y)
        forces = point.forces(x, alpha, speed, slip_speed, travel)
        return forces._replace(fy=self.mirror * forces.fy, mx=self.mirror * forces.mx, mz=self.mirror * forces.mz)
