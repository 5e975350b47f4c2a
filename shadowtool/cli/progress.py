"""Progress on stderr: a bar for a person, lines for a log, messages for a farm."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

Advance = Callable[[int, int], None]

_SECONDS_BETWEEN_LINES = 5.0


@contextlib.contextmanager
def reporter(kind: str, name: str) -> Iterator[Advance]:
    """A function to call with steps done and steps in all, drawn as ``kind`` says."""
    if kind == "auto":
        kind = "bar" if sys.stderr.isatty() else "plain"
    if kind == "bar":
        with _bar(name) as advance:
            yield advance
    elif kind == "plain":
        yield _lines(name)
    elif kind == "openjd":
        yield _openjd()
    else:
        yield lambda done, total: None


@contextlib.contextmanager
def _bar(name: str) -> Iterator[Advance]:
    from tqdm import tqdm

    with tqdm(desc=name, unit="frame", file=sys.stderr, leave=False, dynamic_ncols=True) as bar:

        def advance(done: int, total: int) -> None:
            bar.total = total or None
            bar.update(done - bar.n)

        yield advance


def _lines(name: str) -> Advance:
    last = time.monotonic()

    def advance(done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= _SECONDS_BETWEEN_LINES:
            last = now
            print(f"{name}: {done} of {total}", file=sys.stderr, flush=True)

    return advance


def _openjd() -> Advance:
    most = 0.0

    def advance(done: int, total: int) -> None:
        nonlocal most
        # Open Job Description reads a task's progress from its output, in per cent. A take that has
        # to be read again begins anew, and a task's progress never falls.
        most = max(most, 100 * done / total if total else 0.0)
        print(f"openjd_progress: {most:.1f}", file=sys.stderr, flush=True)

    return advance
