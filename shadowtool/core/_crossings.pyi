from typing import Any

import numpy as np
from numpy.typing import NDArray

def settle(
    state: tuple[Any, ...],
    frames: list[NDArray[np.int16]],
    seen: int,
    first: int,
    nearly_lit: float,
    nearly_lit_keys: int,
) -> None: ...
