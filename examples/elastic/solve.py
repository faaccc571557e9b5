"""The solver of the bracket as a command for a shell loop. `python examples/elastic/solve.py OUT [MESH]`.

Without a mesh it makes one, OUT/bracket.vtu, and its design surface, OUT/design.vtp. It solves the bracket with its
nodes where those of the mesh are, and writes OUT/solved.vtu with the array `sensitivity` = dL/dX at all nodes, and
OUT/J.txt with L = J + PRICE V, compliance and what material costs: what is not worth its price is taken away.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

PRICE = 0.004  # N/mm^2: what a mm^3 everywhere on the design surface is worth at first, so the volume hardly changes


def main(arguments: list[str] | None = None) -> int:
    """Solve one design; return 0, 1 if there is no solution, or 2 if a package is missing."""
    made = argparse.ArgumentParser(description="Solve the bracket at the nodes of a mesh, or at first make the mesh.")
    made.add_argument("out", type=Path, metavar="OUT", help="directory for the files")
    made.add_argument("mesh", type=Path, nargs="?", metavar="MESH", help="a deformed mesh (default: the original one)")
    made.add_argument("--cells", type=int, nargs=3, default=(24, 6, 3), metavar="N", help="as for optimize.py")
    options = made.parse_args(arguments)
    try:
        import bracket
        import skfem
        from elasticity import ShapeError

        from rbfevo import meshes
    except ModuleNotFoundError as error:
        print(f"solve.py: {error}: pip install 'rbfevo[elastic]'", file=sys.stderr)
        return 2
    case = bracket.bracket(options.cells)
    points = case.points
    if options.mesh is not None:
        with meshes.opened(options.mesh) as mesh:
            points = mesh.points
    try:
        found = case.body.solve(points)
    except ShapeError as error:
        print(f"solve.py: {error}", file=sys.stderr)
        return 1
    options.out.mkdir(parents=True, exist_ok=True)
    if options.mesh is None:
        bracket.write(case, points, found, options.out / "bracket.vtu")
        bracket.write_design(case, options.out / "bracket.vtu", options.out / "design.vtp")
    slope = found.compliance_gradient + PRICE * found.volume_gradient
    solved = skfem.MeshHex(points.T.copy(), case.body.corners.T.copy())
    solved.save(str(options.out / "solved.vtu"), point_data={"sensitivity": slope})
    total = found.compliance + PRICE * found.volume
    (options.out / "J.txt").write_text(f"{total!r}\n")
    print(f"L = {total:.4f}: J = {found.compliance:.4f} N mm, V = {found.volume:.1f} mm^3", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
