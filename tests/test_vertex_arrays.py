"""Numbers of the vertices: by name or from a table, one row for each point, and one clear line for every mistake."""

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from rbfevo.errors import UserError
from rbfevo.scenarios import vertex_arrays
from rbfevo.scenarios.templates import Template
from rbfevo.scenarios.vertex_arrays import ENDINGS

POINTS = np.array([[0.0, 0, 0], [9, 9, 9], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]])
ROWS = np.array([0, 2, 3, 4])
VALUES = np.array([1.5, -7.0, 2.5, -3.0, 4e-3])
VECTORS = np.arange(15.0).reshape(5, 3) - 0.25
PICKED = VALUES[ROWS]


def vertex_array(source: str, of: Template, what: str, **how: str) -> np.ndarray:
    return vertex_arrays.vertex_array(source, of, what, **how).values


def template(**changes) -> Template:
    arrays = {"pressure": PICKED, "normals": VECTORS[ROWS], "uv": np.zeros((4, 2)), "hole": np.array([1, np.nan, 2, 3])}
    settled = {
        "vertices": POINTS[ROWS],
        "triangles": np.array([[0, 1, 2], [0, 2, 3]]),
        "arrays": arrays,
        "rows": ROWS,
        "count": 5,
        "notes": {},
        "cell_arrays": {"stress": np.array([4.0, 8.0])},
        "cell": np.array([0, 1]),
    }
    return Template(**(settled | changes))


def write(folder: Path, name: str, content: str | bytes | np.ndarray | dict) -> str:
    path = folder / name
    if isinstance(content, np.ndarray):
        np.save(path, content)
    elif isinstance(content, dict):
        np.savez(path, **content)
    else:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    return str(path)


def refusal(source: str, what: str = "sensitivity", of: Template | None = None) -> str:
    with pytest.raises(UserError) as caught:
        vertex_array(source, of or template(), what)
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith(f"scenario.{what}={source}: ")
    return text.removeprefix(f"scenario.{what}={source}: ")


# what is read


def test_by_name():
    np.testing.assert_array_equal(vertex_array("pressure", template(), "sensitivity"), PICKED)
    np.testing.assert_array_equal(vertex_array("normals", template(), "sensitivity"), VECTORS[ROWS])


def test_a_name_goes_before_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, "pressure.npy", VALUES)
    both = template(arrays={"pressure.npy": PICKED + 1.0})
    np.testing.assert_array_equal(vertex_array("pressure.npy", both, "fixed"), PICKED + 1.0)
    np.testing.assert_array_equal(vertex_array("pressure.npy", template(), "fixed"), PICKED)


def lines(header: str, *columns: np.ndarray, between: str = ",") -> str:
    rows = [between.join(repr(float(cell)) for cell in row) for row in zip(*columns, strict=True)]
    return "\n".join([header] * bool(header) + rows) + "\n"


COORDINATES = tuple(POINTS.T)
SCALARS = {
    "bare.csv": lines("", VALUES),
    "header.csv": lines("pressure", VALUES),
    "bare.txt": lines("", VALUES).replace("\n", "\r\n"),
    "id.csv": lines("Point ID,pressure", np.arange(5), VALUES),
    "semicolon.csv": lines("node;p", np.arange(5) + 1, VALUES, between=";"),
    "decimal_comma.csv": lines("id;p", np.arange(5), VALUES, between=";").replace(".", ","),
    "space.txt": lines("id value", np.arange(5), VALUES, between=" "),
    "xyz.csv": lines("x,y,z,value", *COORDINATES, VALUES),
    "paraview.csv": lines('"pressure","Points:0","Points:1","Points:2"', VALUES, *COORDINATES),
    "old_paraview.csv": lines("p,Points_0,Points_1,Points_2", VALUES, *COORDINATES),
    "comment.csv": "# made today\n" + lines("", VALUES),
    "named.csv": lines("a,sensitivity,b,c", VALUES * 2, VALUES, VALUES * 3, VALUES),
    "a.npy": VALUES,
    "column.npy": VALUES[:, None],
    "single.npy": VALUES.astype(">f4").astype(np.float64),
    "one.npz": {"anything": VALUES},
    "two.npz": {"other": VALUES * 2, "sensitivity": VALUES},
}


