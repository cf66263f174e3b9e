"""Rows that are implied by others at the given pose stay so, or the user is told: when a scene is compiled, when a
motion starts, and along the motion. Scripts of a user's kind.
"""

import functools
import os
import subprocess
import sys

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import lagrangian, mechanisms, planar, spatial
from jaxmb.bodies.independence import JointBlocks
from jaxmb.manifold import Baumgarte, Projection

GRAVITY = mb.Gravity((0.0, -9.81))


def bar(name, start, end, mass=1.0):
    """A slender bar between two points."""
    start, end = np.asarray(start), np.asarray(end)
    length = float(np.linalg.norm(end - start))
    angle = float(np.arctan2(*(end - start)[::-1]))
    return planar.Body(name, mass=mass, inertia=planar.rod(mass, length), position=(start + end) / 2, angle=angle)


def chain(points, lengths):
    """Bars from point to point, pinned to each other and to the ground at both ends."""
    names = [f"bar{k}" for k in range(len(lengths))]
    ends = [("ground", points[0]), *((n, (l / 2, 0.0)) for n, l in zip(names, lengths, strict=True))]
    joints = [
        planar.Revolute(f"pin{k}", ends[k][0], names[k], point_a=ends[k][1], point_b=(-lengths[k] / 2, 0.0))
        for k in range(len(names))
    ]
    joints.append(planar.Revolute("last", ends[-1][0], "ground", point_a=ends[-1][1], point_b=points[-1]))
    bodies = [bar(n, a, b) for n, a, b in zip(names, points, points[1:], strict=False)]
    return mb.Scene(bodies, joints=joints, forces=[GRAVITY])


def crank(*drivers, **options):
    body = planar.Body("crank", mass=1.0, inertia=0.1, **options)
    return mb.Scene([body], joints=[planar.Revolute("pivot", "ground", "crank", point=(0.0, 0.0)), *drivers])


def driver(name, angle):
    return planar.Driver(name, "ground", "crank", quantity="angle", motion=lambda t, p: angle(t))


# Singular poses


def particle(*constraints):
    kinetic = lambda t, q, v, p: 0.5 * v @ v
    own = [lagrangian.Holonomic(f"c{k}", f) for k, f in enumerate(constraints)]
    return lagrangian.LagrangianSystem(kinetic=kinetic, q=np.zeros(2), constraints=own)


SINGULAR = {
    "two bars of 1 m between pins 2 m apart": (
        lambda: chain([(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)], [1.0, 1.0]).compile(),
        r"pose of bar0, bar1 is singular: row 0 of pin1 is implied by pin0, last there, but not near it.*off this pos",
    ),
    "a flat four-bar": (
        lambda: chain([(0.0, 0.0), (1.0, 0.0), (3.0, 0.0), (2.0, 0.0)], [1.0, 2.0, 1.0]).compile(),
        r"pose of .*bar1.* is singular: row 0 of pin2 is implied by pin0, last, pin1 there, but not near it",
    ),
    "a flat parallelogram that is redundant besides": (
        lambda: mechanisms.get("parallelogram", angle=0.0),
        r"pose of .*coupler.* is singular: row 0 of head\d",
    ),
    "a product": (lambda: particle(lambda t, q, p: q[0] * q[1]), r"gradient of row 0 of c0 is zero.*singular"),
    "a line and its tangent parabola": (
        lambda: particle(lambda t, q, p: q[1], lambda t, q, p: q[1] - q[0] ** 2),
        r"singular: row 0 of c1 is implied by c0 there, but not near it",
    ),
    "the square of an angle": (
        lambda: crank(mb.Constraint("square", ["crank"], lambda x, t, p: x[0, 2] ** 2, rheonomic=False)).compile(),
        r"gradient of row 0 of square is zero.*singular",
    ),
    "an angle times its rate": (
        lambda: crank(
            mb.VelocityConstraint("w", ["crank"], lambda x, v, t, p: x[0, 2] * v[0, 2], linear=True)
        ).compile(),
        r"gradient of row 0 of w is zero",
    ),
}


