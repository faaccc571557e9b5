"""Figures are drawn from synthetic run directories, written here by NumPy alone, and looked at pixel by pixel."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread
from scipy.interpolate import RBFInterpolator
from scipy.spatial.distance import cdist

from rbfevo import figures
from rbfevo.errors import UserError
from rbfevo.figures import __main__ as command_line
from rbfevo.figures import centers, front, local_error, panels, processes, style, view
from rbfevo.recorded.record import knee, read
from rbfevo.scoring import pareto
from rbfevo.scoring.kernels import triharmonic

SERIES = {
    "random": style.GREEN,
    "nsga2": style.BLUE,
    "gradient": style.BLUE,
    "cmaes": style.MAGENTA,
    "lloyd": style.ORANGE,
    "ols": style.ORANGE,
}


def phi(r, kernel, support, d):
    """Kernel values, written out again so that they are an oracle."""
    if kernel == "wendland":
        return np.where(r < support, (1 - r / support) ** 4 * (4 * r / support + 1), 0.0)
    return r**3 if d == 3 else np.where(r > 0, r * r * np.log(r + (r == 0)), 0.0)


def definition(vertices, g, weights, setup, kernel, support):
    """R of the indirect U, P, and U U^+ g, by NumPy's SVD and pseudoinverse of the weighted U."""
    n, d = vertices.shape
    U = phi(np.linalg.norm(vertices[:, None] - setup[None], axis=2), kernel, support, d)
    root = np.sqrt(weights)[:, None]
    sigma = np.linalg.svd(root * U, compute_uv=False)
    cut = max(n, len(setup)) * np.finfo(float).eps
    fitted = U @ (np.linalg.pinv(root * U, rcond=cut) @ (root * g))
    R = sigma[-1] / sigma[0] if sigma[-1] > cut * sigma[0] else 0.0
    return R, 1 - np.sum((root * (g - fitted)) ** 2), fitted


def write(
    run: Path, *, d=2, k=None, m=6, kernel="wendland", methods=tuple(SERIES), uniform=True, faces=True, **summary
):
    """Write a run directory as DESIGN section 5 describes it, with true scores, and return it."""
    rng = np.random.default_rng(7)
    if d == 2:
        x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, 13), np.linspace(0, 2, 21), indexing="ij"))
        vertices, (lower, upper) = np.stack([x, y], axis=1), np.array([[0.0, 0.0], [1.0, 2.0]])
        corner = np.arange(12 * 21).reshape(12, 21)[:, :-1].ravel()
        triangles = np.concatenate([corner[:, None] + [0, 21, 22], corner[:, None] + [0, 22, 1]])
        g = np.maximum(0, np.cos(3 * x) * y)[:, None] * np.ones(k or 1)
    else:
        ball = trimesh.creation.icosphere(subdivisions=2)
        vertices, triangles = np.array(ball.vertices), np.array(ball.faces)
        lower, upper = np.array([[-1.0] * 3, [1.0] * 3])
        g = (vertices * [0.5, 0.1, 0.4] * (vertices[:, 2:] > 0))[:, : k or 3]
    weights = np.ones(len(vertices)) if uniform else rng.uniform(0.2, 3.0, len(vertices))
    norm = float(np.sqrt((weights[:, None] * g**2).sum()))
    g = g / norm
    support = 0.6 if kernel == "wendland" else None
    method = np.repeat(methods, 4)
    setups = rng.uniform(lower, upper, (len(method), m, d))
    R, P = np.array([definition(vertices, g, weights, setup, kernel, support)[:2] for setup in setups]).T
    better = (R[:, None] >= R) & (P[:, None] >= P) & ((R[:, None] > R) | (P[:, None] > P))
    run.mkdir(parents=True, exist_ok=True)
    np.savez(
        run / "setups.npz",
        centers=setups,
        regularity=R,
        improvement_potential=P,
        variability=np.ones(len(R)),
        method=method,
        preference=np.where(method == "cmaes", 0.25, np.nan),
        nondominated=~better.any(axis=0),
    )
    mesh = {"vertices": vertices, "faces": triangles if faces else triangles[:0], "gradient": g, "weights": weights}
    np.savez(run / "scenario.npz", **mesh, lower=lower, upper=upper)
    content = {
        "scenario": "face" if d == 3 else "plane",
        "kernel": kernel,
        "support": support,
        "manipulation": "indirect",
    }
    content |= {"method": "panel", "seed": 3, "hypervolume": 0.625, "gradient_norm": norm, **summary}
    (run / "summary.json").write_text(json.dumps(content))
    return run


