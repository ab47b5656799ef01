"""One class has the names of a run folder; no other module spells one."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from occfusion.errors import CheckpointError
from occfusion.files.run_folder import REGIONS, FrameFolder, Inside, RunFolder, StageFolder, read_json
from occfusion.geometry.coverage import CLASSES

PACKAGE = Path(__file__).parents[2] / "src" / "occfusion"
OWNER = PACKAGE / "files" / "run_folder.py"
# parts that work in run folders; in the others a name such as "masks" is one of a data set's layout
AT_RUNS = {"bench", "cli", "compare", "evaluation", "inpaint", "plan", "report", "run", "stages"}
# sentences of the page of settings, and the layout of embedded scenes
OF_OTHER_PAGES = ("settings/", "synth/")
OTHERS = {
    ("cli/train.py", "config.yaml"): "the package's own configuration, which Hydra reads",
    ("compare/page.py", "report.md"): "of a comparison, in a folder of its own",
    ("cli/report.py", "report.md"): "of a comparison, in a folder of its own",
    ("data/occluders.py", "manifest.json"): "of a stored occlusion, a layout of data",
}


def names() -> tuple[set[str], set[str]]:
    """Returns the names of files (those with a suffix) and of folders that `RunFolder` has."""
    run = RunFolder(Path("run"))
    found: set[str] = set()
    for holder in (run, run.stage("optim"), run.masks, run.inpainted):
        for name, member in vars(type(holder)).items():
            value = getattr(holder, name) if isinstance(member, (property, Inside)) else None
            found |= {part.name for part in [value] if isinstance(part, Path)}
            found |= {value.path.name, value.second} if isinstance(value, FrameFolder) else set()
    return {name for name in found if "." in name}, {name for name in found if "." not in name}


def texts(path: Path) -> Iterator[tuple[int, str, bool]]:
    """Yields line and content of each text in a module but docstrings, and whether it is joined to a path."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    joined = {
        id(node.right)
        for node in ast.walk(tree)
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.lineno, node.value, id(node) in joined


def test_the_class_has_the_names_that_users_know() -> None:
    files, folders = names()
    assert files >= {
        "config.yaml", "environment.json", "plan.json", "metrics.json", "report.md", "losses.csv", "error_vs_time.csv",
        "per_image.csv", "point_cloud.ply", "finished.json", "stage.json", "avatar.safetensors", "last.ckpt",
    }  # fmt: skip
    assert folders >= {"masks", "inpainted", "uncertainty", "regions", "pictures", "occlusion"}


@pytest.mark.parametrize(
    "path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: path.relative_to(PACKAGE).as_posix()
)
def test_no_other_module_spells_a_name_of_the_run_folder(path: Path) -> None:
    if path == OWNER:
        return
    files, folders = names()
    inside = path.relative_to(PACKAGE).as_posix()
    for line, text, is_joined in texts(path):
        spelt = [name for name in files if re.search(rf"(?<![\w./-]){re.escape(name)}\b", text)]
        spelt = [
            name for name in spelt if (inside, name) not in OTHERS and not inside.startswith(OF_OTHER_PAGES)
        ]
        assert not spelt, f"{inside}:{line} spells {spelt}: RunFolder has it"
        if path.relative_to(PACKAGE).parts[0].removesuffix(".py") in AT_RUNS:
            assert not (is_joined and text in folders), f"{inside}:{line} spells {text!r}: RunFolder has it"


def test_regions_have_the_classes_of_what_training_saw() -> None:
    assert set(CLASSES) < set(REGIONS)


def test_a_stage_is_done_when_its_record_and_its_avatar_are_there(tmp_path: Path) -> None:
    own = StageFolder(tmp_path)
    own.avatar.touch()
    assert not own.has_avatar
    own.record.write_text('{"train_seconds": 1}')
    assert own.has_avatar
    for garbage in (b"garbage", b"", b"[]", b"{}", b'{"train_seconds": "x"}', b"\x88\xff", b"[" * 100_000):
        own.record.write_bytes(garbage)
        assert not own.has_avatar and own.damage == f"{own.record} is damaged"


def test_training_seconds_are_read_stage_by_stage(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    for name, seconds in (("optim", 2.0004), ("refine", 1.5)):
        folder.stage(name).path.mkdir()
        folder.stage(name).record.write_text(f'{{"train_seconds": {seconds}}}')
    assert folder.train_seconds() == {"init": None, "optim": 2.0, "refine": 1.5, "total": 3.5}


@pytest.mark.parametrize(
    ("content", "said"), [(None, "cannot be read"), ("{", "not readable"), ("[]", "no table")]
)
def test_a_record_that_is_none_is_said(tmp_path: Path, content: str | None, said: str) -> None:
    if content is not None:
        (tmp_path / "plan.json").write_text(content)
    with pytest.raises(CheckpointError, match=rf"plan\.json.*{said}"):
        read_json(tmp_path / "plan.json")
