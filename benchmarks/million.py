"""A template of a million vertices: `python -m benchmarks.million [N]` searches on N (20,000) and scores on all.

It makes an ellipsoid with a sensitivity, runs `scenario=mesh` on it in a separate process, and prints the wall-clock
seconds, the peak memory of that process, and the differences between the search's scores and those on all vertices.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyvista as pv


def main() -> int:
    """Make the template, carry out the run, and print its time and memory."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
    with tempfile.TemporaryDirectory() as folder:
        template, run = Path(folder) / "million.vtp", Path(folder) / "run"
        ball = pv.Sphere(theta_resolution=1010, phi_resolution=1000)
        points = np.asarray(ball.points, np.float64) * (4.0, 2.0, 1.6)
        surface = pv.PolyData.from_regular_faces(points, np.asarray(ball.regular_faces))
        surface["s"] = np.exp(-4.0 * (points[:, 0] - 1.0) ** 2)
        surface.save(template)
        overrides = [
            "scenario=mesh", f"scenario.template={template}", "scenario.sensitivity=s", "method=gradient",
            "scenario.sensitivity_kind=density", "scenario.weights=area", f"scenario.search_vertices={count}",
            "kernel.support=20%", "figures=false", "quiet=true", f"hydra.run.dir={run}",
        ]  # fmt: skip
        begin = time.perf_counter()
        done = subprocess.run([sys.executable, "-m", "rbfevo", *overrides], check=False)
        seconds = time.perf_counter() - begin
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
        if done.returncode:
            return done.returncode
        summary = json.loads((run / "summary.json").read_text())
    print(f"{summary['vertices']:,} vertices, {summary['search_vertices']:,} in the search: {seconds:.0f} s, "
          f"of which {summary['seconds']:.0f} s in the search; peak memory {peak:.2f} GiB")  # fmt: skip
    for name, value in summary["search_differences"].items():
        print(f"{name}: {value:.2g}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
