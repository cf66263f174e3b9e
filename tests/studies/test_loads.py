"""Loads of bodies along motions."""

import csv
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import four_bar_forces
from trajectories import motion_of

import jaxmb as mb
from jaxmb import mechanisms, planar, spatial
from jaxmb.studies.loads import _of_body

MOST_PROGRAMS = 140


def through(system, count=1):
    """A trajectory through states with random velocities."""
    random, states = np.random.default_rng(0), []
    for _ in range(count):
        u = jnp.asarray(random.normal(size=system.nu))
        states.append(mb.assemble(system, mb.State(system.guess.q, u, system.guess.z), throw=False))
    ys = jax.tree.map(lambda *x: np.stack(x), *states)
    return motion_of(system, np.arange(float(count)), ys.q, ys.u, ys.z)


def in_axes(angle, vector):
    turned = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]) @ vector
    return np.append(turned, 0.0)


def check_balance(motion, names):
    for name in names:
        on_body = mb.loads(motion, name)
        force, moment = (np.asarray(x) for x in on_body.balance)
        size = np.max(np.abs(on_body.forces))
        arm = max(np.max(np.abs(on_body.points)), float(motion.system.length))
        np.testing.assert_allclose(force, 0.0, atol=1e-12 * size)
        # A free body has no loads, but gyroscopic moments up to twice its kinetic energy.
        largest = max(size * arm, np.max(np.abs(on_body.moments)), np.max(motion.kinetic_energy))
        np.testing.assert_allclose(moment, 0.0, atol=1e-12 * largest)


MASS, CENTRE = 40.0, (0.9, 0.1)


def lifted(space, *, driven=False):
    """A boom with its frame at the pin, on a cylinder."""
    of = (lambda v: v) if space is planar else (lambda v: (*v, 0.0))
    inertia, pinned = (6.0, {}) if space is planar else ((0.5, 6.0, 6.0), {"axis": (0.0, 0.0, 1.0)})
    boom = space.Body("boom", mass=MASS, inertia=inertia, centre=of(CENTRE))
    pin = space.Revolute("pin", "ground", "boom", point=of((0.0, 0.0)), **pinned)
    lift = space.Cylinder("lift", "ground", "boom", bore_area=2e-3, point_a=of((0.2, -0.5)), point_b=of((0.6, -0.2)))
    move = [mb.JointDriver("move", "lift.length", rate=0.4)] if driven else []
    tip = space.PointForce("tip", "boom", force=of((3.0, -50.0)), point=of((2.0, 0.0)))
    coil = mb.JointSpring("coil", "pin.angle", stiffness=70.0, free=1.0)
    forces = [mb.Gravity(of((0.0, -9.81))), tip, coil]
    return mb.Scene([boom], joints=[pin, lift, *move], forces=forces).compile()


@pytest.fixture(scope="module")
def boom():
    """A boom whose cylinder has a driver, at three instants."""
    return through(lifted(planar, driven=True), 3)


def test_loads_of_a_boom_are_in_balance(boom):
    """One cylinder is one load, whatever drives it."""
    found = mb.loads(boom, "boom")
    assert found.names == ("pin", "lift", "tip", "coil", "gravity", "inertia") and not found.undetermined
    assert found.kinds == ("joint", "force", "force", "force", "gravity", "inertia")
    np.testing.assert_allclose(found.mass_centre, [*CENTRE, 0.0])
    angles = np.asarray(boom["pin"].angle)
    for name, point in {"pin": (0, 0, 0), "lift": (0.6, -0.2, 0), "tip": (2, 0, 0), "coil": (0, 0, 0)}.items():
        np.testing.assert_allclose(found[name].point, np.tile(point, (3, 1)), atol=1e-13, err_msg=name)
    for name, force in {"tip": [3.0, -50.0], "gravity": [0.0, -9.81 * MASS]}.items():
        expected = [in_axes(angle, force) for angle in angles]
        np.testing.assert_allclose(found[name].force, expected, atol=1e-10, err_msg=name)
        np.testing.assert_allclose(found[name].moment, 0.0, atol=1e-10, err_msg=name)
    np.testing.assert_allclose(found["coil"].force, 0.0, atol=1e-12)
    np.testing.assert_allclose(found["coil"].moment[:, 2], 70.0 * (1.0 - angles), rtol=1e-12)
    np.testing.assert_allclose(found["lift"].moment, 0.0, atol=1e-10)
    force = np.abs(boom.reactions["move"].multipliers[:, 0])
    np.testing.assert_allclose(np.linalg.norm(found["lift"].force, axis=1), force, rtol=1e-12)
    check_balance(boom, ["boom"])