@pytest.mark.parametrize("case", SINGULAR)
def test_pose_that_is_singular_is_refused(case):
    make, message = SINGULAR[case]
    with pytest.raises(ValueError, match=message):
        make()


def test_pose_near_a_singular_one_is_accepted():
    lifted = [(0.0, 0.0), (np.cos(0.01), np.sin(0.01)), (2.0 + np.cos(0.01), np.sin(0.01)), (2.0, 0.0)]
    system = chain(lifted, [1.0, 2.0, 1.0]).compile()
    assert system.velocity_rank == 8


def test_rockers_that_lock_are_refused():
    """They are parallel but for one pin, which is a millimetre beside its place."""
    bodies = [planar.Body(f"rocker{k}", mass=1.0, inertia=0.1, position=(k, 0.5)) for k in range(3)]
    bodies.append(planar.Body("platform", mass=1.0, inertia=0.1, position=(1.0, 1.0)))
    feet, heads = [(0.0, 0.0), (1.001, 0.0), (2.0, 0.0)], [(float(k), 1.0) for k in range(3)]
    joints = [planar.Revolute(f"foot{k}", "ground", f"rocker{k}", point=feet[k]) for k in range(3)]
    joints += [planar.Revolute(f"head{k}", f"rocker{k}", "platform", point=heads[k]) for k in range(3)]
    with pytest.raises(ValueError, match=r"rocker0, .*platform cannot move: .*foot1.* leave no degree of freedom"):
        mb.Scene(bodies, joints=joints).compile()


def test_beam_of_many_welded_bodies_is_accepted():
    """Joints that close no loop are not redundant, though the rows of many of them are nearly dependent."""
    bodies = [planar.Body(f"b{k}", mass=1.0, inertia=0.1, position=(k + 0.5, 0.0)) for k in range(40)]
    ends = ["ground", *(body.name for body in bodies)]
    welds = [planar.Fixed(f"weld{k}", ends[k], ends[k + 1], point=(float(k), 0.0)) for k in range(40)]
    system = mb.Scene(bodies, joints=welds, forces=[mb.Gravity((0.0, -9.81))]).compile()
    assert system.velocity_rank == 120


# Components of many rows, without dense matrices


def ladder(n):
    """Two chains of spatial bodies on parallel hinges with rungs between them; three rows of each loop are implied."""
    bodies, joints = [], []

    def body(name, x, y):
        bodies.append(spatial.Body(name, mass=1.0, inertia=np.diag([0.1, 0.1, 0.1]), position=(x, y, 0.0)))

    def hinge(name, a, b, x, y):
        joints.append(spatial.Revolute(name, a, b, point=(x, y, 0.0), axis=(0.0, 0.0, 1.0)))

    for k in range(n):
        for side, x in (("l", 0.0), ("r", 1.0)):
            body(f"{side}{k}", x, -k - 0.5)
            hinge(f"{side}{k}_pin", f"{side}{k - 1}" if k else "ground", f"{side}{k}", x, -float(k))
        body(f"rung{k}", 0.5, -k - 0.8)
        hinge(f"rung{k}_l", f"l{k}", f"rung{k}", 0.0, -k - 0.8)
        hinge(f"rung{k}_r", f"rung{k}", f"r{k}", 1.0, -k - 0.8)
    return mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, -9.81, 0.0))])


def without_dense_matrices(monkeypatch):
    """Let all components count as those of many rows."""
    monkeypatch.setattr(JointBlocks, "subsets", functools.partialmethod(JointBlocks.subsets, dense=-1))


