"""Curves over the number of centers: by value on synthetic runs, and as a sweep of real ones shows them."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import trimesh
from browsers import opened
from test_mesh_runs import egg
from test_sweep import a_run

from rbfevo import collect
from rbfevo.__main__ import main
from rbfevo.figures import curves as figure
from rbfevo.recorded import sweep
from rbfevo.recorded.sweep import sequences
from rbfevo.recorded.sweep.tables import QUANTITIES, Group, spread
from rbfevo.runs.sequence import picks

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

NAN = math.nan
RANDOM = ("method=random", "method.population=12", "scenario.resolution=[16,16]", "quiet=true")


def with_centers(run: Path, m: int, R: Any, P: Any, **settings: Any) -> Path:
    """A synthetic run of setups of m centers."""
    a_run(run, R, P, **settings)
    with np.load(run / "setups.npz") as saved:
        arrays = dict(saved)
    arrays["centers"] = np.full((len(arrays["regularity"]), m, 2), 0.5)
    np.savez(run / "setups.npz", **arrays)
    return run


def found(directory: Path) -> list[sweep.Curve]:
    members, unread = sweep.members(directory)
    assert unread == []
    return sweep.curves(sweep.groups(members))


def rows(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def a_group(m: int, best: list[float], method: str = "gradient", **settings: Any) -> Group:
    """A group of runs, one a seed, that found these best potentials with m centers."""
    values = dict.fromkeys(QUANTITIES, tuple([0.5] * len(best))) | {"best_improvement_potential": tuple(best)}
    shown = {"mesh": "a", "scenario": "plane", "kernel": "wendland", "method": method, "centers": m, **settings}
    return Group(
        settings=shown,
        varying=("centers", "method", *settings),
        series="all",
        vertices=4,
        setups=9,
        runs=tuple(f"{m}-{seed}" for seed in range(len(best))),
        seeds=len(best),
        spreads={key: spread(values[key]) for key in QUANTITIES},
        values=values,
    )


def sentences(groups: list[Group], nested: tuple[sweep.NestedSequence, ...] = ()) -> list[str]:
    return [text for texts in sweep.advice(sweep.curves(groups), nested).values() for text in texts]


def a_sequence(potential: list[float], note: str = "", mesh: str = "a", **settings: Any) -> sweep.NestedSequence:
    R = [1.0 / (i + 1) for i in range(len(potential))]
    return sweep.NestedSequence("k", mesh, settings, R, potential, None, [[0.0, 0.0]] * len(potential), note)


# --- where another center stops paying -------------------------------------------------------------------------------


def test_the_fewest_centers_with_enough_gain_by_hand() -> None:
    """Gains are 0.5, 0.8, 0.95 and 1: of the largest 50, 80, 95 and 100 %."""
    groups = [a_group(m, [P]) for m, P in ((40, 1.0), (4, 0.25), (16, 0.9025), (8, 0.64))]
    (curve,) = sweep.curves(groups)
    assert curve.centers == [4, 8, 16, 40]
    assert curve.gains == pytest.approx([0.5, 0.8, 0.95, 1.0])
    assert (curve.label, curve.enough) == ("gradient", 16)
    assert sentences(groups) == [
        "gradient: 16 centers reach 95 % of the largest gain (the square root of improvement potential), that of 40; "
        "8 have 80 %; from 8 to 16 centers improvement potential grows by 0.26 (1 seed), from 16 to 40 it grows by "
        "0.098 (1 seed)"
    ]
    groups[2] = a_group(16, [0.9024])
    assert sweep.curves(groups)[0].enough == 40


def test_ends_of_the_numbers_that_were_tried_are_said_to_be_ends() -> None:
    growing = [a_group(m, [P]) for m, P in ((4, 0.25), (8, 0.64))]
    assert sentences(growing) == [
        "gradient: 8 centers have the largest gain (the square root of improvement potential); 4 have 62 %; no larger "
        "number was tried, and more may gain more; from 4 to 8 centers improvement potential grows by 0.39 (1 seed)"
    ]
    flat = [a_group(m, [P]) for m, P in ((4, 0.81), (8, 0.8))]
    assert sentences(flat) == [
        "gradient: 4 centers have the largest gain (the square root of improvement potential); no smaller number was "
        "tried, and fewer may do; from 4 to 8 centers improvement potential falls by 0.01 (1 seed)"
    ]
    one = [a_group(m, [P]) for m, P in ((1, 0.9), (2, 0.91))]
    assert sentences(one)[0].startswith("gradient: 1 center reaches 95 % of the largest gain (the square root of")
    assert "fewer may do" not in sentences(one)[0]


def test_a_step_within_the_scatter_of_the_seeds_is_said_to_be() -> None:
    groups = [a_group(4, [0.30, 0.32]), a_group(8, [0.80, 0.84]), a_group(16, [0.83, 0.85])]
    (text,) = sentences(groups)
    assert text.endswith(
        "from 4 to 8 centers improvement potential grows by 0.51, from 8 to 16 it grows by 0.02 (within the scatter of "
        "the seeds)"
    )
    assert "(within" not in sentences([*groups[:2], a_group(16, [0.845, 0.85])])[0]
    falling = [a_group(4, [0.30, 0.32]), a_group(8, [0.80, 0.84]), a_group(16, [0.79, 0.81])]
    assert sentences(falling)[0].endswith("it falls by 0.02 (within the scatter of the seeds)")


def test_medians_over_the_seeds_decide_and_lost_seeds_do_not() -> None:
    groups = [a_group(4, [0.9, 0.1, 0.1]), a_group(8, [0.5, 0.6, NAN]), a_group(16, [0.6, 0.6, 0.6])]
    (curve,) = sweep.curves(groups)
    assert curve.gains == pytest.approx(np.sqrt([0.1, 0.55, 0.6]))
    assert curve.enough == 8


def test_nothing_gained_is_no_reason_to_stop() -> None:
    (curve,) = sweep.curves([a_group(4, [0.0]), a_group(8, [0.0])])
    assert curve.enough is None
    assert sentences([a_group(4, [0.0]), a_group(8, [0.0])]) == []


def test_a_nested_sequence_beside_the_most_that_were_tried_and_beside_all() -> None:
    potential = [(i / 10.0) ** 2 for i in range(1, 11)]  # gains 0.1, 0.2 ... 1
    groups = [a_group(m, [P]) for m, P in ((2, 0.3), (4, 0.5))]
    texts = sentences(groups, (a_sequence([*potential, 1.0, 1.0]),))
    assert texts[1] == "nested OLS sequence: 4 centers reach 95 % of its gain with 4, 10 of that with 12"
    ended = a_sequence([0.25, 0.9025, 1.0], "no other candidate has a column of its own: it ends")
    assert sentences(groups, (ended,))[1] == (
        "nested OLS sequence: 2 centers reach 95 % of its gain with 3; no other candidate has a column of its own: it "
        "ends"
    )
    assert sentences(groups, (a_sequence([0.0, 0.0]),))[1] == "nested OLS sequence: no center gains anything"
    labels = sweep.labels_of([a_sequence([1.0], support=0.1), a_sequence([1.0], support=0.2)])
    assert labels == ["nested OLS sequence (support 0.1)", "nested OLS sequence (support 0.2)"]


# --- which curves there are ------------------------------------------------------------------------------------------


def test_a_curve_for_each_combination_and_one_number_alone_is_a_point(tmp_path: Path) -> None:
    for i, (m, support, P) in enumerate([(4, 0.2, 0.5), (8, 0.2, 0.6), (4, 0.4, 0.3), (8, 0.4, 0.7), (16, 0.4, 0.8)]):
        with_centers(tmp_path / f"g{i}", m, [0.1], [P], support=support, config={})
    with_centers(tmp_path / "lloyd", 8, [0.9], [0.2], support=0.2, method="lloyd")
    curves = found(tmp_path)
    assert {curve.label: curve.centers for curve in curves} == {
        "support 0.2, gradient": [4, 8],
        "support 0.4, gradient": [4, 8, 16],
        "support 0.2, lloyd": [8],
    }
    assert [curve.enough for curve in curves] == [8, 16, None]


def test_one_number_alone_makes_no_curves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed in (0, 1):
        with_centers(tmp_path / str(seed), 4, [0.1], [0.5], seed=seed)
    assert found(tmp_path) == []
    assert collect.main([str(tmp_path)]) == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith("runs.csv, medians.csv, report.html")
    assert not (tmp_path / "curves.csv").exists()


def test_meshes_have_curves_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for m, P in ((4, 0.3), (8, 0.9)):
        with_centers(tmp_path / f"a{m}", m, [0.1], [P])
        with_centers(tmp_path / f"b{m}", m, [0.1], [P / 2], scale=2.0)
    with_centers(tmp_path / "c", 8, [0.1], [0.4], scale=3.0)
    curves = found(tmp_path)
    assert [curve.centers for curve in curves] == [[4, 8], [4, 8]]
    assert len({curve.mesh for curve in curves}) == 2
    assert collect.main([str(tmp_path), "--sequence", "0"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert [line[:5] for line in out if "centers have the largest gain" in line] == ["mesh ", "mesh "]
    picture = figure.picture(curves, (), "Sweep")
    assert len(picture.axes) == 4


def test_the_knee_of_a_front_is_found_anew_from_setups_npz(tmp_path: Path) -> None:
    """The setup farthest from the chord between the ends of the front, both axes scaled, by plain loops."""
    rng = np.random.default_rng(0)
    for m in (3, 5, 9):
        for seed in (0, 1, 2):
            angle, size = rng.uniform(0, math.pi / 2, 30), rng.uniform(0.2, 1.0, 30)
            with_centers(tmp_path / f"{m}-{seed}", m, size * np.cos(angle), size * np.sin(angle), seed=seed)
    expected: dict[int, list[tuple[float, float]]] = {}
    for run in sorted(tmp_path.iterdir()):
        with np.load(run / "setups.npz") as saved:
            points = list(zip(saved["regularity"].tolist(), saved["improvement_potential"].tolist(), strict=True))
            m = saved["centers"].shape[1]
        front = sorted(p for p in points if not any(q[0] >= p[0] and q[1] >= p[1] and q != p for q in points))
        (r0, p0), (r1, p1) = front[0], front[-1]
        far = [abs((r - r0) / (r1 - r0) + (p - p1) / (p0 - p1) - 1.0) for r, p in front]
        expected.setdefault(m, []).append(front[far.index(max(far))])
    (curve,) = found(tmp_path)
    for group, m in zip(curve.groups, curve.centers, strict=True):
        R, P = zip(*expected[m], strict=True)
        assert sorted(group.values["knee_regularity"]) == sorted(R)
        assert group.spreads["knee_regularity"].median == np.median(R)
        assert group.spreads["knee_improvement_potential"] == pytest.approx(np.quantile(P, [0.5, 0.25, 0.75]))
    assert collect.main([str(tmp_path), "--sequence", "0"]) == 0
    table = rows(tmp_path / "curves.csv")
    assert [int(row["centers"]) for row in table] == [3, 5, 9]
    assert [float(row["knee_regularity_median"]) for row in table] == [
        pytest.approx(np.median([R for R, _ in expected[m]])) for m in (3, 5, 9)
    ]
    assert [int(row["enough"]) for row in table].count(1) == 1
    share = [float(row["share_of_largest_gain"]) for row in table]
    best = [np.sqrt(float(row["best_improvement_potential_median"])) for row in table]
    assert share == pytest.approx(np.array(best) / max(best))


def test_one_setup_a_run_is_its_own_knee_and_runs_without_scores_are_left_out(tmp_path: Path) -> None:
    with_centers(tmp_path / "0", 2, [0.8], [0.3], method="lloyd")
    with_centers(tmp_path / "1", 4, [0.4], [0.6], method="lloyd")
    with_centers(tmp_path / "2", 8, [NAN], [NAN], method="lloyd")
    (curve,) = found(tmp_path)
    assert curve.centers == [2, 4]
    assert [group.spreads["knee_regularity"].median for group in curve.groups] == [0.8, 0.4]
    assert [group.spreads["knee_improvement_potential"].median for group in curve.groups] == [0.3, 0.6]


def test_the_picture_has_the_numbers_and_takes_a_logarithmic_axis_where_it_needs_one(tmp_path: Path) -> None:
    for m, R, P in ((2, 0.9, 0.3), (4, 0.5, 0.6), (8, 0.2, 0.61)):
        with_centers(tmp_path / str(m), m, [R], [P])
    curves, nested = found(tmp_path), [a_sequence([0.1, 0.3, 0.4], mesh=found(tmp_path)[0].mesh)]
    left, right = figure.picture(curves, nested, "Sweep").axes
    (sequence, best, knee, *_), (of_sequence, regularity, *_) = left.get_lines(), right.get_lines()
    assert list(best.get_xdata()) == [2, 4, 8]  # pyright: ignore[reportArgumentType]
    assert list(best.get_ydata()) == list(knee.get_ydata()) == [0.3, 0.6, 0.61]  # pyright: ignore[reportArgumentType]
    assert list(sequence.get_ydata()) == [0.1, 0.3, 0.4]  # pyright: ignore[reportArgumentType]
    assert list(of_sequence.get_ydata()) == [1.0, 0.5, pytest.approx(1 / 3)]  # pyright: ignore[reportArgumentType]
    assert list(regularity.get_ydata()) == [0.9, 0.5, 0.2]  # pyright: ignore[reportArgumentType]
    uprights = [
        line.get_xdata() for line in left.get_lines() if len(set(line.get_xdata())) == 1 < len(line.get_xdata())
    ]  # pyright: ignore
    assert [list(x) for x in uprights] == [[4, 4]]  # pyright: ignore[reportArgumentType]
    assert (left.get_xscale(), right.get_yscale()) == ("log", "linear")
    with_centers(tmp_path / "16", 16, [1e-4], [0.7])
    assert figure.picture(found(tmp_path), nested, "Sweep").axes[1].get_yscale() == "log"


# --- a sweep of real runs, with the nested sequence ------------------------------------------------------------------


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A sweep over centers, manipulation and seed, as it is collected, and what that printed."""
    directory = tmp_path_factory.mktemp("numbers") / "sweep"
    given = ["-m", *RANDOM, "figures=false", f"hydra.sweep.dir={directory}"]
    assert main([*given, "centers=2,4,8", "manipulation=indirect,direct", "seed=0,1"]) == 0
    assert not (directory / "curves.csv").exists()  # figures=false
    picked: list[int] = []

    def counted(parts: Any, most: int) -> Any:
        picked.append(most)
        return picks(parts, most)

    with contextlib.redirect_stdout(io.StringIO()) as out, pytest.MonkeyPatch.context() as patch:
        patch.setattr("rbfevo.runs.sequence.picks", counted)
        assert collect.main([str(directory), "--sequence", "12"]) == 0
    assert picked == [12]  # once for both manipulations
    return directory, out.getvalue()


