from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

def settle(
    state: tuple[Any, ...],
    frames: Sequence[NDArray[Any]],
    seen: int,
    first: int,
    nearly_lit: float,
    nearly_lit_keys: int,
) -> None: ...
