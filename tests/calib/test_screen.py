"""The bench's screen: big enough, small enough, and plain where there is no terminal."""

import os
import pty
import sys
import termios
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO, StringIO, TextIOWrapper
from threading import Event
from typing import Any

import pytest
from realtime import DEADLINE_S, until
from rich.cells import cell_len
from rich.console import Console

from calib.bench import block_letters
from calib.bench.keys import Keyboard
from calib.bench.screen import (
    NO_DATA,
    NO_FRAMES,
    OperatorScreen,
    large_text,
    plain,
    screen,
    tone,
    with_port_state,
)
from calib.messages import english, message, verbatim
from calib.procedure.events import Abort, Confirm, Phase, Redo, Skip, View
from imudrv.diagnosis import LineState

LONG = (
    "gravity reads 9.203 m/s^2 where 9.792 +- 0.02 is expected: check the accelerometers' scale factors",
    "the readings are those of a unit whose accelerometers X and Y are exchanged, or of another pose",
)
HEADLINES = (
    "TURN IT: X UP",
    "TURN IT 180 DEG COUNTER-CLOCKWISE",
    "HANDS OFF 5:54",
    "ROTATE NOW +180",
    "ROTATE NOW -180",
    "FASTER",
    "STOP",
    "CHECK FAILED: SEE WHY",
    "GOOD: STEP 12 OF 20 DONE",
    "WAIT FOR THE UNIT",
    english(NO_DATA),
    english(NO_FRAMES),
)


def view(phase: Phase = Phase.PLACE, headline: str = "TURN IT: X UP", **changes: Any) -> View:
    values: dict[str, Any] = {
        "step_id": "x-up",
        "title": "step 2 of 3: X up, +180 deg",
        "hints": (),
        "reasons": (),
        "last_try": (),
        "accepted": (),
        "skipped": (),
        "C_nb": None,
        "force_m_s2": None,
        "angle_deg": None,
        "want_deg": None,
        "rate_deg_per_s": 0.0,
        "stillness": 1.0,
        "progress": None,
        "remaining_s": None,
        "level_sigma_deg": None,
        "heading_sigma_deg": None,
        "actions": ("confirm", "redo", "skip", "back", "abort"),
        "bells": 0,
    }
    values |= changes
    for name in ("hints", "reasons", "last_try"):
        values[name] = tuple(map(verbatim, values[name]))
    values["title"] = verbatim(values["title"])
    return View(phase=phase, headline=verbatim(headline), **values)


def rows(shown: View, width: int = 80, height: int = 24, **options: Any) -> list[str]:
    out = StringIO()
    console = Console(file=out, width=width, height=height, color_system=None)
    console.print(screen(shown, width, height, **options))
    return out.getvalue().splitlines()


@pytest.mark.parametrize("size", [(80, 24), (120, 40), (200, 60)])
@pytest.mark.parametrize("headline", HEADLINES)
def test_every_screen_fits_and_keeps_its_height(headline: str, size: tuple[int, int]) -> None:
    full = {
        "hints": (LONG[0], LONG[1]),
        "reasons": (*LONG, *LONG),
        "angle_deg": -171.25,
        "want_deg": -180.0,
        "rate_deg_per_s": -123.0,
        "stillness": 0.0,
        "progress": 0.5,
        "remaining_s": 3599.0,
        "level_sigma_deg": 0.0031,
        "heading_sigma_deg": 0.0821,
    }
    for shown in (view(headline=headline), view(Phase.ROTATE, headline, **full)):
        drawn = rows(shown, *size)
        assert len(drawn) == size[1] - 1
        assert max(map(len, drawn)) <= size[0]


def test_the_headline_is_drawn_in_letters_at_least_three_rows_high_on_a_small_screen() -> None:
    for headline in HEADLINES:
        # what a screen of 80 by 24 has left beside the most that hints and reasons take
        scale, lines = block_letters.fitted(headline, 78, 8)
        assert scale >= 1
        assert block_letters.rows(lines, scale) <= 8
        assert " ".join(lines) == headline


