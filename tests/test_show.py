"""What `python -m rbfevo.show` shows: the choices without a window, and pictures looked at pixel by pixel."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from test_figures import PROBE, change, definition, write

from rbfevo import show
from rbfevo.errors import UserError
from rbfevo.figures import processes, scene
from rbfevo.figures.scene import COLOURS, KEYS, SHAPES, SOFTWARE, Fields, State
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, read

MIRROR = {"axis": "x", "at": 0.0}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run on a sphere."""
    return write(tmp_path_factory.mktemp("show") / "run", d=3)


@pytest.fixture(scope="module")
def record(run) -> Record:
    return read(run)


@pytest.fixture
def state(record) -> State:
    return State(record, "knee")


@pytest.fixture
def a_copy(run, tmp_path) -> Path:
    """The run in a directory of this test's own."""
    return Path(shutil.copytree(run, tmp_path / "run"))


@pytest.fixture(autouse=True)
def no_display(monkeypatch, request):
    """No display, unless the test is about the window that is on one."""
    if "display" not in request.fixturenames:
        monkeypatch.delenv("DISPLAY", raising=False)
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


# --- choices ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", scene.NAMED)
def test_a_key_leads_to_each_named_setup(state, record, key):
    assert state.press(key)
    assert state.row == pick(record, scene.NAMED[key])


def test_right_and_left_walk_along_the_whole_front_and_end_there(state, record):
    state.press("r")
    seen = [state.row]
    while not state.message:
        state.press("Left")
        seen.append(state.row)
    assert seen[:-1] == record.front[::-1].tolist()
    assert "no setup on it has lower regularity" in state.message
    state.press("Right")
    assert (state.row, state.message) == (record.front[1], "")


def test_from_beside_the_front_it_goes_on_to_the_next_of_higher_or_lower_regularity(record):
    R = record.regularity
    beside = [row for row in record.usable if not record.nondominated[row]]
    assert beside
    for row in beside:
        for key, there in (("Right", record.front[R[record.front] > R[row]][:1]), ("Left", None)):
            state = State(record, f"index:{row}")
            state.press(key)
            expected = record.front[R[record.front] < R[row]][-1:] if there is None else there
            assert state.row == (expected[0] if expected.size else row)


def test_without_a_front_it_walks_along_all_setups_and_has_no_knee(tmp_path):
    record = read(change(write(tmp_path), nondominated=np.zeros(24, dtype=bool)))
    state = State(record, "best-regularity")
    for _ in range(23):
        state.press("Left")
    assert state.row == record.regularity.argmin()
    state.press("k")
    assert "there is no knee" in state.message
    assert state.row == record.regularity.argmin()


@pytest.mark.parametrize("preference", [0.0, 0.2, 0.5, 0.77, 1.0])
def test_the_slider_shows_the_setup_for_a_preference(state, record, preference):
    state.prefer(preference)
    value = preference * record.regularity + (1 - preference) * record.improvement_potential
    assert state.row == value.argmax()


def test_preferences_of_a_row_are_those_that_choose_it(state, record):
    grid = np.linspace(0, 1, 401)
    value = grid[:, None] * record.regularity + (1 - grid[:, None]) * record.improvement_potential
    best = value.argmax(axis=1)
    for row in record.usable:
        found, chosen = state.preferences(int(row)), grid[best == row]
        inside = grid[(grid > found[0] + 1e-9) & (grid < found[1] - 1e-9)] if found else grid[:0]
        assert set(inside) <= set(chosen)
        assert set(chosen) - set(inside) <= set(chosen[[0, -1]] if chosen.size else [])


def test_the_slider_follows_the_setup_chosen_by_a_key(state):
    for key in ("r", "p", "k", "Left", "Right", "Right"):
        state.press(key)
        fits = state.preferences(state.row)
        if fits is None:
            assert f"row {state.row} is the best setup for none" in state.slider_title()
        else:
            assert fits[0] <= state.preference <= fits[1]


def test_the_slider_starts_where_the_pick_says(record):
    assert State(record, "preference:0.37").preference == 0.37


def test_c_keeps_a_setup_x_swaps_them_and_c_drops_it(state):
    knee = state.row
    state.press("c")
    assert state.rows == [knee, knee]
    state.press("r")
    best = state.row
    assert state.rows == [best, knee] != [knee, knee]
    state.press("x")
    assert state.rows == [knee, best]
    state.press("c")
    assert state.rows == [knee]
    state.press("x")
    assert (state.rows, state.message) == ([knee], "there is no setup to swap with: press c to keep one")


