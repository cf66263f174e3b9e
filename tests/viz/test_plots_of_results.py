"""Results draw themselves: which curves, labels and units stand in each picture, and what is refused."""

import dataclasses
import sys
import types

import jax
import numpy as np
import pytest
from trajectories import motion_of

import jaxmb as mb
from jaxmb import planar, viz
from jaxmb._pictured import picture
from jaxmb.bodies.units import effort, named, parameter_unit
from jaxmb.studies.identify import Identification
from jaxmb.studies.optimise.optimise import ConstrainedOutput
from jaxmb.studies.optimise.trials import Iteration
from jaxmb.viz.figure import color, colors_of, draw_legend, new_figure, shown_unit
from jaxmb.viz.plan import plot as plot_of_plan

TS = np.linspace(0.0, 1.0, 6)


def pendulums(count):
    """A row of bars on pins, a spring with a motor on the first."""
    names = [f"b{k}" for k in range(1, count + 1)]
    bodies = [planar.Body(name, mass=1.0, inertia=0.1, position=(k + 0.5, 0.0)) for k, name in enumerate(names)]
    joints = [
        planar.Revolute(f"p{k + 1}", (["ground", *names])[k], name, point=(float(k), 0.0))
        for k, name in enumerate(names)
    ]
    motor = mb.Motor("motor", "p1.angle", command=0.0, lag=0.1)
    return mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, -9.81)), motor]).compile()


def swung(system):
    """The bars turn with the first, each by its own share."""
    count = len(system.body_names)
    angle = np.stack([(k + 1) * 0.1 * np.sin(TS) for k in range(count)], axis=1)
    ends = np.cumsum(np.stack([np.cos(angle), np.sin(angle)], axis=2), axis=1)
    place = ends - 0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=2)
    q = np.concatenate([place, angle[:, :, None]], axis=2).reshape(TS.size, -1)
    return motion_of(system, TS, q, np.zeros_like(q), np.full((TS.size, 1), 2e4))


@pytest.fixture(scope="module")
def double():
    return swung(pendulums(2))


def labels(axes):
    return [line.get_label() for line in axes.lines if not line.get_label().startswith("_")]