@pytest.mark.parametrize("name", SCALARS)
def test_a_number_for_each_point(tmp_path, name):
    found = vertex_array(write(tmp_path, name, SCALARS[name]), template(), "sensitivity")
    np.testing.assert_allclose(found, PICKED, rtol=1e-6 if name == "single.npy" else 0.0)
    assert found.dtype == np.float64
    assert found.shape == (4,)


VECTOR_TABLES = {
    "bare.csv": lines("", *VECTORS.T),
    "header.csv": lines("sx,sy,sz", *VECTORS.T),
    "xyz.csv": lines("sens[x],sens[y],sens[z]", *VECTORS.T),
    "paraview.csv": lines(
        '"Point ID","s:0","s:1","s:2","s:Magnitude","Points:0","Points:1","Points:2"',
        np.arange(5),
        *VECTORS.T,
        VALUES,
        *COORDINATES,
    ),
    "named.csv": lines("p,sensitivity:0,sensitivity:1,sensitivity:2", VALUES, *VECTORS.T),
    "a.npy": VECTORS,
}


@pytest.mark.parametrize("name", VECTOR_TABLES)
def test_a_vector_for_each_point(tmp_path, name):
    found = vertex_array(write(tmp_path, name, VECTOR_TABLES[name]), template(), "sensitivity")
    np.testing.assert_array_equal(found, VECTORS[ROWS])


def test_a_row_for_each_vertex_is_enough(tmp_path):
    np.testing.assert_array_equal(vertex_array(write(tmp_path, "a.npy", PICKED), template(), "fixed"), PICKED)
    mask = np.array([True, False, False, True])
    np.testing.assert_array_equal(vertex_array(write(tmp_path, "b.npy", mask), template(), "fixed"), [1, 0, 0, 1])
    text = lines("x,y,z,v", *POINTS[ROWS].T, PICKED)
    np.testing.assert_array_equal(vertex_array(write(tmp_path, "c.csv", text), template(), "fixed"), PICKED)


# what is refused


def test_unknown_name():
    message = refusal("presure")
    assert "did you mean 'pressure'?" in message
    assert all(name in message for name in ("hole", "normals", "uv", "stress"))
    assert "did you mean" not in refusal("quite something else")
    assert "it has no point arrays" in refusal("pressure", of=template(arrays={}))


