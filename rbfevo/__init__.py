"""rbfevo: where the control points of an RBF shape deformation should sit, before the design optimization starts."""

from rbfevo.deformation import RBFDeformation
from rbfevo.errors import UserError
from rbfevo.evaluator import Evaluator
from rbfevo.evolvability import Scores, evolvability
from rbfevo.kernels import Cubic, Kernel, ThinPlate, Wendland, triharmonic, wendland

__all__ = [
    "Cubic",
    "Evaluator",
    "Kernel",
    "RBFDeformation",
    "Scores",
    "ThinPlate",
    "UserError",
    "Wendland",
    "evolvability",
    "triharmonic",
    "wendland",
]
