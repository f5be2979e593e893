from pathlib import Path

import pytest

_DATA = Path(__file__).parents[2] / "shared" / "data"


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
