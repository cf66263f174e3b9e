"""Undocumented names and behaviour of JAX, equinox, diffrax and the standard library.

Each stands here once, with its purpose and the versions where it was found. `tests/package/test_compat.py` tests each
of them, and says what is missing when an update removes it.
"""

import functools
import importlib.util
import io
import mmap
import operator
import pickle
import pkgutil
import weakref
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
from jax._src import compilation_cache, pjit, xla_bridge
from jax._src.array import ArrayImpl
from jax._src.compilation_cache_interface import CacheInterface
from jax._src.core import JaxprEqnContext
from jax._src.interpreters import mlir as lowerings
from jax._src.interpreters.partial_eval import partial_eval_jaxpr_nounits
from jax._src.lax import linalg
from jax._src.named_sharding import UNSPECIFIED
from jax.core import ShapedArray
from jax.experimental import serialize_executable
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend import core, source_info_util
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir, partial_eval
from jax.interpreters.ad import Zero
from jaxtyping import Array

# The makers of new operations of JAX. (jax.extend.core.Primitive and jax.interpreters, 0.7 to 0.10.) The base class of
# stores of compiled programs. (jax._src.compilation_cache_interface, 0.9 and 0.10.)
__all__ = ["CacheInterface", "Primitive", "ShapedArray", "Zero", "ad", "batching", "mlir", "partial_eval"]

T = TypeVar("T")

# JAX


# A rule of a function in a batch. Derivatives call it without a batch as well. (jax.custom_batching, 0.7 to 0.10.)
custom_vmap = jax.custom_batching.custom_vmap

# The parts of traced programs. (jax.extend.core, 0.7 to 0.10; jax 0.11 changes the parameters of `scan`.)
ClosedJaxpr, Jaxpr, Literal = core.ClosedJaxpr, core.Jaxpr, core.Literal
# Parameters of equations of functions with custom derivative rules: Python functions, `bwd` only with a rule for
# reverse mode. (custom_jvp_call and custom_vjp_call, 0.9 and 0.10.)
REVERSE = "bwd"
RULES = frozenset({"jvp_jaxpr_fun", "fwd_jaxpr_thunk", REVERSE, "out_trees"})
# The parameter of equations of functions with rules for batches. (custom_vmap_call, 0.9 to 0.12.)
BATCH_RULE = "rule"
# A closed jaxpr as a function of its operands. (jax.extend.core.jaxpr_as_fun, 0.9 and 0.10.)
jaxpr_as_function = core.jaxpr_as_fun


# The settings of JAX that an equation was traced with, such as metadata for XLA.
# (jax._src.core.JaxprEqnContext, 0.9 to 0.12.)
settings_of: Callable[[Any], tuple[Any, ...]] = operator.attrgetter(
    *(f"ctx.{name}" for name in JaxprEqnContext.__slots__ if name not in ("configs", "__weakref__"))
)


def bound(equation: Any, operands: Any) -> Any:
    """The outputs of an equation of a traced program.

    (Primitive.get_bind_params, 0.9 to 0.12.)
    """
    return equation.primitive.bind(*operands, **equation.primitive.get_bind_params(equation.params))


def sizes_of_scan(params: Mapping[str, Any]) -> tuple[int, int]:
    """The numbers of constants of a `scan`, and of values that it carries from step to step, from its parameters.

    (`num_consts` and `num_carry` up to jax 0.10, `ft_in` in 0.12.)
    """
    if "num_carry" in params:
        return params["num_consts"], params["num_carry"]
    constants, carried, _ = params["ft_in"].unpack()
    return len(constants), len(carried)


def is_of_jax(primitive: Primitive) -> bool:
    """Whether an operation is JAX's own, and not made by another package.

    (Primitive.impl, a function of the package that made it, 0.9 to 0.12.)
    """
    module = getattr(getattr(primitive, "impl", None), "__module__", None) or "jax"
    return module.split(".")[0] in ("jax", "functools")


def place_of(source_info: Any) -> str:
    """Where an equation stands in the code of a user or a package: file, line and function; empty if unknown.

    (jax.extend.source_info_util.summarize, and Equation.source_info, 0.9 to 0.12.)
    """
    return "" if source_info is None else source_info_util.summarize(source_info).rpartition("/")[2]


