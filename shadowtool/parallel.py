"""The only place with threads.

OpenEXR and OpenCV release the GIL while they decode and encode, so threads are enough; OpenCV's
own threads are switched off in favour of ours.
"""

import contextlib
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import cv2

# No machine has a number of processors with so many digits.
_DIGITS = 7

Item = TypeVar("Item")
Result = TypeVar("Result")


def available_cpus() -> int:
    """The CPUs that this process may use: what Slurm granted, or the affinity mask."""
    granted = os.environ.get("SLURM_CPUS_PER_TASK", "")
    if granted.isascii() and granted.isdigit() and 0 < len(granted) < _DIGITS and int(granted) > 0:
        return int(granted)
    return len(os.sched_getaffinity(0))


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
