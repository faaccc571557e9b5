"""Values that are no text: VTK files, flat arrays, arrays beside their coordinates; and what a `point` column is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
from test_export import a_run
from test_vertex_arrays import PICKED, POINTS, ROWS, VALUES, VECTORS, lines, refusal, template, write

from rbfevo import apply
from rbfevo.errors import UserError
from rbfevo.scenarios import mesh, vertex_arrays
from rbfevo.scenarios.vertex_arrays import VertexArray

LARGE = np.arange(12.0)


def found(source: str, what: str = "sensitivity", of: Any = None, **how: str) -> VertexArray:
    return vertex_arrays.vertex_array(source, of or template(), what, **how)


ORDER = np.array([3, 0, 4, 2, 1])


@pytest.mark.parametrize(
    ("ids", "told"),
    [
        (ORDER, "rows by 'point', from 0"),
        (ORDER + 1, "rows by 'point', from 1"),
    ],
)
def test_a_column_point_holds_ids_where_it_can(ids: np.ndarray, told: str, tmp_path: Path) -> None:
    table = write(tmp_path, "a.csv", lines("point,v", ids, VALUES[ORDER]))
    np.testing.assert_array_equal(found(table).values, PICKED)
    assert told in found(table).note


@pytest.mark.parametrize(
    "ids",
    [ORDER + 0.5, np.array([3, 0, 4, 2, 2]), ORDER + 2, -ORDER],
    ids=["fractions", "twice", "too high", "negative"],
)
def test_a_column_point_that_cannot_hold_ids_holds_values(ids: np.ndarray, tmp_path: Path) -> None:
    """Then it is one of two quantities, and the question is which; alone it is the quantity, as whole numbers are."""
    both = write(tmp_path, "a.csv", lines("point,v", ids, VALUES))
    assert "2 columns or vectors of values (point; v)" in refusal(both)
    np.testing.assert_array_equal(found(f"{both}:v").values, PICKED)
    np.testing.assert_array_equal(found(f"{both}:point").values, ids[ROWS])
    named = write(tmp_path, "c.csv", lines("point,sensitivity", ids, VALUES))
    np.testing.assert_array_equal(found(named).values, PICKED)
    for alone in (ids, ORDER):
        table = write(tmp_path, "b.csv", lines("point", alone))
        np.testing.assert_array_equal(found(table).values, alone[ROWS])
    text = lines("v,point", VALUES, VALUES).replace(",", ",P")
    np.testing.assert_array_equal(found(f"{write(tmp_path, 'd.csv', text)}:v").values, PICKED)


def test_ids_tell_apart_what_coordinates_cannot(tmp_path: Path) -> None:
    """Vertices that coincide, and rows that are nearer to each other than the tolerance."""
    same = POINTS.copy()
    same[3] = same[2]
    twins = template(vertices=same[ROWS])
    table = write(tmp_path, "a.csv", lines("id,x,y,z,v", ORDER, *same[ORDER].T, VALUES[ORDER]))
    np.testing.assert_array_equal(found(table, of=twins).values, PICKED)
    fine = np.zeros((15001, 3))
    fine[:, 0] = np.linspace(0.0, 1.0, len(fine))  # a shift by one stays within the tolerance everywhere
    inner, values = np.arange(1, len(fine) - 1), np.sin(40.0 * fine[:, 0])
    row = template(vertices=fine[inner], rows=inner, count=len(fine), triangles=np.array([[0, 1, 2]]))
    order = np.random.default_rng(0).permutation(len(fine))
    for first in (0, 1):
        table = write(tmp_path, "b.csv", lines("id,x,y,z,v", order + first, *fine[order].T, values[order]))
        np.testing.assert_array_equal(found(table, of=row).values, values[inner])
        assert f"rows by 'id', from {first}, coordinates agree to 0" in found(table, of=row).note


def test_two_coordinates_are_enough_in_a_plane(tmp_path: Path) -> None:
    flat = template(vertices=POINTS[ROWS] * [1, 1, 0] + [0, 0, 0.25])
    table = write(tmp_path, "a.csv", lines("x,y,s_x,s_y", *POINTS[ORDER, :2].T, *VECTORS[ORDER, :2].T))
    np.testing.assert_array_equal(found(table, of=flat).values, VECTORS[ROWS] * [1, 1, 0])
    assert "it has 2 of three coordinates" in refusal(table)


def test_arrays_of_a_vtk_file_are_matched_by_coordinates(tmp_path: Path) -> None:
    cloud = pv.PolyData(POINTS[ORDER])
    cloud.point_data["v"] = VALUES[ORDER]
    cloud.point_data["shape_sensitivity"] = VECTORS[ORDER]
    for name in ("a.vtp", "a.vtk"):
        cloud.save(tmp_path / name)
        np.testing.assert_array_equal(found(str(tmp_path / name)).values, VECTORS[ROWS])
        np.testing.assert_array_equal(found(f"{tmp_path / name}:V").values, PICKED)
        assert found(str(tmp_path / name)).names == ("a", *(f"shape_sensitivity_{axis}" for axis in "xyz"))
    assert "2 columns or vectors of values" in refusal(str(tmp_path / "a.vtp"), what="fixed")
    assert "give its name behind the file's, as in FILE:v" in refusal(str(tmp_path / "a.vtp"), what="fixed")
    bare = pv.PolyData(POINTS)
    bare.save(tmp_path / "b.vtp")
    assert "it has no point arrays" in refusal(str(tmp_path / "b.vtp"))
    bare.cell_data["c"] = VALUES
    bare.save(tmp_path / "c.vtp")
    assert "it has no point arrays (its cell arrays, c, would have to be converted)" in refusal(str(tmp_path / "c.vtp"))
    assert "not a readable VTP file" in refusal(write(tmp_path, "d.vtp", "no mesh"))
    assert "no such file" in refusal(str(tmp_path / "gone.vtu"))


def test_flat_arrays_are_x_y_z_of_one_point_after_another(tmp_path: Path) -> None:
    np.testing.assert_array_equal(found(write(tmp_path, "a.npy", VECTORS.reshape(-1))).values, VECTORS[ROWS])
    np.testing.assert_array_equal(found(write(tmp_path, "b.npy", VECTORS[ROWS].reshape(-1))).values, VECTORS[ROWS])
    cells = template(cell=np.array([0, 11]))  # 12 numbers: for each of 12 cells, or three for each of 4 vertices
    text = refusal(write(tmp_path, "c.npy", LARGE), of=cells)
    assert "may be one for each of the mesh's cells, or x, y, z for each of 4 points" in text
    assert "save it as an array [12, 1] or [4, 3]" in text
    np.testing.assert_array_equal(found(write(tmp_path, "d.npy", LARGE.reshape(4, 3)), of=cells).values.ravel(), LARGE)
    many = template(count=12)  # 12 points, of which 4 are vertices
    assert "one for each of the mesh's points, or x, y, z for each of 4" in refusal(str(tmp_path / "c.npy"), of=many)
    assert found(write(tmp_path, "e.npy", LARGE[:, None]), of=many).values.tolist() == [0.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize("flat", [True, False])
def test_arrays_beside_their_coordinates(flat: bool, tmp_path: Path) -> None:
    """Points that processes or patches share stand there more than once: their derivatives add up."""
    again = np.concatenate([ORDER, ROWS[:2]])
    share = np.array([1.0, 0.75, 1.0, 0.5, 1.0, 0.25, 0.5])  # of 0 and of 2, which come twice
    points, values = POINTS[again], VECTORS[again] * share[:, None]
    arrays = {"x_aero0": points, "sensitivity": values}
    arrays = {name: array.reshape(-1) if flat else array for name, array in arrays.items()}
    table = write(tmp_path, "a.npz", arrays)
    np.testing.assert_allclose(found(table).values, VECTORS[ROWS], rtol=1e-15)
    assert "2 of 7 points repeat others: their values are summed" in found(table).note
    with pytest.raises(UserError, match="repeat others with different values per area"):
        found(table, kind="density")
    same = write(tmp_path, "b.npz", {"points": points, "s": VECTORS[again]})
    np.testing.assert_array_equal(found(same, kind="density").values, VECTORS[ROWS])
    marks = write(tmp_path, "c.npz", {"points": points, "s": (again == 3) * 1.0})
    np.testing.assert_array_equal(found(marks, kind="marks").values, ROWS == 3)
    scalar = write(tmp_path, "d.npz", {"points": POINTS[ORDER], "s": VALUES[ORDER], "t": VALUES})
    np.testing.assert_array_equal(found(f"{scalar}:s").values, PICKED)
    assert "it holds 2 arrays, but none named 'sensitivity': s, t" in refusal(scalar)
    assert "it holds no array u; there are points, s, t" in refusal(f"{scalar}:u")
    twins = template(notes={"coincident vertices": "2"})
    assert "repeat others, and so do vertices" in refusal(table, of=twins)
    for points, message in ((POINTS[:, :2], "shape [5, 2]"), (POINTS[:4], "there are 4 coordinates")):
        assert message in refusal(write(tmp_path, "e.npz", {"points": points, "s": VALUES}))


def test_a_flat_array_is_deformed_and_stays_flat(tmp_path: Path) -> None:
    run = a_run(tmp_path / "run")
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    np.save(tmp_path / "d.npy", np.random.default_rng(1).normal(size=(6, 3)))
    command = [str(run), "--pick", "index:0", "--displacements", str(tmp_path / "d.npy")]
    for name, array in (("rows", points), ("flat", points.reshape(-1))):
        np.save(tmp_path / f"{name}.npy", array)
        out = tmp_path / f"{name}-moved.npy"
        assert apply.main([*command, "--mesh", str(tmp_path / f"{name}.npy"), "--out", str(out)]) == 0
    moved, flat = np.load(tmp_path / "rows-moved.npy"), np.load(tmp_path / "flat-moved.npy")
    assert flat.shape == (60,)
    np.testing.assert_array_equal(flat.reshape(20, 3), moved)
    assert np.abs(moved - points).max() > 0.1
    np.save(tmp_path / "bad.npy", np.zeros(10))
    assert apply.main([*command, "--mesh", str(tmp_path / "bad.npy"), "--out", str(tmp_path / "c.npy")]) == 2


KRATOS = """Begin Nodes
  10 0.0 0.0 0.0
  40 1.0 0.0 0.0
  20 1.0 1.0 0.5
  30 0.0 1.0 0.0
