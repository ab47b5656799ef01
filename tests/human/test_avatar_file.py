from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from occfusion.errors import CheckpointError
from occfusion.human import Avatar, Body, load_avatar, save_avatar, write_gaussians_ply
from occfusion.human.gaussians import PARAMETERS
from occfusion.human.pose_spline import PoseSpline
from oracles.people import make_arrays, make_pose
from oracles.splat_files import read_raw_ply

CENTRE = torch.tensor([0.0, 0.0, 4.0])


@pytest.fixture
def body():
    return Body(make_arrays())


def make(body, **options):
    torch.manual_seed(0)
    avatar = Avatar(body, **{"sh_degree": 2, **options})
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.05)
        avatar.gaussians.replace(
            {name: getattr(avatar.gaussians, name)[:17] for name in PARAMETERS}, torch.arange(17)
        )
    avatar.active_sh_degree = 1
    return avatar.eval()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"refine_pose": False, "learn_skinning": False},
        {"key_light": torch.tensor([0.2, -0.3, 0.1])},
        {"dilation": 0.1},
    ],
)
def test_round_trip_gives_the_same_cloud(tmp_path, body, options):
    avatar = make(body, **options)
    avatar(make_pose(0, dtype=torch.float32), CENTRE)
    save_avatar(tmp_path / "a.safetensors", avatar)
    loaded = load_avatar(tmp_path / "a.safetensors", Body(make_arrays()))
    with torch.no_grad():
        a, b = (x(make_pose(1, dtype=torch.float32), CENTRE) for x in (avatar, loaded))
    for name in ("means", "covariances", "opacities", "colors"):
        assert torch.equal(getattr(a, name), getattr(b, name))
    assert loaded.active_sh_degree == 1
    assert a.dilation == b.dilation == options.get("dilation", 0.3)
    assert (loaded.key_light is None) == (avatar.key_light is None)
    assert not loaded.training


def test_a_file_that_is_read_and_written_again_is_the_same_file(tmp_path, body):
    """Also what describes it: the first frame of the corrections, `0`, once came back as `0.0`."""
    for options in ({}, {"refine_pose": False, "pose_spline": PoseSpline(0, 4, 5)}, {"dilation": 0}):
        save_avatar(tmp_path / "a.safetensors", make(body, **options))
        save_avatar(tmp_path / "b.safetensors", load_avatar(tmp_path / "a.safetensors", body))
        assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


def test_file_names_its_body_but_does_not_hold_it(tmp_path, body):
    save_avatar(tmp_path / "a.safetensors", make(body))
    with safe_open(tmp_path / "a.safetensors", "pt") as file:
        assert json.loads(file.metadata()["avatar"])["body"] == body.digest()
        assert all(file.get_tensor(name).shape[:1] != (40,) for name in file.keys())  # noqa: SIM118


def test_wrong_body(tmp_path, body):
    save_avatar(tmp_path / "a.safetensors", make(body))
    with pytest.raises(CheckpointError, match="another body"):
        load_avatar(tmp_path / "a.safetensors", Body(make_arrays(seed=1)))


def rewrite(path, change_tensors=None, change_description=None):
    with safe_open(path, "pt") as file:
        description = json.loads(file.metadata()["avatar"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    (change_tensors or (lambda t: None))(tensors)
    description.update(change_description or {})
    description = {key: value for key, value in description.items() if value is not None or key != "body"}
    save_file(tensors, path, metadata={"avatar": json.dumps(description)})


def drop(tensors):
    del tensors["gaussians.means"]


def add(tensors):
    tensors["gaussians.more"] = torch.zeros(1)


def spoil(tensors):
    tensors["gaussians.sh0"][3] = float("nan")


def shorten(tensors):
    tensors["gaussians.sh0"] = tensors["gaussians.sh0"][:5].clone()


def misplace(tensors):
    tensors["gaussians.vertex_index"][2] = 40


@pytest.mark.parametrize(
    ("tensors", "description", "message"),
    [
        (drop, None, "missing"),
        (add, None, "unknown"),
        (spoil, None, "sh0 holds NaN"),
        (shorten, None, "5 rows"),
        (misplace, None, "vertex_index"),
        (None, {"version": 2}, "version 2"),
        (None, {"body": None}, "made for another body"),
        (None, {"sh_frame": "world"}, "in the frame 'world'.*train the avatar again"),
        (None, {"format": "cake"}, "not an avatar"),
        (None, {"sh_degree": 3}, "does not fit"),
        (None, {"active_sh_degree": 7}, "does not fit"),
        (None, {"refine_pose": False}, "does not fit"),
    ],
)
def test_files_that_are_not_what_they_say(tmp_path, body, tensors, description, message):
    path = tmp_path / "a.safetensors"
    save_avatar(path, make(body))
    rewrite(path, tensors, description)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_avatar(path, body)
    assert str(path) in str(caught.value)


def test_no_file_cut_file_other_file(tmp_path, body):
    path = tmp_path / "a.safetensors"
    with pytest.raises(CheckpointError, match="no such"):
        load_avatar(path, body)
    save_avatar(path, make(body))
    content = path.read_bytes()
    for cut in (0, 5, 200, len(content) - 1):
        path.write_bytes(content[:cut])
        with pytest.raises(CheckpointError, match=r"damaged"):
            load_avatar(path, body)
    save_file({"x": torch.zeros(2)}, path)
    with pytest.raises(CheckpointError, match="not an avatar"):
        load_avatar(path, body)


def test_point_cloud_holds_the_raw_parameters(tmp_path, body):
    avatar = make(body)
    write_gaussians_ply(tmp_path / "cloud.ply", avatar.gaussians)
    table = read_raw_ply(tmp_path / "cloud.ply")
    for name in PARAMETERS:
        assert np.array_equal(table[name], getattr(avatar.gaussians, name).detach().numpy())
