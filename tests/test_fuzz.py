"""The fuzzer runs and finds a broken decoder, and the processing chain accepts any capture."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imudrv.errors import FaultyFileError
from imudrv.files.settings_file import parse
from imudrv.sim.scenario import Scenario
from imudrv.wire.candump import format_candump
from imudrv.wire.stream import Decoded, StreamDecoder
from tools.fuzz import __main__ as fuzz
from tools.fuzz.chain import NAMES, check_chain
from tools.fuzz.units import SHIPPED, transmit


def capture(profile: str) -> bytes:
    """A good capture of 40 messages or frames."""
    sent = transmit(np.random.default_rng(1), SHIPPED[profile], 40)
    return format_candump(sent) if SHIPPED[profile].can else sent


CAPTURES = {profile: capture(profile) for profile in SHIPPED}


@pytest.mark.parametrize("target", [t.name for t in fuzz.TARGETS])
def test_some_cases_of_every_target_pass(target: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert fuzz.main(["--cases", "12", "--only", target]) == 0
    assert target in capsys.readouterr().out


def test_a_decoder_that_loses_a_byte_is_found_and_its_input_reduced(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    close = StreamDecoder.close

    def forgetful(decoder: StreamDecoder) -> Decoded:
        decoder._state["pending"] = 0
        return close(decoder)

    monkeypatch.setattr(StreamDecoder, "close", forgetful)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert fuzz.main(["--only", "stream", "--cases", "100", "--seed", "3"]) == 1
    printed = capsys.readouterr().out
    assert "after 1: input not accounted for" in printed
    assert "run: python -m tools.fuzz --only stream --seed 3 --first " in printed
    (kept,) = tmp_path.iterdir()
    assert str(kept) in printed
    assert len(kept.read_bytes()) == 1


def test_an_interrupted_run_ends_with_the_summary(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(fuzz.Case, "run", interrupted)
    assert fuzz.main([]) == 130
    assert "MB" in capsys.readouterr().out


EDITS = st.lists(st.tuples(st.integers(0, 3000), st.integers(0, 90), st.binary(max_size=90)), max_size=6)
CUTS = st.lists(st.integers(0, 3000), max_size=8)


@pytest.mark.parametrize("profile", CAPTURES)
@settings(deadline=None, max_examples=150)
@given(EDITS, CUTS, st.sampled_from(NAMES))
def test_a_changed_capture_gives_the_same_finite_increments_in_any_pieces_and_its_counts_add_up(
    profile: str, edits: list[tuple[int, int, bytes]], cuts: list[int], rate_filter: str
) -> None:
    data = CAPTURES[profile]
    for at, lost, inserted in edits:
        data = data[:at] + inserted + data[at + lost :]
    check_chain([profile, rate_filter, True], data, cuts)


@pytest.mark.parametrize("profile", CAPTURES)
@settings(deadline=None, max_examples=100)
@given(st.binary(max_size=300), CUTS)
def test_the_counts_of_the_chain_add_up_for_any_bytes(profile: str, data: bytes, cuts: list[int]) -> None:
    check_chain([profile, "causal", True], data, cuts)


# Found by the fuzzer


def test_a_list_with_a_fault_inside_is_not_called_too_short() -> None:
    site = {"latitude_deg": 28.2, "longitude_deg": 113.0, "height_m": 60.0}
    document = {"format": "imu50-scenario", "version": 1, "site": site}
    with pytest.raises(FaultyFileError) as caught:
        parse(document | {"motion": [{"rest": {"duration_s": -1}}]}, Scenario, "x")
    assert caught.value.faults == ("motion[0].rest.duration_s: expected more than 0.0, got -1",)
    with pytest.raises(FaultyFileError, match="motion: expected at least 1"):
        parse(document | {"motion": []}, Scenario, "x")
