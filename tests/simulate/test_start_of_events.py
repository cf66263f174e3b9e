"""What the table of events says of the start of a motion, and of bodies at rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.contacts.events import AtStart, ContactEvents

G = 9.81
DOWN = mb.Gravity((0.0, -G))


def block(speed, restitution=0.0):
    """A block on two feet, on ground on which it slides or lies."""
    body = planar.Body("block", mass=2.0, inertia=0.1, position=(0.0, 0.1), velocity=(speed, 0.0))
    feet = [
        mb.RigidContact(f"foot {k}", "block", terrain=mb.terrain.Flat(), centre=(x, -0.1), restitution=restitution)
        for k, x in ((1, -0.3), (2, 0.3))
    ]
    rubs = [mb.DryFriction(f"rub {k}", f"foot {k}", coefficient=0.3) for k in (1, 2)]
    return mb.Scene([body], joints=feet, forces=[DOWN, *rubs]).compile()


def kinds(motion):
    return [(event.part, event.kind) for event in motion.events.at_start]


@pytest.mark.slow
def test_the_table_begins_with_what_holds_at_the_start():
    """It slides to its stop; the same program lies at rest, where a foot at its limit does not slip. Bodies at rest
    have no events, also with restitution and with speeds of rounding errors. Events on the way are counted alone.
    """
    system = block(0.5, restitution=0.5)
    slides = mb.simulate(system, mb.assemble(system), t1=0.5)
    closed = [("foot 1", "closed at start"), ("foot 2", "closed at start")]
    assert kinds(slides) == [*closed, ("rub 1", "slip at start"), ("rub 2", "slip at start")]
    assert str(slides.events).splitlines()[3].split()[3:6] == ["slip", "at", "start"]
    np.testing.assert_allclose(slides.events.times, [0.5 / (0.3 * G)], rtol=1e-9)
    assert {event.kind for event in slides.events} == {"stick"}
    end = jax.tree.map(lambda x: x[-1], slides.ys)
    for at_rest in (mb.assemble(system, rates={"block.velocity": (0.0, 0.0)}), end):
        for speed in (0.0, -1e-25):
            state = mb.State(at_rest.q, at_rest.u.at[1].set(speed))
            rests = mb.simulate(system, state, t1=0.5)
            assert kinds(rests) == [*closed, ("rub 1", "stick at start"), ("rub 2", "stick at start")]
            assert len(rests.events) == 0 and len(str(rests.events).splitlines()) == 5


@pytest.mark.slow
def test_an_end_of_bounces_after_the_motion_is_not_listed():
    ball = planar.PointMass("ball", mass=1.0, position=(0.0, 1e-9))
    floor = mb.RigidContact("floor", "ball", terrain=mb.terrain.Flat(), restitution=0.5)
    system = mb.Scene([ball], joints=[floor], forces=[DOWN]).compile()
    state = mb.assemble(system)
    bounces = [mb.simulate(system, state, t1=t1, rtol=1e-5).events for t1 in (3.5e-5, 1.0)]
    assert ["rest" in {event.kind for event in events} for events in bounces] == [False, True]


@pytest.mark.slow
def test_the_start_in_a_batch_and_under_jit():
    """Arrays of the start, with the derivative of an impulse by the speed before it."""
    ball = planar.PointMass("ball", mass=2.0, position=(0.0, 0.0))
    floor = mb.RigidContact("floor", "ball", terrain=mb.terrain.Flat(), restitution=0.5)
    system = mb.Scene([ball], joints=[floor], forces=[DOWN]).compile()
    state = mb.assemble(system)

    def impulse(speed):
        start = mb.State(state.q.at[-1].set(0.0), state.u.at[1].set(-speed))
        return mb.simulate(system, start, t1=0.01).events.start.impulses[0]

    np.testing.assert_allclose(jax.vmap(impulse)(jnp.array([0.5, 1.0])), [1.5, 3.0], rtol=1e-12)
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(impulse))(1.0), 3.0, rtol=1e-12)


def test_the_table_of_known_numbers():
    """Contacts that are closed or strike at the start, and friction; an end of bounces only within the motion."""
    start = AtStart(
        time=np.array(0.0),
        impulses=np.array([0.0, 3.0, 0.0, 0.0, 0.0]),
        kinetic_energy_lost=np.array(1.5),
        before=np.array([1.0, 0.0, 1.0, 1.0, 0.0]),
        after=np.array([1.0, 0.0, 1.0, 1.0, 0.0]),
        rest=np.zeros(5),
        moves=np.array([False, False, True, False, False]),
    )
    closes = np.array([[0.0, 2.0, 0.0, 0.0, 0.0]])
    modes = np.array([[1.0, 0.0, 1.0, 1.0, 0.0]]), np.array([[1.0, 1.0, 1.0, 1.0, 0.0]])
    rest, names = np.array([[0.0, 0.25, 0.0, 0.0, 0.0]]), ("lies", "strikes", "slips", "holds", "idle")
    for end, kinds in ((0.6, ["close"]), (0.8, ["close", "rest"])):
        events = ContactEvents(
            names, 2, np.array([0.5]), closes, np.array([2.0]), *modes, rest, start=start, end=np.array(end)
        )
        assert [(event.part, event.kind) for event in events.at_start] == [
            ("lies", "closed at start"),
            ("strikes", "impact at start"),
            ("slips", "slip at start"),
            ("holds", "stick at start"),
        ]
        assert [event.kind for event in events] == kinds
        assert len(str(events).splitlines()) == 5 + len(kinds) == 1 + len(events.to_pandas())
