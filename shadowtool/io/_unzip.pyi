from typing import Any

import numpy as np
from numpy.typing import NDArray

def unzip(
    inflate: int, data: bytes, places: NDArray[np.int64], target: NDArray[Any], size: int
) -> int: ...
