"""The printed command names a folder to a shell and to Hydra, whatever the folder is called."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from occfusion.importing.folder import training_command
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
        training_command(Path(root) / name, 10, Path(root) / "body.npz", 0.5).replace("\\\n", " ")
    )
    assert words[:2] == ["python", "train.py"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", words[2:])
    found = load_settings(config)
    assert (found.dataset.root, str(found.dataset.scene)) == (root, name)
    assert found.body.path == f"{root}/body.npz"
    assert list(found.dataset.test_frames) == [8, 10, 1]
