"""Many sessions: what has changed is found, what has not raises no alarm; the index is that of the files."""

import platform
import sqlite3
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from bench_session import begin

from calib.bench.session import Session
from calib.bench.state import RESULT
from calib.cli import main
from calib.fleet.changes import MONTH_DAYS, Measurement, find_changes, unchanged
from calib.fleet.index import update
from imudrv.errors import InputError
from tools.fleet import fleet, write_session


def test_a_bench_that_is_off_and_a_unit_that_drifts_are_found_and_nothing_else() -> None:
    found = find_changes(fleet(1, off_mm=0.05, drift_mm=0.02))
    assert {(change.kind, change.name) for change in found} == {("bench", "bench 4"), ("unit", "50-0007")}
    for change in found:
        expected = np.zeros(6)
        expected[1 if change.kind == "bench" else 4] = 0.05 if change.kind == "bench" else 0.02
        # 4 sigma: one of twelve numbers is outside in one run of a thousand.
        assert (np.abs(change.value - expected) < 4 * change.sigma).all()
        assert change.sigma.max() < 0.05 / 4


@pytest.mark.parametrize("seed", range(4))
def test_a_fleet_in_which_nothing_changes_raises_no_alarm(seed: int) -> None:
    """One fleet of a hundred does, by the probability that was asked for; none of these four."""
    assert find_changes(fleet(seed, 80, 10)) == ()


def test_chi_square_of_an_unchanged_unit_is_that_of_its_degrees_of_freedom() -> None:
    measurements = [m for m in fleet(3, 600) if m.unit == "50-0002"]
    chi_square, freedom, p = unchanged(measurements)
    assert freedom == 6 * (len(measurements) - 1)
    assert abs(chi_square - freedom) < 4 * np.sqrt(2 * freedom)
    assert p > 1e-4
    moved = [m._replace(value=m.value + 0.1 * (m.t_days > 365)) for m in measurements]
    assert unchanged(moved)[2] < 1e-9


def test_a_bench_whose_units_were_on_no_other_one_cannot_be_judged() -> None:
    own = [m for m in fleet(2, units=10) if (m.unit in ("50-0001", "50-0002")) == (m.bench == "bench 1")]
    own = [m._replace(value=m.value + (m.bench == "bench 1")) for m in own]
    assert find_changes(own) == ()


ARMS_MM = np.array([47.0, -40.0, -2.0, 25.0, 7.0, -25.0])


