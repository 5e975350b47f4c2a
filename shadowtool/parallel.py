"""The only place with threads.

OpenEXR and OpenCV release the GIL while they decode and encode, so threads are enough; OpenCV's
own threads are switched off in favour of ours.
"""

import contextlib
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import cv2

# No number of processors, and none of microseconds here, has so many digits.
_DIGITS = 10
# Microseconds that a container may use of each so many; "max" if it may use all.
_QUOTA = Path("/sys/fs/cgroup/cpu.max")

Item = TypeVar("Item")
Result = TypeVar("Result")


def available_cpus() -> int:
    """The CPUs that this process may use: what Slurm granted, or those of the affinity mask, but no
    more than the share of a container."""
    granted = _number(os.environ.get("SLURM_CPUS_PER_TASK", ""))
    if granted:
        return granted
    if hasattr(os, "sched_getaffinity"):
        there = len(os.sched_getaffinity(0))
    else:
        there = os.cpu_count() or 1
    return min(there, _share() or there)


def _share() -> int | None:
    """How many CPUs' time a container has at most, rounded up; None for no limit."""
    try:
        quota, period = map(_number, _QUOTA.read_text().split())
    except (OSError, ValueError):
        return None
    return -(-quota // period) if quota and period else None


def _number(text: str) -> int:
    """A number as the system writes it; 0 for what is none."""
    usual = text.isascii() and text.isdigit() and len(text) < _DIGITS
    return int(text) if usual else 0


@contextlib.contextmanager
def meanwhile(work: Callable[[], Result]) -> Iterator[Callable[[], Result]]:
    """Do one thing on a thread of its own while the block does others.

    The block is given a function that waits for the result, or raises what ``work`` raised. The
    work is over when the block is left, however that happens.
    """
    cv2.setNumThreads(1)
    with ThreadPoolExecutor(1, thread_name_prefix="shadowtool") as pool:
        yield pool.submit(work).result


def ordered_map(
    work: Callable[[Item], Result], items: Iterable[Item], jobs: int | None = None
) -> Iterator[Result]:
    """Apply ``work`` to each item on a pool of threads; results in the order of the items.

    At most ``jobs + 2`` items are under way or waiting to be taken, however many there are, and
    ``items`` is advanced in the calling thread. An exception in ``work`` is raised here, in its
    turn; what is then under way is finished, what is not begun never is.

    Args:
        jobs: threads; None for `available_cpus`.
    """
    count = jobs or available_cpus()
    cv2.setNumThreads(1)
    pool = ThreadPoolExecutor(count, thread_name_prefix="shadowtool")
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) >= count + 2:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
