from pathlib import Path

import pytest

_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of captures that a developer's machine has beside the project."""
    if not _DATA.is_dir():
        pytest.skip(f"needs the captures in {_DATA}, which come with the project's workplace only")
    return _DATA


@pytest.fixture(scope="session")
def reference(data: Path) -> Path:
    """The folder of the reference captures and what belongs to them."""
    return data / "reference"
