"""From a system and a state to a motion."""

from .simulate import simulate as simulate
