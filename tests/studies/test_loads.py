"""Loads of bodies along motions."""

import csv
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import four_bar_forces
from trajectories import motion_of

import jaxmb as mb
from jaxmb import mechanisms, planar, spatial

LENGTHS, BASE, MASSES, GRAVITY = (1.0, 3.0, 2.5), 2.5, (1.0, 3.0, 2.5), 9.81


def through(system, count=1):
    """A trajectory through states with random velocities."""
    random, states = np.random.default_rng(0), []
    for _ in range(count):
        u = jnp.asarray(random.normal(size=system.nu))
        states.append(mb.assemble(system, mb.State(system.guess.q, u, system.guess.z), throw=False))
    ys = jax.tree.map(lambda *x: jnp.stack(x), *states)
    return motion_of(system, np.arange(float(count)), ys.q, ys.u, ys.z)


@functools.cache
def four_bar():
    """The linkage at three instants."""
    machine = mechanisms.four_bar(lengths=LENGTHS, base=BASE, masses=MASSES, gravity=GRAVITY)
    return through(machine.system, 3)


def body_axes(angle, vector):
    turned = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]) @ vector
    return np.append(turned, 0.0)


def check_balance(motion, names=None):
    for name in motion.system.body_names if names is None else names:
        on_body = mb.loads(motion, name)
        force, moment = on_body.balance
        size = np.max(np.abs(on_body.forces))
        arm = max(np.max(np.abs(on_body.points)), float(motion.system.length))
        np.testing.assert_allclose(force, 0.0, atol=1e-12 * size)
        # A free body has no loads, but gyroscopic moments up to twice its kinetic energy.
        largest = max(size * arm, np.max(np.abs(on_body.moments)), np.max(motion.kinetic_energy))
        np.testing.assert_allclose(moment, 0.0, atol=1e-12 * largest)


def test_pins_as_by_newton_and_euler():
    motion = four_bar()
    coupler, angles = mb.loads(motion, "coupler"), motion["coupler"].angle
    assert coupler.names == ("B", "C", "gravity", "inertia")
    assert coupler.kinds == ("joint", "joint", "gravity", "inertia") and not coupler.undetermined
    np.testing.assert_allclose(coupler["B"].point, np.tile([-1.5, 0.0, 0.0], (3, 1)), atol=1e-15)
    for k in range(3):
        crank = motion["crank"]
        at = crank.angle[k], crank.angular_velocity[k], motion.quantity("crank.angular_acceleration")[k]
        torque, pins = four_bar_forces.forces(LENGTHS, BASE, MASSES, GRAVITY, *map(float, at))
        assert abs(torque) < 1e-10
        np.testing.assert_allclose(coupler["B"].force[k], body_axes(angles[k], pins[1]), atol=1e-10)
        np.testing.assert_allclose(coupler["C"].force[k], body_axes(angles[k], -pins[2]), atol=1e-10)
        np.testing.assert_allclose(coupler["B"].moment[k], 0.0, atol=1e-11)
    check_balance(motion, ["coupler"])


