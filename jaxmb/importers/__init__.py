"""Machines from files of other programs: MJCF of MuJoCo, URDF of ROS, SDF of Gazebo; and MJCF of a scene."""

from .mjcf import mjcf as mjcf
from .model import ImportedModel as ImportedModel
