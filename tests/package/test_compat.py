"""Names and habits of other libraries that `jaxmb._compat` relies on; a test of each says what an update took away."""

import contextlib
import importlib
import multiprocessing
import os
import pickle
from concurrent.futures import ProcessPoolExecutor
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from precision import single_precision

from jaxmb.linalg.sums import unchecked_take
from jaxmb.manifold.projection import ProjectedSolver
from jaxmb.solvers import directed

MOST_PROGRAMS = 70


@pytest.fixture(scope="module")
def compat():
    return importlib.import_module("jaxmb._compat")


# JAX


def test_members_of_a_batch_can_be_taken_one_after_the_other(compat):
    shapes = []

    @compat.sequential_vmap
    def double(x):
        shapes.append(x.shape)
        return 2 * x

    x = jnp.arange(6.0).reshape(3, 2)
    np.testing.assert_array_equal(jax.vmap(double)(x), 2 * x)
    assert set(shapes) == {(2,)}, "rules of jax.custom_batching hand whole batches to the function"


def test_functions_can_have_rules_for_batches(compat):
    @compat.custom_vmap
    def double(x):
        return 2 * x

    @double.def_vmap
    def rule(size, batched, x):
        assert size == 3 and batched == [True]
        return 2 * x + 1, True

    np.testing.assert_array_equal(jax.vmap(double)(jnp.zeros(3)), np.ones(3))


def test_types_of_numbers(compat):
    assert compat.canonical() == jnp.result_type(float), "jax.dtypes.canonicalize_dtype(float) is no float's type"
    with single_precision():
        assert compat.canonical() == np.float32
        assert compat.canonical(np.float64) == np.float32


def test_weak_types(compat):
    about = "the weak type of arrays is no longer told by `.aval.weak_type`"
    assert compat.is_weakly_typed(jnp.asarray(1.0)) is True, about
    assert compat.is_weakly_typed(jnp.asarray(1.0, float)) is False, about
    jax.jit(lambda x, y: [x, compat.is_weakly_typed(x) and pytest.fail(about)])(jnp.zeros(1), 1.0)
    program = jax.make_jaxpr(lambda x, y: (x, y))(jnp.zeros(2), 1.0)
    strong, weak = map(compat.like_of, program.in_avals)
    assert (strong.shape, strong.weak_type, weak.shape, weak.weak_type) == ((2,), False, (), True), about


def test_places_of_equations(compat):
    (equation,) = jax.make_jaxpr(lambda x: lax.sin(x))(1.0).eqns
    place = compat.place_of(equation.source_info)
    assert place.startswith("test_compat.py:") and "test_places_of_equations" in place, place
    assert compat.place_of(None) == ""


def test_calls_that_jax_evaluates(compat, monkeypatch):
    """Under a derivative, of a compiled function: its value and its tangent."""
    call, seen = compat.pjit.jit_p, []
    monkeypatch.setattr(call, "impl", call.impl)

    def rule(evaluate, name, program, arrays):
        seen.append((name, len(program.in_avals), len(arrays)))
        return [np.asarray(x) for x in evaluate()]

    compat.evaluate_calls_by(rule)
    named = jax.jit(lambda x: jnp.sin(x) * x)
    assert float(jax.grad(named)(0.5)) == pytest.approx(np.cos(0.5) * 0.5 + np.sin(0.5))
    assert {name for name, *_ in seen} == {"<lambda>"} and all(n == m for _, n, m in seen), "jit_p.impl is not called"


def test_arrays_of_weak_types(compat):
    (strong, other) = jax.make_jaxpr(lambda x, y: (x, y))(jnp.zeros(2), 1.0).out_avals
    x = jnp.arange(3.0)
    assert compat.typed_as(strong, x) is x
    weak = compat.typed_as(other, x)
    assert compat.is_weakly_typed(weak) and (weak + np.ones(3, np.float32)).dtype == np.float32
    np.testing.assert_array_equal(weak, [0.0, 1.0, 2.0])


def test_whether_jax_has_started(compat):
    jnp.zeros(1)
    assert compat.has_started() is True, "jax._src.xla_bridge no longer tells whether there are backends"


def test_options_that_xla_takes(compat):
    assert compat.takes_option("xla_disable_hlo_passes"), "names of options no longer stand in the library of jaxlib"
    assert not compat.takes_option("xla_no_option_of_this_name")