def change(run: Path, file: str = "setups.npz", **arrays) -> Path:
    """Replace arrays of a run directory: by an array, or by what a function makes of the old one."""
    with np.load(run / file) as archive:
        old: dict[str, Any] = dict(archive)
    new: dict[str, Any] = {key: made(old[key]) if callable(made) else made for key, made in arrays.items()}
    np.savez(run / file, **old | new)
    return run


def pixels(figure: Figure):
    """What a figure shows, [height, width, 3] in [0, 1]."""
    canvas = FigureCanvasAgg(figure)
    with style.typography():
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3] / 255.0


def amount(image, color, tolerance=0.03):
    """How many pixels have a colour."""
    return int((np.abs(image[..., :3] - to_rgb(color)).max(axis=-1) < tolerance).sum())


def colour_bars(figure: Figure):
    return [axes for axes in figure.axes if axes.get_ylabel().startswith(("height", "local error"))]


def legend(figure: Figure) -> list[str]:
    found = figure.axes[0].get_legend()
    return [text.get_text() for text in found.get_texts()] if found else []


def dots(figure: Figure):
    """Where the first axes have marks, by label."""
    marks = {str(series.get_label()): np.asarray(series.get_offsets()) for series in figure.axes[0].collections}
    return {label: places for label, places in marks.items() if places.size}


def ink(figure: Figure, color):
    """How many pixels inside the first axes have a colour."""
    image = pixels(figure)
    box = figure.axes[0].get_window_extent()
    height = len(image)
    return amount(image[height - int(box.y1) : height - int(box.y0), int(box.x0) : int(box.x1)], color)


# --- what a setup leaves ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("block", [local_error.BLOCK, 50])
@pytest.mark.parametrize("uniform", [True, False])
@pytest.mark.parametrize("kernel", ["wendland", "triharmonic"])
@pytest.mark.parametrize(("d", "k"), [(2, 1), (3, 3), (3, 1)])
def test_what_is_reached_equals_the_pseudoinverse(tmp_path, monkeypatch, d, k, kernel, uniform, block):
    monkeypatch.setattr(local_error, "BLOCK", block)
    record = read(write(tmp_path, d=d, k=k, kernel=kernel, uniform=uniform))
    for index in (0, 9, 20):
        arguments = record.vertices, record.gradient, record.weights, record.centers[index]
        expected = definition(*arguments, kernel, record.summary["support"])[2]
        found = local_error.reached(record, index)
        np.testing.assert_allclose(found, expected, atol=1e-10)
        left = (record.weights * local_error.local_error(record.gradient - found) ** 2).sum()
        assert left == pytest.approx(1 - record.improvement_potential[index], abs=1e-10)


def test_duplicate_and_out_of_reach_centers_leave_what_the_others_leave(tmp_path):
    change(
        write(tmp_path, m=4), centers=lambda old: np.concatenate([old[:, :2], old[:, :1], 0 * old[:, :1] + 9], axis=1)
    )
    record = read(tmp_path)
    arguments = record.vertices, record.gradient, record.weights, record.centers[0, :2]
    np.testing.assert_allclose(local_error.reached(record, 0), definition(*arguments, "wendland", 0.6)[2], atol=1e-12)


@pytest.mark.parametrize(("d", "name"), [(2, "thin_plate_spline"), (3, "cubic")])
def test_triharmonic_interpolates_as_scipys_kernel(d, name):
    places, queries, values = np.split(np.random.default_rng(1).uniform(size=(21, d)), [7, 14])
    weights = np.linalg.solve(triharmonic(d)(cdist(places, places)), values)
    found = triharmonic(d)(cdist(queries, places)) @ weights
    np.testing.assert_allclose(found, RBFInterpolator(places, values, kernel=name, degree=-1)(queries), atol=1e-9)


# --- front.png -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", SERIES)
def test_every_method_is_drawn_in_its_colour(tmp_path, method):
    record = read(write(tmp_path, methods=(method,)))
    image = front.picture(record)
    assert ink(image, SERIES[method]) > 40
    for other in set(SERIES.values()) - {SERIES[method]}:
        assert ink(image, other) == 0


