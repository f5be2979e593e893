"""Operator's screen: the current instruction, readable from two metres; a function of the engine's `View`.

On a terminal the screen is redrawn in place; elsewhere (a pipe, ``TERM=dumb``) each change is a line.
"""

import textwrap
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Final

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from calib.bench import block_letters
from calib.bench.keys import BY_LINES
from calib.messages import english, message, verbatim
from calib.procedure.events import Phase, View
from imudrv.diagnosis import LineState

NO_DATA: Final = message("no_data")
"""Headline while no data arrive from the unit."""


NO_FRAMES: Final = message("no_frames")
"""Headline while the data contain no frame of the profile."""


WRONG_RATE: Final = message("wrong_rate")
"""Headline while the unit sends at another rate than its profile's."""


_OTHER_ROWS: Final = 8
"""Rows besides headline, hints and reasons; one stays free for terminals that scroll after the last row."""


_FEWEST: Final = 2


_MOST_HINTS: Final = 3


_MOST_REASONS: Final = 5
"""Limits on the rows of hints and reasons, so that the headline keeps its space."""


_NAMES: Final = {"confirm": "Enter", "redo": "r", "skip": "s", "abort": "q"}


_STYLES: Final = {
    Phase.PREFLIGHT: "white on blue",
    Phase.PLACE: "white on blue",
    Phase.SETTLE: "black on yellow",
    Phase.ALIGN: "black on yellow",
    Phase.ROTATE: "white on magenta",
    Phase.REST: "black on yellow",
    Phase.VERDICT: "black on green",
    Phase.DONE: "black on green",
    Phase.ABORTED: "white on red",
}


def with_port_state(view: View, state: LineState) -> View:
    """Add a fault of the line to a view, and make it the headline.

    Parameters
    ----------
    view : View
        View of the engine.
    state : LineState
        State of the line, from the service.

    Returns
    -------
    View
        The same view if there is no fault.
    """
    if not state.trouble:
        return view
    headlines = {"unreadable": NO_FRAMES, "wrong rate": WRONG_RATE}
    headline = headlines.get(state.name, NO_DATA)
    return replace(view, headline=headline, reasons=(verbatim(str(state)), *view.reasons))


def screen(
    view: View, width: int, height: int, question: str = "", ascii_only: bool = False
) -> RenderableType:
    """Draw a view; it fits 80 columns and 24 lines.

    Parameters
    ----------
    view : View
        View of the engine.
    width, height : int
        Size of the terminal, cells.
    question : str
        Question to show instead of the keys.
    ascii_only : bool
        The terminal has no block characters.

    Returns
    -------
    renderable
    """
    top = Table.grid(expand=True)
    top.add_column(no_wrap=True, overflow="ellipsis")
    top.add_column(justify="right", no_wrap=True)
    where = f"{view.phase.value.upper()} {_time(view.remaining_s)}"
    top.add_row(Text(english(view.title), "bold"), Text(where, "bold"))
    hints = _wrapped([english(hint) for hint in view.hints], width, _FEWEST, _MOST_HINTS)
    reasons = _wrapped([english(reason) for reason in view.reasons], width, _FEWEST, _MOST_REASONS)
    free = height - _OTHER_ROWS - len(hints) - len(reasons)
    return Group(
        top,
        _banner(view, width, max(1, free), ascii_only),
        Text("\n".join(hints)),
        _figures(view, width, ascii_only),
        Text("\n".join(reasons), "bold red"),
        Text((question or _keys(view.actions))[:width], "bold red" if question else "dim"),
    )


def plain(view: View, question: str = "") -> str:
    """Return a view as one line, without the values that change continuously."""
    parts = [english(view.title), f"{view.phase.value}: {english(view.headline)}", *map(english, view.hints)]
    parts += [f"! {reason}" for reason in (*map(english, view.reasons), question) if reason]
    return " | ".join(part for part in parts if part)