def test_e_and_t_go_round_colours_and_shapes(state):
    assert [state.colour, *(state.press("e") and state.colour for _ in COLOURS)] == [*COLOURS, "wanted"]
    assert [state.shape, *(state.press("t") and state.shape for _ in SHAPES)] == [*SHAPES, "template"]


def test_h_shows_and_hides_the_keys_and_other_keys_do_nothing(state):
    assert state.press("h")
    assert state.keys_shown
    before = dict(vars(state))
    for key in ("w", "f", "Up", "Shift_L", ""):
        assert not state.press(key)
    assert vars(state) == before
    state.press("h")
    assert not state.keys_shown


def test_every_key_is_told(state):
    documented = {key for keys, _ in KEYS for key in keys.split()}
    assert documented == {*scene.NAMED, "Left", "Right", *"cxetnvsh", "q", "Escape"}


def test_titles_tell_what_a_setup_is_best_at_its_row_and_its_scores(state, record):
    state.press("r")
    first, second = state.titles(state.row)
    assert first.startswith("best regularity")
    assert f"row {state.row} ({record.method[state.row]}" in first
    assert f"R = {record.regularity.max():.4g}" in second
    row = int(np.flatnonzero(record.method == "cmaes")[0])
    assert "(cmaes, preference 0.25)" in state.titles(row)[0]


@pytest.mark.parametrize(
    ("settings", "colours", "shapes"),
    [({"d": 3, "k": 1}, ["left"], []), ({"d": 3, "support": None}, [], ["wanted"]), ({"d": 2, "k": 2}, ["left"], None)],
    ids=str,
)
def test_what_a_run_does_not_tell_is_refused(tmp_path, settings, colours, shapes):
    record = read(write(tmp_path, **settings))
    possible = {
        "colour": ["wanted", *colours],
        "shape": ["template", *(["reached", "wanted"] if shapes is None else shapes)],
    }
    for option, valid in (("colour", COLOURS), ("shape", SHAPES)):
        for word in valid:
            choices: dict[str, Any] = {option: word}
            if word in possible[option]:
                State(record, "knee", **choices)
            else:
                with pytest.raises(UserError, match=f"--{option} {word}: "):
                    State(record, "knee", **choices)
    state = State(record, "knee")
    for key, option in (("e", "colour"), ("t", "shape")):
        state.press(key)
        assert getattr(state, option) == possible[option][1 % len(possible[option])]
        assert bool(state.message) == (len(possible[option]) < len({"e": COLOURS, "t": SHAPES}[key]))


# --- arrays ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("d", [2, 3])
def test_values_and_shapes_are_those_of_the_definition(tmp_path, d):
    record = read(write(tmp_path, d=d))
    fields, row = Fields(record), 5
    arguments = record.vertices, record.gradient, record.weights, record.centers[row]
    reached, norm = definition(*arguments, "wendland", 0.6)[2], record.summary["gradient_norm"]
    np.testing.assert_allclose(fields.values(row, "wanted"), norm * np.linalg.norm(record.gradient, axis=1))
    left = norm * np.linalg.norm(record.gradient - reached, axis=1)
    np.testing.assert_allclose(fields.values(row, "left"), left, atol=1e-9)
    assert fields.highest == pytest.approx(fields.values(row, "wanted").max())
    assert (fields.unit, fields.remark) == ("[model units]", "")
    template = record.vertices if d == 3 else np.hstack([record.vertices, np.zeros((len(record.vertices), 1))])
    np.testing.assert_array_equal(fields.points(row, "template"), template)
    for shape, moved in (("wanted", record.gradient), ("reached", reached)):
        expected = norm * moved if d == 3 else norm * moved * [0, 0, 1]  # a height is the third coordinate
        np.testing.assert_allclose(fields.points(row, shape) - template, expected, atol=1e-9)


def test_a_direction_is_shown_with_a_largest_displacement_and_not_to_scale(tmp_path):
    fields = Fields(read(write(tmp_path, d=3, gradient_is="direction")))
    farthest = np.linalg.norm(fields.points(0, "wanted") - fields.points(0, "template"), axis=1).max()
    assert farthest == pytest.approx(0.05 * np.sqrt(12))
    assert (fields.unit, fields.remark) == ("(unit norm)", "displacement not to scale")


