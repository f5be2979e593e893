"""Address of this machine itself, where servers listen by default."""

from typing import Final

LOOPBACK: Final = "127.0.0.1"