def test_worst_instants_and_files(tmp_path):
    crank = mb.loads(four_bar(), "crank")
    sizes = np.max(np.linalg.norm(np.asarray(crank.forces), axis=2)[:, :2], axis=1)
    np.testing.assert_array_equal(crank.worst(count=3).ts, np.argsort(-sizes))
    by_moment = lambda loads: jnp.abs(loads["inertia"].moment[:, 2])
    worst = crank.worst(by_moment)
    assert float(worst.ts[0]) == int(np.argmax(by_moment(crank)))
    crank.to_csv(tmp_path / "crank.csv")
    with (tmp_path / "crank.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12 and rows[0]["part"] == "A" and len(rows[0]) == 11
    np.testing.assert_array_equal([float(rows[5][f"force_{axis}"]) for axis in "xyz"], crank["B"].force[1])
    assert float(rows[5]["time"]) == 1.0 and "largest force [N]" in str(crank)
    with pytest.raises(ValueError, match="a number at each time"):
        crank.worst(lambda loads: loads.forces)


def test_names_that_are_unknown():
    with pytest.raises(ValueError, match="did you mean 'coupler'"):
        mb.loads(four_bar(), "couplr")
    with pytest.raises(ValueError, match="Unknown load 'D'"):
        mb.loads(four_bar(), "coupler")["D"]
    machine = mechanisms.roller_racer()
    with pytest.raises(ValueError, match="there are none"):
        mb.loads(motion_of(machine.system, [0.0], machine.state.q[None], machine.state.u[None]), "racer")


@pytest.mark.slow
def test_a_body_with_friction_a_stop_a_motor_and_its_frame_elsewhere():
    rod = planar.Body("rod", mass=2.0, inertia=0.3, position=(0.0, 0.0), centre=(0.5, 0.1))
    pin = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    forces = [
        mb.Gravity((0.0, -9.81)),
        planar.Friction("rub", "pin", coefficient=0.3, radius=0.1, transition_speed=0.1),
        mb.JointStop("stop", "pin.angle", lower=0.5, upper=1.0, stiffness=50.0),
        mb.Motor("motor", "pin.angle", command=2.0, lag=0.1, force=1.5),
        planar.PointForce("wind", "rod", force=(3.0, 1.0), point=(1.0, 0.2)),
    ]
    motion = through(mb.Scene([rod], joints=[pin], forces=forces).compile())
    on_rod = mb.loads(motion, "rod")
    kinds = dict(zip(on_rod.names, on_rod.kinds, strict=True))
    assert kinds["rub"] == "friction" and kinds["stop"] == "force" and kinds["motor"] == "force"
    np.testing.assert_allclose(on_rod.mass_centre, [0.5, 0.1, 0.0])
    np.testing.assert_allclose(on_rod["wind"].point, [[1.0, 0.2, 0.0]], atol=1e-15)
    np.testing.assert_allclose(on_rod["wind"].force, [body_axes(float(motion["rod"].angle[0]), [3.0, 1.0])], rtol=1e-12)
    np.testing.assert_allclose(on_rod["wind"].moment, 0.0, atol=1e-13)
    np.testing.assert_allclose(on_rod["motor"].moment, [[0.0, 0.0, 1.5]], atol=1e-12)
    check_balance(motion)


@pytest.mark.slow
def test_only_bodies_that_touch_are_in_contact():
    """A part that acts where a gap is closed, or on one side only, may be a rope, a coupler or a stop."""
    rod = planar.Body("rod", mass=2.0, inertia=0.3, position=(0.5, 0.0))
    car = planar.Body("car", mass=2.0, inertia=0.3, position=(3.0, 0.0))
    terrain, push = mb.terrain.Flat(-5.0), mb.contact.Linear(1e4)
    joints = [
        planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0)),
        mb.Stop("stop", "pin.angle", lower=-2.0),
        mb.Slack("slack", "ground", "rod", length=3.0),
        mb.Rope("rope", [("ground", (0.0, 2.0)), ("rod", (0.5, 0.0))], stiffness=100.0, length=3.0),
        mb.RigidContact("rigid", "rod", terrain=terrain, radius=0.1),
    ]
    forces = [
        mb.JointStop("compliant_stop", "pin.angle", lower=-1.0, upper=1.0, stiffness=10.0),
        planar.DraftGear("gear", "rod", "car"),
        planar.Contact("compliant", "rod", terrain=terrain, radius=0.1, normal=push),
        planar.Tyre(
            "tyre",
            "car",
            terrain=terrain,
            radius=0.3,
            normal=push,
            coefficient=0.9,
            slip_stiffness=8.0,
            relaxation_length=0.3,
        ),
    ]
    motion = through(mb.Scene([rod, car], joints=joints, forces=forces).compile())
    kinds: dict[str, str] = {}
    for body in ("rod", "car"):
        loads = mb.loads(motion, body)
        kinds |= dict(zip(loads.names, loads.kinds, strict=True))
    assert {name for name, kind in kinds.items() if kind == "contact"} == {"rigid", "compliant", "tyre"}
    assert {name for name, kind in kinds.items() if kind == "joint"} == {"pin", "stop", "slack"}
    assert {name for name, kind in kinds.items() if kind == "force"} == {"compliant_stop", "rope", "gear"}


