"""Declarations of the fields of a part, checks of its numbers against them, and its contents by them.

A part declares its fields with the helpers of this file, in place of `equinox.field`:

    class Spring(AbstractForce):
        name: str = name()
        body: str = body_name()
        stiffness: Number = parameter(unit="N/m", sign="positive")
        point: Number = point(body=0, default="origin")

Numbers become read-only arrays and are the part's parameters, `"name.field"`, as are the weights of a `module`; all
other fields are static. A declaration holds the shape of a number (`"d"` is 2 in the plane and 3 in space), its sign
and unit, the body that it is fixed in, and whether it is optional. Scenes use it to check and stack parts, `identify`
to keep parameters positive, and pictures and reactions to find where a part acts.
"""

import dataclasses
import functools
from collections.abc import Callable, Collection, Iterator
from typing import TYPE_CHECKING, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._arguments import warn_of_degrees
from .._compat import canonical, is_weakly_typed, with_values
from ..linalg.arrays import is_traced
from .module_weights import ModuleWeights, as_weights
from .units import Unit, power_of_length

# Types of fields. A number may be given as any array-like value and is stored as an array; type checkers do not see the
# converters of these helpers.
if TYPE_CHECKING:
    Number = Numbers = Names = Module = Any
else:
    Number, Numbers, Names, Module = Array, dict[str, Array | ModuleWeights], tuple[str, ...], ModuleWeights

Sign = Literal["positive", "non-negative", "nonzero", "positive definite"]
Size = int | Literal["d", "v"] | None

# Largest error of the length of a unit vector.
_UNIT = 1e-6


@dataclasses.dataclass(frozen=True)
class Declaration:
    """The meaning of a field.

    **Fields:**

    - `kind`: `"identity"`: a name that distinguishes stacked parts; `"body"`: the name of a body; `"number"`;
        `"module"`: a module whose weights are one parameter; `"law"`: a module with parameters; `"part"`: another part
        of the scene; `"state"`: a number of the initial guess; `"internal"`: an internal state. Plurals are tuples of
        names (`"identities"`, `"bodies"`) and dictionaries (`"numbers"`, also of modules; `"parts"`; `"internals"`).
        States are not parameters.
    - `shape` of a number, None for any shape, with entries None for any size; `sign`; `unit`, `"1"` for a number
        without unit, None if unknown, or two units, with an angle and with a length, `("N m", "N")`.
    - `body`: index, among the part's bodies, of the body that a point or direction is fixed in; None for the world.
    - `is_point`: whether the number is a point; `is_direction`: a unit vector; `is_attitude`: unit Euler parameters.
        Several points or unit vectors are rows.
    - `sizes`: whether the scene's size is computed from this length.
    - `optional`: whether the field may be None and is then computed from the given poses; `at_origin`: whether a point
        that is left out is the origin of its frame.
    - `gives`: the body-fixed fields that a world point or direction determines; `needed`: whether one or the other must
        be given.
    - `of`: the type of a law, or the words of a choice; `what`: a description of the law, for messages.
    - `constant`: whether a number cannot be a function of time.
    - `dimension`: 2 or 3, of the scenes that the field is for; None for both.
    """

    kind: str
    shape: tuple[Size, ...] | None = None
    sign: Sign | None = None
    unit: Unit = None
    body: int | None = None
    is_point: bool = False
    is_direction: bool = False
    is_attitude: bool = False
    sizes: bool = False
    optional: bool = False
    at_origin: bool = False
    gives: tuple[str, ...] = ()
    needed: bool = True
    of: Any = None
    what: str = ""
    constant: bool = False
    dimension: int | None = None

    def __post_init__(self):
        for unit in (self.unit,) if isinstance(self.unit, str) else self.unit or ():
            power_of_length(unit)

    @property
    def is_number(self) -> bool:
        return self.kind in ("number", "state", "internal")


@functools.cache
def declarations(cls: type) -> dict[str, Declaration]:
    """The declared fields of a class, in their order."""
    fields = dataclasses.fields(cls)
    return {field.name: field.metadata["declaration"] for field in fields if "declaration" in field.metadata}


def values_of(part: Any) -> dict[str, Any]:
    """The values of all fields of a part by name, at once: access to each attribute of a module takes a microsecond,
    too long for thousands of parts.
    """
    return vars(part)


