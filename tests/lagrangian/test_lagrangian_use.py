"""What is built around systems works for those from a Lagrangian: assembly, descriptions, saved motions, pictures."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb.formulations import Partitioned
from jaxmb.lagrangian import (
    Holonomic,
    LagrangianSystem,
    Pfaffian,
    QuasiVelocityFrame,
    ServoConstraint,
    Viscous,
)


def kinetic(t, q, v, p):
    return 0.5 * p["m"] * (v @ v)


def potential(t, q, p):
    return 9.81 * p["m"] * q[1]


def rod(t, q, p):
    return q[:2] @ q[:2] - p["l"] ** 2


def off(t, q, p):
    return q[2] - 0.1 * jnp.sin(t)


def built(**changes):
    """A mass on a rod, and a third coordinate that follows a sine."""
    arguments = {
        "kinetic": kinetic,
        "potential": potential,
        "constraints": [Holonomic("rod", rod), ServoConstraint("hold", off, 1.0, 1.0)],
        "nonideal": [Viscous("rod", "c")],
        "q": [0.6, -0.8, 0.1],
        "coordinates": ("x", "y", "z"),
        "parameters": {"m": 1.0, "l": 1.0, "c": 0.1},
    }
    return LagrangianSystem(**(arguments | changes))


def turning(t, q, p):
    """Along the circle, and along z."""
    zero = jnp.zeros_like(q[0])
    return jnp.stack([jnp.stack([-q[1], q[0], zero]), jnp.stack([zero, zero, 1 + q[0]])], axis=1)


@pytest.fixture(scope="module")
def system():
    return built()


@pytest.fixture(scope="module")
def framed():
    """The same mass on its circle, by quasi-velocities."""
    return built(constraints=[], nonideal=[], kinematics=QuasiVelocityFrame(turning, 2), u=[1.0, 0.5])


@pytest.fixture(scope="module")
def motion(framed):
    """Three states of the framed mass."""
    angles = np.array([0.1, 0.4, 0.8])
    q = np.stack([np.sin(angles), -np.cos(angles), angles], axis=1)
    ys, stats = mb.State(q, np.array([[1.0, 0.5], [0.8, 0.4], [0.3, -0.2]])), {"num_steps": 3}
    return mb.Trajectory(framed, Partitioned(), np.arange(3.0), ys, stats, mb.RESULTS.successful, None, None)


# Construction


def test_equal_functions_make_equal_structures(system):
    """Another system of the same functions runs in programs that are there already."""
    assert jax.tree.structure(built(parameters={"m": 2.0, "l": 1.1, "c": 0.0})) == jax.tree.structure(system)


UNBUILT = [
    ({"coordinates": ("t", "y", "z")}, "'t' has another meaning"),
    ({"coordinates": ("x", "y")}, "need as many names"),
    ({"kinetic": lambda t, q, v, p: v}, r"^kinetic must be a scalar, got shape \(3,\)"),
    ({"potential": lambda t, q, p: q}, r"^potential must be a scalar, got shape \(3,\)"),
    ({"constraints": [Pfaffian("rod", lambda t, q, p: jnp.ones((1, 2)))]}, "rod does not fit the system"),
    ({"constraints": []}, r"a constraint 'rod', but there are \[\]"),
]


def test_systems_that_are_refused():
    for changes, message in UNBUILT:
        with pytest.raises(ValueError, match=message):
            built(**changes)


# Assembly


UNASSEMBLED = [
    ({"fix": {"xx": 0.3}}, "Unknown coordinate 'xx'; did you mean 'x'"),
    ({"fix": {"x": [0.3, 0.4]}}, "has 1 components"),
    ({"rates": {"w": 1.0}}, "there are 'x', 'y', 'z'"),
    ({"fix": {"x": 1.3}}, r"the value of x is out of reach; .* residuals remain in rod"),
    ({"fix": {"x": 0.6, "y": 0.8}}, "x and y depend on each other: of these 2 coordinates only 1"),
    ({"rates": {"x": 0.6, "y": 0.9}}, "satisfy rod with the rates x, y fixed"),
]


def test_assemblies_that_are_refused(system):
    for prescribed, message in UNASSEMBLED:
        with pytest.raises(ValueError, match=message):
            mb.assemble(system, **prescribed)


def test_quasi_velocities_are_fixed_by_number(framed):
    state = mb.assemble(framed, fix={"z": 0.4}, rates={"u1": 3.0})
    np.testing.assert_allclose(state.q, [0.6, -0.8, 0.4])
    np.testing.assert_allclose(state.u, [1.0, 3.0])
    with pytest.raises(ValueError, match="Unknown rate 'z'; there are 'u0', 'u1'"):
        mb.assemble(framed, rates={"z": 3.0})


@pytest.mark.slow
def test_derivatives_of_assembly(system):
    """Of y and its rate, where the length and x are given: `y = −√(l² − x²)`."""

    def assembled(length, x):
        state = mb.assemble(mb.with_parameters(system, {"l": length}), fix={"x": x}, rates={"x": 1.0})
        return jnp.stack([state.q[1], state.u[1]])

    def known(length, x):
        y = -jnp.sqrt(length**2 - x**2)
        return jnp.stack([y, -x / y])

    at = jnp.array(1.1), jnp.array(0.3)
    expected = jax.jacfwd(known, (0, 1))(*at)
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(mode(assembled, (0, 1))(*at), expected, rtol=1e-10)


# Words and pictures


def test_description(system, framed):
    text = str(system)
    for words in (
        "3 coordinates: x, y, z",
        "2, of which 2 independent (1 between accelerations only)",
        "degrees of freedom  2",
        "Holonomic        rod   1 row",
        "ServoConstraint  hold  1 row",
        "Viscous  rod",
        "factorisation of the mass matrix: it is diagonal",
    ):
        assert words in text
    assert "every constraint is one of positions" not in text
    assert "<b>constraints</b>" in system._repr_html_()
    assert "2, of a QuasiVelocityFrame" in str(framed) and "no constraints" in str(framed)


def test_rates_plots_and_files_of_a_motion(framed, motion, tmp_path):
    frame = np.stack([-motion.ys.q[:, 1], motion.ys.q[:, 0]], axis=1) * motion.ys.u[:, :1]
    upwards = (1 + motion.ys.q[:, 0]) * motion.ys.u[:, 1]
    np.testing.assert_allclose(motion.rates, np.column_stack([frame, upwards]), rtol=1e-12)
    motion.save(tmp_path / "motion.npz")
    saved = mb.load(tmp_path / "motion.npz")
    assert {"t", "q", "u", "x", "y", "z", "energy", "stats.num_steps"} <= set(saved)
    np.testing.assert_array_equal(saved["y"], motion.ys.q[:, 1])
    coordinate, rate, energy = mb.viz.plot_motion(motion).axes
    assert [line.get_label() for line in coordinate.lines] == ["x", "y", "z"]
    assert len(energy.lines) == 3
    coordinate, rate = mb.viz.plot_motion(motion, ["z", "x"]).axes
    np.testing.assert_array_equal(coordinate.lines[0].get_ydata(), motion["z"])
    np.testing.assert_array_equal(rate.lines[1].get_ydata(), motion.rates[:, 0])
    assert [line.get_label() for line in coordinate.lines] == ["z", "x"]
    with pytest.raises(ValueError, match="Unknown coordinate 'w'"):
        mb.viz.plot_motion(motion, ["w"])
    with pytest.raises(ValueError, match=r"LagrangianSystem has none; plot_motion"):
        mb.viz.plot_mechanism(motion)


# Projection


@pytest.mark.slow
def test_a_network_is_a_parameter():
    """It is called in the user's functions, and its weights have derivatives."""
    network = eqx.nn.MLP(1, 1, 4, 1, activation=jnp.tanh, key=jax.random.key(0))
    system = LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * p["m"] * v @ v,
        force=lambda t, q, v, p: p["net"](v) - q,
        q=[1.0],
        parameters={"m": 1.0, "net": network},
    )
    start, weights = mb.assemble(system), mb.parameters(system)["net"]
    assert weights.shape == (13,) and eqx.tree_equal(mb.modules(system)["net"], network, rtol=0.0, atol=0.0)

    def end(weights):
        return mb.simulate(mb.with_parameters(system, {"net": weights}), start, t1=1.0, rtol=1e-10)["q0"][-1]

    along = np.sin(np.arange(13.0))
    run = jax.jit(lambda w: (jax.jvp(end, (w,), (jnp.asarray(along),)), jax.grad(end)(w)))
    (_, forward), reverse = run(weights)
    (after, _), _ = run(weights + 1e-4 * along)
    (before, _), _ = run(weights - 1e-4 * along)
    np.testing.assert_allclose(reverse @ along, forward, rtol=1e-9)
    np.testing.assert_allclose(forward, (after - before) / 2e-4, rtol=1e-6)
    np.testing.assert_allclose(end(network), end(weights), rtol=1e-14)
    with pytest.raises(ValueError, match="'net' is a module, whose weights are not a function of time"):
        mb.simulate(system, start, t1=1.0, inputs={"net": lambda t: weights})
    with pytest.raises(ValueError, match="Parameter 'm': expected a real number or an array"):
        LagrangianSystem(kinetic=kinetic, q=[1.0], parameters={"m": "one"})
