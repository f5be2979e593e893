"""Compiled kernels, kept in files from one run to the next.

numba's own cache ends a command at a file that a power failure has cut short, and where it cannot write. This
one never fails: a kernel that cannot be loaded is compiled; one that cannot be stored is compiled at each
start.

It is the only module that uses internals of numba: what `Dispatcher` asks of its cache, how a compiled
function becomes bytes and is one again, how the type of a call from another kernel is found, and where LLVM
makes machine code.
"""

import hashlib
import pickle
import secrets
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import current_thread, main_thread
from typing import Any, Final

import numba
from numba.core.compiler import CompileResult
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps
from numba.core.types import unliteral

from imudrv.compilation import missed_a_kernel

_to_bytes: Final[Callable[[Any], bytes]] = dumps

_unliteral: Final[Callable[[Any], Any]] = unliteral

_start_memory: Final[Callable[[Any], None]] = rtsys.initialize

_from_parts: Final[Callable[..., Any]] = CompileResult._rebuild  # noqa: SLF001

_DIGEST: Final = hashlib.sha256().digest_size

refused = False
"""Whether a kernel could not be kept."""


def keep_compiled(dispatcher: Any, folder: Path | None) -> None:
    """Keep what a function of numba is compiled to in a folder.

    Parameters
    ----------
    dispatcher : Dispatcher
        Function declared with `numba.njit`, without a cache.
    folder : Path or None
        Made when it is needed; None if there is no place for one.
    """
    dispatcher._cache = _KernelCache(dispatcher.py_func, folder)  # noqa: SLF001


def take_literals_as_variables(dispatcher: Any) -> None:
    """Compile a function once for all constants with which other ones call it.

    Parameters
    ----------
    dispatcher : Dispatcher
        Function declared with `numba.njit`.
    """
    template = dispatcher.get_call_template

    def get_call_template(args: Any, kws: Any) -> Any:
        return template([_unliteral(a) for a in args], {name: _unliteral(a) for name, a in kws.items()})

    dispatcher.get_call_template = get_call_template


def _hold_interrupts(engine: Any) -> None:
    """Let Ctrl-C wait until LLVM has made or taken over the code of a kernel.

    Meanwhile LLVM calls functions of Python that can raise nothing: the interrupt would be lost, and the code
    of the kernel with it.
    """
    if "finalize_object" in vars(engine):
        return
    finalize = engine.finalize_object

    def finalize_whole() -> None:
        raises = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if not raises or current_thread() is not main_thread():
            finalize()
            return
        caught: list[int] = []
        signal.signal(signal.SIGINT, lambda number, frame: caught.append(number))
        try:
            finalize()
        finally:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        if caught:
            raise KeyboardInterrupt

    engine.finalize_object = finalize_whole


class _KernelCache:
    """The cache of one kernel: a file for each signature, that begins with the SHA-256 of the rest."""

    def __init__(self, function: Callable[..., Any], folder: Path | None) -> None:
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._code = function.__code__.co_code
        self._folder = folder

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the compiled function; None if there is none that is whole."""
        _hold_interrupts(target.codegen()._engine)  # noqa: SLF001
        # What compiling needs besides, half a second of each start, the compiler loads itself.
        _start_memory(target)
        if self._folder is None:
            return None
        compiled = self._load(self._folder, signature, target)
        if compiled is None and missed_a_kernel(self._folder):
            compiled = self._load(self._folder, signature, target)
        return compiled

    def _load(self, folder: Path, signature: Any, target: Any) -> Any:
        with suppress(Exception):  # whatever is wrong with the file, the kernel is compiled
            data = self._file(folder, signature, target.codegen()).read_bytes()
            if hashlib.sha256(data[_DIGEST:]).digest() == data[:_DIGEST]:
                return _from_parts(target, *pickle.loads(data[_DIGEST:]))
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Store a compiled function; where that is impossible, say so once."""
        if compiled.library.has_dynamic_globals:  # addresses of this process are in its code
            return
        if self._folder is None:
            _say("there is no home folder")
            return
        payload = _to_bytes(compiled._reduce())  # noqa: SLF001
        path = self._file(self._folder, signature, compiled.library.codegen)
        beside = path.with_suffix(f".{secrets.token_hex(4)}")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            beside.write_bytes(hashlib.sha256(payload).digest() + payload)
            beside.replace(path)
        except OSError as error:
            with suppress(OSError):
                beside.unlink()
            _say(f"{self._folder}: {error.strerror or error}")

    def _file(self, folder: Path, signature: Any, codegen: Any) -> Path:
        made_for = (
            numba.__version__,
            sys.implementation.cache_tag,
            codegen.magic_tuple(),
            signature,
            self._code,
        )
        return folder / f"{self._name}-{hashlib.sha256(repr(made_for).encode()).hexdigest()[:16]}.kernel"


def _say(reason: str) -> None:
    global refused
    before, refused = refused, True
    if sys.stderr is not None and not before:
        with suppress(OSError):
            sys.stderr.write(
                f"compiled kernels cannot be kept ({reason}), so each start takes longer; "
                "set XDG_CACHE_HOME to a folder that can be written to\n"
            )