def test_a_letter_is_what_it_looks_like() -> None:
    assert block_letters.blocks("T", 2) == ["██████", "  ██  ", "  ██  ", "  ██  ", "  ██  "]
    assert block_letters.blocks("T", 1) == ["▀█▀", " █ ", " ▀ "]
    assert block_letters.blocks("T", 2, ascii_only=True)[0] == "######"


def test_bars_figures_and_reasons_are_on_the_screen() -> None:
    text = "\n".join(
        rows(
            view(
                Phase.ROTATE,
                "FASTER",
                angle_deg=90.0,
                want_deg=180.0,
                rate_deg_per_s=44.0,
                stillness=0.0,
                remaining_s=75.0,
                level_sigma_deg=0.0031,
                heading_sigma_deg=0.0821,
                reasons=("turned 148.3 deg, expected 180 +- 5",),
            )
        )
    )
    for words in (
        "step 2 of 3: X up, +180 deg",
        "+90.0 of +180 deg",
        "44 deg/s",
        "moving",
        "level 0.0031 deg, heading 0.0821 deg",
        "turned 148.3 deg, expected 180 +- 5",
        "Enter: confirm   r: redo   s: skip   b: back to the skipped step   q: abort",
    ):
        assert words in text
    bar = next(row for row in text.splitlines() if row.startswith("angle"))
    assert bar.count("█") == bar.count("░")


def test_a_question_replaces_the_keys() -> None:
    assert rows(view(), question=verbatim("once more: abort"))[-1] == "once more: abort"


@pytest.mark.parametrize(
    ("state", "line"),
    [
        (LineState("lost", "the port is gone"), "NO DATA: CHECK THE CABLE | ! port lost: the port is gone"),
        (
            LineState("silent", "nothing for 0.4 s"),
            "NO DATA: CHECK THE CABLE | ! port silent: nothing for 0.4 s",
        ),
        (LineState("unreadable", "no frame"), "NO FRAMES: CHECK THE PROFILE | ! port unreadable: no frame"),
        (
            LineState("wrong rate", "expected 1000 samples/s"),
            "WRONG RATE: CHECK THE PROFILE | ! port wrong rate: expected 1000 samples/s",
        ),
        (LineState("streaming"), "TURN IT: X UP"),
    ],
)
def test_what_is_wrong_with_the_line_is_shown_and_without_samples_it_is_the_headline(
    state: LineState, line: str
) -> None:
    shown = with_port_state(view(), state)
    assert tone(shown) == ("bad" if state.trouble else "do")
    assert plain(shown).endswith(f"place: {line}")
    assert state.trouble in "\n".join(rows(shown))


def test_a_session_that_is_over_does_not_ask_for_the_line() -> None:
    done = view(phase=Phase.DONE, headline=message("all_done"))
    assert with_port_state(done, LineState("lost", "the port is gone")) == done


def test_the_countdown_is_in_the_large_text_while_one_waits() -> None:
    shown = replace(view(Phase.ALIGN, remaining_s=354.0), headline=message("hands_off"))
    assert large_text(shown) == "HANDS OFF 5:54"
    turning = replace(view(Phase.ROTATE, remaining_s=354.0), headline=message("rotate", turn_deg=180))
    assert large_text(turning) == "ROTATE +180"


def test_a_rejection_has_one_reason_and_one_remedy_in_the_largest_letters_and_then_a_grey_last_try() -> None:
    slow = message("too_slow", peak_deg_per_s=40.0, limit_deg_per_s=60.0)
    angle = message("wrong_angle", angle_deg=150.0, expected_deg=180.0, tolerance_deg=5.0)
    rejected = replace(
        view(Phase.VERDICT),
        headline=message("rejected"),
        hints=(message("remedy_time", shortest_s=2.0, longest_s=3.0),),
        reasons=(slow, angle),
    )
    drawn = rows(rejected)
    text = "\n".join(drawn)
    assert len(drawn) == 23
    assert "peak 40 deg/s: slower than 60" in text
    assert "turn it in 2 to 3 s" in text
    assert "turned 150.0 deg" not in text
    assert sum("█" in row for row in drawn) >= 10  # of the letters; there are no bars

    again = replace(view(Phase.PLACE), last_try=(slow, angle))
    assert "last try: peak 40 deg/s: slower than 60" in "\n".join(rows(again))
    assert len(rows(again)) == 23