def test_results_that_nothing_uses_are_let_go(compat):
    twice, seen = compat.Primitive("twice"), []
    twice.multiple_results = True
    twice.def_abstract_eval(lambda x: [x, x])
    compat.let_go(twice, lambda used, equation: (seen.append(list(used)), ([True], equation))[1])
    traced = jax.make_jaxpr(lambda x: twice.bind(x)[0])(1.0).jaxpr
    compat.partial_eval.dce_jaxpr(traced, [True])
    assert seen == [[True, False]], "jax.interpreters.partial_eval.dce_rules changed their arguments"


def test_jax_makes_the_store_of_programs_that_it_is_told(compat, monkeypatch, tmp_path):
    of_jax = importlib.import_module("jax._src.compilation_cache")
    monkeypatch.setattr(of_jax, "LRUCache", of_jax.LRUCache)

    class Store(compat.CacheInterface):
        def __init__(self, path, *, max_size):
            self.made_of = path, max_size

        def get(self, key):
            return None

        def put(self, key, value):
            pass

    compat.keep_programs_as(Store)
    store, path = of_jax.get_file_cache(str(tmp_path))
    expected = str(tmp_path), jax.config.jax_compilation_cache_max_size
    assert isinstance(store, Store) and store.made_of == expected and path == str(tmp_path)


def test_a_rule_gives_the_executables_of_compiled_functions(compat, monkeypatch):
    calls = importlib.import_module("jax._src.pjit")
    monkeypatch.setattr(calls, "_pjit_call_impl_python", calls._pjit_call_impl_python)
    seen, executables = [], []

    def rule(arrays, params, compile):
        seen.append((params["name"], compat.goes_anywhere(arrays, params)))
        executables.append(executables[0] if executables else compile())
        return executables[-1]

    compat.compile_calls_by(rule)
    x = np.array([0.3, -0.2])
    first, second = jax.jit(lambda x: jnp.sin(x) + x), jax.jit(lambda x: jnp.cos(x) + x)
    np.testing.assert_allclose(first(x), np.sin(x) + x, rtol=1e-15)
    np.testing.assert_array_equal(second(x), first(x))
    assert seen == [("<lambda>", True)] * 2, "_pjit_call_impl_python is not called"
    assert compat.is_pure(executables[0])
    text = compat.pickled_executable(executables[0], "no program of this name")
    with pytest.raises(pickle.UnpicklingError, match="the program was dropped"):
        compat.unpickled_executable(text)


def test_calls_that_go_anywhere(compat, monkeypatch):
    calls = importlib.import_module("jax._src.pjit")
    monkeypatch.setattr(calls, "_pjit_call_impl_python", calls._pjit_call_impl_python)
    seen = []

    def rule(arrays, params, compile):
        seen.append(compat.goes_anywhere(arrays, params))
        return compile()

    compat.compile_calls_by(rule)
    x, place = np.ones(2), jax.sharding.SingleDeviceSharding(jax.devices()[0])
    placed = jax.device_put(x, place)
    del seen[:]
    jax.jit(lambda x: x + 1.0)(placed)
    jax.jit(lambda x: x + 2.0, out_shardings=place)(x)
    jax.jit(lambda x: (jax.debug.callback(lambda: None), x + 3.0)[1])(x)
    assert seen == [False] * 3


def test_how_operations_are_lowered_and_traced(compat):
    assert callable(compat.lowering_of(jax.lax.sin_p, "cpu"))
    assert compat.lowering_of(compat.Primitive("unknown"), "cpu") is None

    def function(x):
        with compat.not_inlined():
            y = x * 2.0
        return x * 2.0 + y

    (one, other, _) = (compat.settings_of(equation) for equation in jax.make_jaxpr(function)(1.0).eqns)
    assert one != other, "an equation no longer has its metadata for XLA"


def test_programs_can_be_read(compat):
    program = jax.make_jaxpr(lambda x: jax.lax.cond(x > 0, lambda: x, lambda: 2.0 * x))(1.0)
    assert isinstance(program, compat.ClosedJaxpr)
    assert any(isinstance(v, compat.Literal) for equation in program.jaxpr.eqns for v in equation.invars)
    kinds = compat.ClosedJaxpr | compat.Jaxpr
    inner = [
        x for own in program.jaxpr.eqns for x in jax.tree.leaves(own.params, is_leaf=lambda x: isinstance(x, kinds))
    ]
    assert any(isinstance(x, kinds) for x in inner), "branches of `cond` are no programs in the parameters of `cond`"


