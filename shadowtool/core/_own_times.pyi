from typing import Any

from numpy.typing import NDArray

def catch(
    crossings: tuple[NDArray[Any] | None, ...],
    found: tuple[NDArray[Any], ...],
    counts: NDArray[Any],
    slope: float,
    floor: float,
    beyond: float,
    enough: float,
    chosen: float,
) -> None: ...
def tell(
    crossings: tuple[NDArray[Any] | None, ...],
    caught: tuple[NDArray[Any], ...],
    found: tuple[NDArray[Any], ...],
    slope: float,
    floor: float,
    beyond: float,
    profile: float,
    least: float,
    least_between: float,
    interval: float,
    sharp: float,
    soft: float,
) -> None: ...
