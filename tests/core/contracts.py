"""What every function on arrays promises, whatever it computes."""

import copy
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

WILD = st.one_of(
    st.floats(0, 4, width=16),
    st.floats(-2, 2, width=16),
    st.sampled_from([np.nan, np.inf, -np.inf, 0.0, 1.0, 60000.0]),
)
TAME = st.floats(0, 4, width=16)
UNIT = st.floats(0, 1, width=16)
SIZES = st.tuples(st.integers(1, 9), st.integers(1, 9))


@dataclass(frozen=True)
class Contract:
    """A call, what it may be given for a picture of a size, and what holds of its result."""

    call: Callable[..., Any]
    arguments: Callable[[int, int], st.SearchStrategy[tuple[Any, ...]]]
    holds: Callable[..., bool]


def array(
    *shape: int, elements: st.SearchStrategy[Any] = WILD, dtype: Any = np.float32
) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(dtype, shape, elements=elements)


def picture(
    height: int, width: int, elements: st.SearchStrategy[Any] = WILD
) -> st.SearchStrategy[np.ndarray]:
    return array(height, width, 3, elements=elements)


def halfs(height: int, width: int) -> st.SearchStrategy[np.ndarray]:
    return array(height, width, 3, dtype=np.float16)


def plane(
    height: int, width: int, elements: st.SearchStrategy[Any] = WILD
) -> st.SearchStrategy[np.ndarray]:
    return array(height, width, elements=elements)


def mask(height: int, width: int) -> st.SearchStrategy[np.ndarray]:
    return array(height, width, elements=st.booleans(), dtype=bool)


def same(one: Any, other: Any) -> bool:
    """Equal in type, shape and every bit, as deep as it goes; any NaN equals any other."""
    if isinstance(one, np.ndarray):
        if one.dtype != other.dtype or one.shape != other.shape:
            return False
        return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    if is_dataclass(one):
        return all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and (one == other or one != one)


def scattered(value: Any) -> Any:
    """The same values lying apart in memory."""
    if isinstance(value, np.ndarray) and value.ndim:
        return np.repeat(value, 2, axis=-1)[..., ::2]
    return copy.deepcopy(value)


def is_kept(contract: Contract, shrink: bool = True) -> None:
    """Inputs stay as they are, the same input gives the same bits however it lies in memory, and
    what the contract says holds of the result."""

    @settings(
        max_examples=25,
        phases=[Phase.generate, *([Phase.shrink] if shrink else [])],
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )
    @given(SIZES.flatmap(lambda size: contract.arguments(*size)))
    def check(arguments: tuple[Any, ...]) -> None:
        before = copy.deepcopy(arguments)
        result = contract.call(*arguments)
        assert same(arguments, before), "an input was changed"
        assert contract.holds(result, *arguments), f"the contract is broken by {result!r}"
        assert same(result, contract.call(*map(scattered, before))), "memory layout matters"

    check()
