"""Pictures of motions and of their stability.

Results draw themselves by `plot()`, as `jaxmb help pictures` shows. `plot_scene` draws a scene before it moves, also
where it cannot be assembled; `plot_motion` draws quantities over time; `save_movie` writes an animated GIF or a film.
`explore` has sliders for numbers and joints. `show`, `explore` and `plot_mechanism` draw wheels, gears, pins, springs,
ropes, tracks and terrain; other bodies are bars from the mass centre to their frames and to the points where parts act.
All of them but `explore` also take other shapes: `shapes={"crank": jaxmb.shapes.Box((1.0, 0.1, 0.1))}`, or
`shapes.Mesh.read(file)`; a user-defined part defines them by its methods `shapes` and `path`. A picture shows the
saved states only. A moving picture takes about 0.9 MB, including 0.82 MB for viser's viewer, needs no network, and also
plays in notebooks exported to HTML.

Figures need the extra `jaxmb[plot]`, moving pictures `jaxmb[view]`; matplotlib and viser are imported when needed.
"""

from .animation import MovingPicture as MovingPicture, save_html as save_html, show as show
from .explore import Explorer as Explorer, explore as explore
from .mechanism import plot_mechanism as plot_mechanism
from .motion import plot_motion as plot_motion
from .movie import save_movie as save_movie
from .root_locus import plot_root_locus as plot_root_locus
from .scene import plot_scene as plot_scene
from .sweep import plot_sweep as plot_sweep