class OperatorScreen:
    """Screen that shows views and text.

    A thread of its own writes, so that no caller waits for a stopped terminal (Ctrl-S) or a slow connection.
    A view that has not been written yet is replaced by the next one; lines of text are kept, in order.

    Parameters
    ----------
    console : Console
        Console of rich. Without a terminal, or on a dumb one, it receives plain lines.

    Attributes
    ----------
    shown : View or None
        Newest view that has been written: the operator's keys refer to it.
    """

    def __init__(self, console: Console) -> None:
        self.shown: View | None = None
        self._console = console
        self._is_plain = not console.is_terminal or console.is_dumb_terminal
        self._live: Live | None = None
        self._bells = 0
        self._last = ""
        self._writer = ThreadPoolExecutor(1, "screen")
        self._newest: Future[None] | None = None
        self._newest_view: Future[None] | None = None
        self._newest_text = ""

    @property
    def is_idle(self) -> bool:
        """Whether everything has been written."""
        return self._newest is None or self._newest.done()

    def show(self, view: View, question: str = "") -> None:
        """Show a view.

        Parameters
        ----------
        view : View
            View of the engine.
        question : str
            Question to show instead of the keys.

        Raises
        ------
        OSError
            The terminal can no longer be written to.
        """
        text = plain(view, question) if self._is_plain else ""
        if self._newest_view is not None and text == self._newest_text:
            self._newest_view.cancel()
        self._newest_text = text
        self._newest_view = self._submit(partial(self._draw, view, question))

    def print(self, what: RenderableType) -> None:
        """Leave the full-screen view and print permanent text."""
        self._submit(partial(self._print, what))

    def close(self) -> None:
        """Write everything that waits, however long the terminal takes, and restore the terminal."""
        self._writer.submit(self._leave)
        self._writer.shutdown()

    def _submit(self, write: Callable[[], None]) -> Future[None]:
        before = self._newest
        if before is not None and before.done() and not before.cancelled():
            before.result()
        self._newest = self._writer.submit(write)
        return self._newest

    # Methods of the writing thread

    def _draw(self, view: View, question: str) -> None:
        if self._is_plain:
            self._print_line(plain(view, question))
        else:
            if view.bells > self._bells:
                self._console.bell()
            self._bells = view.bells
            if self._live is None:
                self._live = Live(console=self._console, auto_refresh=False, screen=True)
                self._live.start()
            size = self._console.size
            ascii_only = self._console.options.ascii_only
            self._live.update(screen(view, size.width, size.height, question, ascii_only), refresh=True)
        self.shown = view

    def _print_line(self, text: str) -> None:
        """Print a line unless it repeats the last one."""
        if text != self._last:
            self._console.print(text, markup=False, highlight=False, soft_wrap=True)
            self._last = text

    def _print(self, what: RenderableType) -> None:
        self._leave()
        self._console.print(what, markup=False, highlight=False)

    def _leave(self) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None


def _time(seconds: float | None) -> str:
    return "" if seconds is None else f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def _banner(view: View, width: int, height: int, ascii_only: bool) -> RenderableType:
    refused = view.reasons and view.phase in (Phase.PREFLIGHT, Phase.PLACE, Phase.VERDICT)
    style = (
        "white on red"
        if refused or view.headline in (NO_DATA, NO_FRAMES, WRONG_RATE)
        else _STYLES[view.phase]
    )
    headline, inside = english(view.headline), width - 2
    scale, lines = block_letters.fitted(headline, inside, height)
    if ascii_only and scale < 2:
        scale = 0
    if scale:
        drawn = [block_letters.blocks(line, scale, ascii_only) for line in lines]
        rows = drawn[0] + [row for block in drawn[1:] for row in ["", *block]]
    else:
        rows = [headline]
    free = height - len(rows)
    rows = ["" for _ in range(free // 2)] + rows + ["" for _ in range(free - free // 2)]
    text = "\n".join(row.center(width)[:width] for row in rows)
    return Text(text, f"bold {style}", no_wrap=True, overflow="crop")


def _wrapped(texts: Sequence[str], width: int, fewest: int, most: int) -> list[str]:
    """Wrap texts into rows, each text on a new row; an ellipsis stands for rows beyond the limit."""
    rows = [row for text in texts for row in textwrap.wrap(text, width)]
    if len(rows) > most:
        rows = [*rows[: most - 1], textwrap.shorten(" ".join(rows[most - 1 :]), width, placeholder=" ...")]
    return rows + [""] * (fewest - len(rows))


def _figures(view: View, width: int, ascii_only: bool) -> RenderableType:
    """Return the bars of angle, rate, stillness and progress, and the sigmas."""
    room = width - 10 - 24
    full = view.want_deg or 180.0
    angle = "" if view.angle_deg is None else f"{view.angle_deg:+.1f} of {full:+.0f} deg"
    table = Table.grid(padding=(0, 1))
    table.add_column(width=9, style="bold")
    table.add_column(width=room, no_wrap=True)
    table.add_column(no_wrap=True, overflow="ellipsis")

    def add(name: str, part: float | None, style: str, text: str) -> None:
        table.add_row(name, _bar(part, room, style, ascii_only), text)

    add("angle", (view.angle_deg or 0.0) / full, "magenta", angle)
    add("rate", abs(view.rate_deg_per_s) / 150.0, "cyan", f"{abs(view.rate_deg_per_s):.0f} deg/s")
    add(
        "still",
        view.stillness,
        "green" if view.stillness > 0.8 else "red",
        "" if view.stillness > 0.8 else "moving",
    )
    add("progress", view.progress, "yellow", "" if view.progress is None else f"{view.progress:.0%}")
    sigmas = [
        f"{name} {sigma:.4f} deg"
        for name, sigma in (("level", view.level_sigma_deg), ("heading", view.heading_sigma_deg))
        if sigma is not None
    ]
    table.add_row("1 sigma", ", ".join(sigmas), "")
    return table


def _bar(part: float | None, width: int, style: str, ascii_only: bool) -> Text:
    filled = round(min(max(part or 0.0, 0.0), 1.0) * width)
    full, empty = ("#", "-") if ascii_only else ("█", "░")
    return Text.assemble((full * filled, style), (empty * (width - filled), "dim"))


def _keys(actions: Sequence[str]) -> str:
    names = [f"{_NAMES[name]}: {name}" for name in _NAMES if name in actions]
    return "   ".join([*names, "(a letter, then Enter)"] if names and BY_LINES else names)
