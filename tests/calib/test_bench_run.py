"""The whole bench procedure through a real pty: the unit simulated in another process, in fast time."""

import json
import logging
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from realtime import DEADLINE_S
from rich.console import Console
from samples import parse_json

from calib.bench.entries import Plan, Signed, from_json
from calib.bench.journal import Journal, begin
from calib.bench.result import identify, identify_session
from calib.bench.run import RunOptions, run
from calib.bench.session import Session
from calib.bench.simulated_unit import SEED
from calib.bench.state import JOURNAL, Attempt
from calib.bench.technician import BENCH, true_calibration
from calib.bench.verify import verify
from calib.fleet.reidentify import reidentify, reidentify_all, sessions
from calib.identification import PriorCalibration
from calib.procedure.plan import load, predicted
from calib.signing.keys import BenchKey, bench_key, make_bench_key
from calib.signing.signatures import fingerprint
from imudrv.calibration import SizeEffect, read_calibration, write_calibration
from imudrv.errors import InputError
from imudrv.files import atomic, settings_file
from imudrv.files.atomic import sha256
from imudrv.recording.reader import Recording
from imudrv.records import Source
from imudrv.sim.scenario import NOMINAL
from imudrv.sinks.recorder import Recorder

# The alignment is short: the joint estimate determines most of heading and biases again.
PROCEDURE = """
format: imu50-procedure
version: 1
name: short
align_s: 40
rest_s: 8
poses:
  - {id: z-up, up: +Z, east: +X, turn_deg: 180}
  - {id: x-up, up: +X, east: +Y, turn_deg: 180}
  - {id: y-up, up: +Y, east: +Z, turn_deg: 180}
"""
TURNS = """
format: imu50-procedure
version: 2
name: turns
align_s: 40
rest_s: 4
turn_s: [1.5, 2]
poses:
  - {id: z-up, up: +Z, east: +X, turn_deg: 180, turns: 4}
  - {id: x-up, up: +X, east: +Y, turn_deg: 180, turns: 4}
  - {id: y-up, up: +Y, east: +Z, turn_deg: 180, turns: 4}
"""
STEPS = ["z-up", "x-up", "y-up"]
RUN = """
import sys
from pathlib import Path
from rich.console import Console
from calib.bench.run import RunOptions, run
from imudrv.terminal import guarded
procedure, folder, *redo = sys.argv[1:]
options = RunOptions(Path(folder), procedure=procedure, rehearse=True, speed="max", redo=tuple(redo))
sys.exit(guarded(lambda: run(options, Console(width=200))))
"""
INTERRUPTED_LOADING = f"""
import os, signal
from imudrv.service import loop
load = loop.warm_up

def interrupted(*arguments):
    try:
        os.kill(os.getpid(), signal.SIGINT)
    except KeyboardInterrupt:
        pass  # as in a callback of the compiler, which can raise nothing
    load(*arguments)

loop.warm_up = interrupted
{RUN}"""

INTERRUPTED_AFTER_Y_UP = f"""
import os
from calib.bench.entries import AcceptedStep
from calib.bench.session import Session
append = Session.append

def appended(session, entry):
    append(session, entry)
    if isinstance(entry, AcceptedStep) and entry.step_id == "y-up":
        os._exit(130)  # before the result is computed

Session.append = appended
{RUN}"""


