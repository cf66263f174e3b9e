"""The rate of a vector field along a motion, with its derivatives: from equations of motion that are differentiated in
time, against the derivative of the field itself.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sprung_pendulums import double_pendulum

import jaxmb as mb
from jaxmb.formulations import Multipliers, Partitioned
from jaxmb.manifold import Partition, Projection
from jaxmb.solvers import Hermite
from jaxmb.solvers.manifold_term import AbstractManifoldTerm

MOST_PROGRAMS = 110


@pytest.mark.slow("projection")
@pytest.mark.parametrize(
    "manifold, formulation", [(Partition(), Partitioned()), (Projection(), Multipliers())], ids=["chart", "projection"]
)
def test_the_rate_of_a_field_has_the_derivatives_of_the_field(manifold, formulation):
    system, names, _, _ = double_pendulum()
    t, point = jnp.array(0.3), {name: mb.parameters(system)[name] for name in names}
    y = mb.assemble(system, fix={"rod.angle": 0.3, "shank.angle": -0.4}, rates={"rod.angle": 1.0})
    term, _ = manifold.prepare(system, formulation, Hermite(), manifold.accuracy(1e-8))
    chart = term.update_chart(t, y, term.init_chart(t, y, None), None)
    found, kept = term.project_cold(t, y, chart, None), term.kept(chart)
    random = np.random.default_rng(0)
    along = jax.tree.map(lambda x: jnp.asarray(random.normal(size=np.shape(x))), (point, t, found.y))

    def rates(of):
        def at(point, t, y):
            own = eqx.tree_at(lambda term: term.system, term, mb.with_parameters(system, point))
            # The rate along the field itself, and that along a rate whose derivative is that of the field.
            _, along, g = of(own, t, y, found.f, None, kept, None)
            return g, of(own, t, y, found.f, along, kept, None)[2]

        at_point = jax.tree.map(jnp.asarray, (point, t, found.y))
        return jax.jvp(at, at_point, along)

    known, field = jax.jit(lambda: (rates(type(term).along_solution), rates(AbstractManifoldTerm.along_solution)))()
    for own, other in zip(jax.tree.leaves(known), jax.tree.leaves(field), strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-10, atol=1e-9)
