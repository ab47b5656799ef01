"""Trains an avatar: `python train.py [overrides]`, a Hydra application over `conf/`.

Its `@hydra.main` is in `occfusion.cli.train`; the fish shell completes only scripts that name it.
"""

import sys
from pathlib import Path

if __name__ == "__main__":
    try:
        from occfusion.cli.train import main

        sys.exit(main(Path(__file__).resolve().parent / "conf"))
    except KeyboardInterrupt:  # while libraries were imported
        print("stopped by SIGINT: the same command continues", file=sys.stderr)
        sys.exit(130)
