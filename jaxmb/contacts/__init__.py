"""Contacts and dry friction: the laws that hold at a state, and the events at which they change."""
