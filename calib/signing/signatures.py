"""Ed25519 signatures of bytes, with keys and signatures in base64."""

import hashlib
from base64 import b64decode, b64encode
from types import ModuleType

from imudrv.calibration import Signature
from imudrv.errors import InputError


def new_private_key() -> str:
    """Return a new private key, base64 of 32 random bytes."""
    return _text(_ed25519().Ed25519PrivateKey.generate().private_bytes_raw())


def public_key(private_key: str) -> str:
    """Return the public key of a private key, base64."""
    key = _ed25519().Ed25519PrivateKey.from_private_bytes(b64decode(private_key))
    return _text(key.public_key().public_bytes_raw())


def sign(data: bytes, private_key: str) -> Signature:
    """Sign bytes.

    Parameters
    ----------
    data : bytes
        The message.
    private_key : str
        Base64.

    Returns
    -------
    Signature
        The same for the same message and key.
    """
    key = _ed25519().Ed25519PrivateKey.from_private_bytes(b64decode(private_key))
    return Signature(public_key=public_key(private_key), ed25519=_text(key.sign(data)))


def is_valid(signature: Signature, data: bytes) -> bool:
    """Return whether a signature is that of these bytes by its public key.

    Raises
    ------
    InputError
        The package cryptography is not installed.
    """
    ed25519 = _ed25519()
    from cryptography.exceptions import InvalidSignature

    try:
        key = ed25519.Ed25519PublicKey.from_public_bytes(b64decode(signature.public_key))
        key.verify(b64decode(signature.ed25519), data)
    except (InvalidSignature, ValueError):  # ValueError: no point of the curve
        return False
    return True


def fingerprint(public_key: str) -> str:
    """Return the fingerprint of a public key, as OpenSSH shows them: ``SHA256:`` and 43 characters."""
    return f"SHA256:{_text(hashlib.sha256(b64decode(public_key)).digest()).rstrip('=')}"


def _ed25519() -> ModuleType:
    try:
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError as error:
        raise InputError(
            "signatures: expected the package cryptography: pip install 'imu50[sign]'"
        ) from error
    return ed25519


def _text(data: bytes) -> str:
    return b64encode(data).decode()
