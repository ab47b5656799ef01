"""Which layout a folder is read in: the same for training and for `check`, said aloud, and asked for by name."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from data import layout_writers as writers
from data.layout_writers import Source
from occfusion.__main__ import main
from occfusion.data.layouts import LAYOUTS, find_layout, other_layouts
from occfusion.data.ocmotion.ocmotion_data import OcMotionDataModule
from occfusion.data.opening import open_folder
from occfusion.data.posing import Poser
from occfusion.data.video.video_data import VideoDataModule
from occfusion.data.zju.zju_data import ZjuDataModule
from occfusion.errors import ConfigError, DataError
from occfusion.synth import SceneSpec, write_scene
from upstream import humannerf as upstream
from upstream.humannerf import Smpl

SIZE, FRAMES = 64, 2
ALL = {"train_frames": [0, None, 1], "occlusion": "none"}


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("COLUMNS", "400")
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Source:
    spec = SceneSpec(1, "clean", image_size=SIZE, frames=FRAMES, cameras=2)
    return Source(write_scene(tmp_path_factory.mktemp("embedded"), spec, progress=False))


@pytest.fixture(scope="module")
def kept(source, tmp_path_factory) -> dict[str, Path]:
    """Each layout, whole."""
    root = tmp_path_factory.mktemp("layouts")
    smpl = Smpl.of(source.folder / "body.npz")
    upstream.write_zju(source, root / "377", smpl)
    return {
        "original": writers.write_original(source, root / "CoreView_377"),
        "refined": writers.write_refined(source, root),
        "humannerf": root / "377",
        "w2a": writers.write_w2a(source, root),
        "video": writers.write_video(source, root / "mine"),
        "chomp": writers.write_chomp(source, root / "raw"),
    }


def wild(source: Source, target: Path, *, trans: bool) -> Path:
    """Footage as HumanNeRF's script leaves it, or with the translation apart, as OccNeRF's does OcMotion."""
    smpl, rows = Smpl.of(source.folder / "body.npz"), {}
    for frame in range(source.frames):
        betas, orient, pose, transl = source.smplx(frame)
        moved = np.eye(4)
        moved[:3, 3] = 0 if trans else transl
        rows[f"{frame:06d}"] = {
            "poses": [*orient.tolist(), *pose.tolist()], "betas": betas.tolist(),
            "cam_intrinsics": source.cams["K"][0].tolist(),
            "cam_extrinsics": (source.extrinsics(0) @ moved).tolist(),
        } | ({"trans": transl.tolist()} if trans else {})  # fmt: skip
    upstream.write_wild(rows, target, smpl, SIZE, occnerf=trans)
    return target


def checked(capsys, source: Source, folder: Path, *arguments: str) -> tuple[int, str]:
    code = main(["check", str(folder), "--body", str(source.folder / "body.npz"), *arguments])
    return code, capsys.readouterr().out


def layout_of(said: str) -> str:
    found = re.search(r"(\w+): \d+ frames, \d+ cameras", said)
    assert found is not None, said
    return found[1]


def test_prepared_footage_is_read_from_its_tables(source, tmp_path, capsys):
    folder = wild(source, tmp_path / "monocular", trans=False)
    data = ZjuDataModule(tmp_path, "monocular", source.body, **ALL)
    data.validate()
    code, said = checked(capsys, source, folder)
    assert code == 0 and layout_of(said) == "humannerf" and data.taken.layout.startswith("humannerf")
    asked = "the layout w2a too (dataset=ocmotion dataset.layout=w2a, or --layout w2a of check)"
    assert asked in data.taken.others and asked in said
    code, said = checked(capsys, source, folder, "--layout", "w2a")
    assert code == 0 and layout_of(said) == "w2a"
    with pytest.raises(
        DataError, match=r"'humannerf', which dataset=zju reads.*'w2a' too: dataset.layout=w2a"
    ):
        OcMotionDataModule(tmp_path, "monocular", source.body, **ALL).setup()
    data = OcMotionDataModule(tmp_path, "monocular", source.body, layout="w2a", **ALL)
    data.validate()
    assert "the layout humannerf too (dataset=zju dataset.layout=humannerf" in data.taken.others


@pytest.mark.parametrize("name", ["0011_02", "0013_02_w2a"])
def test_a_cut_of_ocmotion_is_read_from_its_metadata(name, source, tmp_path, capsys):
    """Wild2Avatar's folders hold `metadata.json`, `cameras.pkl` and `mesh_infos.pkl`; the name may lack `_w2a`."""
    folder = wild(source, tmp_path / name, trans=True)
    if name.endswith("_w2a"):  # the name alone is enough
        rows = json.loads((folder / "metadata.json").read_text())
        rows = {key: {k: v for k, v in row.items() if k != "trans"} for key, row in rows.items()}
        rows = {key: row | {"cam_extrinsics": upstream.load(folder / "cameras.pkl")[key]["extrinsics"].tolist()}
                for key, row in rows.items()}  # fmt: skip
        (folder / "metadata.json").write_text(json.dumps(rows))
    data = OcMotionDataModule(tmp_path, name.removesuffix("_w2a"), source.body, **ALL)
    data.validate()
    code, said = checked(capsys, source, folder)
    assert code == 0 and layout_of(said) == "w2a"
    assert "the layout humannerf too" in data.taken.others and "the layout humannerf too" in said
    with pytest.raises(
        DataError, match=r"'w2a', which dataset=ocmotion reads.*dataset.layout=humannerf reads that"
    ):
        ZjuDataModule(tmp_path, name, source.body, **ALL).setup()
    asked = ZjuDataModule(tmp_path, name, source.body, layout="humannerf", **ALL)
    asked.validate()
    for frame in range(FRAMES):
        views = (data.train_frame(frame), asked.train_frame(frame))
        seen = []
        for view in views:
            pose, viewmat = view.pose, view.camera.viewmat.double().numpy()
            body = (
                source.body(pose.betas, pose.global_orient, pose.body_pose, pose.transl)[0].double().numpy()
            )
            seen.append(body @ viewmat[:3, :3].T + viewmat[:3, 3])
        assert np.linalg.norm(seen[0] - seen[1], axis=1).max() < 1e-5