def session(folder: Path, unit: str, bench: str, days: float, shift_mm: float = 0.0) -> Path:
    """A complete session with a result, without recordings."""
    value = ARMS_MM + np.array([shift_mm, 0.0, 0.0, shift_mm, 0.0, 0.0])
    write_session(folder, Measurement(unit, bench, days, value, (np.eye(6) + 1.0) * 0.01**2))
    return folder


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty sessions: bench c is off by 0.5 mm, and unit 3 drifts by 0.1 mm a month."""
    tree = tmp_path_factory.mktemp("fleet") / "sessions"
    for n in range(20):
        unit, bench, days = n % 4, "abc"[n % 3], 20 * n
        shift = 0.5 * (bench == "c") + 0.1 * (unit == 3) * days / MONTH_DAYS
        session(tree / f"y{n % 2}" / f"s{n}", f"50-{unit:04}", f"bench {bench}", days, shift)
    return tree


def rows(index: Path) -> list[tuple[object, ...]]:
    with sqlite3.connect(index) as database:
        return [
            row
            for table in ("session", "quantity")
            for row in database.execute(f"SELECT * FROM {table} ORDER BY 1, 2, 3").fetchall()
        ]


def calib(arguments: Sequence[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    code = main([*arguments])
    return code, capsys.readouterr().out


def test_the_index_finds_the_bench_and_the_unit(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert calib(["fleet", "index", str(tree)], capsys) == (
        0,
        "fleet.sqlite: 20 read, 0 unchanged, 0 removed\n",
    )
    code, text = calib(["fleet", "benches"], capsys)
    assert code == 3
    assert "bench c: is off, p" in text
    assert "x-y.x +0.5" in text
    assert "bench a: agrees with the others" in text
    assert "unit 50-0003 drifts" in text
    code, text = calib(["fleet", "drift", "--unit", "50-0003", "--plot", "arms.png"], capsys)
    assert code == 3
    assert "drift, mm a month: x-y.x +0.10" in text
    assert (tmp_path / "arms.png").read_bytes().startswith(b"\x89PNG")
    assert "is off" in calib(["fleet", "drift", "--unit", "50-0001"], capsys)[1]


def test_an_index_that_was_brought_up_to_date_equals_one_made_from_nothing(
    tree: Path, tmp_path: Path
) -> None:
    copy, index = tmp_path / "sessions", tmp_path / "fleet.sqlite"
    for name in ("s0", "s2", "s4"):
        (copy / name).mkdir(parents=True)
        for file in (tree / "y0" / name).iterdir():
            (copy / name / file.name).write_bytes(file.read_bytes())
    assert update(copy, index)[:3] == (3, 0, 0)
    assert update(copy, index)[:3] == (0, 3, 0)
    session(copy / "later", "50-0009", "bench a", 900)
    (copy / "s2").rename(tmp_path / "elsewhere")
    assert update(copy, index)[:3] == (1, 2, 1)
    update(copy, tmp_path / "new.sqlite")
    assert rows(index) == rows(tmp_path / "new.sqlite")


def test_a_session_whose_certificate_was_changed_is_named_and_not_used(
    tree: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = session(tmp_path / "sessions" / "s", "50-0001", "bench a", 0)
    (folder / RESULT).write_text((folder / RESULT).read_text() + "# changed\n")
    arguments = ["fleet", "index", str(tmp_path / "sessions"), "--index", str(tmp_path / "i.sqlite")]
    code, text = calib(arguments, capsys)
    assert code == 2
    assert "not used: s: s/certificate.yaml: was damaged or changed" in text


def test_a_session_without_a_result_is_not_used(tmp_path: Path) -> None:
    (tmp_path / "sessions").mkdir()
    begin(tmp_path / "sessions" / "s").close()
    assert update(tmp_path / "sessions", tmp_path / "i.sqlite").faults == ("s: no accepted result",)


def test_the_export_has_every_quantity_of_every_session(
    tree: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    index, out = str(tmp_path / "i.sqlite"), str(tmp_path / "fleet.parquet")
    calib(["fleet", "index", str(tree), "--index", index], capsys)
    assert calib(["fleet", "export", "--to", "parquet", "-o", out, "--index", index], capsys)[0] == 0
    table = parquet.read_table(out).to_pylist()
    assert len(table) == len([row for row in rows(Path(index)) if len(row) == 4])
    assert {row["operator"] for row in table} == {"Li"}
    shifts = {row["bench"] for row in table if row["name"] == "arms.x_minus_y_mm.x" and row["value"] > 47.4}
    assert "bench c" in shifts


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["drift", "--unit", "50-0001"], "expected an index, there is none; make it: calib fleet index TREE"),
        (["index", "nowhere"], "nowhere: expected a folder with sessions, there is none"),
    ],
)
def test_what_is_missing_is_said(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    expected: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["fleet", *arguments]) == 2
    assert expected in capsys.readouterr().err


def test_another_file_is_no_index(tmp_path: Path) -> None:
    (tmp_path / "other").write_text("text" * 1000)
    with pytest.raises(InputError, match="other: expected an index that can be read and written"):
        update(tmp_path, tmp_path / "other")


def test_a_session_records_who_made_it(tmp_path: Path) -> None:
    begin(tmp_path / "s", bench="bench 3", operator="Li").close()
    made = Session.open(tmp_path / "s")
    made.close()
    assert (made.bench().bench, made.plan.operator) == ("bench 3", "Li")
    assert made.plan.host == platform.node()
