"""A scene traces nothing that it does not need, and its program does not grow with the number of its bodies."""

from collections import Counter

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled
from jax.extend import core

import jaxmb as mb
from jaxmb import lagrangian, planar, spatial
from jaxmb.bodies import rigid_bodies
from jaxmb.formulations import laws
from jaxmb.linalg import elimination, rotations
from jaxmb.manifold import orthogonal_projection, partition
from jaxmb.parts import contact


def primitives(jaxpr) -> Counter:
    """How often each primitive occurs, in inner programs as well."""
    counts = Counter()
    for equation in jaxpr.eqns:
        counts[equation.primitive.name] += 1
        for value in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
            if isinstance(value, core.ClosedJaxpr):
                counts += primitives(value.jaxpr)
            elif isinstance(value, core.Jaxpr):
                counts += primitives(value)
    return counts


def program(system, **options) -> Counter:
    run = lambda system, state: mb.simulate(system, state, t1=1.0, throw=False, **options).ys
    return primitives(jax.make_jaxpr(run)(system, system.guess).jaxpr)


def planar_body(**changes):
    return planar.Body("body", mass=1.0, inertia=0.1, **changes)


def refuse(monkeypatch, module, *names):
    for name in names:

        def refused(*args, name=name, **kwargs):
            raise AssertionError(f"{name} is traced")

        monkeypatch.setattr(module, name, refused)


def test_unconstrained_body_has_nothing_of_constraints(monkeypatch):
    system = mb.Scene([planar_body()], forces=[mb.Gravity((0.0, -9.81))]).compile()
    for module, names in {
        elimination: ["full_pivot", "eliminate", "gauss_jordan"],
        partition: ["acceleration", "eliminate"],
        orthogonal_projection: ["_multipliers", "full_pivot"],
    }.items():
        refuse(monkeypatch, module, *names)
    own = program(system)

    def plain(system, state):
        field = lambda t, y, args: mb.State(y.u, jnp.array([0.0, -9.81, 0.0]) + 0 * y.u)
        return diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            mb.solvers.Adams(),
            0.0,
            1.0,
            None,
            state,
            # The user's series and the end state.
            saveat=diffrax.SaveAt(subs=(diffrax.SubSaveAt(t1=True), diffrax.SubSaveAt(t1=True))),
            stepsize_controller=mb.solvers.MultistepController(rtol=1e-8, atol=1e-10),
            throw=False,
        ).ys[0]

    bare = primitives(jax.make_jaxpr(plain)(system, system.guess).jaxpr)
    # No loop, no branch, no search, no rule of differentiation besides those of the solver itself.
    for name in ("while", "cond", "argmax", "sort", "custom_jvp_call"):
        # One rule chooses the program of runs that are differentiated.
        assert own[name] <= bare[name] + (name == "custom_jvp_call"), name


@pytest.mark.slow
def test_constrained_body_has_them():
    pin = planar.Revolute("pin", "ground", "body", point=(0.0, 0.0))
    pendulum = program(mb.Scene([planar_body(position=(1.0, 0.0))], joints=[pin]).compile())
    assert pendulum["custom_jvp_call"] > 0 and pendulum["argmax"] > 0


def inside_loops(jaxpr, inside=False) -> Counter:
    """How often each primitive and each named function occurs, in and outside of loops of unknown length."""
    counts = Counter()
    for equation in jaxpr.eqns:
        counts[equation.params.get("name", equation.primitive.name), inside] += 1
        for value in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
            if isinstance(value, core.ClosedJaxpr | core.Jaxpr):
                own = value.jaxpr if isinstance(value, core.ClosedJaxpr) else value
                counts += inside_loops(own, inside or equation.primitive.name == "while")
    return counts


@pytest.mark.parametrize("options", [{"jumps": [0.5], "dt0": 0.01}])
def test_charts_and_evaluations_stand_in_one_place(options):
    """The first step is the start, and a restart after a jump is a start: neither has its own search and evaluation."""
    system = mb.mechanisms.four_bar().system
    run = lambda system, state: mb.simulate(system, state, t1=1.0, throw=False, **options).ys
    counts = inside_loops(jax.make_jaxpr(run)(system, system.guess).jaxpr)
    # A search finds a row and a column. A failure is explained by one more, after the loop.
    assert counts["argmax", True] == 2 and counts["argmax", False] <= 2
    for name, most in (("acceleration", 1), ("restore", 1), ("_updated", 1)):
        assert counts[name, True] == most and counts[name, False] == 0, name


def test_free_body_in_space_has_no_charts(monkeypatch):
    body = spatial.Body("body", mass=1.0, inertia=(1.0, 2.0, 3.0), angular_velocity=(0.1, 2.0, 0.1))
    system = mb.Scene([body]).compile()
    refuse(monkeypatch, elimination, "full_pivot", "eliminate", "gauss_jordan")
    refuse(monkeypatch, partition, "acceleration", "eliminate")
    assert program(system)["argmax"] == 0


