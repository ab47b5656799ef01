"""Rebuilds the embedded body `free_body.npz` (6890 vertices, SMPL's keys) from the full free body.

    python scripts/build_free_body.py                     # full body -> free_body.npz
    python scripts/build_free_body.py --check             # compare with the file in the package
    python scripts/build_free_body.py --full other.npz --output body.npz

The full body itself comes out of `scripts/build_full_body.py`. Nothing here is random, sums have one
order on every machine, and ties are broken by vertex number: the same input gives the same arrays. The
file in the package is older than that order: its vertices are the same, and of its 13776 triangles 5,
on the midline, are split along the other diagonal; `--check` allows for these.
"""

from __future__ import annotations

import argparse
import heapq
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

ASSETS = Path(__file__).resolve().parents[1] / "src" / "occfusion" / "assets"
VERTICES = 6890  # SMPL's count: files in the ZJU-MoCap layout hold this many body vertices a frame
BODY_VERTICES = 13380  # vertices 0..13379 of the full body are the skin, the rest are helpers
NEIGHBOURHOOD = 300  # vertices a joint may depend on
LENGTH_WEIGHT = 2e-4  # price of a long edge against quadric error; keeps vertices evenly spread
TIES = 5  # triangles of the stored file that mirror-symmetric ties split the other way
FLIP_COSINE = 0.2  # a collapse may not turn a triangle by more than about 78 degrees

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def face_quadrics(vertices: Floats, faces: Ints) -> Floats:
    """Returns the summed squared-distance quadric of the planes around each vertex, `[V, 4, 4]`.

    Garland and Heckbert, "Surface Simplification Using Quadric Error Metrics", section 5; planes are
    weighted by triangle area.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    double_area = np.maximum(np.linalg.norm(normal, axis=1), 1e-20)
    unit = normal / double_area[:, None]
    plane = np.concatenate([unit, -(unit * a).sum(1, keepdims=True)], axis=1)
    quadric = plane[:, :, None] * plane[:, None, :] * (0.5 * double_area)[:, None, None]
    out = np.zeros((len(vertices), 4, 4))
    for k in range(3):
        np.add.at(out, faces[:, k], quadric)
    return out


class _Mesh:
    """A closed triangle mesh under half-edge collapses: vertices vanish, none ever moves."""

    def __init__(self, vertices: Floats, faces: Ints) -> None:
        self.vertices = vertices
        self.faces: dict[int, tuple[int, int, int]] = {
            i: (int(f[0]), int(f[1]), int(f[2])) for i, f in enumerate(faces)
        }
        self.around: list[set[int]] = [set() for _ in vertices]
        for i, face in self.faces.items():
            for v in face:
                self.around[v].add(i)
        self.quadrics = face_quadrics(vertices, faces)
        self.version = [0] * len(vertices)

    def neighbours(self, v: int) -> set[int]:
        return {w for i in self.around[v] for w in self.faces[i]} - {v}

    def cost(self, gone: int, kept: int) -> float:
        # Sums written out: the body is mirror-symmetric, so collapses tie along its midline, and a
        # BLAS that sums in the order of the machine's vector width would decide them by machine.
        quadric = (self.quadrics[gone] + self.quadrics[kept]).tolist()
        x, y, z = self.vertices[kept].tolist()
        error = sum(
            p * (x * row[0] + y * row[1] + z * row[2] + row[3])
            for p, row in zip((x, y, z, 1.0), quadric, strict=True)
        )
        u, v, w = (self.vertices[gone] - self.vertices[kept]).tolist()
        return float(error + LENGTH_WEIGHT * (u * u + v * v + w * w) ** 2)

    def is_allowed(self, gone: int, kept: int) -> bool:
        """Says whether the mesh stays a manifold and no triangle flips."""
        if len(self.neighbours(gone) & self.neighbours(kept)) != 2:
            return False
        for i in self.around[gone] - self.around[kept]:
            face = self.faces[i]
            before = self._normal(*(self.vertices[v] for v in face))
            after = self._normal(*(self.vertices[kept if v == gone else v] for v in face))
            scale = np.linalg.norm(before) * np.linalg.norm(after)
            if scale <= 1e-20 or before @ after < FLIP_COSINE * scale:
                return False
        return True

    @staticmethod
    def _normal(a: Floats, b: Floats, c: Floats) -> Floats:
        u, v = b - a, c - a
        return np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])

    def collapse(self, gone: int, kept: int) -> None:
        for i in list(self.around[gone]):
            if i in self.around[kept]:
                for v in self.faces.pop(i):
                    self.around[v].discard(i)
            else:
                a, b, c = (kept if v == gone else v for v in self.faces[i])
                self.faces[i] = (a, b, c)
                self.around[kept].add(i)
        self.around[gone] = set()
        self.quadrics[kept] += self.quadrics[gone]
        self.version[gone] += 1
        self.version[kept] += 1


def decimate(vertices: Floats, faces: Ints, target: int) -> tuple[Ints, Ints]:
    """Returns the `target` vertex numbers that stay, `[target]`, and the faces among them, `[F, 3]`."""
    mesh = _Mesh(vertices, faces)
    heap: list[tuple[float, int, int, int, int]] = []

    def offer(v: int) -> None:
        for w in sorted(mesh.neighbours(v)):
            for gone, kept in ((v, w), (w, v)):
                stamp = mesh.version[gone], mesh.version[kept]
                heapq.heappush(heap, (mesh.cost(gone, kept), gone, kept, *stamp))

    for v in range(len(vertices)):
        offer(v)
    left = len(vertices)
    while left > target:
        if not heap:
            raise SystemExit(f"no collapse is left at {left} vertices; wanted {target}")
        _, gone, kept, stamp_gone, stamp_kept = heapq.heappop(heap)
        if (stamp_gone, stamp_kept) != (mesh.version[gone], mesh.version[kept]) or not mesh.is_allowed(
            gone, kept
        ):
            continue
        mesh.collapse(gone, kept)
        left -= 1
        offer(kept)
    small = np.array([mesh.faces[i] for i in sorted(mesh.faces)])
    kept_vertices = np.unique(small)
    renumber = np.full(len(vertices), -1)
    renumber[kept_vertices] = np.arange(len(kept_vertices))
    return kept_vertices, renumber[small]


def joint_regressor(template: Floats, shapedirs: Floats, joints: Floats, joint_dirs: Floats) -> Floats:
    """Returns the local regressor `[J, V]` that gives the joints of every shape exactly.

    Each row is the smallest change (least squares) to the mean of its neighbourhood that reproduces
    the rest joint, its ten shape directions and a sum of one: 34 linear conditions. Rows are signed;
    a non-negative regressor misses extreme shapes by centimetres.
    """
    components = np.concatenate([template[:, :, None], shapedirs], axis=2)  # [V, 3, 1 + B]
    wanted = np.concatenate([joints[:, :, None], joint_dirs], axis=2)  # [J, 3, 1 + B]
    rows = np.zeros((len(joints), len(template)))
    for j, joint in enumerate(joints):
        near = np.sort(np.argsort(np.linalg.norm(template - joint, axis=1), kind="stable")[:NEIGHBOURHOOD])
        system = np.concatenate([components[near].reshape(len(near), -1).T, np.ones((1, len(near)))])
        target = np.append(wanted[j].ravel(), 1.0)
        mean = np.full(len(near), 1.0 / len(near))
        change = np.linalg.lstsq(system, target - system @ mean, rcond=1e-12)[0]
        rows[j, near] = mean + change
    return rows


def build(full_path: Path) -> dict[str, NDArray[np.generic]]:
    """Returns the arrays of the small body, under SMPL's keys."""
    with np.load(full_path, allow_pickle=False) as full:
        vertices = full["v_template"][:BODY_VERTICES].astype(np.float64)
        faces = full["f_body"].astype(np.int64)
        keep, small_faces = decimate(vertices, faces, VERTICES)
        shapedirs = full["shapedirs"][keep].astype(np.float32)
        weights = np.zeros((VERTICES, 24), np.float32)
        slots = np.arange(VERTICES)[:, None]
        values = full["w_val"][keep].astype(np.float32)
        np.add.at(weights, (slots, full["w_idx"][keep].astype(np.int64)), values)
        weights /= weights.sum(1, keepdims=True)
        parents = full["parents"].astype(np.int64)
        template = full["v_template"][keep]
        regressor = joint_regressor(
            template.astype(np.float64),
            shapedirs.astype(np.float64),
            full["J_template"].astype(np.float64),
            full["J_dirs"].astype(np.float64),
        )
    return {
        "v_template": template,
        "shapedirs": shapedirs,
        "J_regressor": regressor.astype(np.float32),
        "weights": weights,
        "kintree_table": np.stack([np.where(parents < 0, 2**32 - 1, parents), np.arange(24)]).astype(
            np.int64
        ),
        "f": small_faces.astype(np.int32),
        "full_vertex": keep.astype(np.int32),  # number of each vertex in the full body
    }