def test_rows_with_a_preference_are_triangles_whatever_found_them(tmp_path):
    record = read(change(write(tmp_path, methods=("gradient",)), preference=np.array([0.1, 0.5, np.nan, np.nan])))
    image = front.picture(record)
    assert ink(image, style.MAGENTA) > 40
    assert ink(image, style.BLUE) > 30
    assert legend(image) == ["front (gradient)", "preferences (gradient)", "knee"]


def test_legend_title_and_axes_name_everything(tmp_path):
    image = front.picture(read(write(tmp_path)))
    axes = image.axes[0]
    population, *others = legend(image)
    assert population == "initial population"
    assert set(others) == {"front (nsga2)", "front (gradient)", "preferences (cmaes)", "Lloyd", "OLS", "knee"}
    assert axes.get_ylabel() == "improvement potential"
    assert axes.get_xlabel().startswith("regularity")
    labels = " ".join(text.get_text() for text in image.texts)
    for word in ("plane", "Wendland", "0.6", "indirect", "hypervolume 0.625", "6 centers", "seed 3"):
        assert word in labels


@pytest.mark.parametrize("spread", [1.5, 3.5, 9.0])
@pytest.mark.parametrize("zeros", [0, 5])
def test_regularity_is_logarithmic_where_it_spans_more_than_two_decades(tmp_path, spread, zeros):
    R = np.logspace(-spread - 0.3, -0.3, 24)
    R[24 - zeros :] = 0.0
    R[0], R[1] = 10.0 ** (-spread - 0.3), 10.0**-0.3
    record = read(change(write(tmp_path), regularity=R, nondominated=np.arange(24) == 1, method=np.full(24, "nsga2")))
    image = front.picture(record)
    axes = image.axes[0]
    assert axes.get_xscale() == ("log" if spread > 2 else "linear")
    drawn = np.concatenate([places for label, places in dots(image).items() if label != "knee"])
    assert len(drawn) == 24
    low, high = axes.get_xlim()
    assert ((drawn[:, 0] > low) & (drawn[:, 0] < high)).all()
    margin = [text for text in axes.texts if text.get_text() == "R = 0"]
    assert len(margin) == (1 if zeros and spread > 2 else 0)
    if margin:
        place = drawn[:, 0].min()
        assert (drawn[:, 0] == place).sum() == zeros
        assert place < R[R > 0].min()
        assert all(tick > place for tick in axes.xaxis.get_ticklocs())
        note = margin[0].get_window_extent(FigureCanvasAgg(image).get_renderer())
        assert note.x0 < axes.transData.transform((place, 0.5))[0] < note.x1


def test_staircase_bounds_what_the_front_dominates(tmp_path):
    record = read(write(tmp_path))
    axes = front.picture(record).axes[0]
    step = max(axes.lines, key=lambda line: len(np.asarray(line.get_xdata())))
    x, y = np.asarray(step.get_xdata()), np.asarray(step.get_ydata())
    assert step.get_drawstyle() == "steps-pre"
    for at in np.random.default_rng(0).uniform(0, record.regularity.max(), 50):
        reached = record.improvement_potential[record.regularity >= at].max()
        assert y[np.searchsorted(x, at)] == pytest.approx(reached)


def test_knee_is_where_the_ring_is(tmp_path):
    record = read(write(tmp_path))
    ring = dots(front.picture(record))["knee"]
    rows = record.front
    scores = np.stack([record.regularity, record.improvement_potential], axis=1)
    unit = (scores - scores[rows].min(axis=0)) / np.ptp(scores[rows], axis=0)
    expected = max(rows, key=lambda row: abs(unit[row].sum() - 1))
    np.testing.assert_allclose(ring[0], scores[expected])
    assert knee(record) == expected


@pytest.mark.parametrize("seed", range(20))
def test_knee_is_that_of_pareto(tmp_path, seed):
    rng = np.random.default_rng(seed)
    scores = np.round(rng.uniform(size=(24, 2)), 1 + seed % 3)  # rounded: with duplicates
    scores[rng.uniform(size=24) < 0.1, seed % 2] = np.nan
    finite = np.flatnonzero(np.isfinite(scores).all(axis=1))
    flags = np.zeros(24, dtype=bool)
    flags[finite[pareto.nondominated(torch.from_numpy(scores[finite])).numpy()]] = True
    change(write(tmp_path, m=1), regularity=scores[:, 0], improvement_potential=scores[:, 1], nondominated=flags)
    assert knee(read(tmp_path)) == pareto.knee(torch.from_numpy(scores))


