"""Modules, such as neural networks, as laws: their weights are one parameter by name."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly

import jaxmb as mb
from jaxmb import parts, planar
from jaxmb.studies.identify.experiment import known_parameters


def network(seed, width=4, activation=jnp.tanh, size=1):
    return eqx.nn.MLP(size, 1, width, 1, activation=activation, key=jax.random.key(seed))


def friction(t, measured, states, parameters):
    """A torque [N m] in a joint, by its rate."""
    rate = measured["rate"]
    return -parameters["net"](rate[None])[0] - parameters["damping"] * rate, {}


class Drag(parts.AbstractForce):
    """A force [N] against the velocity of a body, by its size."""

    name: str = parts.name()
    body: str = parts.body_name()
    net: parts.Module = parts.module()

    def wrenches(self, space, poses, velocities, t):
        v = velocities[0, : space.dimension]
        return space.point_force(poses[0], jnp.zeros_like(v), -self.net(v @ v) * v)[None]


class Ratio(eqx.Module):
    """A rational function of one number, with a power that is static."""

    factors: Any
    power: int = eqx.field(static=True, default=1)

    def __call__(self, x):
        return self.factors[0] / (1 + self.factors[1] ** 2 * x**self.power)


NETS = {
    "friction.net": network(1),
    "drag_b.net": Ratio(jnp.array([0.3, 0.5])),
    "drag_c.net": Ratio(jnp.array([0.1, 0.2])),
}


@pytest.fixture(scope="module")
def linkage():
    """A four-bar linkage whose crank turns against a network, and whose other bars have a drag of their own each."""
    bodies = [
        planar.Body("crank", mass=1.0, inertia=0.1, position=(0.0, 0.5), angle=1.57),
        planar.Body("coupler", mass=1.0, inertia=0.3, position=(1.0, 1.4), angle=0.4),
        planar.Body("rocker", mass=1.0, inertia=0.3, position=(2.2, 0.9), angle=1.8),
    ]
    joints = [
        planar.Revolute("A", "ground", "crank", point_a=(0.0, 0.0), point_b=(-0.5, 0.0)),
        planar.Revolute("B", "crank", "coupler", point_a=(0.5, 0.0), point_b=(-1.0, 0.0)),
        planar.Revolute("C", "coupler", "rocker", point_a=(1.0, 0.0), point_b=(0.9, 0.0)),
        planar.Revolute("D", "ground", "rocker", point_a=(2.5, 0.0), point_b=(-0.9, 0.0)),
    ]
    law = {"net": NETS["friction.net"], "damping": 0.2}
    forces = [
        mb.Gravity((0.0, -9.81)),
        mb.Controller("friction", friction, {"rate": "A.angle_rate"}, "A.angle", parameters=law),
        Drag("drag_b", "coupler", net=NETS["drag_b.net"]),
        Drag("drag_c", "rocker", net=NETS["drag_c.net"]),
    ]
    return mb.Scene(bodies, joints=joints, forces=forces).compile()


@pytest.mark.slow
def test_the_weights_are_one_vector_by_name(linkage):
    known = mb.parameters(linkage)
    assert {name: known[name].shape for name in NETS} == {"friction.net": (13,), "drag_b.net": (2,), "drag_c.net": (2,)}
    assert "friction.damping" in known
    found = mb.modules(linkage)
    assert found.keys() == NETS.keys()
    for name, net in NETS.items():
        assert eqx.tree_equal(found[name], net)
    # Two drags differ in nothing but their weights, and are computed together.
    assert len(linkage.forces.groups) == 2
    other = {"friction.net": network(2), "drag_c.net": Ratio(jnp.array([0.7, 0.9]))}
    changed = mb.with_parameters(linkage, other)
    assert all(eqx.tree_equal(mb.modules(changed)[name], net) for name, net in (NETS | other).items())
    # By their vectors, and by modules of another precision, as well.
    single = jax.tree.map(lambda x: x.astype(jnp.float32) if eqx.is_array(x) else x, other["friction.net"])
    again = mb.with_parameters(linkage, mb.parameters(changed) | {"friction.net": single})
    for name, value in mb.parameters(changed).items():
        np.testing.assert_allclose(mb.parameters(again)[name], value, rtol=1e-6 if name == "friction.net" else 0)
    experiment = mb.Experiment({"crank.angle": np.zeros(3)}, ts=np.arange(1.0, 4.0), parameters=other)
    for name, value in known_parameters(linkage, experiment).items():
        np.testing.assert_array_equal(value, mb.parameters(changed)[name])


@pytest.mark.slow
def test_the_law_acts(linkage):
    state = mb.assemble(linkage, rates={"crank.angle": 3.0})
    ys = jax.tree.map(lambda x: x[None], state)
    of = lambda name: linkage.catalogue.applied_wrenches(name, jnp.zeros(1), ys, None)[0]
    torque = -NETS["friction.net"](jnp.array([3.0]))[0] - 0.2 * 3.0
    np.testing.assert_allclose(of("friction")[-1, 2], torque, rtol=1e-12)
    for name, body in (("drag_b", "coupler"), ("drag_c", "rocker")):
        v = linkage.catalogue.motion(body, ys).velocity[0]
        np.testing.assert_allclose(of(name)[0, :2], -NETS[f"{name}.net"](v @ v) * v, rtol=1e-12)


@pytest.mark.slow
def test_derivatives_with_respect_to_weights(linkage):
    """Forward mode, reverse mode and differences of a tighter solution, under `jit` and `vmap`."""
    state = mb.assemble(linkage, rates={"crank.angle": 4.0})
    random = np.random.default_rng(0)
    is_weight = eqx.is_inexact_array
    change = lambda x: jnp.asarray(random.normal(size=x.shape)) if is_weight(x) else None
    directions = [jax.tree.map(change, NETS) for _ in range(2)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *directions)
    weights, rest = eqx.partition(NETS, is_weight)

    def angle(weights, rtol=1e-9):
        changed = mb.with_parameters(linkage, eqx.combine(weights, rest))
        return mb.simulate(changed, state, t1=0.5, rtol=rtol)["rocker"].angle[-1]

    at = lambda size, direction: jax.tree.map(lambda w, d: w + size * d, weights, direction)
    tight = jit_quickly(jax.vmap(lambda size, direction: angle(at(size, direction), 1e-11), in_axes=(0, None)))
    forward = jit_quickly(jax.vmap(lambda direction: jax.jvp(angle, (weights,), (direction,))[1]))(stacked)
    # In a batch with other weights.
    gradient = jit_quickly(jax.vmap(lambda size: jax.grad(angle)(at(size, directions[0]))))(jnp.array([0.0, 0.1]))
    inner = lambda k, direction: sum(
        float(jnp.vdot(g[k], d)) for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
    )
    h = 1e-3
    for k, direction in enumerate(directions):
        values = tight(h * jnp.array([-2.0, -1.0, 1.0, 2.0]), direction)
        difference = float(values @ jnp.array([1.0, -8.0, 8.0, -1.0])) / (12 * h)
        assert abs(difference) > 1e-3
        np.testing.assert_allclose(forward[k], difference, rtol=1e-6)
        np.testing.assert_allclose(inner(0, direction), forward[k], rtol=1e-9)
    values = tight(0.1 + h * jnp.array([-2.0, -1.0, 1.0, 2.0]), directions[0])
    difference = float(values @ jnp.array([1.0, -8.0, 8.0, -1.0])) / (12 * h)
    np.testing.assert_allclose(inner(1, directions[0]), difference, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("friction.net", network(1, width=5), r"layers\[0\]\.weight .* shape \(4, 1\), got .* \(5, 1\)"),
        ("friction.net", network(1, activation=jnp.sin), r"activation of the module must stay .*tanh.*, got .*sin"),
        ("friction.net", eqx.filter(network(1), eqx.is_array), r"activation of the module must stay .*, got None"),
        ("friction.net", eqx.nn.Linear(1, 1, key=jax.random.key(0)), r"expected a module MLP, got Linear"),
        ("friction.net", jnp.zeros(12), r"has shape \(13,\), got \(12,\)"),
        ("friction.net", "net", r": expected a real number or an array of real numbers, got 'net'"),
        ("friction.damping", network(1), r"is a number or an array, not the weights of a module; got a MLP"),
        ("drag_b.net", Ratio(jnp.ones(2), power=2), r"a static field of the Ratio differs"),
        ("drag_b.net", Ratio(jnp.arange(2)), r"factors is an array of int64 numbers; weights are"),
        ("drag_b.net", Ratio(0.5), r"Ratio has no weights: none of its fields is an array of real numbers"),
    ],
)
def test_another_module_is_refused(linkage, name, value, message):
    with pytest.raises(ValueError, match=f"Parameter '{name}'.*{message}"):
        mb.with_parameters(linkage, {name: value})


@pytest.mark.slow
def test_weights_are_identified():
    """A falling body tells both weights of its law of drag."""
    mass = planar.PointMass("drop", mass=1.0, position=(0.0, 0.0))
    start = Ratio(jnp.array([0.3, 0.3]))
    system = mb.Scene([mass], forces=[mb.Gravity((0.0, -9.81)), Drag("drag", "drop", net=start)]).compile()
    true = Ratio(jnp.array([0.5, 0.15]))
    ts = np.linspace(0.1, 2.0, 20)
    truth = mb.with_parameters(system, {"drag.net": true})
    data = {
        "drop.position": np.asarray(
            mb.simulate(truth, mb.assemble(truth), t1=2.0, saveat=ts, rtol=1e-9)["drop"].position
        )
    }
    fit = mb.identify(system, data, ts=ts, free=["drag.net"], sigma={"drop.position": 1e-3})
    np.testing.assert_allclose(fit.parameters["drag.net"], true.factors, rtol=1e-4)
    found = mb.modules(mb.with_parameters(system, fit.parameters))["drag.net"]
    np.testing.assert_allclose(found(2.0), true(2.0), rtol=1e-5)


NAN = Ratio(jnp.array([1.0, jnp.nan]))
ROD = planar.Body("rod", mass=1.0, inertia=0.1)


def law(poses, velocities, t, parameters):
    return parameters["net"](velocities)


REFUSED = {
    "no weights": (lambda system: mb.Force("f", "rod", law, parameters={"net": Ratio(0.5)}), "Ratio has no weights"),
    "no module": (lambda system: Drag("d", "rod", net=3.0), r"'d': net: expected an equinox module, .*, got 3"),
    "of a force": (
        lambda system: mb.Scene([ROD], forces=[mb.Force("f", "rod", law, parameters={"net": NAN})]).compile(),
        r"'f': net must be finite, got \[ 1\. nan\]",
    ),
    "of a part": (
        lambda system: mb.Scene([ROD], forces=[Drag("f", "rod", net=NAN)]).compile(),
        "'f': net must be finite",
    ),
    "changed": (lambda system: mb.with_parameters(system, {"drag_b.net": NAN}), "'drag_b': net must be finite"),
    "the start of a fit": (
        lambda system: mb.identify(
            system, {"crank.angle": np.zeros(3)}, ts=np.arange(1.0, 4.0), free={"drag_b.net": NETS["drag_b.net"]}
        ),
        r"The start of 'drag_b\.net' must be numbers, got a Ratio; leave it out",
    ),
}


@pytest.mark.parametrize("build, message", REFUSED.values(), ids=REFUSED)
def test_weights_that_are_refused(linkage, build, message):
    with pytest.raises(ValueError, match=message):
        build(linkage)
