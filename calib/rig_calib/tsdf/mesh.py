"""Mesh: coloured triangles in the rig frame."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from rig_protocol.frames import ImageU8

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

LEAST_PIECE_M2 = 0.0025
"""Smaller pieces, 5 cm × 5 cm, are what noise leaves floating."""


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """`vertices_m` (N,3) with `colors` (N,3) u8, RGB, and `faces` (M,3), counterclockwise from outside."""

    vertices_m: Array
    faces: Index
    colors: ImageU8

    def face_normals(self) -> Array:
        """Outward vectors (M,3), as long as the faces are large."""
        a, b, c = (self.vertices_m[self.faces[:, k]] for k in range(3))
        return np.asarray(np.cross(b - a, c - a) / 2)

    def normals(self) -> Array:
        """Unit normals (N,3) of the vertices: means of their faces', weighted by area."""
        normals, of_faces = np.zeros_like(self.vertices_m), self.face_normals()
        for axis in range(3):
            for corner in range(3):
                normals[:, axis] += np.bincount(
                    self.faces[:, corner], of_faces[:, axis], len(self.vertices_m)
                )
        return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30))

    def area_m2(self) -> float:
        """Of all faces."""
        return float(np.linalg.norm(self.face_normals(), axis=1).sum())

    def rims(self) -> Index:
        """Edges (R,2), pairs of vertices, that only one face has: where nothing is known any more."""
        edges, count = np.unique(self._edges(), axis=0, return_counts=True)
        return np.asarray(edges[count == 1])

    def holes(self) -> tuple[int, float]:
        """How many pieces the rims are in, and how long they are together, metres."""
        rims = self.rims()
        if not len(rims):
            return 0, 0.0
        length_m = np.linalg.norm(self.vertices_m[rims[:, 0]] - self.vertices_m[rims[:, 1]], axis=1).sum()
        _, piece = self._connected(rims)
        return len(np.unique(piece[rims[:, 0]])), float(length_m)

    def without_small_pieces(self, least_m2: float = LEAST_PIECE_M2) -> "Mesh":
        """What hangs together with at least this area."""
        if not len(self.faces):
            return self
        count, piece = self._connected(self._edges())
        of_face = piece[self.faces[:, 0]]
        area = np.bincount(of_face, np.linalg.norm(self.face_normals(), axis=1), count)
        faces = self.faces[area[of_face] >= least_m2]
        used, places = np.unique(faces, return_inverse=True)
        return Mesh(self.vertices_m[used], places.reshape(-1, 3), self.colors[used])

    def _edges(self) -> Index:
        pairs = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]])
        return np.sort(pairs, axis=1)

    def _connected(self, edges: Index) -> tuple[int, npt.NDArray[np.int32]]:
        """How many pieces vertices that edges (E,2) join are in, and the piece (N,) of each."""
        size = len(self.vertices_m)
        graph = scipy.sparse.coo_array((np.ones(len(edges), np.bool_), edges.T), shape=(size, size))
        count, piece = connected_components(graph, directed=False)
        return int(count), np.asarray(piece)
