"""The key of the bench, and files of trusted public keys."""

import os
import platform
from collections import Counter
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import AfterValidator, model_validator
from pydantic import Field as Key

from calib.signing.signatures import fingerprint, new_private_key, public_key
from imudrv.calibration import Base64Of32Bytes
from imudrv.errors import FaultyFileError, InputError
from imudrv.files import settings_file
from imudrv.files.atomic import sync_folder
from imudrv.files.config_folder import config_file
from imudrv.files.model import Model, UtcTime

KEY_FILE: Final = "signing-key.yaml"
MAX_NAME: Final = 64
"""Longest name of a key, characters."""
MAX_KEYS: Final = 1000
"""Largest number of trusted keys in a file."""

_OTHERS: Final = 0o077
"""Permissions of group and others."""


def _name(text: str) -> str:
    if not text.strip() or text != text.strip() or not text.isprintable():
        raise ValueError(f"expected printable text that neither begins nor ends with a space, got {text!r}")
    return text


KeyName = Annotated[str, Key(max_length=MAX_NAME), AfterValidator(_name)]


class BenchKey(Model):
    """The private key of a bench, in a file that only its owner can read."""

    format: Literal["imu50-signing-key"]
    version: Literal[1]
    name: KeyName
    created: UtcTime
    private_key: Annotated[Base64Of32Bytes, Key(repr=False)]

    @property
    def public_key(self) -> str:
        """Its public key, base64."""
        return public_key(self.private_key)

    def __str__(self) -> str:
        """Return name and fingerprint."""
        return f"{self.name} ({fingerprint(self.public_key)})"


class TrustedKey(Model):
    """A public key and the name of its owner."""

    name: KeyName
    public_key: Base64Of32Bytes


class TrustedKeys(Model):
    """Public keys that are trusted."""

    format: Literal["imu50-trusted-keys"]
    version: Literal[1]
    keys: Annotated[tuple[TrustedKey, ...], Key(min_length=1, max_length=MAX_KEYS)]

    @model_validator(mode="after")
    def _has_each_key_once(self) -> Self:
        ((_, most),) = Counter(key.public_key for key in self.keys).most_common(1)
        if most > 1:
            raise ValueError(f"keys: expected each public key once, got one {most} times; keep one")
        return self


def key_path() -> Path | None:
    """Return the path of the bench's key, whether it exists or not; None for a user without a home."""
    return config_file(KEY_FILE)


def bench_key() -> BenchKey | None:
    """Return the key of the bench; None if there is none.

    Raises
    ------
    InputError
        The key is damaged or readable by others, or the package cryptography is not installed.
    """
    path = key_path()
    if path is None or not os.path.lexists(path):
        return None
    try:
        key = settings_file.read(path, BenchKey)
    except FaultyFileError:  # its message might show the key
        raise InputError(
            f"{path}: expected the key of calib key new, got other contents; restore it, or remove it and "
            "make a new one"
        ) from None
    if mode := path.stat().st_mode & _OTHERS:
        raise InputError(
            f"{path}: expected a key that only its owner can access, got mode {mode | 0o600:03o}; "
            f"if nobody has copied it: chmod 600 {path}"
        )
    try:
        public_key(key.private_key)
    except InputError as error:
        raise InputError(f"{path}: this bench signs what it writes: {error}") from error
    return key


def make_bench_key(name: str | None = None) -> tuple[Path, BenchKey]:
    """Make the key of the bench, which must not have one.

    Parameters
    ----------
    name : str, optional
        Name of the bench; default: the name of the computer.

    Returns
    -------
    Path
        Its file, mode 600 in a folder of mode 700.
    BenchKey

    Raises
    ------
    InputError
        There is a key, the name is invalid, the file cannot be written, or cryptography is not installed.
    """
    path = key_path()
    if path is None:
        raise InputError("calib key: expected a user with a home folder, got none; set XDG_CONFIG_HOME")
    document = {
        "format": "imu50-signing-key",
        "version": 1,
        "name": platform.node()[:MAX_NAME] or "bench" if name is None else name,
        "created": datetime.now(UTC).replace(microsecond=0),
        "private_key": new_private_key(),
    }
    key = settings_file.parse(document, BenchKey, "calib key new")
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.parent.chmod(0o700)
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), "wb") as file:
            file.write(settings_file.to_bytes(key))
            file.flush()
            os.fsync(file.fileno())
        sync_folder(path.parent)
    except FileExistsError:
        raise InputError(
            f"{path}: expected a bench without a key, got one that has it; it is kept as it is"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path, key


def public_half(key: BenchKey) -> TrustedKeys:
    """Return the public half of a key as a file of trusted keys."""
    return TrustedKeys(
        format="imu50-trusted-keys",
        version=1,
        keys=(TrustedKey(name=key.name, public_key=key.public_key),),
    )


def read_trusted(path: str | os.PathLike[str]) -> Mapping[str, str]:
    """Read trusted keys.

    Parameters
    ----------
    path : path-like
        A file of `TrustedKeys`.

    Returns
    -------
    mapping of str to str
        Names by public key, base64.

    Raises
    ------
    InputError
        The file cannot be read or has faults.
    """
    return {key.public_key: key.name for key in settings_file.read(path, TrustedKeys).keys}
