"""Meshes that gmsh, MeshLab and Open3D write and read: a program of its own, which needs one of them and NumPy.

`python foreign_writers.py LIBRARY` answers each line of JSON on its input with one on its output. It runs in the
environment that `scripts/writers` makes, since gmsh and MeshLab are GPL and Open3D brings much that rbfevo does not
need.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np


def split(faces: list[list[int]]) -> dict[int, list[list[int]]]:
    return {size: [face for face in faces if len(face) == size] for size in (3, 4)}


class Gmsh:
    """Discrete surfaces, one a patch, with physical names; triangles and quadrilaterals."""

    def __init__(self) -> None:
        self.gmsh = gmsh = importlib.import_module("gmsh")
        gmsh.initialize(interruptible=False)
        gmsh.option.setNumber("General.Terminal", 0)

    def write(self, request: dict[str, Any]) -> None:
        gmsh = self.gmsh
        gmsh.clear()
        for name, value in request["options"].items():
            gmsh.option.setNumber(name, value)
        points, faces = request["points"], request["faces"]
        gmsh.model.add("drawn")
        element = 1
        for tag, (name, own) in enumerate(request["patches"].items(), 1):
            gmsh.model.addDiscreteEntity(2, tag)
            if tag == 1:  # all nodes, so that those that nothing uses are there too
                numbers = np.arange(1, len(points) + 1)
                gmsh.model.mesh.addNodes(2, tag, numbers, np.ravel(points))
            for size, kind in ((3, 2), (4, 3)):
                listed = [faces[i] for i in own if len(faces[i]) == size]
                numbers = np.arange(element, element + len(listed))
                element += len(listed)
                gmsh.model.mesh.addElementsByType(tag, kind, numbers, np.ravel(listed).astype(np.int64) + 1)
            gmsh.model.addPhysicalGroup(2, [tag], name=name)
        gmsh.write(request["path"])

    def read(self, path: str) -> tuple[Any, Any]:
        gmsh = self.gmsh
        gmsh.clear()
        gmsh.option.setNumber("Geometry.MatchMeshTolerance", 0)
        gmsh.merge(path)
        tags, places, _ = gmsh.model.mesh.getNodes(-1, -1)
        order = {int(tag): i for i, tag in enumerate(tags)}
        faces = []
        for kind, size in ((2, 3), (3, 4)):
            for _, entity in gmsh.model.getEntities(2):
                _, corners = gmsh.model.mesh.getElementsByType(kind, entity)
                faces += [[order[int(c)] for c in face] for face in np.reshape(corners, (-1, size))]
        return np.reshape(places, (-1, 3)), faces


class MeshLab:
    """Faces of up to any number of corners; a scalar of the vertices."""

    def __init__(self) -> None:
        self.lab = importlib.import_module("pymeshlab")

    def write(self, request: dict[str, Any]) -> None:
        options: dict[str, Any] = {}
        if request["values"] is not None:
            options["v_scalar_array"] = np.asarray(request["values"], np.float64)
        points = np.asarray(request["points"], np.float64)
        faces = np.asarray(request["faces"], np.int32)
        everything = self.lab.MeshSet()
        everything.add_mesh(self.lab.Mesh(vertex_matrix=points, face_matrix=faces, **options))
        everything.save_current_mesh(request["path"], **request["options"])

    def read(self, path: str) -> tuple[Any, Any]:
        everything = self.lab.MeshSet()
        everything.load_new_mesh(path)
        mesh = everything.current_mesh()
        return mesh.vertex_matrix(), mesh.polygonal_face_list()


class Open3D:
    """Triangles, with normals and colours of the vertices."""

    def __init__(self) -> None:
        self.open3d = importlib.import_module("open3d")

    def write(self, request: dict[str, Any]) -> None:
        vector = self.open3d.utility
        mesh = self.open3d.geometry.TriangleMesh(
            vector.Vector3dVector(np.asarray(request["points"], np.float64)),
            vector.Vector3iVector(np.asarray(request["faces"], np.int32)),
        )
        mesh.compute_vertex_normals()
        mesh.paint_uniform_color([0.5, 0.2, 0.1])
        if not self.open3d.io.write_triangle_mesh(request["path"], mesh, **request["options"]):
            raise ValueError("Open3D does not write it")

    def read(self, path: str) -> tuple[Any, Any]:
        mesh = self.open3d.io.read_triangle_mesh(path)
        return np.asarray(mesh.vertices), np.asarray(mesh.triangles)


LIBRARIES = {"gmsh": Gmsh, "pymeshlab": MeshLab, "open3d": Open3D}


def main() -> None:
    replies = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what a library prints must not get between the replies
    try:
        library = LIBRARIES[sys.argv[1]]()
    except (ImportError, OSError) as error:
        print(json.dumps({"missing": " ".join(str(error).split())}), file=replies, flush=True)
        return
    print(json.dumps({}), file=replies, flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        try:
            if "faces" in request:
                library.write(request)
                reply = {} if Path(request["path"]).is_file() else {"error": "nothing is written"}
            else:
                points, faces = library.read(request["path"])
                listed = [list(map(int, face)) for face in faces]
                reply = {"points": np.asarray(points, np.float64).tolist(), "faces": listed}
        except Exception as error:  # libraries raise whatever they like
            reply = {"error": f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"}
        print(json.dumps(reply), file=replies, flush=True)


if __name__ == "__main__":
    main()
