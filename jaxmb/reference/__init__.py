"""The reference of all public names, for a terminal and as HTML, from their docstrings and signatures."""

from .entries import Entry as Entry, Subject as Subject, find as find, subjects as subjects
from .site import build as build
from .terminal import listed as listed, shown as shown