def test_equations_are_evaluated_again(compat):
    x = jnp.array([3.0, 1.0, 2.0])
    program = jax.make_jaxpr(lambda x: jnp.sort(jax.jit(jnp.sin)(x))[::-1])(x)
    values = {program.jaxpr.invars[0]: x}
    for equation in program.jaxpr.eqns:
        out = compat.bound(equation, [values[atom] for atom in equation.invars])
        values |= zip(equation.outvars, out if equation.primitive.multiple_results else [out], strict=True)
        assert compat.is_of_jax(equation.primitive)
    np.testing.assert_array_equal(values[program.jaxpr.outvars[0]], np.sort(np.sin(x))[::-1])
    (equation,) = jax.make_jaxpr(lambda x: unchecked_take(x, np.array([2, 0])))(x).jaxpr.eqns
    assert not compat.is_of_jax(equation.primitive)


def test_sizes_of_scans(compat):
    step = lambda carry, row: ((carry[0] + row, 2 * carry[1]), row * carry[1] + y)
    x, y = jnp.ones((4, 3)), jnp.array(2.0)
    program = jax.make_jaxpr(lambda x, y: lax.scan(lambda c, row: step(c, row * y), (x[0], y), x))(x, y)
    (equation,) = [equation for equation in program.jaxpr.eqns if equation.primitive.name == "scan"]
    constants, carried = compat.sizes_of_scan(equation.params)
    assert (constants + carried + 1, carried) == (len(equation.invars), 2)


def test_calls_that_are_not_inlined(compat):
    def program(separate):
        called = jax.jit(lambda x: jnp.cos(x) + 1)

        def of(x):
            with compat.not_inlined() if separate else contextlib.nullcontext():
                return called(x) * 2

        return jax.jit(of).lower(jnp.ones(3)).compile().as_text()

    assert " call(" in program(True) and " call(" not in program(False)


def test_rules_of_derivatives_in_programs(compat):
    forward, reverse = jax.custom_jvp(jnp.sin), jax.custom_vjp(jnp.sin)
    forward.defjvp(lambda primals, tangents: (jnp.sin(*primals), 2 * tangents[0]))
    reverse.defvjp(lambda x: (jnp.sin(x), x), lambda x, ct: (2 * ct,))
    program = jax.make_jaxpr(lambda x: forward(x) + reverse(x))(1.0)
    held = [set(equation.params) & compat.RULES for equation in program.jaxpr.eqns[:2]]
    about = "the equations of functions with rules for derivatives hold them under other names"
    assert held == [{"jvp_jaxpr_fun"}, {"fwd_jaxpr_thunk", compat.REVERSE, "out_trees"}], about
    (value,) = compat.jaxpr_as_function(program)(1.0)
    np.testing.assert_allclose(value, 2 * np.sin(1.0))
    assert compat.is_weakly_typed(program.jaxpr.invars[0]) is True


def test_inputs_that_a_function_is_computed_from(compat):
    length = jax.jit(lambda x: jnp.sqrt(jnp.vdot(x, x)))

    def function(x):
        jnp.sin(x["unused"])
        return length(x["used"]) + jnp.zeros(2) @ x["without effect"]

    found = compat.used_inputs(function, {name: jnp.zeros(2) for name in ("unused", "used", "without effect")})
    assert found == {"unused": False, "used": True, "without effect": True}


def test_bilinear_operations(compat):
    outer = compat.define_bilinear(
        "outer_of_test",
        lambda a, b: a[..., :, None] * b[..., None, :],
        lambda a, b: (*a.shape, b.shape[-1]),
        (
            lambda c, b: jnp.sum(c * b[..., None, :], axis=-1),
            lambda c, a: jnp.sum(c * a[..., :, None], axis=-2),
        ),
    )
    a, b = np.array([1.0, 2.0]), np.array([3.0, -1.0, 0.5])

    @jax.jit
    def every(a, b):
        out = []
        for own in (outer, jnp.outer):
            value = lambda a, b, own=own: jnp.sum(jnp.sin(own(a, b)) ** 2)
            batch = jax.vmap(own, in_axes=(None, 0))(a, jnp.stack([b, 2 * b]))
            out.append([value(a, b), jax.grad(value, 1)(a, b), jax.jacfwd(jax.grad(value))(a, b), batch])
        return out

    for found, expected in zip(*every(a, b), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-14)


# equinox


def test_linear_operations(compat):
    twice = compat.define_linear(
        "twice",
        lambda a, *, of, lead: of * a,
        lambda shape, *, of, lead: shape,
        lambda c, shape, *, of, lead: of * c,
        parameters=("of",),
    )
    about = "operations of one's own no longer have derivatives, transposes and batches"
    x = np.arange(6.0).reshape(2, 3)
    value = lambda x: jnp.sum(jnp.sin(twice(x, of=2.0)))
    every = jax.jit(lambda x: (jax.grad(value)(x), jax.jacfwd(value)(x), jax.vmap(lambda x: twice(x, of=2.0))(x)))
    for found, expected in zip(every(x), (2 * np.cos(2 * x), 2 * np.cos(2 * x), 2 * x), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12, err_msg=about)