def lifted(space, *, driven=False):
    """A boom with its frame at the pin, on a cylinder."""
    of = (lambda v: v) if space is planar else (lambda v: (*v, 0.0))
    if space is planar:
        inertia, pinned = 6.0, {}
    else:
        inertia, pinned = (0.5, 6.0, 6.0), {"axis": (0.0, 0.0, 1.0)}
    boom = space.Body("boom", mass=40.0, inertia=inertia, centre=of((0.9, 0.1)))
    pin = space.Revolute("pin", "ground", "boom", point=of((0.0, 0.0)), **pinned)
    lift = space.Cylinder("lift", "ground", "boom", bore_area=2e-3, point_a=of((0.2, -0.5)), point_b=of((0.6, -0.2)))
    move = [mb.JointDriver("move", "lift.length", rate=0.4)] if driven else []
    tip = space.PointForce("tip", "boom", force=of((3.0, -50.0)), point=of((2.0, 0.0)))
    return mb.Scene([boom], joints=[pin, lift, *move], forces=[mb.Gravity(of((0.0, -9.81))), tip]).compile()


@pytest.mark.parametrize(
    "space, by",
    [
        (planar, "lift.pressure"),
        *(pytest.param(planar, by, marks=pytest.mark.slow) for by in ("move", "lift.length", "boom.angle")),
        *(pytest.param(spatial, by, marks=pytest.mark.slow) for by in ("move", "lift.length", "pin.angle")),
    ],
)
def test_needed_forces_are_loads_as_forces_of_a_drive(space, by):
    motion = through(lifted(space, driven=True))
    expected, system = mb.loads(motion, "boom"), motion.system if by == "move" else lifted(space)
    # One cylinder is one load, whatever drives it.
    assert expected.names == ("pin", "lift", "tip", "gravity", "inertia")
    np.testing.assert_allclose(expected["lift"].point[0, :2], [0.6, -0.2], atol=1e-14)
    np.testing.assert_allclose(expected["lift"].moment, 0.0, atol=1e-10)
    force = motion.reactions["move"].multipliers[:, 0]
    np.testing.assert_allclose(np.linalg.norm(expected["lift"].force, axis=1), np.abs(force), rtol=1e-12)
    needed = mb.required_forces(system, motion, by=[by])
    found, load = mb.loads(needed, "boom"), by if by.endswith("angle") else "lift"
    assert found.kinds[found.names.index(load)] == "force"
    for total in found.balance:
        np.testing.assert_allclose(total, 0.0, atol=1e-9)
    if by.endswith(".angle"):
        np.testing.assert_allclose(found[load].force, 0.0, atol=1e-12)
        np.testing.assert_allclose(found[load].moment[:, 2], needed[by], rtol=1e-12)
        return
    assert found.names == expected.names
    for name in found.names:
        for a, b in zip(found[name], expected[name], strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_parts_along_a_cylinder_share_its_row():
    """Its pressure, a spring along it and friction of its seals; a tendon without a force of its own has no row."""
    bar = planar.Body("bar", mass=2.0, inertia=0.5, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    ram = planar.Cylinder("ram", "ground", "bar", bore_area=1e-3, pressure=3e4, point_a=(0.3, -1.0), point_b=(0.2, 0.0))
    line = mb.Tendon("line", [("ground", (1.0, 1.0)), ("bar", (0.5, 0.0))])
    forces = [
        mb.JointForce("push", "ram.length", force=4.0),
        mb.JointSpring("cushion", "ram.length", stiffness=50.0, free=0.9),
        mb.JointSpring("pull", "line.length", stiffness=20.0, free=0.5),
    ]
    motion = through(mb.Scene([bar], joints=[pin, ram, line], forces=forces).compile())
    on_bar = mb.loads(motion, "bar")
    assert on_bar.names == ("pin", "ram", "pull", "inertia") and on_bar.kinds == ("joint", "force", "force", "inertia")
    length = float(motion["ram"].length[0])
    assert np.linalg.norm(on_bar["ram"].force[0]) == pytest.approx(abs(34.0 - 50.0 * (length - 0.9)), rel=1e-12)
    check_balance(motion)


@pytest.mark.slow
def test_derivatives_of_loads_under_needed_forces():
    """Of a pin force along a prescribed motion, by a mass and by the place of the cylinder, alone and in a batch."""
    system, ts = lifted(planar), np.linspace(0.0, 0.4, 5)
    swing = {"pin.angle": lambda t: 0.3 + 0.2 * jnp.sin(4.0 * t)}

    def pinned(x):
        place = {"boom.mass": x[0], "lift.point_b": jnp.stack([x[1], -0.2 + 0.0 * x[1]])}
        needed = mb.required_forces(mb.with_parameters(system, place), swing, by=["lift.pressure"], ts=ts)
        return jnp.max(mb.rotations.norm(mb.loads(needed, "boom")["pin"].force))

    x, along = jnp.array([40.0, 0.6]), jnp.array([3.0, 0.1])
    reverse = jnp.vdot(jax.jit(jax.grad(pinned))(x), along)
    _, forward = jax.jit(lambda v: jax.jvp(pinned, (x,), (v,)))(along)
    np.testing.assert_allclose(reverse, forward, rtol=1e-11)
    steps = jnp.array([1e-3, -1e-3, 2e-3, -2e-3])
    a, b, c, d = jax.vmap(lambda h: pinned(x + h * along))(steps)
    np.testing.assert_allclose(forward, (8 * (a - b) - (c - d)) / 12e-3, rtol=1e-8)


def test_quantities_of_a_needed_motion():
    system = lifted(planar, driven=True)
    motion = through(system)
    needed = mb.required_forces(system, motion, by=["move"])
    for name in ("lift.length", "boom.position", "boom.acceleration", "pin.force"):
        np.testing.assert_allclose(needed.quantity(name), motion.quantity(name), rtol=1e-9)
    with pytest.raises(ValueError, match=r"did you mean 'lift\.length'"):
        needed.quantity("lift.lenght")


LIBRARY = (
    "pendulum",
    "slider_crank",
    "parallelogram",
    "knife_edge",
    "chaplygin_sleigh",
    "heavy_top",
    "free_body",
    "rolling_disc",
    "spatial_slider_crank",
    "bennett",
    "swash_plate",
    "car_axis",
)


@pytest.mark.slow
@pytest.mark.parametrize("name", LIBRARY)
def test_loads_balance(name):
    check_balance(through(mechanisms.get(name).system, 2))


@pytest.mark.slow
def test_shares_of_redundant_joints_are_named():
    on_coupler = mb.loads(through(mechanisms.parallelogram().system), "coupler")
    assert on_coupler.undetermined == ("head1", "head2", "head3")
    assert "not determined" in str(on_coupler)


@pytest.mark.slow
def test_derivatives_of_the_largest_force():
    """Of a pin force along a simulated motion, by a mass and a length."""
    machine = mechanisms.four_bar()

    def largest(x):
        changed = mb.with_parameters(machine.system, {"coupler.mass": x[0], "B.point_b": jnp.stack([x[1], 0.0 * x[1]])})
        state = mb.assemble(changed, machine.state, fix=machine.fix, rates=machine.rates)
        motion = mb.simulate(changed, state, t1=0.3, saveat=jnp.linspace(0.0, 0.3, 7), rtol=1e-10, atol=1e-12)
        return jnp.max(mb.rotations.norm(mb.loads(motion, "coupler")["C"].force))

    x, along = jnp.array([3.0, -1.5]), jnp.array([0.3, 0.1])
    reverse = jnp.vdot(jax.jit(jax.grad(largest))(x), along)
    _, forward = jax.jit(lambda v: jax.jvp(largest, (x,), (v,)))(along)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    at = jax.jit(lambda h: largest(x + h * along))
    differences = (8 * (at(1e-3) - at(-1e-3)) - (at(2e-3) - at(-2e-3))) / 12e-3
    np.testing.assert_allclose(forward, differences, rtol=1e-5)
