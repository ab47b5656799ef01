"""A lock between processes: one at a time, and none left behind by a process that was killed."""

import multiprocessing
import os
import signal
import time
from multiprocessing.synchronize import Event
from pathlib import Path

import pytest

from occfusion.files.lock import Taken, only_one

SPAWN = multiprocessing.get_context("spawn")


def hold(path: Path, held: Event) -> None:
    with only_one(path):
        held.set()
        time.sleep(60)


def add_many(lock: Path, counter: Path) -> None:
    for _ in range(50):
        with only_one(lock):
            value = int(counter.read_text())
            time.sleep(0.0005)
            counter.write_text(str(value + 1))


def test_nobody_adds_at_the_same_time(tmp_path: Path) -> None:
    counter = tmp_path / "counter"
    counter.write_text("0")
    workers = [SPAWN.Process(target=add_many, args=(tmp_path / "lock", counter)) for _ in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(60)
        assert worker.exitcode == 0
    assert counter.read_text() == "150"
    assert os.listdir(tmp_path) == ["counter"]


def test_who_does_not_wait_is_told_who_holds_it_until_that_is_killed(tmp_path: Path) -> None:
    held = SPAWN.Event()
    holder = SPAWN.Process(target=hold, args=(tmp_path / "lock", held))
    holder.start()
    assert held.wait(60)
    with pytest.raises(Taken, match=f"process {holder.pid} on "), only_one(tmp_path / "lock", wait=False):
        raise AssertionError("let in")
    assert holder.pid is not None
    os.kill(holder.pid, signal.SIGKILL)
    holder.join(60)
    assert (tmp_path / "lock").exists()  # its file is still there, but locks nobody out
    with only_one(tmp_path / "lock", wait=False):
        pass
    assert not (tmp_path / "lock").exists()


def test_where_no_lock_can_be_had_everybody_is_let_in(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with only_one(tmp_path / "file" / "lock", wait=False):
        pass
    assert (tmp_path / "file").read_bytes() == b""
