"""PyGeM's parameter file (.prm) for its RBF deformation: kernel, control points, and their new places."""

from __future__ import annotations

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.recorded.setup import Setup
from rbfevo.scoring.kernels import Cubic, Gaussian, InverseMultiquadric, Multiquadric, Wendland

SCALED = {  # PyGeM's multiquadrics are these times the scale, or over it, which changes no deformation
    Gaussian: "gaussian_spline",
    Multiquadric: "multi_quadratic_biharmonic_spline",
    InverseMultiquadric: "inv_multi_quadratic_biharmonic_spline",
}
LINEAR = "PyGeM adds a linear polynomial to the RBFs, so it deforms differently between the control points"
SAME = "PyGeM deforms as rbfevo.apply does"


def difference(setup: Setup) -> str:
    """How PyGeM deforms compared with `rbfevo.apply`, in one line."""
    return LINEAR if setup.plain else SAME


def parameters(setup: Setup, displacements: Array) -> bytes:
    """The file for displacements [m, 3] of the centers of a setup in space; images are control points of their own.

    Raises:
        UserError: for held regions, for a kernel that PyGeM does not have, or if the control points do not determine
            its linear polynomial.
    """
    if setup.hold is not None:
        raise UserError("PyGeM has no held regions; deform meshes with python -m rbfevo.apply")
    original = setup.centers_and_images().points
    if original.shape[1] < 3 or np.linalg.matrix_rank(original - original.mean(axis=0)) < 3:
        raise UserError("PyGeM adds a linear polynomial in x, y and z, which points in one plane do not determine")
    deformed = original + setup.with_images(displacements)
    if isinstance(setup.kernel, Wendland):
        kernel = ["basis function: beckert_wendland_c2_basis", f"radius: {setup.kernel.support!r}"]
    elif isinstance(setup.kernel, Gaussian | Multiquadric | InverseMultiquadric):
        kernel = [f"basis function: {SCALED[type(setup.kernel)]}", f"radius: {setup.kernel.scale!r}"]
    elif isinstance(setup.kernel, Cubic):
        kernel = ["basis function: polyharmonic_spline", "radius: 1.0", "k: 3"]
    else:
        raise UserError(f"PyGeM has no kernel that corresponds to {setup.name}")
    lines = ["# RBF parameters for PyGeM, written by rbfevo.", f"# {difference(setup)}.", ""]
    lines += ["[Radial Basis Functions]", *kernel, "", "[Control points]"]
    for name, points in (("original", original), ("deformed", deformed)):
        # Lines after the first must be indented: they belong to one value.
        rows = ["   ".join(repr(number) for number in point) for point in points.tolist()]
        lines += [f"{name} control points: " + f"\n{' ' * 25}".join(rows), ""]
    return "\n".join(lines).encode()
