"""The paper's figures, drawn from small studies: their content, their captions, missing series, and failures."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from scipy.ndimage import label
from studies import drawn, full_study

from benchmarks.panels import PANELS
from rbfevo.figures import style
from rbfevo.scenarios.face import face
from rbfevo.scoring.pareto import nondominated
from reproduction import figures, runs
from reproduction.figures import __main__ as command_line
from reproduction.figures import exhibits, fronts, functions, processes, shapes, wording
from reproduction.study import Study, panels_of

INDIRECT = panels_of("plane", "local", "indirect")[0]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A study of small scenarios in which every run is there, written once."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        yield full_study(tmp_path_factory.mktemp("whole"), monkeypatch).out


@pytest.fixture
def study(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Study:
    """That study, to be changed and drawn into; its pictures are coarse, to be quick."""
    monkeypatch.setattr(style, "DPI", 50)
    return Study(shutil.copytree(whole, tmp_path, dirs_exist_ok=True))


@pytest.fixture
def empty(tmp_path: Path) -> Path:
    """A directory of a study in which every series is missing, and which other processes can read too."""
    (tmp_path / "study.json").write_text(json.dumps({"budget": "paper"}))
    return tmp_path


def without(study: Study, method: str, scenario: str = "plane") -> Study:
    """The same study without a method's runs on a scenario."""
    for panel in panels_of(scenario):
        for seed in study.budget.seeds:
            shutil.rmtree(study.directory(panel, method, seed), ignore_errors=True)
    return Study(study.out)


def marks(axes: Axes) -> dict[str, np.ndarray]:
    """Where marks are, by label."""
    return {str(series.get_label()): np.asarray(series.get_offsets()) for series in axes.collections}


@pytest.mark.parametrize("figure", figures.FIGURES)
def test_every_figure_is_drawn(study: Study, figure: str) -> None:
    before = set(study.out.iterdir())
    assert command_line.main([str(study.out), "--only", figure, "--no-opengl"]) == 0
    image = imread(study.out / f"{figure}.png")
    assert min(image.shape[:2]) > 100
    assert image[..., :3].std() > 0.02
    assert (study.out / "centers" / f"{figure}.csv").exists() == (figure in command_line.TABLES)
    tables = {study.out / "centers"} if figure in command_line.TABLES else set()
    assert set(study.out.iterdir()) - before == {study.out / f"{figure}.png"} | tables


def test_a_figure_is_drawn_where_every_series_is_missing(empty: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "PAPER", empty / "nowhere")
    assert command_line.main([str(empty), "--only", "figure5"]) == 0
    assert imread(empty / "figure5.png").std() > 0
    assert "Not there: " in figures.captions(Study(empty))["figure5.png"]


def test_captions_name_seeds_budget_and_what_is_missing(study: Study) -> None:
    for seed in study.budget.seeds:
        shutil.rmtree(study.directory(panels_of("plane", "triharmonic", "direct")[0], "gradient", seed))
    captions = figures.captions(without(study, "cmaes"))
    assert list(captions) == [f"{figure}.png" for figure in figures.FIGURES]
    for caption in captions.values():
        assert caption.endswith(" Made by scripts/reproduce --budget tiny.")
    for text in ("seed 0", "reference point (0, 0)", study.budget.description, "gradient search 400 "):
        assert text in captions["figure3.png"]
    assert "Not there: gradient search (triharmonic r² log r direct); CMA-ES." in captions["figure3.png"]
    assert "Not there" not in captions["figure6.png"]
    for text in ("NSGA-II (seeds 0, 1)", "gradient search (seeds 0, 1, not on every panel)", "Not there: CMA-ES."):
        assert text in captions["figure4.png"]
    assert "CMA-ES (seeds 0, 1)" in captions["figure4-face.png"]
    assert "Not there: OLS." in figures.captions(without(study, "ols"))["figure7.png"]