def start(folder: Path, *redo: str, program: str = RUN, procedure: str = PROCEDURE) -> subprocess.Popen[str]:
    """Begin or resume a rehearsal."""
    file = folder.parent / "short.yaml"
    file.write_text(procedure)
    return subprocess.Popen(
        [sys.executable, "-c", program, str(file), str(folder), *redo],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def journal(folder: Path) -> list[dict[str, Any]]:
    """Complete lines of the journal, which may be growing."""
    path = folder / JOURNAL
    text = path.read_text() if path.exists() else ""
    return [parse_json(line) for line in text.split("\n")[:-1]]


def until(process: subprocess.Popen[str], true: Callable[[], bool]) -> None:
    """Wait for an outcome, or for the end of a process that should run."""
    end = time.monotonic() + DEADLINE_S
    while not true():
        if process.poll() is not None or time.monotonic() > end:
            process.kill()
            raise AssertionError("\n".join(filter(None, process.communicate())))
        time.sleep(0.01)


def ended(process: subprocess.Popen[str]) -> str:
    out, err = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, out + err
    return out


def size_effect(folder: Path) -> SizeEffect:
    found = read_calibration(folder / "certificate.yaml").size_effect
    assert found is not None
    return found


@pytest.fixture(scope="module", autouse=True)
def key(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BenchKey]:
    """The bench has a key, in all processes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("config")))
        yield make_bench_key("bench 3")[1]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("bench") / "undisturbed"
    return folder, ended(start(folder))


def test_the_result_is_within_three_sigma_of_the_truth_and_a_twentieth_of_a_millimetre_rms(
    undisturbed: tuple[Path, str],
) -> None:
    check_true(undisturbed[0])


def test_the_operator_sees_every_step_and_the_result(
    undisturbed: tuple[Path, str],
) -> None:
    folder, said = undisturbed
    # In fast time the screen, which shows the newest state only, passes over some of them.
    for words in ("Z up", "X up", "Y up", "align: HANDS OFF", "DONE"):
        assert any(words in line for line in said.splitlines()), words
    assert f"report: {folder / 'report.html'}" in said
    assert "residual velocity after half a turn" in said
    # what the rehearsal knows of the truth is shown at its end only
    assert said.count("rms error of the nine components") == 1
    assert said.index("rms error of the nine components") > said.index("active certificate")


def test_a_rehearsal_in_fast_time_is_reported_neither_as_a_wrong_rate_nor_without_data(
    undisturbed: tuple[Path, str],
) -> None:
    folder, said = undisturbed
    assert "samples/s" not in said + (folder / JOURNAL).read_text()
    assert "NO DATA" not in said


@pytest.mark.parametrize(
    "profile",
    [
        "kvh1775",  # floating point, a counter of 7 bits
        "hg4930",  # no counter
        "ilabs-ga-200",  # rates, a counter in steps of 10
        "sbg-imu-short",  # a time
    ],
)
def test_units_of_other_makers_give_arms_as_good_from_their_recordings(profile: str, tmp_path: Path) -> None:
    folder = tmp_path / "session"
    ended(start(folder, program=RUN.replace("rehearse=True", f"rehearse=True, profile={profile!r}")))
    verified = verify(folder)
    assert verified.faults == ()
    assert "the recordings give the certificate, digit for digit" in verified.notes
    check_true(folder)
    certificate = read_calibration(folder / "certificate.yaml")
    assert certificate.gyro.scale == certificate.accelerometer.scale == (1.0, 1.0, 1.0)


def test_the_operator_sees_that_the_unit_sends_no_frame_of_the_profile(tmp_path: Path) -> None:
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    settings_file.write(tmp_path / "site.yaml", BENCH)
    (tmp_path / "short.yaml").write_text(PROCEDURE)
    files = ["--calibration", "unit.yaml", "--site", "site.yaml", "--procedure", "short.yaml"]
    sends = ["sim", "static", "--profile", "imu50-rs422-acc", "--port", "pty", "--link", "port"]
    port = ["--port", str(tmp_path / "port"), "--profile", "imu50-rs422"]
    shown = tmp_path / "shown"
    with shown.open("w") as screen:
        unit, operator = (
            subprocess.Popen(
                [sys.executable, "-m", *command],
                cwd=tmp_path,
                stdin=subprocess.DEVNULL,
                stdout=screen,
                stderr=screen,
                text=True,
            )
            for command in (
                ["imudrv", *sends],
                ["calib", "run", *port, *files, "--session", "session", "--hands-free"],
            )
        )
    try:
        until(operator, lambda: "preflight: NO FRAMES: CHECK THE PROFILE" in shown.read_text())
        until(operator, lambda: "check never right; this looks like imu50-rs422-acc" in shown.read_text())
        operator.send_signal(signal.SIGINT)
        assert operator.wait(DEADLINE_S) == 130, shown.read_text()
    finally:
        for process in (unit, operator):
            process.kill()
            process.wait()


def test_the_active_certificate_is_the_result_and_the_old_one_is_kept(undisturbed: tuple[Path, str]) -> None:
    folder, _ = undisturbed
    active = folder / "rehearsal" / "unit.yaml"
    assert active.read_bytes() == (folder / "certificate.yaml").read_bytes()
    (kept,) = active.parent.glob("unit.*Z.yaml")
    assert kept.read_bytes() == (folder / "before.yaml").read_bytes()


def test_a_last_rotation_shows_the_effect_of_compensation_also_in_the_report(
    undisturbed: tuple[Path, str],
) -> None:
    folder, said = undisturbed
    (left,) = (entry["velocity_left_m_s"] for entry in journal(folder) if entry["event"] == "end")
    # Arms of 20 to 50 mm leave 50 to 150 mm/s; what is left then is tilt and bias over the turn, 2 mm/s.
    assert left["without"] > 0.03
    assert left["compensated"] < 0.1 * left["without"]
    words = said[said.index("residual velocity after half a turn") :].splitlines()[0]
    assert words in (folder / "report.html").read_text()


def test_velocity_and_h_of_every_sample_of_every_run_are_logged_once(undisturbed: tuple[Path, str]) -> None:
    folder, _ = undisturbed
    accepted = [entry for entry in journal(folder) if entry["event"] == "accepted"]
    assert [entry["step_id"] for entry in accepted] == [*STEPS, "verification"]
    newest = -1
    for entry in accepted[:3]:
        with np.load(folder / entry["recording"].replace(".mcap", ".npz")) as log:
            counter = log["counter"]
            assert (np.diff(counter) == 1).all()
            assert counter[0] > newest
            assert counter[-1] == entry["last_counter"]
            assert log["v_n"].shape == (len(counter), 3)
            assert log["H"].shape == (len(counter), 3, 9)
            assert (np.abs(log["H"][-1, :2]) > 1e-3).any()
        newest = int(counter[-1])


def test_the_result_is_recomputed_and_a_flipped_bit_in_a_recording_is_reported(
    undisturbed: tuple[Path, str],
) -> None:
    folder, _ = undisturbed
    verified = verify(folder)
    assert verified.faults == ()
    assert "the recordings give the certificate, digit for digit" in verified.notes
    recording = folder / "run-x-up-1.mcap"
    data = recording.read_bytes()
    damaged = bytearray(data)
    damaged[len(data) // 2] ^= 16
    recording.write_bytes(damaged)
    (fault,) = verify(folder).faults
    recording.write_bytes(data)
    assert fault.startswith(f"{recording}: was damaged or changed")


def test_sessions_are_identified_again_by_dask_workers_of_which_one_dies_with_the_same_bits(
    undisturbed: tuple[Path, str], tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed")
    for name in ("a", "b", "c"):
        shutil.copytree(undisturbed[0], tmp_path / name)
    folders = sessions([tmp_path])
    serial = reidentify(folders[0])
    assert (serial.fault, serial.shift_mm) == ("", 0.0)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL
    ) as cluster:
        spread = reidentify_all(folders, scheduler=cluster.scheduler_address)
        done = [next(spread)]
        with distributed.Client(cluster) as client:
            tasks = client.processing()
            busy = max(tasks, key=lambda worker: len(tasks[worker]))
            os.kill(client.run(os.getpid, workers=[busy])[busy], signal.SIGKILL)
        done += spread
    assert [one.folder for one in done] == folders
    assert {one.r_mm for one in done} == {serial.r_mm}


def test_session_and_certificate_are_signed_with_the_key_of_the_bench(
    undisturbed: tuple[Path, str], key: BenchKey
) -> None:
    folder, _ = undisturbed
    signed = [folder / "journal.jsonl", folder / "certificate.yaml"]
    shown = fingerprint(key.public_key)
    for trusted in (None, {key.public_key: "bench 3"}):
        verified = verify(folder, trusted)
        assert [f"{path}: signed by bench 3 ({shown})" for path in signed] == list(verified.notes[-2:])
        assert (verified.faults, verified.unfinished, verified.untrusted) == ((), (), ())
    verified = verify(folder, {"another": "bench 4"})
    assert verified.faults == ()
    assert list(verified.untrusted) == [
        f"{path}: expected the signature of a trusted key, it is signed by an unknown key ({shown})"
        for path in signed
    ]


def test_an_unsigned_session_detects_accidents_not_forgery(
    undisturbed: tuple[Path, str], tmp_path: Path, key: BenchKey
) -> None:
    forged = copied(undisturbed[0], tmp_path)
    rewrite(forged, lambda entry: entry.get("event") == "plan" and entry.update(port="/dev/forged"))
    verified = verify(forged)
    assert verified.faults == ()
    assert f"{forged / JOURNAL}: unsigned" in verified.notes
    (reason,) = verify(forged, {key.public_key: "bench 3"}).untrusted
    assert reason == f"{forged / JOURNAL}: expected the signature of a trusted key, it is unsigned"


def copied(folder: Path, beside: Path) -> Path:
    """A session with the same files, to forge."""
    forged = beside / "forged"
    forged.mkdir()
    for path in folder.iterdir():
        if path.is_file():
            (forged / path.name).hardlink_to(path)
    return forged


def test_a_forged_certificate_is_named_even_if_every_hash_fits(
    undisturbed: tuple[Path, str], tmp_path: Path
) -> None:
    folder, _ = undisturbed
    forged = copied(folder, tmp_path)
    certificate = (folder / "certificate.yaml").read_text()
    r_x = f"{size_effect(folder).r_mm.x[0]}"
    (forged / "certificate.yaml").unlink()
    unsigned = certificate[: certificate.index("signature:")]
    (forged / "certificate.yaml").write_text(unsigned.replace(r_x, f"{r_x}1", 1))
    rewrite(forged, lambda entry: None)
    (fault,) = verify(forged).faults
    assert fault.startswith(f"{forged / 'certificate.yaml'}: differs from the result of the recordings")


def rewrite(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Forge a journal: change its entries, and give every file the hash that it has now."""
    entries = journal(folder)
    (folder / JOURNAL).unlink()
    for entry in entries:
        for key in ("before", "sha256"):
            entry.pop(key)
        if entry["event"] == "file":
            entry["sha256_of_file"] = sha256(folder / entry["name"])
        change(entry)
        typed = from_json(entry)
        if isinstance(typed, Signed):
            continue  # nobody without the key can make it
        if isinstance(typed, Plan):
            begin(folder / JOURNAL, typed)
            forger = Journal(folder / JOURNAL)
        else:
            forger.append(typed)
    forger.close()


def test_only_the_step_with_a_gap_in_its_recording_is_done_again(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "holed"
    process = start(folder, program=INTERRUPTED_AFTER_Y_UP)
    out, err = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 130, out + err
    assert accepted_in(folder) == STEPS
    # A session of the first version: it began to record x-up when half of the alignment was over.
    path = folder / "run-x-up-1.mcap"
    arrivals = list(Recording(path).arrivals())
    origin, profile = Recording(path).origin, Recording(path).profile_text.encode()
    path.unlink()
    late = Recorder(
        path,
        layout=Recording(folder / "run-z-up-1.mcap").profile.layout(),
        profile=profile,
        calibration=None,
        source=Source.SIMULATOR,
        port="",
        unit=origin["unit"],
    )
    for arrival in arrivals[len(arrivals) // 3 :]:
        late.arrived(arrival.block)
    late.close()
    rewrite(folder, lambda entry: entry.pop("samples", None))

    (fault,) = verify(folder).faults
    assert "run-x-up-1.mcap: step x-up: its recording does not cover counters" in fault
    assert f"calib run --session {folder} --redo x-up" in fault
    process = start(folder)
    _, err = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 2
    assert f"calib run --session {folder} --redo x-up" in err

    ended(start(folder, "x-up"))
    asked = [(e["step_id"], e["attempt"]) for e in journal(folder) if e.get("phase") == "place"]
    assert asked == [("z-up", 1), ("x-up", 1), ("y-up", 1), ("x-up", 2), ("verification", 1)]
    assert verify(folder).faults == ()
    assert "run-x-up-1.mcap" in [entry.get("name") for entry in journal(folder)]
    check_true(folder)


def accepted_in(folder: Path) -> list[str]:
    return [entry["step_id"] for entry in journal(folder) if entry["event"] == "accepted"]


def test_only_steps_of_an_existing_session_can_be_done_again(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--redo: expected an existing session, with --session, got none"):
        run(RunOptions(tmp_path / "new", rehearse=True, redo=("z-up",)), Console())


def test_a_counter_that_wrapped_before_the_recording_makes_no_difference(
    undisturbed: tuple[Path, str],
) -> None:
    folder, _ = undisturbed
    procedure = load(str(folder.parent / "short.yaml"))
    accepted = {entry["step_id"]: entry for entry in journal(folder) if entry["event"] == "accepted"}
    before = read_calibration(folder / "before.yaml")
    certificates = [
        identify(
            procedure,
            [
                Attempt(
                    step,
                    folder / accepted[step.id]["recording"],
                    accepted[step.id]["first_counter"] + rounds * 2**32,
                    accepted[step.id]["last_counter"] + rounds * 2**32,
                )
                for step in procedure.steps
            ],
            PriorCalibration(before, "unit.yaml", ""),
            BENCH,
        ).certificate
        for rounds in (0, 3)
    ]
    assert certificates[0].size_effect == certificates[1].size_effect == size_effect(folder)


def test_a_session_killed_and_stopped_at_random_moments_is_resumed_with_the_same_result(
    undisturbed: tuple[Path, str], tmp_path: Path
) -> None:
    whole, _ = undisturbed
    folder = tmp_path / "killed"
    lines = len(journal(whole))
    moments = sorted(random.Random(7).sample(range(6, lines), 3))
    for number, moment in zip((signal.SIGINT, signal.SIGKILL, signal.SIGKILL), moments, strict=True):
        process = start(folder)
        until(process, lambda moment=moment: len(journal(folder)) >= moment)  # type: ignore[misc]
        process.send_signal(number)
        out, err = process.communicate(timeout=DEADLINE_S)
        if number is signal.SIGINT:
            assert process.returncode == 130, out + err
            assert f"resume with: calib run --session {folder}" in out
    ended(start(folder))
    check_resumed(folder)
    check_true(folder)
    # Motion and noise differ between the two sessions: two results of equal sigma differ by less than three
    # sigma of their difference.
    found = size_effect(folder)
    assert (np.abs(found.r_m - size_effect(whole).r_m) < 3.0 * 2.0**0.5 * sigma(found)).all()


def test_a_session_killed_between_two_turns_repeats_only_that_run(tmp_path: Path) -> None:
    folder = tmp_path / "killed"
    process = start(folder, procedure=TURNS)
    until(process, lambda: any(e["event"] == "turned" and e["step_id"] == "x-up" for e in journal(folder)))
    process.kill()
    process.communicate(timeout=DEADLINE_S)
    with closing(Session.open(folder)) as session:
        assert set(session.accepted) == {"z-up"}

    said = ended(start(folder, procedure=TURNS))

    accepted = {e["step_id"]: e for e in journal(folder) if e["event"] == "accepted"}
    assert {name: (e["attempt"], e["turns"]) for name, e in accepted.items()} == {
        "z-up": (1, 4),
        "x-up": (2, 4),
        "y-up": (1, 4),
        "verification": (1, 1),
    }
    assert re.search("step 3 of 3: Y up, turn [2-4] of 4", said)  # in fast time the screen passes over some
    check_true(folder)
    assert verify(folder).faults == ()
    labels = read_calibration(folder / "certificate.yaml").provenance
    assert "y-up" in json.dumps(labels)


def test_one_run_of_several_turns_can_be_done_again(tmp_path: Path) -> None:
    folder = tmp_path / "redone"
    process = start(folder, procedure=TURNS, program=INTERRUPTED_AFTER_Y_UP)
    process.communicate(timeout=DEADLINE_S)
    ended(start(folder, "x-up", procedure=TURNS))

    attempts = [(e["step_id"], e["attempt"]) for e in journal(folder) if e["event"] == "accepted"]
    assert attempts[-2:] == [("x-up", 2), ("verification", 1)]
    check_true(folder)


def test_ctrl_c_is_not_lost_while_compiled_code_is_loaded(tmp_path: Path) -> None:
    process = start(tmp_path / "session", program=INTERRUPTED_LOADING)
    out, err = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 130, out + err
    assert f"resume with: calib run --session {tmp_path / 'session'}" in out


def sigma(found: SizeEffect) -> np.ndarray:
    assert found.covariance_m2 is not None
    return np.sqrt(np.diag(found.covariance_m2)).reshape(3, 3)


def check_true(folder: Path) -> None:
    """The result agrees with the truth within its own sigma and within the requirement."""
    unit = true_calibration(SEED)
    assert unit.size_effect is not None
    found = size_effect(folder)
    error = found.r_m - unit.size_effect.r_m
    assert np.sqrt(np.mean(error**2)) < 0.05e-3
    assert (np.abs(error) < 3.0 * sigma(found)).all()


def check_resumed(folder: Path) -> None:
    """No accepted step was repeated, no sample logged twice, all recordings are complete, all is signed."""
    done: list[str] = []
    logged: set[str] = set()
    for entry in journal(folder):
        if entry["event"] == "accepted":
            done.append(entry["step_id"])
            assert entry["recording"] not in logged
            logged.add(entry["recording"])
        elif entry["event"] == "entered" and entry["phase"] in ("place", "align", "rotate"):
            assert entry["step_id"] not in done
    assert done == [*STEPS, "verification"]
    key = bench_key()
    assert key is not None
    verified = verify(folder, {key.public_key: key.name})
    assert (verified.faults, verified.unfinished, verified.untrusted) == ((), (), ())


def test_a_complete_session_is_not_resumed(undisturbed: tuple[Path, str]) -> None:
    folder, _ = undisturbed
    with pytest.raises(InputError, match=r"the session is over, see report.html in it"):
        run(RunOptions(folder, rehearse=True), Console())


def test_keys_need_a_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open(os.devnull) as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        with pytest.raises(InputError, match="expected a terminal for the operator's keys"):
            run(RunOptions(tmp_path / "new"), Console())


def test_a_rehearsal_with_a_port_is_refused_and_so_is_rehearsing_the_session_of_a_unit(
    tmp_path: Path,
) -> None:
    with pytest.raises(InputError, match="--rehearse: expected no --port"):
        run(RunOptions(tmp_path / "new", rehearse=True, port="/dev/ttyUSB0"), Console())
    (tmp_path / JOURNAL).touch()
    with pytest.raises(InputError, match="expected a rehearsal to resume"):
        run(RunOptions(tmp_path, rehearse=True), Console())


def test_a_recording_that_changes_while_it_is_read_is_refused(
    undisturbed: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(undisturbed[0], copy)

    def change_and_hash(path: Path) -> str:
        with path.open("ab") as recording:
            recording.write(b"more")
        return sha256(path)

    monkeypatch.setattr(atomic, "sha256", change_and_hash)
    session = Session.open(copy)
    with closing(session), pytest.raises(InputError, match=r"z-up.*mcap: .* changed while it was read"):
        identify_session(session)


def test_the_plan_contains_the_site_and_procedure_that_were_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    procedure, site, unit = (tmp_path / f"{name}.yaml" for name in ("procedure", "site", "unit"))
    procedure.write_text(PROCEDURE)
    site.write_text("{latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}\n")
    write_calibration(unit, NOMINAL)
    texts = procedure.read_text(), site.read_text()

    def judge(*arguments: object) -> object:
        site.write_text(texts[1].replace("28.2", "-28.2"))
        procedure.write_text(PROCEDURE.replace("rest_s: 8", "rest_s: 9"))
        return predicted(*arguments)

    class CreatedError(Exception):
        """Far enough."""

    def create(folder: Path, **about: Any) -> None:
        raise CreatedError(about["procedure"].text, about["site"].text)

    monkeypatch.setattr("calib.procedure.plan.predicted", judge)
    monkeypatch.setattr(Session, "create", create)
    options = RunOptions(
        tmp_path / "new",
        port="/dev/ttyUSB0",
        profile="imu50-rs422",
        calibration=unit,
        site=site,
        procedure=str(procedure),
        hands_free=True,
    )
    with pytest.raises(CreatedError) as created:
        run(options, Console())
    assert created.value.args == texts


def test_a_plan_is_shown_without_a_unit_and_makes_no_session(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, site = tmp_path / "new", tmp_path / "site.yaml"
    site.write_text("{latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}\n")

    assert run(RunOptions(folder, site=site, procedure="ten-turns", plan=True), Console(width=200)) == 0

    assert "ten-turns: 30 rotations, about 9 min" in capsys.readouterr().out
    assert not folder.exists()
    with pytest.raises(InputError, match="--plan: expected --site, for the latitude, or --rehearse"):
        run(RunOptions(folder, procedure="ten-turns", plan=True), Console())


def test_a_new_session_needs_port_profile_calibration_and_site(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected --port, --profile, --calibration and --site"):
        run(RunOptions(tmp_path / "new", hands_free=True), Console())
