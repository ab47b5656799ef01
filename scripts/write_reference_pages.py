"""Writes the pages that follow from the code: all settings, and the protocols of all data sets.

    python scripts/write_reference_pages.py

`docs/reference/settings.md` and `docs/reference/protocols.md` are written whole. Tests hold that what is there is what
this writes.
"""

from __future__ import annotations

from pathlib import Path

from protocol_pages import protocols_page
from settings_page import settings_page

DOCS = Path(__file__).resolve().parents[1] / "docs"
SETTINGS_PAGE = DOCS / "reference" / "settings.md"
PROTOCOLS_PAGE = DOCS / "reference" / "protocols.md"


def main() -> None:
    SETTINGS_PAGE.write_text(settings_page(), encoding="utf-8")
    PROTOCOLS_PAGE.write_text(protocols_page(), encoding="utf-8")


if __name__ == "__main__":
    main()
