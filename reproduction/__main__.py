"""`scripts/reproduce`: the runs, the figures, the fits and the page of one budget."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

from benchmarks.panels import chosen
from rbfevo.errors import UserError
from reproduction import page, runs
from reproduction.budgets import BUDGETS, Budget, budget_named
from reproduction.claims import CLAIMS
from reproduction.study import Study

PARTS = ("runs", "fronts", "fits", "figures", "claims")


def report(line: str) -> None:
    """Print a line with the time, without buffering."""
    print(f"{time.strftime('%H:%M:%S')} {line}", flush=True)


def prepare(out: Path, budget: Budget) -> dict[str, object]:
    """Make the directory, or continue in one of the same budget; return the contents of study.json.

    Raises:
        UserError: if the directory belongs to another budget or cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {out}: {error.strerror or error}") from error
    held = {}
    if (out / "study.json").exists():
        held = Study(out).facts
        if held["budget"] != budget.name:
            raise UserError(f"--out {out} is of --budget {held['budget']}: choose another directory for {budget.name}")
    contents: dict[str, object] = {**page.facts(budget.name), "seconds": held.get("seconds", {})}
    for name in ("hardware", "software"):  # of every machine used
        before = str(held.get(name, contents[name]))
        contents[name] = before if str(contents[name]) in before else f"{before}; then {contents[name]}"
    page.write_facts(out, contents)
    return contents


def carry_out(part: str, out: Path, budget: Budget, names: list[str]) -> int:
    """Carry out one part; return its exit code."""
    panels = chosen(names)
    if part == "runs":
        return runs.carry_out(budget, out, report, panels)
    if part == "fronts":
        return runs.carry_out_fronts(budget, out, report, panels)
    if part == "fits":
        from reproduction import fits

        return fits.carry_out(Study(out), report)
    from reproduction import figures

    if part == "figures":
        for warning in figures.draw(out):
            report(f"warning: {warning}")
        return 0
    study = study_with_runs(out)
    findings = page.write(study, figures.captions(study))
    verdicts = [finding.verdict for finding in findings.values()]
    counts = (f"{verdicts.count(name)} {name}" for name in dict.fromkeys(verdicts))
    report(f"{out / 'claims.md'}: {', '.join(counts)}")
    return 0


def study_with_runs(out: Path) -> Study:
    """The study of a directory that holds runs.

    Raises:
        UserError: if it holds none: the repository has pages, but not the runs that they were made from.
    """
    study = Study(out)
    if not (out / "runs").is_dir():
        raise UserError(f"--out {out} has no runs to measure claims on: make them with --only runs --only fronts first")
    return study


def show_claim(out: Path, key: str) -> int:
    """Measure one claim and print its values.

    Raises:
        UserError: if there is no such claim.
    """
    found = next(((number, claim) for number, claim in enumerate(CLAIMS, 1) if claim.key == key), None)
    if found is None:
        raise UserError(f"--claim {key}: there is no such claim; choose from {', '.join(one.key for one in CLAIMS)}")
    study = study_with_runs(out)
    print("\n".join(page.claim_lines(*found, found[1].find(study), study)).strip())
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Carry out what is missing, part by part; return the exit code."""
    parser = argparse.ArgumentParser(prog="scripts/reproduce", description=__doc__)
    parser.add_argument("panels", nargs="*", help="only runs and fronts of these panels (parts of their names)")
    parser.add_argument("--budget", default="quick", help=f"one of {', '.join(BUDGETS)}; default: quick")
    parser.add_argument("--out", type=Path, help="directory of the results; default: outputs/reproduce/BUDGET")
    parser.add_argument("--only", choices=PARTS, action="append", help="only this part; may be given several times")
    parser.add_argument("--claim", metavar="KEY", help="measure one claim on the results in --out, and print it")
    options = parser.parse_args(arguments)
    try:
        budget = budget_named(options.budget)
        out = options.out or Path("outputs") / "reproduce" / budget.name
        if options.claim is not None and options.panels:
            raise UserError(f"--claim {options.claim} takes all panels: leave out {' '.join(options.panels)}")
        if options.claim is not None:
            return show_claim(out, options.claim)
        chosen(options.panels)
        contents = prepare(out, budget)
        taken = dict(json.loads(json.dumps(contents["seconds"])))
        for part in options.only or PARTS:
            begin = time.perf_counter()
            code = carry_out(part, out, budget, options.panels)
            taken[part] = round(time.perf_counter() - begin, 1)
            page.write_facts(out, {**contents, "seconds": taken})
            if code != 0:
                return code
    except UserError as error:
        print(f"scripts/reproduce: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("scripts/reproduce: interrupted; the same command continues from here", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