@pytest.mark.slow
def test_implied_rows_are_those_of_dense_matrices(monkeypatch):
    n = 4
    systems = [ladder(n).compile()]
    without_dense_matrices(monkeypatch)
    systems.append(ladder(n).compile())
    for system in systems:
        A = np.asarray(system.jacobian(0.0, system.guess.q, system.guess.u))
        assert system.velocity_rank == np.linalg.matrix_rank(A) and len(system.implied) == 3 * n
        of_rows = {row: k for k, row in enumerate(system.rows)}
        dropped = [of_rows[own.name, own.row] for own in system.implied]
        kept = np.setdiff1d(np.arange(len(A)), dropped)
        assert np.linalg.matrix_rank(A[kept]) == kept.size
        for own, row in zip(system.implied, dropped, strict=True):
            by = np.array([k for k in kept if system.rows[k][0] in (*own.by, own.name)])
            shares = np.linalg.lstsq(A[by].T, A[row], rcond=None)[0]
            np.testing.assert_allclose(A[by].T @ shares, A[row], rtol=0, atol=1e-12)
            names = {system.rows[k][0] for k in by[np.abs(shares) > 1e-6]} - {own.name}
            assert names == set(own.by)


@pytest.mark.slow
def test_ladder_of_many_has_no_dense_matrix(monkeypatch):
    n, largest = 150, 0

    def watched(function):
        def call(matrix, *arguments, **options):
            nonlocal largest
            largest = max(largest, *matrix.shape)
            return function(matrix, *arguments, **options)

        return call

    for name in ("lstsq", "svd"):
        monkeypatch.setattr(np.linalg, name, watched(getattr(np.linalg, name)))
    system = ladder(n).compile()
    assert len(system.implied) == 3 * n and system.velocity_rank == system.nu - n
    assert largest <= 1000


@pytest.mark.slow
def test_pose_that_is_singular_is_refused_without_dense_matrices(monkeypatch):
    without_dense_matrices(monkeypatch)
    for make, _ in (own for case, own in SINGULAR.items() if "bar" in case):
        with pytest.raises(ValueError, match=r"is singular: row \d of .* implied by .* there, but not near it"):
            make()
    with pytest.raises(ValueError, match=r"row 0 of \w+ is implied by \w+ at t = 0, but no more at t = "):
        crank(driver("first", lambda t: t), driver("second", lambda t: t + t**3)).compile()
    with pytest.raises(ValueError, match="first, second contradict each other"):
        crank(driver("first", lambda t: t), driver("second", lambda t: 2.0 * t)).compile()


# Prescribed motions


def test_drivers_that_agree_now_only_are_refused():
    with pytest.raises(ValueError, match=r"row 0 of second is implied by first at t = 0, but no more at t = "):
        crank(driver("first", lambda t: t), driver("second", lambda t: t + t**3)).compile()


def parting():
    """Two drivers, the second of which parts from the first after half a second, at a rate."""
    late = lambda t, p: t + p["rate"] * jnp.maximum(t - 0.5, 0.0) ** 3
    second = planar.Driver("second", "ground", "crank", quantity="angle", motion=late, parameters={"rate": 0.0})
    return crank(driver("first", lambda t: t), second).compile()


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, diffrax.Tsit5()])
def test_drivers_that_part_end_the_motion(solver):
    system = parting()
    (implied,) = system.implied
    assert (implied.name, implied.by) in (("second", ("first",)), ("first", ("second",)))
    state, saveat = mb.assemble(system), diffrax.SaveAt(steps=True)
    run = lambda rate, **options: mb.simulate(
        mb.with_parameters(system, {"second.rate": rate}), state, t1=2.0, solver=solver, saveat=saveat, **options
    )
    together = run(0.0)
    np.testing.assert_allclose(together["crank"].angle, together.ts, atol=1e-9)
    with pytest.raises(RuntimeError, match=r"At t = [01].* the constraints (first|second) \(.*contradict the others"):
        run(1.0)
    motion = run(1.0, throw=False)
    assert motion.result == mb.RESULTS.inconsistent_constraints
    if solver is None:
        # A violation of 1e-7 rad is allowed.
        assert 0.5 <= motion.ts[-1] <= 0.5 + 1.2e-7 ** (1 / 3)
        assert abs(motion["crank"].angle[-1] - motion.ts[-1] - (motion.ts[-1] - 0.5) ** 3) <= 1.2e-7