def test_any_of_a_batch(compat):
    found = jax.vmap(lambda x: compat.any_of_batch(x > 1) & True, out_axes=None)(jnp.arange(3.0))
    assert found.shape == () and found, "equinox.internal.unvmap_any no longer makes one condition of those of a batch"


def test_enumerations(compat):
    about = "items of equinox.Enumeration no longer hold their class, their code or all names"

    class Results(diffrax.RESULTS):
        stuck = "It is stuck."

    assert compat.is_enumerated(Results.stuck) and not compat.is_enumerated("stuck"), about
    messages = compat.messages_of(Results.successful)
    assert next(iter(messages)) == "successful" and messages["stuck"] == "It is stuck.", about
    batch = jax.vmap(lambda bad: Results.where(bad, Results.stuck, Results.successful))(jnp.array([True, False]))
    codes = compat.codes_of(batch)
    assert [list(messages)[code] for code in codes] == ["stuck", "successful"], about
    compat.set_message(Results.successful, "fine")
    assert Results[Results.successful] == "fine" and diffrax.RESULTS[diffrax.RESULTS.successful] == "", about


def test_modules_can_be_copied_without_their_checks(compat):
    class Positive(eqx.Module):
        value: Any = eqx.field(converter=float)

        def __check_init__(self):
            if self.value <= 0:
                raise ValueError

    copy = compat.with_values(Positive, {"value": "none"})
    assert type(copy) is Positive and copy.value == "none", "equinox converts or checks fields that are set afterwards"
    assert jax.tree.leaves(copy) == ["none"]
    with pytest.raises(AttributeError):
        copy.value = 1.0


def test_loops_with_buffers(compat):
    def squares(count):
        def body(carry):
            k, table = carry
            return k + 1, compat.buffer_set(table, k, k**2, k != 2)

        carry = 0, -jnp.ones(5, int)
        own = lambda carry: carry[1]
        return compat.while_loop(lambda carry: carry[0] < count, body, carry, buffers=own, max_steps=None, kind="lax")[
            1
        ]

    np.testing.assert_array_equal(squares(4), [0, 1, -1, 9, -1])
    batch = jax.jit(jax.vmap(squares))(jnp.array([1, 4]))
    np.testing.assert_array_equal(batch, [[0, -1, -1, -1, -1], [0, 1, -1, 9, -1]])
    np.testing.assert_array_equal(compat.buffer_set(jnp.zeros(2), 1, jnp.array(3.0)), [0.0, 3.0])


# diffrax


def solve(solver, rate=-1.0, t1=1.0, *, adjoint=None, controller=None, saveat=None):
    term = diffrax.ODETerm(lambda t, y, args: rate * y)
    return diffrax.diffeqsolve(
        term,
        solver,
        0.0,
        t1,
        0.1 * t1,
        jnp.array([1.0, 2.0]),
        adjoint=diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        stepsize_controller=diffrax.ConstantStepSize() if controller is None else controller,
        saveat=diffrax.SaveAt(t1=True) if saveat is None else saveat,
        max_steps=64,
    )


@pytest.mark.slow
def test_terms_are_wrapped_once():
    """The names of diffrax's wrapper are those of `Directed`."""
    seen = []

    class Spy(diffrax.Euler):
        def step(self, terms, *args):
            seen.append(terms)
            return super().step(terms, *args)

    with jax.disable_jit():
        solve(Spy(), t1=-1.0)
    about = "diffrax no longer puts one wrapper with a `term` and a `direction` around the term of a solver"
    assert isinstance(directed.inner_term(seen[0]), diffrax.ODETerm), about
    assert directed.term_of(seen[0]) is directed.inner_term(seen[0]) and directed.direction_of(seen[0]) == -1, about
    assert directed.direction_of(diffrax.ODETerm(lambda t, y, args: y)) == 1