def not_inlined() -> Any:
    """A context in which calls of compiled functions stay calls in the program that XLA makes.

    (jax.experimental.xla_metadata.set_xla_metadata, 0.9 to 0.12; `inlineable` is an attribute of XLA.)
    """
    return set_xla_metadata(inlineable="false")


def current_trace() -> Any:
    """The trace that operations go to now, for comparison with another.

    (jax.extend.core.get_opaque_trace_state, 0.9 and 0.10.)
    """
    return core.get_opaque_trace_state()


def traces_around() -> Iterator[Any]:
    """References to the trace that operations go to now, and to those around it, whose values may be used as well.

    (jax._src.core.trace_ctx and Trace.parent_trace, 0.9 and 0.10.)
    """
    trace = jax._src.core.trace_ctx.trace  # pyright: ignore[reportAttributeAccessIssue]
    while trace is not None:
        yield weakref.ref(trace)
        trace = getattr(trace, "parent_trace", None)


def with_rest_computed(function: Callable[[Array], Array], like: Array) -> Callable[[Array], Array]:
    """The same function of an array, with all parts that do not depend on the array computed now: a loop that calls it
    contains nothing else. `like`: an example of the array.

    (jax._src.interpreters.partial_eval.partial_eval_jaxpr_nounits, 0.10.)
    """
    constant_part, varying_part, *_ = partial_eval_jaxpr_nounits(
        jax.make_jaxpr(function)(like), [True], instantiate=True
    )
    constants = jaxpr_as_function(constant_part)()
    return lambda x: jaxpr_as_function(varying_part)(*constants, x)[0]


def like_of(aval: Any) -> jax.ShapeDtypeStruct:
    """Shape and dtype of a value in a traced program, and whether the dtype comes from a Python number.

    (jax.core.ShapedArray.weak_type, 0.7 to 0.10.)
    """
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype, weak_type=aval.weak_type)


def canonical(dtype: Any = float) -> np.dtype:
    """JAX's version of a type, in single precision unless `jax_enable_x64` is on: `jnp.result_type` takes 50 times as
    long. (jax.dtypes.canonicalize_dtype, 0.7 to 0.10.)
    """
    return jax.dtypes.canonicalize_dtype(dtype)


def has_started() -> bool:
    """Whether JAX has searched for its devices, after which it ignores further options of XLA.

    (jax._src.xla_bridge.backends_are_initialized, 0.9 and 0.10.)
    """
    return xla_bridge.backends_are_initialized()


def computes_on_processors() -> bool:
    """Whether JAX computes on processors by default, as far as this is known before it starts: a platform is named, or
    nothing for an accelerator is installed.

    (jax.config.jax_platforms; the module jax_plugins and the entry points of that name, and libtpu, 0.9 to 0.12.)
    """
    platforms = getattr(jax.config, "jax_platforms", None)
    if platforms:
        return platforms.split(",")[0] == "cpu"
    if importlib.util.find_spec("libtpu") or metadata.entry_points(group="jax_plugins"):
        return False
    plugins = importlib.util.find_spec("jax_plugins")
    return plugins is None or not list(pkgutil.iter_modules(plugins.submodule_search_locations))


@functools.cache
def takes_option(name: str) -> bool:
    """Whether this XLA takes an option in `XLA_FLAGS`; an unknown option ends the process.

    (Names of options are strings in the libraries of jaxlib, which end with a zero; jaxlib 0.9 to 0.12.)
    """
    libraries = Path(jaxlib.__file__).parent.glob("*jax_common*")
    return any(_holds(path, b"\0" + name.encode() + b"\0") for path in libraries)


def _holds(path: Path, text: bytes) -> bool:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as library:
        return library.find(text) >= 0


def evaluate_calls_by(rule: Callable[[Callable[[], Any], str, Any, list[Any]], Any]) -> None:
    """Let `rule(evaluate, name, program, arrays)` give the results of calls of compiled functions that JAX evaluates
    itself, as it does where it takes derivatives of them; `evaluate()` is what JAX does.

    (jax._src.pjit.jit_p and its `impl`, 0.10 to 0.12.)
    """
    call: Any = pjit.jit_p
    plain = call.impl

    @functools.wraps(plain)
    def evaluated(*arrays, **params):
        return rule(lambda: plain(*arrays, **params), params["name"], params["jaxpr"], list(arrays))

    call.def_impl(evaluated)


