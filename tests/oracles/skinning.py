"""Skinning the slow way: recursion over joints, loops over vertices, float64, from the formulas of SMPL."""

from __future__ import annotations

import numpy as np

from oracles.rotation import exponential


def place_joint(joint, rotations, joints, parents):
    """World rotation and position of a joint, by recursion up the tree."""
    if parents[joint] < 0:
        return rotations[joint], joints[joint]
    above_rotation, above_position = place_joint(parents[joint], rotations, joints, parents)
    offset = joints[joint] - joints[parents[joint]]
    return above_rotation @ rotations[joint], above_position + above_rotation @ offset


def skin_vertex(point, weights, rotations, joints, parents):
    """Sum over joints of weight times (R_k (x - j_k) + posed j_k), and the same sum of the rotations."""
    position, linear = np.zeros(3), np.zeros((3, 3))
    for k in range(len(parents)):
        rotation, place = place_joint(k, rotations, joints, parents)
        position = position + weights[k] * (rotation @ (point - joints[k]) + place)
        linear = linear + weights[k] * rotation
    return position, linear


def pose_body(arrays, betas, global_orient, body_pose, transl):
    """Vertices and joints of a body file's arrays, in smplx's conventions."""
    full = np.concatenate([np.ravel(global_orient), np.ravel(body_pose)]).reshape(24, 3)
    rotations = [exponential(vector) for vector in full]
    shaped = np.array(
        [_shape(*pair, betas) for pair in zip(arrays.v_template, arrays.shapedirs, strict=True)]
    )
    joints = np.array([_shape(*pair, betas) for pair in zip(arrays.J_template, arrays.J_dirs, strict=True)])
    if arrays.posedirs is not None:
        features = np.concatenate([(rotation - np.eye(3)).ravel() for rotation in rotations[1:]])
        shaped = np.array([v + d @ features for v, d in zip(shaped, arrays.posedirs, strict=True)])
    pairs = zip(shaped, arrays.weights, strict=True)
    vertices = [skin_vertex(v, w, rotations, joints, arrays.parents)[0] for v, w in pairs]
    placed = [place_joint(k, rotations, joints, arrays.parents)[1] for k in range(24)]
    return np.array(vertices) + transl, np.array(placed) + transl


def _shape(point, directions, betas):
    for k, beta in enumerate(betas):
        point = point + beta * directions[:, k]
    return point


def kl(mean_a, cov_a, mean_b, cov_b):
    """KL divergence of two normal densities in matrix form."""
    inverse = np.linalg.inv(cov_b)
    d = mean_b - mean_a
    logs = np.linalg.slogdet(cov_b)[1] - np.linalg.slogdet(cov_a)[1]
    return 0.5 * (np.trace(inverse @ cov_a) + d @ inverse @ d - len(d) + logs)
