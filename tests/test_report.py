"""The content of report.html and how it is put together; that it works in a browser is in test_report_page.py."""

import base64
import html.parser
import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
import torch
from scipy.spatial.distance import cdist
from test_figures import change, write

from rbfevo.errors import UserError
from rbfevo.figures import __main__ as command_line
from rbfevo.figures.report import content, page
from rbfevo.figures.report.surface import surface_of
from rbfevo.recorded.record import Record, read
from rbfevo.scoring.pareto import nondominated


class Parts(html.parser.HTMLParser):
    """The elements of a page, and the text of its scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: dict[str | None, str] = {}
        self._script: str | None = None
        self._inside = False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._inside = tag == "script"
        self._script = dict(attrs).get("id")

    def handle_endtag(self, tag):
        self._inside = False

    def handle_data(self, data):
        if self._inside:
            self.scripts[self._script] = self.scripts.get(self._script, "") + data


def page_content(run: Path) -> dict[str, Any]:
    """The content that the page of a run embeds."""
    return json.loads(Parts(page(read(run), run)).scripts["content"])


def numbers(text: str, kind: str = "<f8"):
    return np.frombuffer(base64.b64decode(text), kind)


def test_a_page_fetches_nothing(tmp_path):
    parts = Parts(page(read(write(tmp_path)), tmp_path))
    links = [value for _, attributes in parts.elements for key, value in attributes.items() if key in ("src", "href")]
    assert links == ["data:,"]
    policy = next(a["content"] for tag, a in parts.elements if a.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None
    assert policy.startswith("default-src 'none'")
    assert "http" not in policy


@pytest.mark.parametrize("d", [2, 3])
def test_numbers_arrive_as_they_are(tmp_path, d):
    record, seen = read(write(tmp_path, d=d)), page_content(tmp_path)
    run, mesh = seen["runs"][0], seen["meshes"][0]
    assert np.array_equal(numbers(run["centers"]).reshape(record.centers.shape), record.centers)
    assert np.array_equal(numbers(run["regularity"]), record.regularity)
    assert np.array_equal(numbers(run["potential"]), record.improvement_potential)
    assert np.array_equal(numbers(mesh["vertices"]).reshape(record.vertices.shape), record.vertices)
    assert np.array_equal(numbers(mesh["gradient"]).reshape(record.gradient.shape), record.gradient)
    assert np.array_equal(numbers(mesh["faces"], "<u4").reshape(record.faces.shape), record.faces)
    assert run["method"] == record.method.tolist()
    assert [value == 1 for value in run["nondominated"]] == record.nondominated.tolist()


def test_weights_are_told_where_they_differ(tmp_path):
    assert page_content(write(tmp_path / "one"))["meshes"][0]["weights"] is None
    record = read(write(tmp_path / "two", uniform=False))
    assert np.array_equal(numbers(page_content(tmp_path / "two")["meshes"][0]["weights"]), record.weights)


def test_setups_without_scores_or_centers_are_left_out(tmp_path):
    def holed(values):
        values = values.copy()
        values[[1, 5]] = np.nan
        return values

    change(write(tmp_path), regularity=holed)
    assert page_content(tmp_path)["runs"][0]["rows"] == [row for row in range(24) if row not in (1, 5)]


def test_a_run_without_usable_setups_has_no_page(tmp_path):
    change(write(tmp_path), regularity=np.full(24, np.nan))
    with pytest.raises(UserError, match="no setup has finite centers and scores"):
        page(read(tmp_path), tmp_path)


@pytest.mark.parametrize("text", ["</script><b>", "<!--<script>", "{{plotly}}", "\u2028 é 漢", "\\"])
def test_words_of_a_run_cannot_break_the_page(tmp_path, text):
    write(tmp_path, notes={"a": text}, warnings=[text], stop_reason=text)
    seen = page_content(tmp_path)["runs"][0]["made"]
    assert (seen["notes"]["a"], seen["warnings"][0], seen["facts"]["stopped by"]) == (text, text, text)


def test_the_command_of_a_run_can_be_pasted_into_a_shell(tmp_path):
    (write(tmp_path) / ".hydra").mkdir()
    (tmp_path / ".hydra" / "overrides.yaml").write_text(
        "- scenario=plane\n- 'preference=[0, 0.5]'\n- scenario.scan='a b.obj'\n"
    )
    command = page_content(tmp_path)["runs"][0]["made"]["command"]
    script = "import sys; print(sys.argv[1:])"
    printed = subprocess.run(
        ["bash", "-c", command.replace("python -m rbfevo", f"{sys.executable} -c '{script}'")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert printed.stdout.strip() == "['scenario=plane', 'preference=[0, 0.5]', \"scenario.scan='a b.obj'\"]"


@pytest.mark.parametrize("wrong", ["no: list", "- [", None])
def test_a_run_that_does_not_tell_its_command_has_a_page(tmp_path, wrong):
    write(tmp_path)
    if wrong is not None:
        (tmp_path / ".hydra").mkdir()
        (tmp_path / ".hydra" / "overrides.yaml").write_text(wrong)
    assert page_content(tmp_path)["runs"][0]["made"]["command"] is None


def test_an_unknown_kernel_has_a_page_of_centers(tmp_path):
    run = page_content(_renamed(tmp_path))["runs"][0]
    assert run["known"] is False
    assert len(run["rows"]) == 24


def _renamed(run: Path) -> Path:
    write(run)
    summary = json.loads((run / "summary.json").read_text())
    (run / "summary.json").write_text(json.dumps(summary | {"kernel": "gaussian"}))
    return run


def test_centers_near_a_symmetry_plane_are_put_on_it(tmp_path):
    def near(centers):
        centers = centers.copy()
        centers[:, 0, 1] = 1e-15
        return centers

    change(write(tmp_path, d=3, symmetry={"axis": "y", "at": 0.0}), centers=near)
    run = page_content(tmp_path)["runs"][0]
    centers = numbers(run["centers"]).reshape(24, 6, 3)
    assert run["mirror"] == {"axis": 1, "at": 0.0}
    assert (centers[:, 0, 1] == 0).all()
    assert (centers[:, 1:, 1] != 0).all()


# --- large meshes ----------------------------------------------------------------------------------------------------


def large(faces: bool = True) -> Record:
    """A sphere of 5,000 vertices or so, with weights."""
    ball = pyvista.Sphere(theta_resolution=70, phi_resolution=70)
    vertices = np.asarray(ball.points, float)
    triangles = np.asarray(ball.regular_faces)
    n = len(vertices)
    weights = np.random.default_rng(1).uniform(0.5, 2.0, n)
    none, box = np.empty(0), np.ones(3)
    return Record(
        centers=np.empty((0, 1, 3)),
        regularity=none,
        improvement_potential=none,
        method=none,
        preference=none,
        nondominated=none,
        vertices=vertices,
        faces=triangles if faces else triangles[:0],
        gradient=np.ones((n, 3)),
        weights=weights,
        lower=-box,
        upper=box,
        summary={},
    )


def test_a_mesh_that_is_small_enough_is_shown_whole():
    record = large()
    whole = surface_of(record)
    assert np.array_equal(whole.rows, np.arange(len(record.vertices)))
    assert whole.faces is record.faces
    assert whole.weights is record.weights


@pytest.mark.parametrize("faces", [True, False])
def test_a_large_mesh_is_shown_by_fewer_of_its_vertices(faces):
    record = large(faces)
    fewer = surface_of(record, 1000)
    assert 500 < len(fewer.rows) <= 1000
    assert len(np.unique(fewer.rows)) == len(fewer.rows)
    nearest = cdist(record.vertices, record.vertices[fewer.rows]).argmin(axis=1)
    expected = np.bincount(nearest, record.weights, len(fewer.rows))
    assert fewer.weights.sum() == pytest.approx(record.weights.sum())
    assert np.median(np.abs(fewer.weights - expected)) < 1e-12  # all but ties
    assert (len(fewer.faces) > 0) == faces


def test_the_fewer_faces_keep_the_shape():
    record = large()
    fewer = surface_of(record, 1000)
    mesh = pyvista.PolyData.from_regular_faces(record.vertices[fewer.rows], fewer.faces)
    whole = pyvista.PolyData.from_regular_faces(record.vertices, record.faces)
    assert mesh.area == pytest.approx(whole.area, rel=0.03)


def test_a_page_of_20000_vertices_and_300_setups_is_below_15_megabytes(tmp_path):
    ball = pyvista.Sphere(theta_resolution=142, phi_resolution=142)
    vertices, rng = np.asarray(ball.points, float), np.random.default_rng(0)
    assert len(vertices) > 19_800
    p, m = 300, 25
    g = rng.normal(size=vertices.shape)
    mesh: dict[str, Any] = {
        "vertices": vertices,
        "faces": np.asarray(ball.regular_faces),
        "gradient": g / np.linalg.norm(g),
    }
    mesh |= {"lower": -np.ones(3), "upper": np.ones(3), "weights": rng.uniform(1, 2, len(vertices))}
    np.savez(tmp_path / "scenario.npz", **mesh)
    setups: dict[str, Any] = {
        "centers": rng.normal(size=(p, m, 3)),
        "method": np.repeat("gradient", p),
        "preference": np.full(p, np.nan),
    }
    setups |= {name: rng.uniform(size=p) for name in ("regularity", "improvement_potential", "variability")}
    np.savez(tmp_path / "setups.npz", **setups, nondominated=np.ones(p, bool))
    (tmp_path / "summary.json").write_text(json.dumps({"scenario": "mesh", "kernel": "wendland", "support": 1.0}))
    assert command_line.main([str(tmp_path), "--only", "report"]) == 0
    assert 5e6 < (tmp_path / "report.html").stat().st_size < 15e6


def many(run: Path, copies: int, m: int = 6) -> Path:
    """A run of 24 times as many setups, each as often as the others."""
    write(run, m=m)
    with np.load(run / "setups.npz") as archive:
        repeated: dict[str, Any] = {name: np.concatenate([array] * copies) for name, array in archive.items()}
    rng = np.random.default_rng(0)
    repeated["regularity"] = repeated["regularity"] * rng.uniform(0.5, 1, len(repeated["regularity"]))
    scores = np.stack([repeated["regularity"], repeated["improvement_potential"]], axis=1)
    repeated["nondominated"] = nondominated(torch.from_numpy(scores)).numpy()
    np.savez(run / "setups.npz", **repeated)
    return run


def test_of_too_many_setups_dominated_ones_are_left_out(tmp_path):
    record = read(many(tmp_path, 250))
    seen = page_content(tmp_path)
    rows = np.array(seen["runs"][0]["rows"])
    assert 3000 < len(rows) <= 4100
    assert set(np.flatnonzero(record.nondominated)) <= set(rows)
    assert seen["left_out"] == 6000 - len(rows)
    assert f"{seen['left_out']:,} dominated setups left out" in seen["subtitle"]


# --- written whole ---------------------------------------------------------------------------------------------------


def test_a_page_that_cannot_be_written_is_one_line(tmp_path, capsys):
    (write(tmp_path) / "report.html").mkdir()
    assert command_line.main([str(tmp_path), "--only", "report"]) == 2
    line = capsys.readouterr().err
    assert "report.html cannot be written" in line
    assert line.count("\n") == 1


def test_the_parts_of_the_page_are_packaged():
    root = Path(content.__file__).parents[3]
    packages = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["setuptools"]
    patterns = packages["package-data"]["rbfevo.figures.report"]
    folder = Path(content.__file__).parent
    packaged = {path for pattern in patterns for path in folder.glob(pattern) if path.is_file()}
    assert packaged == {path for path in (folder / "page").rglob("*") if path.is_file()}
    assert "rbfevo.figures.report" in packages["packages"]