def test_centers_have_mirror_images_and_move_with_the_shape_within_reach(tmp_path):
    record = read(write(tmp_path, d=3, symmetry=MIRROR))
    fields = Fields(record)
    places, mirrored = fields.centers(2, "template")
    np.testing.assert_array_equal(places[~mirrored], record.centers[2])
    np.testing.assert_array_equal(places[mirrored], record.centers[2] * [-1, 1, 1])
    moved, _ = fields.centers(2, "reached")
    assert np.abs(moved - places).max() > 1e-3
    np.testing.assert_allclose(moved[mirrored], moved[~mirrored] * [-1, 1, 1])
    np.testing.assert_array_equal(fields.centers(2, "wanted")[0], places)


# --- pictures --------------------------------------------------------------------------------------------------------

SNAPSHOTS = """
import sys
from pathlib import Path
import numpy as np
from rbfevo.figures import window
from rbfevo.figures.scene import State
from rbfevo.recorded.record import read
window.SIZE = (600, 430)
shown = {}
for run, keys in zip(sys.argv[2::2], sys.argv[3::2]):
    state = State(read(Path(run)), "knee")
    made = window.Window(Path(run), state.record, state, off_screen=True)
    for name in ["", *keys.split()]:
        for key in name.split("+") if name else ():
            made.press(key)
        shown[Path(run).name + name] = made.picture(bare=True)
np.savez(sys.argv[1], **shown)
"""


