"""Releases with known holes or worse are outside of the ranges, and not here; what is known stands below, offline."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
RANGES = {wanted.name: wanted.specifier for wanted in map(Requirement, PROJECT["dependencies"])}
KNOWN = {
    "torch": (
        ("2.5.1", "`weights_only` ran code (CVE-2025-32434)"),
        ("2.9.1", "its unpickler corrupted memory (CVE-2026-24747)"),
        ("2.10.0", "archives of exported programs ran code (CVE-2026-4538)"),
    ),
    "lightning": (
        ("2.6.2", "malware (GHSA-w37p-236h-pfx3)"),
        ("2.6.3", "malware (GHSA-w37p-236h-pfx3)"),
        (
            "2.6.5",
            "hyperparameters of a checkpoint ran code in `load_from_checkpoint` (its release notes of 2.6.6)",
        ),
    ),
    "hydra-core": (("1.3.7", "aliases passed the block list of `_target_` (GHSA-37p2-j732-x8pj)"),),
    "opencv-contrib-python-headless": (
        ("4.8.0.76", "libwebp wrote out of bounds (CVE-2023-4863)"),
        ("4.11.0.86", "a JPEG was read into a loose pointer (CVE-2025-53644)"),
    ),
    "pillow": (
        ("10.2.0", "a buffer of `_imagingcms` overflowed (CVE-2024-28219)"),
        ("12.1.0", "PSD pictures wrote out of bounds (CVE-2026-25990)"),
        ("12.2.0", "pasting and cropping wrote out of bounds (CVE-2026-59199)"),
        ("12.3.0", "a JPEG overflowed a buffer (CVE-2026-112403)"),
    ),
}
"""By package, the last releases of a kind that must not be taken, and why; looked up in November 2026."""


@pytest.mark.parametrize(
    ("name", "release", "why"), [(name, *one) for name, releases in KNOWN.items() for one in releases]
)
def test_ranges_leave_them_out(name: str, release: str, why: str) -> None:
    assert not RANGES[name].contains(release), f"{name} {release}: {why}"
    assert Version(metadata.version(name)) > Version(release), (
        f"{name} here is no newer than {release}: {why}"
    )


def test_locks_are_newer() -> None:
    for lock in ("requirements.lock", "requirements-dev.lock"):
        pinned = dict(
            re.findall(r"^([\w.-]+)==([\w.+]+)", (ROOT / lock).read_text(encoding="utf-8"), re.MULTILINE)
        )
        for name, releases in KNOWN.items():
            for release, why in releases:
                assert Version(pinned[name]) > Version(release), f"{lock}: {name} {pinned[name]}: {why}"


def test_nothing_direct_is_without_a_floor() -> None:
    for name, specifier in RANGES.items():
        assert any(part.operator in (">=", "==") for part in specifier), f"{name} may be of any age"