def test_a_terminal_without_blocks_gets_ascii() -> None:
    for headline in HEADLINES:
        assert "\n".join(rows(view(headline=headline, progress=0.3), ascii_only=True)).isascii()


def test_in_chinese_the_large_letters_stay_ascii_and_the_headline_is_repeated_below() -> None:
    shown = replace(
        view(Phase.ALIGN, remaining_s=75.0),
        headline=message("hands_off"),
        hints=(message("do_not_touch"),),
        reasons=(message("alignment_interrupted", elapsed_s=8.4, cause=message("unit_restarted")),) * 4,
    )
    out = StringIO()
    console = Console(file=out, width=80, height=24, color_system=None)
    console.print(screen(shown, 80, 24, language="zh_CN"))
    drawn = out.getvalue().splitlines()

    assert len(drawn) == 23
    assert max(map(cell_len, drawn)) <= 80
    assert drawn[0].endswith("对准")
    assert "请勿触碰" in drawn
    assert drawn[-1] == "Enter: 确认   r: 重做   s: 跳过   b: 返回跳过的步骤   q: 中止"
    assert not any("请" in row for row in drawn[1:10])  # the large letters


def test_a_terminal_of_ascii_gets_english() -> None:
    out = TextIOWrapper(BytesIO(), "ascii")
    shown = OperatorScreen(Console(file=out, width=80), "zh_CN")
    shown.say(message("computing"))
    shown.close()
    out.seek(0)
    assert out.read() == "Computing the result from the recordings ...\n"


def test_without_a_terminal_each_change_is_a_line() -> None:
    out = StringIO()
    shown = OperatorScreen(Console(file=out, width=80))
    shown.show(view(rate_deg_per_s=20.0, hints=("roll it over",)))
    shown.show(view(rate_deg_per_s=30.0, hints=("roll it over",), bells=1))
    shown.show(view(Phase.VERDICT, "REJECTED: DO IT AGAIN", reasons=("turned 150 deg, expected 180 +- 5",)))
    shown.show(view(Phase.VERDICT, "REJECTED: DO IT AGAIN"), question=verbatim("once more: abort"))
    shown.close()
    assert out.getvalue().splitlines() == [
        "step 2 of 3: X up, +180 deg | place: TURN IT: X UP | roll it over",
        "step 2 of 3: X up, +180 deg | verdict: REJECTED: DO IT AGAIN | ! turned 150 deg, expected 180 +- 5",
        "step 2 of 3: X up, +180 deg | verdict: REJECTED: DO IT AGAIN | ! once more: abort",
    ]


def test_a_dumb_terminal_gets_lines_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "dumb")
    out = StringIO()
    shown = OperatorScreen(Console(file=out, force_terminal=True, width=80))
    shown.show(view())
    shown.close()
    assert out.getvalue() == plain(view()) + "\n"


def test_the_bell_rings_when_bells_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    out = StringIO()
    shown = OperatorScreen(Console(file=out, force_terminal=True, width=80, height=24))
    for bells in (0, 1, 1, 2):
        shown.show(view(bells=bells))
        written(shown)
    shown.close()
    assert out.getvalue().count("\a") == 2


def written(shown: OperatorScreen) -> None:
    """Wait until a screen has written everything."""
    until(lambda: shown.is_idle)


class Stopped(StringIO):
    """A terminal that takes nothing until it runs again."""

    def __init__(self) -> None:
        super().__init__()
        self.runs = Event()
        self.waits = Event()

    def write(self, text: str) -> int:
        self.waits.set()
        assert self.runs.wait(DEADLINE_S)
        return super().write(text)


