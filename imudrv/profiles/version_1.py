"""Profiles of version 1 in the words of version 2: pulses only, one check a message."""

from collections.abc import Mapping
from typing import Any


def upgraded(document: Any) -> Any:
    """Return a document of version 1 as one of version 2, anything else as it is.

    What is wrong in it stays wrong, in its place: the schema reports it.

    Parameters
    ----------
    document : object
        Contents of a profile file.

    Returns
    -------
    object
    """
    if not isinstance(document, Mapping) or type(document.get("version")) is not int:
        return document
    if document["version"] != 1:
        return document
    new = {key: value for key, value in document.items() if key != "counts"} | {"version": 2}
    if "counts" in document:
        sensor = {"values": document["counts"], "unit": "pulse"}
        new |= {"gyro": sensor, "accelerometer": sensor}
    if isinstance(document.get("messages"), list):
        new["messages"] = [_message(message) for message in document["messages"]]
    return new


def _message(message: Any) -> Any:
    if not isinstance(message, Mapping) or "check" not in message:
        return message
    check = message["check"]
    new = {key: value for key, value in message.items() if key != "check"}
    if check is None:
        return new
    if isinstance(check, Mapping) and {"first", "last"} <= check.keys():
        kept = {key: value for key, value in check.items() if key not in ("first", "last")}
        check = kept | {"covers": [[check["first"], check["last"]]]}
    return new | {"checks": [check]}
