"""The events of contacts and dry friction in words."""

import numpy as np

from jaxmb.contacts.events import ContactEvents
from jaxmb.parts.modes import CLOSED, OPEN


def test_kinds_of_events_of_contacts():
    """By whether a gap was open before and is open after; a contact that is at rest may take part in an impact."""
    before = np.array([[OPEN, CLOSED], [OPEN, CLOSED], [CLOSED, CLOSED]])
    after = np.array([[OPEN, CLOSED], [CLOSED, CLOSED], [OPEN, CLOSED]])
    impulses = np.array([[2.0, 1.0], [0.5, 0.0], [0.0, 0.0]])
    events = ContactEvents(
        ("ball", "block"), 2, np.array([0.1, 0.4, 0.9]), impulses, np.zeros(3), before, after, np.zeros((3, 2))
    )
    assert [(event.time, event.part, event.kind, event.impulse) for event in events] == [
        (0.1, "ball", "impact", 2.0),
        (0.1, "block", "impulse", 1.0),
        (0.4, "ball", "close", 0.5),
        (0.9, "ball", "open", 0.0),
    ]