# --- centers.png -----------------------------------------------------------------------------------------------------


def test_columns_are_best_regularity_knee_and_best_improvement_potential(tmp_path):
    record = read(write(tmp_path))
    titles = panels.choose(record)
    assert titles[int(record.regularity.argmax())].startswith("best regularity")
    assert titles[int(record.improvement_potential.argmax())].endswith("best improvement potential")
    assert "knee" in titles[knee(record) or 0]
    names = [name for title in titles.values() for name in title.split(",\n")]
    assert sorted(names) == ["best improvement potential", "best regularity", "knee"]


def test_ties_in_one_score_are_broken_by_the_other(tmp_path):
    best = int(read(write(tmp_path)).improvement_potential.argmax())
    record = read(change(tmp_path, regularity=np.zeros(24), nondominated=np.arange(24) == best))
    assert panels.choose(record) == {best: "best regularity,\nknee,\nbest improvement potential"}


def test_plane_panels_show_centers_and_values(tmp_path):
    record = read(write(tmp_path))
    image = centers.picture(record)
    shown = panels.choose(record)
    images = pixels(image)
    assert amount(images, style.RED) > 50 * len(shown)
    assert amount(images, style.ERROR(1.0), 0.06) > 100  # the yellow end
    bars = colour_bars(image)
    assert len(bars) == 3
    assert len(image.axes) == 3 * len(shown) + 3
    norm = record.summary["gradient_norm"]
    highest = norm * np.abs(record.gradient).max()
    assert bars[1].get_ylim() == pytest.approx((0, highest))
    left = [np.linalg.norm(record.gradient - local_error.reached(record, index), axis=1).max() for index in shown]
    assert bars[2].get_ylim() == pytest.approx((0, norm * max(left)))
    places = np.asarray(image.axes[0].collections[-1].get_offsets())
    np.testing.assert_allclose(places, record.centers[next(iter(shown))][:, ::-1])  # the longer side lies


SETUPS = ("centers", "regularity", "improvement_potential", "variability", "method", "preference")
DEGENERATE = {
    "one setup": {key: lambda old: old[:1] for key in SETUPS} | {"nondominated": np.ones(1, dtype=bool)},
    "regularity 0 everywhere": {"regularity": np.zeros(24), "nondominated": np.arange(24) == 3},
    "equal scores": {"regularity": np.full(24, 0.5), "improvement_potential": np.ones(24), "nondominated": np.ones(24)},
    "rows without scores": {
        "regularity": lambda old: np.where(np.arange(24) % 2, np.nan, old),
        "improvement_potential": lambda old: np.where(np.arange(24) % 3, old, np.nan),
    },
    "centers that are not finite": {
        "centers": lambda old: np.where(np.arange(24)[:, None, None] < 20, np.inf, old),
        "regularity": lambda old: np.where(np.arange(24) < 20, 0.0, old),
        "improvement_potential": lambda old: np.where(np.arange(24) < 20, 0.0, old),
    },
    "an unknown method": {"method": np.array(["mystery"] * 24)},
}


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_setups_are_drawn(tmp_path, case, d):
    record = read(change(write(tmp_path, d=d), **DEGENERATE[case]))
    assert pixels(centers.picture(record, opengl=False)).std() > 0.02
    if d == 2:
        assert pixels(front.picture(record)).std() > 0.02


@pytest.mark.parametrize(
    "settings",
    [
        {"m": 1},
        {"m": 1, "kernel": "triharmonic"},
        {"d": 3, "m": 1},
        {"d": 3, "k": 1},
        {"d": 2, "k": 2},
        {"uniform": False},
        {"d": 3, "uniform": False, "kernel": "triharmonic"},
        {"d": 3, "gradient_norm": None},
        {"d": 3, "gradient_norm": 1e6},
        {"d": 2, "gradient_norm": None, "hypervolume": None, "seed": None},
        {"faces": False},
        {"d": 3, "faces": False},
    ],
    ids=str,
)
def test_unusual_scenarios_are_drawn(tmp_path, settings):
    record = read(write(tmp_path, **settings))
    image = centers.picture(record, opengl=False)
    assert amount(pixels(image), style.RED) > 10
    noted = any("not to scale" in text.get_text() for text in image.texts)
    assert noted == (settings.get("d") == 3 and settings.get("gradient_norm", 1) in (None, 1e6))