def test_footage_with_the_files_of_another_layout(kept, source, tmp_path, capsys):
    folder = Path(shutil.copytree(kept["video"], tmp_path / "mine"))
    rows = json.loads((kept["w2a"] / "metadata.json").read_text())
    names = sorted(path.name for path in (folder / "images").iterdir())
    (folder / "metadata.json").write_text(json.dumps(dict(zip(names, rows.values(), strict=True))))
    code, said = checked(capsys, source, folder)
    assert code == 0 and layout_of(said) == "w2a" and "dataset=video dataset.layout=video" in said
    with pytest.raises(
        DataError, match=r"'w2a', which dataset=ocmotion reads.*dataset.layout=video reads that"
    ):
        VideoDataModule(tmp_path, "mine", source.body, **ALL).setup()
    data = VideoDataModule(tmp_path, "mine", source.body, layout="video", **ALL)
    data.validate()
    assert "the layout w2a too" in data.taken.others
    code, said = checked(capsys, source, folder, "--layout", "video")
    assert code == 0 and layout_of(said) == "video"


def test_damaged_metadata_does_not_decide(source, tmp_path):
    folder = wild(source, tmp_path / "monocular", trans=True)
    assert find_layout(folder) == "w2a"
    (folder / "metadata.json").write_text("{")
    assert find_layout(folder) == "humannerf"
    (folder / "metadata.json").write_text("[]")
    assert find_layout(folder) == "humannerf"


