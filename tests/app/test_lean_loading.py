"""A process that only draws loads less of its libraries."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from occfusion.cpu import loading

LEFT_OUT = ("torch._decomp", "torch._prims", "scipy.linalg")
IS_WHOLE = not loading.is_torch_checked()
"""Whether the torch that is here is loaded whole in any case."""


def told_by(code: str) -> str:
    """Returns what a fresh process prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.mark.parametrize(
    ("way", "expected"),
    [("loading_to_draw", [IS_WHOLE, IS_WHOLE, False]), ("loading", [True] * len(LEFT_OUT))],
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


@pytest.mark.parametrize(
    "first", ["torch", "lightning", "torch._meta_registrations", "torch._functorch.config"]
)
@pytest.mark.slow
def test_both_can_be_had_afterwards(first: str) -> None:
    """Parts of torch that trace import each other in a circle; `render --path train` reads data with Lightning."""
    told = told_by(
        "from occfusion.cpu.loading import loading_to_draw\n"
        "with loading_to_draw():\n"
        "    import torch\n"
        f"import numba, numpy, {first}\n"
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


@pytest.mark.parametrize(("path", "is_lean"), [("turntable", True), ("train", False), ("held-out", True)])
def test_a_command_draws_in_a_process_of_its_own(
    path: str, is_lean: bool, short_run: Path, tmp_path: Path
) -> None:
    """Beside its input it reads data, with Lightning, which asks for what was left out."""
    told = told_by(
        "import sys\n"
        "from occfusion.__main__ import main\n"
        f"words = ['--path', {path!r}, '--frames', '1', '--size', '48', '--output', {str(tmp_path / 'p')!r}]\n"
        f"status = main(['render', {str(short_run)!r}, *words])\n"
        "print(status, 'torch._decomp' in sys.modules)"
    )
    assert told.splitlines()[-1] == f"0 {IS_WHOLE or not is_lean}"
    assert len(list((tmp_path / "p").rglob("*.png"))) == 1
