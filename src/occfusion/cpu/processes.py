"""Several processes that train one scene: which of them this one is.

The process that the user started does everything; helpers, which Lightning starts when training begins, run the same
command again, take part in the training and do nothing else: they claim no folder, print nothing and write no file.
"""

from __future__ import annotations

import os
from pathlib import Path

from occfusion.errors import ConfigError

RANK = "LOCAL_RANK"
"""Set by Lightning for every process that it starts, and for itself once it has started some."""
FOLDER = "OCCFUSION_RUN_FOLDER"
"""The folder that the user's process has claimed."""


def local_rank() -> int:
    """Returns the number of this process among those that train together, 0 for the user's own."""
    return int(os.environ.get(RANK, "0"))


def is_helper() -> bool:
    """Returns whether this process was started to help another."""
    return local_rank() > 0


def tell_helpers(folder: Path) -> None:
    """Lets the helpers that will be started know the run folder."""
    os.environ[FOLDER] = str(folder.absolute())


def helped_folder() -> Path | None:
    """Returns the run folder of the process that this one helps; None where it helps none.

    Raises:
        ConfigError: started by something that gave it a rank, but not by a run.
    """
    if not is_helper():
        return None
    if FOLDER not in os.environ:
        raise ConfigError(
            f"{RANK}={local_rank()} is set, but no run has started this process: with trainer.devices=N "
            "`python train.py` starts the others itself; do not use torchrun or srun -n N"
        )
    return Path(os.environ[FOLDER])
