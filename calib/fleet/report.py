"""Answers from the index of a fleet, as text, plot and table."""

import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from calib.fleet.changes import Change, Measurement, find_changes, unchanged
from calib.fleet.index import ARMS, measurements
from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write
from imudrv.files.tables import table
from imudrv.wording import counted

_SHORT: Final = [name.removeprefix("arms.").replace("_mm", "").replace("_minus_", "-") for name in ARMS]
_UNLIKELY: Final = 0.001
"""Probability below which chance does not explain a chi-square."""


class Answer(NamedTuple):
    """Text, and whether nothing has changed."""

    text: str
    is_good: bool


def drift(database: sqlite3.Connection, unit: str) -> Answer:
    """Return the results of a unit over time, and whether it has changed.

    Raises
    ------
    InputError
        There is no result of the unit.
    """
    fleet = measurements(database)
    own = [m for m in fleet if m.unit == unit]
    if not own:
        units = ", ".join(sorted({m.unit for m in fleet})) or "none"
        raise InputError(f"--unit: expected a unit of the index, {units}, got {unit!r}")
    chi_square, freedom, p = unchanged(own)
    lines = [
        f"unit {unit}: {counted(len(own), 'result')}; lever arms, mm, with 1 sigma",
        _row("date", "bench", _SHORT),
    ]
    for m in own:
        sigma = np.sqrt(np.diag(m.covariance))
        cells = [f"{value:+.3f} ± {s:.3f}" for value, s in zip(m.value, sigma, strict=True)]
        lines.append(_row(_date(m.t_days), m.bench, cells))
    lines.append(f"nothing has changed: {_tested(chi_square, freedom)}, p {p:.2g}")
    changes = find_changes(fleet)
    drifts = [change for change in changes if (change.kind, change.name) == ("unit", unit)]
    lines += [f"drift, mm a month: {_values(change)}" for change in drifts]
    benches = {m.bench for m in own}
    lines += [_off(change) for change in changes if change.kind == "bench" and change.name in benches]
    lines += _sensors(database, unit)
    return Answer("\n".join(lines), not drifts and p > _UNLIKELY)


def benches(database: sqlite3.Connection) -> Answer:
    """Return whether a bench is off, by the units that were on several of them."""
    fleet = measurements(database)
    found = find_changes(fleet)
    off = {change.name: change for change in found if change.kind == "bench"}
    lines = [f"{_results(fleet)}; lever arms, mm, with 1 sigma"]
    for name in sorted({m.bench for m in fleet}):
        own = [m for m in fleet if m.bench == name]
        agrees = f"{_bench(name)}: agrees with the others, {_results(own)}"
        lines.append(_off(off[name]) if name in off else agrees)
    lines += [
        f"unit {change.name} drifts, mm a month: {_values(change)}"
        for change in found
        if change.kind == "unit"
    ]
    return Answer("\n".join(lines), not off)


def plot(database: sqlite3.Connection, unit: str, path: Path) -> None:
    """Plot the lever arms of a unit over time, less their mean.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    from matplotlib.figure import Figure

    own = [m for m in measurements(database) if m.unit == unit]
    dates = np.array([m.t_days for m in own]).astype("datetime64[D]")
    values = np.array([m.value for m in own])
    sigma = np.sqrt([np.diag(m.covariance) for m in own])
    figure = Figure(figsize=(9, 7), layout="constrained")
    rows = figure.subplots(len(ARMS), 1, sharex=True)
    for axes, name, column, error in zip(rows, _SHORT, values.T, sigma.T, strict=True):
        axes.errorbar(dates, column - column.mean(), error, fmt="o", ms=3, capsize=2)
        axes.set_ylabel(f"{name}\nmm")
        axes.grid(alpha=0.3)
    rows[0].set_title(f"Unit {unit}: lever arms less their mean, 1 sigma")
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=120)


def export(database: sqlite3.Connection, path: Path, kind: str) -> None:
    """Write all quantities of all sessions that count, one a row.

    Raises
    ------
    InputError
        The file cannot be written, or has another suffix.
    """
    names = ("folder", "unit", "bench", "operator", "host", "software", "created", "name", "value", "sigma")
    rows = database.execute(
        f"SELECT {', '.join(names)} FROM session JOIN quantity USING (folder) "
        "WHERE fault = '' ORDER BY created, folder, name"
    ).fetchall()
    columns: dict[str, Any] = {}
    for name, column in zip(names, zip(*rows, strict=True) if rows else ((),) * len(names), strict=True):
        columns[name] = np.array(column, np.float64 if name in ("value", "sigma") else np.str_)
    with table(path, (f".{kind}",), {}) as written:
        written.write(columns)


def _sensors(database: sqlite3.Connection, unit: str) -> list[str]:
    """Return the numbers of the sensors that differ between the certificates of a unit."""
    lines = []
    rows = database.execute(
        "SELECT name, value, sigma, created FROM session JOIN quantity USING (folder) "
        "WHERE fault = '' AND unit = ? AND name NOT LIKE 'arms.%' ORDER BY name, created",
        (unit,),
    ).fetchall()
    for name in dict.fromkeys(row[0] for row in rows):
        own = [row for row in rows if row[0] == name]
        distinct = [
            row for row, before in zip(own, [None, *own], strict=False) if not before or before[1] != row[1]
        ]
        if len(distinct) > 1:
            values = ", ".join(
                f"{created[:10]} {value:g}" + ("" if sigma is None else f" ± {sigma:.2g}")
                for _, value, sigma, created in distinct
            )
            lines.append(f"{name}: {values}{_chi_square(distinct)}")
    return lines


def _results(measurements: Sequence[Measurement]) -> str:
    """Return how many results of how many units there are."""
    units = len({m.unit for m in measurements})
    return f"{counted(len(measurements), 'result')} of {counted(units, 'unit')}"


def _chi_square(rows: Sequence[tuple[str, float, float | None, str]]) -> str:
    known = [(value, sigma) for _, value, sigma, _ in rows if sigma]
    if len(known) < len(rows):
        return ""
    value, sigma = np.array(known).T
    mean = np.average(value, weights=sigma**-2)
    return f"; {_tested(np.sum(((value - mean) / sigma) ** 2), len(rows) - 1)}"


def _tested(chi_square: float, freedom: int) -> str:
    return f"chi-square {chi_square:.1f}, {counted(freedom, 'degree')} of freedom"


def _row(date: str, bench: str, cells: Sequence[str]) -> str:
    return f"{date:10}  {bench or '-':16}" + "".join(f"{cell:>18}" for cell in cells)


def _date(t_days: float) -> str:
    return str(np.datetime64(int(t_days), "D"))


def _bench(name: str) -> str:
    return name or "bench without a name"


def _off(change: Change) -> str:
    return f"{_bench(change.name)}: is off, p {change.p:.2g}: {_values(change)}"


def _values(change: Change) -> str:
    return ", ".join(
        f"{name} {value:+.3f} ± {sigma:.3f}"
        for name, value, sigma in zip(_SHORT, change.value, change.sigma, strict=True)
    )