def child(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a script that uses OpenGL in a process of its own; skip where this machine has none."""
    done = subprocess.run([sys.executable, "-c", script, *arguments], capture_output=True, text=True, timeout=120)
    if done.returncode != 0:
        probe = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, timeout=60)
        if probe.returncode != 0:
            pytest.skip(f"no off-screen OpenGL on this machine (exit code {probe.returncode})")
        pytest.fail(done.stderr)
    return done


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> dict[str, Any]:
    """Pictures [430, 600, 3] after keys, one after the other: of a sphere that is symmetric, and of a plane."""
    place = tmp_path_factory.mktemp("pictures")
    runs = {"sphere": "e c r x s", "plane": "t t+e"}
    write(place / "sphere", d=3, symmetry=MIRROR)
    write(place / "plane")
    arguments = [word for name, keys in runs.items() for word in (str(place / name), keys)]
    child(SNAPSHOTS, str(place / "shown.npz"), *arguments)
    with np.load(place / "shown.npz") as shown:
        return {**shown, "files": sorted(path.name for path in (place / "sphere").glob("*.png"))}


def inside(picture: Any) -> Any:
    """What is shown of setups, without the texts above and below, in [0, 1]."""
    high = len(picture)
    return picture[int(0.15 * high) : int(0.85 * high)] / 255.0


def reddish(image: Any, green: tuple[float, float]) -> int:
    """How many pixels are red with that much green and blue in them, of the red."""
    part = image[..., 1] / np.maximum(image[..., 0], 1e-9)
    alike = np.abs(image[..., 1] - image[..., 2]) < 0.06
    return int(((image[..., 0] > 0.5) & alike & (part > green[0]) & (part < green[1])).sum())


def halves(picture: Any) -> tuple[Any, Any]:
    image = inside(picture)
    return image[:, :300], image[:, 300:]


def test_centers_are_red_balls_and_their_images_lighter_ones(pictures):
    assert reddish(inside(pictures["sphere"]), (0.0, 0.3)) > 100
    assert reddish(inside(pictures["sphere"]), (0.6, 0.8)) > 100
    assert reddish(inside(pictures["plane"]), (0.0, 0.3)) > 100
    assert reddish(inside(pictures["plane"]), (0.6, 0.8)) < 20


def test_what_cannot_be_reached_is_coloured_otherwise_and_on_the_same_scale(pictures):
    wanted, left = inside(pictures["sphere"]), inside(pictures["spheree"])
    yellow = [((image[..., 0] > 0.5) & (image[..., 1] > 0.5) & (image[..., 2] < 0.5)).sum() for image in (wanted, left)]
    assert yellow[0] > 2 * yellow[1] + 50
    low = int(0.9 * 430)
    np.testing.assert_array_equal(pictures["sphere"][low:, 320:], pictures["spheree"][low:, 320:])  # the colour bar


def test_a_kept_setup_is_shown_beside_itself_and_then_beside_another(pictures):
    same, other = halves(pictures["spherec"]), halves(pictures["spherer"])
    assert np.abs(same[0] - same[1]).mean() < 0.002
    assert np.abs(other[0] - other[1]).mean() > 0.01
    for half in (*same, *other):
        assert reddish(half, (0.0, 0.3)) > 20
    np.testing.assert_allclose(other[1], same[1], atol=0.02)


def test_swapping_swaps_the_two(pictures):
    before, after = halves(pictures["spherer"]), halves(pictures["spherex"])
    assert np.abs(before[0] - after[1]).mean() < 0.002
    assert np.abs(before[1] - after[0]).mean() < 0.002


def test_s_writes_a_picture_beside_the_run(pictures):
    (name,) = pictures["files"]
    assert name.startswith("show-row-")
    assert "-vs-" in name


def test_a_plane_is_raised_by_its_heights(pictures):
    flat, reached, wanted = (inside(pictures[f"plane{keys}"]) for keys in ("", "t", "t+e"))
    assert np.abs(flat - reached).mean() > 0.01
    assert np.abs(reached - wanted).mean() > 0.005


# --- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture
def drawn(monkeypatch) -> list[list[str]]:
    """The commands of child processes, which are noted and not run; pictures are a PNG's text."""
    commands: list[list[str]] = []

    def attempt(arguments: list[str], timeout: float) -> tuple[int, str]:
        commands.append(arguments)
        if "--out" in arguments:
            Path(arguments[arguments.index("--out") + 1]).write_bytes(f"tEXtSoftware\0{SOFTWARE}".encode())
        return 0, ""

    monkeypatch.setattr(processes, "attempt", attempt)
    return commands


def complaint(capsys, arguments: list[str], code: int = 2) -> str:
    assert show.main(arguments) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("rbfevo.show: ")
    return line


@pytest.mark.usefixtures("pictures")  # skips where nothing can be rendered
def test_without_a_display_a_picture_is_written(a_copy, capsys):
    assert show.main([str(a_copy)]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    first, title, last = captured.out.splitlines()
    assert "there is no display" in first
    assert title.startswith("knee, ")
    assert last == f"written: {a_copy / 'show-knee.png'}"
    picture = (a_copy / "show-knee.png").read_bytes()
    assert f"Software\0{SOFTWARE}".encode() in picture
    assert reddish(imread(a_copy / "show-knee.png")[..., :3], (0.0, 0.3)) > 500


def test_choices_are_in_the_name_and_handed_on(a_copy, drawn):
    options = ["--pick", "preference:0.3", "--compare", "index:2", "--colour", "left", "--shape", "reached"]
    assert show.main([str(a_copy), *options]) == 0
    (command,) = drawn
    assert command[-1] == str(a_copy / "show-preference-0.3-vs-index-2-left-reached-shape.png")
    for option, word in zip(options[::2], options[1::2], strict=True):
        assert command[command.index(option) + 1] == word


def test_with_a_display_a_window_opens_unless_pictures_are_asked_for(a_copy, drawn, monkeypatch, tmp_path):
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    for options, pictured in (
        ([], False),
        (["--pictures"], True),
        (["--no-display"], True),
        (["--out", str(tmp_path / "a.png")], True),
    ):
        assert show.main([str(a_copy), *options]) == 0
        assert ("--out" in drawn[-1]) == pictured


def test_macos_and_windows_have_a_display_and_linux_where_it_is_named():
    assert show.has_display({}, "darwin")
    assert show.has_display({}, "win32")
    assert not show.has_display({"DISPLAY": ""}, "linux")
    assert show.has_display({"DISPLAY": ":0"}, "linux")
    assert show.has_display({"WAYLAND_DISPLAY": "wayland-0"}, "linux")


def test_out_is_a_picture_or_a_directory_that_is_made(a_copy, drawn, tmp_path):
    assert show.main([str(a_copy), "--out", str(tmp_path / "new/one.png")]) == 0
    assert show.main([str(a_copy), "--out", str(tmp_path / "new/more")]) == 0
    assert (tmp_path / "new/one.png").exists()
    assert (tmp_path / "new/more/show-knee.png").exists()


def test_only_its_own_pictures_in_the_run_are_replaced(a_copy, drawn, capsys, tmp_path):
    assert show.main([str(a_copy)]) == 0
    assert show.main([str(a_copy)]) == 0
    assert "is not overwritten" in complaint(capsys, [str(a_copy), "--out", str(a_copy)])
    (a_copy / "show-best-regularity.png").write_bytes(b"mine")
    assert "is not overwritten" in complaint(capsys, [str(a_copy), "--pick", "best-regularity"])
    assert (a_copy / "show-best-regularity.png").read_bytes() == b"mine"
    (tmp_path / "a.png").touch()
    assert "a.png already exists" in complaint(capsys, [str(a_copy), "--out", str(tmp_path / "a.png")])
    assert len(drawn) == 2


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--pick", "nose"], "pick=nose: there is no such pick; choose one of knee"),
        (["--compare", "index:99"], "--compare: pick=index:99: there is no such row; choose one from 0 to 23"),
        (["--colour", "red"], "invalid choice: 'red'"),
        (["--shape", "round"], "invalid choice: 'round'"),
        (["--out", "a.jpg"], "--out a.jpg: give a .png file"),
        (["--colours", "left"], "unrecognized arguments"),
    ],
)
def test_mistakes_are_one_line(a_copy, drawn, capsys, options, reason):
    assert reason in complaint(capsys, [str(a_copy), *options])
    assert drawn == []
    assert not list(a_copy.glob("*.png"))


