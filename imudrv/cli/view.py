"""Command `imudrv view`."""

import argparse
from pathlib import Path
from typing import Final

from imudrv.receiver import receive
from imudrv.recording.reader import Recording
from imudrv.terminal import say
from imudrv.viewer import PORT, Viewer, play, start_server

EXAMPLE: Final = "udp://:5050"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    text = "what `imudrv run --out` sends (udp://[HOST]:PORT, tcp://HOST:PORT), or a recording (.mcap)"
    parser.add_argument("source", help=text)
    text = f"port on this machine that Foxglove or Lichtblick connects to (default: {PORT})"
    parser.add_argument("--listen", type=int, default=PORT, metavar="PORT", help=text)


def run(arguments: argparse.Namespace) -> None:
    """Show samples until Ctrl-C, or the end of a recording."""
    viewer = Viewer()
    if "://" in arguments.source:
        with receive(arguments.source) as receiver:
            _serve(arguments.listen)
            for increments in receiver:
                viewer.publish(increments)
    else:
        recording = Recording(Path(arguments.source))
        _serve(arguments.listen)
        play(recording.increments(), viewer)


def _serve(port: int) -> None:
    server = start_server(port)
    say(f"open ws://127.0.0.1:{server.port} in Foxglove or Lichtblick; Ctrl-C ends")
