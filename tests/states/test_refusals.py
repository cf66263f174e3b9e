"""Why a mechanism cannot be assembled, moved or simulated on, at dead centres and beyond them."""

import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.simulate.outcome import about_lost_rank
from jaxmb.states.consistency import not_finite
from jaxmb.states.refusals import LostRank

CRANK, ROD = 0.3, 0.8
REACH = CRANK + ROD


def slider_crank(angle, *drivers):
    """A crank at an angle, a rod and a piston on the x axis."""
    pin = CRANK * np.array([np.cos(angle), np.sin(angle)])
    end = np.array([pin[0] + np.sqrt(ROD**2 - pin[1] ** 2), 0.0])
    bodies = [
        planar.Body("crank", mass=1.0, inertia=0.02, position=pin / 2, angle=angle),
        planar.Body("rod", mass=1.0, inertia=0.06, position=(pin + end) / 2, angle=float(np.arcsin(-pin[1] / ROD))),
        planar.Body("piston", mass=0.5, inertia=0.01, position=end),
    ]
    joints = [
        planar.Revolute("O", "ground", "crank", point=(0.0, 0.0)),
        planar.Revolute("P", "crank", "rod", point=pin),
        planar.Revolute("Q", "rod", "piston", point=end),
        planar.Prismatic("slide", "ground", "piston", point_a=(0.0, 0.0), point_b=(0.0, 0.0), axis=(1.0, 0.0)),
    ]
    return mb.Scene(bodies, joints=[*joints, *drivers]).compile(), end[0]


@pytest.fixture(scope="module")
def machine():
    return slider_crank(0.6)[0]


@pytest.fixture(scope="module")
def bar():
    body = planar.Body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    return mb.Scene([body], joints=[pin], forces=[mb.Gravity((0.0, -9.81))]).compile()


ASSEMBLED = {
    "a joint at its reach": ({"slide.displacement": REACH}, "at the end of the reach of slide.displacement"),
    "a body at its reach": ({"piston.x": REACH}, "at the end of the reach of piston.x"),
    "a joint beyond": ({"slide.displacement": REACH + 0.1}, "the value of slide.displacement is out of reach.*P"),
    "a body beyond": ({"piston.x": REACH + 0.1}, "the value of piston.x is out of reach.*P"),
    "a coordinate without freedom": ({"piston.y": 0.1}, "the constraints determine piston.y already.*slide"),
    "two of one freedom": ({"piston.x": 1.0, "crank.angle": 0.3}, "of these 2 coordinates only 1 can be chosen"),
}


@pytest.mark.slow(but=("a joint beyond",))
@pytest.mark.parametrize("case", ASSEMBLED)
def test_coordinates_that_cannot_be_fixed(machine, case):
    """A coordinate that moves elsewhere is not called dependent, and a lone one is not said to depend on others."""
    fix, why = ASSEMBLED[case]
    with pytest.raises(ValueError, match=why) as error:
        mb.assemble(machine, fix=fix)
    assert len(fix) > 1 or not re.search("each other|these coordinates", str(error.value))


@pytest.mark.slow
def test_coordinates_beyond_the_reach_of_a_bar_that_is_drawn_at_it(bar):
    """The bar is drawn at the end of the reach of x, which is free elsewhere."""
    with pytest.raises(ValueError, match=r"value of bar.x is out of reach.* remain in pin \(2\.5\)"):
        mb.assemble(bar, fix={"bar.x": 3.0})
    with pytest.raises(ValueError, match=r"at the end of the reach of bar\.x"):
        mb.assemble(bar, fix={"bar.x": 0.5})
    with pytest.raises(ValueError, match=r"the guess is at a dead centre of bar\.x"):
        mb.assemble(bar, fix={"bar.x": 0.4})
    raised = mb.assemble(bar, fix={"bar.angle": 0.1})
    np.testing.assert_allclose(mb.assemble(bar, raised, fix={"bar.x": 0.4}).q[2], np.arccos(0.8), rtol=1e-12)


def test_rates_that_cannot_be_fixed(machine):
    """Across its guide the piston always stands still, and two rates of one freedom contradict each other."""
    with pytest.raises(ValueError, match=r"with the rates piston.y fixed: in this configuration .* determine piston.y"):
        mb.assemble(machine, rates={"piston.y": 0.1})
    with pytest.raises(ValueError, match=r"with the rates .*crank.angle.* fixed: these contradict each other"):
        mb.assemble(machine, rates={"crank.angle": 1.0, "rod.angle": 1.0})


@pytest.mark.slow
def test_rates_that_a_dead_centre_forbids():
    straight = slider_crank(0.0)[0]
    for rate in ("slide.displacement", "piston.x"):
        with pytest.raises(ValueError, match=f"with the rates {rate} fixed: in this configuration .* determine {rate}"):
            mb.assemble(straight, rates={rate: 0.1})