def test_cell_array():
    """Two triangles of equal area, values 4 and 8: shared by thirds, averaged by area, or marked where not 0."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    square = template(vertices=vertices)
    third = np.array([12, 4, 12, 8]) / 3
    np.testing.assert_allclose(vertex_array("stress", square, "sensitivity", kind="nodal"), third)
    np.testing.assert_allclose(vertex_array("stress", square, "sensitivity", kind="density"), [6, 4, 6, 8])
    marks = template(vertices=vertices, cell_arrays={"hold": np.array([0.0, -1.0])})
    assert (vertex_array("hold", marks, "fixed", kind="marks") > 0).tolist() == [True, False, True, True]
    # A quadrilateral cut in two: its value is shared as its area is.
    cut = template(vertices=vertices, cell_arrays={"force": np.array([6.0])}, cell=np.array([0, 0]))
    np.testing.assert_allclose(vertex_array("force", cut, "sensitivity", kind="nodal"), [2, 1, 2, 1])
    inner = template(cell=np.array([-1, -1]))
    assert "belongs to the cells of a volume" in refusal("stress", of=inner)


def test_rows_in_any_order_are_matched(tmp_path):
    """By coordinates, also with rows to spare, and by ids from 0, from 1 or as the file has them."""
    order = np.array([3, 0, 4, 2, 1])
    for name, header, columns in (
        ("xyz.csv", "x,y,z,v", (*POINTS[order].T, VALUES[order])),
        ("id.csv", "PointID,v", (order, VALUES[order])),
        ("id1.csv", "Node Number,v", (order + 1, VALUES[order])),
    ):
        np.testing.assert_array_equal(
            vertex_array(write(tmp_path, name, lines(header, *columns)), template(), "sensitivity"), PICKED
        )
    numbered = template(numbers=np.array([7, 3, 40, 12, 9]))
    table = lines("id,v", np.array([9, 7, 1, 12, 40]), np.array([4.0, 1.0, 99.0, 3.0, 2.0]))
    found = vertex_array(write(tmp_path, "own.csv", table), numbered, "sensitivity")
    np.testing.assert_array_equal(found, [1.0, 2.0, 3.0, 4.0])
    spare = np.concatenate([[[5.0, 5, 5]], POINTS[order]])
    table = lines("x,y,z,v", *spare.T, np.concatenate([[99.0], VALUES[order]]))
    np.testing.assert_array_equal(vertex_array(write(tmp_path, "more.csv", table), template(), "sensitivity"), PICKED)
    table = lines("id,v", np.arange(7), np.arange(7.0))
    assert "from 0 or from 1" in refusal(write(tmp_path, "both.csv", table))


def test_values_of_another_mesh_are_taken_on_request(tmp_path):
    """The nearest row's, or between rows; a table of another unit or another place is asked about or refused."""
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 21)), -1).reshape(-1, 2)
    places = np.column_stack([grid, np.zeros(len(grid))])
    flat = template(
        vertices=np.array([[0.01, 0.02, 0], [1, 0, 0], [0.503, 1, 0], [0, 0.777, 0]]), count=4, rows=np.arange(4)
    )

    def slope(points):
        return 2.0 * points[:, 0] - points[:, 1] + 3.0

    path = write(tmp_path, "fine.csv", lines("x,y,z,v", *places.T, slope(places)))
    assert "scenario.sensitivity_match=nearest or interpolate" in refusal(path, of=flat)
    found = vertex_arrays.vertex_array(path, flat, "sensitivity", "interpolate")
    np.testing.assert_allclose(found.values, slope(flat.vertices), atol=1e-2)
    assert found.other_mesh
    nearest = vertex_arrays.vertex_array(path, flat, "sensitivity", "nearest")
    assert nearest.values.tolist() == pytest.approx([3.0, 5.0, 3.0, 2.2])
    assert "largest distance 0.023" in nearest.note
    path = write(tmp_path, "mm.csv", lines("x,y,z,v", *(1000 * places).T, slope(places)))
    for match in ("exact", "interpolate"):
        with pytest.raises(UserError, match="1000 times the mesh's: another unit"):
            vertex_arrays.vertex_array(path, flat, "sensitivity", match)
    path = write(tmp_path, "far.csv", lines("x,y,z,v", *(places * [0.6, 1, 1]).T, slope(places)))
    with pytest.raises(UserError, match="not of the same surface, or of a part of it"):
        vertex_arrays.vertex_array(path, flat, "sensitivity", "nearest")


def test_zeros_beside_values_are_asked_about(tmp_path):
    columns = (np.arange(5), *np.zeros((3, 5)), VALUES)
    path = write(
        tmp_path, "z.csv", lines("PointID,Sensitivity_x,Sensitivity_y,Sensitivity_z,Surface_Sensitivity", *columns)
    )
    assert "Sensitivity_z is zero in every row, Surface_Sensitivity is not" in refusal(path)


def test_columns_without_names_are_taken_only_where_they_can_be_one_thing(tmp_path):
    assert "two of them are coordinates of the mesh" in refusal(
        write(tmp_path, "a.csv", lines("", POINTS[:, 0], POINTS[:, 1], VALUES))
    )
    assert "only the coordinates" in refusal(write(tmp_path, "b.csv", lines("", *POINTS.T)))
    path = write(tmp_path, "c.csv", lines("", *POINTS[::-1].T, VALUES[::-1]))
    np.testing.assert_array_equal(vertex_array(path, template(), "sensitivity"), PICKED)
    path = write(tmp_path, "d.csv", lines("", *POINTS.T, *VECTORS.T))
    np.testing.assert_array_equal(vertex_array(path, template(), "sensitivity"), VECTORS[ROWS])
    assert "5 columns without names" in refusal(write(tmp_path, "e.csv", lines("", *POINTS.T, VALUES, VALUES)))


def test_no_such_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.csv").mkdir()
    assert refusal("gone.csv") == refusal("some/gone") == "no such file"
    assert "is a directory" in refusal("folder.csv")
    assert ".npy" in refusal(write(tmp_path, "values.xlsx", "x"))
    assert "no such array" in refusal("a\0b")


