"""OpenFOAM cases: mesh, patches and adjoint sensitivities in double precision, ASCII or binary, compressed or not."""

from rbfevo.meshes.openfoam.case import Case, case_of, is_time, times
from rbfevo.meshes.openfoam.objective import objective_of
from rbfevo.meshes.openfoam.reader import read_case
from rbfevo.meshes.openfoam.writing import POINT_DISPLACEMENT

__all__ = ["POINT_DISPLACEMENT", "Case", "case_of", "is_time", "objective_of", "read_case", "times"]