def test_what_is_not_a_run_is_one_line(tmp_path, capsys):
    assert "there is no such run directory" in complaint(capsys, [str(tmp_path / "nowhere")])


def test_without_a_front_the_best_improvement_potential_is_shown(a_copy, drawn):
    change(a_copy, nondominated=np.zeros(24, dtype=bool))
    assert show.main([str(a_copy)]) == 0
    assert (a_copy / "show-best-improvement-potential.png").exists()


@pytest.mark.parametrize("what", ["picture", "window"])
def test_a_missing_opengl_that_kills_the_process_is_one_line(run, tmp_path, monkeypatch, capsys, what):
    (tmp_path / "pyvista.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    if what == "window":
        monkeypatch.setenv("DISPLAY", ":0")
    line = complaint(capsys, [str(run)], code=1)
    assert f"the {what} could not be drawn: the process was ended by SIGSEGV" in line
    assert f"python -m rbfevo.figures {run}" in line
    assert "report.html" in line
    assert not list(run.glob("*.png"))


# --- the window ------------------------------------------------------------------------------------------------------

PRESSES = """
import json, sys
from pathlib import Path
from rbfevo.figures.scene import State
from rbfevo.figures.window import Window
from rbfevo.recorded.record import read
run = Path(sys.argv[1])
state = State(read(run), "index:9")
window = Window(run, state.record, state, off_screen=False)
show, values = window.plotter.show, {}
window.plotter.show = lambda **options: show(**options | {"auto_close": False, "interactive_update": True})
window.open()
values["start"] = state.row
inner = window.plotter.iren.interactor
def press(key):
    inner.SetKeySym(key)
    inner.SetKeyCode(key if len(key) == 1 else chr(0))
    inner.KeyPressEvent()
    inner.CharEvent()
camera = window.plotter.renderers[1].camera
before = camera.position, camera.parallel_scale
for key in ("k", "r", "p", "w", "e", "s", "f", "3", "i", "v", "Up"):
    press(key)
    values[key] = state.row
values["camera stays"] = before == (camera.position, camera.parallel_scale)
values["wireframe"] = window._panels[0].surface.prop.style
values["colour"], values["done"] = state.colour, bool(inner.GetDone())
slider = window.plotter.slider_widgets[0]
values["slider"] = bool(slider.GetEnabled())
slider.GetRepresentation().SetValue(1.0)
slider.InvokeEvent("InteractionEvent")
values["slid"] = state.row
press("Escape")
values["closed"] = bool(inner.GetDone())
window.plotter.close()
print(json.dumps(values))
"""


@pytest.fixture
def display() -> str:
    """The display, or a reason to skip."""
    if not os.environ.get("DISPLAY"):
        pytest.skip("a window needs a display: DISPLAY is not set")
    return os.environ["DISPLAY"]


def test_keys_and_slider_change_the_window_and_do_nothing_else(display, a_copy, record):
    done = child(PRESSES, str(a_copy))
    values = json.loads(done.stdout.splitlines()[-1])
    knee, R, P = (pick(record, name) for name in scene.NAMED.values())
    assert [values[key] for key in ("start", "k", "r", "p", "w", "e")] == [9, knee, R, P, P, P]
    assert values["camera stays"]
    assert values["wireframe"] == "Surface"
    assert (values["colour"], values["done"], values["slider"]) == ("left", False, True)
    assert values["slid"] == R
    assert values["closed"]
    assert (a_copy / f"show-row-{P}.png").exists()