@pytest.mark.slow
def test_drivers_that_part_in_a_member_of_a_batch_spoil_no_other():
    system = parting()
    state = mb.assemble(system)

    def run(rate):
        motion = mb.simulate(mb.with_parameters(system, {"second.rate": rate}), state, t1=1.0, throw=False)
        return motion.result == mb.RESULTS.inconsistent_constraints, motion["crank"].angle[-1]

    wrong, angle = jax.jit(jax.vmap(run))(jnp.array([0.0, 1.0]))
    assert wrong.tolist() == [False, True]
    np.testing.assert_allclose(angle[0], 1.0, atol=1e-9)


@pytest.mark.slow
def test_redundancy_at_a_coarse_tolerance_is_no_singularity():
    bricard = mechanisms.get("bricard")
    motion = mb.simulate(bricard.system, bricard.state, t1=0.5, rtol=1e-4)
    assert motion.result == mb.RESULTS.successful


# Rows between accelerations


def servo(name, angle=lambda t, p: jnp.sin(t), **gains):
    """By default along sin t; `straight` leads to t."""
    program = lambda t, p: p["size"] * (angle(t, p) + p["straight"] * (t - angle(t, p)))
    numbers = {"motion": program, "parameters": {"size": 1.0, "straight": 0.0}}
    return mb.Servo(planar.Driver(name, "ground", "crank", quantity="angle", **numbers), **gains)


def servos(*programs, **options):
    return crank(*programs, angular_velocity=1.0, velocity=(0.0, 0.0), **options).compile()


DIFFERENT = r"constraints (first|second) \(.*(first|second).*ask for other accelerations"


def test_servo_of_a_driven_coordinate_is_followed_or_refused():
    gains = {"damping": 2.0, "stiffness": 4.0}
    system = servos(servo("first", **gains), servo("second", **gains))

    def run(rate=1.0, **numbers):
        changed = mb.with_parameters(system, {f"second.{name}": value for name, value in numbers.items()})
        state = mb.State(system.guess.q, np.array([0.0, 0.0, rate]))
        return mb.simulate(changed, state, t1=1.0).ys.q[-1, 2]

    # The same programs; gains that differ, on the program.
    np.testing.assert_allclose([run(), run(stiffness=5.0)], np.sin(1.0), atol=1e-8)
    # Another program, a larger one, and gains that differ off the program.
    for numbers in ({"straight": 1.0}, {"size": 1.001}, {"stiffness": 5.0, "rate": 0.5}):
        with pytest.raises(RuntimeError, match=DIFFERENT):
            run(**numbers)


APART = lambda: servos(servo("first"), servo("second", lambda t, p: t))
CONTRADICTING = {
    "programs that differ from a time on": (
        lambda: servos(
            servo("first", lambda t, p: t), servo("second", lambda t, p: jnp.where(t < 0.5, t, t + (t - 0.5) ** 2))
        ),
        {},
    ),
    "a servo beside a driver": (lambda: servos(driver("first", lambda t: t), servo("second")), {}),
    "Runge and Kutta": (APART, {"solver": diffrax.Tsit5()}),
    "an implicit method": (APART, {"solver": mb.solvers.Hermite()}),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CONTRADICTING)
def test_servo_that_contradicts_is_named(case):
    make, options = CONTRADICTING[case]
    system = make()
    with pytest.raises(RuntimeError, match=DIFFERENT):
        mb.simulate(system, mb.assemble(system, rates={"crank.angle": 1.0}), t1=2.0, **options)


@pytest.mark.slow
def test_servos_with_different_gains_follow_the_same_program():
    gains = {"damping": 20.0, "stiffness": 100.0}, {"damping": 200.0, "stiffness": 1e4}
    system = servos(servo("first", **gains[0]), servo("second", **gains[1]))
    state = mb.assemble(system, rates={"crank.angle": 1.0})
    for solver in (None, mb.solvers.Hermite(), diffrax.Tsit5()):
        for rtol in (1e-3, 1e-11):
            motion = mb.simulate(system, state, t1=2.0, rtol=rtol, solver=solver)
            np.testing.assert_allclose(motion["crank"].angle[-1], np.sin(2.0), atol=10 * rtol)


