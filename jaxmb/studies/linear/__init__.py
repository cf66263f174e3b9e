"""Small motions about equilibria, steady and periodic motions."""

from .floquet import Floquet as Floquet, floquet as floquet
from .linearisation import Linearisation as Linearisation
from .linearise import linearise as linearise
from .root_locus import RootLocus as RootLocus, root_locus as root_locus
from .steady import steady_motion as steady_motion
