"""The YAML edge: every settings file of ours comes in and goes out here, checked whole.

A file is plain data: mappings, lists, text, numbers, true/false, null. Unquoted values follow the core schema
of YAML 1.2: ``1e-6`` is a number; ``0017``, ``1:30``, ``yes`` and a date are text. Anchors, aliases, tags and
keys given twice are refused.
"""

import hashlib
import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Generic

import yaml
from pydantic import ValidationError

from imudrv.errors import FaultyFileError, InputError
from imudrv.files.atomic import MAX_BYTES, backup_name, content, reported_errors, write_whole
from imudrv.files.faults import bounded, header_faults, shown_value, validation_faults
from imudrv.files.model import M, Model
from imudrv.files.outputs import file_to_write
from imudrv.files.yaml_text import (
    FLOAT,
    Dumper,
    load_yaml,
    represent_sequence,
    represent_text,
    represent_time,
)


@dataclass(frozen=True)
class SettingsFile(Generic[M]):
    """A settings file as one read found it; whatever happens to the file, the three agree.

    Attributes
    ----------
    content : bytes
        The file as it is.
    sha256 : str
        SHA-256 of the content, 64 hexadecimal digits.
    model : Model
        The content, checked.
    """

    content: bytes
    sha256: str
    model: M


def read_file(path: str | os.PathLike[str], model: type[M]) -> SettingsFile[M]:
    """Read and check a settings file, and keep its content; see `read`.

    Parameters
    ----------
    path : path-like
        The file.
    model : subclass of Model
        What it should be.

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
        What it should be.

    Returns
    -------
    Model

    Raises
    ------
    InputError
        The file cannot be read.
    FaultyFileError
        It is no YAML, or not what the model says; all faults at once.
    """
    return read_file(path, model).model


def parse_text(text: bytes, model: type[M], name: str) -> M:
    """Read and check settings that are in memory already; see `read`.

    Parameters
    ----------
    text : bytes
        YAML, UTF-8.
    model : subclass of Model
        What it should be.
    name : str
        What messages call it.

    Returns
    -------
    Model
    """
    return parse(load_yaml(text, name), model, name)


def parse(document: object, model: type[M], name: str) -> M:
    """Check data that is loaded already.

    Parameters
    ----------
    document : object
        Mappings, lists, text, numbers, dates.
    model : subclass of Model
        What it should be. A wrong `format` or `version` is told alone: the rest is then another file's.
    name : str
        What messages call it.

    Returns
    -------
    Model

    Raises
    ------
    FaultyFileError
        It is not what the model says; all faults at once.
    """
    if faults := list(header_faults(document, model)):
        raise FaultyFileError(name, faults)
    try:
        # As JSON, because strict then takes a list for a tuple and text for a date, yet no text for a number.
        return model.model_validate_json(json.dumps(document, default=datetime.isoformat))
    except ValidationError as error:
        raise FaultyFileError(name, bounded(validation_faults(error, document, model))) from None


def kind(path: str | os.PathLike[str]) -> str:
    """Tell what a settings file is: the value of its `format`; a site file may lack it.

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
        The file cannot be read, is no YAML, or does not say what it is.
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
    """Write a settings file so that at every moment the old or the new one is there, whole.

    The file that was there is kept beside it under its name and time, ``NAME.20261122T100000Z.yaml``, with
    ``.2``, ``.3`` ... behind the time where that is taken. A symbolic link is followed.

    Parameters
    ----------
    path : path-like
        The file.
    document : Model or mapping
        What it becomes: keys in the model's order, absent options left out, floats that come back exactly.

    Raises
    ------
    InputError
        It cannot be written, what is there is no settings file but too large, or see `file_to_write`.
    """
    path = Path(path)
    target = file_to_write(path)
    data = yaml.dump(
        _plain(document), Dumper=Dumper, sort_keys=False, allow_unicode=True, width=math.inf
    ).encode()
    if len(data) > MAX_BYTES:
        raise InputError(
            f"{path}: expected at most {MAX_BYTES} bytes to write, got {len(data)}; shorten the contents"
        )
    load_yaml(data, str(path))  # what is written can be read
    with reported_errors(path, "written", f"expected the folder {path.parent}, there is none; make it first"):
        if target.exists():
            write_whole(backup_name(target), content(target))
        write_whole(target, data)


Dumper.add_representer(str, represent_text)


Dumper.add_representer(list, represent_sequence)


Dumper.add_representer(datetime, represent_time)


# Text that only YAML 1.2 takes for a number (1e5) needs its quotes too.
Dumper.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(f"({FLOAT.pattern})$"), list("-+.0123456789")
)


def _plain(value: object) -> object:
    if isinstance(value, Model):
        fields = ((name, getattr(value, name)) for name in type(value).model_fields)
        return {name: _plain(field) for name, field in fields if field is not None}
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