def legend(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


# Motions


def test_a_motion_has_a_panel_for_each_unit(double):
    names = ("b1.angle", "b1.position", "p2.angle", "motor.force", "motor.drive_force")
    place, angle, torque = double.plot(*names).axes
    assert [axes.get_ylabel() for axes in (place, angle)] == ["position [m]", "angle [rad]"]
    assert labels(place) == legend(place) == ["b1 x", "b1 y"] and labels(angle) == ["b1", "p2"]
    # Large torques have a prefix; both are the motor's, so that the curves have their whole names.
    assert torque.get_ylabel() == "torque, torque of the drive [kN m]"
    assert labels(torque) == ["motor.force", "motor.drive_force"]
    np.testing.assert_allclose(torque.lines[0].get_ydata(), 20.0)
    assert torque.get_xlabel() == "t [s]" and not place.get_xlabel()


def test_a_body_has_its_colour_in_all_pictures(double):
    place, angle = double.plot("b2.position", "b2.angle", "p1.angle").axes
    assert {place.lines[0].get_color(), place.lines[1].get_color(), angle.lines[0].get_color()} == {color(1)}
    assert angle.lines[1].get_color() not in (color(0), color(1)) or "b1" not in labels(angle)
    ends = [line for line in viz.plot_mechanism(double, frames=1).axes[0].lines if line.get_label() == "b2"]
    assert ends[0].get_color() == color(1)
    assert colors_of(["pin", "b2", "b1"], ["b1", "b2"]) == {"b2": color(1), "b1": color(0), "pin": color(2)}


def test_many_curves_stand_in_panels_of_eight():
    many = swung(pendulums(9))
    panels = many.plot(*(f"{name}.position" for name in many.system.body_names)).axes
    # Components apart, and the ninth body, whose colour is the first's, by itself.
    assert [labels(axes) for axes in panels] == [
        *([f"b{k} {x}" for k in range(first, last)] for x in "xy" for first, last in ((1, 9), (9, 10)))
    ]
    assert {axes.get_ylabel() for axes in panels} == {"position [m]"}
    # By default those that move most.
    place, _, angle, *_ = many.plot().axes
    assert labels(place) == [f"b{k} {x}" for k in range(6, 10) for x in "xy"]
    assert labels(angle) == [f"b{k}" for k in range(2, 10)]


def test_no_legend_covers_a_curve(double):
    figure = double.plot("b1", "b2", "energy", "residuals")
    figure.canvas.draw()
    for axes in figure.axes:
        if axes.get_legend():
            assert not axes.get_legend().get_window_extent().overlaps(axes.get_window_extent().shrunk(0.98, 0.98))


def test_legends_stand_above_wide_panels_and_beside_narrow_ones():
    figure = new_figure(9.0, 3.0)
    wide, narrow = figure.subplots(1, 2, width_ratios=(1.6, 1))
    for axes in (wide, narrow):
        for k in range(2):
            axes.plot([0.0, 1.0], label=f"driven accelerometer[{k}]")
        draw_legend(axes)
    figure.canvas.draw()
    above, beside = (axes.get_legend().get_window_extent() for axes in (wide, narrow))
    assert above.y0 > wide.get_window_extent().y1 - 5 and above.x1 < narrow.get_window_extent().x0
    assert beside.x0 > narrow.get_window_extent().x1 - 5


def test_a_motion_that_failed_says_where(double):
    failed = dataclasses.replace(
        double,
        ts=np.where(np.arange(6) < 4, TS, np.inf),
        result=mb.RESULTS.newton_failed,
    )
    figure = failed.plot("b1.angle")
    assert figure.get_suptitle().startswith("The run ended at t = 0.6 s: Newton's method found no state")
    assert figure.axes[0].lines[0].get_xdata().size == 4


def test_motions_that_cannot_be_shown_are_refused(double, tmp_path):
    double.save(tmp_path / "motion.npz")
    read = mb.load(tmp_path / "motion.npz")
    batch = jax.tree.map(lambda x: np.stack([x, x]), double)
    for shown, names, message in (
        (double, ("b1.angel",), "did you mean 'b1.angle'"),
        (double, ("b1.angle", "b3"), "Unknown body, joint or quantity 'b3'"),
        (batch, (), "single motions, but this is a batch"),
    ):
        with pytest.raises(ValueError, match=message):
            shown.plot(*names)
    with pytest.raises(ValueError, match=r"must be a motion from simulate.*; what load reads from a file has arrays"):
        viz.plot_motion(read)  # pyright: ignore[reportArgumentType]


def test_without_matplotlib_the_extra_is_named(double, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r'pip install "jaxmb\[plot\]"'):
        double.plot("b1.angle")


# Units


def test_units_of_quantities_and_actuators(double):
    system = double.system
    for quantity, word, unit in (
        ("b1.velocity", "velocity", "m/s"),
        ("b1.angular_acceleration", "angular acceleration", "rad/s²"),
        ("p1.angle_rate", "angular velocity", "rad/s"),
        ("p1.angle_acceleration", "angular acceleration", "rad/s²"),
        ("p1.moment", "moment", "N m"),
        ("motor.force", "torque", "N m"),
    ):
        assert named(system, quantity)[2:] == (word, unit), quantity
    for name, word, unit in (
        ("p1.angle", "torque", "N m"),
        ("motor", "torque", "N m"),
        ("b1.x", "force", "N"),
        ("b1.angle", "torque", "N m"),
        ("motor.lag", "lag", "s"),
    ):
        assert effort(system, name) == (word, unit), name
    found = {name: parameter_unit(system, name) for name in ("b1.mass", "p1.point_b[0]", "gravity.acceleration[1]")}
    assert found == {"b1.mass": "kg", "p1.point_b[0]": "m", "gravity.acceleration[1]": "m/s²"}
    assert shown_unit("Pa", np.array([3e7])) == (1e-6, "MPa") and shown_unit("N", np.array([999.0])) == (1.0, "N")
    assert shown_unit("m", np.array([2e-5])) == (1e6, "µm") and shown_unit("m", np.array([0.02]))[1] == "mm"
    assert shown_unit("m", np.zeros(2)) == (1.0, "m") and shown_unit("rad", np.array([1e5])) == (1.0, "rad")


def test_states_of_a_controller_have_the_units_that_were_given(double):
    law = lambda t, measured, states, p: (p["gain"] * measured["angle"], {"sum": measured["angle"]})
    units = {"sum": "rad s", "gain": "N m/rad"}
    numbers = {"states": {"sum": 0.0}, "parameters": {"gain": 1.0}, "units": units}
    bar = planar.Body("bar", mass=1.0, inertia=0.1)
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    control = mb.Controller("pid", law, {"angle": "pin.angle"}, "pin.angle", **numbers)
    system = mb.Scene([bar], joints=[pin], forces=[control]).compile()
    assert named(system, "pid.sum").unit == "rad s" and parameter_unit(system, "pid.gain") == "N m/rad"


# Inverse dynamics and loads


def needed_of(double, forces):
    power = {name: np.full(TS.size, 2e3) for name in forces}
    return mb.RequiredForces(TS, forces, power, double.ys, None, None, double.system, double.system)


def test_required_forces(double):
    push = np.stack([3.0 * TS, 2e3 * TS], axis=1)
    needed = needed_of(double, {"p1.angle": 5.0 * TS, "p2.angle": TS, "b1.position": push})
    torque, force, power = needed.plot().axes
    assert [axes.get_ylabel() for axes in (torque, force, power)] == [
        "torque [N m]",
        "force [kN]",
        "power into the machine [kW]",
    ]
    assert labels(torque) == ["p1.angle", "p2.angle"] and labels(force) == ["b1.position x", "b1.position y"]
    np.testing.assert_allclose(force.lines[1].get_ydata(), 2.0 * TS)
    assert torque.lines[0].get_color() == power.lines[0].get_color()
    assert labels(needed.plot("p2.angle").axes[1]) == ["p2.angle"]
    with pytest.raises(ValueError, match=r"did you mean 'p1\.angle'"):
        needed.plot("p1.angel")
    assert list(needed.to_pandas().columns) == [
        *("t", "p1.angle", "p2.angle", "b1.position[0]", "b1.position[1]"),
        *("p1.angle power", "p2.angle power", "b1.position power"),
    ]


def test_plan_shows_held_controls_as_steps_and_quantities_in_the_colours_of_their_bodies(double):
    controls = {kind: mb.Series([0.0, 0.5, 1.0], [1.0, -1.0, -1.0], kind) for kind in ("held", "linear")}
    along = dict.fromkeys(controls, 1.0 - TS)
    plan = types.SimpleNamespace(
        trajectory=double, system=double.system, controls=controls, along=along, bounds={"held": (-1.0, 1.0)}
    )
    held, linear, angle = plot_of_plan(plan, ["b2.angle"]).axes
    assert [axes.lines[0].get_drawstyle() for axes in (held, linear)] == ["steps-post", "default"]
    np.testing.assert_array_equal([line.get_ydata()[0] for line in held.lines[1:]], [-1.0, 1.0])
    assert angle.get_ylabel() == "angle [rad]" and angle.lines[0].get_color() == color(1)


def loads_of(points, forces, moments):
    kinds = ("joint", "joint", "gravity")
    times = np.array([0.0, 1.0, 2.0])
    shares = np.array([0.5, 1.0, 0.2])[:, None, None]
    stacked = lambda x: np.broadcast_to(np.asarray(x, float), (3, 3, 3))
    values = (stacked(points), shares * stacked(forces), shares * stacked(moments))
    return mb.Loads("boom", ("heel", "lift", "gravity"), kinds, (), times, *values, np.array([1.0, 0.0, 0.0]))


FLAT = ([[0, 0, 0], [2, 1, 0], [1, 0, 0]], [[4e3, 0, 0], [0, -2e3, 0], [0, -1e4, 0]], [[0, 0, -900], [0] * 3, [0] * 3])


def test_loads_are_arrows_on_the_body_and_curves():
    loads = loads_of(*FLAT)
    body, force, moment = loads.plot().axes
    assert "largest loads on boom, at t = 1 s" in body.get_title()
    assert [text.get_text() for text in body.texts if text.get_text()] == [
        "gravity 10 kN",
        "heel 4 kN, −900 N m",
        "lift 2 kN",
    ]
    arrows = {tuple(text.xyann): np.asarray(text.xy) for text in body.texts if not text.get_text()}
    np.testing.assert_allclose(arrows[0.0, 0.0] / np.linalg.norm(arrows[0.0, 0.0]), (1.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(arrows[1.0, 0.0][1] / (arrows[0.0, 0.0][0]), -2.5)
    (turn,) = body.patches
    # To the right about the heel, which is the origin.
    (x, y), (along_x, along_y) = turn.get_path().vertices[:2]
    assert x * along_y - y * along_x < 0
    assert labels(force) == list(loads.names) and force.get_ylabel() == "force [kN]"
    np.testing.assert_allclose(force.lines[0].get_ydata(), [2.0, 4.0, 0.8])
    assert moment.get_ylabel() == "moment [N m]"
    assert "loads on boom, at t = 2 s" in loads.plot("lift", t=1.9).axes[0].get_title()
    assert len(loads.worst().plot().axes) == 1
    with pytest.raises(ValueError, match="Unknown load 'left'; did you mean 'lift'"):
        loads.plot("left")
    with pytest.raises(ValueError, match="t = 3 is not between 0 and 2"):
        loads.plot(t=3.0)
    assert loads.to_pandas().shape == (9, 11) and loads.to_pandas()["force_y"][4] == -2e3


def test_loads_in_space_and_at_one_point():
    points, forces, moments = FLAT
    spatial = loads_of(points, [[4e3, 0, 1e3], *forces[1:]], moments).plot().axes[0]
    assert spatial.get_zlabel() == "z of the body [m]"
    bars = loads_of(np.zeros((3, 3)), forces, moments).plot().axes
    (force,) = [axes for axes in bars if axes.get_xlabel() == "force [kN]"]
    assert sorted(patch.get_width() for patch in force.patches) == pytest.approx([2.0, 4.0, 10.0])


# Fits


def swing():
    bar = planar.Body("bar", mass=1.0, inertia=0.3, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    return mb.Scene([bar], joints=[pin], forces=[mb.Gravity((0.0, -9.81))]).compile()


@pytest.mark.slow
def test_a_fit_stands_beside_its_data():
    system = swing()
    state, ts = mb.assemble(system, fix={"bar.angle": 0.5}), np.linspace(0.05, 1.0, 20)
    rng = np.random.default_rng(1)
    clean = mb.simulate(system, state, t1=1.0, saveat=ts)
    data = {
        "bar.angle": np.asarray(clean["bar"].angle) + 0.01 * rng.normal(size=20),
        "place": np.asarray(clean["bar"].position) + 0.01 * rng.normal(size=(20, 2)),
    }
    sensors = [mb.Sensor("bar.angle", sigma=0.01), mb.Sensor("bar.position", name="place", bias=0.0, sigma=0.01)]
    fit = mb.identify(system, data, ts=ts, free={"bar.inertia": 0.25}, state=state, sensors=sensors)
    angle, residual, place, _ = fit.plot().axes
    assert angle.get_ylabel() == "angle [rad]" and place.get_ylabel() == "position [m]"
    assert labels(angle) == ["bar.angle"] and labels(place) == ["place[0]", "place[1]"]
    np.testing.assert_allclose(angle.lines[0].get_ydata(), data["bar.angle"], atol=1e-12)
    fitted = mb.simulate(fit.system, fit.state, t1=1.0, saveat=ts)["bar"].angle
    np.testing.assert_allclose(angle.lines[1].get_ydata(), fitted, atol=1e-6)
    assert residual.get_ylabel() == "fitted − measured [σ]"
    np.testing.assert_allclose(residual.lines[0].get_ydata(), (fitted - data["bar.angle"]) / 0.01, atol=1e-3)
    band = fit.predict("bar.angle")
    (shaded,) = angle.collections
    points = shaded.get_paths()[0].vertices[:, 1]
    assert points.min() == pytest.approx(band.low["bar.angle"].min())
    assert "95% confidence" in fit.plot().get_suptitle()
    assert not fit.plot("bar.angle", level=None).axes[0].collections
    with pytest.raises(ValueError, match="Unknown sensor 'plaec'; did you mean 'place'"):
        fit.plot("plaec")
    assert fit.to_pandas().loc["bar.inertia", "estimate"] == pytest.approx(0.3, abs=0.02)


def test_a_fit_of_a_residual_function_has_no_curves():
    class Fake(Identification):
        series = ()  # pyright: ignore[reportAssignmentType]

    with pytest.raises(ValueError, match="compared by a residual function"):
        Identification.plot(object.__new__(Fake))


# Designs


def optimum():
    limits = [ConstrainedOutput(f"stress[{k}]", -np.inf, 9.0, 11.0, 9.0, True, 1.0, 1e-6) for k in range(3)]
    rows = [(0, 4.0, 0.2, True), (1, 1.0, 0.3, False), (2, 2.0, 0.0, True)]
    return mb.Optimum(
        parameters={"arm.mass": np.array(1.0), "pin.point_a": np.array([0.2, -0.1])},
        start={"arm.mass": np.array(2.0), "pin.point_a": np.array([0.1, -0.1])},
        objective=2.0,
        outputs={"mass": np.array(2.0), "stress": np.array([9.0, 8.0, 7.0])},
        before={"mass": np.array(4.0), "stress": np.array([11.0, 9.0, 8.0])},
        constraints=tuple(limits),
        iterations=tuple(Iteration(n, x, violation, 0.1, n, 0, ok) for n, x, violation, ok in rows),
        trials=3,
        failed=0,
        attempts=(),
        success=True,
        message="converged",
        derivatives="forward",
    )


def test_an_optimum_shows_its_iterations_and_parameters():
    figure = optimum().plot()
    objective, violation, parameters = figure.axes
    assert labels(objective) == ["best so far", "tried"]
    np.testing.assert_array_equal(objective.lines[0].get_xydata(), [(0, 4.0), (2, 2.0)])
    np.testing.assert_array_equal(objective.lines[1].get_xydata(), [(1, 1.0)])
    np.testing.assert_allclose(violation.lines[0].get_ydata(), [20.0, 30.0, 0.0])
    assert [text.get_text() for text in parameters.get_yticklabels()] == [
        "pin.point_a[1]\n-0.1 → -0.1",
        "pin.point_a[0]\n0.1 → 0.2",
        "arm.mass\n2 → 1",
    ]
    assert figure.get_suptitle() == "objective 2: converged"
    assert list(optimum().to_pandas().loc["pin.point_a[0]"]) == [0.1, 0.2]


def test_outputs_before_and_after():
    (stress,) = optimum().plot("stress", along={"t [s]": [0.0, 0.5, 1.0]}).axes
    assert legend(stress) == ["before", "after"]
    np.testing.assert_array_equal(stress.lines[0].get_xydata(), [(0.0, 11.0), (0.5, 9.0), (1.0, 8.0)])
    np.testing.assert_array_equal(stress.lines[-1].get_ydata(), [9.0, 9.0])
    assert stress.get_xlabel() == "t [s]" and stress.get_ylabel() == "stress"
    with pytest.raises(ValueError, match=r"along must have shape \(3,\), as 'stress' has; got \(2,\)"):
        optimum().plot("stress", along={"t [s]": [0.0, 1.0]})
    with pytest.raises(ValueError, match="did you mean 'stress'"):
        optimum().plot("stres")


# Small motions


@pytest.fixture(scope="module")
def linear():
    """An oscillator of 2 rad/s and damping ratio 0.1, by a torque, in place of a computed linearisation."""
    A, B = np.array([[0.0, 1.0], [-4.0, -0.4]]), np.array([[0.0], [1.0]])
    C, D, system = np.eye(2), np.zeros((2, 1)), swing()
    names = ("bar.angle", "bar.angle_rate"), ("motor.torque",), ("pin.angle", "pin.angle_rate")
    return mb.Linearisation(A, B, C, D, *names, 1, np.zeros((6, 2)), system, system.guess, np.array(0.0))


def with_numpy(linear, monkeypatch):
    """Eigenvalues and responses without programs."""

    def response(self, omega):
        return np.stack([self.C @ np.linalg.solve(1j * w * np.eye(2) - self.A, self.B) + self.D for w in omega])

    monkeypatch.setattr(mb.Linearisation, "eigenvalues", property(lambda self: np.linalg.eigvals(self.A)))
    monkeypatch.setattr(mb.Linearisation, "frequency_response", response)
    return linear


def test_bode(linear, monkeypatch):
    omega = np.array([0.02, 2.0, 200.0])
    gain, phase = with_numpy(linear, monkeypatch).plot("motor.torque", "pin.angle", omega=omega).axes
    assert labels(gain) == ["motor.torque → pin.angle"]
    np.testing.assert_allclose(gain.lines[0].get_ydata(), np.abs(1 / (4 - omega**2 + 0.4j * omega)), rtol=1e-12)
    np.testing.assert_allclose(phase.lines[0].get_ydata(), [-0.1146, -90.0, -179.885], atol=1e-3)
    assert (phase.get_xlabel(), phase.get_ylabel(), gain.get_xscale()) == ("ω [rad/s]", "phase [°]", "log")
    assert len(labels(linear.plot().axes[0])) == 2
    for inputs, outputs, message in (
        ("motor.toque", (), "did you mean 'motor.torque'"),
        ((), "pin.angel", "pin.angle"),
    ):
        with pytest.raises(ValueError, match=message):
            linear.plot(inputs, outputs)


def test_eigenvalues(linear, monkeypatch):
    alone = dataclasses.replace(with_numpy(linear, monkeypatch), inputs=())
    (plane,) = alone.plot().axes
    (stable,) = [line for line in plane.lines if line.get_label() == "stable or neutral"]
    np.testing.assert_allclose(np.sort(stable.get_ydata()), [-np.sqrt(3.96), np.sqrt(3.96)])
    np.testing.assert_allclose(stable.get_xdata(), -0.2)
    assert (plane.get_xlabel(), plane.get_ylabel()) == ("Re λ [1/s]", "Im λ [rad/s]")
    with pytest.raises(ValueError, match="plot shows a single result, and this is a batch of shape"):
        jax.tree.map(lambda x: np.stack([x, x]), alone).plot()


def test_multipliers_and_locus(monkeypatch):
    monkeypatch.setattr(mb.Floquet, "multipliers", property(lambda self: np.linalg.eigvals(self.monodromy)))
    periodic = mb.Floquet(np.diag([1.5, 0.5]), ("a", "a_rate"), 1, np.zeros((2, 2)), np.array(2.0))
    (plane,) = periodic.plot().axes
    found = {line.get_label().split(":")[0]: line.get_xdata() for line in plane.lines}
    np.testing.assert_allclose(found["stable"], [0.5])
    np.testing.assert_allclose(found["unstable"], [1.5])
    values = np.array([[-1.0 + 2j, -1.0 - 2j], [0.5 + 2j, 0.5 - 2j]])
    locus = mb.RootLocus("speed", np.array([1.0, 2.0]), values, np.ones((2, 2, 2)), ("a", "b"))
    real, _, plane = locus.plot(labels=["weave"]).axes
    assert legend(real) == ["weave"] and real.get_ylabel() == "Re λ [1/s]" and plane.get_ylabel() == "Im λ [rad/s]"


# Suspensions and sweeps


def curves(steer):
    grid = (5,) if steer is None else (5, *np.shape(steer))
    values = lambda x: np.full(grid, x) * np.linspace(-1.0, 1.0, 5).reshape(5, *[1] * (len(grid) - 1))
    plain = ("toe", "camber", "bump_steer", "bump_camber", "track", "wheelbase", "roll_centre")
    others = dict.fromkeys(("caster", "kingpin_inclination", "scrub_radius", "caster_trail"))
    return mb.KinematicsAndCompliance(
        travel=np.linspace(-0.1, 0.1, 5),
        steer=steer,
        motion_ratio={"spring": values(0.5)},
        compliance={},
        q=np.zeros((*grid, 7)),
        freedoms=0,
        **{name: values(0.01) for name in plain},
        **others,
    )


def test_curves_of_a_suspension_point_upward():
    toe, camber, track, centre, ratio = curves(None).plot().axes
    np.testing.assert_allclose(toe.lines[0].get_ydata(), [-100, -50, 0, 50, 100])
    np.testing.assert_allclose(toe.lines[0].get_xdata(), np.rad2deg(0.01) * np.linspace(-1, 1, 5))
    assert [axes.get_xlabel()[-4:] for axes in (toe, camber, track, centre)] == [" [°]", " [°]", "[mm]", "[mm]"]
    assert labels(ratio) == ["spring"] and toe.get_ylabel() == "travel of the wheel, up [mm]"
    steered = curves(np.array([-0.02, 0.0, 0.02])).plot("toe").axes[0]
    assert legend(steered) == ["steer −0.02", "steer 0", "steer 0.02"]
    for name in ("caster", "to"):
        with pytest.raises(ValueError, match=f"Unknown curve '{name}'"):
            curves(None).plot(name)


def test_sweeps_are_curves_and_maps():
    xarray = pytest.importorskip("xarray")
    status = np.ones((3, 4), int)
    status[2, 3] = 4
    runs = xarray.Dataset(
        {
            "swing": (("mass", "length"), np.arange(12.0).reshape(3, 4), {"units": "rad"}),
            "angle": (("mass", "length", "time"), np.arange(60.0).reshape(3, 4, 5)),
            "status": (("mass", "length"), status),
        },
        {"mass": ("mass", [1.0, 2.0, 3.0], {"units": "kg"}), "length": [0.1, 0.2, 0.3, 0.4], "time": np.arange(5.0)},
    )
    short = runs.assign_coords(length=("length", [0.01, 0.02, 0.03, 0.04], {"units": "m"}))
    figure = viz.plot_sweep(runs, "swing")
    colours, bar = figure.axes
    assert (colours.get_xlabel(), colours.get_ylabel(), bar.get_ylabel()) == ("mass [kg]", "length", "swing [rad]")
    shown = np.ma.filled(colours.collections[0].get_array(), np.nan)
    np.testing.assert_array_equal(shown.T, [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, np.nan]])
    assert figure.get_suptitle() == "1 of 12 members failed and are left out"
    for wide, scale in ((10.0 ** np.arange(12.0), "log"), (1.0 + np.arange(12.0), "linear")):
        colours, bar = viz.plot_sweep(runs.assign(swing=(("mass", "length"), wide.reshape(3, 4))), "swing").axes
        assert bar.get_yscale() == scale
    (over_time,) = viz.plot_sweep(runs, "angle", at={"length": 0.19}).axes
    assert labels(over_time) == ["mass = 1 kg", "mass = 2 kg", "mass = 3 kg"]
    np.testing.assert_array_equal(over_time.lines[1].get_ydata(), 25.0 + np.arange(5.0))
    assert viz.plot_sweep(short, "swing").axes[0].get_ylabel() == "length [mm]"
    figure = viz.plot_sweep(short, "swing", at={"mass": 3.0})
    (line,) = figure.axes[0].lines
    assert (figure.get_suptitle(), figure.axes[0].get_xlabel()) == (
        "mass = 3 kg; 1 of 4 members failed and are left out",
        "length [mm]",
    )
    np.testing.assert_allclose(line.get_xdata(), [10.0, 20.0, 30.0, 40.0])
    np.testing.assert_array_equal(line.get_ydata(), [8.0, 9.0, 10.0, np.nan])
    for name, at, message in (
        ("swin", None, "did you mean 'swing'"),
        ("angle", None, "one or two dimensions, and 'angle' has mass, length, time"),
        ("swing", {"lenght": 1.0}, "did you mean 'length'"),
    ):
        with pytest.raises(ValueError, match=message):
            viz.plot_sweep(runs, name, at=at)
    with pytest.raises(ValueError, match="no status"):
        viz.plot_sweep(runs.drop_vars("status"), "swing")


def test_the_functions_of_pictures_exist():
    with pytest.raises(AttributeError):
        picture("loads.nothing", None)
