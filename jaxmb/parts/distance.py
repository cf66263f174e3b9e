"""A rod without mass between two points, in the plane and in space."""

from typing import ClassVar

from ..linalg.rotations import dot, norm
from . import fields
from .base import AbstractConstraint, AbstractPointPair, PathKind
from .elements import apart
from .space import separation


class Distance(AbstractPointPair, AbstractConstraint):
    """A massless rod: points A and B of two bodies keep their distance. Rows 1: `(d·d − length²) / (2 length) = 0`,
    with d from A to B; the multiplier is the rod force [N].

    ```python
    bob = planar.Body("bob", mass=1.0, inertia=0.1, position=(0.6, 0.0))
    rod = planar.Distance("rod", "ground", "bob", point_b=(-0.1, 0.0))
    system = jaxmb.Scene([bob], joints=[rod]).compile()
    ```

    It has no coordinates.

    **Arguments:** `length` [m] > 0, default from the given poses.
    """

    length: fields.Number = fields.length(sign="positive", optional=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False
    path_kind: ClassVar[PathKind] = "rod"

    def complete(self, space, poses):
        return self.filled(length=norm(separation(space, self, poses)))

    @property
    def elements(self):
        return (apart(self),)

    def residual(self, space, poses, t):
        d = separation(space, self, poses)
        return ((dot(d, d) - self.length**2) / (2 * self.length))[None]