def test_a_named_array_is_checked_as_well():
    assert "it has 2 columns" in refusal("uv")
    assert "1 of 4 vertices have values that are not finite" in refusal("hole")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("short.csv", lines("", VALUES[:3]), "it has 3 rows, but the mesh has 5 points (4 of them in triangles)"),
        ("long.npy", np.zeros((6, 3)), "it has 6 rows, but the mesh has 5 points"),
        ("two.csv", lines("", VALUES, VALUES), "it has 2 columns"),
        ("named.csv", lines("id,a,b", np.arange(5), VALUES, VALUES * 2), "2 columns or vectors of values (a; b)"),
        ("many.csv", lines("a,b", VALUES, VALUES), "name the one to use sensitivity"),
        ("points.csv", lines("Points:0,Points:1,Points:2", *COORDINATES), "only ids and coordinates"),
        ("id.csv", lines("id", np.arange(5)), "only ids and coordinates"),
        ("moved.csv", lines("x,y,z,v", *(POINTS + 0.01).T, VALUES), "4 of 4 vertices have no row within 0.0001"),
        ("ids.csv", lines("id,v", np.arange(5) * 3, VALUES), "'id' (0 to 12, 5 rows) does not hold the numbers"),
        ("twice.csv", lines("id,v", np.array([0, 1, 2, 3, 3]), VALUES), "'id' holds 1 ids more than once"),
        ("places.csv", lines("x,y,z", *VECTORS.T), "it holds only ids and coordinates (x, y, z) and no values"),
        ("nan.csv", lines("", np.where(VALUES < 0, np.nan, VALUES)), "1 of 4 vertices have values"),
        ("empty.csv", " \n", "the file is empty"),
        ("header.csv", "a,b\n", "there are no lines with numbers in it"),
        ("words.csv", "a\n1\n2\nthree\n4\n5\n", "not a readable CSV file"),
        ("ragged.txt", "1 2\n3\n", "not a readable TXT file"),
        ("cube.npy", np.zeros((5, 3, 1)), "it is of shape 5 x 3 x 1"),
        ("number.npy", np.array(3.0), "it is of shape none"),
        ("text.npy", np.array(["a"] * 5), "not real numbers (dtype <U1)"),
        ("complex.npy", np.ones(5, complex), "not real numbers (dtype complex128)"),
        ("records.npy", np.ones(5, "f8,f8"), "not real numbers"),
        ("objects.npy", np.array([1.0, None], object), "not a readable NPY file (Object arrays"),
        ("empty.npy", b"", "not a readable NPY file"),
        ("two.npz", {"a": VALUES, "b": VALUES}, "it holds 2 arrays, but none named 'sensitivity': a, b"),
        ("none.npz", {}, "it holds no array"),
        ("text.npz", "no archive", "not a readable NPZ file (File is not a zip file)"),
    ],
)
def test_bad_tables(tmp_path, capfd, name, content, message):
    assert message in refusal(write(tmp_path, name, content))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("length", [10**9, 10**13])
def test_an_announced_giant(tmp_path, length):
    whole = io.BytesIO()
    np.lib.format.write_array_header_1_0(whole, {"descr": "<f8", "fortran_order": False, "shape": (length,)})
    assert "not a readable NPY file" in refusal(write(tmp_path, "giant.npy", whole.getvalue() + b"\0" * 80))


# any bytes


def packed(arrays: dict[str, np.ndarray], squeezed: bool) -> bytes:
    whole = io.BytesIO()
    (np.savez_compressed if squeezed else np.savez)(whole, allow_pickle=False, **arrays)
    return whole.getvalue()


def saved(values: np.ndarray) -> bytes:
    whole = io.BytesIO()
    np.save(whole, values)
    return whole.getvalue()


SEEDS = {
    "csv": str(SCALARS["paraview.csv"]).encode(),
    "txt": str(SCALARS["space.txt"]).encode(),
    "npy": saved(VECTORS),
    "npz": packed({"sensitivity": VALUES, "b": VECTORS}, squeezed=True),
    "plain.npz": packed({"sensitivity": VALUES}, squeezed=False),
}


def accept_or_refuse(folder: Path, name: str, content: bytes) -> None:
    source = write(folder, name, content)
    try:
        values = vertex_array(source, template(), "sensitivity")
    except UserError as error:
        if "\n" in str(error) or not str(error).startswith(f"scenario.sensitivity={source}: "):
            raise AssertionError(f"not one clear line: {error}") from None
        return
    assert values.shape in ((4,), (4, 3))
    assert np.isfinite(values).all()


