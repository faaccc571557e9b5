"""Every testable statement of the paper, each with a quantity, a criterion and a verdict."""

from reproduction.claims import centers, fits, fronts, heuristics, preferences, scores, times
from reproduction.claims.claim import Case, Claim, Finding

CLAIMS: tuple[Claim, ...] = (
    *scores.CLAIMS,
    *fronts.CLAIMS,
    *centers.CLAIMS,
    *preferences.CLAIMS,
    *heuristics.CLAIMS,
    *fits.CLAIMS,
    *times.CLAIMS,
)

__all__ = ["CLAIMS", "Case", "Claim", "Finding"]