@pytest.mark.slow
def test_rows_between_accelerations_are_watched():
    row = lambda name, right: lagrangian.AccelerationConstraint(
        name, lambda t, q, v, p: jnp.array([[1.0, 0.0]]), lambda t, q, v, p: jnp.array([right(t)])
    )
    own = {"kinetic": lambda t, q, v, p: 0.5 * v @ v, "q": [0.0, 0.0]}
    pair = lagrangian.LagrangianSystem(**own, constraints=[row("a", jnp.cos), row("b", jnp.cos)])
    assert mb.simulate(pair, mb.assemble(pair), t1=1.0).ys.u[-1, 0] == pytest.approx(np.sin(1.0), abs=1e-8)
    pair = lagrangian.LagrangianSystem(**own, constraints=[row("a", jnp.ones_like), row("b", jnp.cos)])
    with pytest.raises(RuntimeError, match=r"constraints (a|b) \(.*, (a|b) \("):
        mb.simulate(pair, mb.assemble(pair), t1=1.0)


@pytest.mark.slow
def test_servos_are_not_watched_by_other_manifolds():
    system = servos(servo("first"), servo("second"))
    state = mb.assemble(system, rates={"crank.angle": 1.0})
    for manifold in (Baumgarte(), Projection()):
        with pytest.raises(ValueError, match=r"Of 4 constraint rows only 3 .*does not watch implied rows of servos"):
            mb.simulate(system, state, t1=1.0, manifold=manifold)


@pytest.mark.slow
def test_drivers_that_contradict_are_refused_with_stabilised_constraints():
    second = planar.Driver(
        "second", "ground", "crank", quantity="angle", motion=lambda t, p: p["rate"] * t**2, parameters={"rate": 1.0}
    )
    system = crank(driver("first", lambda t: t**2), second).compile()
    options = {"manifold": Baumgarte(), "solver": diffrax.Tsit5()}
    mb.simulate(system, mb.assemble(system), t1=1.0, **options)
    changed = mb.with_parameters(system, {"second.rate": 2.0})
    with pytest.raises(RuntimeError, match=r"constraints second \(1\) contradict the others"):
        mb.simulate(changed, mb.assemble(changed), t1=1.0, **options)


# Rows that are implied to a higher order


def test_row_that_is_implied_to_the_fifth_order():
    """Together the rows admit no motion. The displacement x that one of them admits violates the other by x⁵, so by
    5e-8 in the end, and by a displacement of x / 5.
    """
    bead = particle(lambda t, q, p: q[1], lambda t, q, p: q[1] - q[0] ** 5)
    for rtol, successful in ((1e-3, True), (1e-8, False)):
        motion = mb.simulate(bead, mb.State(bead.guess.q, jnp.array([1.0, 0.0])), t1=0.035, rtol=rtol, throw=False)
        assert (motion.result == mb.RESULTS.successful) == successful


def box_on_ropes():
    corners = [(0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5)]
    box = spatial.Body("box", mass=1.0, inertia=spatial.box(1.0, 1.0, 1.0, 1.0), position=(0.0, 0.0, 2.0))
    ropes = [
        spatial.Distance(f"rope{k}", "ground", "box", point_a=(x, y, 5.0), point_b=(x, y, 0.5), length=2.5)
        for k, (x, y) in enumerate(corners)
    ]
    return mb.Scene([box], joints=ropes, forces=[mb.Gravity((0.0, 0.0, -9.81))]).compile()