def test_a_sweep_over_centers_is_collected_with_its_sequences(collected: tuple[Path, str]) -> None:
    directory, out = collected
    lines = out.splitlines()
    assert lines[0] == "nested OLS sequence of up to 12 centers for 0 and runs like it ..."
    assert lines[-1].endswith("runs.csv, medians.csv, curves.csv, sequence.csv, curves.png, report.html")
    assert sum("reach" in line and "nested OLS sequence (" in line for line in lines) == 2
    table = rows(directory / "sequence.csv")
    assert [(row["manipulation"], int(row["centers"])) for row in table] == [
        (manipulation, m) for manipulation in ("indirect", "direct") for m in range(1, 13)
    ]
    assert main([*RANDOM[2:], "method=ols", "centers=12", "manipulation=direct", "figures=false",
                 f"hydra.run.dir={directory.parent / 'ols'}"]) == 0  # fmt: skip
    own = rows(directory.parent / "ols" / "sequence.csv")
    for of_sweep, of_run in zip(table[12:], own, strict=True):
        for name in ("regularity", "improvement_potential", "x", "y"):
            assert float(of_sweep[name]) == pytest.approx(float(of_run[name]), rel=1e-12)
    assert [row["improvement_potential"] for row in table[:12]] == [row["improvement_potential"] for row in table[12:]]
    assert [row["regularity"] for row in table[:12]] != [row["regularity"] for row in table[12:]]
    assert (directory / "curves.png").stat().st_size > 10_000