METHODS = {
    "Partition": {},
    "Projection": {"manifold": mb.manifold.Projection()},
    "Runge-Kutta": {"solver": diffrax.Dopri8(), "max_steps": 4000},
}


@pytest.mark.slow
def test_drive_that_leaves_its_reach_is_named():
    """A piston is pulled at 0.05 m/s to its dead centre and beyond: by one result, with every way to stay on the
    constraints, at the time at which it does.
    """
    _, start = slider_crank(0.6)
    system = slider_crank(0.6, mb.JointDriver("pull", "slide.displacement", value=start, rate=0.05))[0]
    when = (REACH - start) / 0.05
    for options in METHODS.values():
        run = lambda options=options, **given: mb.simulate(system, mb.assemble(system), t1=2 * when, **options | given)
        assert run(throw=False).result == mb.RESULTS.singular_configuration
        with pytest.raises(RuntimeError, match=r"'pull' prescribes leaves its reach") as error:
            run()
        found = re.match(r"The motion came to t = (\S+) of ", str(error.value))
        np.testing.assert_allclose(float(found[1]), when, rtol=1e-5)
        assert "friction" not in str(error.value)

    def end(rate):
        motion = mb.simulate(mb.with_parameters(system, {"pull.rate": rate}), mb.assemble(system), t1=2 * when)
        return motion.ys.q[-1, 0], motion.result

    # The derivative is not a number, and the reason is the same.
    for derivative in (jax.grad(end, has_aux=True), jax.jit(jax.grad(end, has_aux=True))):
        slope, result = derivative(0.05)
        assert np.isnan(slope) and result == mb.RESULTS.singular_configuration


def test_drive_that_leaves_its_reach_is_told_apart_from_joints_that_lock():
    """By the joints that lose their rank, and by the drives among them."""
    said = {n: about_lost_rank(LostRank(["P", "Q"], ["pull", "push"][:n])) for n in (0, 1, 2)}
    assert "the constraints of P, Q are no longer independent, and the motion beyond is not determined" in said[0]
    assert "the motion that 'pull' prescribes leaves its reach" in said[1]
    assert "'pull' and 'push' prescribes leave their reach" in said[2]


@pytest.mark.slow
def test_drive_of_a_large_mechanism_that_leaves_its_reach_is_named():
    """Sparse elimination does not look at ranks: a drive of one of many arms leaves its reach."""
    bodies, joints = [], []
    for k in range(10):
        names = f"upper{k}", f"lower{k}"
        bodies += [planar.Body(names[0], mass=1.0, inertia=0.1, position=(0.5, k), angle=0.0)]
        bodies += [planar.Body(names[1], mass=1.0, inertia=0.1, position=(1.0, k + 0.5), angle=np.pi / 2)]
        joints += [planar.Revolute(f"hip{k}", "ground", names[0], point=(0.0, k))]
        joints += [planar.Revolute(f"knee{k}", *names, point=(1.0, k))]
    reach = {"quantity": "distance", "point_a": (0.0, 3.0), "point_b": (0.5, 0.0)}
    foot = planar.Driver("foot", "ground", "lower3", motion=lambda t, p: jnp.sqrt(2.0) + t, **reach)
    system = mb.Scene(bodies, joints=[*joints, foot]).compile()
    assert system.elimination is not None
    assert mb.simulate(system, mb.assemble(system), t1=1.0, throw=False).result == mb.RESULTS.singular_configuration
    with pytest.raises(RuntimeError, match=r"came to t = 0\.58\d+ of 1\..* 'foot' prescribes leaves its reach"):
        mb.simulate(system, mb.assemble(system), t1=1.0)


@pytest.mark.slow
def test_times_too_coarse_for_any_step_are_named(bar):
    """Seconds since 1970: the first step would be shorter than the distance between two numbers."""
    where = r"came to t = 1700000000\S* of 1700000002\. The time is too coarse.*2.4e-07 s away.*begin at zero"
    for options in ({}, {"manifold": mb.manifold.Projection()}):
        with pytest.raises(RuntimeError, match=where):
            mb.simulate(bar, mb.assemble(bar), t0=1.7e9, t1=1.7e9 + 2, **options)


# Which joint


AT = {"ground": (0.0, 0.0), "c": (0.0, 0.5), "k": (1.0, 1.0), "r": (2.0, 0.5), "d": (2.5, 1.0), "s": (3.0, 0.5)}
PINS = {"A": "ground c", "B": "c k", "C": "k r", "D": "ground r", "E": "r d", "F": "d s", "G": "ground s"}
PLACES = {"A": (0, 0), "B": (0, 1), "C": (2, 1), "D": (2, 0), "E": (2, 1), "F": (3, 1), "G": (3, 0)}


