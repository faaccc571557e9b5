"""The page `claims.md` and the tables that hold its numbers."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rbfevo.runs.storage import csv_text, write_whole
from reproduction import pays, pays_page, runs
from reproduction.claims import CLAIMS, Claim, Finding
from reproduction.claims.claim import HOLDS, MOST, PLURAL
from reproduction.claims.times import FRONT
from reproduction.markdown import prose
from reproduction.study import METHODS, PANELS, Study


def write(study: Study, captions: dict[str, str]) -> dict[str, Finding]:
    """Measure every claim; write claims.md, claims.csv, runs.csv and the setups of every panel; return the findings.

    `captions` are the captions of the figures by file name.
    """
    findings = {claim.key: claim.find(study) for claim in CLAIMS}
    cases = [
        (claim.key, case.where, "" if case.seed is None else case.seed, case.value, case.fulfilled)
        for claim in CLAIMS
        for case in findings[claim.key].cases
    ]
    names = ("claim", "where", "seed", "value", "fulfilled")
    write_whole(study.out / "claims.csv", csv_text(names, cases))
    commands = list(run_table(study))
    write_whole(
        study.out / "runs.csv", csv_text(("panel", "method", "seed", "evaluations", "seconds", "command"), commands)
    )
    write_setups(study)
    pays.write_tables(study)
    text = "\n".join(lines(study, findings, captions, sum(float(row[4]) for row in commands)))
    write_whole(study.out / "claims.md", (text + "\n").encode())
    return findings


def run_table(study: Study) -> Iterable[tuple[str, str, int, int, float, str]]:
    """Every finished run: panel, method, seed, evaluations, seconds and its command."""
    for task in runs.tasks(study.budget):
        summary = study.summary(task.panel, task.series, task.seed)
        if summary is not None and task.done(study.out):
            command = f"python -m rbfevo {shlex.join(task.arguments)}"
            yield task.panel.name, task.series, task.seed, summary["evaluations"], round(summary["seconds"], 2), command
    generations = study.budget.evaluations // runs.POPULATION - 1
    for panel in PANELS:
        for seed in study.seeds(panel, "nsga2"):
            command = f"scripts/fronts {panel.name} --seed {seed} --generations {generations}"
            yield panel.name, "nsga2", seed, study.budget.evaluations, study.front_seconds(panel, seed) or 0.0, command


def write_setups(study: Study) -> None:
    """Write `setups/PANEL.csv`: method, seed, preference, R and P of every setup used by figures and claims."""
    (study.out / "setups").mkdir(exist_ok=True)
    for panel in PANELS:
        rows = []
        for method in METHODS:
            for seed in study.budget.seeds:
                setups = study.setups(panel, method, seed)
                if setups is not None:
                    columns = zip(*(column.tolist() for column in setups[1:3]), setups.preference.tolist(), strict=True)
                    rows += [(method, seed, preference, R, P) for R, P, preference in columns]
        names = ("method", "seed", "preference", "regularity", "improvement_potential")
        write_whole(study.out / "setups" / f"{panel.name}.csv", csv_text(names, rows))


def lines(study: Study, findings: dict[str, Finding], captions: dict[str, str], seconds: float) -> Iterable[str]:
    """The lines of claims.md."""
    budget, facts = study.budget, study.facts
    yield "# The paper, put to the test"
    yield ""
    yield (
        "Richter, Achenbach, Menzel and Botsch, *Multi-objective Representation Setups for Deformation-based Design "
        "Optimization* (EMO 2017), reproduced with rbfevo. A program writes this page, including its verdicts."
    )
    yield ""
    yield f"- Command: `scripts/reproduce --budget {budget.name} --out OUT`, OUT being the directory of this page."
    yield f"- Budget: {budget.description}; {budget.random} random setups per panel and seed."
    if budget.evaluations < FRONT:
        yield prose(f"""- The paper's fronts have {FRONT:,} evaluations, those here {budget.evaluations:,}. That
            favours the methods compared with them: CMA-ES with the paper's generations (series `cmaes-full`), Lloyd and
            OLS.""")
    yield f"- Hardware: {facts['hardware']}. Software: {facts['software']}."
    yield prose(f"""- Times: the runs in [runs.csv](runs.csv), each listed with its command, searched for
        {seconds:,.0f} s in total (NSGA-II: processor time); fronts in `benchmarks/fronts` are not computed again. The
        last calls of the parts of `scripts/reproduce` took {parts(facts)} of wall-clock time.""")
    yield prose("""- The run directories are not in the repository; `scripts/reproduce --only runs --only fronts`
        makes them again, and `--claim KEY` then measures one claim again. `setups/` has R and P of all setups,
        `centers/` the centers that the figures show.""")
    yield prose("""- Terms: *local* and *wide* are Wendland's kernel with the smaller and the larger support radius
        (0.25 and 0.5 on the plane, 0.5 and 1 on the sphere); `face` is the sphere that is deformed into a face; a
        *panel* is one scenario, kernel and manipulation.""")
    yield "- Hypervolumes have the reference point (0, 0): R and P are both maximized."
    yield f"- Available seeds: {available_seeds(study)}."
    yield ""
    yield "## Verdicts"
    yield ""
    yield prose(f"""Each claim has a measured quantity and a criterion, and is measured in every place that it covers:
        a panel, or what the table of its values names. A place meets the criterion if most of its seeds do. A claim
        *holds* if at least {MOST:.0%} of its places meet the criterion, *does not hold here* if fewer than a third
        do, and *holds in part* in between. The criteria are ours: the paper gives few numbers. Two claims, marked so,
        are ours too.""")
    yield ""
    counts = [finding.verdict for finding in findings.values()]
    yield f"Of {len(counts)} claims " + ", ".join(f"{counts.count(v)} {PLURAL[v]}" for v in PLURAL if v in counts) + "."
    yield ""
    yield "| | claim | section | verdict | met in | values |"
    yield "|---|---|---|---|---|---|"
    for number, claim in enumerate(CLAIMS, 1):
        finding = findings[claim.key]
        verdict = finding.verdict if finding.verdict == HOLDS else f"**{finding.verdict}**"
        good = f"{finding.good} of {finding.places}"
        yield (
            f"| [{number}](#{claim.key}) | {claim.statement} | {claim.section} | {verdict} | {good} | {span(finding)} |"
        )
    yield ""
    yield from pays_page.section(study)
    yield "## Figures"
    yield ""
    for name, caption in captions.items():
        if name != pays_page.PICTURE and (study.out / name).exists():
            yield f"![{name}]({name})"
            yield ""
            yield f"*{caption}*"
            yield ""
    yield "## Every claim"
    for number, claim in enumerate(CLAIMS, 1):
        yield from claim_lines(number, claim, findings[claim.key], study)


def claim_lines(number: int, claim: Claim, finding: Finding, study: Study) -> Iterable[str]:
    """One claim: what is measured, the verdict, and a table of its values."""
    yield ""
    yield f'<a id="{claim.key}"></a>'
    yield f"### {number}. {claim.statement}"
    yield ""
    yield f"Paper, section {claim.section}. Measured: {claim.quantity}. Criterion: {claim.criterion}."
    yield ""
    yield f"**{finding.verdict.capitalize()}.** {finding.why}"
    yield ""
    yield (
        f"From the runs of {', '.join(claim.methods)} in [runs.csv](runs.csv); measured again by "
        f"`scripts/reproduce --out OUT --claim {claim.key}`."
    )
    if finding.cases:
        yield ""
        yield from table(finding, study)


def table(finding: Finding, study: Study) -> Iterable[str]:
    """The values of a claim, a row for each place and a column for each seed; values that contradict it are bold."""
    seeds: Sequence[int | None] = [
        seed for seed in study.budget.seeds if any(case.seed == seed for case in finding.cases)
    ]
    seeds = seeds or [None]
    cells = {(case.where, case.seed): case for case in finding.cases}
    yield "| | " + " | ".join("all seeds" if seed is None else f"seed {seed}" for seed in seeds) + " |"
    yield "|---" * (len(seeds) + 1) + "|"
    for where in dict.fromkeys(case.where for case in finding.cases):
        row = []
        for seed in seeds:
            case = cells.get((where, seed))
            value = "" if case is None else f"{case.value:.4g}"
            row.append(value if case is None or case.fulfilled else f"**{value}**")
        yield f"| {where} | " + " | ".join(row) + " |"


def span(finding: Finding) -> str:
    """The range of a claim's values as text."""
    if not finding.cases:
        return ""
    values = [case.value for case in finding.cases]
    low, high = min(values), max(values)
    return f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"


