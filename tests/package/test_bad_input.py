"""Bad input gets an error that names the part and the fix; a motion that cannot go on ends with its own result."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from precision import single_precision
from trajectories import motion_of

import jaxmb as mb
from jaxmb import planar, spatial


def bar(name="bar", **changes):
    return planar.Body(name, **({"mass": 1.0, "inertia": 0.1, "position": (0.5, 0.0)} | changes))


def pin(name="pin", a="ground", b="bar", **changes):
    return planar.Revolute(name, a, b, **({"point": (0.0, 0.0)} | changes))


def rod(name, start, end):
    start, end = np.array(start, float), np.array(end, float)
    angle = np.arctan2(*(end - start)[::-1])
    return planar.Body(name, mass=1.0, inertia=0.1, position=(start + end) / 2, angle=angle)


SPATIAL = spatial.Body("body", mass=1.0, inertia=(1.0, 1.0, 1.0))

REFUSED = {
    "repeated name": (lambda: mb.Scene([bar(), bar()]), "'bar' is used twice"),
    "name of the ground": (lambda: mb.Scene([bar("ground")]), "'ground' is used twice.*fixed world"),
    "empty name": (lambda: mb.Scene([bar("")]), "must not be empty"),
    "dot in a name": (lambda: mb.Scene([bar("a.b")]), "dot"),
    "joint with itself": (lambda: mb.Scene([bar()], joints=[pin(a="bar")]), "pin.*with itself"),
    "a body without a list": (lambda: mb.Scene(bar()), "A scene takes lists, .*got Body 'bar': give a list of it"),
    "a joint without a list": (lambda: mb.Scene([bar()], joints=pin()), "got Revolute 'pin': give a list of it"),
    "no bodies": (lambda: mb.Scene([]), "at least one body"),
    "force among joints": (
        lambda: mb.Scene([bar()], joints=[mb.Gravity((0, -1))]),
        "joints must hold constraints, got Gravity.*it belongs in forces=",
    ),
    "joint among forces": (
        lambda: mb.Scene([bar()], forces=[pin()]),
        "forces must hold force elements, friction, or Gravity, got Revolute 'pin'; it belongs in joints=",
    ),
    "two gravities": (
        lambda: mb.Scene([bar()], forces=[mb.Gravity((0, -1)), mb.Gravity((0, -1), name="more")]),
        "one Gravity",
    ),
    "planar joint in space": (lambda: mb.Scene([SPATIAL], joints=[pin(b="body")]), "pin.*is planar.*scene is spatial"),
    "mass": (lambda: mb.Scene([bar(mass=0.0)]).compile(), "bar.*mass must be positive"),
    "inertia": (lambda: mb.Scene([bar(inertia=-1.0)]).compile(), "bar.*inertia must be positive"),
    "not finite": (lambda: mb.Scene([bar(position=(np.nan, 0.0))]).compile(), "bar.*position must be finite"),
    "gravity's shape": (lambda: mb.Scene([bar()], forces=[mb.Gravity((0, 0, -9.81))]).compile(), "gravity.*shape"),
    "infinite stiffness": (
        lambda: mb.Scene([bar()], forces=[planar.SpringDamper("s", "ground", "bar", stiffness=np.inf)]).compile(),
        "'s': stiffness must be finite",
    ),
    "open loop": (
        lambda: mb.Scene(
            [rod("a", (0, 0), (1, 0)), rod("b", (1, 0), (2, 0))],
            joints=[
                pin("O", b="a"),
                planar.Revolute("A", "a", "b", point=(1, 0)),
                planar.Revolute("B", "ground", "b", point_a=(5, 0), point_b=(0.5, 0)),
            ],
        ).compile(),
        r"cannot be compiled.*cannot be assembled.*residuals \[m, rad\] remain in .*B.* position and the angle of each",
    ),
    "inconsistent redundant joints": (
        lambda: mb.Scene(
            [bar()],
            joints=[pin(), planar.Fixed("weld", "ground", "bar", point_a=(0, 0.1), point_b=(-0.5, 0), angle=0.0)],
        ).compile(),
        "cannot be assembled.*(pin|weld)",
    ),
    "drivers that fight": (
        lambda: mb.Scene(
            [bar()],
            joints=[
                pin(),
                planar.Driver("one", "ground", "bar", quantity="angle", motion=lambda t, p: 1.0 * t),
                planar.Driver("two", "ground", "bar", quantity="angle", motion=lambda t, p: 2.0 * t),
            ],
        ).compile(),
        "velocities prescribed by one, two contradict",
    ),
}


@pytest.mark.slow("inconsistent redundant joints")
@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_the_name_and_the_fix(case):
    build, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        build()


@pytest.fixture(scope="module")
def pendulum():
    return mb.Scene([bar()], joints=[pin()], forces=[mb.Gravity((0, -9.81))]).compile()


@pytest.mark.slow
def test_assembly_names_what_cannot_be_fixed(pendulum):
    with pytest.raises(ValueError, match=r"cannot be assembled with bar.x, bar.y fixed.*pin"):
        mb.assemble(pendulum, fix={"bar.x": 2.0, "bar.y": 2.0})
    with pytest.raises(ValueError, match=r"rates bar.x, bar.angle fixed"):
        mb.assemble(pendulum, rates={"bar.x": 1.0, "bar.angle": 0.5})
    quiet = mb.assemble(pendulum, fix={"bar.x": 2.0, "bar.y": 2.0}, throw=False)
    assert np.all(np.isnan(quiet.q))


@pytest.mark.slow
def test_more_rates_than_freedoms_may_be_given_if_they_agree(pendulum):
    # Along x the centre stands still in this position, whatever the other rates are.
    for name, why in (("bar.x", r"the constraints determine bar\.x"), ("bar.y", "these contradict each other")):
        # The bar turns about its end, half a metre from its centre.
        given = {"bar.angle": 2.0, "bar.x": 0.0, "bar.y": 1.0}
        np.testing.assert_allclose(mb.assemble(pendulum, rates=given).u, (0.0, 1.0, 2.0), rtol=0, atol=1e-14)
        with pytest.raises(ValueError, match=f"No velocities satisfy pin with .*{why}"):
            mb.assemble(pendulum, rates=given | {name: 0.5})
    turn = lambda w: mb.assemble(pendulum, rates={"bar.angle": w, "bar.y": 0.5 * w}).u
    np.testing.assert_allclose(jax.jacfwd(turn)(2.0), (0.0, 0.5, 1.0), rtol=0, atol=1e-14)


def test_prescribed_values_are_real_numbers(pendulum):
    for value in ("0.3", None, 0.3j, [[1.0], [2.0, 3.0]]):
        for call, message in (
            (lambda value: mb.assemble(pendulum, fix={"bar.angle": value}), "Coordinate 'bar.angle'"),
            (lambda value: mb.assemble(pendulum, rates={"bar.velocity": value}), "Rate 'bar.velocity'"),
            (lambda value: mb.equilibrium(pendulum, fix={"bar.angle": value}), "Coordinate 'bar.angle'"),
            (lambda value: mb.assemble(pendulum, t=value), "t"),
        ):
            with pytest.raises(ValueError, match=f"{message} must be a real number"):
                call(value)


@pytest.mark.parametrize("function", [mb.assemble, mb.equilibrium])
def test_arguments_of_wrong_types(pendulum, function):
    scene = mb.Scene([bar()], joints=[pin()])
    for system, message in ((scene, r"got .*; compile the scene first, scene.compile\(\)"), (None, "got None")):
        with pytest.raises(ValueError, match=f"{function.__name__}: system must be a compiled scene.*{message}"):
            function(system)
    for guess, message in (
        ("here", r"guess must be a State\(q, u\), got 'here'"),
        (mb.State(jnp.zeros(2), jnp.zeros(3)), r"guess.q must have shape \(3,\), got \(2,\)"),
        (mb.State(jnp.zeros(3), None), "guess.u must be an array of real numbers, got None"),
    ):
        with pytest.raises(ValueError, match=message):
            function(pendulum, guess)
    with pytest.raises(ValueError, match=r"prescribed by name.*got \['bar.angle'\]"):
        function(pendulum, fix=["bar.angle"])
    with pytest.raises(ValueError, match="t must be a real number"):
        function(pendulum, t=(0.0, 1.0))


@pytest.mark.slow
def test_nothing_to_solve_implicitly():
    turned = planar.Driver("drive", "ground", "bar", quantity="angle", motion=lambda t, p: 2.0 * t)
    system = mb.Scene([bar()], joints=[pin(), turned]).compile()
    with pytest.raises(ValueError, match=r"constraints prescribe all components of the state. Use `Adams\(\)`"):
        mb.simulate(system, mb.assemble(system), t1=0.1, solver=mb.solvers.Hermite())


@pytest.mark.slow
def test_single_precision_warns(pendulum):
    single = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x, pendulum)
    for whose, options in (("^rtol=1e-10", {"rtol": 1e-10}), ("^The default rtol=1e-08", {})):
        with single_precision(), pytest.warns(UserWarning, match=rf"{whose} .*single precision.*jax_enable_x64"):
            state = mb.State(jnp.array([0.5, 0.0, 0.0]), jnp.zeros(3))
            sol = mb.simulate(single, state, t1=0.1, **options)
        assert sol.ys.q.dtype == jnp.float32 and np.all(np.isfinite(sol.ys.q))


def test_precision_switched_after_the_scene_was_compiled(pendulum):
    scene = mb.Scene([bar()], joints=[pin()])
    with single_precision():
        early = scene.compile()
        with pytest.raises(ValueError, match="numbers of float64, and JAX now makes float32"):
            mb.assemble(pendulum)
    for function in (lambda *of: mb.simulate(*of, t1=0.1), mb.linearise):
        with pytest.raises(
            ValueError, match=r"^(simulate|linearise): .*float32, and JAX now makes float64.*enable_x64"
        ):
            function(early, pendulum.guess)


def steady_turn(t, p):
    return p["speed"] * t


def lock_up(rod_length):
    """A spatial slider-crank with its crank driven at 2π rad/s (Haug 1989, §10.2), from where the tip is nearest to the
    slider's line; half a turn later it needs a rod of 0.2362 m.
    """
    r, height, depth = 0.08, 0.12, 0.1
    centre = np.array([0.0, depth, height])
    inward = -centre / np.linalg.norm(centre)
    tip = centre + r * inward
    slider = np.array([np.sqrt(rod_length**2 - tip @ tip), 0.0, 0.0])
    crank = spatial.Body("crank", mass=0.12, inertia=(1e-4, 1e-4, 1e-4), position=centre)
    block = spatial.Body("block", mass=2.0, inertia=(1e-2, 1e-2, 1e-2), position=slider)
    joints = [
        spatial.Revolute("hub", "ground", "crank", point=centre, axis=(1.0, 0.0, 0.0)),
        spatial.Prismatic("guide", "ground", "block", point=slider, axis=(1.0, 0.0, 0.0)),
        spatial.Distance("rod", "crank", "block", point_a=r * inward, length=rod_length),
        spatial.Driver(
            "drive",
            "ground",
            "crank",
            quantity="angle",
            axis=(1.0, 0.0, 0.0),
            motion=steady_turn,
            parameters={"speed": 2 * np.pi},
        ),
    ]
    return mb.Scene([crank, block], joints=joints).compile()


@pytest.mark.slow
def test_lock_up_ends_with_its_own_result():
    def turn(length, throw=False):
        system = lock_up(length)
        return mb.simulate(system, mb.assemble(system), t1=1.0, throw=throw, saveat=diffrax.SaveAt(steps=True))

    assert turn(0.2363).result == mb.RESULTS.successful
    short = turn(0.2361)
    assert short.result == mb.RESULTS.singular_configuration
    # The trajectory up to there is kept, on its constraints.
    assert 0.3 < float(short.ts[-1]) < 0.6
    assert float(jnp.max(short.constraint_violation.position)) < 1e-10
    with pytest.raises(RuntimeError, match="singular configuration"):
        turn(0.2361, throw=True)


# Arguments of `simulate` that are refused before anything is compiled: the argument is named, and the cure.
ARGUMENTS = {
    "class of a solver": (
        {"solver": mb.solvers.Adams},
        r"solver must be an object .*Adams\(\).*the class Adams",
    ),
    "solver by a name": (
        {"solver": "rk45"},
        r"solver must be an object, such as jaxmb.solvers.Adams\(\), jaxmb.solvers.Hermite\(\) or diffrax.Tsit5\(\), "
        "or one of the words 'auto' and 'switch'; got 'rk45'",
    ),
    "name of a manifold": ({"manifold": "partition"}, r"manifold must be .*Partition\(\), got 'partition'"),
    "name of a formulation": ({"formulation": "multipliers"}, r"formulation must be .*Multipliers\(\), got"),
    "controller": ({"stepsize_controller": 1e-6}, "stepsize_controller must be .*MultistepController"),
    "event": ({"event": lambda t, y, args, **kwargs: t - 1.0}, "event must be .*diffrax.Event"),
    "progress meter": ({"progress_meter": True}, "progress_meter must be .*got True"),
    "no bound of steps": ({"max_steps": None}, "max_steps must be an integer of at least 1, got None"),
    "half a step": ({"max_steps": 1.5}, "max_steps must be an integer of at least 1, got 1.5"),
    "first step of zero": ({"dt0": 0.0}, "dt0 must be a finite step from t0 = 0.0 towards t1 = 0.1.*leave it out"),
    "first step back": ({"dt0": -1e-3}, "dt0 must be a finite step"),
    "first step forward in time that runs back": ({"dt0": 1e-3, "t1": -1.0}, "dt0 must be a finite step"),
    "no end": ({"t1": None}, "t1 must be a real number, got None"),
    "two ends": ({"t1": [1.0, 2.0]}, "t1 must be a real number"),
    "NaN as the start": ({"t0": np.nan}, "t0 must not be NaN"),
    "endless future": ({"t1": np.inf}, "t1 must be finite, got inf"),
    "complex start": ({"t0": 1j}, "t0 must be a real number"),
    "tolerance in words": ({"rtol": "1e-6"}, "rtol must be a real number"),
    "tolerances of the wrong number": (
        {"atol": [1e-6, 1e-6]},
        r"atol must have shape \(\) or \(6,\), got \(2,\)",
    ),
    "negative tolerance": ({"atol": -1e-6}, "atol must be between 0 and 1"),
    "times in words": ({"saveat": "all"}, "saveat must be an array of real numbers, got 'all'"),
    "no times": ({"saveat": []}, "saveat must be a vector of times"),
    "NaN among the times": ({"saveat": [0.0, np.nan]}, "saveat must not be NaN"),
    "no state": ({"state": None}, "state must be a jaxmb.State, got None; jaxmb.assemble"),
    "state as a pair": ({"state": (np.zeros(3), np.zeros(3))}, "state must be a jaxmb.State, got"),
    "complex state": ({"state": mb.State(np.zeros(3) + 0j, np.zeros(3))}, "state.q must be an array of real numbers"),
    "no system": ({"system": None}, "system must be a compiled system, got None"),
    "scene that is not compiled": (
        {"system": mb.Scene([bar()])},
        r"system must be a compiled.*scene.compile\(\)",
    ),
    "manifold of other solvers": (
        {"solver": diffrax.Tsit5(), "manifold": mb.manifold.Partition()},
        "Partition needs a solver that knows charts",
    ),
    "state of another system": ({"state": mb.State(np.zeros(2), np.zeros(3))}, "coordinates and"),
    "controller of other solvers": (
        {"stepsize_controller": diffrax.PIDController(rtol=1e-6, atol=1e-6)},
        "MultistepController",
    ),
    # They need tolerances of the solver's own, by which it chooses the order.
    **{
        f"given steps for {solver}": (
            {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": 0.01, "solver": solver},
            r"(Adams|Hermite)\(rtol=1e-8, atol=1e-10\)",
        )
        for solver in (None, mb.solvers.Hermite())
    },
    **{f"tolerance {rtol}": ({"rtol": rtol}, "rtol") for rtol in (0.0, -1e-3, 2.0, np.nan, 1e-17)},
}


def test_arguments_of_simulate(pendulum):
    for changes, message in ARGUMENTS.values():
        arguments = {"system": pendulum, "state": pendulum.guess, "t1": 0.1} | changes
        with pytest.raises(ValueError, match=message) as refused:
            mb.simulate(arguments.pop("system"), arguments.pop("state"), **arguments)
        assert "\n" not in str(refused.value)
    with pytest.raises(TypeError, match=r"no argument 'adjoint' any more: every mode.*jaxmb\.solvers\.integrate"):
        mb.simulate(pendulum, pendulum.guess, t1=0.1, adjoint=diffrax.ForwardMode())


NAMES = {
    "an argument of numpy.savez": ("file", "'file' has another meaning"),
    "a column of the motion": ("energy", "'energy' has another meaning"),
    "a path": ("../x", "'../x' cannot be saved.*slashes"),
    "a drive": ("c:", "'c:' cannot be saved"),
    "hidden": (".x", "'.x' cannot be saved"),
    "empty": ("", "a non-empty string, got ''"),
    "number": (1, "a non-empty string, got 1"),
}


def test_names_of_coordinates():
    for name, message in NAMES.values():
        with pytest.raises(ValueError, match=message):
            mb.lagrangian.LagrangianSystem(lambda t, q, v, p: v @ v, q=[1.0, 2.0], coordinates=("y", name))


def test_what_only_bodies_have():
    system = mb.lagrangian.LagrangianSystem(lambda t, q, v, p: v @ v, q=[1.0])
    motion = motion_of(system, [0.0], np.ones((1, 1)), np.zeros((1, 1)))
    for ask, message in (
        (lambda: motion.reactions, "this system has constraint_forces"),
        (lambda: motion.forces, "this system has none"),
        (lambda: motion.linear_momentum, "Momentum is defined for bodies"),
        (lambda: motion.angular_momentum, "Momentum is defined for bodies"),
        (lambda: motion.quantity("q0.rat"), r"Unknown quantity 'q0\.rat'; did you mean 'q0_rate'"),
    ):
        with pytest.raises(ValueError, match=message):
            ask()


def test_a_scene_is_compiled_before_it_is_traced():
    scene = mb.Scene([planar.PointMass("mass", mass=1.0)])
    with pytest.raises(ValueError, match="cannot be compiled within a function that JAX traces"):
        jax.jit(lambda x: x * mb.parameters(scene.compile())["mass.mass"])(1.0)
