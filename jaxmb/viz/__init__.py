"""Pictures of motions. Needs the extra `jaxmb[plot]`; matplotlib is imported when a figure is made."""

from .mechanism import plot_mechanism as plot_mechanism
from .motion import plot_motion as plot_motion
