"""Sweeps of synthetic runs with chosen scores: found, read, tabulated, compared; the numbers are worked out by hand."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
from pathlib import Path
from typing import Any

import moocore
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from rbfevo.errors import UserError
from rbfevo.recorded import sweep
from rbfevo.recorded.record import knee, read
from rbfevo.scoring import pareto

NAN, INF = math.nan, math.inf
VERTICES = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0], [1.0, 2.0]])
CONFIG = {
    "scenario": {"_target_": "rbfevo.scenarios.plane", "resolution": [30, 30], "support": 0.5},
    "kernel": {"_target_": "rbfevo.scoring.kernels.wendland", "support": None},
    "manipulation": {"name": "indirect"},
    "method": {"_target_": "rbfevo.methods.GradientSearch", "generations": 6},
    "seed": 0,
    "centers": 3,
    "preference": None,
    "device": "auto",
    "evaluator": "auto",
    "figures": True,
    "quiet": False,
}


def a_run(
    run: Path, R: Any = (0.5,), P: Any = (0.5,), *, series: Any = None, config: Any = None, scale=1.0, **summary
) -> Path:
    """Write a run directory of setups with chosen scores; `config` are dotted keys of .hydra/config.yaml, if given."""
    content = {
        "scenario": "plane",
        "kernel": "wendland",
        "support": 0.5,
        "manipulation": "indirect",
        "method": "gradient",
    }
    content |= {
        "seed": 0,
        "evaluations": 100,
        "failed_evaluations": 1,
        "seconds": 2.5,
        "stop_reason": "budget",
        **summary,
    }
    content = {key: value for key, value in content.items() if value != "absent"}
    R, P = np.array(R, dtype=float), np.array(P, dtype=float)
    run.mkdir(parents=True)
    as_good = (R[:, None] >= R) & (P[:, None] >= P) & ((R[:, None] > R) | (P[:, None] > P))
    np.savez(
        run / "setups.npz",
        centers=np.full((len(R), 3, 2), 0.5),
        regularity=R,
        improvement_potential=P,
        method=np.array(series or [content.get("method")] * len(R), dtype=np.str_),
        preference=np.full(len(R), NAN),
        nondominated=~as_good.any(axis=0) & np.isfinite(R + P),
    )
    mesh = {"vertices": scale * VERTICES, "faces": np.array([[0, 1, 2], [1, 3, 2]]), "weights": np.ones(4)}
    np.savez(run / "scenario.npz", **mesh, gradient=np.full((4, 1), 0.5), lower=np.zeros(2), upper=np.array([1.0, 2.0]))
    (run / "summary.json").write_text(json.dumps(content))
    if config is not None:
        (run / ".hydra").mkdir()
        made = OmegaConf.create(CONFIG)
        for key, value in config.items():
            OmegaConf.update(made, key, value, force_add=True)
        OmegaConf.save(made, run / ".hydra" / "config.yaml")
    return run


def square(run: Path, area: float, **settings: Any) -> Path:
    """A run with one setup, R = P, of that hypervolume."""
    return a_run(run, [math.sqrt(area)], [math.sqrt(area)], **settings)


def collected(directory: Path) -> list[sweep.Member]:
    members, unread = sweep.members(directory)
    assert unread == []
    return members


def names(directory: Path) -> list[str]:
    return [path.relative_to(directory).as_posix() for path in sweep.find(directory)]


# --- finding and reading ---------------------------------------------------------------------------------------------


def test_runs_are_found_at_any_depth_in_natural_order(tmp_path):
    for name in ("b/10", "b/2", "b/2a", "a", "b/02"):
        a_run(tmp_path / name)
    assert names(tmp_path) == ["a", "b/02", "b/2", "b/2a", "b/10"]


def test_a_run_is_found_at_the_directory_itself_and_nothing_within_it(tmp_path):
    run = a_run(tmp_path / "run")
    a_run(run / "export-knee")
    assert names(run) == ["."]
    assert names(tmp_path) == ["run"]


def test_hidden_directories_are_not_looked_into(tmp_path):
    a_run(tmp_path / ".hydra" / "0")
    a_run(tmp_path / ".old" / "0")
    assert names(tmp_path) == []


def test_links_are_followed_once_and_never_around(tmp_path):
    a_run(tmp_path / "elsewhere" / "run")
    a_run(tmp_path / "beside")
    a_run(tmp_path / "sweep" / "0")
    sweep_directory = tmp_path / "sweep"
    (sweep_directory / "1").symlink_to(tmp_path / "elsewhere" / "run")
    (sweep_directory / "2").symlink_to(sweep_directory / "0")
    (sweep_directory / "loop").symlink_to(sweep_directory)
    (sweep_directory / "self").symlink_to(sweep_directory / "self")
    (sweep_directory / "up").symlink_to(tmp_path)
    assert names(sweep_directory) == ["0", "1"]


def test_a_directory_that_does_not_exist_or_holds_no_run_is_a_mistake(tmp_path):
    (tmp_path / "file").write_text("")
    for directory, said in [("nowhere", "there is no such"), ("file", "is a file"), (".", "there is no run here")]:
        with pytest.raises(UserError, match=said):
            sweep.members(tmp_path / directory)


def test_runs_that_cannot_be_read_are_told_with_the_reason(tmp_path):
    a_run(tmp_path / "0")
    (a_run(tmp_path / "1") / "scenario.npz").unlink()
    (a_run(tmp_path / "2") / "summary.json").write_text("{")
    (a_run(tmp_path / "3", config={}) / ".hydra" / "config.yaml").write_text("a: [1")
    (a_run(tmp_path / "4", config={}) / "summary.json").unlink()
    members, unread = sweep.members(tmp_path)
    assert [member.name for member in members] == ["0"]
    expected = {"1: ": "scenario.npz is missing", "2: ": "summary.json cannot be read", "3: ": "config.yaml cannot be"}
    for line, (start, reason) in zip(unread, [*expected.items(), ("4: ", "has no results")], strict=True):
        assert "\n" not in line
        assert line.startswith(start)
        assert reason in line


def test_a_sweep_of_which_nothing_can_be_read_is_a_mistake(tmp_path):
    (a_run(tmp_path / "0") / "scenario.npz").unlink()
    with pytest.raises(UserError, match=r"no run can be read: 0: .*scenario\.npz is missing"):
        sweep.members(tmp_path)


def test_settings_are_those_of_the_summary_and_the_leaves_of_the_configuration(tmp_path):
    config = {"method.nsga2": {"_target_": "x", "eta": 1e-5}, "scenario.keep_out": False, "preference": [0.0, 0.25, 1]}
    a_run(tmp_path / "0", config=config, support=0.75, seed=4)
    ((_, record, settings),) = collected(tmp_path)
    assert settings == {
        "scenario": "plane",
        "mesh": sweep.mesh_of(record),
        "kernel": "wendland",
        "support": 0.75,
        "manipulation": "indirect",
        "method": "gradient",
        "centers": 3,
        "seed": 4,
        "preference": "[0,0.25,1]",
        "scenario.resolution": "[30,30]",
        "scenario.support": 0.5,
        "scenario.keep_out": "false",
        "kernel.support": None,
        "method.generations": 6,
        "method.nsga2.eta": 1e-5,
    }


def test_runs_without_a_configuration_or_with_a_bare_summary_have_settings_too(tmp_path):
    a_run(tmp_path / "0", kernel="absent", seed="absent", stop_reason="absent", seconds="absent")
    ((_, _, settings),) = collected(tmp_path)
    assert settings["centers"] == 3
    assert settings["kernel"] is settings["seed"] is None
    line, _ = sweep.lines(collected(tmp_path))
    assert math.isnan(line.seconds)


def test_runs_on_one_mesh_share_its_arrays(tmp_path):
    a_run(tmp_path / "0")
    a_run(tmp_path / "1")
    one, other = (member.record for member in collected(tmp_path))
    assert one.vertices is other.vertices
    assert one.gradient is other.gradient


def test_the_fingerprint_of_a_mesh_is_fixed_and_forgives_the_last_bits(tmp_path):
    record = read(a_run(tmp_path / "0"))
    print_of = sweep.mesh_of(record)
    assert print_of == sweep.mesh_of(read(a_run(tmp_path / "1", [0.1, 0.2], [0.3, 0.4], kernel="other")))
    record.gradient[:] *= 1 + 1e-15
    record.vertices[0, 0] = -0.0
    assert sweep.mesh_of(record) == print_of


@pytest.mark.parametrize("name", ["vertices", "gradient", "weights", "faces", "scale"])
def test_the_fingerprint_of_a_mesh_tells_meshes_apart(tmp_path, name):
    record = read(a_run(tmp_path / "0"))
    before = sweep.mesh_of(record)
    if name == "scale":
        record.vertices[:] *= 2.0
    elif name == "faces":
        record.faces[0] = record.faces[0, [1, 2, 0]]
    else:
        getattr(record, name)[1] += 1e-4
    assert sweep.mesh_of(record) != before


# --- scores ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_the_hypervolume_is_that_of_moocore_and_of_torch(seed):
    rng = np.random.default_rng(seed)
    scores = rng.uniform(-0.2, 1.0, (rng.integers(1, 60), 2))
    if seed % 2:
        scores = np.round(scores, 1)  # duplicates and ties
    found = sweep.hypervolume(*scores.T)
    assert found == pytest.approx(moocore.hypervolume(np.maximum(scores, 0), ref=[0, 0], maximise=True), rel=1e-12)
    assert found == pytest.approx(pareto.hypervolume(torch.from_numpy(scores)), rel=1e-12)


def test_the_hypervolume_leaves_out_what_is_not_finite():
    R, P = np.array([0.5, NAN, INF, 0.25, -INF]), np.array([0.5, 1.0, 1.0, 1.0, 1.0])
    assert sweep.hypervolume(R, P) == 0.375
    assert sweep.hypervolume(R[1:3], P[1:3]) == 0.0
    assert sweep.hypervolume(R[:0], P[:0]) == 0.0


@pytest.mark.parametrize("seed", range(10))
def test_nondominated_rows_are_those_of_torch(seed):
    scores = np.round(np.random.default_rng(seed).uniform(0, 1, (50, 2)), 1 + seed % 2)
    expected = pareto.nondominated(torch.from_numpy(scores)).numpy()
    assert (sweep.nondominated(*scores.T) == expected).all()


# --- what varies -----------------------------------------------------------------------------------------------------


def varied(directory: Path, *runs: dict[str, Any]) -> list[str]:
    for number, settings in enumerate(runs):
        a_run(directory / str(number), **settings)
    return sweep.varying(collected(directory))


def test_settings_that_vary_come_in_a_fixed_order_and_the_seed_is_none(tmp_path):
    config = {"method.generations": 9, "preference": 0.3, "scenario.margin": 1, "device": "cuda", "quiet": True}
    other = {"kernel": "triharmonic", "manipulation": "direct", "method": "cmaes", "seed": 7, "scale": 2.0}
    again = {**other, "config": {**config, "method.generations": 8, "preference": 0.1}}
    found = varied(tmp_path, {"config": {}}, {**other, "config": config}, again)
    assert found == ["mesh", "kernel", "manipulation", "method", "preference", "method.generations"]


def test_a_single_run_varies_in_nothing(tmp_path):
    assert varied(tmp_path, {"config": {}}) == []


def test_the_radius_follows_from_the_kernel_unless_it_varies_within_one(tmp_path):
    cubic = {"kernel": "triharmonic", "support": None}
    assert varied(tmp_path / "a", {}, cubic) == ["kernel"]
    assert varied(tmp_path / "b", {}, cubic, {"support": 0.25}) == ["kernel", "support"]


def test_a_radius_is_what_it_comes_to_however_it_was_given(tmp_path):
    runs = ({"config": {"kernel.support": 0.5}}, {"config": {"scenario.support": 0.7, "kernel.support": "20%"}})
    assert varied(tmp_path, *runs) == []


def test_options_of_a_method_follow_from_it_unless_they_vary_within_one(tmp_path):
    fast, slow = {"config": {"method.generations": 6}}, {"config": {"method.generations": 60}}
    cmaes = {"method": "cmaes", "config": {"method.generations": 300, "method.sigma": 0.1, "preference": "[0,1]"}}
    assert varied(tmp_path / "a", fast, cmaes) == ["method"]
    assert varied(tmp_path / "b", fast, slow, cmaes) == ["method", "method.generations"]


def test_a_mesh_is_the_same_whatever_its_file_is_called(tmp_path):
    runs = ({"config": {"scenario.template": "car.vtp"}}, {"config": {"scenario.template": "/there/car.vtp"}})
    assert varied(tmp_path, *runs) == []


def test_settings_that_happen_to_go_together_are_both_listed(tmp_path):
    runs = ({"manipulation": "direct"}, {"kernel": "triharmonic", "support": None})
    assert varied(tmp_path, *runs) == ["kernel", "manipulation"]


# --- tables ----------------------------------------------------------------------------------------------------------

SERIES = ["random", "random", "nsga2", "nsga2", "nsga2", "lloyd"]
R, P = [0.1, NAN, 0.25, 0.5, 0.75, 0.875], [0.1, 0.5, 0.75, 0.625, 0.25, 0.125]


def test_a_line_of_each_series_tells_what_its_rows_come_to(tmp_path):
    a_run(tmp_path / "0", R, P, series=SERIES, method="panel", seed=5)
    whole, chance, search, single = sweep.lines(collected(tmp_path))
    assert [line.series for line in (whole, chance, search, single)] == ["all", "random", "nsga2", "lloyd"]
    area = 0.25 * 0.75 + 0.25 * 0.625 + 0.25 * 0.25
    assert (whole.hypervolume, search.hypervolume) == (area + 0.125 * 0.125, area)
    assert (chance.hypervolume, single.hypervolume) == (pytest.approx(0.01), 0.875 * 0.125)
    assert [line.setups for line in (whole, chance, search, single)] == [5, 1, 3, 1]
    assert [line.nondominated for line in (whole, chance, search, single)] == [4, 0, 3, 1]
    assert (whole.best_regularity, whole.best_improvement_potential) == (0.875, 0.75)
    assert (search.best_regularity, search.best_improvement_potential) == (0.75, 0.75)
    assert (search.knee_regularity, search.knee_improvement_potential) == (0.5, 0.625)
    assert (single.knee_regularity, single.knee_improvement_potential) == (0.875, 0.125)
    assert (whole.run, whole.seed, whole.evaluations, whole.failed_evaluations) == ("0", 5, 100, 1)
    assert (whole.seconds, whole.stop_reason) == (2.5, "budget")


def test_a_series_without_scores_has_a_line_of_nothing(tmp_path):
    a_run(tmp_path / "0", [0.5, NAN], [0.5, NAN], series=["gradient", "random"])
    *_, nothing = sweep.lines(collected(tmp_path))
    assert (nothing.series, nothing.setups, nothing.hypervolume) == ("random", 0, 0.0)
    assert math.isnan(nothing.best_regularity)
    assert math.isnan(nothing.knee_improvement_potential)


@pytest.mark.parametrize("seed", range(5))
def test_the_knee_is_that_of_the_record_and_of_each_series(tmp_path, seed):
    scores = np.random.default_rng(seed).uniform(0, 1, (40, 2))
    run = a_run(tmp_path / "0", *scores.T, series=["nsga2"] * 20 + ["cmaes"] * 20)
    whole, *parts = sweep.lines(collected(tmp_path))
    row = knee(read(run))
    assert [whole.knee_regularity, whole.knee_improvement_potential] == scores[row].tolist()
    for line, rows in zip(parts, (scores[:20], scores[20:]), strict=True):
        found = rows[pareto.knee(torch.from_numpy(rows))].tolist()
        assert [line.knee_regularity, line.knee_improvement_potential] == found


def test_medians_and_quartiles_are_those_over_the_seeds(tmp_path):
    for seed, area in enumerate([0.04, 0.25, 0.16, 0.09]):
        square(tmp_path / "direct" / str(seed), area, seed=seed, manipulation="direct", seconds=10.0 * seed)
    square(tmp_path / "indirect", 0.01)
    whole, series, single, _ = sweep.groups(collected(tmp_path))
    assert (whole.series, series.series) == ("all", "gradient")
    assert whole.runs == ("direct/0", "direct/1", "direct/2", "direct/3")
    assert (whole.seeds, single.seeds) == (4, 1)
    assert whole.spreads["hypervolume"] == pytest.approx((0.125, 0.0775, 0.1825))  # of 0.04, 0.09, 0.16, 0.25
    assert whole.spreads["best_regularity"] == pytest.approx((0.35, 0.275, 0.425))
    assert whole.spreads["knee_improvement_potential"] == pytest.approx((0.35, 0.275, 0.425))
    assert whole.spreads["seconds"] == (15.0, 7.5, 22.5)
    assert single.spreads["hypervolume"] == pytest.approx((0.01, 0.01, 0.01))


def test_runs_on_different_meshes_are_never_one_group(tmp_path):
    a_run(tmp_path / "0", seed=0)
    a_run(tmp_path / "1", seed=1, scale=2.0)
    assert [group.runs for group in sweep.groups(collected(tmp_path))] == [("0",), ("0",), ("1",), ("1",)]


def test_values_that_are_missing_do_not_count(tmp_path):
    assert sweep.spread([1.0, NAN, 2.0]) == (1.5, 1.25, 1.75)
    assert all(map(math.isnan, sweep.spread([NAN])))


def test_the_same_job_run_again_and_one_that_was_stopped_are_told(tmp_path):
    for name, settings in {"0": {}, "1": {}, "2": {"seed": 1}, "3": {"manipulation": "direct"}}.items():
        a_run(tmp_path / name, **settings)
    a_run(tmp_path / "4", seed=2, stop_reason="interrupted by SIGINT")
    members = collected(tmp_path)
    assert sweep.warnings(members) == [
        "0, 1: these runs have the same settings and seed; each of them counts",
        "4: this run was stopped early (interrupted by SIGINT); it counts like the others",
    ]
    whole = sweep.groups(members)[0]
    assert (len(whole.runs), whole.seeds) == (4, 3)


def table(content: bytes) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(content.decode())))


def test_the_tables_keep_all_digits_and_leave_cells_empty(tmp_path):
    third = 1 / 3
    a_run(tmp_path / "0", [third], [1.0], config={"method.generations": 6})
    a_run(tmp_path / "1", [NAN], [NAN], config={"method.generations": 7}, kernel="triharmonic", support=None)
    members = collected(tmp_path)
    runs, medians = sweep.table_of_runs(sweep.lines(members)), sweep.table_of_medians(sweep.groups(members))
    first, _, last, _ = table(runs)
    assert float(first["best_regularity"]) == third
    assert (first["run"], first["kernel"], first["support"], first["series"]) == ("0", "wendland", "0.5", "all")
    assert (last["support"], last["best_regularity"], last["hypervolume"]) == ("", "", "0.0")
    first, _, last, _ = table(medians)
    assert float(first["hypervolume_q1"]) == third
    assert (first["runs"], first["seeds"], last["knee_regularity_median"]) == ("1", "1", "")


def test_the_tables_have_a_column_for_each_setting_that_varies(tmp_path):
    for number, generations in enumerate((6, 7)):
        a_run(tmp_path / str(number), config={"method.generations": generations})
    members = collected(tmp_path)
    for content in (
        sweep.table_of_runs(sweep.lines(members)),
        sweep.table_of_medians(sweep.groups(members)),
    ):
        assert [row["method.generations"] for row in table(content)] == ["6", "6", "7", "7"]


# --- which is best ---------------------------------------------------------------------------------------------------


def sentence(directory: Path, start: str) -> str:
    """The one sentence that begins so."""
    (sentence,) = [line for line in sweep.best(sweep.groups(collected(directory))) if line.startswith(start)]
    return sentence.removeprefix(start)


def several(directory: Path, areas: Any, **settings: Any) -> None:
    for seed, area in enumerate(areas):
        square(directory / str(seed), area, seed=seed, **settings)


def test_a_lead_is_clear_where_each_run_is_ahead_of_each_of_theirs(tmp_path):
    several(tmp_path / "a", [0.20, 0.22, 0.24, 0.26, 0.28], manipulation="direct")
    several(tmp_path / "b", [0.10, 0.12, 0.14, 0.16, 0.19])
    assert sentence(tmp_path, "best hypervolume: ") == (
        "direct: median 0.24 (quartiles 0.22 to 0.26, 5 seeds); next indirect with 0.14; "
        "the lead is clear: each of its runs is ahead of each of theirs"
    )


def test_a_lead_is_not_clear_where_runs_overlap(tmp_path):
    several(tmp_path / "a", [0.20, 0.22, 0.24, 0.26, 0.28], manipulation="direct")
    several(tmp_path / "b", [0.10, 0.12, 0.14, 0.16, 0.201])
    assert sentence(tmp_path, "best hypervolume: ").endswith("the lead is not clear: their runs overlap")


@pytest.mark.parametrize("seeds", [2, 3, 4])
def test_few_seeds_prove_no_lead(tmp_path, seeds):
    several(tmp_path / "a", [0.9] * seeds, manipulation="direct")
    several(tmp_path / "b", [0.1] * seeds)
    assert sentence(tmp_path, "best hypervolume: ").endswith(f"{seeds} seeds cannot prove the lead, 5 or more could")


def test_a_manipulation_does_not_lead_in_improvement_potential(tmp_path):
    for number, (manipulation, P) in enumerate([("direct", 0.7), ("indirect", 0.6)]):
        a_run(tmp_path / str(number), [0.5], [P], manipulation=manipulation)
    text = sentence(tmp_path, "best improvement potential: ")
    assert text == "direct: 0.7 (1 seed); next indirect with 0.6, by chance: P does not depend on the manipulation"


def test_one_seed_shows_no_spread(tmp_path):
    several(tmp_path / "a", [0.25], manipulation="direct")
    several(tmp_path / "b", [0.16])
    assert sentence(tmp_path, "best regularity: ") == (
        "direct: 0.5 (1 seed); next indirect with 0.4; 1 seed cannot prove the lead, 5 or more could"
    )


def test_what_is_equal_is_level(tmp_path):
    a_run(tmp_path / "0", [0.5], [0.7], manipulation="direct")
    a_run(tmp_path / "1", [0.4], [0.7 * (1 + 1e-14)])
    found = sentence(tmp_path, "best improvement potential: ")
    assert found in ("direct: 0.7 (1 seed); tied with it: indirect", "indirect: 0.7 (1 seed); tied with it: direct")


def test_a_single_group_has_nothing_to_be_compared_with(tmp_path):
    several(tmp_path, [0.1, 0.2])
    sentences = sweep.best(sweep.groups(collected(tmp_path)))
    assert len(sentences) == 3
    assert sentences[0] == ("hypervolume: median 0.15 (quartiles 0.125 to 0.175, 2 seeds)")


def test_settings_are_compared_in_pairs_that_differ_in_nothing_else(tmp_path):
    areas = {("direct", 3): 0.50, ("indirect", 3): 0.40, ("direct", 4): 0.30, ("indirect", 4): 0.20}
    areas |= {("direct", 5): 0.30, ("indirect", 5): 0.32, ("direct", 6): 0.9}
    for (manipulation, sigma), area in areas.items():
        config = {"scenario.margin": sigma}
        square(tmp_path / f"{manipulation}{sigma}", area, manipulation=manipulation, config=config)
    text = sentence(tmp_path, "manipulation, by median hypervolume: ")
    assert text == "direct beats indirect in 2 of 3 pairs, by a median factor of 1.25"
    assert sentence(tmp_path, "scenario.margin, by median hypervolume: ").startswith("6 beats 3 in the only pair, by")


def test_the_winner_of_a_comparison_need_not_hold_the_best_run(tmp_path):
    areas = [("direct", 3, 0.9), ("direct", 4, 0.1), ("direct", 5, 0.1), *(("indirect", s, 0.2) for s in (3, 4, 5))]
    for manipulation, margin, area in areas:
        config = {"scenario.margin": margin}
        square(tmp_path / f"{manipulation}{margin}", area, manipulation=manipulation, config=config)
    text = sentence(tmp_path, "manipulation, by median hypervolume: ")
    assert text == "indirect beats direct in 2 of 3 pairs, by a median factor of 2"


def test_a_comparison_without_a_winner_says_so(tmp_path):
    for manipulation, margin, area in [
        ("direct", 3, 0.3),
        ("direct", 4, 0.2),
        ("indirect", 3, 0.2),
        ("indirect", 4, 0.3),
    ]:
        config = {"scenario.margin": margin}
        square(tmp_path / f"{manipulation}{margin}", area, manipulation=manipulation, config=config)
    text = sentence(tmp_path, "manipulation, by median hypervolume: ")
    assert " is not clearly ahead of " in text
    assert "(ahead in 1 of 2 pairs, a median factor of 1.08)" in text


def test_a_kernel_is_compared_with_its_radius(tmp_path):
    square(tmp_path / "0", 0.2, support=0.5, config={})
    square(tmp_path / "1", 0.4, support=0.25, config={"kernel.support": "10%"})
    square(tmp_path / "2", 0.1, kernel="triharmonic", support=None, config={})
    assert sentence(tmp_path, "kernel and support, by median hypervolume: ") == (
        "wendland, support 0.25 (10%) beats wendland, support 0.5 in the only pair, by a factor of 2; "
        "beats triharmonic in the only pair, by a factor of 4; "
        "that is the smallest radius tried: try a smaller one too"
    )


def test_radii_that_look_alike_are_told_apart(tmp_path):
    square(tmp_path / "0", 0.2, support=0.500001)
    square(tmp_path / "1", 0.4, support=0.500002)
    text = sentence(tmp_path, "support, by median hypervolume: ")
    assert text.startswith("0.5 beats 0.5 in the only pair, by a factor of 2; that is the largest radius tried")


def test_what_goes_together_cannot_be_told_apart(tmp_path):
    square(tmp_path / "0", 0.2, manipulation="direct")
    square(tmp_path / "1", 0.1, kernel="triharmonic", support=None)
    for key in ("kernel", "manipulation"):
        assert sentence(tmp_path, f"{key}: ").startswith("no two groups differ in this alone")


def test_random_setups_lead_nothing_and_are_a_baseline_of_methods(tmp_path):
    square(tmp_path / "0", 0.81, method="random")
    square(tmp_path / "1", 0.25, method="gradient")
    square(tmp_path / "2", 0.16, method="nsga2")
    assert sentence(tmp_path, "best hypervolume: ").startswith("gradient: 0.25 (1 seed); next nsga2 with 0.16")
    text = sentence(tmp_path, "method, by median hypervolume: ")
    assert text.startswith("gradient loses to random in the only pair, by a factor of 3.24; beats nsga2")


def test_random_setups_are_compared_where_there_is_nothing_else(tmp_path):
    square(tmp_path / "0", 0.81, method="random", manipulation="direct")
    square(tmp_path / "1", 0.25, method="random")
    assert sentence(tmp_path, "best hypervolume: ").startswith("direct: 0.81 (1 seed); next indirect with 0.25")
    assert sentence(tmp_path, "manipulation, by median hypervolume: ").startswith("direct beats indirect")


def test_random_rows_of_a_search_count_as_its_own(tmp_path):
    a_run(tmp_path / "0", [0.9, 0.5], [0.1, 0.5], series=["random", "gradient"], manipulation="direct")
    a_run(tmp_path / "1", [0.6], [0.6])
    assert sentence(tmp_path, "best regularity: ").startswith("direct: 0.9 (1 seed); next indirect with 0.6")


def test_the_searches_of_a_panel_are_compared_with_each_other(tmp_path):
    for seed, manipulation in itertools.product((0, 1), ("direct", "indirect")):
        run, more = tmp_path / f"{manipulation}{seed}", 0.125 * (manipulation == "direct")
        a_run(
            run,
            [0.1, 0.5, 0.25, 0.75 + more],
            [0.1, 0.5, 0.875, 0.125],
            series=["random", "nsga2", "nsga2", "lloyd"],
            method="panel",
            manipulation=manipulation,
            seed=seed,
        )
    assert sentence(tmp_path, "best regularity: ") == (
        "direct, lloyd: median 0.875 (quartiles 0.875 to 0.875, 2 seeds); next indirect, lloyd with 0.75; "
        "2 seeds cannot prove the lead, 5 or more could"
    )
    assert sentence(tmp_path, "best hypervolume: ").startswith("direct, nsga2: median 0.3438 (")
    assert sentence(tmp_path, "series, by median hypervolume: ") == (
        "nsga2 beats lloyd in 2 of 2 pairs, by a median factor of 3.4 "
        "(lloyd: only one setup per run, which by itself has little hypervolume)"
    )
    assert sentence(tmp_path, "manipulation, by median hypervolume: ").startswith(
        "direct beats indirect in the only pair"
    )


def test_each_mesh_has_sentences_of_its_own(tmp_path):
    for number, scale in enumerate((1.0, 3.0)):
        square(tmp_path / str(number) / "a", 0.2 + number / 10, manipulation="direct", scale=scale)
        square(tmp_path / str(number) / "b", 0.25, scale=scale)
    sentences = sweep.best(sweep.groups(collected(tmp_path)))
    one, other = dict.fromkeys(member.settings["mesh"] for member in collected(tmp_path))
    starts = [f"plane, 4 vertices, mesh {mesh}: " for mesh in (one, other)]
    assert [sum(line.startswith(start) for line in sentences) for start in starts] == [4, 4]
    assert sentences[0].startswith(f"{starts[0]}best hypervolume: indirect: 0.25")
    assert sentences[4].startswith(f"{starts[1]}best hypervolume: direct: 0.3")


def test_scores_that_are_all_missing_or_zero_lead_nothing(tmp_path):
    a_run(tmp_path / "0", [NAN], [NAN], manipulation="direct")
    a_run(tmp_path / "1", [0.0], [0.5])
    assert sentence(tmp_path, "best regularity: ") == "0 (1 seed)"
    assert sentence(tmp_path, "manipulation, by median hypervolume: ") == "direct is tied with indirect"
