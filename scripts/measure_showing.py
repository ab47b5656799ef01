"""Measures how fast an avatar is drawn, turned, viewed and played as a page, and prints a table for the documentation.

    python scripts/measure_showing.py runs/synthetic/001-clean/E [--only drawing turntable view shown page]

Wall time and processor time stand beside each other, with the machine's load: on a machine that others use, the wall
clock says how crowded it is. `view` and exported pages are looked at by a Chromium without a GPU, where there is one
(`tests/app/headless.py`); the newest picture that is on its screen counts, not what was sent.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "tests" / "app"))

import headless  # noqa: E402  (a browser, as the tests drive it)

SIZE = 512
PAGE = (780, 500)
GAUSSIANS_BYTES = 100_000
COUNT = """
const ask = window.requestAnimationFrame.bind(window);
window.frames_drawn = 0; window.pictures = 0; window.instanced = 0;
window.requestAnimationFrame = (f) => ask((t) => { window.frames_drawn++; f(t); });
const gl = WebGL2RenderingContext.prototype;
for (const name of ["texImage2D", "texSubImage2D"]) {
  const own = gl[name];
  gl[name] = function (...words) {
    const last = words[words.length - 1];
    if (last && last.width > 200 && !ArrayBuffer.isView(last)) window.pictures++;
    return own.apply(this, words);
  };
}
for (const name of ["drawElementsInstanced", "drawArraysInstanced"]) {
  const own = gl[name];
  gl[name] = function (...words) { window.instanced++; return own.apply(this, words); };
}
"""


def say(what: str, figure: str) -> None:
    """Prints a row."""
    load = os.getloadavg()[0]
    print(f"| {what} | {figure} | {load:.1f} |", flush=True)


def used() -> float:
    """Returns seconds of processor time of this process and its ended children."""
    whose = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(u.ru_utime + u.ru_stime for u in map(resource.getrusage, whose))


def used_below(pid: int) -> float:
    """Returns seconds of processor time of a process and all that it has started and that still run."""
    below: dict[int, list[int]] = {}
    spent: dict[int, float] = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
        except (OSError, IndexError):
            continue  # none, or just ended
        below.setdefault(int(fields[1]), []).append(int(entry.name))
        spent[int(entry.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    total, left = 0.0, [pid]
    while left:
        one = left.pop()
        total += spent.get(one, 0.0)
        left += below.get(one, [])
    return total


def measure_drawing(run: Path, _: float) -> None:
    """Draws a motion at `SIZE`, with one thread and with two, in processes of their own."""
    for threads in (1, 2):
        command = [sys.executable, __file__, str(run), "--draw-with", str(threads)]
        subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": str(threads)})


def draw(run: Path, threads: int) -> None:
    """Draws the frames of `walk` and says what one takes: posed Gaussians to picture, and joints to picture."""
    from occfusion.human.rendering import Renderer
    from occfusion.run.loaded import load_run
    from occfusion.run.showing import MotionChoice, make_showing

    torch.set_num_threads(threads)
    loaded, renderer = load_run(run), Renderer("auto")
    showing = make_showing(
        loaded, "turntable", MotionChoice("walk"), size=(SIZE, SIZE), frames=96, renderer=renderer
    )
    painter = showing.painter
    clouds = [painter.cloud(shot) for shot in showing.shots]

    def each(do: Callable[[int], Any]) -> str:
        walls, began = [], time.process_time()
        for k in range(len(clouds)):
            start = time.perf_counter()
            do(k)
            walls.append(1000 * (time.perf_counter() - start))
        spent = 1000 * (time.process_time() - began) / len(clouds)
        middle, best = statistics.median(walls), statistics.quantiles(walls, n=10)[0]
        return f"{middle:.1f} ms (a tenth below {best:.1f}), {1000 / middle:.0f} a second; {spent:.1f} ms of processor"

    with torch.inference_mode():
        for k in range(4):  # kernels are loaded
            painter.draw(showing.shots[k])
        many = f"{loaded.avatar.gaussians.num_gaussians} Gaussians, {SIZE} px, threads {threads}"
        say(f"drawing alone, {many}", each(lambda k: renderer.draw(clouds[k], showing.shots[k].camera)))
        say(f"posing and drawing, {many}", each(lambda k: painter.draw(showing.shots[k])))


def measure_turntable(run: Path, _: float) -> None:
    """Times the whole command."""
    with tempfile.TemporaryDirectory() as folder:
        for threads in (1, 2):
            words = ["render", str(run), "--path", "turntable", "--size", str(SIZE), "--frames", "120"]
            output = str(Path(folder) / "turn.mp4")
            start, before = time.perf_counter(), used()
            subprocess.run(
                [sys.executable, "-m", "occfusion", *words, "--output", output], check=True, capture_output=True,
                env={**os.environ, "OMP_NUM_THREADS": str(threads)},
            )  # fmt: skip
            say(
                f"`render --path turntable --frames 120`, {SIZE} px, the whole command, threads {threads}",
                f"{time.perf_counter() - start:.1f} s; {used() - before:.1f} s of processor",
            )


@contextmanager
def viewing(run: Path, *words: str) -> Iterator[tuple[str, float, subprocess.Popen[bytes]]]:
    """Runs `view`; gives its address, when it began, and its process."""
    port = headless.free_port()
    start = time.perf_counter()
    command = [sys.executable, "-m", "occfusion", "view", str(run), "--port", str(port), *words]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield f"127.0.0.1:{port}", start, process
        finally:
            process.terminate()


def measure_view(run: Path, _: float) -> None:
    """Times from the command to the first Gaussians that arrive at a client."""
    import viser
    from websockets.sync.client import connect

    for _number in range(3):
        with viewing(run) as (address, start, process):
            client = None
            while client is None:
                try:
                    client = connect(
                        f"ws://{address}",
                        subprotocols=[f"viser-v{viser.__version__}"],
                        max_size=None,  # type: ignore[list-item]
                    )
                except OSError:
                    time.sleep(0.02)
            opened = time.perf_counter() - start
            with client:  # nothing else is as large as Gaussians: 32 bytes each
                while len(bytes(client.recv(timeout=120))) < GAUSSIANS_BYTES:  # type: ignore[arg-type]
                    pass
            seen = time.perf_counter() - start
            spent = used_below(process.pid)
        say("`view`: the page, and the first picture at a client, after the command", (
            f"{opened:.1f} s and {seen:.1f} s; {spent:.1f} s of processor"
        ))  # fmt: skip


def measure_shown(run: Path, seconds: float) -> None:
    """Counts what a browser shows of `view` while a motion plays, drawn by itself and by the server."""
    for who in ("browser", "server"):
        with viewing(run, "--motion", "walk", "--drawn-by", who) as (address, _, process):
            while True:
                try:
                    with headless.socket.create_connection(tuple(address.split(":")), 1):  # type: ignore[arg-type]
                        break
                except OSError:
                    time.sleep(0.1)
            with (
                tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
                headless.opened(f"http://{address}", Path(profile), COUNT) as page,
            ):
                width, height = PAGE
                size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
                page.command("Emulation.setDeviceMetricsOverride", **size)
                page.wait_for("window.pictures > 3 || window.instanced > 1", 90)
                time.sleep(3)
                asked = "window.pictures" if who == "server" else "window.instanced"
                before, start = page.evaluate(asked), time.perf_counter()
                spent = used_below(process.pid), used_below(os.getpid())
                time.sleep(seconds)
                shown = page.evaluate(asked) - before
                passed = time.perf_counter() - start
                served = used_below(process.pid) - spent[0]
                looked = used_below(os.getpid()) - spent[1] - served
        say(f"`view`, drawn by {who}, {width} x {height}, Chromium without a GPU", (
            f"{shown / passed:.1f} pictures a second on the screen; of processor a second the server has "
            f"{served / passed:.2f} s and the browser {looked / passed:.2f} s"
        ))  # fmt: skip


def measure_page(run: Path, seconds: float) -> None:
    """Measures an exported page: its size, and what a browser draws of it while it plays."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        path = Path(folder) / "avatar.html"
        command = [sys.executable, "-m", "occfusion", "export", str(run), "--output", str(path)]
        subprocess.run(command, check=True, capture_output=True)
        with headless.opened(path, Path(folder) / "profile", COUNT) as page:
            page.wait_for("!!window.occfusion", 90)
            about = page.evaluate("[occfusion.about.gaussians, occfusion.motions.map((m) => m.frames)]")
            time.sleep(5)
            before, start = page.evaluate("window.instanced"), time.perf_counter()
            time.sleep(seconds)
            rate = (page.evaluate("window.instanced") - before) / (time.perf_counter() - start)
        say(
            f"`.html`, {about[0]} Gaussians, motions of {about[1]} frames",
            f"{path.stat().st_size / 1e6:.1f} MB; {rate:.1f} pictures a second in Chromium without a GPU",
        )


PARTS = {
    "drawing": measure_drawing,
    "turntable": measure_turntable,
    "view": measure_view,
    "shown": measure_shown,
    "page": measure_page,
}


def main() -> None:
    """Measures what is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--seconds", type=float, default=15.0, help="of each look at a page")
    parser.add_argument("--draw-with", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.draw_with is not None:
        draw(arguments.run, arguments.draw_with)
        return
    print(f"{os.cpu_count()} cores\n\n| what | figure | load |\n|---|---|---|", flush=True)
    for name in arguments.only:
        if name in ("shown", "page") and headless.find_browser() is None:
            say(name, "no Chromium here")
            continue
        PARTS[name](arguments.run, arguments.seconds)


if __name__ == "__main__":
    main()
