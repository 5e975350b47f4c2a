from typing import Any

def choose(
    planes: tuple[Any, ...],
    chosen: tuple[Any, ...],
    height: int,
    size: int,
    radius: int,
    first: int,
    agrees: float,
) -> None: ...