def test_solvers_are_told_tolerances(compat):
    seen = []

    class Tolerances(eqx.Module):
        rtol: Any
        atol: Any
        norm: Any

    class Told(diffrax.AbstractImplicitSolver, diffrax.AbstractAdaptiveSolver):
        tolerances: Tolerances
        term_structure: ClassVar = diffrax.AbstractTerm
        interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation
        root_find_max_steps: ClassVar = 0

        @property
        def root_finder(self):
            return self.tolerances

        def init(self, terms, t0, t1, y0, args):
            seen.append((self.tolerances.rtol, self.tolerances.atol, self.tolerances.norm))

        def order(self, terms):
            return 1

        def func(self, terms, t0, y0, args):
            return terms.vf(t0, y0, args)

        def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
            y1 = y0 + terms.vf_prod(t0, y0, args, terms.contr(t0, t1))
            return y1, jnp.zeros_like(y0), {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful

    controller = diffrax.PIDController(rtol=0.25, atol=0.125, norm=jnp.max)
    jax.eval_shape(lambda: solve(Told(compat.from_controller(Tolerances)), controller=controller).ys)
    about = "diffrax no longer fills in the tolerances of a solver's root_finder from the step size controller"
    assert set(seen) == {(0.25, 0.125, jnp.max)}, about


def test_loops_of_runge_kutta_methods(compat):
    """Also of those inside others."""
    about = "Runge–Kutta methods of diffrax no longer have the field `scan_kind`"
    explicit = diffrax.Tsit5()
    for solver in (explicit, diffrax.Kvaerno3(), ProjectedSolver(explicit, None, 1e-8), diffrax.HalfSolver(explicit)):
        whole = compat.with_loops(solver, "lax")
        assert getattr(whole, "solver", whole).scan_kind == "lax", about
    assert compat.with_loops(diffrax.SemiImplicitEuler(), "lax") == diffrax.SemiImplicitEuler()


def test_steps_of_dense_solutions(compat):
    saveat = diffrax.SaveAt(dense=True, steps=True)
    solution = solve(diffrax.Euler(), t1=-1.0, saveat=saveat)
    starts, direction = compat.steps_of(solution.interpolation)
    about = "dense solutions of diffrax no longer tell their steps in increasing time, and the direction of time"
    assert direction == -1 and direction.dtype == starts.dtype, about
    np.testing.assert_allclose(starts[1:11], -solution.ts[:10], err_msg=about)


def test_traces_are_told_apart(compat):
    outside = compat.current_trace()
    inside = []

    def loop(x):
        own = compat.current_trace()
        lax.fori_loop(0, 2, lambda _, x: inside.append(compat.current_trace()) or x, x)
        inside.extend([own, compat.current_trace()])
        return x

    jax.jit(loop)(1.0)
    of_loop, *of_program = inside
    about = "the trace that operations go to can no longer be told from others"
    assert compat.current_trace() == outside, about
    assert of_program[0] == of_program[1] and outside not in inside and of_loop not in of_program, about


def test_traces_around_a_trace(compat):
    """The program's trace is around its loop's and its derivative's; a loop's is around nothing after it."""
    inside = {}

    def see(name, x):
        inside[name] = list(compat.traces_around())
        return x

    def program(x):
        see("program", x)
        lax.fori_loop(0, 2, lambda _, x: see("loop", x), x)
        jax.jvp(lambda x: see("derivative", x), (x,), (x,))
        return see("after", x)

    jax.jit(program)(1.0)
    own, about = inside["program"][0], "the traces around one can no longer be found: kept values are computed again"
    assert own in inside["loop"] and own in inside["derivative"] and own == inside["after"][0], about
    assert inside["loop"][0] not in inside["after"], about


def test_functions_with_their_rest_computed(compat):
    def slow(angle, x):
        return jax.jit(lambda angle, x: jnp.sin(angle) * x**2 + jnp.cos(angle))(angle, x)

    def run(angle, x):
        own = compat.with_rest_computed(lambda x: slow(angle, x), x)
        return lax.fori_loop(0, 3, lambda _, x: own(x), x)

    loop = next(eqn for eqn in jax.make_jaxpr(run)(0.3, 0.5).eqns if eqn.primitive.name in ("scan", "while"))
    about = "partial evaluation no longer takes what is known out of a function"
    assert "sin" not in str(loop) and "cos" not in str(loop) and "mul" in str(loop), about
    want = 0.5
    for _ in range(3):
        want = np.sin(0.3) * want**2 + np.cos(0.3)
    np.testing.assert_allclose(jax.vmap(run, (0, None))(jnp.array([0.3]), 0.5), [want], rtol=1e-6, err_msg=about)


# The standard library


def test_processes_of_a_pool(compat):
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        own = pool.submit(os.getpid).result()
        assert [process.pid for process in compat.processes_of(pool)] == [own], "a pool no longer lists its processes"
    assert compat.processes_of(pool) == []
