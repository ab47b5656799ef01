"""`python -m occfusion view RUN...`: a page in the browser to turn and move avatars, also while they are trained."""

from __future__ import annotations

import argparse
import logging
import socket
import sys
import webbrowser
from pathlib import Path

from occfusion.cpu.loading import loading
from occfusion.errors import ConfigError
from occfusion.viewer.room import furnish


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of the verb."""
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="run folders to choose from")
    parser.add_argument(
        "--motion",
        default="sequence",
        help="sequence, an embedded clip, another run, or a file; others on the page",
    )
    parser.add_argument("--port", type=int, default=8080, help="of the page; the next free one is taken")
    parser.add_argument(
        "--host", default="127.0.0.1", help="0.0.0.0 lets other machines in. Default: this one alone"
    )
    parser.add_argument(
        "--drawn-by", choices=("browser", "server"), default="browser",
        help="server: pictures are drawn here, for browsers without a GPU; the page can change it. Default: browser",
    )  # fmt: skip
    parser.add_argument("--browser", action="store_true", help="open the page in a browser")


def run(arguments: argparse.Namespace) -> int:
    """Serves until it is interrupted; returns the exit code."""
    try:
        with loading():
            import viser
    except ImportError:
        raise ConfigError(
            "view needs viser, which is not installed: pip install 'occfusion[view]', in a clone pip install '.[view]'"
        ) from None
    # browsers open connections that they then leave unused, which is no news to anybody
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    if not 1 <= arguments.port <= 65535:
        raise ConfigError(f"--port {arguments.port}: 1 to 65535")
    try:
        # viser looks for a port without end where the address is not this machine's
        with socket.create_server((arguments.host, 0)):
            pass
        server = viser.ViserServer(arguments.host, arguments.port, label="occfusion", verbose=False)
    except OSError as error:
        raise ConfigError(
            f"--host {arguments.host} --port {arguments.port}: {error.strerror or error}; leave --host out for this "
            "machine alone, or 0.0.0.0 lets others in"
        ) from error
    furnish(server)
    address = f"http://{arguments.host}:{server.get_port()}"
    print(f"{address}  (Ctrl-C ends)", flush=True)
    if arguments.browser and not webbrowser.open(address):
        print("--browser: no browser was found here; open the address above in one", file=sys.stderr)
    try:
        with loading():  # takes seconds, in which the browser gets the page
            from occfusion.viewer.page import Page, names_of

        page = Page(server, names_of(arguments.runs), arguments.motion, arguments.drawn_by)
        if page.figure.run.remark:
            print(page.figure.run.remark, file=sys.stderr)
        page.run()
    finally:
        server.stop()
    return 0