def test_a_stopped_terminal_blocks_no_caller_and_then_draws_only_the_newest_view(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    out = Stopped()
    shown = OperatorScreen(Console(file=out, force_terminal=True, width=80, height=24))
    shown.show(view(title="first"))
    assert out.waits.wait(DEADLINE_S)
    for k in range(1000):
        shown.show(view(title=f"view {k}"))
    assert shown.shown is None
    assert not shown.is_idle
    out.runs.set()
    written(shown)
    assert shown.shown == view(title="view 999")
    shown.close()
    assert "first" in out.getvalue()
    assert "view 999" in out.getvalue()
    assert "view 998" not in out.getvalue()


def test_what_is_printed_and_plain_lines_wait_in_order_for_a_stopped_reader() -> None:
    out = Stopped()
    shown = OperatorScreen(Console(file=out, width=80))
    for k in range(3):
        shown.show(view(title=f"view {k}"))
    shown.print("the result")
    shown.show(view(title="view 3"))
    out.runs.set()
    shown.close()
    lines = out.getvalue().splitlines()
    assert [line.partition(" |")[0] for line in lines] == [
        "view 0",
        "view 1",
        "view 2",
        "the result",
        "view 3",
    ]


def test_a_closed_terminal_is_an_error_at_the_next_view() -> None:
    class Gone(StringIO):
        def write(self, text: str) -> int:
            raise OSError("gone")

    shown = OperatorScreen(Console(file=Gone(), width=80))
    shown.show(view(title="first"))
    written(shown)
    with pytest.raises(OSError, match="gone"):
        shown.show(view(title="second"))
    shown.close()


class Terminal:
    """A keyboard."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.master, slave = pty.openpty()
        monkeypatch.setattr(sys, "stdin", os.fdopen(slave, "r"))

    def type(self, keys: bytes) -> None:
        os.write(self.master, keys)


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    terminal = Terminal(monkeypatch)
    yield terminal
    sys.stdin.close()
    os.close(terminal.master)


@pytest.mark.parametrize(
    ("key", "action"),
    [
        (b"\n", Confirm("x-up")),
        (b"ry", Redo("x-up")),
        (b"SY", Skip("x-up")),
        (b"by", Redo("z-up")),
        (b"qy", Abort()),
        (b"x", None),
        (b"y", None),
        (b"\x1b[A", None),
    ],
)
def test_a_key_asks_for_the_step_that_is_on_the_screen(
    terminal: Terminal, key: bytes, action: object
) -> None:
    with Keyboard() as keys:
        assert keys.action(view()) is None
        terminal.type(key)
        assert keys.action(view(skipped=("y-up", "z-up"))) == action


def test_a_key_that_makes_no_sense_now_does_nothing(terminal: Terminal) -> None:
    with Keyboard() as keys:
        terminal.type(b"\n")
        assert keys.action(view(actions=("skip",))) is None


@pytest.mark.parametrize(
    ("key", "question"), [("r", "ask_redo"), ("s", "ask_skip"), ("b", "ask_back"), ("q", "ask_abort")]
)
def test_what_gives_work_up_is_asked_and_only_y_confirms_it(
    terminal: Terminal, key: str, question: str
) -> None:
    shown = view(skipped=("z-up",))
    with Keyboard() as keys:
        for answer in ("n", "x", key, "\n"):
            terminal.type(key.encode())
            assert keys.action(shown) is None
            assert keys.question == message(question)
            terminal.type(answer.encode())
            assert keys.action(shown) is None
            assert keys.question is None
        terminal.type(key.encode())
        keys.action(shown)
        terminal.type(b"y")
        assert keys.action(shown) is not None


def test_an_answer_that_comes_in_another_step_does_nothing(terminal: Terminal) -> None:
    with Keyboard() as keys:
        terminal.type(b"s")
        assert keys.action(view()) is None
        terminal.type(b"y")
        assert keys.action(view(step_id="y-up")) is None


def test_keys_are_read_without_enter_and_the_terminal_is_given_back_as_it_was(terminal: Terminal) -> None:
    before = termios.tcgetattr(sys.stdin.fileno())
    with Keyboard():
        assert not termios.tcgetattr(sys.stdin.fileno())[3] & termios.ICANON
    assert termios.tcgetattr(sys.stdin.fileno()) == before


def test_without_a_terminal_there_are_no_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", open(os.devnull))  # noqa: SIM115
    with Keyboard() as keys:
        assert not keys.there
        assert keys.action(view()) is None
    sys.stdin.close()
