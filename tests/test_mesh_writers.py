"""Meshes drawn by hypothesis and written by other libraries are the meshes that were drawn, and come back moved.

`scripts/writers` installs gmsh, MeshLab and Open3D, whose tests skip without. RBFEVO_MESHES=50 draws more meshes, and
`-s` prints what was tried.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import meshio
import numpy as np
import pytest
import pyvista
import trimesh
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from test_mesh_files import REFUSED

from rbfevo import meshes
from rbfevo.scenarios.templates import read_template

MESHES = int(os.environ.get("RBFEVO_MESHES", "2"))  # drawn for each writer
NAMES = ["wing", "wall_1", "upper-side", "Part.1"]  # names that every format can hold
ODD = ["wing tip", "Fläche 2", "a,b;c", "x=1", "100 %"]  # and those that XML files can
# A prism with the outline of a U: two concave ends of eight corners, and how each is cut into triangles.
OUTLINE = [(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)]
CUT = [(0, 5, 6), (0, 6, 7), (0, 1, 4), (0, 4, 5), (1, 2, 3), (1, 3, 4)]
SHEAR = np.array([[1.1, 0.2, 0.0], [0.0, 0.9, 0.3], [0.1, 0.0, 1.2]])


class Drawn(NamedTuple):
    """Points [n, 3], faces (triangles, then quadrilaterals, then polygons), and what goes with them."""

    points: Any
    faces: list[list[int]]
    triangles: list[list[int]]  # the same surface
    patches: dict[str, list[int]]
    arrays: dict[str, Any]
    cell_arrays: dict[str, Any]

    def cut(self) -> Drawn:
        """The same surface of triangles, with the arrays of its points."""
        return self._replace(faces=self.triangles, patches={}, cell_arrays={})


def barrel(sides: int, rows: int) -> tuple[Any, list[list[int]], list[list[int]]]:
    """A closed barrel: points, faces wound outwards, and the same of triangles."""
    turn = 2 * np.pi * np.arange(sides) / sides
    points = [[0.0, 0.0, -1.5]]
    for row in range(rows):
        radius = 1.0 + 0.25 * (row % 2)
        circle = [radius * np.cos(turn), 0.5 * radius * np.sin(turn), np.full(sides, row - 1.0)]
        points += np.column_stack(circle).tolist()
    points.append([0.25, 0.0, rows - 1.5])
    at = lambda row, i: 1 + row * sides + i % sides  # noqa: E731
    caps = [[0, at(0, i + 1), at(0, i)] for i in range(sides)]
    caps += [[len(points) - 1, at(rows - 1, i), at(rows - 1, i + 1)] for i in range(sides)]
    quads = [[at(j, i), at(j, i + 1), at(j + 1, i + 1), at(j + 1, i)] for j in range(rows - 1) for i in range(sides)]
    halves = [[a, b, c] for a, b, c, _ in quads] + [[a, c, d] for a, _, c, d in quads]
    return np.array(points), caps + quads, caps + halves


def prism() -> tuple[Any, list[list[int]], list[list[int]]]:
    """A prism with the outline of a U."""
    points = np.array([[x, y, z] for z in (0.0, 1.0) for x, y in OUTLINE])
    quads = [[i, (i + 1) % 8, (i + 1) % 8 + 8, i + 8] for i in range(8)]
    ends = [list(range(7, -1, -1)), list(range(8, 16))]
    halves = [[a, b, c] for a, b, c, _ in quads] + [[a, c, d] for a, _, c, d in quads]
    flat = [[c, b, a] for a, b, c in CUT] + [[a + 8, b + 8, c + 8] for a, b, c in CUT]
    return points, quads + ends, halves + flat


@st.composite
def drawn(draw: Any, corners: int, odd: bool) -> Drawn:
    """One to three pieces, of faces of at most `corners` corners, with a patch and values each."""
    points, faces, triangles, owner = [], [], [], []
    pieces = draw(st.lists(st.sampled_from(["barrel", "prism"] if corners > 4 else ["barrel"]), min_size=1, max_size=3))
    count = 0
    for number, kind in enumerate(pieces):
        piece = prism() if kind == "prism" else barrel(draw(st.integers(3, 6)), draw(st.integers(2, 3)))
        own, polygons, cut = piece
        polygons = cut if corners == 3 else polygons
        points.append(own + np.array([4.0 * number, draw(st.floats(-1, 1)), 1 / 3]))
        faces += [[k + count for k in face] for face in polygons]
        triangles += [[k + count for k in face] for face in cut]
        owner += [number] * len(polygons)
        count += len(own)
    if draw(st.booleans()):
        points.append(np.array([[9.0, 9.0, 9.0]]))  # a vertex that nothing uses
    order = sorted(range(len(faces)), key=lambda i: min(len(faces[i]), 5))
    names = draw(st.permutations(NAMES + (ODD if odd else [])))
    scale = draw(st.sampled_from([1e-3, 1.0, 1234.5]))
    places = scale * np.concatenate(points)
    values = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return Drawn(
        places,
        [faces[i] for i in order],
        triangles,
        {names[piece]: [k for k, i in enumerate(order) if owner[i] == piece] for piece in range(len(pieces))},
        {names[0]: values.normal(size=len(places)), names[1]: values.normal(size=(len(places), 3))},
        {names[2]: values.normal(size=len(faces))},
    )


# --- the writers ------------------------------------------------------------------------------------------------------


class Writer(NamedTuple):
    """How a library writes a drawn mesh, and what a file of it keeps."""

    write: Callable[[Path, Drawn], None]
    ending: str
    corners: int = 4  # the most that a face has
    accuracy: float = 1e-15  # of the largest coordinate
    digits: float = 0.0  # behind the point
    keeps: str = ""  # of "point scalar", "point", "cell", "patches"
    odd: bool = False  # names of any text
    library: str = ""  # a program of its own
    winding: bool = True  # faces keep it
    ordered: bool = True  # points keep their order


def by_meshio(*, patches: str = "", arrays: str = "", **options: Any) -> Callable[[Path, Drawn], None]:
    def write(path: Path, mesh: Drawn) -> None:
        sizes = sorted({len(face) for face in mesh.faces})
        rows = {size: [i for i, face in enumerate(mesh.faces) if len(face) == size] for size in sizes}
        kinds = {3: "triangle", 4: "quad", 8: "polygon"}
        blocks: list[Any] = [(kinds[size], np.array([mesh.faces[i] for i in rows[size]])) for size in sizes]
        more: dict[str, Any] = {}
        if patches == "sets":
            more["cell_sets"] = {
                name: [np.flatnonzero(np.isin(rows[size], own)) for size in sizes] for name, own in mesh.patches.items()
            }
        if patches == "physical":
            group = np.zeros(len(mesh.faces), np.int64)
            for tag, own in enumerate(mesh.patches.values(), 1):
                group[own] = tag
            more["cell_data"] = {k: [group[rows[s]] for s in sizes] for k in ("gmsh:physical", "gmsh:geometrical")}
            more["field_data"] = {name: np.array([tag, 2]) for tag, name in enumerate(mesh.patches, 1)}
        if "point" in arrays:
            more["point_data"] = {k: v for k, v in mesh.arrays.items() if v.ndim == 1 or "scalar" not in arrays}
        if "cell" in arrays:
            more["cell_data"] = {name: [values[rows[s]] for s in sizes] for name, values in mesh.cell_arrays.items()}
        meshio.write(path, meshio.Mesh(mesh.points, blocks, **more), **options)

    return write


def by_trimesh(arrays: bool = False, **options: Any) -> Callable[[Path, Drawn], None]:
    def write(path: Path, mesh: Drawn) -> None:
        made = trimesh.Trimesh(mesh.points, np.array(mesh.faces), process=False)
        if arrays:
            made.vertex_attributes.update({name: values for name, values in mesh.arrays.items() if values.ndim == 1})
        made.export(path, **options)

    return write


def polydata(mesh: Drawn, rows: list[int] | None = None) -> Any:
    listed = range(len(mesh.faces)) if rows is None else rows
    made = pyvista.PolyData(mesh.points, faces=[k for i in listed for k in (len(mesh.faces[i]), *mesh.faces[i])])
    for name, values in mesh.arrays.items():
        made.point_data[name] = values
    for name, values in mesh.cell_arrays.items():
        made.cell_data[name] = values if rows is None else values[rows]
    return made


def by_pyvista(binary: bool = True, kind: str = "") -> Callable[[Path, Drawn], None]:
    def write(path: Path, mesh: Drawn) -> None:
        if kind == "blocks":
            made = pyvista.MultiBlock({name: polydata(mesh, rows) for name, rows in mesh.patches.items()})
        else:
            made = polydata(mesh).cast_to_unstructured_grid() if kind == "grid" else polydata(mesh)
        made.save(path, binary=binary)

    return write


def lines(path: Path, listed: list[str]) -> None:
    path.write_text("\n".join([*listed, ""]), encoding="utf-8")


def text_obj(path: Path, mesh: Drawn) -> None:
    listed = ["mtllib none.mtl", "vt 0 0", "vn 0 0 1", *(f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.points.tolist())]
    for name, rows in mesh.patches.items():
        listed += [f"g {name}", *("f " + " ".join(f"{k + 1}/1/1" for k in mesh.faces[i]) for i in rows)]
    lines(path, listed)


def text_off(path: Path, mesh: Drawn) -> None:
    faces = [f"{len(face)} {' '.join(map(str, face))} 255 0 0" for face in mesh.faces]
    points = [f"{x!r} {y!r} {z!r}" for x, y, z in mesh.points.tolist()]
    lines(path, ["OFF  # by hand", "", f"{len(points)} {len(faces)} 0", *points, *faces])


def text_ply(path: Path, mesh: Drawn) -> None:
    scalar = next(name for name, values in mesh.arrays.items() if values.ndim == 1)
    (own,) = mesh.cell_arrays
    rows = zip(mesh.points.tolist(), mesh.arrays[scalar].tolist(), strict=True)
    faces = zip(mesh.faces, mesh.cell_arrays[own].tolist(), strict=True)
    listed = ["ply", "format ascii 1.0", "comment by hand", f"element vertex {len(mesh.points)}"]
    listed += [*(f"property double {axis}" for axis in "xyz"), f"property double {scalar}"]
    listed += [f"element face {len(mesh.faces)}", f"property double {own}", "property list uchar int vertex_indices"]
    listed += ["end_header", *(" ".join(map(repr, [*point, value])) for point, value in rows)]
    lines(path, listed + [f"{value!r} {len(face)} {' '.join(map(str, face))}" for face, value in faces])


def text_nastran(path: Path, mesh: Drawn) -> None:
    listed = ["SOL 101", "CEND", "BEGIN BULK"]
    for number, point in enumerate(mesh.points.tolist()):
        x, y, z = (f"{value:.9E}".replace("E-0", "-").replace("E+0", "+") for value in point)
        listed += [f"GRID*   {3 * number + 10:16d}{'':16}{x:>16}{y:>16}", f"*       {z:>16}"]
    group = {i: number for number, rows in enumerate(mesh.patches.values(), 1) for i in rows}
    for i, face in enumerate(mesh.faces):
        listed.append(
            f"CTRIA3,{i + 1},{group[i]},".replace("CTRIA3", {3: "CTRIA3", 4: "CQUAD4"}[len(face)])
            + ",".join(str(3 * k + 10) for k in face)
        )
    lines(path, [*listed, "ENDDATA"])


def text_abaqus(path: Path, mesh: Drawn) -> None:
    listed = ["*Heading", "*Node"]
    listed += [f"{7 * k + 5}, {x!r}, {y!r}, {z!r}" for k, (x, y, z) in enumerate(mesh.points.tolist())]
    for name, rows in mesh.patches.items():
        for size, kind in ((3, "S3"), (4, "S4R")):
            listed.append(f"*Element, type={kind}, elset={name}")
            own = [i for i in rows if len(mesh.faces[i]) == size]
            listed += [", ".join(map(str, [i + 1, *(7 * k + 5 for k in mesh.faces[i])])) for i in own]
    lines(path, listed)


def by_program(library: str, **options: Any) -> Callable[[Path, Drawn], None]:
    def write(path: Path, mesh: Drawn) -> None:
        scalar = next((values.tolist() for values in mesh.arrays.values() if values.ndim == 1), None)
        request = {"points": mesh.points.tolist(), "faces": mesh.faces, "patches": mesh.patches, "values": scalar}
        ask(library, {**request, "path": str(path), "options": options})

    return write


def gmsh(ending: str, accuracy: float = 1e-15, keeps: str = "patches", **options: float) -> Writer:
    named = {f"Mesh.{name}": value for name, value in options.items()}
    return Writer(by_program("gmsh", **named), ending, 4, accuracy, keeps=keeps, library="gmsh")


def lab(ending: str, accuracy: float = 1e-15, keeps: str = "", **options: Any) -> Writer:
    return Writer(by_program("pymeshlab", **options), ending, 3, accuracy, keeps=keeps, library="pymeshlab")


def open3d(ending: str, accuracy: float = 1e-15, **options: Any) -> Writer:
    return Writer(by_program("open3d", **options), ending, 3, accuracy, library="open3d")


SINGLE = 1e-6  # seven digits
ALL = "point cell"
WRITERS: dict[str, Writer] = {
    "meshio obj": Writer(by_meshio(), ".obj", 8),
    "meshio off": Writer(by_meshio(), ".off", 3),
    "meshio ply": Writer(by_meshio(arrays="point scalar"), ".ply", keeps="point scalar"),
    "meshio text ply": Writer(by_meshio(arrays="point scalar", binary=False), ".ply", keeps="point scalar"),
    "meshio stl": Writer(by_meshio(binary=True), ".stl", 3, SINGLE),
    "meshio text stl": Writer(by_meshio(binary=False), ".stl", 3),
    "meshio vtk": Writer(by_meshio(arrays=ALL), ".vtk", 8, keeps=ALL),
    "meshio text vtk": Writer(by_meshio(arrays=ALL, binary=False), ".vtk", 8, keeps=ALL),
    "meshio vtk 4.2": Writer(by_meshio(arrays=ALL, file_format="vtk42"), ".vtk", 8, keeps=ALL),
    "meshio vtu": Writer(by_meshio(arrays=ALL), ".vtu", 8, keeps=ALL, odd=True),
    "meshio text vtu": Writer(by_meshio(arrays=ALL, binary=False), ".vtu", 8, 1e-11, keeps=ALL, odd=True),
    "meshio abaqus": Writer(by_meshio(patches="sets"), ".inp", keeps="patches"),
    "meshio gmsh 2.2": Writer(by_meshio(patches="physical", file_format="gmsh22"), ".msh", keeps="patches"),
    "meshio text gmsh 4.1": Writer(by_meshio(file_format="gmsh", binary=False), ".msh", 3),
    "meshio gmsh 4.1": Writer(by_meshio(file_format="gmsh"), ".msh", 3),
    "meshio kratos": Writer(by_meshio(), ".mdpa"),
    "meshio medit": Writer(by_meshio(), ".mesh"),
    "meshio binary medit": Writer(by_meshio(), ".meshb"),
    "meshio avs": Writer(
        by_meshio(arrays="point"), ".avs", 4, 1e-14, keeps="point"
    ),  # its reader fails on its cell arrays
    "meshio xdmf": Writer(by_meshio(arrays=ALL, data_format="XML"), ".xdmf", keeps=ALL),
    "meshio xdmf with hdf": Writer(by_meshio(arrays=ALL), ".xdmf", keeps=ALL),
    "meshio med": Writer(by_meshio(), ".med"),
    "meshio ugrid": Writer(by_meshio(), ".lb8.ugrid"),
    "trimesh obj": Writer(by_trimesh(), ".obj", 3, 1e-6, 1e-8),
    "trimesh ply": Writer(by_trimesh(True), ".ply", 3, SINGLE, keeps="point scalar"),
    "trimesh text ply": Writer(by_trimesh(encoding="ascii"), ".ply", 3, SINGLE, 1e-8),
    "trimesh off": Writer(by_trimesh(), ".off", 3, 1e-6, 1e-8),
    "trimesh stl": Writer(by_trimesh(), ".stl", 3, SINGLE),
    "trimesh text stl": Writer(by_trimesh(file_type="stl_ascii"), ".stl", 3, SINGLE, 1e-8),
    "trimesh glb": Writer(by_trimesh(), ".glb", 3, SINGLE),
    "pyvista vtp": Writer(by_pyvista(), ".vtp", 8, keeps=ALL, odd=True),
    "pyvista text vtp": Writer(by_pyvista(False), ".vtp", 8, 1e-8, keeps=ALL, odd=True),
    "pyvista vtk": Writer(by_pyvista(), ".vtk", 8, keeps=ALL, odd=True),
    "pyvista text vtk": Writer(by_pyvista(False), ".vtk", 8, 1e-8, keeps=ALL, odd=True),
    "pyvista vtu": Writer(by_pyvista(kind="grid"), ".vtu", 8, keeps=ALL, odd=True),
    "pyvista grid vtk": Writer(by_pyvista(kind="grid"), ".vtk", 8, keeps=ALL, odd=True),
    "pyvista vtm": Writer(by_pyvista(kind="blocks"), ".vtm", 8, keeps="patches", odd=True),
    "pyvista ply": Writer(by_pyvista(), ".ply", 8, SINGLE),
    "pyvista stl": Writer(by_pyvista(), ".stl", 3, SINGLE),
    "text obj": Writer(text_obj, ".obj", 8, keeps="patches"),
    "text off": Writer(text_off, ".off", 8),
    "text ply": Writer(text_ply, ".ply", 8, keeps="point scalar cell"),
    "text nastran": Writer(text_nastran, ".bdf", 4, 1e-9),
    "text abaqus": Writer(text_abaqus, ".inp", keeps="patches"),
    "gmsh 4.1": gmsh(".msh"),
    "gmsh binary 4.1": gmsh(".msh", Binary=1),
    "gmsh 2.2": gmsh(".msh", MshFileVersion=2.2),
    "gmsh binary 2.2": gmsh(".msh", MshFileVersion=2.2, Binary=1),
    "gmsh abaqus": gmsh(".inp", 1e-13),
    "gmsh nastran": gmsh(".bdf", 1e-5, keeps="")._replace(digits=1e-5),
    "gmsh vtk": gmsh(".vtk", 1e-13, keeps=""),
    "gmsh medit": gmsh(".mesh", 1e-13, keeps=""),
    "gmsh cgns": gmsh(".cgns", keeps="")._replace(ordered=False),  # Gmsh sorts its points
    "gmsh stl": gmsh(".stl", SINGLE, keeps="", Binary=1),
    "gmsh text stl": gmsh(".stl", 1e-8, keeps=""),
    "gmsh off": gmsh(".off", 1e-5, keeps=""),
    "meshlab ply": lab(".ply", keeps="quality"),
    "meshlab text ply": lab(".ply", keeps="quality", binary=False),
    "meshlab obj": lab(".obj", SINGLE),
    "meshlab off": lab(".off")._replace(winding=False),
    "meshlab stl": lab(".stl", SINGLE),
    "meshlab text stl": lab(".stl", SINGLE, binary=False),
    "open3d ply": open3d(".ply"),
    "open3d text ply": open3d(".ply", 1e-5, write_ascii=True),
    "open3d obj": open3d(".obj", 1e-5),
    "open3d off": open3d(".off", 1e-5),
    "open3d stl": open3d(".stl", SINGLE),
    "open3d glb": open3d(".glb", SINGLE),
}

# --- the programs -----------------------------------------------------------------------------------------------------

ROOT = Path(__file__).parent.parent
PROGRAMS: dict[str, Any] = {}
TRIED: Counter[str] = Counter()


def program(library: str) -> Any:
    """The program that writes for a library; the test skips where there is none."""
    if library not in PROGRAMS:
        python = os.environ.get("RBFEVO_WRITERS", str(ROOT / ".venv" / "writers" / "bin" / "python"))
        command = [python if Path(python).exists() else sys.executable, str(ROOT / "tests" / "foreign_writers.py")]
        pipe, nothing = subprocess.PIPE, subprocess.DEVNULL
        started = subprocess.Popen([*command, library], stdin=pipe, stdout=pipe, stderr=nothing, text=True)
        PROGRAMS[library] = started, json.loads(started.stdout.readline() if started.stdout else "{}")
    started, reply = PROGRAMS[library]
    if "missing" in reply:
        pytest.skip(f"{library} is not there ({reply['missing']}): scripts/writers installs it")
    return started


def ask(library: str, request: dict[str, Any]) -> dict[str, Any]:
    started = program(library)
    started.stdin.write(json.dumps(request) + "\n")
    started.stdin.flush()
    reply = json.loads(started.stdout.readline())
    if "error" in reply:
        raise ValueError(reply["error"])
    return reply


@pytest.fixture(scope="module", autouse=True)
def _programs_end() -> Iterator[None]:
    yield
    for started, _ in PROGRAMS.values():
        started.stdin.close()
        started.stdout.close()
        started.wait(timeout=30)
    PROGRAMS.clear()
    print("".join(f"\n{name}: {count}" for name, count in sorted(TRIED.items())))


# --- the readers of others --------------------------------------------------------------------------------------------


def by_their_meshio(path: Path) -> tuple[Any, list[list[int]]]:
    mesh = meshio.read(path)
    faces = [block.data.tolist() for block in mesh.cells if block.type in ("triangle", "quad", "polygon")]
    return mesh.points, [face for own in faces for face in own]


def by_their_trimesh(path: Path) -> tuple[Any, list[list[int]]]:
    mesh: Any = trimesh.load(path, process=False, force="mesh")
    return mesh.vertices, mesh.faces.tolist()


def by_their_pyvista(path: Path) -> tuple[Any, list[list[int]]]:
    mesh: Any = pyvista.read(path)
    mesh = mesh.combine() if isinstance(mesh, pyvista.MultiBlock) else mesh
    mesh = mesh.cast_to_unstructured_grid()
    offsets = mesh.cell_offsets if hasattr(mesh, "cell_offsets") else mesh.offset
    flat = mesh.cell_connectivity
    listed = [own.tolist() for own in np.split(flat, offsets[1:-1])]
    return mesh.points, [face for face, kind in zip(listed, mesh.celltypes, strict=True) if kind in (5, 7, 9)]


def by_their_program(library: str) -> Callable[[Path], tuple[Any, list[list[int]]]]:
    def read(path: Path) -> tuple[Any, list[list[int]]]:
        reply = ask(library, {"path": str(path)})
        return np.array(reply["points"]), reply["faces"]

    return read


READERS: dict[str, tuple[Callable[[Path], tuple[Any, list[list[int]]]], str]] = {
    "meshio": (
        by_their_meshio,
        ".obj .off .ply .stl .vtk .vtu .inp .msh .mdpa .mesh .meshb .avs .xdmf .med .su2 .bdf .nas",
    ),
    "trimesh": (by_their_trimesh, ".obj .off .ply .stl .glb"),
    "pyvista": (by_their_pyvista, ".obj .ply .stl .vtk .vtp .vtu .vtm"),
    "gmsh": (by_their_program("gmsh"), ".msh .stl .bdf .mesh .off .cgns .vtk"),
    "pymeshlab": (by_their_program("pymeshlab"), ".obj .off .ply .stl"),
    "open3d": (by_their_program("open3d"), ".obj .off .ply .stl .glb"),
}


def area(points: Any, faces: list[list[int]]) -> float:
    """By the outlines of planar polygons, and the first diagonal of quadrilaterals."""
    total = 0.0
    for face in faces:
        p = np.asarray(points, np.float64)[face]
        if len(face) == 4:
            total += area(p, [[0, 1, 2], [0, 2, 3]])
        else:
            total += float(np.linalg.norm(np.cross(p, np.roll(p, -1, axis=0)).sum(axis=0)) / 2.0)
    return total


def volume(points: Any, faces: list[list[int]]) -> float:
    a, b, c = np.moveaxis(np.asarray(points)[np.array(faces)], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def key(face: Any, winding: bool = True) -> tuple[int, ...]:
    """A face from its smallest corner on."""
    listed = [int(k) for k in face]
    start = listed.index(min(listed))
    found = (*listed[start:], *listed[:start])
    return found if winding else min(found, (found[0], *found[:0:-1]))


def faces_of(mesh: meshes.Mesh) -> list[list[int]]:
    """The faces of a mesh, without lines and points."""
    listed = np.split(mesh.cells.corners, np.cumsum(mesh.cells.sizes)[:-1])
    return [own.tolist() for own, kind in zip(listed, mesh.cells.kinds, strict=True) if kind in (5, 7, 9)]


@pytest.mark.parametrize("name", WRITERS)
def test_what_other_libraries_write_is_the_mesh_that_was_drawn(
    name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    writer = WRITERS[name]
    if writer.library:
        program(writer.library)

    @settings(max_examples=MESHES, phases=[Phase.generate], suppress_health_check=[HealthCheck.too_slow])
    @given(mesh=drawn(writer.corners, writer.odd))
    def trial(mesh: Drawn) -> None:
        check_written_mesh(name, mesh, tmp_path_factory.mktemp("drawn"))

    trial()


def check_written_mesh(name: str, mesh: Drawn, folder: Path) -> None:
    """Write a mesh by another library, read it, deform and write it again, and compare with what was drawn."""
    writer = WRITERS[name]
    path = folder / f"a{writer.ending}"
    writer.write(path, mesh)
    TRIED[name] += 1
    largest = float(np.abs(mesh.points).max())
    close = writer.accuracy * largest + writer.digits
    loose = max(1e-12, 1e3 * close / largest)
    template = read_template(path)
    # A warped quadrilateral may be cut at either diagonal: those of a barrel are flat, and so are sheared ones.
    assert area(template.vertices, template.triangles.tolist()) == pytest.approx(
        area(mesh.points, mesh.faces), rel=loose
    )
    if writer.winding:
        assert volume(template.vertices, template.triangles.tolist()) == pytest.approx(
            volume(mesh.points - mesh.points[0], mesh.triangles), rel=loose
        )
    used = np.unique(np.concatenate([np.array(face) for face in mesh.faces]))
    # STL has no order of vertices, and a VTM file several parts.
    ordered = writer.ordered and writer.ending not in (".stl", ".vtm")
    if ordered:
        np.testing.assert_allclose(template.vertices, mesh.points[used], atol=close, rtol=0)
    elif writer.ending == ".stl":
        assert len(template.vertices) == len(used)
    with meshes.opened(path) as opened:
        kept(writer, mesh, opened, ordered)
        moved = opened.points @ SHEAR  # which keeps flat polygons flat
        out = folder / ("out.vtu" if writer.ending in (".vtm", ".cgns", ".lb8.ugrid") else f"out{writer.ending}")
        meshes.write(opened, path, moved, moved - opened.points, out)
    single = SINGLE if writer.ending in (".ply", ".stl", ".glb", ".vtk", ".vtp", ".vtm", ".avs", ".bdf") else 1e-15
    with meshes.opened(out) as again:
        np.testing.assert_array_equal(again.cells.corners, opened.cells.corners)
        np.testing.assert_allclose(again.points, moved, atol=single * np.abs(moved).max(), rtol=0)
    faces = faces_of(opened)
    for library, (read, endings) in READERS.items():
        if out.suffix not in endings.split() or (library in FANS and max(map(len, mesh.faces)) > 4):
            continue
        try:
            points, read_back = read(out)
        except (Exception, SystemExit, pytest.skip.Exception) as error:  # libraries raise whatever they like
            TRIED[f"{library} does not read what {name} has written ({type(error).__name__})"] += 1
            continue
        with np.errstate(over="ignore"):
            found = area(points, read_back) if np.shape(points)[1:] == (3,) else np.nan
        right = found == pytest.approx(area(moved, faces), rel=1e-5)
        if not right and (library, name) in MISREAD:
            TRIED[f"{library} misreads what {name} has written"] += 1
            continue
        assert right, (library, name)
        assert len(read_back) in (len(faces), len(mesh.triangles)), (library, name)


# Open3D leaves out the quadrilaterals of OBJ, and MeshLab and Open3D all faces of OFF with more than three numbers a
# point or a comment; meshio takes six numbers of an OBJ's point with colours for coordinates.
MISREAD = {
    *(("open3d", name) for name in ("meshio obj", "text obj", "text off", "meshlab off", "gmsh off")),
    *(("pymeshlab", name) for name in ("text off", "meshlab off", "gmsh off")),
    *(("meshio", name) for name in ("meshlab obj", "open3d obj")),
}
FANS = {"trimesh"}  # which takes concave polygons for fans: an area of 44 for 33.5


def kept(writer: Writer, mesh: Drawn, opened: meshes.Mesh, ordered: bool) -> None:
    """The faces, arrays and patches of a file that a writer keeps."""
    listed = np.split(opened.cells.corners, np.cumsum(opened.cells.sizes)[:-1])
    if ordered:
        faces = [key(face, writer.winding) for face in faces_of(opened)]
        wanted = [key(face, writer.winding) for face in mesh.faces]
        assert sorted(faces) == sorted(wanted)
    if "point" in writer.keeps:
        for name, values in mesh.arrays.items():
            if values.ndim == 1 or "scalar" not in writer.keeps:
                np.testing.assert_allclose(opened.arrays[name], values, rtol=max(writer.accuracy, 1e-15))
    if "quality" in writer.keeps:
        values = next(values for values in mesh.arrays.values() if values.ndim == 1)
        np.testing.assert_allclose(opened.arrays["quality"], values, rtol=1e-6)
    if "cell" in writer.keeps:
        for name, values in mesh.cell_arrays.items():
            found = {key(face): value for face, value in zip(listed, opened.cell_arrays[name], strict=True)}
            wanted = {key(face): value for face, value in zip(mesh.faces, values, strict=True)}
            assert found.keys() == wanted.keys()
            np.testing.assert_allclose(
                [found[face] for face in wanted], list(wanted.values()), rtol=max(writer.accuracy, 1e-15)
            )
    if "patches" in writer.keeps and ordered:
        if len(mesh.patches) > 1 or opened.patches:
            found = {name: sorted(key(listed[i]) for i in own) for name, own in opened.patches.items()}
            wanted = {name: sorted(key(mesh.faces[i]) for i in own) for name, own in mesh.patches.items()}
            more = {f"Surface{i + 1}" for i in range(len(wanted))} if writer.library == "gmsh" else set()
            assert {name: own for name, own in found.items() if name not in more} == wanted
    elif "patches" in writer.keeps and len(mesh.patches) > 1:
        assert {name: len(own) for name, own in opened.patches.items()} == {
            name: len(own) for name, own in mesh.patches.items()
        }


@pytest.mark.parametrize(
    "name", sorted(set(REFUSED) - {"star.obj"})
)  # no area belongs to a polygon that crosses itself
def test_no_two_libraries_read_alike_what_is_refused(name: str, tmp_path: Path) -> None:
    """What rbfevo refuses (tests/test_mesh_files.py) is not a mesh that others agree about."""
    path = tmp_path / name
    path.write_bytes(REFUSED[name][0])
    seen: list[tuple[str, int, float]] = []
    for library, (read, endings) in READERS.items():
        if path.suffix not in endings.split() or library == "pymeshlab":  # it never comes back from a short STL
            continue
        try:
            points, faces = read(path)
            used = np.unique([k for face in faces for k in face])
            found = len(np.unique(np.asarray(points)[used], axis=0)), area(points, faces)
        except (Exception, SystemExit, pytest.skip.Exception):  # libraries raise whatever they like
            continue
        for other, count, other_area in seen:
            assert (count, other_area) != (found[0], pytest.approx(found[1])), (library, other)
        seen.append((library, *found))
