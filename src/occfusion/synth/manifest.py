"""`scene.json`: what a written scene holds, and whether it is whole. Written last."""

from __future__ import annotations

from pathlib import Path

from occfusion.errors import ConfigError, DataError
from occfusion.files.atomic import write_json
from occfusion.files.jsonfile import parse_json
from occfusion.synth.spec import SceneSpec

MANIFEST = "scene.json"
FORMAT = "occfusion embedded scene"
VERSION = 1
"""Of the generator: a change of any byte it writes needs another number, and scenes are made anew."""


def write_manifest(folder: Path, spec: SceneSpec) -> None:
    """Writes the manifest of a finished scene."""
    write_json(folder / MANIFEST, {"format": FORMAT, "version": VERSION, "spec": spec.as_dict()})


def written_spec(folder: Path) -> SceneSpec | None:
    """Returns what a folder was written from; None where it is no scene of this version of the generator."""
    try:
        content = parse_json((folder / MANIFEST).read_text(encoding="utf-8"))
        if content["format"] != FORMAT or content["version"] != VERSION:
            return None
        return SceneSpec(**content["spec"])
    except (OSError, ValueError, KeyError, TypeError, ConfigError):
        return None


def is_current(folder: Path, spec: SceneSpec) -> bool:
    """Says whether the folder holds this very scene, whole; False where it has to be made (again).

    Raises:
        DataError: the folder holds another scene, or something that is not a scene of ours.
    """
    if not folder.exists():
        return False
    if folder.is_dir() and not any(folder.iterdir()):
        return False
    try:
        content = parse_json((folder / MANIFEST).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError(
            f"{folder}: exists and is no scene written here (no {MANIFEST}); it is left alone. "
            "Choose another folder, or remove it."
        ) from None
    except NotADirectoryError:
        raise DataError(f"{folder}: is a file; choose another folder.") from None
    except (OSError, ValueError) as error:
        raise DataError(
            f"{folder / MANIFEST}: cannot be read ({error}); remove the folder to make it anew."
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise DataError(f"{folder / MANIFEST}: is not that of an embedded scene; choose another folder.")
    wanted = spec.as_dict()
    there = content.get("spec")
    if there != wanted:
        have = there if isinstance(there, dict) else {}
        differ = [
            f"{k} {have.get(k)!r} (wanted {wanted.get(k)!r})" for k in wanted if have.get(k) != wanted[k]
        ]
        raise DataError(
            f"{folder}: holds the scene with {', '.join(differ) or 'other settings'}. "
            "Choose another output folder, or remove this one."
        )
    return content.get("version") == VERSION
