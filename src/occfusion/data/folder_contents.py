"""The pictures of a folder by name, and tables of frames in pickles and JSON files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from occfusion.errors import DataError
from occfusion.files.naming import natural
from occfusion.files.unpickle import load_pickle

MAX_NAME, MAX_PATH = 250, 1000
"""Longest name and path in bytes: file systems take 255, and 4096 with the folder in front."""


def load_table(path: Path) -> Mapping[str, Any]:
    """Returns the table in a pickle; executes nothing.

    Raises:
        DataError: the file is missing or damaged, or holds no table.
    """
    return table(load_pickle(path), path)


def table(content: Any, path: Path) -> Mapping[str, Any]:
    """Returns the content of a file that must hold a table of frames or values.

    Raises:
        DataError: it holds something else, nothing, or keys that are not text.
    """
    if not isinstance(content, Mapping) or not content:
        raise DataError(f"{path}: holds a {type(content).__name__}, not a table of frames.")
    if not all(isinstance(key, str) for key in content):
        raise DataError(f"{path}: the frames must be named by text, as 'frame_000000'.")
    return content


def entry(rows: Mapping[str, Any], name: str, path: Path) -> Mapping[str, Any]:
    """Returns the row of a frame, which must be a table itself."""
    row = rows[name]
    if not isinstance(row, Mapping):
        raise DataError(f"{path}, {name}: holds a {type(row).__name__}, not a table.")
    return row


def need(row: Mapping[str, Any], key: str, where: str) -> Any:
    """Returns the value of a key.

    Raises:
        DataError: it is missing; says what is there.
    """
    if key not in row:
        known = ", ".join(map(str, row))[:200] or "none that is known here"
        raise DataError(f"{where}: key {key!r} is missing; it has {known}.")
    return row[key]


def inside(name: Any, where: str) -> str:
    """Returns a relative path in POSIX form, once it is certain that it stays inside its folder.

    Raises:
        DataError: it is absolute, goes up, names nothing, or cannot be a file's name.
    """
    path = PurePosixPath(str(name).replace("\\", "/"))
    shown = repr(str(name)[:80])
    if path.is_absolute() or ".." in path.parts or not path.name or "\0" in str(path):
        raise DataError(f"{where} names {shown}, which leads out of the scene's folder.")
    sizes = [len(part.encode(errors="replace")) for part in path.parts]
    broken = str(path).encode(errors="ignore") != str(path).encode(errors="surrogatepass")
    if max(sizes) > MAX_NAME or sum(sizes) > MAX_PATH or broken:
        raise DataError(f"{where} names {shown}, which cannot be a file's name.")
    return path.as_posix()


SUFFIXES = (".png", ".jpg", ".jpeg")
"""What is taken for a picture, in any case of letters."""

MASK_SUFFIXES = (*SUFFIXES, ".npy")
"""What is taken for a mask: InstantAvatar keeps PeopleSnapshot's as arrays."""

MAX_DIGITS = 12
"""Longest number read from a name; `int` refuses a few thousand digits with an error of its own."""

_NUMBER = re.compile(r"(\d+)(?!.*\d)", re.DOTALL)


def pictures_in(
    folder: Path, suffixes: tuple[str, ...] = SUFFIXES, prefer: str | None = None
) -> dict[str, Path]:
    """Returns the pictures of a folder by their name without suffix, in natural order.

    Hidden files are none: systems leave such as `._frame_000000.png` behind.

    Args:
        folder: where to look.
        suffixes: what is taken for a picture, in small letters.
        prefer: the suffix to take where several pictures have one name; that is refused when None.

    Raises:
        DataError: no such folder, no picture in it, or two pictures of one name.
    """
    try:
        found = [path for path in folder.iterdir() if path.suffix.lower() in suffixes and path.name[0] != "."]
    except OSError as error:
        raise DataError(f"{folder}: cannot be read ({error.strerror or error}).") from error
    if not found:
        raise DataError(f"{folder}: holds no pictures ({', '.join(suffixes)}).")
    by_name: dict[str, Path] = {}
    for path in sorted(found, key=lambda path: natural(path.name)):
        if path.stem in by_name and prefer in (path.suffix.lower(), by_name[path.stem].suffix.lower()):
            by_name[path.stem] = path if path.suffix.lower() == prefer else by_name[path.stem]
            continue
        if path.stem in by_name:
            raise DataError(f"{path}: there is also {by_name[path.stem].name}; keep one of them.")
        by_name[path.stem] = path
    return by_name


def pngs_in(folder: Path) -> dict[str, Path]:
    """Returns the PNG files of a folder as `pictures_in` does, or where it has none the pictures of other kinds.

    For forms whose own program reads PNG files alone: what lies beside them are copies and previews.
    """
    try:
        return pictures_in(folder, (".png",))
    except DataError:
        return pictures_in(folder)


def strays(folder: Path, taken: Iterable[Path]) -> list[str]:
    """Returns the names of what lies in a folder and was not taken, in natural order."""
    return sorted((path.name for path in set(folder.iterdir()) - set(taken)), key=natural)


def like(names: Iterable[str], others: Iterable[str]) -> list[str]:
    """Returns the names that are built like one of the others: equal but for their numbers."""
    kinds = {re.sub(r"\d+", "0", other) for other in others}
    return [name for name in names if re.sub(r"\d+", "0", name) in kinds]


def require_same(names: Iterable[str], what: str, others: Iterable[str], other_what: str) -> None:
    """Raises DataError naming the first entry that only one of two sets has."""
    first, second = set(names), set(others)
    for there, here, missing, have in ((first, second, other_what, what), (second, first, what, other_what)):
        lacking = sorted(there - here, key=natural)
        if lacking:
            more = f" and {len(lacking) - 1} more" if len(lacking) > 1 else ""
            raise DataError(
                f"{missing}: has no {lacking[0]!r}{more}, which {have} has ({len(there)} against {len(here)} "
                "entries). Complete it, or remove what belongs to no frame."
            )


def partners(
    pictures: Sequence[str], others: dict[str, Path], folder: Path, *, more: bool = False
) -> tuple[Path, ...]:
    """Returns what belongs to each picture: the same name, or else the same last number, as `mask_0007`.

    Args:
        pictures: names without suffix.
        others: what there is, by name without suffix.
        folder: what messages call it.
        more: there may be some that belong to no picture.

    Raises:
        DataError: a picture has no partner; names the first. Or a partner belongs to no picture.
    """
    if all(name in others for name in pictures):
        chosen = list(pictures)
    else:
        by_number = {last_number(name): name for name in others}
        chosen = []
        for name in pictures:
            number = last_number(name)
            if number is None or number not in by_number:
                raise DataError(
                    f"{folder}: has nothing for the picture {name!r} ({len(pictures)} pictures, "
                    f"{len(others)} entries here). Complete it, or remove the picture."
                )
            chosen.append(by_number[number])
    lost = sorted(set(others) - set(chosen), key=natural)
    if lost and not more:
        raise DataError(
            f"{folder}: {lost[0]!r} belongs to no picture ({len(pictures)} pictures, {len(others)} entries "
            "here). Remove it, or complete the pictures."
        )
    return tuple(others[name] for name in chosen)


def last_number(name: str) -> str | None:
    """Returns the last number in a name without the zeros before it, None where there is none."""
    found = _NUMBER.search(name)
    return None if found is None else found[1].lstrip("0")
