"""Numbers of the vertices: by name or from a table, one row for each point, and one clear line for every mistake."""

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from rbfevo.errors import UserError
from rbfevo.scenarios.templates import Template
from rbfevo.scenarios.vertex_arrays import ENDINGS, vertex_array

POINTS = np.array([[0.0, 0, 0], [9, 9, 9], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]])
ROWS = np.array([0, 2, 3, 4])
VALUES = np.array([1.5, -7.0, 2.5, -3.0, 4e-3])
VECTORS = np.arange(15.0).reshape(5, 3) - 0.25
PICKED = VALUES[ROWS]


def template(**changes) -> Template:
    arrays = {"pressure": PICKED, "normals": VECTORS[ROWS], "uv": np.zeros((4, 2)), "hole": np.array([1, np.nan, 2, 3])}
    settled = {
        "vertices": POINTS[ROWS],
        "triangles": np.array([[0, 1, 2], [0, 2, 3]]),
        "arrays": arrays,
        "rows": ROWS,
        "count": 5,
        "notes": {},
        "cell_arrays": ("stress",),
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
    "semicolon.csv": lines("node;p", np.arange(5) * 10, VALUES, between=";"),
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
    "xyz.csv": lines("x,y,z", *VECTORS.T),
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
    said = refusal("presure")
    assert "did you mean 'pressure'?" in said
    assert all(name in said for name in ("hole", "normals", "uv", "stress"))
    assert "did you mean" not in refusal("quite something else")
    assert "it has no point arrays" in refusal("pressure", of=template(arrays={}))


def test_cell_array():
    assert "is a cell array; convert it to point data first" in refusal("stress", "fixed")


def test_no_such_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.csv").mkdir()
    assert refusal("gone.csv") == refusal("some/gone") == "no such file"
    assert "is a directory" in refusal("folder.csv")
    assert ".npy" in refusal(write(tmp_path, "values.xlsx", "x"))
    assert "no such point array" in refusal("a\0b")


def test_a_named_array_is_checked_as_well():
    assert "it has 2 columns" in refusal("uv")
    assert "1 of 4 vertices have values that are not finite" in refusal("hole")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("short.csv", lines("", VALUES[:3]), "it has 3 rows, but the mesh has 5 points (4 of them in triangles)"),
        ("long.npy", np.zeros((6, 3)), "it has 6 rows, but the mesh has 5 points"),
        ("two.csv", lines("", VALUES, VALUES), "it has 2 columns"),
        ("named.csv", lines("id,a,b", VALUES.argsort().argsort(), VALUES, VALUES), "'id' column does not ascend"),
        ("many.csv", lines("a,b", VALUES, VALUES), "2 columns of values (a, b); 1 or 3 are wanted, or name them sens"),
        ("points.csv", lines("Points:0,Points:1,Points:2", *COORDINATES), "only ids and coordinates"),
        ("id.csv", lines("id", np.arange(5)), "only ids and coordinates"),
        ("sorted.csv", lines("x,y,z,v", *POINTS[::-1].T, VALUES), "its coordinates differ from the mesh's at 3 of 4"),
        ("nan.csv", lines("", np.where(VALUES < 0, np.nan, VALUES)), "1 of 4 vertices have values"),
        ("empty.csv", " \n", "the file is empty"),
        ("header.csv", "a,b\n", "a header, but no lines with numbers"),
        ("words.csv", "a\n1\n2\nthree\n4\n5\n", "not a readable CSV file"),
        ("ragged.txt", "1 2\n3\n", "not a readable TXT file"),
        ("cube.npy", np.zeros((5, 3, 1)), "it is of shape 5 x 3 x 1"),
        ("number.npy", np.array(3.0), "it is of shape none"),
        ("text.npy", np.array(["a"] * 5), "no real numbers (dtype <U1)"),
        ("complex.npy", np.ones(5, complex), "no real numbers (dtype complex128)"),
        ("records.npy", np.ones(5, "f8,f8"), "no real numbers"),
        ("objects.npy", np.array([1.0, None], object), "not a readable NPY file (Object arrays"),
        ("empty.npy", b"", "not a readable NPY file"),
        ("two.npz", {"a": VALUES, "b": VALUES}, "it holds 2 arrays, none named 'sensitivity': a, b"),
        ("none.npz", {}, "there is no array in it"),
        ("text.npz", "no archive", "not a readable NPZ file (File is not a zip file)"),
    ],
)
def test_bad_tables(tmp_path, capfd, name, content, said):
    assert said in refusal(write(tmp_path, name, content))
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