@functools.cache
def field_names(cls: type) -> tuple[str, ...]:
    """The names of all fields of a class, declared or not."""
    return tuple(field.name for field in dataclasses.fields(cls))


# Conversion


def as_parameter(value: Any) -> Any:
    """A strongly typed array of floats.

    It is a JAX array if any entry is traced, otherwise a read-only NumPy array: building a scene compiles nothing.

    **Raises:** `ValueError` unless it is a real number or an array of real numbers.
    """
    dtype = canonical()
    if is_traced(value):
        return jnp.asarray(value, dtype)
    given = np.asarray(value) if not isinstance(value, dict) else np.array(None)
    if given.dtype.kind not in "fiub":
        raise ValueError(f"expected a real number or an array of real numbers, got {value!r}")
    # A copy, since `jax.device_put` may alias NumPy memory that the caller changes later.
    out = given.astype(dtype)
    out.flags.writeable = False
    return out


def as_jax(value: Any) -> Array:
    """As `as_parameter`, but always a JAX array, which tracers can index."""
    if isinstance(value, Array) and value.dtype == jnp.result_type(float) and not is_weakly_typed(value):
        return value
    value = as_parameter(value)
    return value if isinstance(value, Array) else jax.device_put(value)


def _lenient(convert: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A converter that returns invalid values unchanged: `check_kinds` then names the part and the field."""

    def converter(value: Any) -> Any:
        try:
            return convert(value)
        except (ValueError, TypeError):
            return value

    return converter


def _as_states(values: Any) -> Any:
    return {key: as_jax(value) for key, value in values.items()} if isinstance(values, dict) else values


def _as_numbers(values: Any) -> Any:
    if not isinstance(values, dict):
        return values
    convert = lambda value: as_weights(value) if isinstance(value, eqx.Module) else as_jax(value)
    return {key: convert(value) for key, value in values.items()}


def _as_names(values: Any) -> Any:
    return (values,) if isinstance(values, str) else tuple(values)


_NUMBER, _NUMBERS, _STATES = _lenient(as_parameter), _lenient(_as_numbers), _lenient(_as_states)
_NAMES, _MODULE = _lenient(_as_names), _lenient(as_weights)


# Helpers


def _field(declaration: Declaration, **options: Any) -> Any:
    static = declaration.kind in ("identity", "identities", "body", "bodies", "choice")
    options = {name: value for name, value in options.items() if value is not dataclasses.MISSING}
    return eqx.field(static=static, metadata={"declaration": declaration}, **options)


def name() -> Any:
    """The name of the part, or of another part that it refers to; stacked parts may differ in it.

    ```python
    name: str = jaxmb.parts.name()
    ```
    """
    return _field(Declaration("identity"))


def names(*, optional: bool = False) -> Any:
    """The names of any number of other parts that it refers to; a single name becomes a tuple. `optional`: none by
    default.

    ```python
    sources: tuple[str, ...] = jaxmb.parts.names(optional=True)
    ```
    """
    keyword = {"default": (), "kw_only": True} if optional else {}
    return _field(Declaration("identities", optional=optional), converter=_NAMES, **keyword)


def body_name(*, default: Any = dataclasses.MISSING) -> Any:
    """The name of a body that the part acts on. `part.bodies` lists them in the order of the fields.

    ```python
    vehicle: str = jaxmb.parts.body_name()
    ```
    """
    keyword = {} if default is dataclasses.MISSING else {"kw_only": True}
    return _field(Declaration("body"), default=default, **keyword)


def body_names() -> Any:
    """The names of any number of bodies, in a field that must be named `bodies`; a single name becomes a tuple.

    ```python
    bodies: tuple[str, ...] = jaxmb.parts.body_names()
    ```
    """
    return _field(Declaration("bodies"), converter=_NAMES)


def choice(*values: str, default: Any = dataclasses.MISSING) -> Any:
    """One of several words; static.

    ```python
    frame: str = jaxmb.parts.choice("world", "body", default="world")
    ```
    """
    return _field(Declaration("choice", of=values), default=default, kw_only=True)


def function(*, default: Any = dataclasses.MISSING, kw_only: bool = False) -> Any:
    """A user function; static.

    ```python
    from collections.abc import Callable
    height: Callable[..., jax.Array] = jaxmb.parts.function()
    ```
    """
    return eqx.field(static=True, kw_only=kw_only, **({} if default is dataclasses.MISSING else {"default": default}))


def parameter(
    *,
    shape: tuple[Size, ...] | None = (),
    unit: Unit = None,
    sign: Sign | None = None,
    default: Any = dataclasses.MISSING,
    optional: bool = False,
    sizes: bool = False,
    kw_only: bool = True,
    converter: Callable[[Any], Any] | None = None,
    constant: bool = False,
    dimension: int | None = None,
) -> Any:
    """A number or an array of numbers.

    ```python
    stiffness: jaxmb.parts.Number = jaxmb.parts.parameter(unit="N/m", sign="positive")
    ```

    **Arguments:**

    - `shape`, in which `"d"` is the dimension of the space, `"v"` the size of a velocity and None any size; None for
        any shape.
    - `unit`: a product of powers of SI units, `"1"` for a number without unit; two units for a number of a coordinate,
        with an angle and with a length, `("N m/rad", "N/m")`; None, the default, if unknown: `report.stress_test` then
        cannot scale lengths.
    - `sign` of every component: `"positive"`, `"non-negative"`, `"nonzero"`, or `"positive definite"` of a matrix.
    - `default`; `optional`: default None, which the part's `complete` replaces.
    - `sizes`: whether the scene's size is computed from this length; `constant`: whether it cannot be a function of
        time; `dimension` of the scenes that have it, 2 or 3, default both; `converter`, applied before the checks.

    **Raises:** `ValueError` for a unit that cannot be read.
    """
    options = {"optional": optional, "sizes": sizes, "constant": constant, "dimension": dimension}
    declaration = Declaration("number", shape=shape, sign=sign, unit=unit, **options)
    default = None if optional else default
    convert = _NUMBER if converter is None else _lenient(converter)
    return _field(declaration, converter=_optional(convert), default=default, kw_only=kw_only)


def length(**options: Any) -> Any:
    """A length [m] from which the scene's size is computed; arguments as in `parameter`.

    ```python
    radius: jaxmb.parts.Number = jaxmb.parts.length(sign="positive")
    ```
    """
    return parameter(**({"unit": "m", "sizes": True} | options))


def point(
    *,
    body: int | None,
    shape: tuple[Size, ...] = ("d",),
    default: Any = dataclasses.MISSING,
    optional: bool = False,
    sizes: bool = True,
    gives: tuple[str, ...] = (),
    needed: bool = True,
) -> Any:
    """A point [m], fixed in a body, or in the world with `body=None`.

    ```python
    point_b: jaxmb.parts.Number = jaxmb.parts.point(body=1, default="origin")
    ```

    A point of a body is given in the body's frame, or in the frame that the part names in its place. The origin of a
    body's frame is its mass centre, unless the body was given `centre=`.

    **Arguments:** `body`: index among the part's bodies; `shape`: `(None, "d")` for any number of points, a row each;
    `default`: `"origin"`, of that frame, or coordinates; `optional`: default None; `sizes`: whether it contributes to
    the scene's size; `gives`: the body-fixed points that a world point determines at the given poses; `needed=False`:
    both the world point and the body-fixed point that it gives may be omitted.
    """
    at_origin = isinstance(default, str)
    if at_origin and default != "origin":
        raise ValueError(f"the default of a point must be 'origin' or coordinates, got {default!r}")
    declaration = Declaration(
        "number",
        shape=shape,
        unit="m",
        body=body,
        is_point=True,
        sizes=sizes,
        optional=optional or at_origin or bool(gives),
        at_origin=at_origin,
        gives=gives,
        needed=needed,
    )
    default = None if declaration.optional else default
    return _field(declaration, converter=_optional(_NUMBER), default=default, kw_only=True)


def axis(
    *,
    body: int | None,
    shape: tuple[Size, ...] = ("d",),
    default: Any = dataclasses.MISSING,
    optional: bool = False,
    gives: tuple[str, ...] = (),
    needed: bool = True,
    dimension: int | None = None,
) -> Any:
    """A unit vector, fixed in a body, or in the world with `body=None`; arguments as in `point`.

    ```python
    axis_a: jaxmb.parts.Number = jaxmb.parts.axis(body=0, default=(0.0, 0.0, 1.0))
    ```

    `needed=False`: both the world axis and the body-fixed ones may be omitted; `dimension` as in `parameter`.
    """
    declaration = Declaration(
        "number",
        shape=shape,
        unit="1",
        body=body,
        is_direction=True,
        optional=optional or bool(gives),
        gives=gives,
        needed=needed,
        dimension=dimension,
    )
    default = None if declaration.optional else default
    return _field(declaration, converter=_optional(_NUMBER), default=default, kw_only=True)


def attitude(*, default: Any = dataclasses.MISSING, optional: bool = False, state: bool = False) -> Any:
    """Unit Euler parameters, scalar first, for spatial scenes.

    ```python
    orientation: jaxmb.parts.Number = jaxmb.parts.attitude(default=(1.0, 0.0, 0.0, 0.0))
    ```
    """
    kind = "state" if state else "number"
    declaration = Declaration(kind, shape=(4,), unit="1", is_attitude=True, optional=optional, dimension=3)
    default = None if optional else default
    return _field(declaration, converter=_optional(_NUMBER), default=default, kw_only=True)


def guess(*, shape: tuple[Size, ...] = (), unit: Unit, default: Any) -> Any:
    """A number of a body's initial guess, which `assemble` improves; not a parameter.

    ```python
    angular_velocity: jaxmb.parts.Number = jaxmb.parts.guess(unit="rad/s", default=0.0)
    ```
    """
    return _field(Declaration("state", shape=shape, unit=unit), converter=_NUMBER, default=default, kw_only=True)


def internal_state(
    *, shape: tuple[Size, ...] | None = (), unit: Unit = None, default: Any = 0.0, optional: bool = False
) -> Any:
    """An internal state, a number that changes by an equation of first order; see `AbstractDynamicForce`.

    ```python
    torque: jaxmb.parts.Number = jaxmb.parts.internal_state(unit="N m")
    ```

    The kernels of the part see the current value in this field; its given value is the initial guess. It is not a
    parameter. `optional`: default None, which means no such state.
    """
    declaration = Declaration("internal", shape=shape, unit=unit, optional=optional)
    return _field(declaration, converter=_optional(_NUMBER), default=None if optional else default, kw_only=True)


def internal_states_by_name() -> Any:
    """Internal states of a user function by name, `"part.key"`, with their initial values."""
    return _field(Declaration("internals"), converter=_STATES, default_factory=dict, kw_only=True)


def numbers() -> Any:
    """Parameters of a user function by name, `"part.key"`: numbers, and modules as in `module`.

    ```python
    parameters: jaxmb.parts.Numbers = jaxmb.parts.numbers()
    ```
    """
    return _field(Declaration("numbers"), converter=_NUMBERS, default_factory=dict, kw_only=True)


def module() -> Any:
    """An equinox module, such as a neural network, whose weights are one parameter `"part.field"`, a vector.

    ```python
    from typing import Any
    net: Any = jaxmb.parts.module()
    ```

    The weights are all arrays of floating-point numbers in it; the rest, such as sizes and functions, is static. The
    kernels of the part call it as the module, `self.net(x)`; `self.net.module` is the module itself.
    """
    return _field(_MODULE_FIELD, converter=_MODULE, kw_only=True)


_MODULE_FIELD = Declaration("module", shape=(None,))


def part(of: Any) -> Any:
    """Another part, which the scene fills in; its numbers are parameters under that part's name."""
    return _field(Declaration("part", of=of | None), default_factory=lambda: None, init=False)


def law(of: Any, *, what: str, default: Any = dataclasses.MISSING, kw_only: bool = True) -> Any:
    """A module whose numbers are parameters, `"part.field.number"`.

    ```python
    terrain: jaxmb.terrain.AbstractTerrain = jaxmb.parts.law(jaxmb.terrain.AbstractTerrain, what="a terrain")
    ```

    **Arguments:** `of`: its abstract type, or `X | None`; `what`: a description, for messages.
    """
    return _field(Declaration("law", of=of, what=what), default=default, kw_only=kw_only)


def _optional(convert: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: None if value is None else convert(value)


# Checks of values against declarations


def check_kinds(part: Any, label: str) -> None:
    """Raise a `ValueError` if the value of a field is not of the declared kind."""
    values = values_of(part)
    for field, declared in declarations(type(part)).items():
        value = values[field]
        if declared.is_number:
            if not _is_number(value) and not (value is None and declared.optional):
                raise ValueError(
                    f"{label}: {field}: expected a real number or an array of real numbers, got {value!r}."
                )
        elif declared.kind in ("identity", "body"):
            if not isinstance(value, str):
                raise ValueError(f"{label}: {field} must be a name, got {value!r}.")
        elif declared.kind in ("identities", "bodies"):
            given = value or declared.optional
            if not isinstance(value, tuple) or not all(isinstance(name, str) for name in value) or not given:
                what = "a body" if declared.kind == "bodies" else "a part"
                raise ValueError(f"{label}: {field} must be the name of {what} or several names, got {value!r}.")
        elif declared.kind == "choice":
            if value not in declared.of:
                raise ValueError(f"{label}: {field} must be one of {declared.of}, got {value!r}.")
        elif declared.kind in ("numbers", "internals"):
            if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
                raise ValueError(f"{label}: {field} must be a dictionary of numbers, got {value!r}.")
            for key, number in value.items():
                if not key or "." in key:
                    raise ValueError(f"{label}: names of {field} must not be empty or contain a dot, got {key!r}.")
                if declared.kind == "numbers" and isinstance(number, eqx.Module):
                    _check_module(number, f"{label}: {key}")
                elif not _is_number(number):
                    raise ValueError(f"{label}: {key}: expected a real number or an array, got {number!r}.")
        elif declared.kind == "module":
            _check_module(value, f"{label}: {field}")
        elif not isinstance(value, declared.of):
            raise ValueError(f"{label}: {field} must be {declared.what}, got {value!r}.")


def _check_module(value: Any, label: str) -> None:
    try:
        as_weights(value)
    except ValueError as error:
        raise ValueError(f"{label}: {error}.") from None


def _is_number(value: Any) -> bool:
    # JAX transformations may put other objects in place of arrays.
    return hasattr(value, "shape") and hasattr(value, "dtype") and value.dtype.kind == "f"


def in_range(declared: Declaration, values: Float[Array, "..."]) -> Bool[Array, ""]:
    """Whether traced numbers, perhaps of several parts, are finite, of the declared sign, and unit vectors."""
    values, sign = lax.stop_gradient(values), declared.sign
    ok = jnp.all(jnp.isfinite(values))
    if sign == "nonzero":
        ok &= jnp.all(values != 0)
    elif sign == "positive":
        ok &= jnp.all(values > 0)
    elif sign == "non-negative":
        ok &= jnp.all(values >= 0)
    elif sign == "positive definite":
        minors = [jnp.linalg.det(values[..., :k, :k]) for k in range(1, values.shape[-1] + 1)]
        ok &= jnp.all(jnp.stack(minors) > 0)
    if declared.is_direction or declared.is_attitude:
        ok &= jnp.all(jnp.abs(jnp.linalg.norm(values, axis=-1) - 1.0) <= _UNIT)
    return ok


def check_numbers(part: Any, label: str, dimension: int, prefix: str = "") -> None:
    """Raise a `ValueError` for numbers of wrong shape or sign, non-finite numbers, and directions that are not unit
    vectors, in the part and its laws.
    """
    values = values_of(part)
    for field, declared in declarations(type(part)).items():
        value, shown = values[field], prefix + field
        if declared.kind == "law":
            if value is not None:
                check_numbers(value, label, dimension, f"{shown}.")
        elif declared.kind == "numbers":
            for key, number in value.items():
                _check_finite(number, label, f"{prefix}{key}")
        elif declared.kind == "module":
            _check_finite(value, label, shown)
        elif declared.is_number and value is not None and not is_traced(value):
            _check_number(declared, label, shown, np.asarray(value), dimension)


def warn_of_angles(part: Any, given: Any, names: Collection[str] | None = None, *, stacklevel: int) -> None:
    """Warn of a number of a part that is an angle in degrees, by all appearances.

    Angles of joints count turns, so the warning is for multiples of five beyond a full turn; for the initial guess of a
    body it is for any angle beyond.

    **Arguments:** the `part` in a scene, and the `given` part, whose omitted numbers do not count; `names` of its
    numbers, `"field"` or `"law.field"`, None for all; `stacklevel`: the user's place, counted from the caller.
    """
    for shown, declared, angles in _angles(part, given):
        if names is not None and shown not in names:
            continue
        is_guess = declared.kind == "state"
        beyond = angles[(np.abs(angles) > 2 * np.pi) & (is_guess | (angles % 5 == 0))]
        if beyond.size:
            warn_of_degrees(part.label if is_guess else f"{part.label}, {shown}", beyond[0], stacklevel + 1)
            return


def _angles(part: Any, given: Any, prefix: str = "") -> Iterator[tuple[str, Declaration, np.ndarray]]:
    """The given angles of a part and of its laws, each with the number's name and declaration."""
    values = values_of(given)
    for field, declared in declarations(type(given)).items():
        value = values[field]
        if value is None or is_traced(value):
            continue
        if declared.kind == "law":
            yield from _angles(None, value, f"{prefix}{field}.")
        elif declared.is_number:
            # The numbers of laws have one unit.
            is_angle = declared.unit == "rad" if part is None else part.is_angle(field, declared.unit)
            if np.any(is_angle):
                value = np.asarray(value)
                yield prefix + field, declared, value[np.broadcast_to(is_angle, value.shape)]


def _check_finite(value: Any, label: str, shown: str) -> None:
    # The values of a module are its weights.
    for number in jax.tree.leaves(value):
        if not is_traced(number) and not np.all(np.isfinite(number)):
            raise ValueError(f"{label}: {shown} must be finite, got {np.asarray(number)}.")


def _check_number(declared: Declaration, label: str, shown: str, value: np.ndarray, dimension: int) -> None:
    if declared.dimension not in (None, dimension):
        scenes = "planar" if declared.dimension == 2 else "spatial"
        raise ValueError(f"{label}: {shown} belongs to {scenes} scenes; leave it out.")
    if declared.shape is not None:
        sizes: dict[Any, int] = {"d": dimension, "v": 3 * (dimension - 1)}
        shape = tuple(sizes.get(size, size) for size in declared.shape)
        any_size = len(shape) == value.ndim and all(a in (None, b) for a, b in zip(shape, value.shape, strict=True))
        if not any_size:
            wanted = str(shape).replace("None", "any")
            raise ValueError(f"{label}: {shown} must have shape {wanted}, got {value.shape}.")
    if declared.kind == "internal":
        return  # In a compiled scene its values are in the state.
    if not np.isfinite(value).all():
        raise ValueError(f"{label}: {shown} must be finite, got {value.tolist()}.")
    sign = declared.sign
    if sign == "nonzero" and (value == 0).any():
        raise ValueError(f"{label}: {shown} must not be zero.")
    if (sign == "positive" and (value <= 0).any()) or (sign == "non-negative" and (value < 0).any()):
        raise ValueError(f"{label}: {shown} must be {sign}, got {value.tolist()}.")
    for row in np.atleast_2d(value) if declared.is_direction or declared.is_attitude else ():
        size = float(np.linalg.norm(row))
        if abs(size - 1.0) <= _UNIT:
            continue
        if declared.is_attitude:
            raise ValueError(
                f"{label}: {shown} must be unit Euler parameters (e0, e1, e2, e3), scalar first, got {row.tolist()} "
                f"of length {size:.6g}; normalise them, or make them with rotations.from_axis_angle."
            )
        cure = "divide it by its length" if size > 0 else "give a direction"
        raise ValueError(f"{label}: {shown} must be a unit vector, got {row.tolist()} of length {size:.6g}; {cure}.")


def check_matrices(part: Any, label: str, prefix: str = "") -> None:
    """Raise a `ValueError` for numbers that are declared as positive definite matrices and are not, in the part and its
    laws.
    """
    values = values_of(part)
    for field, declared in declarations(type(part)).items():
        value, shown = values[field], prefix + field
        if declared.kind == "law" and value is not None:
            check_matrices(value, label, f"{shown}.")
        if declared.sign != "positive definite" or value is None or is_traced(value):
            continue
        matrix = np.asarray(value)
        if matrix.ndim < 2 or matrix.shape[-1] != matrix.shape[-2]:
            raise ValueError(f"{label}: {shown} must be a square matrix, got shape {matrix.shape}.")
        transposed = np.swapaxes(matrix, -1, -2)
        if not np.allclose(matrix, transposed, rtol=0.0, atol=1e-9 * np.max(np.abs(matrix), initial=0.0)):
            raise ValueError(f"{label}: {shown} must be symmetric, got {matrix.tolist()}; use (A + A.T) / 2.")
        sizes = np.linalg.eigvalsh(matrix)
        if np.any(sizes[..., 0] <= 0):
            raise ValueError(f"{label}: {shown} must be positive definite, got eigenvalues {sizes.tolist()}.")


# Contents of a part


def anonymous(part: Any) -> Any:
    """The part without the names that distinguish stacked parts, and without the initial guess of bodies."""
    declared, values = declarations(type(part)), values_of(part)
    out = {}
    for field in field_names(type(part)):
        value, kind = values[field], declared[field].kind if field in declared else None
        if kind in ("identity", "body"):
            value = ""
        elif kind in ("identities", "bodies"):
            value = ("",) * len(value)
        elif kind == "state":
            value = None
        elif kind in ("part", "law"):
            value = None if value is None else anonymous(value)
        elif kind == "parts":
            value = {key: anonymous(inner) for key, inner in value.items()}
        out[field] = value
    return with_values(type(part), out)


def inner_parts(part: Any, prefix: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """All other parts inside a part, at any depth, each with its path of keys before it."""
    for name in _fields_of_parts(type(part)):
        value: Any = getattr(part, name)
        held = value if isinstance(value, dict) else {} if value is None else {None: value}
        for key, inner in held.items():
            keys = (*prefix, name) if key is None else (*prefix, name, key)
            yield keys, inner
            yield from inner_parts(inner, keys)


@functools.cache
def _fields_of_parts(cls: type) -> tuple[str, ...]:
    return tuple(name for name, declaration in declarations(cls).items() if declaration.kind in ("part", "parts"))


def internal_states(part: Any) -> dict[str, tuple[str, ...]]:
    """The paths of keys to the internal states of a part, by their names."""
    states = {}
    for name, declared in declarations(type(part)).items():
        if declared.kind == "internal" and getattr(part, name) is not None:
            states[name] = (name,)
        elif declared.kind == "internals":
            states |= {key: (name, key) for key in getattr(part, name)}
    return states


def paths(part: Any) -> Iterator[tuple[tuple[str, ...], tuple[str, ...], Declaration]]:
    """The parameters of a part itself, without the parts in it.

    For each: its path of keys; the path in its name, without the keys of fields that are dictionaries; and its
    declaration, empty for an entry of a dictionary. The weights of a module have the name of the module.
    """
    declared = declarations(type(part))
    for field in field_names(type(part)):
        declaration = declared.get(field, _ANY_NUMBER)
        if declaration.kind not in ("state", "internal", "internals", "part", "parts"):
            yield from _paths(getattr(part, field), (field,), (field,), declaration)


_ANY_NUMBER = Declaration("number")


def _paths(value: Any, keys: tuple[str, ...], shown: tuple[str, ...], declared: Declaration):
    if eqx.is_inexact_array(value):
        yield keys, shown, declared
    elif declared.kind == "module":
        yield (*keys, "values"), shown, declared
    elif isinstance(value, dict):
        for key, entry in value.items():
            is_module = declared.kind == "numbers" and isinstance(entry, eqx.Module)
            yield from _paths(entry, (*keys, key), (*shown[:-1], key), _MODULE_FIELD if is_module else _ANY_NUMBER)
    elif isinstance(value, eqx.Module):
        for inner, name, declaration in paths(value):
            yield (*keys, *inner), (*shown, *name), declaration


def entry(value: Any, keys: tuple[str, ...]) -> Any:
    """The value at a path of attribute names and dictionary keys."""
    for key in keys:
        value = value[key] if isinstance(value, dict) else getattr(value, key)
    return value
