"""Every part in a scene: it compiles, moves on its constraints, has derivatives, finds its equilibrium, and is known
when it stands twice. Every method of integration gives the same motion.

Each stands in a small scene of its own, where gravity and a spring move it.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from every_part import EXAMPLES, METHOD, METHODS, compiled

import jaxmb as mb
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.parts import (
    AbstractCompound,
    AbstractConstraint,
    AbstractVelocityConstraint,
)
from jaxmb.parts.base import AbstractInertialConstraint

CONSTRAINTS = (AbstractConstraint, AbstractVelocityConstraint, AbstractCompound)


# Inertias of one coordinate add up.
CONSTRAINED = [
    name
    for name, example in EXAMPLES.items()
    if isinstance(example.part, CONSTRAINTS) and not isinstance(example.part, AbstractInertialConstraint)
]
AT_REST = [name for name, example in EXAMPLES.items() if example.rests and example.ideal]
T1 = 0.2
# Two thirds of the time are of space, whose parts share nearly all of their code with one another.
SOON = [pytest.param(name, marks=[pytest.mark.slow] * name.startswith("spatial")) for name in EXAMPLES]


# What is tested


@pytest.fixture(scope="module")
def programs(request):
    """A motion and its forward derivative with respect to a parameter of the part, its reverse derivative, and the
    finest tolerance of both.

    They are functions of a number that is added to the parameter, in its own size, and of the tolerance. Tests of one
    part follow one another, so that its programs need not be kept beside those of all others.
    """
    example = EXAMPLES[request.param]
    # At finer ones `Dopri8` follows the rounding errors of a driver's accelerations with ever shorter steps.
    finest = 1e-11 if request.param == "spatial: Driver" else 1e-12
    system, parameter = compiled(example), f"{example.part.name}.{example.parameter}"
    value = mb.parameters(system)[parameter]
    size = max(float(np.max(np.abs(value))), 0.1)

    def end(share, rtol):
        changed = mb.with_parameters(system, {parameter: value + share * size})
        state = mb.assemble(changed, throw=False)
        y = mb.simulate(changed, state, t1=T1, rtol=rtol, throw=False, **METHOD).ys
        q, u = y.q[-1], y.u[-1]
        energy = changed.kinetic_energy(T1, q, u) + changed.potential_energy(T1, q)
        broken = changed.position_residual(T1, q), changed.velocity_residual(T1, q, u)
        return jnp.cos(jnp.arange(float(system.nq))) @ q, (broken, energy)

    @jax.jit
    def forward(share, rtol):
        return jax.jvp(lambda x: end(x, rtol), (share,), (jnp.ones(()),), has_aux=True)

    return forward, jax.jit(jax.grad(lambda share, rtol: end(share, rtol)[0])), finest


@pytest.mark.slow
@pytest.mark.parametrize("programs", SOON, indirect=True)
def test_motion_and_its_derivative(programs):
    """The state stays on the constraints, and the derivative is that of central differences."""
    forward, _, finest = programs
    still = jnp.zeros(())
    _, _, (broken, energy) = forward(still, 1e-6)
    for residual in broken:
        np.testing.assert_allclose(residual, 0.0, atol=1e-9)
    assert np.isfinite(energy)

    _, derivative, _ = forward(still, 1e-9)
    # A parameter without effect would pass the rest.
    assert abs(derivative) > 1e-6
    h = 1e-3
    value = lambda s: forward(still + s, finest)[0]
    difference = (8 * (value(h) - value(-h)) - (value(2 * h) - value(-2 * h))) / (12 * h)
    np.testing.assert_allclose(derivative, difference, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("programs", EXAMPLES, indirect=True)
def test_reverse_derivative(programs):
    forward, reverse, _ = programs
    still = jnp.zeros(())
    np.testing.assert_allclose(reverse(still, 1e-9), forward(still, 1e-9)[1], rtol=1e-9, atol=1e-10)


def twin(part):
    return part.named(f"{part.name} twin")


@pytest.mark.slow(
    but=(
        "planar: Revolute",
        "planar: Prismatic",
        "planar: KnifeEdge",
        "functions: JointCoupling",
        "spatial: Universal",
        "spatial: Gimbal",
    )
)
@pytest.mark.parametrize("name", CONSTRAINED)
def test_a_part_that_stands_twice_is_named(name):
    """As many rows are implied as the part has, each by its twin."""
    part = EXAMPLES[name].part
    once, twice = compiled(EXAMPLES[name]), compiled(EXAMPLES[name], twin(part))
    names = {part.name, twin(part).name}
    assert len(twice.implied) == len([own for own, _ in once.rows if own == part.name])
    for item in twice.implied:
        assert item.name in names and names - {item.name} <= set(item.by)
    assert once.velocity_rank == twice.velocity_rank


# Bodies are given velocities that some of the constraints contradict.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The velocities given with the bodies")
@pytest.mark.parametrize("name", CONSTRAINED)
def test_a_part_that_stands_twice_moves_as_once(name):
    ends = []
    for more in ((), (twin(EXAMPLES[name].part),)):
        system = compiled(EXAMPLES[name], *more)
        end = mb.simulate(system, mb.assemble(system), t1=T1, rtol=1e-10, **METHOD).ys
        ends.append(np.concatenate([end.q[-1], end.u[-1]]))
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", AT_REST)
def test_equilibrium(name):
    """Nothing starts to move from it."""
    system = compiled(EXAMPLES[name])
    state = mb.equilibrium(system)
    still = jnp.zeros(system.nu)
    udot, broken = jax.jit(
        lambda q: (accelerations(system.at(state), Multipliers(), 0.0, q, still)[0], system.position_residual(0.0, q))
    )(state.q)
    # In m/s² and rad/s², where weights accelerate by ten.
    np.testing.assert_allclose(udot, 0.0, atol=1e-8)
    np.testing.assert_allclose(broken, 0.0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_method_gives_the_same_motion(method):
    system = compiled(EXAMPLES["planar: Body" if method == "without constraints" else "planar: Revolute"])
    start = mb.assemble(system)
    ends = [mb.simulate(system, start, t1=T1, rtol=1e-10, **own).ys for own in (METHOD, METHODS[method])]
    np.testing.assert_allclose(ends[1].q, ends[0].q, rtol=0, atol=1e-8)
    np.testing.assert_allclose(ends[1].u, ends[0].u, rtol=0, atol=1e-7)
