from typing import Any

from numpy.typing import NDArray

def unzip(
    inflate: int,
    data: bytes | bytearray,
    table: memoryview,
    target: NDArray[Any],
    top: int,
    rows: int,
    length: int,
) -> int: ...
def zip(
    deflate: int,
    level: int,
    source: NDArray[Any],
    target: NDArray[Any],
    place: int,
    table: NDArray[Any],
    top: int,
    rows: int,
    length: int,
) -> int: ...