def test_captions_need_no_matplotlib(empty: Path) -> None:
    code = (
        "import sys; sys.modules['matplotlib'] = None\n"
        "from pathlib import Path; from reproduction.figures import captions; from reproduction.study import Study\n"
        "print(captions(Study(Path(sys.argv[1])))['figure7.png'].isascii())"
    )
    done = subprocess.run([sys.executable, "-c", code, str(empty)], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "False", done.stderr


def test_the_best_setups_are_found_over_searches_and_seeds(study: Study) -> None:
    panel = panels_of("plane", "wide", "direct")[0]
    kinds = [(method, seed) for method in ("nsga2", "cmaes", "gradient") for seed in (0, 1)]
    regular = exhibits.most_regular(study, panel)
    assert regular is not None
    assert regular.regularity == max(drawn(panel, *kind).regularity.max() for kind in kinds)
    improvable = exhibits.most_improvable(study, "plane", "wide")
    assert improvable is not None
    every = [drawn(one, *kind) for one in panels_of("plane", "wide") for kind in kinds]
    assert improvable.improvement_potential == max(setups.improvement_potential.max() for setups in every)
    source = drawn(improvable.panel, improvable.method, improvable.seed)
    np.testing.assert_array_equal(source.centers[source.most_improvable], improvable.centers)
    assert wording.origin(improvable._replace(method="cmaes", preference=0.1)) == "CMA-ES, λ = 0.1, seed 0"


@pytest.mark.parametrize(("figure", "panels"), [("figure4", 6), ("figure5-face", 3), ("figure7", 3)])
def test_tables_hold_the_centers_that_are_drawn(study: Study, figure: str, panels: int) -> None:
    shown = [exhibit for row in exhibits.of_figure(study, figure) for exhibit in row if exhibit is not None]
    lines = list(csv.DictReader(exhibits.table(shown).decode().splitlines()))
    assert len(shown) == panels
    assert len(lines) == 5 * panels
    axes = "xyz" if figure.endswith("face") else "xy"
    assert list(lines[0]) == ["panel", "method", "seed", "criterion", "R", "P", "center", *axes]
    centers = np.array([[float(line[axis]) for axis in axes] for line in lines]).reshape(panels, 5, -1)
    np.testing.assert_array_equal(centers, np.stack([exhibit.centers for exhibit in shown]))
    for exhibit, line in zip(shown, lines[::5], strict=True):
        assert (line["panel"], line["method"]) == (exhibit.panel.name, exhibit.method)
        assert float(line["R"]) == exhibit.regularity


def test_a_panel_shows_every_series_and_leaves_out_what_is_missing(study: Study) -> None:
    assert PANELS[0] == INDIRECT
    shutil.rmtree(study.directory(INDIRECT, "cmaes", 0))
    axes = fronts.picture(Study(study.out), "plane", "caption").axes
    assert len(axes) == 6
    first, second = marks(axes[0]), marks(axes[1])
    assert fronts.SERIES["cmaes"].label not in first
    assert fronts.SERIES["cmaes-full"].label not in second
    assert len(first[fronts.SERIES["cmaes-full"].label]) == 11
    assert len(second[fronts.SERIES["cmaes"].label]) == 11
    front = drawn(INDIRECT, "nsga2", 0)
    kept = nondominated(torch.from_numpy(front.objectives)).numpy()
    places = first[fronts.SERIES["nsga2"].label]
    np.testing.assert_allclose(places, front.objectives[kept][np.argsort(front.regularity[kept])])
    assert "hypervolume: NSGA-II 0." in axes[0].get_title()


def test_what_is_too_low_of_the_initial_population_stands_on_the_edge(
    study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fronts, "ROOM", -0.9)  # cuts into the population
    axes = fronts.picture(study, "plane", "caption").axes[0]
    population = drawn(INDIRECT, "random", 0)
    shown = marks(axes)[fronts.SERIES["random"].label]
    bottom = axes.get_ylim()[0]
    edge = [places for places in marks(axes).values() if len(places) and (places[:, 1] == bottom).all()]
    assert len(edge) == 1
    found = np.sort(np.concatenate([shown[:, 0], edge[0][:, 0]]))
    np.testing.assert_allclose(found, np.sort(population.regularity))
    assert (shown[:, 1] > bottom).all()


def test_the_target_is_the_scan_that_the_sphere_is_to_become() -> None:
    vertices, triangles = shapes.target()
    closest = face(subdivisions=1).closest
    assert closest is not None
    for points in (vertices, vertices[triangles].mean(axis=1)):
        np.testing.assert_allclose(closest(points), points, atol=1e-6)


@pytest.mark.parametrize(
    ("value", "text"), [(0.98375, "0.9838"), (0.0, "0.0000"), (0.003427, "3.43·10⁻³"), (2.33e-6, "2.33·10⁻⁶")]
)
def test_numbers_are_short(value: float, text: str) -> None:
    assert wording.number(value) == text


def test_what_is_no_study_is_one_clear_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line.main([str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "study.json" in line
    (warning,) = figures.draw(tmp_path)
    assert warning.startswith("no figure could be drawn: ")
    assert not any(tmp_path.iterdir())


def test_a_figure_is_drawn_by_a_process_of_its_own(empty: Path) -> None:
    assert processes.draw_one(empty, "figure3") == (0, None)
    assert imread(empty / "figure3.png").shape[1] > 1_500


def test_the_uniform_setup_has_25_centers() -> None:
    canvas = FigureCanvasAgg(functions.picture("caption"))
    canvas.draw()
    red = np.abs(np.asarray(canvas.buffer_rgba())[..., :3] / 255 - to_rgb(style.RED)).max(axis=-1) < 0.1
    assert label(red, output=np.empty(red.shape, np.int32)) == 25


def test_a_process_that_dies_is_reported_and_the_others_go_on(empty: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def command(_: Path, figure: str, *options: str) -> list[str]:
        dies = {"figure4": "kill -SEGV $$", "figure1": '[ "$1" = --no-opengl ] || kill -SEGV $$'}
        return ["sh", "-c", dies[figure], "sh"] if figure in dies else ["true"]

    monkeypatch.setattr(processes, "command", command)
    assert figures.draw(empty) == [
        "figure1.png was drawn without OpenGL: the process was ended by SIGSEGV",
        "figure4.png could not be drawn: the process was ended by SIGSEGV",
    ]
    assert command_line.main([str(empty)]) == 1
