"""Integrated or per area: names and refined meshes that speak against the default are asked about, and no others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from benchmarks.choosing import body
from rbfevo.errors import UserError
from rbfevo.geometry import topology
from rbfevo.scenarios import kinds, mesh


def refined(levels: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """A ball of which one half is subdivided further, as in an octree mesh: four times as many triangles a level."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    for level in range(levels):
        centers = np.asarray(ball.triangles_center)
        inside = np.flatnonzero(centers[:, 2] > 0.1 + 0.3 * level)
        subdivide: Any = trimesh.remesh.subdivide
        vertices, faces = subdivide(ball.vertices, ball.faces, face_index=inside)
        ball = trimesh.Trimesh(vertices, faces, process=True)
        ball.vertices /= np.linalg.norm(ball.vertices, axis=1, keepdims=True)
    return np.asarray(ball.vertices, np.float64), np.asarray(ball.faces, np.int64)


def uniform(level: int = 4) -> tuple[np.ndarray, np.ndarray]:
    ball = trimesh.creation.icosphere(subdivisions=level)
    return np.asarray(ball.vertices, np.float64), np.asarray(ball.faces, np.int64)


def field(vertices: np.ndarray, name: str) -> np.ndarray:
    x, _, z = vertices.T
    return {"smooth": 1.5 + x, "signed": np.sin(3 * x) + z, "peaked": 0.05 + np.exp(-8 * (1 - z))}[name]


FIELDS = ("smooth", "signed", "peaked")


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("levels", [1, 2])
@pytest.mark.parametrize("name", FIELDS)
def test_densities_are_asked_about_and_integrated_values_are_not(name: str, levels: int, noise: float) -> None:
    vertices, triangles = refined(levels=levels)
    areas = topology.vertex_areas(vertices, triangles)
    density = field(vertices, name) * np.exp(noise * np.random.default_rng(3).normal(size=len(vertices)))
    for values in (density, np.stack([density, 0 * density, -density], axis=1)):
        nodal = values * (areas if values.ndim == 1 else areas[:, None])
        assert kinds.hint((), nodal, areas, triangles) is None
        with pytest.raises(UserError, match=r"per area\? Where the mesh is refined") as caught:
            kinds.ask((), values, areas, triangles, "s")
        assert "set scenario.sensitivity_kind=nodal (integrated) or density (per area)" in str(caught.value)
        assert "\n" not in str(caught.value)
    found = kinds.slope(density * areas, areas, triangles)
    assert found is not None
    assert found.slope == pytest.approx(0.9, abs=0.25)
    assert found.slope + 2.0 * found.error < 1.3


@pytest.mark.parametrize("noise", [0.0, 0.5, 3.0])
@pytest.mark.parametrize("name", FIELDS)
def test_uniform_meshes_are_never_asked_about(name: str, noise: float) -> None:
    vertices, triangles = uniform()
    stretched = vertices * [3.0, 1.0, 0.5]  # areas vary from place to place, but not between neighbours
    for places in (vertices, stretched):
        areas = topology.vertex_areas(places, triangles)
        values = field(vertices, name) * np.exp(noise * np.random.default_rng(5).normal(size=len(vertices)))
        assert kinds.slope(values, areas, triangles) is None
        assert kinds.hint(("sens",), values, areas, triangles) is None


def test_a_body_of_odd_triangles_has_no_refined_region() -> None:
    """The guide's car: nodal derivatives along sharp edges of a marching-cubes mesh, far from areas times a field."""
    car = body()
    vertices, triangles = car.of_surface(car.body(0.06))
    vertices.requires_grad_()
    car.drag(vertices, triangles).backward()
    assert vertices.grad is not None
    places, faces, nodal = vertices.detach().numpy(), triangles.numpy(), vertices.grad.numpy()
    areas = topology.vertex_areas(places, faces)
    assert kinds.hint((), nodal, areas, faces) is None
    single = np.log(areas[faces] / areas[np.roll(faces, 1, axis=1)])
    assert np.abs(single).max() > np.log(4.0)


def test_noise_that_hides_the_slope_is_not_asked_about() -> None:
    vertices, triangles = refined()
    areas = topology.vertex_areas(vertices, triangles)
    few = np.where(np.abs(vertices[:, 2] - 0.1) < 0.05, 1.0, 0.0)
    few *= np.abs(vertices[:, 0]) < 0.1  # too few vertices with a value
    assert kinds.hint((), few, areas, triangles) is None
    for seed in range(20):
        noise = np.random.default_rng(seed).standard_cauchy(len(vertices)) * areas
        assert kinds.hint((), noise, areas, triangles) is None


@pytest.mark.parametrize(
    "name",
    [
        "faceSensVecas1ESI",
        "faceSensNormaladjS1ESI",
        "pointSensVecas1ESI",
        "pointSensNormalVecas1ESI",
        "dJ per unit area",
    ],
)
def test_names_that_may_be_per_area_are_asked_about(name: str) -> None:
    vertices, triangles = uniform(2)
    areas = topology.vertex_areas(vertices, triangles)
    with pytest.raises(UserError, match=rf"{name}: .*per area \(density\).*; set scenario\.sensitivity_kind=nodal"):
        kinds.ask(("s", name), areas, areas, triangles, "s")


@pytest.mark.parametrize("name", ["Sensitivity_x", "Surface_Sensitivity", "sensitivity", "dJdx", "facesens", "area"])
def test_other_names_are_not(name: str) -> None:
    vertices, triangles = uniform(2)
    areas = topology.vertex_areas(vertices, triangles)
    assert kinds.hint((name,), areas, areas, triangles) is None


def test_an_answer_ends_the_question(tmp_path: Path) -> None:
    vertices, triangles = refined()
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (triangles + 1).tolist()]
    (tmp_path / "a.obj").write_text("\n".join(lines) + "\n")
    areas = topology.vertex_areas(vertices, triangles)
    density = 1.5 + vertices[:, 0]
    np.save(tmp_path / "density.npy", density)
    np.savetxt(tmp_path / "b.csv", density * areas, header="pointSensNormalas1ESI", comments="")
    for name in ("density.npy", "b.csv"):
        settings: dict[str, Any] = {"template": str(tmp_path / "a.obj"), "sensitivity": str(tmp_path / name)}
        with pytest.raises(UserError, match="integrated over each vertex's share of the surface, or per area"):
            mesh(**settings)
        for kind in kinds.KINDS:
            note = mesh(**settings, sensitivity_kind=kind).notes["sensitivity"]
            assert f"{kind} (" in note
    nodal = mesh(str(tmp_path / "a.obj"), sensitivity=str(tmp_path / "b.csv"), sensitivity_kind="nodal")
    per_area = mesh(str(tmp_path / "a.obj"), sensitivity=str(tmp_path / "density.npy"), sensitivity_kind="density")
    np.testing.assert_allclose(nodal.gradient.numpy(), per_area.gradient.numpy(), atol=1e-12)
