"""The page of the protocols of all data sets, `docs/reference/protocols.md`."""

from __future__ import annotations

import inspect
import re

from settings_page import GENERATED

from occfusion.data.ocmotion import ocmotion_protocols
from occfusion.data.video import video_protocols
from occfusion.data.zju import zju_protocols

STRIPS = (
    "Strips are middle / width in columns of a picture 1024 wide: the paper's are 377 460/70, 386 415/80, 387",
    "448/50, 392 417/78, 393 434/68, 394 418/64; OccNeRF's differ in 387 451/66 and 394 423/64.",
)


def protocol_table() -> str:
    """Returns the table of all protocols."""
    lines = [
        "| protocol | training camera | training frames | held-out frames | held-out cameras | masks | size | strip |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in zju_protocols.PRESETS:
        said = zju_protocols.describe(name)
        keys = (
            "training camera",
            "training frames",
            "held-out frames",
            "held-out cameras",
            "masks",
            "longer side",
        )
        cells = [re.sub(r"the first \(.*\)", "a stretch, by subject", said[key]) for key in keys]
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
    parts = [
        "# Protocols",
        "",
        GENERATED,
        "",
        "How they are chosen: [data](../guide/data.md#protocols).",
        "",
        *protocol_table().splitlines(),
        "",
        *STRIPS,
        "",
    ]
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