def two_loops(name, off):
    """Two four-bars side by side that share a rocker; the second point of the pin `name` is off."""
    bodies = [
        planar.Body(body, mass=1.0, inertia=0.1, position=place) for body, place in AT.items() if body != "ground"
    ]
    pins = []
    for pin, (a, b) in ((pin, pair.split()) for pin, pair in PINS.items()):
        point_a, point_b = (np.subtract(PLACES[pin], AT[body]) for body in (a, b))
        point_b = point_b + (off if pin == name else (0.0, 0.0))
        pins.append(planar.Revolute(pin, a, b, point_a=point_a, point_b=point_b))
    return mb.Scene(bodies, joints=pins)


@pytest.mark.slow(but=("F",))
@pytest.mark.parametrize(
    ("name", "off"), [("F", (4.0, 1.0)), ("B", (5.0, 3.0)), ("G", (0.0, -7.0))], ids=["F", "B", "G"]
)
def test_joint_whose_point_is_far_off_is_named(name, off):
    with pytest.raises(ValueError, match=f"Without {name} the other joints close, and it then misses by about"):
        two_loops(name, off).compile()


def four_bar(crank, coupler, rocker, base):
    """The given poses are on no circle of the pins."""
    lengths = {"crank": crank, "coupler": coupler, "rocker": rocker}
    places = {"crank": (0.0, 0.5), "coupler": (1.0, 1.0), "rocker": (2.0, 0.5)}
    turns = {"crank": np.pi / 2, "coupler": 0.0, "rocker": -np.pi / 2}
    bodies = [planar.Body(n, mass=1.0, inertia=0.1, position=places[n], angle=turns[n]) for n in places]
    ends = ["ground", *lengths, "ground"]
    points = [((0.0, 0.0), (base, 0.0)), *(((x / 2, 0.0), (-x / 2, 0.0)) for x in lengths.values())]
    starts = [points[0][0], *(p[0] for p in points[1:])]
    ends_at = [*(p[1] for p in points[1:]), points[0][1]]
    pins = [
        planar.Revolute(f"p{k}", ends[k], ends[k + 1], point_a=starts[k], point_b=ends_at[k])
        for k in range(len(ends) - 1)
    ]
    return mb.Scene(bodies, joints=pins)


@pytest.mark.slow(but=("short",))
@pytest.mark.parametrize("lengths", [(0.3, 0.5, 0.3, 2.0), (0.2, 3.0, 0.2, 1.0)], ids=["short", "long"])
def test_loop_whose_lengths_cannot_reach_is_told_by_how_much(lengths):
    """The longest side less the sum of the others."""
    with pytest.raises(ValueError, match=r"Without any one of p0, p1, p2, p3 the others close.*miss by about") as error:
        four_bar(*lengths).compile()
    miss = float(re.search(r"miss by about ([\d.e-]+)", str(error.value))[1])
    assert miss == pytest.approx(2 * max(lengths) - sum(lengths), rel=0.02)


@pytest.mark.slow
def test_joint_that_parameters_move_far_off_is_named():
    system = two_loops("F", (0.0, 0.0)).compile()
    changed = mb.with_parameters(system, {"F.point_b": jnp.array([4.0, 1.5])})
    with pytest.raises(ValueError, match="Without F the other joints close"):
        mb.assemble(changed)
    wrong = mb.State(system.guess.q.at[2].set(jnp.nan), system.guess.u)
    with pytest.raises(RuntimeError, match=r"assembly_gap.* Not finite: c\.angle \(nan\)\."):
        mb.simulate(system, wrong, t1=0.1)


def test_entries_of_a_state_that_are_not_finite_are_named(bar):
    q, u = np.asarray(bar.guess.q), np.asarray(bar.guess.u)
    at = lambda values, k, x: np.where(np.arange(3) == k, x, values)
    for function in (mb.assemble, mb.equilibrium):
        with pytest.raises(ValueError, match=rf"{function.__name__}: the guess is not finite: bar\.y \(nan\)"):
            function(bar, mb.State(at(q, 1, np.nan), u))
    with pytest.raises(ValueError, match=r"the guess is not finite: bar\.angle_rate \(inf\)"):
        mb.assemble(bar, mb.State(q, at(u, 2, np.inf)))
    with pytest.raises(ValueError, match=r"fixed coordinates are not finite: bar\.angle \(nan\)"):
        mb.assemble(bar, fix={"bar.angle": np.nan})
    assert not_finite(bar, q=np.full(3, np.nan), u=np.zeros(3)) == "bar.x (nan), bar.y (nan), bar.angle (nan)"
