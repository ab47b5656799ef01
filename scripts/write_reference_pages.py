"""Writes the pages that follow from the code: all settings, the protocols of all data sets, faults and their tests.

    python scripts/write_reference_pages.py

`settings.md`, `protocols.md` and `faults.md` of `docs/reference/` are written whole. Tests hold that what is there is
what this writes.
"""

from __future__ import annotations

import csv
import inspect
import re
from pathlib import Path

from settings_page import GENERATED, settings_page

from occfusion.data.ocmotion import ocmotion_protocols
from occfusion.data.video import video_protocols
from occfusion.data.zju import zju_protocols

DOCS = Path(__file__).resolve().parents[1] / "docs"
SETTINGS_PAGE = DOCS / "reference" / "settings.md"
PROTOCOLS_PAGE = DOCS / "reference" / "protocols.md"
FAULTS_PAGE = DOCS / "reference" / "faults.md"
FAULTS = DOCS.parent / "tests" / "faults.csv"
FAULTS_HEAD = """# Faults that were found

What somebody found or suspected who tried to break the program, with signals, damaged files, bad input and hostile
ones; what it does in that case now; and the tests that hold it. The list is `tests/faults.csv`, this page follows from
it (`python scripts/write_reference_pages.py`), and the tests run with every change.

| fault | now | tests |
|---|---|---|
"""
FAULTS_FOOT = """
What is measured besides, by scripts that take too long for every change: [stops and damage](stops_and_damage.md).
"""
STRIPS = (
    "Strips are middle / width in columns of a picture 1024 wide: the paper's are 377 460/70, 386 415/80, 387",
    "448/50, 392 417/78, 393 434/68, 394 418/64; OccNeRF's differ in 387 451/66 and 394 423/64.",
)
PROTOCOL_COLUMNS = (
    "training camera", "training frames", "held-out frames", "held-out cameras", "masks", "longer side",
)  # fmt: skip


def fault_page() -> str:
    """Returns the page: a row for each fault, under the kind of its first."""
    with FAULTS.open(newline="", encoding="utf-8") as file:
        faults = list(csv.DictReader(file))
    lines, kind = [], ""
    for fault in faults:
        if fault["kind"] != kind:
            kind = fault["kind"]
            lines.append(f"| **{kind}** | | |\n")
        tests = ", ".join(f"`{name.rpartition('/')[2]}`" for name in fault["test"].split())
        lines.append(f"| {fault['fault']} | {fault['behaviour']} | {tests} |\n")
    return FAULTS_HEAD + "".join(lines) + FAULTS_FOOT


def protocol_table() -> str:
    """Returns the table of all protocols."""
    lines = [
        "| protocol | training camera | training frames | held-out frames | held-out cameras | masks | size | strip |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in zju_protocols.PRESETS:
        said = zju_protocols.describe(name)
        cells = [re.sub(r"the first \(.*\)", "a stretch, by subject", said[key]) for key in PROTOCOL_COLUMNS]
        lines.append(f"| `zju`, `{name}` | {' | '.join(cells)} | {said['strip']} |")
    for name in ocmotion_protocols.PROTOCOLS:
        said = ocmotion_protocols.describe_ocmotion(name)
        lines.append(
            f"| `ocmotion`, `{name}` | the cut's | {said['training frames']} | {said['held-out frames']} | none "
            f"| {said['masks']} | {said['size']} | none |"
        )
    for name in video_protocols.PROTOCOLS:
        lines.append(
            f"| `video`, `{name}` | the only one | by subject | by subject, not all apart | the same | masks "
            "| as asked | none |"
        )
    return "\n".join(lines) + "\n"


def protocols_page() -> str:
    """Returns the page on where protocols were read, and what the papers' code does otherwise."""
    chosen = "How they are chosen: [data](../guide/data.md#protocols)."
    parts = ["# Protocols", "", GENERATED, "", chosen, "", *protocol_table().splitlines(), "", *STRIPS, ""]
    for title, names, describe in (
        ("ZJU-MoCap", zju_protocols.PRESETS, zju_protocols.describe),
        ("OcMotion", ocmotion_protocols.PROTOCOLS, ocmotion_protocols.describe_ocmotion),
    ):
        parts += [
            f"## {title}",
            "",
            "| protocol | read in | training frames | what the code does otherwise |",
        ]
        parts += ["|---|---|---|---|"]
        parts += [
            f"| `{name}` | {said['source']} | {said['training frames']} | {said['differs']} |"
            for name in names
            for said in [describe(name)]
        ]
        parts.append("")
    parts += ["## PeopleSnapshot and NeuMan", "", inspect.cleandoc(video_protocols.__doc__ or ""), ""]
    parts += ["| subject | training pictures | held-out pictures |", "|---|---|---|"]
    parts += [
        f"| `{name}` | {_in_words(ranges.train)} | {_in_words(ranges.test)} |"
        for name, ranges in video_protocols.INSTANT_AVATAR.items()
    ]
    return "\n".join(parts) + "\n"


def _in_words(pictures: range) -> str:
    return f"{pictures.start} to {pictures[-1]} by {pictures.step}"


def main() -> None:
    SETTINGS_PAGE.write_text(settings_page(), encoding="utf-8")
    PROTOCOLS_PAGE.write_text(protocols_page(), encoding="utf-8")
    FAULTS_PAGE.write_text(fault_page(), encoding="utf-8")


if __name__ == "__main__":
    main()
