"""The array type of the mathematics."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
"""Array of float64; its docstring says shape and unit."""
