"""Ways to find setups: searches for the front or for preferences, and heuristics."""

from rbfevo.methods.gradient.search import GradientSearch
from rbfevo.methods.heuristics import LloydHeuristic, OlsHeuristic, RandomHeuristic
from rbfevo.methods.searches import CmaesSearch, Nsga2Search, Panel

__all__ = ["CmaesSearch", "GradientSearch", "LloydHeuristic", "Nsga2Search", "OlsHeuristic", "Panel", "RandomHeuristic"]
