"""Settings files: YAML, checked against a `Model` when read, written so that a crash loses nothing."""

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import chain, count
from pathlib import Path
from typing import Generic

from pydantic import ValidationError

from imudrv.errors import FaultyFileError, InputError
from imudrv.files.atomic import MAX_BYTES, atomic_write, content
from imudrv.files.faults import bounded, header_faults, shown_value, validation_faults
from imudrv.files.model import M, Model
from imudrv.files.outputs import file_to_write
from imudrv.files.yaml_text import dump_yaml, load_yaml


@dataclass(frozen=True)
class SettingsFile(Generic[M]):
    """One reading of a settings file; content, hash and model belong together even if the file changes.

    Attributes
    ----------
    content : bytes
        The bytes of the file.
    sha256 : str
        SHA-256 of the content, 64 hexadecimal digits.
    model : Model
        The content, checked.
    """

    content: bytes
    sha256: str
    model: M


def read_file(path: str | os.PathLike[str], model: type[M]) -> SettingsFile[M]:
    """Read and check a settings file, with its content and hash; see `read`.

    Parameters
    ----------
    path : path-like
        The file.
    model : subclass of Model
        Kind of file that is expected.

    Returns
    -------
    SettingsFile
    """
    data = content(path)
    return SettingsFile(data, hashlib.sha256(data).hexdigest(), parse_text(data, model, os.fspath(path)))


def read(path: str | os.PathLike[str], model: type[M]) -> M:
    """Read and check a settings file.

    Parameters
    ----------
    path : path-like
        The file: YAML, UTF-8, at most `MAX_BYTES`.
    model : subclass of Model
        Kind of file that is expected.

    Returns
    -------
    Model

    Raises
    ------
    InputError
        The file cannot be read.
    FaultyFileError
        It is no YAML, or does not fit the model; all faults at once.
    """
    return read_file(path, model).model


def parse_text(text: bytes, model: type[M], name: str) -> M:
    """Check the text of a settings file; see `read`.

    Parameters
    ----------
    text : bytes
        YAML, UTF-8.
    model : subclass of Model
        Kind of file that is expected.
    name : str
        Name of the file in messages.

    Returns
    -------
    Model
    """
    return parse(load_yaml(text, name), model, name)


def parse(document: object, model: type[M], name: str) -> M:
    """Check the document of a settings file.

    Parameters
    ----------
    document : object
        Mappings, lists, text, numbers, dates.
    model : subclass of Model
        Kind of file that is expected. A wrong `format`, `version` or `kind` is the only fault reported: the
        rest then belongs to another kind of file.
    name : str
        Name of the file in messages.

    Returns
    -------
    Model

    Raises
    ------
    FaultyFileError
        It does not fit the model; all faults at once.
    """
    document = model.current(document)
    if faults := list(header_faults(document, model)):
        raise FaultyFileError(name, faults)
    try:
        # As JSON, because strict then takes a list for a tuple and text for a date, yet no text for a number.
        return model.model_validate_json(json.dumps(document, default=datetime.isoformat))
    except ValidationError as error:
        raise FaultyFileError(name, bounded(validation_faults(error, document, model))) from None


def kind(path: str | os.PathLike[str]) -> str:
    """Return the kind of a settings file: its `format`, which a site file may lack.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    str
        For example ``imu50-calibration``.

    Raises
    ------
    InputError
        The file cannot be read, is no YAML, or has no format.
    """
    name = os.fspath(path)
    document = load_yaml(content(path), name)
    if not isinstance(document, dict):
        raise FaultyFileError(name, [f"expected a mapping (key: value), got {shown_value(document)}"])
    if "format" not in document and "latitude_deg" in document:
        return "imu50-site"
    found = document.get("format")
    if not isinstance(found, str):
        came = shown_value(found) if "format" in document else "no such key"
        raise FaultyFileError(
            name, [f"format: expected what the file is, such as imu50-calibration, got {came}"]
        )
    return found


def write(path: str | os.PathLike[str], document: Model | Mapping[str, object]) -> None:
    """Write a settings file so that at every moment the old or the new one exists, complete.

    The previous file is kept beside it under its name and time, ``NAME.20261122T100000Z.yaml``, with ``.2``,
    ``.3`` ... after the time where that is taken. A symbolic link is followed.

    Parameters
    ----------
    path : path-like
        The file.
    document : Model or mapping
        Its new contents, see `to_bytes`.

    Raises
    ------
    InputError
        It cannot be written, the existing file is too large for a settings file, or see `file_to_write`.
    """
    replace(path, to_bytes(document))


def to_bytes(document: Model | Mapping[str, object]) -> bytes:
    """Return the content of a settings file.

    Parameters
    ----------
    document : Model or mapping
        Keys in the model's order, without absent options and fields that a model excludes; floats exact.

    Returns
    -------
    bytes
        YAML, UTF-8.
    """
    return dump_yaml(_plain(document))


def replace(path: str | os.PathLike[str], data: bytes) -> None:
    """Write the content of a settings file; see `write`.

    Parameters
    ----------
    path : path-like
        The file.
    data : bytes
        Its new content.
    """
    path = Path(path)
    target = file_to_write(path)
    if len(data) > MAX_BYTES:
        raise InputError(
            f"{path}: expected at most {MAX_BYTES} bytes to write, got {len(data)}; shorten the contents"
        )
    load_yaml(data, str(path))  # never write a file that cannot be read
    if target.exists():
        _write(_backup_name(target), content(target))
    _write(path, data)


def _write(path: Path, data: bytes) -> None:
    with atomic_write(path) as file:
        file.write(data)


def _backup_name(path: Path) -> Path:
    """Return a free name for a copy of the file, by the time of its modification."""
    time = datetime.fromtimestamp(path.stat().st_mtime, UTC)
    stem = f"{path.stem}.{time:%Y%m%dT%H%M%SZ}"
    names = chain([stem], (f"{stem}.{n}" for n in count(2)))
    return next(free for name in names if not os.path.lexists(free := path.with_name(name + path.suffix)))


def _plain(value: object) -> object:
    """Return models as mappings without absent options and excluded fields, tuples as lists."""
    if isinstance(value, Model):
        names = (name for name, field in type(value).model_fields.items() if not field.exclude)
        fields = ((name, getattr(value, name)) for name in names)
        return {name: _plain(field) for name, field in fields if field is not None}
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