def test_an_unknown_kernel_still_shows_its_centers(tmp_path):
    image = centers.picture(read(write(tmp_path, kernel="wendland", support=None)))
    assert [axes.get_ylabel() for axes in colour_bars(image)] == ["height [model units]", "local error [model units]"]
    assert any("kernel=wendland with support radius" in text.get_text() for text in image.texts)


def test_without_any_score_there_is_a_front_png_and_a_reason(tmp_path):
    record = read(change(write(tmp_path), regularity=np.full(24, np.nan)))
    assert "24 setups without scores" in front.picture(record).texts[1].get_text()
    with pytest.raises(UserError, match="no setup has finite centers and scores"):
        centers.picture(record)


# --- surfaces --------------------------------------------------------------------------------------------------------


def test_points_behind_the_surface_are_hidden():
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices, faces = np.array(ball.vertices), np.array(ball.faces)
    looking = view.view_of(vertices, 0.1)
    points = np.array([1.2 * looking.towards, 0 * looking.up, -1.2 * looking.towards, 1.3 * looking.right])
    assert view.hidden(points, vertices, faces, looking).tolist() == [False, True, True, False]


def test_the_view_is_from_the_front_and_holds_every_point():
    points = np.random.default_rng(0).normal(size=(200, 3)) * [3, 1, 2]
    looking = view.view_of(points, margin=0.25)
    axes = np.stack([looking.right, looking.up, looking.towards])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(axes) == pytest.approx(1)
    assert looking.towards[2] > 0.9
    assert looking.up[1] > 0.9
    flat = looking.project(points)[0]
    assert np.abs(flat).max() == pytest.approx(looking.half - 0.25)


# --- processes -------------------------------------------------------------------------------------------------------

PROBE = "import pyvista as v; p = v.Plotter(off_screen=True); p.add_mesh(v.Sphere()); assert p.screenshot().std() > 0"


@pytest.fixture(scope="module")
def opengl():
    """Skip where nothing can be rendered off-screen; asked in a process of its own, which may die of it."""
    try:
        done = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, timeout=60)
    except subprocess.TimeoutExpired:
        pytest.skip("off-screen OpenGL hangs on this machine")
    if done.returncode != 0:
        pytest.skip(f"no off-screen OpenGL on this machine (exit code {done.returncode})")


@pytest.fixture
def broken_opengl(tmp_path_factory, monkeypatch):
    """A pyvista that kills its process, as a missing OpenGL does."""
    place = tmp_path_factory.mktemp("broken")
    (place / "pyvista.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n")
    monkeypatch.setenv("PYTHONPATH", str(place))


def is_picture(path: Path) -> bool:
    image = imread(path)
    return min(image.shape[:2]) > 400 and image[..., :3].std() > 0.02


def leftovers(run: Path) -> set[str]:
    return {path.name for path in run.iterdir()} - {"setups.npz", "scenario.npz", "summary.json"}


def test_a_run_gets_both_pictures_and_a_page(tmp_path):
    assert figures.draw(write(tmp_path)) == []
    assert leftovers(tmp_path) == {"front.png", "centers.png", "report.html"}
    assert is_picture(tmp_path / "front.png")
    assert is_picture(tmp_path / "centers.png")
    for color in set(SERIES.values()):
        assert amount(imread(tmp_path / "front.png"), color) > 100


def test_a_surface_is_rendered(tmp_path, opengl):
    assert processes.draw_one(write(tmp_path, d=3, m=12), "centers") == (0, None)
    image = imread(tmp_path / "centers.png")[..., :3]
    assert is_picture(tmp_path / "centers.png")
    red = (image[..., 0] > 0.6) & (image[..., 1:].max(axis=-1) < 0.25)
    assert red.sum() > 300
    blue = (image[..., 2] > image[..., 0] + 0.15) & (image[..., 0] < 0.35)
    assert blue.sum() > 5000


