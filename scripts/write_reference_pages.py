"""Writes the pages that follow from the code: all settings, the protocols of all data sets, faults and their tests.

    python scripts/write_reference_pages.py

`settings.md`, `protocols.md` and `faults.md` of `docs/reference/` are written whole. Tests hold that what is there is
what this writes.
"""

from __future__ import annotations

from pathlib import Path

from fault_page import fault_page
from protocol_pages import protocols_page
from settings_page import settings_page

DOCS = Path(__file__).resolve().parents[1] / "docs"
SETTINGS_PAGE = DOCS / "reference" / "settings.md"
PROTOCOLS_PAGE = DOCS / "reference" / "protocols.md"
FAULTS_PAGE = DOCS / "reference" / "faults.md"


def main() -> None:
    SETTINGS_PAGE.write_text(settings_page(), encoding="utf-8")
    PROTOCOLS_PAGE.write_text(protocols_page(), encoding="utf-8")
    FAULTS_PAGE.write_text(fault_page(), encoding="utf-8")


if __name__ == "__main__":
    main()
