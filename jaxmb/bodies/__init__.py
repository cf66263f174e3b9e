"""Scenes of rigid bodies, and the systems that they compile to."""

from .rigid_bodies import RigidBodySystem as RigidBodySystem
from .scene import Scene as Scene
