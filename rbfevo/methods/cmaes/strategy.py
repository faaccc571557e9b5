"""Strategy parameters of CMA-ES: recombination weights and learning rates (N. Hansen, arXiv:1604.00772, eq. 49-58)."""

from __future__ import annotations

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class Strategy:
    """Strategy parameters of one (parents, offspring) setting in one dimension (tutorial, eq. 49-58).

    Attributes:
        positive, negative: recombination weights of the best and of the worst offspring, best to worst.
        mu_eff: variance effective selection mass. The others carry the tutorial's names; chi = E|N(0, I)|.
    """

    positive: tuple[float, ...]
    negative: tuple[float, ...]
    mu_eff: float
    c_sigma: float
    d_sigma: float
    c_c: float
    c_1: float
    c_mu: float
    chi: float

    @staticmethod
    def default(n: int, parents: int, offspring: int, covariance: bool = True) -> Strategy:
        """Defaults for dimension `n`; weights of the ranks between the best `parents` and the worst are 0.

        Without `covariance`, c_1 = c_mu = 0 and no rank below the best `parents` weighs anything.
        """
        raw = [math.log(parents + 0.5) - math.log(i) for i in range(1, 2 * parents + 1)]  # eq. 49
        best, worst = raw[:parents], raw[parents:][max(0, 2 * parents - offspring) :]
        mu_eff = sum(best) ** 2 / sum(w * w for w in best)  # eq. 8
        c_sigma = (mu_eff + 2) / (n + mu_eff + 5)  # eq. 55
        d_sigma = 1 + 2 * max(0.0, math.sqrt((mu_eff - 1) / (n + 1)) - 1) + c_sigma  # eq. 55
        c_c = (4 + mu_eff / n) / (n + 4 + 2 * mu_eff / n)  # eq. 56
        c_1 = 2 / ((n + 1.3) ** 2 + mu_eff)  # eq. 57
        c_mu = min(1 - c_1, 2 * (0.25 + mu_eff + 1 / mu_eff - 2) / ((n + 2) ** 2 + mu_eff))  # eq. 58
        negative: tuple[float, ...] = ()
        if not covariance:
            c_1 = c_mu = 0.0
        elif worst:
            mu_eff_minus = sum(worst) ** 2 / sum(w * w for w in worst)
            mass = min(
                1 + c_1 / c_mu,  # eq. 50
                1 + 2 * mu_eff_minus / (mu_eff + 2),  # eq. 51
                (1 - c_1 - c_mu) / (n * c_mu),  # eq. 52
            )
            negative = tuple(-mass * w / sum(worst) for w in worst)  # eq. 53
        return Strategy(
            positive=tuple(w / sum(best) for w in best),  # eq. 53
            negative=negative,
            mu_eff=mu_eff,
            c_sigma=c_sigma,
            d_sigma=d_sigma,
            c_c=c_c,
            c_1=c_1,
            c_mu=c_mu,
            chi=math.sqrt(2) * math.exp(math.lgamma((n + 1) / 2) - math.lgamma(n / 2)),
        )
