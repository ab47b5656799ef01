"""What Lightning and torch do without a word when something is wrong, each closed here or in a test that is named.

| what happens there | closed by |
|---|---|
| a resumed epoch begins anew | `data/test_sampling.py::test_a_stream_started_late_goes_on_as_the_first_would` |
| objects among hyperparameters make a checkpoint unreadable with `weights_only` | below |
| another number of Gaussians is a size mismatch | `human/test_avatar.py::test_state_of_another_size_loads` |
| a truncated file is any of three errors | `test_damaged_run.py::test_the_newest_whole_checkpoint_is_taken` |
| a loss of NaN trains to the end, exit 0 | `test_run.py::test_non_finite_loss_stops_and_keeps_the_last_good_state` |
| one gradient of NaN makes all parameters NaN | below |
| an empty loader trains nothing | below |
| SIGTERM exits with 0 | `test_command_line.py::test_sigterm_saves_exits_with_143_and_the_same_command_goes_on` |
| a trial writes `last.ckpt` | `test_run.py::test_fast_dev_run` |
"""

from __future__ import annotations

import re
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.utils.data import DataLoader

from occfusion.errors import DataError, NumericsError
from occfusion.files.checkpoint import PARTS, read_checkpoint
from occfusion.files.run_folder import RunFolder
from occfusion.run.training import fit
from occfusion.settings.schema import Settings, TrainerSettings
from occfusion.stages.base import Stage, check_finite_gradients, check_finite_terms

TESTS = Path(__file__).parents[1]


class Falling(Stage):
    """One number that falls."""

    name = "falling"

    def __init__(self) -> None:
        super().__init__()
        self.number = torch.nn.Parameter(torch.ones(()))

    def training_step(self, batch: torch.Tensor, _: int) -> torch.Tensor:
        return self.number * batch

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD([{"name": "number", "params": [self.number]}], lr=0.1)


def fitted(place: Path, batches: list[torch.Tensor], steps: int, falling: Falling | None = None) -> Falling:
    trainer = TrainerSettings(accelerator="cpu", enable_progress_bar=False)
    stage, chosen = falling or Falling(), replace(Settings(), trainer=trainer)
    loader = DataLoader(batches, batch_size=None)  # type: ignore[arg-type]
    fit(stage, loader, chosen, RunFolder(place), place / "last.ckpt", steps=steps)
    return stage


def test_an_empty_loader_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="stage falling: what it trains on ended after 0 of 3 steps"):
        fitted(tmp_path, [], 3)
    assert float(fitted(tmp_path / "whole", [torch.ones(())], 3).number) == pytest.approx(0.7)


def test_checkpoints_hold_nothing_but_tensors_and_numbers(short_run: Path) -> None:
    content = read_checkpoint(short_run / "optim" / "last.ckpt")
    assert set(PARTS) <= set(content) and "hyper_parameters" not in content

    def plain(value: object) -> bool:
        if isinstance(value, dict):
            return all(map(plain, value.values()))
        if isinstance(value, list | tuple):
            return all(map(plain, value))
        return value is None or isinstance(value, torch.Tensor | int | float | str | bool)

    assert plain(content)


@pytest.mark.parametrize("wrong", [float("nan"), float("inf"), float("-inf")])
def test_one_bad_gradient_is_named_before_it_spreads(wrong: float) -> None:
    groups = [
        {"name": name, "params": [torch.nn.Parameter(torch.zeros(4, 3))]} for name in ("means", "scales")
    ]
    for group in groups:
        group["params"][0].grad = torch.ones(4, 3)
    groups.append({"name": "unused", "params": [torch.nn.Parameter(torch.zeros(2))]})
    check_finite_gradients(groups, "optim", 7, "000003")
    groups[1]["params"][0].grad[2, 1] = wrong
    with pytest.raises(NumericsError, match="stage optim, step 7, frame 000003: the gradient of `scales`"):
        check_finite_gradients(groups, "optim", 7, "000003")
    groups[1]["params"][0].grad.fill_(2e38)  # each is finite, and their sum is not
    check_finite_gradients(groups, "optim", 7, "000003")


def test_one_bad_term_is_named() -> None:
    terms = {"rgb": torch.tensor(3e38), "mask": torch.tensor(3e38)}
    for wrong in (float("nan"), float("inf"), -float("inf")):
        bad = {**terms, "ssim": torch.tensor(wrong)}
        with pytest.raises(NumericsError, match=f"the loss term `ssim` is {wrong}"):
            check_finite_terms(bad, "optim", 7, "000003", torch.stack([*bad.values()]).sum())
    total = 1e4 * terms["rgb"] + terms["mask"]
    with pytest.raises(
        NumericsError, match="the weighted sum of the loss terms is inf, and each of them is finite"
    ):
        check_finite_terms(terms, "optim", 7, "000003", total)
    check_finite_terms(terms, "optim", 7, "000003", torch.tensor(1.0))


def test_the_guard_takes_less_than_a_hundredth_of_a_step() -> None:
    """A quarter of Adam's own step over the same gradients, in one process: that takes 1 of the 35 ms of a step."""
    groups = [
        {"name": f"{k}", "params": [torch.nn.Parameter(torch.zeros(shape))], "lr": 1e-4}
        for k, shape in enumerate([(13_000, 45), *[(13_000, 3)] * 4, *[(128, 128)] * 8, *[(128,)] * 10])
    ]
    for group in groups:
        group["params"][0].grad = torch.full_like(group["params"][0], 1e-3)
    adam = torch.optim.Adam([dict(group) for group in groups], fused=True)
    terms = {f"{k}": torch.tensor(float(k)) for k in range(6)}
    total, least = torch.tensor(15.0), {"guard": float("inf"), "adam": float("inf")}
    for _ in range(25):
        started = time.thread_time()
        check_finite_terms(terms, "optim", 7, "000003", total)
        check_finite_gradients(groups, "optim", 7, "000003")
        guarded = time.thread_time()
        adam.step()
        least["guard"] = min(least["guard"], guarded - started)
        least["adam"] = min(least["adam"], time.thread_time() - guarded)
    assert least["guard"] < 0.25 * least["adam"], least


def test_the_tests_that_are_named_are_there() -> None:
    named = re.findall(r"`([\w/]+\.py)::(\w+)`", __doc__ or "")
    assert len(named) == 6
    for file, test in named:
        path = TESTS / file if "/" in file else TESTS / "app" / file
        assert f"def {test}(" in path.read_text(), (file, test)
