"""`avatar.safetensors`: an avatar alone, without the body it belongs to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from occfusion.errors import CheckpointError
from occfusion.files.atomic import write_bytes
from occfusion.files.jsonfile import parse_json
from occfusion.files.ply import SplatTable, write_ply
from occfusion.human.avatar import Avatar
from occfusion.human.body import Body
from occfusion.human.gaussians import PARAMETERS, Gaussians
from occfusion.human.pose_spline import PoseSpline
from occfusion.splat import Limits

FORMAT = "occfusion avatar"
VERSION = 1
SH_FRAME = "canonical"
"""The frame that viewing directions are turned to; files name it, and some older ones were made in another."""
_KEPT_FOR_TRAINING = ("skinning_offsets", "_extra_state")
"""Parts of the state that only the middle of a training needs."""


def save_avatar(path: Path | str, avatar: Avatar) -> None:
    """Writes the avatar whole or not at all; the header says which body it belongs to.

    Raises:
        DataError: the disk refuses.
    """
    tensors = {
        name: value.detach().cpu().contiguous()
        for name, value in avatar.state_dict().items()
        if name not in _KEPT_FOR_TRAINING
    }
    write_bytes(path, save(tensors, metadata={"avatar": json.dumps(describe_avatar(avatar))}))


def describe_avatar(avatar: Avatar) -> dict[str, Any]:
    """Returns what the tensors of an avatar do not say: plain numbers and text."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "body": avatar.body.digest(),
        "gaussians": avatar.gaussians.num_gaussians,
        "sh_degree": avatar.gaussians.sh_degree,
        "active_sh_degree": avatar.active_sh_degree,
        "sh_frame": SH_FRAME,
        "key_light": avatar.key_light is not None,
        "dilation": float(avatar.dilation),
        "refine_pose": avatar.pose_refiner is not None,
        "pose_spline": _spline_description(avatar.pose_spline),
        "learn_skinning": avatar.skinning_field is not None,
        "skinning_every": avatar.skinning_every,
    }


def _spline_description(spline: PoseSpline | None) -> dict[str, float] | None:
    if spline is None:
        return None
    range_ = {"first": float(spline.first), "spacing": float(spline.spacing), "knots": spline.knots}
    return {**range_, "aligned": spline.aligned}


def load_avatar(path: Path | str, body: Body) -> Avatar:
    """Returns the avatar of a file, ready to be posed.

    Raises:
        CheckpointError: no such file, not an avatar, of another version, damaged, or made for another body.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path}: no such avatar file; it is written when a stage ends")
    try:
        with safe_open(str(path), framework="pt") as file:
            description = _stored(path, file.metadata())
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path}: not a safetensors file, or damaged ({error})") from error
    return make_avatar(path, body, description, tensors)


def make_avatar(path: Path, body: Body, description: dict[str, Any], tensors: dict[str, Tensor]) -> Avatar:
    """Returns the avatar of tensors and of what `describe_avatar` said, ready to be posed.

    Args:
        path: what messages name.
        body: that it belongs to.
        description: of the avatar.
        tensors: its state; parts that only training needs may be there.

    Raises:
        CheckpointError: of another version, damaged, or made for another body.
    """
    description = _checked_description(path, description)
    tensors = {name: value for name, value in tensors.items() if name not in _KEPT_FOR_TRAINING}
    if description.get("body") != body.digest():
        raise CheckpointError(
            f"{path}: made for another body (hash {description.get('body')}, given one has {body.digest()}); "
            "set body.path to the file it was trained with"
        )
    try:
        avatar = _empty_avatar(body, description)
        avatar.load_state_dict(tensors, strict=False)
        missing = set(avatar.state_dict()) - set(tensors) - set(_KEPT_FOR_TRAINING)
        extra = set(tensors) - set(avatar.state_dict())
        if missing or extra:
            raise ValueError(f"missing: {sorted(missing)}, unknown: {sorted(extra)}")
        avatar.active_sh_degree = int(description["active_sh_degree"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(f"{path}: its content does not fit its description ({error})") from error
    _check(path, avatar)
    return avatar.eval()


def _stored(path: Path, metadata: dict[str, str] | None) -> Any:
    try:
        return parse_json((metadata or {})["avatar"])
    except (KeyError, ValueError) as error:
        raise CheckpointError(f"{path}: a safetensors file, but not an avatar") from error


def _checked_description(path: Path, description: Any) -> dict[str, Any]:
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise CheckpointError(f"{path}: not an avatar, or without a description of it")
    if description.get("version") != VERSION:
        raise CheckpointError(
            f"{path}: written in version {description.get('version')} of the format, "
            f"this program reads {VERSION}"
        )
    if description.get("sh_frame") != SH_FRAME:
        raise CheckpointError(
            f"{path}: its colours are by viewing directions in the frame {description.get('sh_frame')!r}, this program "
            f"has them in {SH_FRAME!r} alone; train the avatar again"
        )
    return description


def _empty_avatar(body: Body, description: dict[str, Any]) -> Avatar:
    start = body.v_template.new_zeros(0, 3)
    spline = description.get("pose_spline")  # absent from files that are older than it
    return Avatar(
        body,
        refine_pose=bool(description["refine_pose"]),
        pose_spline=spline
        and PoseSpline(
            float(spline["first"]),
            float(spline["spacing"]),
            int(spline["knots"]),
            bool(spline.get("aligned")),
        ),
        learn_skinning=bool(description["learn_skinning"]),
        skinning_every=int(description["skinning_every"]),
        # absent, as the spline is, from files that are older, and so is what follows
        key_light=start.new_zeros(3) if description.get("key_light") else None,
        dilation=float(description.get("dilation", Limits.dilation)),
        gaussians=Gaussians(start, start, int(description["sh_degree"])),
    )


def _check(path: Path, avatar: Avatar) -> None:
    for name, value in avatar.gaussians.state_dict().items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            raise CheckpointError(f"{path}: gaussians.{name} holds NaN or infinite values")
        if len(value) != avatar.gaussians.num_gaussians:
            raise CheckpointError(
                f"{path}: gaussians.{name} has {len(value)} rows, the means have another number"
            )
    index = avatar.gaussians.vertex_index
    if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < avatar.body.num_vertices:
        raise CheckpointError(f"{path}: gaussians.vertex_index names vertices that the body does not have")


def write_gaussians_ply(path: Path | str, gaussians: Gaussians) -> None:
    """Writes the canonical Gaussians in the layout of 3DGS, raw values.

    Raises:
        DataError: a value is not finite, or the disk refuses.
    """
    values = {name: getattr(gaussians, name).detach().float().cpu().numpy() for name in PARAMETERS}
    write_ply(path, SplatTable(**values))
