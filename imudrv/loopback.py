"""Address of this machine itself, where servers listen unless told otherwise."""

from typing import Final

LOOPBACK: Final = "127.0.0.1"