def test_a_sequence_is_computed_once(
    collected: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = shutil.copytree(collected[0], tmp_path / "sweep")
    before = (directory / "sequence.csv").read_bytes()

    def fails(*_: object) -> None:
        raise RuntimeError("computed again")

    monkeypatch.setattr("rbfevo.runs.sequence.picks", fails)
    assert collect.main([str(directory), "--sequence", "12"]) == 0
    assert "nested OLS sequence of" not in capsys.readouterr().out
    assert (directory / "sequence.csv").read_bytes() == before
    assert collect.main([str(directory), "--sequence", "5"]) == 0
    assert len(rows(directory / "sequence.csv")) == 10
    assert collect.main([str(directory), "--sequence", "12"]) == 0  # the shorter one is all that is left of it
    err = capsys.readouterr().err
    assert "warning: no nested OLS sequence for 0 and runs like it: RuntimeError: computed again" in err
    assert len(rows(directory / "sequence.csv")) == 10
    (directory / "sequence.csv").write_text("centers,regularity\n1,nonsense\n")
    assert collect.main([str(directory), "--sequence", "12"]) == 0
    assert (directory / "report.html").exists()


def test_sequences_of_ols_runs_are_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["-m", *RANDOM[2:], "figures=false", "method=ols", "method.per_axis=8", f"hydra.sweep.dir={tmp_path}"]
    assert main([*given, "centers=3,9"]) == 0
    capsys.readouterr()
    assert collect.main([str(tmp_path), "--sequence", "9"]) == 0
    out, err = capsys.readouterr()
    assert "runs like it ..." not in out
    assert err == ""
    own = rows(tmp_path / "1" / "sequence.csv")
    assert [row["improvement_potential"] for row in rows(tmp_path / "sequence.csv")] == [
        row["improvement_potential"] for row in own
    ]


def test_a_scenario_that_changed_has_no_sequence_but_that_of_its_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    template = egg(tmp_path, subdivisions=2)
    given = [f"scenario.template={template}", f"scenario.sensitivity={tmp_path / 's.npy'}", "kernel.support=1.5"]
    given += ["-m", "scenario=mesh", "figures=false", "quiet=true", f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    assert main([*given, "method=ols", "method.per_axis=5", "centers=3,6"]) == 0
    trimesh.load(template, process=False).apply_scale(1.1).export(template)  # pyright: ignore
    assert collect.main([str(tmp_path / "sweep"), "--sequence", "20"]) == 0
    assert "vertices of the scenario changed since this run scored its setups" in capsys.readouterr().err
    assert len(rows(tmp_path / "sweep" / "sequence.csv")) == 6


def test_runs_without_a_configuration_have_curves_and_no_sequence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for m, P in ((4, 0.3), (8, 0.9)):
        with_centers(tmp_path / str(m), m, [0.1], [P])
    assert collect.main([str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    assert "config.yaml is missing: it is needed to build the scenario of this run again" in err
    assert err.count("\n") == 1
    assert "8 centers have the largest gain" in out
    assert out.splitlines()[-1].endswith("runs.csv, medians.csv, curves.csv, curves.png, report.html")
    assert collect.main([str(tmp_path), "--sequence", "-1"]) == 2
    assert "--sequence -1: give a number of centers, or 0 for no sequence" in capsys.readouterr().err


def test_settings_on_which_no_sequence_depends_share_one(tmp_path: Path) -> None:
    for i, settings in enumerate(({}, {"method": "lloyd"}, {"seed": 3}, {"support": 0.9})):
        config = {"method.generations": i, "seed": i}
        with_centers(tmp_path / str(i), 2 + i, [0.1], [0.5], config=config, **settings)
    members, _ = sweep.members(tmp_path)
    keys = [sequences.key_of(member) for member in members]
    assert keys[0] == keys[1] == keys[2] != keys[3]


def test_a_sweep_prints_its_numbers_of_centers_as_they_come(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])
    loud = [word for word in RANDOM if word != "quiet=true"]
    assert main(["-m", *loud, f"hydra.sweep.dir={tmp_path}", "centers=2,300,4"]) == 2
    out, err = capsys.readouterr()
    assert "nested OLS sequence of up to 100 centers for 0 and runs like it ..." in out
    assert "random: 2 centers reach 95 % of the largest gain (the square root of improvement potential), that of" in out
    assert "1 of 3 jobs failed:" in err
    assert [int(row["centers"]) for row in rows(tmp_path / "curves.csv")] == [2, 4]
    assert [int(row["centers"]) for row in rows(tmp_path / "sequence.csv")] == list(range(1, 101))


def test_bounded_potential_takes_the_place_of_p(tmp_path: Path) -> None:
    given = ["-m", *RANDOM, "figures=false", "criterion.norm=16", f"hydra.sweep.dir={tmp_path}", "centers=2,4"]
    assert main(given) == 0
    assert collect.main([str(tmp_path), "--sequence", "5"]) == 0
    (curve,) = found(tmp_path)
    assert curve.groups[0].potential == "bounded potential (p = 16)"
    with np.load(tmp_path / "1" / "setups.npz") as saved:
        assert curve.groups[1].spreads["best_improvement_potential"].median == saved["bounded_potential"].max()
    members, _ = sweep.members(tmp_path)
    keys = sequences.shown_settings(members)
    (sequence,) = sequences.read(tmp_path / "sequence.csv", {sequences.key_of(members[0]): members[0]}, keys).values()
    assert sequence.potential == sequence.bounded_potential
    assert np.all(np.diff(sequence.potential) > 0)


# --- the page --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def page(browser: Browser, collected: tuple[Path, str]) -> Iterator[Page]:
    with opened(browser, collected[0] / "report.html") as opened_page:
        yield opened_page


def traces(page: Page, plot: str) -> list[dict[str, Any]]:
    kept = "({ name, x, y, line, error_y }) => ({ name, x: [...x], y: [...y], dash: line.dash, bar: error_y?.array })"
    return page.evaluate(f"(id) => document.getElementById(id).data.map({kept})", plot)


def test_the_page_draws_the_curves_and_the_sequences(page: Page, collected: tuple[Path, str]) -> None:
    directory, _ = collected
    assert page.locator("#numbers").is_visible()
    curves = {curve.label: curve for curve in found(directory)}
    assert sorted(curves) == ["direct", "indirect"]
    nested = rows(directory / "sequence.csv")
    drawn = traces(page, "numbers-potential")
    assert [trace["name"] for trace in drawn] == [
        *(f"nested OLS sequence ({name})" for name in ("indirect", "direct")),
        *("indirect", "indirect", "direct", "direct"),
    ]
    for trace, part in zip(drawn[:2], (nested[:12], nested[12:]), strict=True):
        assert trace["x"] == list(range(1, 13))
        assert trace["y"] == [float(row["improvement_potential"]) for row in part]
    for place, name in ((2, "indirect"), (4, "direct")):
        for trace, key in zip(
            drawn[place:], ("best_improvement_potential", "knee_improvement_potential"), strict=False
        ):
            spreads = [group.spreads[key] for group in curves[name].groups]
            assert trace["x"] == [2, 4, 8]
            assert trace["y"] == [spread.median for spread in spreads]
            assert trace["bar"] == pytest.approx([spread.upper - spread.median for spread in spreads])
    assert [trace["dash"] for trace in drawn[2:4]] == ["solid", "dash"]
    below = traces(page, "numbers-regularity")
    medians = [group.spreads["knee_regularity"].median for group in curves["direct"].groups]
    assert below[-1]["y"] == medians
    assert below[0]["y"][1] == float(nested[1]["regularity"])
    uprights = page.evaluate("() => document.getElementById('numbers-potential').layout.shapes.map((line) => line.x0)")
    assert uprights == [curves[name].enough for name in ("indirect", "direct")]


def test_the_page_tells_the_numbers_in_words_and_in_a_table(page: Page, collected: tuple[Path, str]) -> None:
    directory, out = collected
    shown = page.locator("#numbers-sentences li").all_inner_texts()
    assert len(shown) == 4
    assert all(text in out for text in shown)
    page.locator("#numbers summary").click()
    table = page.locator("#numbers-table tbody tr").all_inner_texts()
    assert len(table) == 6
    assert table[0].split("\t")[:3] == ["indirect", "2", "2"]
    chosen = page.locator("#numbers-table tr.chosen").all_inner_texts()
    enough = {curve.label: curve.enough for curve in found(directory)}
    assert [row.split("\t")[:2] for row in chosen] == [[name, str(enough[name])] for name in ("indirect", "direct")]
    assert "95 % of the largest gain, the square root of P" in (page.text_content("#numbers-hint") or "")


def test_the_page_shows_the_curves_of_one_mesh_and_none_where_there_are_none(browser: Browser, tmp_path: Path) -> None:
    """Also on a narrow window, and a regularity of 0 has no place on a logarithmic axis."""
    for m, R, P in ((4, 0.5, 0.3), (8, 1e-4, 0.9), (9, 0.0, 0.95)):
        with_centers(tmp_path / f"a{m}", m, [R], [P])
    for m, P in ((4, 0.2), (12, 0.1)):
        with_centers(tmp_path / f"b{m}", m, [0.5 / m], [P], scale=2.0)
    with_centers(tmp_path / "c", 8, [0.1], [0.4], scale=3.0)
    assert collect.main([str(tmp_path), "--sequence", "0"]) == 0
    with opened(browser, tmp_path / "report.html", viewport={"width": 360, "height": 740}) as page:
        look = "(id) => (({ xaxis, yaxis }) => [xaxis.tickvals, yaxis.type])(document.getElementById(id).layout)"
        assert traces(page, "numbers-potential")[0]["y"] == [0.3, 0.9, 0.95]
        assert traces(page, "numbers-regularity")[0]["y"] == [0.5, 1e-4, None]
        assert page.evaluate(look, "numbers-regularity") == [[4, 8, 9], "log"]
        right = "(all) => Math.max(...all.map((each) => each.getBoundingClientRect().right))"
        assert page.eval_on_selector_all("#numbers, #numbers-sentences, #numbers .plot", right) <= 360
        page.select_option("#filter-mesh", "2")
        assert page.locator("#numbers").is_hidden()
        page.select_option("#filter-mesh", "1")
        assert page.locator("#numbers").is_visible()
        assert traces(page, "numbers-potential")[0]["y"] == [0.2, 0.1]
        assert page.evaluate(look, "numbers-regularity") == [[4, 12], "linear"]
