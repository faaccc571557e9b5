"""The studio in a browser: how soon the front follows a stroke, how fluent a drag is, and memory: docs/studio.csv.

    python -m benchmarks.studio            # a quarter of an hour on two cores, which nothing else should use

The browser is the one of the tests, without a window; its renderer is part of the table. Each mesh gets three strokes;
the table has the median of the second and third, after which the search begins with known setups.
"""

from __future__ import annotations

import argparse
import importlib
import re
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.choosing import ROOT, write
from rbfevo.meshes import opened
from rbfevo.recorded.record import read
from rbfevo.studio import keeping
from rbfevo.studio.saving import carried_out
from rbfevo.studio.searching import write_mesh

sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "docs" / "car")]
browsers, studios, body = (importlib.import_module(name) for name in ("browsers", "studios", "body"))
TABLE, PAGE = ROOT / "docs" / "studio.csv", ROOT / "docs" / "studio.md"
MESHES = {"car": 0.04, "car, fine": 0.0128}  # spacing of docs/car/body.py
STROKES = (((0.40, 0.50), (0.50, 0.47)), ((0.55, 0.45), (0.62, 0.47)), ((0.47, 0.55), (0.53, 0.53)))
DRAG = 5.0  # seconds
PICTURED = (  # what the brush does, its radius in per cent of the diagonal, and its way on the stage
    ("push in", 9, ((0.10, 0.62), (0.20, 0.68))),
    ("pull out", 8, ((0.70, 0.36), (0.78, 0.38))),
    ("must stay", 4, ((0.33, 0.60), (0.40, 0.655), (0.46, 0.74))),
)


def measured(name: str, mesh: Path, directory: Path, browser: Any) -> dict[str, Any]:
    """A line of the table."""
    with opened(mesh) as read_mesh:
        vertices = len(read_mesh.points)
    begin = time.monotonic()
    with studios.running(mesh, "--directory", directory) as studio, studios.window(browser, studio, []) as page:
        ready = time.monotonic() - begin
        page.wait_for_timeout(5000)
        page.get_by_label("Symmetry").select_option("y")
        line: dict[str, Any] = {"mesh": name, "vertices": vertices, "open_s": ready}
        firsts, settles, tens, done = [], [], [], np.nan
        for places in STROKES:
            studios.stroke(page, *places)
            page.wait_for_function("() => trame.state.get('busy')", polling=10)
            begin = time.monotonic()
            page.wait_for_function("() => /^(Searching:|Done)/.test(trame.state.get('searching'))", polling=10)
            firsts.append(time.monotonic() - begin)
            page.wait_for_timeout(max(1.0, 1000 * (10.0 - (time.monotonic() - begin))))
            tens.append(volume(studios.hint(page)))
            studios.until(page, lambda: studios.hint(page).startswith("Done"), 900.0)
            settles.append(time.monotonic() - begin)
            done = volume(studios.hint(page))
        line |= {"first_s": median(firsts[1:]), "settled_s": median(settles[1:])}
        page.wait_for_timeout(4000)
        state = keeping.kept(directory)
        if state is None:
            raise SystemExit("the studio kept nothing")
        page.keyboard.press("k")
        page.keyboard.press("g")
        studios.until(page, lambda: "largest displacement" in studios.facts(page))
        line |= frames(page, directory)
        line["memory_MB"] = sum(resident(pid) for pid in family(studio.process.pid)) / 2**20
        line["renderer"] = page.evaluate(
            "() => { const gl = document.createElement('canvas').getContext('webgl');"
            " return gl.getParameter(gl.getExtension('WEBGL_debug_renderer_info').UNMASKED_RENDERER_WEBGL); }"
        )
    write_mesh(directory / "again.vtp", state.vertices, state.triangles, state.field, state.held)
    arguments = state.choices.arguments(directory / "again.vtp", vertices, bool(state.held.any()))
    run = directory / "run"
    carried_out(["rbfevo", *arguments, "method=gradient", "figures=false", "quiet=true", f"hydra.run.dir={run}"])
    whole = float(read(run).summary["hypervolume"])
    line |= {"hypervolume_10s": tens[-1] / whole, "hypervolume_settled": done / whole}
    print(line, shlex.join(arguments), flush=True)
    return line


def volume(hint: str) -> float:
    """The hypervolume that the page tells."""
    found = re.search(r"hypervolume ([\d.]+)", hint)
    return float(found[1]) if found else np.nan