def test_a_crash_of_opengl_is_survived_by_matplotlib(tmp_path, broken_opengl):
    outcome = processes.draw_one(write(tmp_path, d=3), "centers")
    assert outcome == (0, "centers.png was drawn without OpenGL: the process was ended by SIGSEGV")
    assert is_picture(tmp_path / "centers.png")
    assert leftovers(tmp_path) == {"centers.png"}


def test_a_crash_of_one_figure_spares_the_other(tmp_path, monkeypatch):
    honest = processes.command

    def command(run, figure, *options):
        return ["sh", "-c", "kill -ABRT $$"] if figure == "centers" else honest(run, figure, *options)

    monkeypatch.setattr(processes, "command", command)
    assert figures.draw(write(tmp_path)) == ["centers.png could not be drawn: the process was ended by SIGABRT"]
    assert is_picture(tmp_path / "front.png")


def test_a_process_that_hangs_or_cannot_start_is_a_warning(tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "TIMEOUT", 0.2)
    monkeypatch.setattr(processes, "command", lambda *_: ["sleep", "20"])
    assert figures.draw(tmp_path)[0] == "front.png could not be drawn: it was not finished after 0.2 s"
    monkeypatch.setattr(processes, "command", lambda *_: ["/nowhere/python"])
    assert "No such file" in figures.draw(tmp_path)[1]


@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="root may write everywhere")
def test_an_unwritable_directory_is_a_warning(tmp_path):
    write(tmp_path).chmod(0o500)
    try:
        warnings = figures.draw(tmp_path)
    finally:
        tmp_path.chmod(0o700)
    assert ["could not be drawn" in line and "Permission denied" in line for line in warnings] == [True, True]
    assert leftovers(tmp_path) == set()


def test_a_picture_is_written_whole_or_not_at_all(tmp_path, capsys):
    (write(tmp_path) / "front.png").mkdir()
    assert command_line.main([str(tmp_path), "--only", "front"]) == 2
    assert "front.png" in capsys.readouterr().err
    assert leftovers(tmp_path) == {"front.png"}

    class Broken(Figure):
        def savefig(self, *_, **__):
            raise MemoryError

    (tmp_path / "old.png").write_bytes(b"old")
    with pytest.raises(MemoryError):
        style.save(Broken(), tmp_path / "old.png")
    assert (tmp_path / "old.png").read_bytes() == b"old"


def test_an_empty_rendering_is_refused(opengl):
    code = (
        "import numpy as np; from matplotlib.figure import Figure; from rbfevo.figures import surface, view\n"
        "surface._pixels = lambda _: np.ones((8, 8, 3)); X, F = np.eye(3), np.array([[0, 1, 2]])\n"
        "surface.render(Figure().add_axes((0, 0, 1, 1)), view.view_of(X, 0.1), X, F, X, X, 0.1)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert "OpenGL rendered an empty picture" in done.stderr


# --- bad input -------------------------------------------------------------------------------------------------------


def spoil(run: Path, file: str, how: str) -> Path:
    if how == "missing":
        (run / file).unlink()
    elif how == "not what it says":
        (run / file).write_text("{nonsense")
    elif file.endswith("json"):
        (run / file).write_text("[1, 2]")
    else:
        with np.load(run / file) as archive:
            np.savez(run / file, **dict(list(archive.items())[1:]))
    return run


@pytest.mark.parametrize("how", ["missing", "not what it says", "something lacks"])
@pytest.mark.parametrize("file", ["setups.npz", "scenario.npz", "summary.json"])
def test_a_broken_run_directory_is_one_clear_line(tmp_path, file, how, capsys):
    spoil(write(tmp_path), file, how)
    assert command_line.main([str(tmp_path), "--only", "centers"]) == 2
    line = capsys.readouterr().err
    assert file in line
    assert line.count("\n") == 1
    assert leftovers(tmp_path) <= {"setups.npz"}


def test_arrays_that_do_not_fit_together_are_refused(tmp_path):
    change(write(tmp_path), regularity=np.zeros(3))
    with pytest.raises(UserError, match="do not match"):
        read(tmp_path)


def test_redrawing_what_is_not_a_run_exits_with_2(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(processes, "FIGURES", ("centers",))
    assert command_line.main([str(tmp_path / "nowhere")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("rbfevo.figures: ")
    assert "there is no such directory" in line
    (tmp_path / "empty").mkdir()
    assert command_line.main([str(tmp_path / "empty")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("centers.png could not be drawn: ")
    assert "setups.npz is missing" in line
