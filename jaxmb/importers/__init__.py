"""Machines from files of other programs: MJCF of MuJoCo, URDF of ROS, SDF of Gazebo; and MJCF of a scene."""

from .export import Exported as Exported, to_mjcf as to_mjcf
from .mjcf import mjcf as mjcf
from .model import ImportedModel as ImportedModel
from .sdf import sdf as sdf
from .urdf import urdf as urdf