def test_inertia_of_a_body_in_space_has_gyroscopic_moments():
    J = np.array([[2.0, 0.1, 0.3], [0.1, 1.5, 0.2], [0.3, 0.2, 1.0]])
    system = mb.Scene([spatial.Body("top", mass=3.0, inertia=J)]).compile()
    u, udot = np.random.default_rng(0).normal(size=(2, 6))
    y = mb.State(system.guess.q, jnp.asarray(u))
    (inertia,) = _of_body(system, 0, system.kinematics(0.0, y.q, y.u), y, jnp.asarray(udot))
    turning = J @ udot[3:] + np.cross(u[3:], J @ u[3:])
    np.testing.assert_allclose(inertia, -np.concatenate([3.0 * udot[:3], turning]), rtol=1e-13)


def test_loads_of_needed_forces_are_those_of_the_motion(boom):
    needed, expected = mb.required_forces(boom.system, boom, by=["move"]), mb.loads(boom, "boom")
    found = mb.loads(needed, "boom")
    assert found.names == expected.names and found.kinds == expected.kinds
    for name in found.names:
        for a, b in zip(found[name], expected[name], strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9, err_msg=name)
    for name in ("boom.acceleration", "pin.force"):
        np.testing.assert_allclose(needed.quantity(name), boom.quantity(name), rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match=r"did you mean 'lift\.length'"):
        needed.quantity("lift.lenght")


def test_balance_of_loads_is_about_the_mass_centre(boom):
    """Not about the origin of the body's frame: a force there has no arm."""
    found = mb.loads(boom, "boom")
    force, moment = np.array([3.0, -2.0, 0.0]), np.array([0.0, 0.0, 0.5])
    at = np.array([CENTRE[0], CENTRE[1] + 0.7, 0.0])
    alone = lambda point: dataclasses.replace(
        found, points=np.array([[point]]), forces=np.array([[force]]), moments=np.array([[moment]])
    )
    np.testing.assert_allclose(alone([*CENTRE, 0.0]).balance[1], [moment], atol=1e-15)
    np.testing.assert_allclose(alone(at).balance[1], [moment - [0.0, 0.0, 0.7 * force[0]]], atol=1e-14)