def compile_calls_by(rule: Callable[[tuple[Any, ...], dict[str, Any], Callable[[], Any]], Any]) -> None:
    """Let `rule(arrays, parameters, compile)` give the executables of compiled functions that JAX calls for the first
    time; `compile()` is what JAX does.

    (jax._src.pjit._pjit_call_impl_python, and MeshExecutable.unsafe_call, 0.9 to 0.12.)
    """
    plain = pjit._pjit_call_impl_python

    @functools.wraps(plain)
    def called(*arrays, **params):
        results: list[Any] = []

        def compile() -> Any:
            results[:] = plain(*arrays, **params)
            return results[1]

        executable = rule(arrays, params, compile)
        return tuple(results) or (executable.unsafe_call(*arrays), executable, None, [])

    pjit._pjit_call_impl_python = called


def goes_anywhere(arrays: Any, params: Mapping[str, Any]) -> bool:
    """Whether a call of a compiled function names no device or layout, and has no effect besides its results.

    (The parameters of jax._src.pjit.jit_p, and Array._committed, 0.9 to 0.12.)
    """
    places, layouts = ([*params[f"in_{what}"], *params[f"out_{what}"]] for what in ("shardings", "layouts"))
    return (
        all(x is UNSPECIFIED for x in places)
        and all(x is None for x in layouts)
        and params["ctx_mesh"].empty
        and not params["jaxpr"].effects
        and not any(getattr(x, "_committed", False) for x in arrays)
    )


def is_pure(executable: Any) -> bool:
    """Whether a compiled program holds nothing of its process, as callbacks do.

    (MeshExecutable._unloaded_executable, 0.9 to 0.12.)
    """
    parts = executable._unloaded_executable
    effects = parts.unordered_effects, parts.ordered_effects
    return not any((parts.host_callbacks, parts.keepalive, parts.mut, parts.pgle_profiler, *effects))


def pickled_executable(executable: Any, program: str) -> bytes:
    """What JAX knows of an executable, and the key of its program in JAX's folder.

    (MeshExecutable._unloaded_executable, and the pickler of jax.experimental.serialize_executable, 0.9 to 0.12.)
    """

    class Pickler(serialize_executable._JaxPjrtPickler):
        def persistent_id(self, obj) -> Any:
            return ("program", program) if obj is executable.xla_executable else super().persistent_id(obj)

    file = io.BytesIO()
    Pickler(file).dump(executable._unloaded_executable)
    return file.getvalue()


def unpickled_executable(text: bytes) -> Any:
    """The executable of a text, with its program from JAX's folder. It raises any error if it cannot be read.

    (jax._src.compilation_cache.get_executable_and_time, UnloadedMeshExecutable.load, jax._src.lax.linalg
    .initialize_lapack, 0.9 to 0.12.)
    """
    # JAX finds the functions of LAPACK while it lowers a program that calls them.
    linalg.initialize_lapack()

    class Unpickler(serialize_executable._JaxPjrtUnpickler):
        def persistent_load(self, pid) -> Any:
            if pid[0] != "program":
                return super().persistent_load(pid)
            found, _ = compilation_cache.get_executable_and_time(pid[1], None, self.backend, self.execution_devices)
            if found is None:
                raise pickle.UnpicklingError("the program was dropped")
            return found

    return Unpickler(io.BytesIO(text), jax.devices()[0].client).load().load()


def lowering_of(operation: Primitive, platform: str) -> Callable[..., Any] | None:
    """The function that lowers an operation on a platform, None without one.

    (jax._src.interpreters.mlir._platform_specific_lowerings and _lowerings, 0.9 to 0.12.)
    """
    of_platform: Any = lowerings._platform_specific_lowerings[platform]
    entry = of_platform.get(operation) or lowerings._lowerings.get(operation)
    return None if entry is None else entry.rule


def keep_programs_as(store: type[CacheInterface]) -> None:
    """Let JAX use such a store for its folder of compiled programs, as `store(path, max_size=bytes)`.

    (jax._src.compilation_cache.LRUCache, which JAX makes when it first compiles, 0.9 and 0.10.)
    """
    compilation_cache.LRUCache = store  # pyright: ignore[reportPrivateImportUsage]


