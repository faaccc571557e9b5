"""A design descends on a solver's answers: U stays on the original design, and its weights accumulate.

After each solution `Descent` takes the design on by a rule, and backs off after a rise of the objective or where a mesh
cannot follow. It reads and writes no files; `state` is all that it knows, and goes to files and back by `files`.
"""

from rbfevo.descent.loop import HALVINGS, Descent
from rbfevo.descent.state import Line, Proposal, Slope, Solved, State

__all__ = ["HALVINGS", "Descent", "Line", "Proposal", "Slope", "Solved", "State"]
