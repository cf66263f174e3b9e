"""Declarations of the fields of a part: the meaning of each field, stated in one place.

A part declares its fields with the helpers of this file, in place of `equinox.field`:

    class Spring(AbstractForce):
        name: str = name()
        body: str = body_name()
        stiffness: Number = parameter(unit="N/m", sign="positive")
        point: Number = point(body=0, default="origin")

Numbers become read-only arrays and are the part's parameters, `"name.field"`; all other fields are static. A
declaration holds the shape of a number (`"d"` is 2 in the plane and 3 in space), its sign and unit, the body that it is
fixed in, and whether it is optional. Scenes use it to check and stack parts, `identify` to keep parameters positive,
and pictures and reactions to find where a part acts.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._compat import default_float, is_weakly_typed
from ..linalg.arrays import is_traced

# Types of fields. A number may be given as any array-like value and is stored as an array; type checkers do not see the
# converters of these helpers.
if TYPE_CHECKING:
    Number = Numbers = Names = Any
else:
    Number, Numbers, Names = Array, dict[str, Array], tuple[str, ...]

Sign = Literal["positive", "non-negative", "nonzero", "positive definite"]
Size = int | Literal["d"] | None


@dataclasses.dataclass(frozen=True)
class Declaration:
    """The meaning of a field.

    **Fields:**

    - `kind`: `"identity"` for a name that distinguishes stacked parts (`"identities"` for several), `"body"` for the
        name of a body (`"bodies"` for several), `"number"`, `"numbers"` for a dictionary of them, `"law"` for a module
        with parameters, `"part"` for another part of the scene (`"parts"` for a dictionary of them), `"state"` for a
        number of the initial guess, and `"internal"` for an internal state (`"internals"` for a dictionary of them);
        these are not parameters.
    - `shape`: of a number, None for any, and None in it for any size; `sign`; `unit`, `""` for a number without one.
    - `body`: index, among the part's bodies, of the body that a point or direction is fixed in; None for the world.
    - `is_point`: whether the number is a point; `is_direction`: a unit vector; `is_attitude`: unit Euler parameters; of
        several points or unit vectors each row is one.
    - `sizes`: whether the scene's size is computed from this length.
    - `optional`: whether the field may be None, and is computed from the given poses; `at_origin`: whether a point that
        is left out is the origin of its frame.
    - `gives`: the body-fixed fields that a world point or direction determines; `needed`: whether one or the other must
        be given.
    - `of`: the type of a law, or the words of a choice; `what`: a description of the law, for messages.
    - `constant`: whether a number cannot be a function of time.
    """

    kind: str
    shape: tuple[Size, ...] | None = None
    sign: Sign | None = None
    unit: str = ""
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

    @property
    def is_number(self) -> bool:
        return self.kind in ("number", "state", "internal")


@functools.cache
def declarations(cls: type) -> dict[str, Declaration]:
    """The declared fields of a class, in their order."""
    fields = dataclasses.fields(cls)
    return {field.name: field.metadata["declaration"] for field in fields if "declaration" in field.metadata}


def values_of(part: Any) -> dict[str, Any]:
    """The values of all fields of a part by name, at once: each attribute of a module that is asked for takes a
    microsecond, too long for those of thousands of parts.
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

    **Raises:** `ValueError` for anything but a real number or an array of real numbers.
    """
    dtype = default_float()
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
    """The same as a JAX array, which tracers can index."""
    if isinstance(value, Array) and value.dtype == jnp.result_type(float) and not is_weakly_typed(value):
        return value
    value = as_parameter(value)
    return value if isinstance(value, Array) else jax.device_put(value)


def _lenient(convert: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A converter that returns invalid values unchanged: `checks.check_kinds` then names the part and the field."""

    def converter(value: Any) -> Any:
        try:
            return convert(value)
        except (ValueError, TypeError):
            return value

    return converter


def _as_numbers(values: Any) -> Any:
    return {key: as_jax(value) for key, value in values.items()} if isinstance(values, dict) else values


def _as_names(values: Any) -> Any:
    return (values,) if isinstance(values, str) else tuple(values)


_NUMBER, _NUMBERS, _NAMES = _lenient(as_parameter), _lenient(_as_numbers), _lenient(_as_names)


# Helpers


def _field(declaration: Declaration, **options: Any) -> Any:
    static = declaration.kind in ("identity", "identities", "body", "bodies", "choice")
    options = {name: value for name, value in options.items() if value is not dataclasses.MISSING}
    return eqx.field(static=static, metadata={"declaration": declaration}, **options)


def name() -> Any:
    """The name of the part, or of another part that it refers to; stacked parts may differ in it."""
    return _field(Declaration("identity"))


def names(*, optional: bool = False) -> Any:
    """The names of any number of other parts that it refers to; a single name becomes a tuple. `optional`: none by
    default.
    """
    keyword = {"default": (), "kw_only": True} if optional else {}
    return _field(Declaration("identities", optional=optional), converter=_NAMES, **keyword)


def body_name(*, default: Any = dataclasses.MISSING) -> Any:
    """The name of a body that the part acts on. `part.bodies` lists them in the order of the fields."""
    keyword = {} if default is dataclasses.MISSING else {"kw_only": True}
    return _field(Declaration("body"), default=default, **keyword)