def differing_keys(
    arrays: Mapping[str, NDArray[np.generic]], stored: Mapping[str, NDArray[np.generic]]
) -> list[str]:
    """Returns the keys under which two bodies differ; triangles are compared as a set, see above."""
    wrong = [k for k, v in arrays.items() if k != "f" and not np.allclose(stored[k], v, rtol=1e-4, atol=1e-6)]
    return wrong + ["f"] * (len(triangles(arrays["f"]) ^ triangles(stored["f"])) > 2 * TIES)


def triangles(faces: NDArray[np.generic]) -> set[tuple[int, ...]]:
    """Returns the triangles of `[F, 3]`, each turned so that its least vertex comes first."""
    first = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    return {tuple(face) for face in turned.tolist()}


def main() -> int:
    """Builds or checks the file; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", type=Path, default=ASSETS / "free_body_full.npz")
    parser.add_argument("--output", type=Path, default=ASSETS / "free_body.npz")
    parser.add_argument("--check", action="store_true", help="compare with --output instead of writing it")
    args = parser.parse_args()
    arrays = build(args.full)
    if not args.check:
        np.savez_compressed(args.output, **arrays)  # type: ignore[arg-type]
        print(f"{args.output}: {args.output.stat().st_size} bytes")
        return 0
    with np.load(args.output, allow_pickle=False) as stored:
        wrong = differing_keys(arrays, stored)
    print("same as the stored file" if not wrong else f"different from the stored file: {', '.join(wrong)}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
