"""The tangents that a run watches."""

import numpy as np

import jaxmb as mb
from jaxmb import planar
from jaxmb.simulate.watch import Watch, parameter_changes


def test_watch_is_along_the_changes_of_parameters():
    """The square of the mass, and the product of both, change as their derivatives say."""
    body = planar.Body("bar", mass=3.0, inertia=0.5)
    system = mb.Scene([body], forces=[planar.Torque("motor", "bar", torque=2.0)]).compile()
    changes = parameter_changes(system, {"bar.mass": 0.5, "motor.torque": -1.5})

    def term_of(system):
        values = mb.parameters(system)
        return values["bar.mass"] ** 2, values["bar.mass"] * values["motor.torque"]

    assert Watch({}, ()).direction(system, term_of) is None
    found = Watch(changes, ()).direction(system, term_of)
    np.testing.assert_allclose(found, (2 * 3.0 * 0.5, 2.0 * 0.5 - 3.0 * 1.5), rtol=1e-15)
