"""How much of a print or of a hairy chest the completion of colours puts on the back, where nobody has it.

python scripts/measure_copies.py [WEIGHTS ...]        # prints a CSV; without weights those of the package

Subjects 090 to 099, in a plain top with marks in front alone, or without a top and with hair; seen from before, as a
run sees them. `copied`: share of the contrast that is found right behind. `psnr`: of these backs, dB.
"""

from __future__ import annotations

import csv
import sys

from occfusion.human.body import embedded_body
from occfusion.inpaint.completion import ColorCompleter, CompletionSettings
from occfusion.prior_training.completion_copies import MARKS, back_psnr, copied_share, marked_examples

COUNT = 30
"""People of each kind, of whom those whose marks hardly show are left out."""


def main() -> None:
    weights = sys.argv[1:] or [None]
    completers = [ColorCompleter(embedded_body(), CompletionSettings(path)) for path in weights]
    writer = csv.writer(sys.stdout)
    writer.writerow(("marks", "people", "colours", "copied", "psnr"))
    for marks in MARKS:
        examples = list(marked_examples(marks, COUNT))
        found = {"nearby": [example.shown.colors.double().numpy() for example in examples]}
        for path, completer in zip(weights, completers, strict=True):
            found[path or "completed"] = [
                completer.complete(shown.colors, shown.seen).colors.double().numpy()
                for shown in (example.shown for example in examples)
            ]
        for name, colours in found.items():
            share, psnr = copied_share(colours, examples), back_psnr(colours, examples)
            writer.writerow((marks, len(examples), name, f"{share:.2f}", f"{psnr:.2f}"))


if __name__ == "__main__":
    main()
