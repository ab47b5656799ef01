"""Pages that follow from the code are what the code says now."""

import dataclasses
import importlib
import sys

import pytest
from doc_pages import DOCS, ROOT

from occfusion.data.ocmotion import ocmotion_protocols
from occfusion.data.video import video_protocols
from occfusion.data.zju import zju_protocols

AGAIN = "run: python scripts/write_reference_pages.py"


@pytest.fixture(scope="module")
def scripts():
    """Imports a module of `scripts/`, whose modules import each other by name."""
    sys.path.insert(0, str(ROOT / "scripts"))
    yield importlib.import_module
    sys.path.remove(str(ROOT / "scripts"))


@pytest.fixture(scope="module")
def settings_text(scripts):
    return scripts("settings_page").settings_page()


def test_settings_page(settings_text):
    assert settings_text == (DOCS / "reference" / "settings.md").read_text(encoding="utf-8"), AGAIN


def test_every_setting_is_on_the_page(scripts, settings_text):
    facts = scripts("settings_page")
    for overrides in ((), ("dataset=zju",), ("dataset=video",), ("dataset=ocmotion",), ("prior=sd15",)):
        for key, _ in facts.flat(facts.composed(*overrides)):
            is_choice = key.endswith(".name") or key.startswith("variant.")
            assert is_choice or f"| `{key}` |" in settings_text, key


def test_ranges_are_those_that_the_checks_apply(settings_text):
    rows = (line.split(" | ") for line in settings_text.splitlines())
    limits = {row[0].strip("| `"): row[3] for row in rows if len(row) == 5}
    assert limits["optim.sh_degree"] == "0 to 3"
    assert limits["plan"] == "needed or full"
    assert limits["optim.densification.every"] == "at least 1"
    assert limits["optim.lambda_rgb"] == "at least 0"


def test_sentences(scripts):
    facts = scripts("settings_page")
    assert facts.first_sentence("of a lamp (docs/method/optim.md); A | B") == "of a lamp; A or B"
    assert facts.first_sentence("first, e.g. This.\n  Second. Third.") == "first, e.g. This"


def test_a_setting_without_a_sentence_is_an_error(scripts):
    facts = scripts("settings_page")
    record = dataclasses.make_dataclass("Record", [("b", int, 1)])
    with pytest.raises(facts.ConfigError, match=r"a\.b"):
        facts.rows("a", record, {"b": 1})


def test_protocols_page(scripts):
    text = scripts("write_reference_pages").protocols_page()
    assert text == (DOCS / "reference" / "protocols.md").read_text(encoding="utf-8"), AGAIN


def test_faults_page(scripts):
    assert scripts("write_reference_pages").fault_page() == (DOCS / "reference" / "faults.md").read_text(
        encoding="utf-8"
    ), AGAIN


def test_table_of_protocols(scripts):
    page = (DOCS / "reference" / "protocols.md").read_text(encoding="utf-8")
    assert scripts("write_reference_pages").protocol_table() in page, AGAIN
    for names in (zju_protocols.PRESETS, ocmotion_protocols.PROTOCOLS, video_protocols.PROTOCOLS):
        for name in names:
            assert f", `{name}` |" in page, name