def test_loads_at_the_worst_instants_and_in_files(boom, tmp_path):
    found = mb.loads(boom, "boom")
    sizes = np.max(np.linalg.norm(np.asarray(found.forces), axis=2)[:, :4], axis=1)
    np.testing.assert_array_equal(found.worst(count=3).ts, np.argsort(-sizes))
    # Gravity and inertia do not count, whatever their sizes.
    reverse = 1e6 * np.argsort(np.argsort(-sizes))[:, None, None]
    large = np.concatenate([found.forces[:, :4], np.tile(reverse, (1, 2, 3))], axis=1)
    heavy = dataclasses.replace(found, forces=jnp.asarray(large))
    np.testing.assert_array_equal(heavy.worst(count=3).ts, np.argsort(-sizes))
    moments = np.abs(found["inertia"].moment[:, 2])
    assert float(found.worst(lambda loads: jnp.abs(loads["inertia"].moment[:, 2])).ts[0]) == int(np.argmax(moments))
    found.to_csv(tmp_path / "boom.csv")
    with (tmp_path / "boom.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 18 and rows[0]["part"] == "pin" and len(rows[0]) == 11
    np.testing.assert_array_equal([float(rows[7][f"force_{axis}"]) for axis in "xyz"], found["lift"].force[1])
    assert float(rows[7]["time"]) == 1.0 and "largest force [N]" in str(found)


def test_loads_name_what_they_do_not_know(boom):
    for call, text in (
        (lambda: mb.loads(boom, "bom"), "did you mean 'boom'"),
        (lambda: mb.loads(boom, "boom")["D"], "Unknown load 'D'"),
        (lambda: mb.loads(boom, "boom").worst(lambda loads: loads.forces), "a number at each time"),
    ):
        with pytest.raises(ValueError, match=text):
            call()


@pytest.mark.slow
@pytest.mark.parametrize("space, by", [(planar, "lift.pressure"), (planar, "boom.angle"), (spatial, "pin.angle")])
def test_needed_forces_are_loads_as_forces_of_a_drive(space, by):
    motion, system = through(lifted(space, driven=True)), lifted(space)
    expected = mb.loads(motion, "boom")
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
def test_loads_of_pins_are_those_of_newton_and_euler():
    lengths, base, masses = (1.0, 3.0, 2.5), 2.5, (1.0, 3.0, 2.5)
    motion = through(mechanisms.four_bar(lengths=lengths, base=base, masses=masses, gravity=9.81).system, 3)
    coupler, angles, crank = mb.loads(motion, "coupler"), motion["coupler"].angle, motion["crank"]
    np.testing.assert_allclose(coupler["B"].point, np.tile([-1.5, 0.0, 0.0], (3, 1)), atol=1e-15)
    for k in range(3):
        at = crank.angle[k], crank.angular_velocity[k], motion.quantity("crank.angular_acceleration")[k]
        torque, pins = four_bar_forces.forces(lengths, base, masses, 9.81, *map(float, at))
        assert abs(torque) < 1e-10
        np.testing.assert_allclose(coupler["B"].force[k], in_axes(angles[k], pins[1]), atol=1e-10)
        np.testing.assert_allclose(coupler["C"].force[k], in_axes(angles[k], -pins[2]), atol=1e-10)
        np.testing.assert_allclose(coupler["B"].moment[k], 0.0, atol=1e-11)


@pytest.mark.slow
def test_kinds_of_loads():
    """A part that acts where a gap is closed, or on one side only, may be a rope, a coupler or a stop.

    A tendon without a force of its own has no row; parts along a cylinder share its row.
    """
    rod = planar.Body("rod", mass=2.0, inertia=0.3, position=(0.0, 0.0), centre=(0.5, 0.1))
    car = planar.Body("car", mass=2.0, inertia=0.3, position=(3.0, 0.0))
    terrain, push = mb.terrain.Flat(-5.0), mb.contact.Linear(1e4)
    slip = {"coefficient": 0.9, "slip_stiffness": 8.0, "relaxation_length": 0.3}
    kinds = {
        "joint": [
            planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0)),
            mb.Stop("stop", "pin.angle", lower=-2.0),
            mb.Slack("slack", "ground", "rod", length=3.0),
        ],
        "contact": [
            mb.RigidContact("rigid", "rod", terrain=terrain, radius=0.1),
            planar.Contact("compliant", "rod", terrain=terrain, radius=0.1, normal=push),
            planar.Tyre("tyre", "car", terrain=terrain, radius=0.3, normal=push, **slip),
        ],
        "friction": [planar.Friction("rub", "pin", coefficient=0.3, radius=0.1, transition_speed=0.1)],
        "force": [
            mb.Rope("rope", [("ground", (0.0, 2.0)), ("rod", (0.5, 0.0))], stiffness=100.0, length=3.0),
            planar.Cylinder(
                "ram", "ground", "rod", bore_area=1e-3, pressure=3e4, point_a=(0.3, -1.0), point_b=(0.2, 0.0)
            ),
            mb.JointStop("compliant_stop", "pin.angle", lower=-1.0, upper=1.0, stiffness=10.0),
            planar.DraftGear("gear", "rod", "car"),
            mb.Motor("motor", "pin.angle", command=2.0, lag=0.1, force=1.5),
            planar.PointForce("wind", "rod", force=(3.0, 1.0), point=(1.0, 0.2)),
            mb.JointSpring("pull", "line.length", stiffness=20.0, free=0.5),
        ],
    }
    line = mb.Tendon("line", [("ground", (1.0, 1.0)), ("rod", (0.5, 0.0))])
    along = [
        mb.JointForce("push", "ram.length", force=4.0),
        mb.JointSpring("cushion", "ram.length", stiffness=50.0, free=0.9),
    ]
    parts = [part for own in kinds.values() for part in own] + [line, *along, mb.Gravity((0.0, -9.81))]
    is_force = lambda part: isinstance(part, mb.parts.AbstractForce | mb.parts.AbstractNonIdeal | mb.Gravity)
    joints, forces = [p for p in parts if not is_force(p)], [p for p in parts if is_force(p)]
    motion = through(mb.Scene([rod, car], joints=joints, forces=forces).compile())
    found: dict[str, str] = {}
    for body in ("car", "rod"):
        on_body = mb.loads(motion, body)
        found |= dict(zip(on_body.names, on_body.kinds, strict=True))
    for kind, own in kinds.items():
        assert {name for name, of in found.items() if of == kind} == {part.name for part in own}
    length = float(motion["ram"].length[0])
    assert np.linalg.norm(on_body["ram"].force[0]) == pytest.approx(abs(34.0 - 50.0 * (length - 0.9)), rel=1e-12)
    np.testing.assert_allclose(on_body["motor"].moment, [[0.0, 0.0, 1.5]], atol=1e-12)
    check_balance(motion, ["rod", "car"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["parallelogram", "knife_edge", "free_body", "rolling_disc", "swash_plate"])
def test_loads_of_mechanisms_are_in_balance(name):
    motion = through(mechanisms.get(name).system, 2)
    check_balance(motion, motion.system.body_names)
    if name == "parallelogram":
        on_coupler = mb.loads(motion, "coupler")
        assert on_coupler.undetermined == ("head1", "head2", "head3") and "not determined" in str(on_coupler)


@pytest.mark.slow
def test_derivatives_of_loads_under_needed_forces():
    """Of a pin force along a prescribed motion, by a mass and by the place of the cylinder, also in a batch."""
    system, ts = lifted(planar), np.linspace(0.0, 0.4, 5)
    swing = {"pin.angle": lambda t: 0.3 + 0.2 * jnp.sin(4.0 * t)}

    def pinned(x):
        place = {"boom.mass": x[0], "lift.point_b": jnp.stack([x[1], -0.2 + 0.0 * x[1]])}
        needed = mb.required_forces(mb.with_parameters(system, place), swing, by=["lift.pressure"], ts=ts)
        return jnp.max(mb.rotations.norm(mb.loads(needed, "boom")["pin"].force))

    x, along = jnp.array([40.0, 0.6]), jnp.array([3.0, 0.1])
    reverse = np.vdot(jax.jit(jax.grad(pinned))(x), along)
    steps = 1e-3 * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    at = jax.jit(jax.vmap(lambda h: jax.jvp(lambda h: pinned(x + h * along), (h,), (jnp.ones(()),))))
    values, forward = at(steps)
    np.testing.assert_allclose(reverse, forward[2], rtol=1e-11)
    np.testing.assert_allclose(forward[2], (8 * (values[3] - values[1]) - (values[4] - values[0])) / 12e-3, rtol=1e-8)
