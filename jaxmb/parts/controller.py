"""Forces on joints that a user's function computes from named measurements."""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from . import fields
from .base import AbstractDynamicForce
from .coordinate_parts import AbstractOfJoints
from .forces import generalized_force
from .frames import AbstractFrame
from .names import unknown
from .space import rate_of

# The quantities of a body or a frame, each with the dimension of its space, None for both.
_OF_BODIES = {"position": None, "velocity": None, "angular_velocity": None, "angle": 2, "orientation": 3}


def _pairs(measures: Any) -> Any:
    return tuple(measures.items()) if isinstance(measures, Mapping) else measures


def _names(names: Any) -> Any:
    return (names,) if isinstance(names, str) else tuple(names)


class Controller(AbstractOfJoints, AbstractDynamicForce):
    """Forces on coordinates of joints as a function of measurements and internal states: `function(t, measured, states,
    parameters) -> forces, rates`.

    ```python
    def pid(t, measured, states, p):
        error = p["target"] - measured["angle"]
        torque = p["kp"] * error + p["ki"] * states["integral"] - p["kd"] * measured["rate"]
        return torque, {"integral": error}

    numbers = {"states": {"integral": 0.0}, "parameters": {"kp": 50.0, "ki": 20.0, "kd": 5.0, "target": 0.3}}
    controller = jaxmb.Controller("pid", pid, {"angle": "pin.angle", "rate": "pin.angle_rate"}, "pin.angle", **numbers)
    system = jaxmb.Scene([bar], joints=[pin], forces=[controller]).compile()
    ```

    **Arguments:**

    - `function`: of the time [s] and dictionaries of the measurements, the internal states and the parameters. It
        returns the force [N m, N] on the coordinate that the controller `acts_on`, or a dictionary of forces by
        coordinate; and the rates of the internal states by name, `{}` without states. Controllers with the same
        function are computed together.
    - `measures`: measured quantities by their names in the function. Of a joint: a coordinate `"hinge.angle"` or its
        rate `"hinge.angle_rate"`. Of a body or frame: `"cart.position"` and `velocity` [m, m/s] in world axes (of a
        body at the mass centre, as in its motion); `angular_velocity` [rad/s] (in space in the axes of the body or
        frame); `angle` in the plane; `orientation` in space.
    - `acts_on`: a coordinate, `"slide.displacement"`, or several.
    - `states`: the internal states, such as an integral, with their initial values; their names are `"pid.integral"`.
    - `parameters`: numbers, or modules as in `Force`, by name; they become parameters of the system, `"pid.gain"`.
    - `units` of states and parameters by name, `{"integral": "rad s"}`, for figures and tables.

    Angles of joints in space are known up to full turns, and jump at half a turn.
    """

    function: Callable[..., Any] = fields.function()
    measures: Any = eqx.field(static=True, converter=_pairs)  # pyright: ignore[reportGeneralTypeIssues]
    acts_on: Any = eqx.field(static=True, converter=_names)  # pyright: ignore[reportGeneralTypeIssues]
    states: fields.Numbers = fields.internal_states_by_name()
    parameters: fields.Numbers = fields.numbers()
    units: Any = eqx.field(static=True, converter=_pairs, default=(), kw_only=True)  # pyright: ignore[reportGeneralTypeIssues]
    # A scene fills in the names of the sources, and the names by which the function returns several forces. In
    # `measures` and `acts_on` the index of a source then replaces its name, so that controllers of different joints are
    # stacked.
    source_names: tuple[str, ...] = fields.names(optional=True)
    force_names: tuple[str, ...] = eqx.field(static=True, default_factory=tuple, init=False)
    takes_bodies: ClassVar[bool] = True

    def __check_init__(self):
        names = [name for pair in self.measures for name in pair] if isinstance(self.measures, tuple) else [None]
        if not all(isinstance(name, str) for name in names):
            raise ValueError(
                f"{self.label}: measures must be a dictionary of quantities by the function's names, "
                f"{{'angle': 'hinge.angle'}}, got {self.measures!r}."
            )
        for name in (*dict(self.measures).values(), *self.acts_on):
            if not isinstance(name, str) or name.count(".") != 1:
                raise ValueError(f"{self.label}: a quantity is named 'part.quantity', got {name!r}.")
        if not self.acts_on:
            raise ValueError(f"{self.label}: acts_on names at least one coordinate of a joint.")
        if len(set(self.acts_on)) < len(self.acts_on):
            raise ValueError(f"{self.label}: acts_on names a coordinate twice, got {self.acts_on}.")
        repeated = set(self.states) & set(self.parameters)
        if repeated:
            raise ValueError(f"{self.label}: {repeated.pop()!r} is the name of a state and of a parameter; rename one.")

    @property
    def sources(self):
        return tuple(dict.fromkeys(name.split(".")[0] for name in (*dict(self.measures).values(), *self.acts_on)))

    @property
    def bodies(self):
        of_source = lambda k, name: self.joints[k].bodies if self._is_joint(k) else (name,)
        return tuple(
            dict.fromkeys(body for k, name in enumerate(self.source_names) for body in of_source(str(k), name))
        )

    def of_sources(self, parts, places):
        numbers = {name: str(k) for k, name in enumerate(self.sources)}

        def numbered(name):
            source, quantity = name.split(".")
            return f"{numbers[source]}.{quantity}"

        return (
            super()
            .of_sources(parts, places)
            .with_fields(
                measures=tuple((label, numbered(name)) for label, name in self.measures),
                acts_on=tuple(numbered(name) for name in self.acts_on),
                source_names=self.sources,
                force_names=self.acts_on if len(self.acts_on) > 1 else (),
            )
        )

    def complete(self, space, poses):
        self._check_names(space)
        return self

    def _check_names(self, space):
        for name in (*dict(self.measures).values(), *self.acts_on):
            source, quantity = name.split(".")
            available = self._known(source, space)
            acted = name in self.acts_on
            allowed = (
                available
                if acted or not self._is_joint(source)
                else [*available, *(f"{entry}_rate" for entry in available)]
            )
            if acted and not self._is_joint(source):
                raise ValueError(
                    f"{self.label}: it acts on coordinates of joints, and {self.source_names[int(source)]!r} is not a "
                    "joint."
                )
            if quantity not in allowed:
                listed = [self._called(f"{source}.{entry}") for entry in allowed]
                raise unknown("quantity", self._called(name), listed, self.label)

    def _called(self, name):
        """The name of a quantity, with its source's name in place of the index."""
        source, quantity = name.split(".")
        return f"{self.source_names[int(source)]}.{quantity}"

    def _is_joint(self, source):
        return source in self.joints and not isinstance(self.joints[source], AbstractFrame)

    def _known(self, source, space):
        if self._is_joint(source):
            poses = jnp.tile(space.prepare(np.asarray(space.ground)), (len(self.places[int(source)]), 1))
            return list(jax.eval_shape(lambda x: self.joints[source].coordinates_at(space, x), poses))
        return [name for name, dimension in _OF_BODIES.items() if dimension in (None, space.dimension)]

    def wrenches(self, space, poses, velocities, t):
        forces, _ = self._evaluated(space, poses, velocities, t)
        return generalized_force(
            space,
            self,
            lambda part, x: part._acted(space, x),
            poses,
            velocities,
            lambda value, rate: self._row(space, poses, forces),
        )

    def state_rates(self, space, poses, velocities, t):
        return self._evaluated(space, poses, velocities, t)[1]

    def _evaluated(self, space, poses, velocities, t):
        measured = {label: self._measured(space, poses, velocities, name) for label, name in self.measures}
        out = self.function(t, measured, self.states, self.parameters)
        if not isinstance(out, tuple) or len(out) != 2 or not isinstance(out[1], dict):
            raise ValueError(f"the function of {self.label} must return the forces and a dictionary of rates.")
        forces, rates = out
        if set(rates) != set(self.states):
            names = ", ".join(self.states) or "none"
            raise ValueError(f"the function of {self.label} must return the rates of its states, {names}.")
        return forces, {name: jnp.asarray(rate, poses.dtype) for name, rate in rates.items()}

    def _row(self, space, poses, forces):
        """The forces [N m, N] on all coordinates, raveled one after the other."""
        names = self.force_names or tuple(map(self._called, self.acts_on))
        forces = forces if self.force_names else {names[0]: forces}
        if not isinstance(forces, dict) or set(forces) != set(names) or isinstance(forces[names[0]], dict):
            raise ValueError(f"the function of {self.label} must return the force on {' and '.join(names)}.")
        rows = []
        for name, coordinate in zip(names, self.acts_on, strict=True):
            shape, force = self._coordinate(space, poses, coordinate).shape, jnp.asarray(forces[name], poses.dtype)
            if force.shape != shape:
                raise ValueError(
                    f"the function of {self.label} must return a force of shape {shape} on {name!r}, got {force.shape}."
                )
            rows.append(force.reshape(-1))
        return jnp.concatenate(rows)

    def _acted(self, space, poses):
        return jnp.concatenate([self._coordinate(space, poses, name).reshape(-1) for name in self.acts_on])

    def _coordinate(self, space, poses, name):
        source, quantity = name.split(".")
        return self.coordinates_of(int(source), space, poses)[quantity]

    def _measured(self, space, poses, velocities, name):
        source, quantity = name.split(".")
        if not self._is_joint(source):
            return self._of_body(space, poses, velocities, source, quantity)
        base = quantity.removesuffix("_rate")
        if base == quantity:
            return self._coordinate(space, poses, name)
        coordinate = lambda part, x: part._coordinate(space, x, f"{source}.{base}")
        return rate_of(space, self, coordinate, poses, velocities)[1]

    def _of_body(self, space, poses, velocities, source, quantity):
        (k, *modal), frame, d = self.places[int(source)], self.joints.get(source), space.dimension
        pose, velocity = poses[k], velocities[k]
        if isinstance(frame, AbstractFrame):
            zeta, rates = ([rows[np.array(modal), 0]] if modal else [] for rows in (poses, velocities))
            pose, velocity = frame.pose(space, pose, *zeta), frame.velocity(space, pose, velocity, *zeta, *rates)
        return {
            "position": pose[:d],
            "velocity": velocity[:d],
            "angular_velocity": velocity[2] if d == 2 else velocity[3:],
            "angle": pose[2],
            "orientation": pose[3:7],
        }[quantity]
