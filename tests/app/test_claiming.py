"""Run folders and shared results when several processes want them at the same time."""

import json
import multiprocessing
import os
import threading
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from occfusion.errors import CheckpointError, ConfigError
from occfusion.files.atomic import create_bytes
from occfusion.files.run_folder import RunFolder
from occfusion.files.sharing import offer, sole_maker, take
from occfusion.run import folder as runfolder
from occfusion.run.folder import at_work, claim_run_folder
from occfusion.settings.schema import Settings, VariantSettings

SPAWN = multiprocessing.get_context("spawn")
ROUNDS = 20


def settings(folder: Path, seed: int) -> Settings:
    variant = VariantSettings("A", ["optim"])
    return Settings(
        dataset={"name": "zju", "root": "data", "scene": "s"},
        variant=variant,
        seed=seed,
        output_dir=str(folder),
    )


def claim_again_and_again(
    root: Path, seed: int, barrier: Barrier, results: "Queue[tuple[int, list[str]]]"
) -> None:
    claimed = []
    for number in range(ROUNDS):
        barrier.wait(60)
        folder = root / str(number) / "run"
        claimed.append(claim_run_folder(settings(folder, seed), "data", chosen_by_user=False).path.name)
    results.put((seed, claimed))


def offer_again_and_again(root: Path, number: int, barrier: Barrier) -> None:
    (root / f"own{number}").mkdir()
    for k in range(30):
        (root / f"own{number}" / f"{k}.png").write_bytes(b"x" * 1000)
    (root / f"record{number}.json").write_text('{"train_seconds": 1}')
    for k in range(ROUNDS):
        barrier.wait(60)
        offer(root / "shared" / str(k), root / f"own{number}", root / f"record{number}.json")
        assert take(root / "shared" / str(k), root / f"taken{number}" / str(k)) == {"train_seconds": 1}
        assert len(os.listdir(root / f"taken{number}" / str(k))) == 30


@pytest.mark.slow
def test_two_processes_never_get_one_folder(tmp_path: Path) -> None:
    barrier, results = SPAWN.Barrier(2), SPAWN.Queue()
    workers = [
        SPAWN.Process(target=claim_again_and_again, args=(tmp_path, seed, barrier, results))
        for seed in (0, 1)
    ]
    for worker in workers:
        worker.start()
    claimed = dict(results.get(timeout=120) for _ in workers)
    for worker in workers:
        worker.join(60)
    for number in range(ROUNDS):
        assert {claimed[0][number], claimed[1][number]} == {"run", "run-2"}
        for seed in (0, 1):
            folder = tmp_path / str(number) / claimed[seed][number]
            assert OmegaConf.load(folder / "config.yaml").seed == seed
            assert sorted(os.listdir(folder)) == ["config.yaml", "environment.json"]


def test_who_finds_a_folder_free_and_comes_second_takes_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both have looked before either writes: the order of events that a race needs, every time."""
    both_have_looked = threading.Barrier(2)

    def late(path: Path, content: bytes) -> bool:
        if path.parent.name == "run":
            both_have_looked.wait(30)
        return create_bytes(path, content)

    monkeypatch.setattr(runfolder, "create_bytes", late)
    claimed: dict[int, Path] = {}

    def claim(seed: int) -> None:
        claimed[seed] = claim_run_folder(settings(tmp_path / "run", seed), "data", chosen_by_user=False).path

    threads = [threading.Thread(target=claim, args=(seed,)) for seed in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert {folder.name for folder in claimed.values()} == {"run", "run-2"}
    for seed, folder in claimed.items():
        assert OmegaConf.load(folder / "config.yaml").seed == seed


def test_a_folder_is_claimed_once_also_where_links_do_not_exist(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise OSError("no links here")

    monkeypatch.setattr(os, "link", refuse)
    assert (
        claim_run_folder(settings(tmp_path / "run", 0), "data", chosen_by_user=True).path == tmp_path / "run"
    )
    assert json.loads((tmp_path / "run" / "environment.json").read_text())["identity"]
    with pytest.raises(ConfigError, match="other settings"):
        claim_run_folder(settings(tmp_path / "run", 1), "data", chosen_by_user=True)
    assert (
        claim_run_folder(settings(tmp_path / "run", 0), "data", chosen_by_user=True).path == tmp_path / "run"
    )
    monkeypatch.setattr(runfolder, "MARKER_PATIENCE", 0.1)
    (tmp_path / "run" / "environment.json").write_bytes(b"")  # its writer was killed between name and content
    with pytest.raises(CheckpointError, match="move the folder away"):
        claim_run_folder(settings(tmp_path / "run", 0), "data", chosen_by_user=True)


def test_what_a_killed_process_left_does_not_make_a_folder_taken(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".environment.json.abc.partial").write_bytes(b"{")
    (tmp_path / "run" / ".at_work").write_bytes(b"process 1 on nowhere")
    assert (
        claim_run_folder(settings(tmp_path / "run", 0), "data", chosen_by_user=True).path == tmp_path / "run"
    )
    with at_work(RunFolder(tmp_path / "run")):
        pass
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "holiday.jpg").write_bytes(b"1")
    with pytest.raises(ConfigError, match="name another folder"):
        claim_run_folder(settings(tmp_path / "other", 0), "data", chosen_by_user=True)


def test_the_same_run_is_not_done_by_two_at_once(tmp_path: Path) -> None:
    with (
        at_work(RunFolder(tmp_path)),
        pytest.raises(ConfigError, match="is at work on this very run"),
        at_work(RunFolder(tmp_path)),
    ):
        pass
    with at_work(RunFolder(tmp_path)):
        pass
    assert not os.listdir(tmp_path)


@pytest.mark.slow
def test_two_processes_offer_the_same_results(tmp_path: Path) -> None:
    barrier = SPAWN.Barrier(2)
    workers = [SPAWN.Process(target=offer_again_and_again, args=(tmp_path, n, barrier)) for n in (0, 1)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(120)
        assert worker.exitcode == 0
    assert len(os.listdir(tmp_path / "shared")) == ROUNDS  # nothing half-made lies beside them
    for folder in (tmp_path / "shared").iterdir():
        assert len(os.listdir(folder / "results")) == 30


def test_shared_results_are_made_by_one_while_others_wait(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shared, made = tmp_path / "init" / "key", []

    def make(number: int) -> None:
        with sole_maker(shared):
            if not shared.exists():
                made.append(number)
                first_is_in.set()
                threading.Event().wait(0.3)
                shared.mkdir(parents=True)

    first_is_in = threading.Event()
    threads = [threading.Thread(target=make, args=(n,)) for n in (0, 1)]
    threads[0].start()
    assert first_is_in.wait(10)
    threads[1].start()
    for thread in threads:
        thread.join(30)
    assert made == [0]
    assert "waiting for it" in capsys.readouterr().out
    assert os.listdir(tmp_path) == ["init"]