def test_the_layout_is_asked_for_by_name(kept, source, capsys):
    for name, folder in kept.items():
        assert find_layout(folder) == find_layout(folder, asked=name) == name and not other_layouts(
            folder, name
        )
    with pytest.raises(ConfigError, match=r"layout 'wild': choose auto, refined, original"):
        find_layout(kept["w2a"], asked="wild")
    with pytest.raises(
        DataError, match=r"cameras.pkl: file not found. The layout 'humannerf' needs cameras.pkl, mesh"
    ):
        ZjuDataModule(kept["w2a"].parent, kept["w2a"].name, source.body, layout="humannerf").setup()
    code, said = checked(capsys, source, kept["video"], "--layout", "refined")
    assert code == 1 and "annots.npy: file not found" in said
    name, scene = open_folder(kept["original"], Poser(source.body), layout="original")
    assert name == "original" and scene.num_frames == FRAMES


NEEDED = {
    "original": {"annots.npy": "original", "new_params": "original"},
    "refined": {"annots.npy": "refined", "smpl_params": "original"},
    "humannerf": {"cameras.pkl": "humannerf", "mesh_infos.pkl": "humannerf", "images": "humannerf"},
    "w2a": {"metadata.json": "w2a", "images": "w2a"},
    "video": {"cameras.npz": "video", "poses.npz": "video", "images": "video"},
    "chomp": {"annot": "w2a"},
}
"""What is taken away of each layout, and which layout the message must still name."""


@pytest.mark.parametrize(("name", "part"), [(name, part) for name, parts in NEEDED.items() for part in parts])
def test_partial_folders_are_told_what_they_lack(name, part, kept, source, tmp_path, capsys):
    folder = Path(shutil.copytree(kept[name], tmp_path / kept[name].name))
    path = folder / part
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    code, said = checked(capsys, source, folder)
    assert code == 1 and part in said, said
    assert f"'{NEEDED[name][part]}'" in said, said
    module = {"w2a": OcMotionDataModule, "chomp": OcMotionDataModule, "video": VideoDataModule}.get(
        name, ZjuDataModule
    )
    scene = "0013_02" if name in ("w2a", "chomp") else folder.name
    with pytest.raises(DataError, match=re.escape(part)):
        module(folder if name == "chomp" else folder.parent, scene, source.body, **ALL).validate()


@pytest.mark.parametrize("name", ["humannerf", "w2a", "video"])
def test_missing_masks_are_named(name, kept, source, tmp_path, capsys):
    folder = Path(shutil.copytree(kept[name], tmp_path / kept[name].name))
    (folder / "masks").rename(folder / "segmentations")
    code, said = checked(capsys, source, folder)
    assert code == 1 and "masks: cannot be read" in said, said
    code, said = checked(capsys, source, folder, "--masks", "segmentations")
    assert code == 0, said


def test_a_folder_of_no_layout_is_told_the_nearest(kept, source, tmp_path):
    (tmp_path / "notes").mkdir()
    with pytest.raises(
        DataError, match=r"no layout that is known here. Needed are .*\. The folder has nothing\.$"
    ):
        find_layout(tmp_path / "notes")
    for name in ("images", "masks"):
        (tmp_path / "notes" / name).mkdir()
    with pytest.raises(
        DataError, match=r"The folder has images/, masks/. It is nearest to 'w2a', which also"
    ):
        find_layout(tmp_path / "notes")
    with pytest.raises(
        DataError, match=r"nearest to 'humannerf', which also needs cameras.pkl, mesh_infos.pkl"
    ):
        ZjuDataModule(tmp_path, "notes", source.body)
    with pytest.raises(DataError, match=r"Sequences lie in it: .*377.*; name one of them"):
        find_layout(kept["humannerf"].parent)
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw" / "annot").mkdir()
    with pytest.raises(DataError, match=r"The folder has annot/\."):
        find_layout(tmp_path / "raw")


def test_every_layout_says_what_it_needs():
    for layout in LAYOUTS:
        assert layout.needs and all(0 <= mark < len(layout.parts) for mark in layout.marks)
