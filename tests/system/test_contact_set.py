"""Where contacts and dry friction are in a system, and a system without any."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import spatial
from jaxmb.parts import terrain
from jaxmb.parts.modes import CLOSED, STICK
from jaxmb.system.instant import Instant

MOST_PROGRAMS = 90


@functools.cache
def scene(contacts=True):
    body = spatial.Body("body", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(0.0, 0.0, 0.5))
    cart = spatial.Body("cart", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(2.0, 0.0, 0.0))
    slide = spatial.Prismatic("slide", "ground", "cart", axis=(1.0, 0.0, 0.0), point=(0.0, 0.0, 0.0))
    floor = mb.RigidContact("floor", "body", terrain=terrain.Flat(), radius=0.1, restitution=0.5, impact_law="poisson")
    rubs = [
        mb.DryFriction("rub", "floor", coefficient=0.2),
        mb.DryFriction("brake", "slide", coefficient=0.3, static_coefficient=0.4),
    ]
    joints, forces = ([floor, slide], rubs) if contacts else ([slide], [])
    return mb.Scene([body, cart], joints=joints, forces=[mb.Gravity((0.0, 0.0, -9.81)), *forces]).compile()


@pytest.mark.slow
def test_contact_set_has_the_laws_of_contacts_and_friction():
    system = scene()
    contacts, laws = system.contacts, system.contact_laws(0.0)
    slip, stick = laws.slip.ask("coefficient", jnp.zeros(3)), laws.slip.ask("limit")
    assert contacts and contacts == system.contacts
    assert (contacts.n, contacts.m) == (1, 3)
    assert contacts.contact_names == ("floor",) and sorted(contacts.friction_names) == ["brake", "rub"]
    of_rows = dict(zip(contacts.names, (system.rows[row][0] for row in contacts.rows), strict=True))
    assert all(name == of_row for name, of_row in of_rows.items())
    names = {places[0]: name for name, places in system.coordinate_names().items() if len(places) == 1}
    assert all(
        names[place].startswith(f"{name}.mode") for name, place in zip(contacts.names, contacts.places, strict=True)
    )
    (first,) = contacts.pairs
    assert contacts.names[1 + first] == contacts.names[2 + first] == "rub"
    for k, name in enumerate(contacts.names[1:]):
        assert contacts.contact_of[k] == (0 if name == "rub" else -1)
        assert contacts.in_joints[k] == (name == "brake") and contacts.in_pairs[k] == (name == "rub")
        assert contacts.releases[k] == (name == "brake")
        assert (slip[k], stick[k]) == ((0.2, 0.2) if name == "rub" else (0.3, 0.4))
    assert contacts.phases == (2,) and np.all(np.isinf(laws.peaks))
    # By Poisson's law a contact pushes again, and need not open before.
    ask = lambda name, *values: laws.normal.ask(name, *(jnp.full(1, x) for x in values))
    assert (ask("ratio", 4.0), ask("rebound", 4.0), ask("pushed", 8.0, 4.0)) == (0.5, 0.0, 4.0)


def test_contact_set_binds_all_that_is_closed():
    system = scene()
    contacts, q = system.contacts, np.asarray(system.guess.q)
    others = np.setdiff1d(np.arange(system.nq), contacts.places)

    @jax.jit
    def evaluate(system, q):
        bound = contacts.bound(q)
        # The gap is that of the poses, whatever the modes are.
        gaps = [Instant(system, jnp.zeros(()), x, jnp.zeros(system.nu)).gaps for x in (q, bound)]
        return bound, contacts.modes(bound).numbers, gaps

    bound, modes, gaps = evaluate(system, q)
    np.testing.assert_array_equal(modes, [CLOSED, STICK, STICK, STICK])
    np.testing.assert_array_equal(bound[others], q[others])
    np.testing.assert_allclose(gaps, [[0.4], [0.4]], rtol=1e-15)


def test_contact_set_of_a_driven_system_follows_its_rows():
    """Rows that are held come before those of friction."""
    system = scene()
    held = system.holding({"slide.displacement": jnp.zeros(())}, {"slide.displacement": jnp.zeros(())}, jnp.zeros(()))
    n = system.contacts.n
    assert held.contacts.rows[:n] == system.contacts.rows[:n]
    assert [row - 1 for row in held.contacts.rows[n:]] == list(system.contacts.rows[n:])


def test_contact_set_of_a_system_without_contacts():
    system = scene(contacts=False)
    contacts, q = system.contacts, np.asarray(system.guess.q)
    assert not contacts and (contacts.n, contacts.m) == (0, 0)
    assert Instant(system, 0.0, q, np.zeros(system.nu)).gaps.size == contacts.modes(q).open.size == 0
    np.testing.assert_array_equal(contacts.bound(q), q)
    laws, none = system.contact_laws(0.0), np.zeros(0)
    assert laws.normal.ask("ratio", none).size == laws.slip.ask("limit").size == laws.peaks.size == 0
