import os
import random
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import TypeAlias

import pytest
from hypothesis import settings

# As `calib` sets it; inherited by the workers and by the programs under test, which all share two cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# The first example of a test may compile kernels, which takes seconds.
settings.register_profile("imu50", deadline=None)
settings.load_profile("imu50")

_DATA = Path(__file__).parents[2] / "shared" / "data"
ReplacedAtRandom: TypeAlias = Callable[..., AbstractContextManager[None]]


@pytest.fixture(scope="session", autouse=True)
def no_key_of_the_bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Nothing is signed with the key of whoever runs the tests, also not by processes that they start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("config")))
        yield


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of captures that may lie beside the project; they are not part of it."""
    if not _DATA.is_dir():
        pytest.skip("needs the captures in ../shared/data beside the project, absent here")
    return _DATA


@pytest.fixture(scope="session")
def reference(data: Path) -> Path:
    """The folder of the reference captures and what belongs to them."""
    return data / "reference"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what takes minutes in one worker: the others would wait for it at the end."""
    items.sort(key=lambda item: item.path.name != "test_warm_up.py")


@contextmanager
def _replaced_at_random(
    path: Path, contents: Sequence[bytes], seed: int, removed: float = 0.0
) -> Iterator[None]:
    """Inside, a file becomes one of the contents again and again, each time whole; `removed`: how often it is
    away for a moment before.
    """
    is_over = Event()
    randomly = random.Random(seed)
    beside = path.with_name("next")

    def replace() -> None:
        while not is_over.is_set():
            beside.write_bytes(randomly.choice(contents))
            if randomly.random() < removed:
                path.unlink()
                time.sleep(randomly.uniform(0.0, 2e-3))
            beside.rename(path)
            time.sleep(randomly.uniform(0.0, 4e-3))  # reading, parsing and hashing takes about as long

    thread = Thread(target=replace)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


@pytest.fixture(scope="session")
def replaced_at_random() -> ReplacedAtRandom:
    """Replaces a file while it is read; see `_replaced_at_random`."""
    return _replaced_at_random
