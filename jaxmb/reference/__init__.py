"""The reference of all public names and topics, for a terminal."""

from .entries import Entry as Entry, Subject as Subject, find as find, subjects as subjects
from .terminal import listed as listed, shown as shown, shown_topic as shown_topic
from .topics import Topic as Topic, topics as topics
