"""Radial basis functions; one file each, free of torch."""

from rbfevo.scoring.kernels.gaussian import Gaussian, gaussian
from rbfevo.scoring.kernels.inverse_multiquadric import InverseMultiquadric, inverse_multiquadric
from rbfevo.scoring.kernels.kernel import Kernel, kernel_of
from rbfevo.scoring.kernels.multiquadric import Multiquadric, multiquadric
from rbfevo.scoring.kernels.triharmonic import Cubic, ThinPlate, triharmonic
from rbfevo.scoring.kernels.wendland import Wendland, wendland
from rbfevo.scoring.kernels.wendland_c0 import WendlandC0, wendland_c0
from rbfevo.scoring.kernels.wendland_c4 import WendlandC4, wendland_c4

__all__ = [
    "Cubic",
    "Gaussian",
    "InverseMultiquadric",
    "Kernel",
    "Multiquadric",
    "ThinPlate",
    "Wendland",
    "WendlandC0",
    "WendlandC4",
    "gaussian",
    "inverse_multiquadric",
    "kernel_of",
    "multiquadric",
    "triharmonic",
    "wendland",
    "wendland_c0",
    "wendland_c4",
]
