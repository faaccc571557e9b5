"""Claims that the scores predict a later optimization (paper, sections 1, 3 and 4), measured by carrying it out."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rbfevo.fit import STRATEGIES
from reproduction import pays
from reproduction.claims.claim import Case, Claim, claim
from reproduction.study import Study

METHODS = ("gradient", "random", "lloyd", "ols")


def ranks(study: Study, which: str, *manipulations: str) -> Iterator[tuple[str, float]]:
    """Scenario, manipulation and strategy, and one of the rank correlations over all kernels."""
    for line in pays.correlations(study):
        rank: pays.Rank = getattr(line, which)
        if line.kind == pays.ALL and line.manipulation in manipulations and np.isfinite(rank.value):
            yield f"{line.scenario} {line.manipulation}, {line.strategy}", rank.value


@claim(
    "regularity-predicts-speed",
    "4",
    "Regularity characterizes how fast a later evolutionary optimization converges.",
    """Spearman's correlation of R with the generations until the error is within 5 % of the least one, given the least
    error (partial rank correlation), over the fitted setups of all kernels (section *Does it pay?*)""",
    "<= -0.7",
    METHODS,
)
def regularity_predicts(study: Study) -> Iterator[Case]:
    for where, value in ranks(study, "given", "indirect", "direct"):
        yield Case(where, None, value, value <= -0.7)


@claim(
    "potential-predicts-error",
    "4",
    "Improvement potential characterizes the fitness that a later optimization gets to.",
    "Spearman's correlation of P with the final error on the sphere, over the setups of all kernels that got there",
    "<= -0.7",
    METHODS,
)
def potential_predicts(study: Study) -> Iterator[Case]:
    for where, value in ranks(study, "reach", "indirect", "direct", "orthogonalized"):
        if where.startswith("face"):
            yield Case(where, None, value, value <= -0.7)


@claim(
    "direct-converges-faster",
    "3",
    "Direct manipulation is more efficient in an evolutionary optimization.",
    "the share of the fitted setups that need fewer generations under direct than under indirect manipulation",
    "> 0.5",
    METHODS,
)
def direct_faster(study: Study) -> Iterator[Case]:
    for scenario in ("plane", "face"):
        for strategy in STRATEGIES:
            direct, indirect = pays.pairs(study, scenario, "direct", "indirect", strategy)
            for kind in ("local", "wide", "triharmonic"):
                a, b = direct.of(kind).generations, indirect.of(kind).generations
                if len(a):
                    share = float((a < b).mean())
                    yield Case(f"{scenario} {kind}, {strategy}", None, share, share > 0.5)


CLAIMS: tuple[Claim, ...] = (regularity_predicts, potential_predicts, direct_faster)
