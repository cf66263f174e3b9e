"""Programs found on disk by their traces: each change of a program is another program."""

import hashlib
import importlib
import pickle
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax._src.lru_cache import LRUCache
from precision import single_precision

from jaxmb import _kept_traces
from jaxmb._compat import Primitive, ShapedArray, compile_calls_by, mlir, not_inlined
from jaxmb._kept_programs import KeptPrograms

MOST_PROGRAMS = 160
X = np.array([0.3, -0.2, 1.1])
SETTINGS = {
    "jax_compilation_cache_max_size": 2**28,
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of kept programs, also of small ones."""
    store, calls = (importlib.import_module(f"jax._src.{name}") for name in ("compilation_cache", "pjit"))
    monkeypatch.setattr(store, "LRUCache", KeptPrograms)
    monkeypatch.setattr(calls, "_pjit_call_impl_python", calls._pjit_call_impl_python)
    monkeypatch.setattr(_kept_traces, "_FEWEST", 5)
    compile_calls_by(_kept_traces._compiled)
    settings = SETTINGS | {"jax_compilation_cache_dir": str(tmp_path)}
    before = {name: getattr(jax.config, name) for name in settings}
    for values in (settings, before):
        for name, value in values.items():
            jax.config.update(name, value)
        store.reset_cache()
        _kept_traces._surroundings.cache_clear()
        if values is settings:
            yield tmp_path


@pytest.fixture
def found(folder, monkeypatch):
    """Whether programs were found, in the order of the calls that looked for them."""
    out, read = [], _kept_traces._read

    def noted(store, key):
        executable = read(store, key)
        out.append(executable is not None)
        return executable

    monkeypatch.setattr(_kept_traces, "_read", noted)
    return out


def program(scale=2.0, zero=0.0, table=(1.0, 2.0, 3.0), kind="sin", reverse=False, shift=1.0, turns=3, swap=False):
    """A function of an array, new each time, and the same function of NumPy."""

    def function(x):
        y = getattr(jnp, kind)(x * scale) + jnp.asarray(table, x.dtype)
        y = lax.cumsum(y, axis=y.ndim - 1, reverse=reverse)
        y = lax.fori_loop(0, turns, lambda k, y: 0.5 * y - shift, y)
        out = y - x, 1.0 / jnp.full(x.shape, zero)
        return out[::-1] if swap else out

    def of_numpy(x):
        y = getattr(np, kind)(x * scale) + np.asarray(table, x.dtype)
        y = np.cumsum(y[..., ::-1], -1)[..., ::-1] if reverse else np.cumsum(y, -1)
        for _ in range(turns):
            y = 0.5 * y - shift
        with np.errstate(divide="ignore"):
            out = y - x, 1.0 / np.full(x.shape, zero)
        return out[::-1] if swap else out

    return function, of_numpy


CHANGES = [
    *({"scale": 2.0000001}, {"zero": -0.0}, {"table": (1.0, 2.0, 3.0000001)}, {"kind": "cos"}, {"reverse": True}),
    *({"shift": 1.5}, {"turns": 4}, {"swap": True}, {"x": X.astype(np.float32)}, {"x": X + 1j}),
    *({"x": X[:2], "table": (1.0, 2.0)}, {"donate_argnums": 0}, {"keep_unused": True}, {"inline": "name"}),
    *({"inline": "metadata"}, {"compiler_options": {"xla_backend_optimization_level": 0}}),
]


def run(change, found):
    """Call a program with a change of it, of its argument, or of how it is compiled; whether it was found."""
    x = change.get("x", X)
    options = {name: value for name, value in change.items() if name in ("donate_argnums", "keep_unused")}
    options["compiler_options"] = change.get("compiler_options")
    own = ("x", "inline", *options)
    function, of_numpy = program(**{name: value for name, value in change.items() if name not in own})
    if change.get("inline") == "name":
        function.__name__ = "another"
    if change.get("inline") == "metadata":
        plain = function

        def function(x):
            with not_inlined():
                return plain(x)

        function.__name__ = "function"
    found.clear()
    out = jax.jit(function, **options)(x)
    for y, expected in zip(out, of_numpy(x), strict=True):
        np.testing.assert_allclose(y, expected, rtol=2e-5 if x.dtype == np.float32 else 1e-14, atol=1e-14)
    (hit,) = found
    return hit


@pytest.mark.filterwarnings("ignore:Some donated buffers")
def test_a_change_of_anything_is_another_program(found):
    """With its own results; without a change the program is found."""
    assert [run({}, found) for _ in range(3)] == [False, True, True]
    for change in CHANGES:
        assert [run(change, found) for _ in range(2)] == [False, True], change
    assert run({}, found)


def test_rules_of_derivatives_count_where_they_are_used(found):
    def gradient_and_value(slope):
        @jax.custom_jvp
        def bent(x):
            return jnp.sin(x) * jnp.cos(x) + x

        bent.defjvp(lambda x, dx: (bent(*x), slope * dx[0]))
        total = lambda x: jnp.sum(bent(x) * 2.0 + x * x)
        del found[:]
        value, gradient = jax.jit(total)(X), jax.jit(jax.grad(total))(X)
        np.testing.assert_allclose(value, np.sum(2.0 * (np.sin(X) * np.cos(X) + X) + X * X), rtol=1e-14)
        np.testing.assert_allclose(gradient, 2.0 * slope + 2.0 * X, rtol=1e-14)
        return list(found)

    assert gradient_and_value(3.0) == [False, False]
    assert gradient_and_value(3.0) == [True, True]
    assert gradient_and_value(4.0) == [True, False]


def test_calls_that_jax_evaluates_itself_are_found(found):
    """Of compiled functions in derivatives and batches outside of `jit`."""

    def results():
        function, of_numpy = program()
        compiled = jax.jit(lambda x: jnp.sum(function(x)[0]))
        del found[:]
        gradient = jax.grad(compiled)(X)
        np.testing.assert_allclose(jax.vmap(compiled)(np.stack([X, -X]))[1], of_numpy(-X)[0].sum(), rtol=1e-14)
        return gradient, list(found)

    (first, before), (again, after) = results(), results()
    np.testing.assert_array_equal(first, again)
    assert len(before) >= 2 and not any(before) and after == [True] * len(before)


def test_what_python_computes_is_compiled_anew(folder, found):
    """Callbacks, and operations that are lowered by functions of the user."""

    def of_operation(factor):
        operation = Primitive("times")
        operation.def_abstract_eval(lambda x: ShapedArray(x.shape, x.dtype))
        mlir.register_lowering(operation, mlir.lower_fun(lambda x: factor * x, multiple_results=False))
        return lambda x: jnp.sin(operation.bind(x) + 1.0) * x + jnp.cos(x)

    def of_callback(factor):
        like = jax.ShapeDtypeStruct((3,), float)
        return lambda x: jnp.sin(jax.pure_callback(lambda x: factor * x, like, x) + 1.0) * x + jnp.cos(x)

    for make in (of_operation, of_callback):
        for factor in (2.0, 3.0):
            np.testing.assert_allclose(jax.jit(make(factor))(X), np.sin(factor * X + 1.0) * X + np.cos(X), rtol=1e-14)
    # A function of a package as a parameter is known by its name alone.
    of_function = Primitive("of_function")
    of_function.def_abstract_eval(lambda x, **_: ShapedArray((), x.dtype))
    mlir.register_lowering(of_function, mlir.lower_fun(lax.reduce, multiple_results=False))
    reduced = lambda x: (
        of_function.bind(jnp.sin(x) * x + x, init_values=1.0, computation=lax.mul, dimensions=(0,)) + 1.0
    )
    np.testing.assert_allclose(jax.jit(reduced)(X), np.prod(np.sin(X) * X + X) + 1.0, rtol=1e-14)
    assert found == []
    # A callback to a package is known too, and called all the same.
    like = jax.ShapeDtypeStruct((3,), float)
    for _ in range(2):
        of_package = jax.jit(lambda x: jnp.sin(jax.pure_callback(np.cbrt, like, x) + 1.0) * x + jnp.cos(x))
        np.testing.assert_allclose(of_package(X), np.sin(np.cbrt(X) + 1.0) * X + np.cos(X), rtol=1e-14)
    assert not any(found) and not list(folder.glob("trace-*"))


def test_programs_for_a_device_are_left_to_jax(found):
    place = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    function, of_numpy = program()
    for out in (jax.jit(function)(jax.device_put(X, place)), jax.jit(program()[0], in_shardings=place)(X)):
        np.testing.assert_allclose(out[0], of_numpy(X)[0], rtol=1e-14)
    assert found == []


@pytest.mark.filterwarnings("error")
def test_files_that_cannot_be_read_are_replaced_in_silence(folder, found):
    run({}, found)
    (place,) = folder.glob("trace-*-cache")
    whole = place.read_bytes()
    with_check = lambda text: hashlib.sha256(text).digest() + text
    flipped = bytes([*whole[:-9], whole[-9] ^ 1, *whole[-8:]])
    foreign = b"", b"text", whole[:-1], flipped, with_check(b"text"), with_check(pickle.dumps({"a": 1}))
    for text in foreign:
        place.write_bytes(text)
        assert [run({}, found) for _ in range(2)] == [False, True]
        assert hashlib.sha256(place.read_bytes()[32:]).digest() == place.read_bytes()[:32]
    # The program itself is dropped from the folder.
    (program_file,) = folder.glob("jit_function-*-cache")
    program_file.unlink()
    assert [run({}, found) for _ in range(2)] == [False, True] and program_file.exists()


def test_programs_of_other_settings_and_versions_are_others(folder, found, monkeypatch):
    def surroundings():
        _kept_traces._surroundings.cache_clear()
        settings = tuple((name, repr(value)) for name, value in jax.config.values.items())
        return _kept_traces._surroundings(settings, (), _kept_traces._flags())[1]

    known = [surroundings()]
    assert surroundings() == known[0]

    def other():
        assert surroundings() == surroundings() not in known
        known.append(surroundings())

    with jax.default_matmul_precision("highest"):
        other()
    with single_precision():
        other()
    with monkeypatch.context() as change:
        change.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
        other()
    with monkeypatch.context() as change:
        change.setattr(sys, "version_info", (3, 99, 0))
        other()
    version = _kept_traces.metadata.version
    for name in _kept_traces._PACKAGES:
        with monkeypatch.context() as change:
            change.setattr(_kept_traces.metadata, "version", lambda x, name=name: "0" if x == name else version(x))
            other()
    source = folder / "package" / "source.py"
    source.parent.mkdir()
    with monkeypatch.context() as change:
        change.setattr(_kept_traces, "__file__", str(source))
        for text in ("", "# A comment."):
            source.write_text(text)
            other()
    assert surroundings() == known[0]
    assert not run({}, found)
    with monkeypatch.context() as change:
        change.setattr(_kept_traces.metadata, "version", lambda name: "0")
        other()
        assert [run({}, found) for _ in range(2)] == [False, True]
    assert surroundings() == known[0] and run({}, found)
    jax.config.update("jax_compilation_cache_max_size", 2**27)
    assert surroundings() == known[0]


def test_another_store_keeps_no_traces(folder, found, monkeypatch):
    of_jax = importlib.import_module("jax._src.compilation_cache")
    monkeypatch.setattr(of_jax, "LRUCache", LRUCache)
    of_jax.reset_cache()
    function, of_numpy = program()
    np.testing.assert_allclose(jax.jit(function)(X)[0], of_numpy(X)[0], rtol=1e-14)
    assert found == [] and list(folder.glob("jit_function*")) and not list(folder.glob("trace-*"))
