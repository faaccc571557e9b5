"""Radial basis functions; one file each, free of torch."""

from rbfevo.scoring.kernels.kernel import Kernel, kernel_of
from rbfevo.scoring.kernels.triharmonic import Cubic, ThinPlate, triharmonic
from rbfevo.scoring.kernels.wendland import Wendland, wendland

__all__ = ["Cubic", "Kernel", "ThinPlate", "Wendland", "kernel_of", "triharmonic", "wendland"]
