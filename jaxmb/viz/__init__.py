"""Pictures of motions and of their stability.

`show` and `plot_mechanism` draw wheels, pins, springs, tracks and terrain; other bodies are bars from their mass
centre to where parts act. `show` also takes shapes of your own: `shapes={"crank": jaxmb.shapes.Box((1.0, 0.1, 0.1))}`,
or `shapes.Mesh.read(file)`; a user-defined part has them from its methods `shapes` and `path`. A picture shows the
saved states and nothing between them, and takes about 0.9 MB, of which 0.82 MB are viser's viewer; it is complete
without a network and keeps playing in notebooks that are exported to HTML.

Figures need the extra `jaxmb[plot]`, moving pictures `jaxmb[view]`; matplotlib and viser are imported when one is
made.
"""

from .animation import MovingPicture as MovingPicture, save_html as save_html, show as show
from .mechanism import plot_mechanism as plot_mechanism
from .motion import plot_motion as plot_motion
from .root_locus import plot_root_locus as plot_root_locus
