"""The normals that one value per vertex is taken along, when the run asks, and what it tells about the move."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from rbfevo.errors import UserError
from rbfevo.scenarios import mesh, signs
from rbfevo.scenarios.scenario import Scenario

BALL = trimesh.creation.icosphere(subdivisions=2, radius=2.0)
X, FACES = np.asarray(BALL.vertices, np.float64), np.asarray(BALL.faces, np.int64)
INWARD = FACES[:, ::-1]
VALUES = 3.0 + X[:, 0] + 0.1 * X[:, 1]  # positive, largest at large x
CAP = FACES[(X[FACES][:, :, 2] > -0.5).all(axis=1)]  # open below
HALF = X[FACES].mean(axis=1)[:, 0] > 0.3


def written(folder: Path, faces: np.ndarray, vertices: np.ndarray = X, values: np.ndarray = VALUES) -> dict[str, Any]:
    used, inverse = np.unique(faces, return_inverse=True)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices[used].tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (inverse.reshape(-1, 3) + 1).tolist()]
    (folder / "a.obj").write_text("\n".join(lines) + "\n")
    np.save(folder / "s.npy", values[used])
    return {"template": str(folder / "a.obj"), "sensitivity": str(folder / "s.npy")}


def outwardness(made: Scenario) -> np.ndarray:
    """Of the directions of the vertices that move, +1 outwards, -1 inwards (about the origin)."""
    moving = (made.gradient != 0).any(dim=1)
    places, wanted = made.vertices[moving].numpy(), made.gradient[moving].numpy()
    along = (places * wanted).sum(axis=1)
    return along / np.linalg.norm(places, axis=1) / np.linalg.norm(wanted, axis=1)


SURFACES = {"closed": (FACES, INWARD), "open": (CAP, CAP[:, ::-1])}


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("objective", ["minimize", "maximize"])
def test_one_reading_is_not_asked_about(name: str, objective: str, tmp_path: Path) -> None:
    settings: dict[str, Any] = written(tmp_path, SURFACES[name][0]) | {"objective": objective}
    made = [mesh(**settings, sensitivity_normal=choice) for choice in (None, "outward", "as_wound")]
    for one in made:
        np.testing.assert_array_equal(one.gradient.numpy(), made[0].gradient.numpy())
        np.testing.assert_allclose(outwardness(one), -1.0 if objective == "minimize" else 1.0, atol=0.05)
        assert one.objective == objective
    assert "outward normal" in made[1].notes["sensitivity"]


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("objective", ["minimize", "maximize"])
def test_a_surface_wound_inwards_is_asked_about(name: str, objective: str, tmp_path: Path) -> None:
    settings: dict[str, Any] = written(tmp_path, SURFACES[name][1]) | {"objective": objective}
    with pytest.raises(UserError) as caught:
        mesh(**settings)
    text, n = str(caught.value), len(np.unique(SURFACES[name][1]))
    assert "\n" not in text
    assert f"at {n} of {n} vertices" in text
    first, second = ("inwards", "outwards") if objective == "minimize" else ("outwards", "inwards")
    most = X[np.argmax(VALUES)]
    assert f"outward (at ({', '.join(f'{number:.3g}' for number in most)}), where it is {VALUES.max():.3g}" in text
    assert f"the design then moves {first}) or as_wound (along the file's normals: {second} there)" in text
    sign = -1.0 if objective == "minimize" else 1.0
    np.testing.assert_allclose(outwardness(mesh(**settings, sensitivity_normal="outward")), sign, atol=0.05)
    np.testing.assert_allclose(outwardness(mesh(**settings, sensitivity_normal="as_wound")), -sign, atol=0.05)


@pytest.mark.parametrize("few", [True, False])
def test_clashing_winding_is_asked_about_and_has_no_reading_as_wound(few: bool, tmp_path: Path) -> None:
    turned = np.where((few == HALF)[:, None], INWARD, FACES)
    settings = written(tmp_path, turned)
    with pytest.raises(UserError, match=r"sensitivity_normal=outward .*as_wound is out: at \d+ edges") as caught:
        mesh(**settings)
    touched = len(np.unique(FACES[few == HALF]))
    assert f"at {touched} of {len(X)} vertices" in str(caught.value)
    np.testing.assert_allclose(outwardness(mesh(**settings, sensitivity_normal="outward")), -1.0, atol=0.05)
    rim = np.intersect1d(FACES[HALF], FACES[~HALF])
    with pytest.raises(UserError, match=f"as_wound: at {len(rim)} edges the file winds"):
        mesh(**settings, sensitivity_normal="as_wound")


def test_vertices_without_a_value_are_not_asked_about(tmp_path: Path) -> None:
    turned = np.where(HALF[:, None], INWARD, FACES)
    touched = np.isin(np.arange(len(X)), FACES[HALF])
    made = mesh(**written(tmp_path, turned, values=np.where(touched, 0.0, VALUES)))
    assert bool((made.gradient[torch.from_numpy(touched)] == 0).all())
    np.testing.assert_allclose(outwardness(made), -1.0, atol=0.05)


def test_patches_that_do_not_share_vertices_are_one_surface(tmp_path: Path) -> None:
    """Two halves of a ball with a seam, one of them wound inwards."""
    split = np.concatenate([FACES[~HALF], INWARD[HALF] + len(X)])
    settings = written(tmp_path, split, np.concatenate([X, X]), np.concatenate([VALUES, VALUES]))
    with pytest.raises(UserError, match="as_wound is out"):
        mesh(**settings)
    np.testing.assert_allclose(outwardness(mesh(**settings, sensitivity_normal="outward")), -1.0, atol=0.2)


def test_an_open_surface_beside_a_closed_one(tmp_path: Path) -> None:
    """Only the open one, wound inwards, is turned."""
    both = np.concatenate([FACES, CAP[:, ::-1] + len(X)])
    settings = written(tmp_path, both, np.concatenate([X, X + np.array([9.0, 0, 0])]), np.concatenate([VALUES, VALUES]))
    with pytest.raises(UserError, match=f"at {len(np.unique(CAP))} of"):
        mesh(**settings)
    made = mesh(**settings, sensitivity_normal="outward")
    away = made.vertices.numpy() - np.where(made.vertices.numpy()[:, :1] > 4.0, [[9.0, 0, 0]], 0.0)
    assert ((away * made.gradient.numpy()).sum(axis=1) < 0.0).all()


def test_a_closed_surface_with_an_edge_of_four_triangles(tmp_path: Path) -> None:
    """Two boxes that share an edge, both wound inwards: no neighbour says which way is out, the volume does."""
    box = trimesh.creation.box(extents=(1.0, 1.0, 1.0))
    one = np.asarray(box.vertices) + 0.5 * np.array([1.0, 1.0, 0.0])
    places, inverse = np.unique(np.concatenate([one, one - [1.0, 1.0, 0.0]]), axis=0, return_inverse=True)
    faces = inverse.reshape(-1)[np.concatenate([box.faces, np.asarray(box.faces) + 8])][:, ::-1]
    found = signs.sides(places, faces)
    assert len(places) == 14
    assert found.sided
    middle = np.sign(places[:, :1] + places[:, 1:2]) * [0.5, 0.5, 0.0]
    outside = np.abs(places[:, 0] + places[:, 1]) > 0.5
    assert ((found.outward * (places - middle)).sum(axis=1)[outside] > 0.5).all()
    np.testing.assert_allclose(found.wound, -found.outward, atol=1e-12)


def test_a_flat_sheet_has_one_reading_and_no_outside(tmp_path: Path) -> None:
    grid = np.array([[x, y, 0.0] for x in range(6) for y in range(6)], float)
    k = np.array([6 * x + y for x in range(5) for y in range(5)])[:, None]
    faces = np.concatenate([k + np.array([0, 6, 7]), k + np.array([0, 7, 1])])
    made = mesh(**written(tmp_path, faces, grid, np.arange(36.0)))
    assert bool((made.gradient[1:, 2] < 0).all())
    note = made.notes["largest move"]
    assert "wards" not in note
    assert note.startswith("it wants to move most at (5, 5, 0): along (0, 0, -1), against the sensitivity")


def test_a_one_sided_strip_is_warned_about(tmp_path: Path) -> None:
    count = 20
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    side = 0.2 * (np.cos(angle / 2)[:, None] * [0, 0, 1.0] + np.sin(angle / 2)[:, None] * ring)
    a, b = np.arange(count), (np.arange(count) + 1) % count
    c, d = b + count, a + count
    c[-1], b[-1] = 0, count
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    strip = np.concatenate([ring - side, ring + side])
    settings = written(tmp_path, faces, strip, np.ones(2 * count))
    made = mesh(**settings, sensitivity_normal="outward")
    assert any("one-sided" in warning for warning in made.warnings)


@pytest.mark.parametrize("kind", ["scalar", "vector"])
def test_the_largest_move_is_told(kind: str, tmp_path: Path) -> None:
    settings = written(tmp_path, FACES)
    most = int(np.argmax(VALUES))
    place = ", ".join(f"{number:.3g}" for number in X[most])
    if kind == "vector":
        np.save(tmp_path / "s.npy", VALUES[:, None] * X / 2.0)
    note = mesh(**settings).notes["largest move"]
    direction = ", ".join(f"{number:.3g}" for number in (-X[most] / 2.0).round(2) + 0.0)
    assert note == (
        f"it wants to move most at ({place}): inwards, along ({direction}), against the sensitivity "
        "(scenario.objective=minimize)"
    )
    upwards = mesh(**settings, objective="maximize").notes["largest move"]
    assert "outwards, along" in upwards
    assert upwards.endswith("along the sensitivity (scenario.objective=maximize)")
    np.save(tmp_path / "s.npy", np.where(np.arange(len(X))[:, None] == most, np.cross(X, [0.0, 0.0, 1.0]), 0.0))
    assert ": along the surface, along (" in mesh(**settings).notes["largest move"]


def test_what_belongs_to_other_settings_is_refused(tmp_path: Path) -> None:
    settings: dict[str, Any] = written(tmp_path, FACES)
    np.save(tmp_path / "s.npy", X)
    with pytest.raises(UserError, match=r"^scenario\.sensitivity_normal=outward: .* three components[^\n]*$"):
        mesh(**settings, sensitivity_normal="outward")
    with pytest.raises(UserError, match="sensitivity_normal=upward: choose one of outward, inward, as_wound"):
        mesh(**settings, sensitivity_normal="upward")
    target: dict[str, Any] = {"template": settings["template"], "target": settings["template"]}
    others: list[dict[str, Any]] = [
        {"sensitivity_normal": "outward"},
        {"sensitivity_kind": "nodal"},
        {"objective": "maximize"},
    ]
    for other in others:
        with pytest.raises(UserError, match="belong to a sensitivity"):
            mesh(**target, **other)
