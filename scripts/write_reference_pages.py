"""Writes the pages that follow from the code: all settings, and the protocols of all data sets.

    python scripts/write_reference_pages.py

`docs/reference/settings.md` and `docs/reference/protocols.md` are written whole; in `docs/guide/data.md` the table
between two marks. Tests hold that what is there is what this writes.
"""

from __future__ import annotations

from pathlib import Path

from protocol_pages import protocols_page, with_protocols
from settings_page import settings_page

DOCS = Path(__file__).resolve().parents[1] / "docs"
SETTINGS_PAGE = DOCS / "reference" / "settings.md"
PROTOCOLS_PAGE = DOCS / "reference" / "protocols.md"
DATA_PAGE = DOCS / "guide" / "data.md"


def main() -> None:
    SETTINGS_PAGE.write_text(settings_page(), encoding="utf-8")
    PROTOCOLS_PAGE.write_text(protocols_page(), encoding="utf-8")
    DATA_PAGE.write_text(with_protocols(DATA_PAGE.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