def typed_as(aval: Any, array: Array) -> Array:
    """The array with a weak type if a value in a traced program has one.

    (jax._src.array.ArrayImpl, its buffers and its type, jax 0.9 to 0.12.)
    """
    if not aval.weak_type:
        return array
    any_array: Any = array
    kind, place = any_array.aval.update(weak_type=True), any_array.sharding
    return ArrayImpl(kind, place, any_array._arrays, committed=any_array._committed, _skip_checks=True)


def is_weakly_typed(array: Array) -> bool:
    """Whether an array takes the type of its partner in an operation, as Python's numbers do.

    (`aval.weak_type` of arrays and tracers, jax 0.7 to 0.10.)
    """
    return array.aval.weak_type


def sequential_vmap(function: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """The function of an array, which computes the members of a batch one after the other."""
    alone = custom_vmap(function)

    @alone.def_vmap
    def of_members(_, batched, members):
        return (jax.lax.map(function, members), True) if batched[0] else (function(members), False)

    return alone


def define_bilinear(
    name: str,
    evaluate: Callable[..., Array],
    shape: Callable[..., tuple[int, ...]],
    gradients: tuple[Callable[..., Array], Callable[..., Array]],
    parameters: tuple[str, ...] = (),
) -> Callable[..., Array]:
    """A new operation of JAX on two arrays of one type, linear in each, with its derivatives, its transposes and a rule
    for batches; see `jaxmb.linalg.bilinear`.

    (jax.extend.core.Primitive and jax.interpreters, 0.7 to 0.10; `ad.defbilinear` makes derivatives and transposes from
    the gradients.)
    """

    def batched(operands, axes, **static):
        size = next(x.shape[axis] for x, axis in zip(operands, axes, strict=True) if axis is not None)
        front = [
            jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
            for x, axis in zip(operands, axes, strict=True)
        ]
        return op.bind(*front, **static), 0

    of_a, of_b = gradients
    op = Primitive(name)
    op.def_impl(jax.jit(evaluate, static_argnames=parameters))
    op.def_abstract_eval(lambda a, b, **static: ShapedArray(shape(a, b, **static), a.dtype))
    mlir.register_lowering(op, mlir.lower_fun(evaluate, multiple_results=False))
    ad.defbilinear(op, lambda c, a, b, **static: of_a(c, b, **static), lambda c, a, b, **static: of_b(c, a, **static))
    batching.primitive_batchers[op] = batched
    return op.bind


def define_linear(
    name: str,
    evaluate: Callable[..., Array],
    shape: Callable[..., tuple[int, ...]],
    transpose: Callable[..., Array],
    parameters: tuple[str, ...] = (),
) -> Callable[..., Array]:
    """A new operation of JAX on one array, linear in it, with its derivatives, its transpose and a rule for batches.
    All functions take the static number of leading axes of a batch, `lead`; see `jaxmb.linalg.sums`.

    (jax.extend.core.Primitive and jax.interpreters, 0.7 to 0.10.)
    """

    def batched(operands, axes, *, lead, **static):
        return op.bind(jnp.moveaxis(operands[0], axes[0], 0), lead=lead + 1, **static), 0

    op = Primitive(name)
    op.def_impl(jax.jit(evaluate, static_argnames=("lead", *parameters)))
    op.def_abstract_eval(lambda a, **static: ShapedArray(shape(a.shape, **static), a.dtype))
    mlir.register_lowering(op, mlir.lower_fun(evaluate, multiple_results=False))
    ad.deflinear2(op, lambda c, a, **static: [transpose(c, a.aval.shape, **static)])
    batching.primitive_batchers[op] = batched
    return functools.partial(op.bind, lead=0)


def let_go(primitive: Primitive, rule: Callable[[list[bool], Any], tuple[list[bool], Any]]) -> None:
    """Let JAX omit unused results of an operation, by `rule(used results, equation)`, which returns the used operands
    and the new equation.

    (jax.interpreters.partial_eval.dce_rules, 0.7 to 0.12; from 0.12 on a rule also takes the operands used elsewhere,
    before the equation.)
    """
    partial_eval.dce_rules[primitive] = lambda used, *arguments: rule(used, arguments[-1])


def used_inputs(function: Callable[[Any], Any], x: Any) -> Any:
    """Which arrays of the pytree x a function uses, as a pytree of truth values; nothing is compiled.

    (jax.interpreters.partial_eval.dce_jaxpr, 0.7 to 0.10.)
    """
    traced = jax.make_jaxpr(function)(x).jaxpr
    _, used = partial_eval.dce_jaxpr(traced, [True] * len(traced.outvars))
    return jax.tree.unflatten(jax.tree.structure(x), used)


# equinox


def any_of_batch(pred: Any) -> Any:
    """Whether a condition holds for any member of a batch, as one number even under `vmap`.

    (equinox.internal.unvmap_any, 0.13.)
    """
    return eqxi.unvmap_any(pred)


# A loop whose buffers are written in place, also in batches. (equinox.internal.while_loop and buffer_at_set, 0.13.)
while_loop = eqxi.while_loop


def buffer_set(buffer: Any, index: Any, x: Array, pred: Any = True) -> Any:
    """The buffer with an entry `x`, which is written only once; unchanged if `pred` is false."""
    return eqxi.buffer_at_set(buffer, index, x, pred=pred)


def is_enumerated(x: Any) -> bool:
    """Whether an object is an item of an `equinox.Enumeration`, such as a result of diffrax.

    (EnumerationItem._enumeration, 0.13.)
    """
    return hasattr(x, "_enumeration")


def messages_of(item: Any) -> dict[str, str]:
    """The names and messages of all items of an item's enumeration, in the order of their codes.

    (Enumeration._name_to_item, 0.13.)
    """
    kind = item._enumeration
    return {name: kind[entry] for name, entry in kind._name_to_item.items()}


def set_message(item: Any, message: str) -> None:
    """Give an item of an enumeration another message. (Enumeration._index_to_message, 0.13.)"""
    item._enumeration._index_to_message[int(item._value)] = message


def codes_of(item: Any) -> np.ndarray:
    """The codes of an item, or of a batch of them. (EnumerationItem._value, 0.13.)"""
    return np.asarray(item._value)


def with_values(kind: type[T], values: Mapping[str, Any]) -> T:
    """A module of a class with these values of all fields, without `__init__`, converters and checks.

    (Modules are frozen dataclasses whose instances `object.__new__` makes and `object.__setattr__` fills, 0.13.)
    """
    out = object.__new__(kind)
    for name, value in values.items():
        object.__setattr__(out, name, value)
    return out


def changed(module: T, **values: Any) -> T:
    """The same module with other values of some fields, unchecked; `equinox.tree_at` takes ten times as long.

    (Fields are among `vars`, 0.13.)
    """
    any_module: Any = module
    fields = {name: x for name, x in vars(module).items() if name in any_module.__dataclass_fields__}
    return with_values(type(module), fields | values)


# diffrax


def from_controller(tolerances: Callable[..., T]) -> T:
    """Tolerances with `rtol`, `atol` and `norm` that diffrax fills in from the step size controller.

    A solver is never told its controller. Only the root finder of an implicit solver receives tolerances: the public
    `diffrax.with_stepsize_controller_tols`, at the place `solver.root_finder`. So a multistep method calls itself
    implicit, and its `root_finder` is not a root finder. (0.7.)
    """
    return diffrax.with_stepsize_controller_tols(tolerances)()  # pyright: ignore[reportArgumentType]


def with_loops(solver: Any, kind: str) -> Any:
    """A solver whose Runge–Kutta methods, also inside others, loop over their stages by a `kind` of loop.

    (AbstractRungeKutta.scan_kind, 0.7.)
    """
    # diffrax counts a solver around a Runge–Kutta method as one of them.
    is_one = lambda x: diffrax.AbstractRungeKutta in type(x).__mro__
    change = lambda x: eqx.tree_at(lambda s: s.scan_kind, x, kind, is_leaf=lambda x: x is None) if is_one(x) else x
    return jax.tree.map(change, solver, is_leaf=is_one)


def steps_of(interpolation: diffrax.DenseInterpolation) -> tuple[Array, Array]:
    """The starts of all steps of a dense solution, in the solver's time, and the sign of the user's time in it.

    (DenseInterpolation.ts and .direction, 0.7.)
    """
    return interpolation.ts, jnp.asarray(interpolation.direction, interpolation.ts.dtype)


# The standard library


def processes_of(pool: ProcessPoolExecutor) -> list[Any]:
    """The processes of a pool. (ProcessPoolExecutor._processes, Python 3.11.)"""
    return list((pool._processes or {}).values())
