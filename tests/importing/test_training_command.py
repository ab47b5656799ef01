"""The printed command names a folder to a shell and to Hydra, whatever the folder is called."""

from __future__ import annotations

import shlex
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hydra import compose, initialize_config_dir

from occfusion.importing.folder import picture_size, training_command
from occfusion.settings.schema import load_settings

CONF = Path(__file__).parents[2] / "conf"


@pytest.mark.parametrize(
    ("root", "name"),
    [
        ("data", "me"), ("/data/of mine", "clip (1), once"), ("data", "003"), ("it's", 'a "b" {c} [d]'), ("a=b", "$c"),
        ("data", "null"), ("data", "1e3"), ("back\\slash", "ends\\"), ("quoted\\'s", "é ü"), ("data", "~me"),
        ("data", "${oops}"), ("data", "True"), ("data", "12"), ("data", "1_000"), ("data", "007"), ("data", "-1.50"),
    ],
)  # fmt: skip
def test_shell_and_hydra_read_back_what_the_folder_is_called(root, name):
    words = shlex.split(
        training_command(Path(root) / name, 10, Path(root) / "body.npz", 0.5, 512).replace("\\\n", " ")
    )
    assert words[:2] == ["python", "train.py"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", words[2:])
    found = load_settings(config)
    assert (found.dataset.root, str(found.dataset.scene)) == (root, name)
    assert found.body.path == f"{root}/body.npz"
    assert list(found.dataset.test_frames) == [8, 10, 1]
    assert found.dataset.image_size == 512


def test_a_small_person_is_trained_on_in_larger_pictures():
    words = [shlex.split(training_command(Path("data/me"), 10, None, None, size)) for size in (300, 512, 900)]
    assert [[word for word in each if "image_size" in word] for each in words] == [
        [],
        [],
        ["dataset.image_size=900"],
    ]


def test_pictures_are_as_large_as_the_person_needs():
    mask = np.zeros((360, 640), bool)
    mask[100:340, 300:380] = True
    shot = SimpleNamespace(size=(640, 360))
    sources = SimpleNamespace(masks=[mask, mask], shot=shot)
    assert picture_size(sources, 80, 96) == 213  # 80 of 240 rows
    assert picture_size(sources, 20, 96) == 96
    mask[:] = False
    mask[100:110, 300:304] = True
    assert picture_size(sources, 80, 96) == 640  # no more than there is
    assert picture_size(sources, 1, 999) == 640
    assert picture_size(SimpleNamespace(masks=[np.zeros_like(mask), mask], shot=shot), 80, 96) == 640
