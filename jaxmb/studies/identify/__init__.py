"""Parameters from measured motion."""

from .experiment import Experiment as Experiment
from .identification import Identification as Identification
from .identify import identify as identify
from .measurements import Measurements as Measurements, read_measurements as read_measurements
from .sensors import Sensor as Sensor