@pytest.mark.slow
def test_ideal_scene_without_contact_tracks_or_couplers_has_nothing_of_them(monkeypatch):
    refuse(monkeypatch, contact.Contact, "wrenches", "energy", "resolve")
    refuse(monkeypatch, planar.Track, "wrenches", "length", "energy")
    refuse(monkeypatch, planar.DraftGear, "wrenches", "tension", "energy")
    refuse(monkeypatch, planar.Friction, "wrenches", "slip")
    refuse(monkeypatch, laws, "find_multipliers")
    four_bar = mb.mechanisms.four_bar()
    # The analysis of a scene eliminates blocks, its motion only where it is large.
    refuse(monkeypatch, rigid_bodies, "block_jacobian")
    assert program(four_bar.system)["tanh"] == 0


def test_planar_scene_has_no_euler_parameters(monkeypatch):
    names = [n for n in dir(rotations) if callable(getattr(rotations, n)) and not n.startswith("_") and n != "norm"]
    refuse(monkeypatch, rotations, *[n for n in names if getattr(rotations, n).__module__ == rotations.__name__])
    four_bar = mb.mechanisms.get("four_bar").system
    counts = program(four_bar)
    assert counts["while"] > 0
    shapes = jax.make_jaxpr(lambda s, y: mb.simulate(s, y, t1=1.0, throw=False).ys)(four_bar, four_bar.guess)
    assert "f64[4,7]" not in str(shapes) and "f64[4,4]" not in str(shapes)  # poses, frames of bodies and ground


@pytest.mark.slow
@pytest.mark.parametrize(
    "what, manifold", [("forward", mb.manifold.Partition()), ("reverse", mb.manifold.Projection())]
)
def test_program_does_not_grow_with_the_number_of_bodies(what, manifold):
    def lines(n):
        mechanism = mb.mechanisms.get("rod_chain", n=n)
        options = {"throw": False, "max_steps": 1000, "manifold": manifold}
        end = lambda system, state: mb.simulate(system, state, t1=1.0, **options).ys.q[-1, 0]
        gradient = lambda system, state: jax.grad(lambda state: end(system, state))(state)
        function = end if what == "forward" else gradient
        return jax.jit(function).lower(mechanism.system, mechanism.state).as_text().count("\n")

    few, many = lines(15), lines(50)
    assert abs(many - few) <= 0.1 * few, (few, many)


def test_building_a_scene_compiles_nothing_but_its_analysis():
    """Numbers of parts are worked out by NumPy: thousands of small programs would take minutes."""
    jax.clear_caches()
    axis = np.array([0.0, 0.6, 0.8])
    with compiled() as names:
        body = spatial.Body(
            "rod",
            mass=2.0,
            inertia=spatial.cylinder(2.0, 0.1, 1.5, "x"),
            position=(0.75, 0.0, 0.0),
            orientation=(0.8, 0.0, 0.6, 0.0),
        )
        tip = spatial.PointMass("tip", mass=0.5, position=(1.0, 2.0, 0.5))
        joints = [
            spatial.Revolute("pin", "ground", "rod", point=(0.1, 0.2, 0.3), axis=axis),
            spatial.Distance("wire", "rod", "tip", point_a=(0.5, 0.0, 0.0)),
        ]
        forces = [
            mb.Gravity((0.0, 0.0, -9.81)),
            spatial.SpringDamper("spring", "ground", "tip", stiffness=10.0),
            mb.JointSpring("coil", "pin.angle", stiffness=3.0),
        ]
        system = mb.Scene([body, tip], joints=joints, forces=forces).compile()
        stiffness = mb.parameters(mb.with_parameters(system, {"coil.stiffness": 4.0}))["coil.stiffness"]
    assert float(stiffness) == 4.0
    # Whether its joint and its spring turn the point mass is asked of themselves.
    assert set(names) == {"turned"}


@pytest.mark.slow
def test_forces_that_no_reaction_changes_are_not_solved_for(monkeypatch):
    refuse(monkeypatch, laws, "find_multipliers", "root")
    viscous = lagrangian.LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * jnp.dot(v, v),
        constraints=[lagrangian.Holonomic("ring", lambda t, q, p: 0.5 * (jnp.dot(q, q) - 1.0))],
        nonideal=[lagrangian.Viscous("ring", "c")],
        q=(1.0, 0.0),
        parameters={"c": 0.2},
    )
    program(viscous)
    program(mb.mechanisms.get("four_bar").system)
    with pytest.raises(AssertionError, match="find_multipliers is traced"):
        program(mb.mechanisms.get("rough_ring").system)


@pytest.mark.slow
def test_second_derivatives_of_short_motions_call_no_python():
    """JAX keeps such programs on disk."""
    four_bar = mb.mechanisms.get("four_bar")

    def end(mass, max_steps):
        system = mb.with_parameters(four_bar.system, {"crank.mass": mass})
        return mb.simulate(system, four_bar.state, t1=0.1, max_steps=max_steps).ys.q[-1, 0]

    calls = lambda most: "callback" in str(jax.make_jaxpr(jax.hessian(lambda mass: end(mass, most)))(1.0))
    assert calls(10000) and not calls(1000)
