"""Examples of one scene of the inpainter's corpus on disk, written and read one by one: none stays in memory."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from occfusion.errors import DataError
from occfusion.prior_training.appearance_batches import Example

PARTS = ("planes", "truth", "mask")
"""Fields of an example, a file each: `planes.npy` and so on, uint8, one row an example."""


class ExampleShard:
    """The examples of a scene.

    Args:
        folder: of their files.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def write(self, examples: Iterable[Example], count: int) -> None:
        """Writes examples as they come.

        Args:
            examples: of one size.
            count: of them.

        Raises:
            DataError: there are others than `count`, or the disk refuses.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        written, files = 0, {}
        try:
            for example in examples:
                for name in PARTS:
                    row: NDArray[np.uint8] = getattr(example, name)
                    if not written:
                        files[name] = (self.folder / f"{name}.npy").open("wb")
                        header = {"descr": "|u1", "fortran_order": False, "shape": (count, *row.shape)}
                        np.lib.format.write_array_header_1_0(files[name], header)
                    files[name].write(row.tobytes())
                written += 1
        except OSError as error:
            raise DataError(
                f"{self.folder}: cannot be written ({error.strerror}); check space and rights."
            ) from error
        finally:
            for file in files.values():
                file.close()
        if written != count or not count:
            raise DataError(f"{self.folder}: {written} examples of {count} occluded frames")
        self.__dict__.pop("_forms", None)

    @cached_property
    def _forms(self) -> dict[str, tuple[int, tuple[int, ...]]]:
        """Where the numbers of each file begin, and its shape."""
        found = {}
        for name in PARTS:
            with (self.folder / f"{name}.npy").open("rb") as file:
                np.lib.format.read_magic(file)
                shape, _, dtype = np.lib.format.read_array_header_1_0(file)
                if dtype != np.uint8:
                    raise DataError(
                        f"{file.name}: {dtype} instead of uint8; remove the folder, it is made again"
                    )
                found[name] = file.tell(), shape
        return found

    def __len__(self) -> int:
        return self._forms["planes"][1][0]

    def read(self, k: int) -> Example:
        """Returns an example; pages of a mapped file would count as this process's memory once they were read."""
        parts = {}
        for name, (start, (_, *shape)) in self._forms.items():
            size = int(np.prod(shape))
            rows = np.fromfile(self.folder / f"{name}.npy", np.uint8, size, offset=start + k * size)
            if len(rows) != size:
                raise DataError(f"{self.folder / name}.npy: cut short; remove the folder, it is made again")
            parts[name] = rows.reshape(shape)
        return Example(**parts)
