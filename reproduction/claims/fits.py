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
    """Spearman's correlation of P with the final error on the sphere, over all fitted setups, those that were given up
    included; over those alone that came within 5 % of their least error it stands in the section *Does it pay?*""",
    "<= -0.7",
    METHODS,
)
def potential_predicts(study: Study) -> Iterator[Case]:
    for where, value in ranks(study, "final", "indirect", "direct", "orthogonalized"):
        if where.startswith("face"):
            yield Case(where, None, value, value <= -0.7)


@claim(
    "direct-converges-faster",
    "3",
    "Direct manipulation is more efficient in an evolutionary optimization.",
    """the share of the fitted setups that need fewer generations under direct than under indirect manipulation, ties
    half""",
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
                    share = float((a < b).mean() + (a == b).mean() / 2)
                    yield Case(f"{scenario} {kind}, {strategy}", None, share, share > 0.5)


@claim(
    "global-higher-fitness",
    "4",
    "Global kernels lead to solutions of higher fitness than local ones.",
    """the least of two ratios of the median final error, local over wide Wendland and wide over triharmonic, over the
    fits of all strategies with orthogonalized manipulation, which nearly all come within 5 % of their least error""",
    "> 1",
    METHODS,
)
def global_fitness(study: Study) -> Iterator[Case]:
    for scenario in ("plane", "face"):
        for strategy in STRATEGIES:
            found = pays.fitted(study, scenario, "orthogonalized", strategy)
            local, wide, other = (found.of(kind).error for kind in ("local", "wide", "triharmonic"))
            if len(local) and len(wide) and len(other):
                ratios = np.median(local) / np.median(wide), np.median(wide) / np.median(other)
                yield Case(f"{scenario}, {strategy}", None, float(min(ratios)), min(ratios) > 1)


CLAIMS: tuple[Claim, ...] = (regularity_predicts, potential_predicts, direct_faster, global_fitness)
