"""The pages that are read by the tests of this folder, and what stands in them."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
TOP = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "NOTICE.md")]
RECORDS = sorted(path for path in (DOCS / "experiments").glob("*.md") if path.name != "README.md")
"""Pages of their date: what they say of settings was true then."""
PAGES = [*TOP, *sorted(DOCS.rglob("*.md"))]
TODAY = [*TOP[:2], *(path for path in PAGES if {"guide", "method"} & set(path.parts))]
"""Pages that quote defaults and commands as they are now."""

_FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def prose(path: Path) -> str:
    """The page without its blocks of code."""
    return _FENCE.sub("", path.read_text(encoding="utf-8"))


def blocks(path: Path) -> list[str]:
    """The blocks of code, without their fences."""
    return [block.split("\n", 1)[1][:-3] for block in _FENCE.findall(path.read_text(encoding="utf-8"))]


def inline_code(path: Path) -> list[str]:
    return re.findall(r"`([^`\n]+)`", prose(path))


def anchors(path: Path) -> set[str]:
    """The names by which headings are linked to, as GitHub makes them."""
    headings = re.findall(r"^#+ +(.+)$", prose(path), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