End Nodes
Begin Elements ShellThinElement3D3N
  1 0 10 40 20
  2 0 10 20 30
End Elements
Begin SubModelPart design
  Begin SubModelPartElements
    1
    2
  End SubModelPartElements
End SubModelPart
"""


def test_kratos_by_numbers_of_nodes_and_by_vtk(tmp_path: Path) -> None:
    (tmp_path / "shell.mdpa").write_text(KRATOS)
    nodes = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0]])
    s = np.array([[1.0, 2, 3], [-1, 0.5, 2], [4, 4, 1], [0, 0, -2]])
    order = np.array([2, 3, 0, 1])
    numbers = np.array([10, 40, 20, 30])
    names = "NODE_ID,SHAPE_SENSITIVITY_X,SHAPE_SENSITIVITY_Y,SHAPE_SENSITIVITY_Z"
    by_numbers = write(tmp_path, "a.csv", lines(names, numbers[order], *s[order].T))
    cloud = pv.PolyData(nodes[order].astype(np.float32))
    cloud.point_data["SHAPE_SENSITIVITY"] = s[order]
    cloud.point_data["DISPLACEMENT"] = np.ones((4, 3))
    cloud.save(tmp_path / "shell_0_1.vtk")
    for source in (by_numbers, str(tmp_path / "shell_0_1.vtk")):
        made = mesh(template=str(tmp_path / "shell.mdpa"), patches=["design"], sensitivity=source)
        np.testing.assert_allclose(made.gradient.numpy() * made.gradient_norm, -s, rtol=1e-12)


def test_fluents_sensitivities_of_one_observable(tmp_path: Path) -> None:
    """The count of observables, their names, the count of rows, and rows of coordinates and three components."""
    rows = lines("", *POINTS[ORDER].T, *VECTORS[ORDER].T, between=" ")
    one = found(write(tmp_path, "a.txt", f"1\npressure-drop\n5\n{rows}"))
    np.testing.assert_array_equal(one.values, VECTORS[ROWS])
    assert "observable pressure-drop" in one.note
    several = write(tmp_path, "b.txt", f"2\npressure-drop\npressure\n5\n{rows}")
    assert "it holds several observables (pressure-drop, pressure); export" in refusal(several)
    short = write(tmp_path, "c.txt", f"1\npressure-drop\n6\n{rows}")
    assert "it announces 6 rows, but has 5" in refusal(short)
