from typing import Any

from numpy.typing import NDArray

def trust(
    value: NDArray[Any],
    allowed: NDArray[Any],
    trusted: NDArray[Any],
    near: float,
    least: int,
) -> None: ...
def add_up(value: NDArray[Any], weight: NDArray[Any], moments: NDArray[Any], size: int) -> None: ...
def solve(
    sums: tuple[NDArray[Any], ...],
    planes: tuple[Any, ...],
    factor: float,
    radius: float,
    weight: float,
    level: float,
    floor: float,
    misfit: float,
) -> None: ...
def choose(
    planes: tuple[Any, ...],
    chosen: tuple[Any, ...],
    height: int,
    size: int,
    radius: int,
    first: int,
    agrees: float,
) -> None: ...
