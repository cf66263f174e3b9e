"""The reference of all public names and topics, for a terminal and as HTML."""

from .entries import Entry as Entry, Subject as Subject, find as find, subjects as subjects
from .site import build as build
from .terminal import listed as listed, shown as shown, shown_topic as shown_topic
from .topics import Topic as Topic, topics as topics
