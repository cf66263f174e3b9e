"""Pictures of motions and of their stability.

Figures need the extra `jaxmb[plot]`, moving pictures `jaxmb[view]`; matplotlib and viser are imported when one is made.
"""

from .animation import MovingPicture as MovingPicture, save_html as save_html, show as show
from .mechanism import plot_mechanism as plot_mechanism
from .motion import plot_motion as plot_motion
from .root_locus import plot_root_locus as plot_root_locus
