"""Certificates with a signature.

The signature is the last line of the file::

    signature: {public_key: BASE64, ed25519: BASE64}

It signs all bytes before that line.
"""

from calib.signing.keys import BenchKey
from calib.signing.signatures import fingerprint, is_valid, sign
from imudrv.calibration import Calibration, Signature
from imudrv.files.settings_file import SettingsFile, to_bytes


def content(calibration: Calibration, key: BenchKey | None) -> bytes:
    """Return the content of a certificate's file.

    Parameters
    ----------
    calibration : Calibration
        The certificate; a signature that it was read with is dropped.
    key : BenchKey or None
        Signs it; None: unsigned.

    Returns
    -------
    bytes
    """
    data = to_bytes(calibration)
    return data if key is None else data + _line(sign(data, key.private_key))


def signature_fault(file: SettingsFile[Calibration], name: str) -> str:
    """Describe why the signature of a certificate is wrong.

    Parameters
    ----------
    file : SettingsFile of Calibration
        The certificate, as it was read.
    name : str
        Its name in messages.

    Returns
    -------
    str
        Empty if it is right, or if there is none.

    Raises
    ------
    InputError
        The package cryptography is not installed.
    """
    signature = file.model.signature
    if signature is None:
        return ""
    line = _line(signature)
    if not file.content.endswith(line):
        expected = "it in the last line, as it was written, got it elsewhere or in another form"
    elif not is_valid(signature, data := file.content.removesuffix(line)):
        key = fingerprint(signature.public_key)
        expected = f"that of the {len(data)} bytes before it by the key {key}, got one that does not match"
    else:
        return ""
    return f"{name}: signature: expected {expected}; the file was changed after it was signed"


def _line(signature: Signature) -> bytes:
    text = f"signature: {{public_key: {signature.public_key}, ed25519: {signature.ed25519}}}\n"
    return text.encode()
