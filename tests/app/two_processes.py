"""`train.py` with a recorder in every process; the folder for the records and when to stop come by environment."""

import os
import sys
from pathlib import Path
from typing import Any

import torch

from occfusion.cli.train import main
from occfusion.stages.interruption import SignalGuard
from occfusion.stages.optim import OptimStage

RANK = int(os.environ.get("LOCAL_RANK", "0"))
OUT = Path(os.environ["RECORDS"])
STOP_AT = int(os.environ.get("STOP_AT", "-1"))
record: dict[str, Any] = {"frames": [], "local": [], "averaged": [], "gaussians": []}
original = {
    name: getattr(OptimStage, name) for name in ("training_step", "on_before_optimizer_step", "on_train_end")
}
original_stop = SignalGuard.on_train_batch_end


def training_step(self: OptimStage, frame: Any, number: int) -> torch.Tensor:
    record["frames"].append(frame.name)
    record["gaussians"].append(self.num_gaussians)
    means = self.avatar.gaussians.means
    if not getattr(means, "is_recorded", False):  # densification makes another parameter
        means.is_recorded = True  # type: ignore[attr-defined]
        means.register_hook(lambda gradient: record["local"].append(gradient.clone()))
    return original["training_step"](self, frame, number)  # type: ignore[no-any-return]


def on_before_optimizer_step(self: OptimStage, optimizer: Any) -> None:
    record["averaged"].append(self.avatar.gaussians.means.grad.clone())  # type: ignore[union-attr]
    original["on_before_optimizer_step"](self, optimizer)


def on_train_end(self: OptimStage) -> None:
    original["on_train_end"](self)
    state = self.avatar.state_dict()
    record["state"] = {name: value.clone() for name, value in state.items() if torch.is_tensor(value)}
    OUT.mkdir(parents=True, exist_ok=True)
    torch.save(record, OUT / f"{RANK}.pt")


def on_train_batch_end(self: SignalGuard, trainer: Any, *rest: Any) -> None:
    if RANK == 1 and trainer.global_step == STOP_AT:
        self.received = 15  # only the helper hears of it
    original_stop(self, trainer, *rest)


OptimStage.training_step = training_step  # type: ignore[method-assign]
OptimStage.on_before_optimizer_step = on_before_optimizer_step  # type: ignore[method-assign]
OptimStage.on_train_end = on_train_end  # type: ignore[method-assign]
SignalGuard.on_train_batch_end = on_train_batch_end  # type: ignore[method-assign]

if __name__ == "__main__":
    sys.exit(main(Path(__file__).resolve().parents[2] / "conf"))