def parts(facts: dict[str, Any]) -> str:
    """The seconds that the last call of each part took, as text."""
    taken = facts.get("seconds", {})
    return ", ".join(f"{seconds:,.0f} s ({part})" for part, seconds in taken.items()) or "an unknown time"


def available_seeds(study: Study) -> str:
    """The seeds that every method has, such as `nsga2 0, 1 (2 on 4 of 12 panels)`."""
    described = []
    for method in METHODS:
        held = {
            seed: sum(study.setups(panel, method, seed) is not None for panel in PANELS) for seed in study.budget.seeds
        }
        whole = [str(seed) for seed, count in held.items() if count == len(PANELS)]
        parts = [
            f"{seed} on {count} of {len(PANELS)} panels" for seed, count in held.items() if 0 < count < len(PANELS)
        ]
        listed = ", ".join(whole) + (f" ({'; '.join(parts)})" if parts else "")
        described.append(f"{method} {listed.strip() or 'none'}")
    return "; ".join(described)


def facts(budget: str) -> dict[str, str]:
    """Budget, hardware and software, for study.json."""
    import os
    import platform

    from rbfevo.runs.summary import versions

    model = ""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        model = next(
            (line.split(":")[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line), ""
        )
    found = versions()
    software = ", ".join(
        f"{name} {found[name]}" for name in ("python", "torch", "numpy", "scipy", "numba") if name in found
    )
    hardware = f"{os.cpu_count()} cores, {model or platform.machine()}, shared with other work"
    return {"budget": budget, "hardware": hardware, "software": software}


def write_facts(out: Path, contents: dict[str, object]) -> None:
    """Write study.json."""
    write_whole(out / "study.json", (json.dumps(contents, indent=2) + "\n").encode())
