from ._base import AbstractManifoldTerm as AbstractManifoldTerm
from .adams import Adams as Adams
from .controller import MultistepController as MultistepController
