"""What is to be designed: every function here builds one Scenario."""

from rbfevo.scenarios.face import face
from rbfevo.scenarios.plane import plane

__all__ = ["face", "plane"]