def any_bytes(examples: int):
    @settings(max_examples=examples, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(ending=st.sampled_from(sorted(ENDINGS)), content=st.binary(max_size=300))
    @example(ending=".npy", content=b"\x93NUMPY\x01\x00\x08\x00(((((((\n")
    def run(tmp_path, capfd, ending, content):
        accept_or_refuse(tmp_path, f"any{ending}", content)
        assert capfd.readouterr() == ("", "")

    return run


def damaged(examples: int):
    @settings(max_examples=examples, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(
        name=st.sampled_from(sorted(SEEDS)),
        place=st.floats(0.0, 1.0, exclude_max=True),
        cut=st.integers(0, 20),
        put=st.one_of(
            st.binary(max_size=8), st.sampled_from([b"-1", b"99999999999", b"nan", b"1e999", b"\n", b",", b'"'])
        ),
    )
    def run(tmp_path, capfd, name, place, cut, put):
        whole = SEEDS[name]
        start = int(place * len(whole))
        accept_or_refuse(tmp_path, f"damaged.{name}", whole[:start] + put + whole[start + cut :])
        assert capfd.readouterr() == ("", "")

    return run


test_any_bytes, test_damaged_files = any_bytes(60), damaged(300)
test_many_more_bytes = pytest.mark.slow(any_bytes(5000))
test_many_more_damaged_files = pytest.mark.slow(damaged(20000))


@pytest.mark.parametrize("name", SEEDS)
def test_the_seeds_are_sound(tmp_path, name):
    values = vertex_array(write(tmp_path, f"seed.{name}", SEEDS[name]), template(), "sensitivity")
    np.testing.assert_array_equal(values, VECTORS[ROWS] if name == "npy" else PICKED)


def test_a_separator_that_the_file_names(tmp_path):
    path = write(
        tmp_path, "a.csv", "sep=|\nid|value\n" + "".join(f"{k}|{v!r}\n" for k, v in enumerate(VALUES.tolist()))
    )
    np.testing.assert_array_equal(vertex_array(path, template(), "sensitivity"), PICKED)


def test_coordinates_that_are_too_coarse_to_tell_vertices_apart_are_refused(tmp_path):
    """Two vertices 5e-5 apart, of a mesh of size 1, share the row of one of them."""
    corners = np.array([[0.0, 0, 0], [5e-5, 0, 0], [1, 0, 0], [0, 1, 0]])
    close = template(vertices=corners, count=4, rows=np.arange(4), triangles=np.array([[0, 1, 3], [1, 2, 3]]))
    table = lines("x,y,z,v", *corners[[3, 2, 0]].T, np.arange(3.0))
    assert "1 vertices share their nearest row" in refusal(write(tmp_path, "a.csv", table), of=close)
    same = template(vertices=corners[[0, 0, 2, 3]], count=4, rows=np.arange(4))
    found = vertex_array(write(tmp_path, "b.csv", table), same, "sensitivity")
    np.testing.assert_array_equal(found, [2.0, 2.0, 1.0, 0.0])


def test_a_total_below_the_rows_is_left_out_and_told(tmp_path):
    table = lines("x,y,z,v", *POINTS.T, VALUES) + f"Total,,,{VALUES.sum()!r}\n"
    found = vertex_arrays.vertex_array(write(tmp_path, "a.csv", table), template(), "sensitivity")
    np.testing.assert_array_equal(found.values, PICKED)
    assert "its last row, 'Total,,," in found.note


def test_a_first_value_that_could_be_the_number_of_rows_is_a_value(tmp_path):
    numbers = "4\n1\n2.5\n3\n0.5\n"
    found = vertex_array(write(tmp_path, "a.csv", numbers), template(), "sensitivity")
    np.testing.assert_array_equal(found, np.array([4, 1, 2.5, 3, 0.5])[ROWS])
    counted = "5\n" + "".join(" ".join(map(repr, row)) + "\n" for row in VECTORS.tolist())
    found = vertex_array(write(tmp_path, "b.txt", counted), template(), "sensitivity")
    np.testing.assert_array_equal(found, VECTORS[ROWS])