def body_names() -> Any:
    """The names of any number of bodies, in a field that must be named `bodies`; a single name becomes a tuple."""
    return _field(Declaration("bodies"), converter=_NAMES)


def choice(*values: str, default: Any = dataclasses.MISSING) -> Any:
    """One of several words; static."""
    return _field(Declaration("choice", of=values), default=default, kw_only=True)


def function(*, default: Any = dataclasses.MISSING, kw_only: bool = False) -> Any:
    """A user function; static."""
    return eqx.field(static=True, kw_only=kw_only, **({} if default is dataclasses.MISSING else {"default": default}))


def parameter(
    *,
    shape: tuple[Size, ...] | None = (),
    unit: str = "",
    sign: Sign | None = None,
    default: Any = dataclasses.MISSING,
    optional: bool = False,
    sizes: bool = False,
    kw_only: bool = True,
    converter: Callable[[Any], Any] | None = None,
    constant: bool = False,
) -> Any:
    """A number or an array of numbers.

    **Arguments:** `shape`, in which `"d"` is the dimension of the space and None any size, None for any; `unit`, for
    information; `sign` of every component: `"positive"`, `"non-negative"`, `"nonzero"`, or `"positive definite"` of a
    matrix; `default`; `optional`: default None, which the part's `complete` replaces; `sizes`: whether the scene's size
    is computed from this length; `converter`, applied before the checks; `constant`: whether it cannot be a function of
    time.
    """
    declaration = Declaration(
        "number", shape=shape, sign=sign, unit=unit, optional=optional, sizes=sizes, constant=constant
    )
    default = None if optional else default
    convert = _NUMBER if converter is None else _lenient(converter)
    return _field(declaration, converter=_optional(convert), default=default, kw_only=kw_only)


def length(**options: Any) -> Any:
    """A length [m] from which the scene's size is computed; arguments as in `parameter`."""
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

    A point of a body is given in the frame of the body, or in that of the frame that the part names in its place. The
    origin of a body's frame is its mass centre, unless the body was given `centre=`.

    **Arguments:** `body`: index among the part's bodies; `shape`: `(None, "d")` for any number of points, a row each;
    `default`: `"origin"`, of that frame, or coordinates; `optional`: default None; `sizes`: whether it contributes to
    the scene's size; `gives`: the body-fixed points that a world point determines at the given poses; `needed=False`:
    both the world point and the one body-fixed point that it gives may be omitted.
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
) -> Any:
    """A unit vector, fixed in a body, or in the world with `body=None`; arguments as in `point`.

    `needed=False`: both the world axis and the body-fixed ones may be omitted.
    """
    declaration = Declaration(
        "number",
        shape=shape,
        body=body,
        is_direction=True,
        optional=optional or bool(gives),
        gives=gives,
        needed=needed,
    )
    default = None if declaration.optional else default
    return _field(declaration, converter=_optional(_NUMBER), default=default, kw_only=True)


def attitude(*, default: Any = dataclasses.MISSING, optional: bool = False, state: bool = False) -> Any:
    """Unit Euler parameters, scalar first."""
    declaration = Declaration("state" if state else "number", shape=(4,), is_attitude=True, optional=optional)
    default = None if optional else default
    return _field(declaration, converter=_optional(_NUMBER), default=default, kw_only=True)


def guess(*, shape: tuple[Size, ...] = (), unit: str, default: Any) -> Any:
    """A number of a body's initial guess, which `assemble` improves; not a parameter."""
    return _field(Declaration("state", shape=shape, unit=unit), converter=_NUMBER, default=default, kw_only=True)


def internal_state(
    *, shape: tuple[Size, ...] | None = (), unit: str = "", default: Any = 0.0, optional: bool = False
) -> Any:
    """An internal state, a number that changes by an equation of first order; see `AbstractDynamicForce`.

    The kernels of the part see the current value in this field; the value that is given here is that of the initial
    guess. It is not a parameter. `optional`: default None, with which the part has no such state.
    """
    declaration = Declaration("internal", shape=shape, unit=unit, optional=optional)
    return _field(declaration, converter=_optional(_NUMBER), default=None if optional else default, kw_only=True)


def internal_states_by_name() -> Any:
    """Internal states of a user function by name, `"part.key"`, with their initial values."""
    return _field(Declaration("internals"), converter=_NUMBERS, default_factory=dict, kw_only=True)


def numbers() -> Any:
    """Parameters of a user function by name, `"part.key"`."""
    return _field(Declaration("numbers"), converter=_NUMBERS, default_factory=dict, kw_only=True)


def part(of: Any) -> Any:
    """Another part, which the scene fills in; its numbers are parameters under that part's own name."""
    return _field(Declaration("part", of=of | None), default=None, kw_only=True)


def law(of: Any, *, what: str, default: Any = dataclasses.MISSING, kw_only: bool = True) -> Any:
    """A module whose numbers are parameters, `"part.field.number"`.

    **Arguments:** `of`: its abstract type, or `X | None`; `what`: a description, for messages.
    """
    return _field(Declaration("law", of=of, what=what), default=default, kw_only=kw_only)


def _optional(convert: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: None if value is None else convert(value)