@pytest.mark.slow
def test_box_on_four_ropes_sways_and_does_not_yaw():
    """At home three rows are independent, and beside it four: the fourth binds the pitch by the third order only.
    Where it only sways it is a spherical pendulum, and the ropes stay parallel.
    """
    system = box_on_ropes()
    yaws = {"box.velocity": (0.3, 0.0, 0.0), "box.angular_velocity": (0.0, 0.0, 0.3)}
    for rtol in (1e-5, 1e-11):
        motion = mb.simulate(system, mb.assemble(system, rates={"box.velocity": (0.3, 0.1, 0.0)}), t1=5.0, rtol=rtol)
        energy = 0.5 * jnp.sum(motion["box"].velocity[-1] ** 2) + 9.81 * (motion["box"].position[-1, 2] - 2.0)
        np.testing.assert_allclose(energy, 0.05, atol=max(rtol, 1e-12))
        with pytest.raises(RuntimeError, match=r"rope\d \(.*contradict.*If they agree, the compiled pose is a bifur"):
            mb.simulate(system, mb.assemble(system, rates=yaws), t1=5.0, rtol=rtol)


# States off the constraints


@pytest.mark.slow
def test_state_off_the_constraints_is_refused():
    four_bar = mechanisms.get("four_bar")
    state, moved = four_bar.state, mb.with_parameters(four_bar.system, {"D.point_a": jnp.array([2.6, 0.0])})
    with pytest.raises(ValueError, match=r"state violates the constraints D \(0\.1\) at t0 = 0\..*jaxmb\.assemble"):
        mb.simulate(moved, state, t1=0.1)
    mb.simulate(moved, mb.assemble(moved, state), t1=0.1)
    with pytest.raises(ValueError, match=r"state violates the constraints .*D \("):
        mb.simulate(four_bar.system, mechanisms.get("four_bar", base=2.4).state, t1=0.1)
    fast = mb.State(state.q, state.u.at[0].add(0.1))
    with pytest.raises(ValueError, match=r"velocities of the state violate the constraints .*B \("):
        mb.simulate(four_bar.system, fast, t1=0.1)
    # Motions that drift on purpose may start anywhere.
    mb.simulate(four_bar.system, fast, t1=0.01, manifold=Baumgarte(), solver=diffrax.Tsit5())
    system = crank(driver("drive", lambda t: t)).compile()
    with pytest.raises(ValueError, match=r"state violates the constraints drive \(1\) at t0 = 1\."):
        mb.simulate(system, mb.assemble(system), t0=1.0, t1=1.1)


@pytest.mark.slow
def test_state_off_the_constraints_of_traced_parameters_fails():
    four_bar = mechanisms.get("four_bar")

    def run(x):
        system = mb.with_parameters(four_bar.system, {"D.point_a": jnp.stack([x, jnp.zeros_like(x)])})
        motion = mb.simulate(system, four_bar.state, t1=0.1, throw=False)
        return motion["crank"].angle[-1], motion.result == mb.RESULTS.assembly_failed

    ends, failed = jax.jit(jax.vmap(run))(jnp.array([2.5, 2.6]))
    assert failed.tolist() == [False, True]
    assert np.isfinite(ends[0]) and np.isnan(ends[1])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["four_bar", "spatial_slider_crank"])
def test_state_of_a_motion_at_a_coarse_tolerance_continues(name):
    mechanism = mechanisms.get(name)
    saveat = np.linspace(0.1, 0.4, 4)
    coarse = mb.simulate(mechanism.system, mechanism.state, t1=0.4, rtol=1e-3, saveat=saveat)
    for k in range(4):
        state = jax.tree.map(lambda y, k=k: y[k], coarse.ys)
        mb.simulate(mechanism.system, state, t0=saveat[k], t1=saveat[k] + 1e-3)


@pytest.mark.slow
def test_state_in_single_precision_is_accepted():
    """In a program of its own: the precision is chosen before anything else."""
    code = """
import jaxmb as mb
from jaxmb import mechanisms
for name in ("four_bar", "bricard"):
    m = mechanisms.get(name)
    assert m.state.q.dtype == "float32"
    motion = mb.simulate(m.system, m.state, t1=0.3, rtol=1e-4)
    mb.simulate(m.system, mb.State(motion.ys.q[-1], motion.ys.u[-1]), t0=0.3, t1=0.4, rtol=1e-4)
"""
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, env=os.environ)
