"""The page's section on the fits: the method, the answers in plain sentences, and the numbers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from reproduction import fits, pays
from reproduction.markdown import prose, table
from reproduction.pays import ALL, Change, Correlations
from reproduction.study import SCENARIOS, Study

PICTURE = "fits.png"
NAMES = {"plane": "the plane", "face": "the sphere"}


def section(study: Study) -> Iterable[str]:
    """The lines of the section; a single sentence if there are no fits."""
    yield "## Does it pay?"
    yield ""
    found = list(pays.correlations(study))
    if not found:
        yield "There are no fits: `scripts/reproduce --only fits` makes them."
        yield ""
        return
    yield from method(study)
    changes = list(pays.changes(study))
    yield from answers(found, changes)
    if (study.out / PICTURE).exists():
        yield f"![generations over regularity]({PICTURE})"
        yield ""
    yield from table(
        (
            *("scenario", "kernel", "strategy", "manipulation", "rank correlation of R with generations"),
            *("the same, given the least error", "the same, converged fits only"),
            *("of P with the final error, converged fits only", "of P with the final error, all fits"),
            *("median generations", "converged", "setups"),
        ),
        (
            (
                *(line.scenario, line.kind, line.strategy, line.manipulation, line.speed, line.given, line.converged),
                *(line.reach, line.final),
                *(f"{line.generations:,.0f}", f"{line.reached:.0%}", line.speed.setups),
            )
            for line in found
        ),
    )
    yield ""
    yield prose("""A dash: fewer than five fits converged, or R is 1 for all. Given the least error: a partial rank
        correlation. A setup with a small least error needs longer to come within 5 % of it, and R and P are in
        conflict, so that a regular setup would seem fast for having little to do. The third correlation leaves out
        the fits that were given up: it excludes the effect of the cap, but also the slowest fits. The final error is
        relative to that of the start. For converged fits on the plane it is (1 - P) times at most 1.05, so that its
        correlation with P is no finding there; on the sphere, where closest points move, it is one.""")
    yield ""
    yield from table(
        ("scenario", "kernel", "strategy", "generations of", "median ratio", "fewer on", "more on", "setups"),
        (
            (
                *(line.scenario, line.kind, line.strategy, f"{line.one} / {line.other}"),
                *(f"{line.ratio:.2g}", f"{line.fewer:.0%}", f"{line.more:.0%}", line.setups),
            )
            for line in changes
        ),
    )
    yield ""
    yield prose("""A fit that was given up counts as the cap: if only the second fit was given up, the true ratio is
        smaller, and if both were, it is unknown.""")
    yield ""


def method(study: Study) -> Iterator[str]:
    """How the fits were made."""
    budget = study.budget
    count = len({(row["scenario"], row["kernel"], row["setup"]) for row in fits.tables(study)})
    yield prose(f"""R and P are meant to predict a later design optimization, so one was carried out with {count}
        setups: a (25,100) evolution strategy starts from the undeformed design and moves the design parameters until
        the error of its mean is within 5 % of the least one; the fit has then converged. There are two strategies,
        *isotropic* (only the step size adapts) and
        *cmaes* (which learns the covariance too), and three manipulations: indirect, direct, and *orthogonalized*, U
        replaced by the thin Q of its QR decomposition: the same designs, R = 1.""")
    yield ""
    yield prose(f"""Setups of each kernel, all of seed 0: {fits.FROM_FRONT} along the gradient search's front for
        each of
        indirect and direct manipulation, {fits.FROM_RANDOM} random ones, Lloyd's and OLS's. On the plane the error
        is the
        squared distance to the height field, whose least value is known exactly. On the sphere, here of
        {10 * 4**budget.fit_subdivisions + 2:,} vertices, it is the squared distance to the scan, closest points anew in
        every generation, plus a smoothness term (weight 1); its least value is where closest points and least
        squares in
        turn end, a local one. The first offspring move the design by 0.3 of the wanted displacement, whatever the
        parameters are. R and P are those on the fitted mesh; with a smoothness term R = 1 is not quite a round bowl. A
        fit is given up after {budget.fit_generations[0]:,} generations (plane) or
        {budget.fit_generations[1]:,} (sphere), the cap, and then counts as that many. Seeds of the strategies:
        {budget.fit_seeds[0]}
        (plane), {budget.fit_seeds[1]} (sphere); medians over them. Every fit is a row of [fits.csv](fits.csv), made by
        `scripts/reproduce --budget {budget.name} --only fits`; a similar fit, with another random stream and on the
        run's own mesh: `python -m rbfevo.fit RUN --pick index:0 --manipulation direct --strategy isotropic`.
        Intervals are 95 %, by bootstrap over setups.""")
    yield ""


def answers(found: list[Correlations], changes: list[Change]) -> Iterator[str]:
    """The questions and their answers in plain sentences, with the numbers."""
    lines = {(line.scenario, line.strategy, line.manipulation): line for line in found if line.kind == ALL}
    ratios = {(line.scenario, line.strategy, line.one, line.other): line for line in changes if line.kind == ALL}

    def ranks(which: str, *key: str) -> str:
        """One rank correlation of a strategy and manipulation on every scenario."""
        held = [(scenario, lines.get((scenario, *key))) for scenario in SCENARIOS]  # pyright: ignore[reportArgumentType]
        return ", ".join(f"{getattr(line, which)} on {NAMES[name]}" for name, line in held if line is not None)

    def change(*key: str) -> str:
        """The ratio of generations of a strategy and two manipulations on every scenario."""
        held = [(scenario, ratios.get((scenario, *key))) for scenario in SCENARIOS]  # pyright: ignore[reportArgumentType]
        return ", ".join(
            f"{line.ratio:.2f} on {NAMES[name]} (fewer for {line.fewer:.0%} of the setups, more for {line.more:.0%})"
            for name, line in held
            if line is not None
        )

    for question, answer in (
        (
            "Does R predict the generations?",
            f"""Rank correlation over all kernels, -1 being a more regular setup always faster: isotropic, indirect
            {ranks("speed", "isotropic", "indirect")}; isotropic, direct {ranks("speed", "isotropic", "direct")};
            CMA-ES, indirect {ranks("speed", "cmaes", "indirect")}; CMA-ES, direct {ranks("speed", "cmaes", "direct")}.
            Given the least error, in the same order: {ranks("given", "isotropic", "indirect")};
            {ranks("given", "isotropic", "direct")}; {ranks("given", "cmaes", "indirect")};
            {ranks("given", "cmaes", "direct")}. Of the converged fits alone: {
                ranks("converged", "isotropic", "indirect")
            }; {ranks("converged", "isotropic", "direct")}; {ranks("converged", "cmaes", "indirect")};
            {ranks("converged", "cmaes", "direct")}. {within(found)}""",
        ),
        (
            "Does P predict the final error?",
            f"""Rank correlation over the converged fits, orthogonalized, isotropic:
            {ranks("reach", "isotropic", "orthogonalized")}. Over all fits, those given up included, indirect,
            isotropic: {ranks("final", "isotropic", "indirect")}; direct: {ranks("final", "isotropic", "direct")}. On
            the plane P is the least error, by definition.""",
        ),
        (
            "Does direct converge faster than indirect?",
            f"""Generations of direct over those of indirect manipulation, median: isotropic
            {change("isotropic", "direct", "indirect")}; CMA-ES {change("cmaes", "direct", "indirect")}.""",
        ),
        (
            "What does orthogonalization buy?",
            f"""Generations over those of direct manipulation, median: isotropic
            {change("isotropic", "orthogonalized", "direct")}; CMA-ES {change("cmaes", "orthogonalized", "direct")}.
            Over those of indirect manipulation: isotropic {change("isotropic", "orthogonalized", "indirect")}; CMA-ES
            {change("cmaes", "orthogonalized", "indirect")}.""",
        ),
        (
            "Is regularity still worth searching for then?",
            f"""Rank correlation of R under indirect manipulation with the generations of the orthogonalized fits, given
            the least error: isotropic {ranks("original", "isotropic", "orthogonalized")}; CMA-ES
            {ranks("original", "cmaes", "orthogonalized")}. {verdict(list(lines.values()))}""",
        ),
    ):
        yield prose(f"- **{question}** {answer}")
    yield ""


def within(found: list[Correlations]) -> str:
    """In which cases R predicts the generations among the setups of one kernel, by the signs of the intervals."""
    single = [line for line in found if line.kind != ALL and line.manipulation != "orthogonalized"]
    sure = [line for line in single if line.given.high < 0]
    names = ", ".join(f"{line.scenario} {line.kind} {line.manipulation} {line.strategy}" for line in sure)
    return f"""Among the setups of one kernel the interval lies below 0 in {len(sure)} of {len(single)}
        cases{f" ({names})" if names else ""}, without a correction for so many tests: R tells kernels and manipulations
        apart more than the setups of one of them."""


def verdict(lines: list[Correlations]) -> str:
    """Whether regularity is worth searching for if U can be orthogonalized, by the results on the sphere."""
    ranks = [line.original for line in lines if line.manipulation == "orthogonalized" and line.scenario == "face"]
    plane = """On the plane it could not be otherwise: there the error is a round bowl in the orthonormal parameters,
        so that the generations depend on P and on chance alone."""
    if not ranks:
        return f"{plane} There are no orthogonalized fits on the sphere."
    lowest = min(rank.low for rank in ranks)
    if any(rank.high < 0 for rank in ranks):
        return f"""{plane} On the sphere a setup that was more regular is faster even so (interval below 0): not
            entirely, then."""
    return f"""{plane} On the sphere, where closest points bend the bowl, nothing shows that a more regular setup is
        faster (a correlation below {lowest:.2f} is outside the intervals). So, for these two scenarios and 25
        centers: no. Where the optimizer may choose its own parameters, orthogonalizing buys what regularity promises,
        and P is what is left to search for. R keeps its worth where the parameters must stay what a designer
        understands: weights, or displacements of control points."""
