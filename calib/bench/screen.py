"""Operator's screen: the current instruction, readable from two metres; a function of the engine's `View`.

On a terminal the screen is redrawn in place; elsewhere (a pipe, ``TERM=dumb``) each change is a line. The
large letters are English in every language; in another one the headline is repeated below them.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from math import ceil
from typing import Final

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from calib.bench import block_letters
from calib.bench.keys import BY_LINES
from calib.messages import Message, message, text
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


_FIGURES: Final = 5
"""Rows of the bars."""


_FEWEST: Final = 2


_MOST_HINTS: Final = 3


_MOST_REASONS: Final = 5
"""Limits on the rows of hints and reasons, so that the headline keeps its space."""


_NAMES: Final = {
    "confirm": ("Enter", message("key_confirm")),
    "redo": ("r", message("key_redo")),
    "skip": ("s", message("key_skip")),
    "back": ("b", message("key_back")),
    "abort": ("q", message("key_abort")),
}
"""Key and name of each action."""


PHASES: Final = {
    Phase.PREFLIGHT: message("phase_preflight"),
    Phase.PLACE: message("phase_place"),
    Phase.SETTLE: message("phase_settle"),
    Phase.ALIGN: message("phase_align"),
    Phase.ROTATE: message("phase_rotate"),
    Phase.REST: message("phase_rest"),
    Phase.VERDICT: message("phase_verdict"),
    Phase.DONE: message("phase_done"),
    Phase.ABORTED: message("phase_aborted"),
}
"""Name of each phase."""


_LINE_STATES: Final = {
    "connecting": message("line_connecting"),
    "silent": message("line_silent"),
    "unreadable": message("line_unreadable"),
    "wrong rate": message("line_wrong_rate"),
    "lost": message("line_lost"),
    "ended": message("line_ended"),
}


_WRAPS: Final = Console(color_system=None)


_TONES: Final = {
    Phase.PREFLIGHT: "do",
    Phase.PLACE: "do",
    Phase.SETTLE: "wait",
    Phase.ALIGN: "wait",
    Phase.ROTATE: "turn",
    Phase.REST: "wait",
    Phase.VERDICT: "good",
    Phase.DONE: "good",
    Phase.ABORTED: "bad",
}


_STYLES: Final = {
    "do": "white on blue",
    "wait": "black on yellow",
    "turn": "white on magenta",
    "good": "black on green",
    "bad": "white on red",
}


def with_port_state(view: View, state: LineState) -> View:
    """Add a fault of the line to a view, and make it the headline; what is over does not need the line.

    Parameters
    ----------
    view : View
        View of the engine.
    state : LineState
        State of the line, from the service.

    Returns
    -------
    View
        The same view if there is no fault, or after the last step.
    """
    if not state.trouble or view.phase in (Phase.DONE, Phase.ABORTED):
        return view
    headlines = {"unreadable": NO_FRAMES, "wrong rate": WRONG_RATE}
    headline = headlines.get(state.name, NO_DATA)
    reason = message("line", state=_LINE_STATES[state.name], trouble=state.trouble)
    return replace(view, headline=headline, reasons=(reason, *view.reasons))


def screen(
    view: View,
    width: int,
    height: int,
    question: Message | None = None,
    ascii_only: bool = False,
    language: str = "en",
) -> RenderableType:
    """Draw a view; it fits 80 columns and 24 lines.

    Parameters
    ----------
    view : View
        View of the engine.
    width, height : int
        Size of the terminal, cells.
    question : Message, optional
        Question to show instead of the keys.
    ascii_only : bool
        The terminal has no block characters.
    language : str
        Language of all but the large letters.

    Returns
    -------
    renderable
    """

    def shown(what: Message) -> str:
        return text(what, language)

    top = Table.grid(expand=True)
    top.add_column(no_wrap=True, overflow="ellipsis")
    top.add_column(justify="right", no_wrap=True)
    top.add_row(Text(shown(view.title), "bold"), Text(shown(PHASES[view.phase]).upper(), "bold"))
    headline = () if language == "en" else (view.headline,)
    hints = _wrapped([*map(shown, (*headline, *view.hints))], width, _FEWEST, _MOST_HINTS)
    reasons = _wrapped([*map(shown, shown_reasons(view))], width, _FEWEST, _MOST_REASONS)
    last_try = _wrapped([shown(tried) for tried in shown_last_try(view)], width, 0, 1)
    last = _keys(view.actions, language) if question is None else shown(question)
    figures = () if _is_rejected(view) else (_figures(view, width, ascii_only, language),)
    free = height - _OTHER_ROWS + _FIGURES * (not figures) - len(hints) - len(reasons) - len(last_try)
    return Group(
        top,
        _banner(view, width, max(1, free), ascii_only),
        Text("\n".join(hints)),
        *figures,
        Text("\n".join(reasons), "bold red"),
        *(Text(row, "dim") for row in last_try),
        Text(last, "dim" if question is None else "bold red", no_wrap=True, overflow="crop"),
    )


def plain(view: View, question: Message | None = None, language: str = "en") -> str:
    """Return a view as one line, without the values that change continuously."""

    def shown(what: Message) -> str:
        return text(what, language)

    phase = message("mark", mark=PHASES[view.phase], text=view.headline)
    parts = [shown(view.title), shown(phase), *map(shown, view.hints)]
    parts += [f"! {shown(why)}" for why in shown_reasons(view)] + [
        shown(tried) for tried in shown_last_try(view)
    ]
    parts += [] if question is None else [f"! {shown(question)}"]
    return " | ".join(part for part in parts if part)


class OperatorScreen:
    """Screen that shows views and text.

    A thread of its own writes, so that no caller waits for a stopped terminal (Ctrl-S) or a slow connection.
    A view that has not been written yet is replaced by the next one; lines of text are kept, in order.

    Parameters
    ----------
    console : Console
        Console of rich. Without a terminal, or on a dumb one, it receives plain lines.
    language : str
        Language of the operator; English where the terminal can show only ASCII.

    Attributes
    ----------
    language : str
        Language that is shown.
    shown : View or None
        Newest view that has been written: the operator's keys refer to it.
    """

    def __init__(self, console: Console, language: str = "en") -> None:
        self.shown: View | None = None
        self._console = console
        self.language = "en" if console.options.ascii_only else language
        self._is_plain = not console.is_terminal or console.is_dumb_terminal
        self._live: Live | None = None
        self._bells = 0
        self._last = ""
        self._writer = ThreadPoolExecutor(1, "screen")
        self._newest: Future[None] | None = None
        self._newest_view: Future[None] | None = None
        self._newest_line = ""

    @property
    def is_idle(self) -> bool:
        """Whether everything has been written."""
        return self._newest is None or self._newest.done()

    def show(self, view: View, question: Message | None = None) -> None:
        """Show a view.

        Parameters
        ----------
        view : View
            View of the engine.
        question : Message, optional
            Question to show instead of the keys.

        Raises
        ------
        OSError
            The terminal can no longer be written to.
        """
        line = plain(view, question, self.language) if self._is_plain else ""
        if self._newest_view is not None and line == self._newest_line:
            self._newest_view.cancel()
        self._newest_line = line
        self._newest_view = self._submit(partial(self._draw, view, question))

    def print(self, what: RenderableType) -> None:
        """Leave the full-screen view and print permanent text."""
        self._submit(partial(self._print, what))

    def say(self, what: Message) -> None:
        """Print a message as permanent text."""
        self.print(text(what, self.language))

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

    def _draw(self, view: View, question: Message | None) -> None:
        if self._is_plain:
            self._print_line(plain(view, question, self.language))
        else:
            if view.bells > self._bells:
                self._console.bell()
            self._bells = view.bells
            if self._live is None:
                self._live = Live(console=self._console, auto_refresh=False, screen=True)
                self._live.start()
            size = self._console.size
            ascii_only = self._console.options.ascii_only
            drawn = screen(view, size.width, size.height, question, ascii_only, self.language)
            self._live.update(drawn, refresh=True)
        self.shown = view

    def _print_line(self, line: str) -> None:
        """Print a line unless it repeats the last one."""
        if line != self._last:
            self._console.print(line, markup=False, highlight=False, soft_wrap=True)
            self._last = line

    def _print(self, what: RenderableType) -> None:
        self._leave()
        self._console.print(what, markup=False, highlight=False)

    def _leave(self) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None


def tone(view: View) -> str:
    """Return what a view asks for: 'do', 'wait', 'turn'; or how something went: 'good', 'bad'."""
    refused = view.reasons and view.phase in (Phase.PREFLIGHT, Phase.VERDICT)
    if refused or view.headline in (NO_DATA, NO_FRAMES, WRONG_RATE):
        return "bad"
    return "wait" if view.headline.key == "hands_off" else _TONES[view.phase]


def large_text(view: View, language: str = "en") -> str:
    """Return the headline, with the remaining time where one has to wait."""
    headline, remaining_s = text(view.headline, language), view.remaining_s
    if view.headline.key != "hands_off" or remaining_s is None:
        return headline
    minutes, seconds = divmod(ceil(remaining_s), 60)
    return f"{headline} {minutes}:{seconds:02d}"


def _is_rejected(view: View) -> bool:
    """Whether the view shows a rejected attempt."""
    return view.headline.key == "rejected"


def shown_reasons(view: View) -> tuple[Message, ...]:
    """Return the reasons to show: of a rejection one, which its hint remedies."""
    return view.reasons[:1] if _is_rejected(view) else view.reasons


def shown_last_try(view: View) -> tuple[Message, ...]:
    """Return why the last attempt was rejected."""
    return tuple(message("label_last_try", reason=reason) for reason in view.last_try[:1])


def _banner(view: View, width: int, height: int, ascii_only: bool) -> RenderableType:
    style = _STYLES[tone(view)]
    headline, inside = large_text(view), width - 2
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
    drawn_text = "\n".join(row.center(width)[:width] for row in rows)
    return Text(drawn_text, f"bold {style}", no_wrap=True, overflow="crop")


def _wrapped(texts: Sequence[str], width: int, fewest: int, most: int) -> list[str]:
    """Wrap texts into rows, each text on a new row; an ellipsis replaces rows beyond the limit."""
    rows = [row.plain for one in texts for row in Text(one).wrap(_WRAPS, width)]
    if len(rows) > most:
        rows = rows[:most]
        rows[-1] = f"{_cut(rows[-1], width - 4)} ..."
    return rows + [""] * (fewest - len(rows))


def _cut(line: str, width: int) -> str:
    """Cut a line to a width in cells."""
    cut = Text(line)
    cut.truncate(width)
    return cut.plain.rstrip()


def _figures(view: View, width: int, ascii_only: bool, language: str) -> RenderableType:
    """Return the bars of angle, rate, stillness and progress, and the sigmas."""

    def shown(what: Message) -> str:
        return text(what, language)

    room = width - 10 - 24
    full, rate = view.want_deg or 180.0, abs(view.rate_deg_per_s)
    angle = message("angle_of", angle_deg=view.angle_deg or 0.0, want_deg=full)
    is_still = view.stillness > 0.8
    table = Table.grid(padding=(0, 1))
    table.add_column(width=9, style="bold")
    table.add_column(width=room, no_wrap=True)
    table.add_column(no_wrap=True, overflow="ellipsis")

    def add(name: Message, part: float | None, style: str, value: str) -> None:
        table.add_row(shown(name), _bar(part, room, style, ascii_only), value)

    add(
        message("label_angle"),
        (view.angle_deg or 0.0) / full,
        "magenta",
        "" if view.angle_deg is None else shown(angle),
    )
    add(message("label_rate"), rate / 150.0, "cyan", shown(message("rate_value", rate_deg_per_s=rate)))
    add(
        message("label_still"),
        view.stillness,
        "green" if is_still else "red",
        "" if is_still else shown(message("label_moving")),
    )
    percent = "" if view.progress is None else f"{view.progress:.0%}"
    add(message("label_progress"), view.progress, "yellow", percent)
    level, heading = view.level_sigma_deg, view.heading_sigma_deg
    sigmas = ""
    if level is not None and heading is not None:
        sigmas = shown(message("sigmas", level_deg=level, heading_deg=heading))
    table.add_row(shown(message("label_sigma")), sigmas, "")
    return table


def _bar(part: float | None, width: int, style: str, ascii_only: bool) -> Text:
    filled = round(min(max(part or 0.0, 0.0), 1.0) * width)
    full, empty = ("#", "-") if ascii_only else ("█", "░")
    return Text.assemble((full * filled, style), (empty * (width - filled), "dim"))


def _keys(actions: Sequence[str], language: str) -> str:
    names = [f"{key}: {text(name, language)}" for action, (key, name) in _NAMES.items() if action in actions]
    return "   ".join([*names, text(message("key_by_lines"), language)] if names and BY_LINES else names)