def frames(page: Any, directory: Path) -> dict[str, float]:
    """Deformed shapes a second, and frames of the browser, while a control point is dragged about."""
    from rbfevo.studio.picking import Camera
    from rbfevo.studio.pulling import Chosen
    from rbfevo.studio.searching import Search, Task

    page.wait_for_timeout(4000)
    state = keeping.kept(directory)
    if state is None or state.chosen is None:
        raise SystemExit("no setup is shown")
    record = (
        Search(state.vertices, state.triangles, directory / "other.vtp")
        .take(Task(1, state.field, state.held, state.choices, state.centers))
        .record
    )
    shown = Chosen(state.share)
    shown.take(record, float(np.linalg.norm(state.field)), state.centers[state.chosen])
    seen = Camera.of(*studios.camera(page))
    now, images = shown.places()
    places = seen.places(now[~images])
    x, y = places[int(np.abs(places - 0.5).max(axis=1).argmin())]
    page.evaluate(
        "() => { window.frames = 0; const tick = () => { window.frames += 1; requestAnimationFrame(tick); }; tick(); }"
    )
    counts = "() => ({ drags: window.rbfevoStudio.answered, frames: window.frames })"
    page.mouse.move(*studios.place(page, x, y))
    page.mouse.down()
    page.wait_for_timeout(500)
    before, begin, turn = page.evaluate(counts), time.monotonic(), 0
    while time.monotonic() - begin < DRAG:
        turn += 1
        page.mouse.move(*studios.place(page, x + 0.02 * np.sin(turn / 5), y - 0.02 - 0.02 * np.cos(turn / 5)))
    spent = time.monotonic() - begin
    after = page.evaluate(counts)
    page.mouse.up()
    return {f"{name}_per_s": (after[name] - before[name]) / spent for name in ("drags", "frames")}


def family(pid: int) -> list[int]:
    """A process and all below it."""
    found = subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True, check=False).stdout.split()
    return [pid, *(one for child in found for one in family(int(child)))]


def resident(pid: int) -> int:
    """Bytes of memory that a process holds."""
    for text in Path(f"/proc/{pid}/status").read_text().splitlines():
        if text.startswith("VmRSS"):
            return 1024 * int(text.split()[1])
    return 0


def picture(path: Path, mesh: Path, directory: Path, browser: Any) -> None:
    """A picture of the page with a painted car, a setup of its front and its handles."""
    with studios.running(mesh, "--directory", directory) as studio, studios.window(browser, studio, []) as page:
        page.set_viewport_size({"width": 1400, "height": 880})
        page.wait_for_timeout(3000)
        page.get_by_label("Symmetry").select_option("y")
        for action, radius, places in PICTURED:
            page.get_by_label(action).check()
            page.get_by_role("slider", name="Radius").fill(str(radius))
            studios.stroke(page, *places)
        studios.settled(page)
        page.keyboard.press("k")
        page.wait_for_timeout(2500)
        page.screenshot(path=path)


def written(lines: list[dict[str, Any]]) -> None:
    """Write the table into the page."""
    head = "| mesh | vertices | first front | settled | hypervolume after 10 s | settled | shapes a second | memory |"
    text = [head, "|---|---|---|---|---|---|---|---|"]
    for line in lines:
        numbers = [f"{float(line[key]):.3g}" for key in ("first_s", "settled_s")]
        shares = [f"{100 * float(line[key]):.1f} %" for key in ("hypervolume_10s", "hypervolume_settled")]
        text.append(
            f"| {line['mesh']} | {line['vertices']} | {numbers[0]} s | {numbers[1]} s | {' | '.join(shares)} | "
            f"{float(line['drags_per_s']):.2g} | {float(line['memory_MB']):.0f} MB |"
        )
    text.append(f"\nRenderer: {lines[0]['renderer']}.")
    before, _, rest = PAGE.read_text(encoding="utf-8").partition("<!-- studio -->\n")
    after = rest.partition("<!-- end of studio -->")[2]
    table = "\n".join(text)
    PAGE.write_text(f"{before}<!-- studio -->\n{table}\n<!-- end of studio -->{after}", encoding="utf-8")


def main() -> int:
    """Measure both meshes and write the table, or only take the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--picture", type=Path, metavar="PNG", help="only take a picture of the page")
    options = parser.parse_args()
    lines = []
    with tempfile.TemporaryDirectory() as place:
        for browser in browsers.started():
            for name, spacing in MESHES.items():
                mesh = Path(place) / ("car.vtp" if options.picture else f"{len(lines)}.vtp")
                made = body.body(spacing)
                vertices, triangles = np.asarray(made.points, np.float64), np.asarray(made.regular_faces, np.int64)
                write_mesh(mesh, vertices, triangles, np.zeros_like(vertices), np.zeros(len(vertices), bool))
                if options.picture:
                    picture(options.picture, mesh, Path(place) / "picture", browser)
                    return 0
                lines.append(measured(name, mesh, Path(place) / str(len(lines)), browser))
    short = [
        {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in one.items()} for one in lines
    ]
    write(TABLE, short)
    written(short)
    return 0


if __name__ == "__main__":
    sys.exit(main())
