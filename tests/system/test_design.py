"""Design variables: what follows from them, in what ranges, and derivatives along them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from designed_four_bar import designed
from identifying import free_parameters

import jaxmb as mb
from jaxmb import planar
from jaxmb.lagrangian import LagrangianSystem
from jaxmb.report.subject import subject


@pytest.fixture(scope="module")
def plain():
    return mb.mechanisms.four_bar()


@pytest.fixture(scope="module")
def machine(plain):
    return designed(plain)


@pytest.mark.slow
def test_design_variable_sets_everything_that_follows(plain, machine):
    longer = mb.with_parameters(machine, {"rod": 3.2, "crank.mass": 2.0})
    known = mb.parameters(longer)
    assert type(machine) is type(plain.system)
    assert float(known["rod"]) == 3.2 and float(known["crank"]) == 1.0
    np.testing.assert_allclose(known["C.point_a"], [1.6, 0.0])
    np.testing.assert_allclose(known["B.point_b"], [-1.6, 0.0])
    np.testing.assert_allclose(known["coupler.inertia"], planar.rod(3.0, 3.2))
    assert float(known["crank.mass"]) == 2.0
    by_hand = {name: known[name] for name in mb.parameters(plain.system)}
    same = mb.with_parameters(plain.system, by_hand)
    start = mb.assemble(longer, plain.state, fix=plain.fix, rates=plain.rates)
    other = mb.assemble(same, plain.state, fix=plain.fix, rates=plain.rates)
    np.testing.assert_array_equal(start.q, other.q)


@pytest.mark.slow
def test_design_variable_in_a_batch(machine, plain):
    def height(rod):
        new = mb.with_parameters(machine, {"rod": rod})
        return mb.assemble(new, plain.state, fix=plain.fix, throw=False).q[4]

    rods = jnp.array([2.8, 3.0, 3.1])
    np.testing.assert_allclose(jax.jit(jax.vmap(height))(rods), [height(rod) for rod in rods], rtol=1e-12)


def test_design_variables_are_left_out_of_reports(machine, plain):
    about = subject(machine, plain.state, 1.0).system
    assert about.design == () and "rod" not in mb.parameters(about)
    assert float(mb.parameters(mb.with_parameters(about, {"coupler.inertia": 1.0}))["coupler.inertia"]) == 1.0


def test_design_variables_of_variables(machine):
    two = mb.design(machine, {"size": 1.0, "inertia": [0.2, 0.3]}, lambda v: {"rod": 3 * v["size"], **inertias(v)})
    known = mb.parameters(mb.with_parameters(two, {"size": 1.1}))
    np.testing.assert_allclose(known["rod"], 3.3)
    np.testing.assert_allclose(known["C.point_a"], [1.65, 0.0])
    np.testing.assert_allclose(known["rocker.inertia"], 0.3)
    with pytest.raises(ValueError, match="follows from the design variables size, inertia"):
        mb.with_parameters(two, {"rod": 3.0})


def inertias(v):
    return {"crank.inertia": v["inertia"][0], "rocker.inertia": v["inertia"][1]}


def test_design_variables_are_in_a_description(machine):
    text = str(machine)
    assert "design variables" in text and "3 m" in text and "within 0.1 … 9" in text and "coupler.inertia" in text
    seen = []
    jax.eval_shape(lambda rod: seen.append(str(mb.with_parameters(machine, {"rod": rod}))), 3.0)
    assert "rod    traced" in seen[0]


@pytest.mark.slow
def test_design_variables_of_a_lagrangian_system():
    swing = LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * p["inertia"] * (v @ v),
        potential=lambda t, q, p: -9.81 * p["arm"] * jnp.cos(q[0]),
        q=[1.0],
        parameters={"inertia": 0.64, "arm": 0.8},
    )
    rod = mb.design(
        swing, {"length": mb.Variable(0.8, (0.1, 2.0))}, lambda v: {"arm": v["length"], "inertia": v["length"] ** 2}
    )
    period = lambda x: mb.simulate(mb.with_parameters(rod, {"length": x}), rod.guess, t1=0.3).ys.q[-1, 0]
    by_hand = mb.with_parameters(swing, {"arm": 0.9, "inertia": 0.81})
    np.testing.assert_allclose(period(0.9), mb.simulate(by_hand, rod.guess, t1=0.3).ys.q[-1, 0], rtol=1e-12)
    assert "length" in str(rod)


def test_design_variables_bound_studies(machine):
    free = free_parameters(machine, {"rod": 3.0})
    far = free(jnp.array([200.0]))["rod"]
    np.testing.assert_allclose(far, 9.0)
    assert mb.parameters(mb.with_parameters(machine, {"rod": far}))["rod"] == far
    narrower = free_parameters(machine, {"rod": 3.0}, {"rod": (2.0, 4.0)})
    np.testing.assert_allclose(narrower(jnp.array([200.0]))["rod"], 4.0)
    with pytest.raises(ValueError, match="reach beyond those of the design variable"):
        free_parameters(machine, {"rod": 3.0}, {"rod": (0.0, 4.0)})


def test_design_variables_out_of_bounds_under_a_trace(machine, plain):
    ok = jax.jit(lambda rod: mb.with_parameters(machine, {"rod": rod}).parameter_table.in_range())
    assert bool(ok(3.0)) and bool(ok(9.0)) and not bool(ok(9.1)) and not bool(ok(jnp.nan))


REFUSED = [
    (
        "'coupler.inertia' follows from the design variables rod, crank",
        lambda s, m: mb.with_parameters(m, {"coupler.inertia": 1.0}),
    ),
    ("'rod' must be within 0.1 … 9, got 9.5", lambda s, m: mb.with_parameters(m, {"rod": 9.5})),
    ("did you mean 'rod'", lambda s, m: mb.with_parameters(m, {"rodd": 1.0})),
    (r"'rod' has shape \(\), got \(1,\)", lambda s, m: mb.with_parameters(m, {"rod": [1.0]})),
    ("has a parameter 'crank.mass' already", lambda s, m: mb.design(s, {"crank.mass": 1.0}, lambda v: {})),
    ("has a parameter 'rod' already", lambda s, m: mb.design(m, {"rod": 1.0}, lambda v: {})),
    ("did you mean 'B.point_a'", lambda s, m: mb.design(s, {"a": 1.0}, lambda v: {"B.pointa": v["a"]})),
    (
        r"'B.point_a' has shape \(\), but \(2,\)",
        lambda s, m: mb.design(s, {"a": 1.0}, lambda v: {"B.point_a": v["a"]}),
    ),
    (
        "Nothing follows from the design variable 'b'",
        lambda s, m: mb.design(s, {"a": 1.0, "b": 2.0}, lambda v: {"crank.mass": v["a"]}),
    ),
    ("Unknown design variable 'c'", lambda s, m: mb.design(s, {"a": 1.0}, lambda v: {"crank.mass": v["c"]})),
    ("is not finite", lambda s, m: mb.design(s, {"a": 1.0}, lambda v: {"crank.mass": jnp.log(-v["a"])})),
    ("must return parameters by name", lambda s, m: mb.design(s, {"a": 1.0}, lambda v: v["a"])),
    ("must be Variables by name", lambda s, m: mb.design(s, {}, lambda v: {})),
    ("'a': value must be", lambda s, m: mb.design(s, {"a": "long"}, lambda v: {})),
    ("low < high", lambda s, m: mb.Variable(1.0, bounds=(2.0, 1.0))),
    ("a pair", lambda s, m: mb.Variable(1.0, bounds=2.0)),
    ("not within its bounds 2 … 3", lambda s, m: mb.Variable(1.0, bounds=(2.0, 3.0))),
    ("scale must be positive", lambda s, m: mb.Variable(1.0, scale=0.0)),
    ("must be finite", lambda s, m: mb.Variable(np.inf)),
]


def test_designs_that_cannot_be_are_refused(plain, machine):
    for message, bad in REFUSED:
        with pytest.raises(ValueError, match=message):
            bad(plain.system, machine)


@pytest.mark.slow
def test_design_variable_derivatives_of_a_redundant_loop():
    """Of a loop in space, three rows of which follow from the others at every length: both modes, and differences of a
    tighter run.
    """
    loop = mb.mechanisms.spatial_loop()
    ends = lambda v: {"B.point_b": -v["rod"] * jnp.eye(3)[0] / 2, "C.point_a": v["rod"] * jnp.eye(3)[0] / 2}
    machine = mb.design(loop.system, {"rod": mb.Variable(3.0, unit="m")}, ends)

    def place(rod, rtol=1e-8):
        new = mb.with_parameters(machine, {"rod": rod})
        start = mb.assemble(new, loop.state, fix={"A.angle": 0.0}, rates=loop.rates)
        motion = mb.simulate(new, start, t1=0.2, rtol=rtol)
        return jnp.sum(motion["rocker"].position[-1] * jnp.array([1.0, 0.5, 0.0]))

    forward = jax.jit(jax.jacfwd(place))(3.0)
    reverse = jax.jit(jax.grad(place))(3.0)
    tight, h = jax.jit(lambda rod: place(rod, rtol=1e-12)), 1e-3
    central = (8 * (tight(3 + h) - tight(3 - h)) - (tight(3 + 2 * h) - tight(3 - 2 * h))) / (12 * h)
    assert abs(forward) > 0.01
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    np.testing.assert_allclose(forward, central, rtol=1e-6)
