"""Design tasks: every function here builds one Scenario."""

from rbfevo.scenarios.face import face
from rbfevo.scenarios.mesh import mesh
from rbfevo.scenarios.plane import plane

__all__ = ["face", "mesh", "plane"]
