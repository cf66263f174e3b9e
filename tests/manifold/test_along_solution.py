"""The rate of a vector field along a motion, with its derivatives: from equations of motion that are differentiated in
time, against the derivative of the field itself.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.formulations import Multipliers, Partitioned
from jaxmb.manifold import Partition, Projection
from jaxmb.solvers import AbstractManifoldTerm, Hermite

POINT = {"upper.mass": 2.0, "spring.stiffness": 30.0, "hip.point_a": np.array([0.1, 0.0])}


def linkage():
    """A double pendulum on a moving pivot, with a spring."""
    return mb.Scene(
        [
            planar.Body("upper", mass=2.0, inertia=0.3, position=(0.5, 0.0)),
            planar.Body("lower", mass=1.0, inertia=0.1, position=(1.5, 0.0)),
        ],
        joints=[
            planar.Revolute("hip", "ground", "upper", point_a=(0.0, 0.0), point_b=(-0.5, 0.0)),
            planar.Revolute("knee", "upper", "lower", point_a=(0.5, 0.0), point_b=(-0.5, 0.0)),
        ],
        forces=[
            mb.Gravity((0.0, -9.81)),
            planar.SpringDamper(
                "spring",
                "ground",
                "lower",
                stiffness=30.0,
                damping=0.4,
                free_length=0.3,
                point_a=(1, 1),
                point_b=(0, 0),
            ),
        ],
    ).compile()


def total(of, term, t, y, f, kept):
    """The rate along the field itself, and that along a rate whose derivative is that of the field."""
    _, own, g = of(term, t, y, f, None, kept, None)
    return g, of(term, t, y, f, own, kept, None)[2]


@pytest.mark.long
@pytest.mark.parametrize(
    "manifold, formulation", [(Partition(), Partitioned()), (Projection(), Multipliers())], ids=["chart", "projection"]
)
def test_the_rate_of_a_field_has_the_derivatives_of_the_field(manifold, formulation):
    system, t = linkage(), jnp.array(0.3)
    y = mb.assemble(system, fix={"upper.angle": 0.3, "lower.angle": -0.4}, rates={"upper.angle": 1.0})
    term, _ = manifold.prepare(system, formulation, Hermite(), 1e-8)
    chart = term.update_chart(t, y, term.init_chart(t, y, None), None)
    found, kept = term.project_cold(t, y, chart, None), term.kept(chart)
    random = np.random.default_rng(0)
    along = jax.tree.map(lambda x: jnp.asarray(random.normal(size=np.shape(x))), (POINT, t, found.y))

    def rates(of):
        def at(point, t, y):
            own = eqx.tree_at(lambda term: term.system, term, mb.with_parameters(system, point))
            return total(of, own, t, y, found.f, kept)

        at_point = jax.tree.map(jnp.asarray, (POINT, t, found.y))
        return jax.jvp(at, at_point, along)

    known, field = jax.jit(lambda: (rates(type(term).along_solution), rates(AbstractManifoldTerm.along_solution)))()
    for own, other in zip(jax.tree.leaves(known), jax.tree.leaves(field), strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-10, atol=1e-9)
