"""A process that only draws loads less of its libraries, and draws the same."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from occfusion.cpu import loading

is_left_out = pytest.mark.skipif(not loading.is_torch_checked(), reason="this torch is loaded whole")

LEFT_OUT = ("torch._decomp", "torch._prims", "scipy.linalg")


def told_by(code: str) -> str:
    """Returns what a fresh process prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@is_left_out
@pytest.mark.parametrize(
    ("way", "expected"), [("loading_to_draw", [False] * len(LEFT_OUT)), ("loading", [True] * len(LEFT_OUT))]
)
def test_what_only_tracing_and_linear_algebra_need_is_left_to_others(way: str, expected: list[bool]) -> None:
    told = told_by(
        "import sys\n"
        f"from occfusion.cpu.loading import {way}\n"
        f"with {way}():\n"
        "    import torch, numba.np.arraymath\n"
        f"print([name in sys.modules for name in {LEFT_OUT}])"
    )
    assert told == str(expected)


def test_both_can_be_had_afterwards() -> None:
    told = told_by(
        "from occfusion.cpu.loading import loading_to_draw\n"
        "with loading_to_draw():\n"
        "    import torch\n"
        "import numba, numpy, torch._meta_registrations\n"
        "product = numba.njit(lambda a, b: a @ b)(numpy.eye(2), numpy.ones((2, 2)))\n"
        "traced = torch.compile(lambda x: (x + 1).tril(), backend='aot_eager')(torch.ones(2, 2))\n"
        "print(product.sum(), traced.sum().item())"
    )
    assert told == "4.0 6.0"


@pytest.mark.parametrize(
    ("release", "package", "expected"),
    [
        ("2.13.1+cpu", "nowhere", True),
        ("2.11.0", "nowhere", False),
        ("2.14.0", "nowhere", False),
        ("2.13.0", "json", False),
    ],
)
def test_a_torch_that_nobody_has_tried_is_loaded_whole(
    release: str, package: str, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.metadata.version", lambda _: release)
    monkeypatch.setattr(loading, "COMPILES", package)
    assert loading.is_torch_checked() is expected


def test_what_is_loaded_already_stays() -> None:
    told = told_by(
        "import sys, torch, numba.np.arraymath, scipy.linalg.cython_blas\n"
        "from occfusion.cpu.loading import loading_to_draw\n"
        f"before = [sys.modules[name] for name in {LEFT_OUT}]\n"
        "with loading_to_draw():\n"
        "    pass\n"
        f"print(before == [sys.modules[name] for name in {LEFT_OUT}], hasattr(torch, '_meta_registrations'))"
    )
    assert told == "True True"


@is_left_out
def test_the_verb_render_loads_so(tmp_path: Path) -> None:
    """The verb is loaded before it finds that there is no such run."""
    code = (
        "import sys\n"
        "from occfusion.__main__ import main\n"
        f"status = main(['render', {str(tmp_path / 'nothing')!r}, '--output', {str(tmp_path / 'a.png')!r}])\n"
        f"print(status, [name in sys.modules for name in {LEFT_OUT}], 'torch' in sys.modules)"
    )
    assert told_by(code) == f"1 {[False] * len(LEFT_OUT)} True"
