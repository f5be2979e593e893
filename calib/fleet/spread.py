"""Work spread over processes of this computer, or over a cluster, by Dask (`dask.distributed`).

The scheduler gives the work of a worker that dies to another one. The results are those of this process, to
the bit: a worker uses one thread, and what it does is given by its item alone.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, TypeVar

from imudrv.errors import InputError

Item = TypeVar("Item")
Result = TypeVar("Result")

_RETRIES: Final = 2
_CONNECT_S: Final = 10


def spread(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int = 1, scheduler: str | None = None
) -> Iterator[Result]:
    """Yield the result of each item, in their order.

    Parameters
    ----------
    function : callable
        Of one item; importable by a worker.
    items : sequence
        What can be pickled; with a scheduler, paths must be those of its workers.
    workers : int
        Processes on this computer; 1: this one, without Dask.
    scheduler : str, optional
        Address of a Dask scheduler, such as ``tcp://host:8786``, whose workers do it instead.

    Yields
    ------
    object

    Raises
    ------
    InputError
        There are less workers than 1, the package distributed is absent, the scheduler does not answer, or
        workers died again and again.
    """
    if workers < 1:
        raise InputError(f"--workers: expected at least 1, got {workers}")
    if workers == 1 and scheduler is None:
        yield from map(function, items)
        return
    distributed = _distributed()
    with _client(distributed, min(workers, len(items)), scheduler) as client:
        for future in client.map(function, items, pure=False, retries=_RETRIES):
            try:
                yield future.result()
            except distributed.KilledWorker as error:
                raise InputError(f"--workers, --scheduler: workers died again and again: {error}") from error


def _client(distributed: Any, workers: int, scheduler: str | None) -> Any:
    if scheduler is None:
        return distributed.Client(
            n_workers=workers,
            threads_per_worker=1,
            dashboard_address="127.0.0.1:0",  # by default 8787, which another cluster may have
            silence_logs=logging.ERROR,
        )
    try:
        return distributed.Client(scheduler, timeout=_CONNECT_S)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {scheduler}: cannot connect: {error}; is it running?") from error


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise InputError(
            "--workers, --scheduler: expected the package distributed: pip install imu50[dask]"
        ) from error
    return distributed
