"""Whole files, read at once and written whole or not at all."""

import contextlib
import errno
import fcntl
import io
import itertools
import os
import threading
import zlib
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from shadowtool.errors import InputError, MissingError, RetryError, ShadowtoolError

_PREFIX = ".shadowtool-"
_RETRY = {
    getattr(errno, name)
    for name in ("ENOSPC", "EDQUOT", "ESTALE", "EIO", "ETIMEDOUT", "EAGAIN", "ENFILE", "EMFILE")
    if hasattr(errno, name)
}
_HOST = f"{zlib.crc32(os.uname().nodename.encode()):08x}"
_SAMPLE, _SAMPLES = 1 << 16, 256
# A prime number of words: no row of pixels, and no page, is a multiple of it.
_FOLD = 4099
# Bytes that are read at a time, a multiple of the fold's.
_BLOCK = 8 * 32 * _FOLD
# So many buffers a thread keeps: a frame's, and what goes with it.
_SPARES = 3
_counter = itertools.count()


class Content(NamedTuple):
    """What is in a file, and its `fingerprint`."""

    data: bytes
    fingerprint: str


class _Version(NamedTuple):
    """What tells a file from another under its name, without reading it."""

    device: int
    number: int
    size: int
    changed: int


class _Known(threading.local):
    """What `fingerprinted` holds for the thread."""

    def __init__(self) -> None:
        self.files: dict[Path, tuple[_Version, str]] = {}


_known = _Known()


@contextlib.contextmanager
def fingerprinted(paths: Sequence[Path]) -> Iterator[list[str]]:
    """Give files' fingerprints; until it ends, this thread reads what they stand for.

    If a file changes meanwhile, reading it is an error.

    Raises:
        InputError, RetryError: as `read_bytes`.
    """
    known = {path: _known_as(path, _version(path)) for path in paths}
    before, _known.files = _known.files, known
    try:
        yield [known[path][1] for path in paths]
    finally:
        _known.files = before


@lru_cache(128)
def _known_as(path: Path, version: _Version) -> tuple[_Version, str]:
    """A file of this version with its fingerprint. Frames that many others are made of, as those
    on the way to a keyframe, are read once."""
    return version, fingerprint_file(path)


class _Spare(threading.local):
    """Memory that one of a pool's threads has read files into, and may again: new memory takes as
    long as reading does."""

    def __init__(self) -> None:
        self._buffers: list[bytearray] = []

    def take(self, size: int) -> bytearray:
        """Memory of so many bytes."""
        for place in reversed(range(len(self._buffers))):
            # What shrinks to less than half goes back to the system, and what grows is copied.
            if size <= 2 * len(self._buffers[place]) <= 4 * size:
                buffer = self._buffers.pop(place)
                # It is left to whoever still looks at what was in it: its size can't be changed.
                with contextlib.suppress(BufferError):
                    buffer.extend(bytes(max(size + 1 - len(buffer), 0)))
                    del buffer[size:]
                    return buffer
        # With some more: files of a take differ a little in size.
        buffer = bytearray(size + size // 8 + 1)
        del buffer[size:]
        return buffer

    def give(self, buffer: bytearray) -> None:
        """What nobody looks at any more. A few are kept, but for the main thread, which goes on
        when it has read all that it needs."""
        if threading.current_thread() is not threading.main_thread():
            self._buffers = [*self._buffers[1 - _SPARES :], buffer]


_spare = _Spare()


class File:
    """A file that is being read.

    Raises:
        InputError, RetryError: as `read_bytes`, in whatever reads it.
    """

    def __init__(self, path: Path, mark: str | None) -> None:
        self._path, self._mark, self._closed = path, mark, False

    @cached_property
    def content(self) -> bytearray:
        """All of it, until the file is no longer being read; then the next one may overwrite it."""
        assert not self._closed
        with _reading(self._path), io.FileIO(self._path) as file:
            buffer = _spare.take(os.fstat(file.fileno()).st_size)
            filled = 0
            with memoryview(buffer) as whole:
                while count := file.readinto(whole[filled:]):
                    filled += count
            del buffer[filled:]
            # Not all file systems tell the size.
            buffer += file.readall()
            return buffer

    def close(self) -> None:
        """Nobody looks at the content any more."""
        self._closed = True
        if "content" in self.__dict__:
            _spare.give(self.__dict__.pop("content"))

    @cached_property
    def source(self) -> str | BinaryIO:
        """What a library is to decode: the file's name, since by itself it reads fastest; the
        content where the name is in no encoding."""
        name = os.fspath(self._path)
        return name if _is_text(name) else io.BytesIO(self.content)

    def fingerprint(self) -> str:
        """See `fingerprint`; of the content, if that was read."""
        if self._mark is None:
            read = "content" in self.__dict__
            self._mark = fingerprint(self.content) if read else fingerprint_file(self._path)
        return self._mark


@contextlib.contextmanager
def unchanging(path: Path) -> Iterator[File]:
    """A file, for a library to decode or for the caller.

    Raises:
        InputError, RetryError: as `read_bytes`; RetryError also if the file changed meanwhile,
            whatever came of it.
    """
    version, mark = _known.files.get(path) or (_version(path), None)
    file = File(path, mark)
    try:
        yield file
    except ShadowtoolError:
        if _version(path) != version:
            raise _changed(path) from None
        raise
    finally:
        file.close()
    if _version(path) != version:
        raise _changed(path)


def read_content(path: Path) -> Content:
    """The file's content with its fingerprint. Raises as `unchanging`."""
    data = read_bytes(path)
    mark = fingerprint(data)
    if path in _known.files and _known.files[path][1] != mark:
        raise _changed(path)
    return Content(data, mark)


def _version(path: Path) -> _Version:
    with _reading(path):
        status = path.stat()
    return _Version(status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)


def _changed(path: Path) -> RetryError:
    return RetryError(f"{path}: changed while it was read; run again when it is whole")


def _is_text(name: str) -> bool:
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def read_bytes(path: Path) -> bytes:
    """The file's content.

    Raises:
        InputError: it isn't there, is no file, or may not be read.
        RetryError: the machine failed, not the file.
    """
    with _reading(path):
        return path.read_bytes()


def require_readable(path: Path) -> None:
    """Raise as `read_bytes` does where the file can't be opened."""
    with _reading(path), path.open("rb"):
        pass


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise MissingError(f"{path}: no such file") from None
    except OSError as error:
        raise translated(error, path, "read") from None


def write_bytes(path: Path, data: bytes | memoryview) -> None:
    """Put a file in place at once: a temporary beside it, then a rename.

    It isn't forced to the disk, which takes longer than most frames do: after a power cut a file
    may be empty, which resuming notices.

    Raises:
        RetryError: disk full, stale file handle and the like.
        ShadowtoolError: the folder is gone or may not be written.
    """
    temporary = path.parent / f"{_PREFIX}{_HOST}-{os.getpid()}-{_name()}.tmp"
    try:
        try:
            with contextlib.ExitStack() as until_renamed:
                with temporary.open("xb") as file:
                    until_renamed.enter_context(_in_use(temporary))
                    file.write(data)
                temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise translated(error, path, "write") from None


def _name() -> str:
    return f"{threading.get_ident():x}-{next(_counter)}"


def real(path: Path) -> Path:
    """The path without links, as far as it has any that lead somewhere."""
    # Path.resolve raises an error of its own where a link leads to itself.
    return Path(os.path.realpath(path))


def size_of(path: Path) -> int:
    """How many bytes a file has. Raises InputError as `read_bytes` does."""
    return _version(path).size


def is_file(path: Path) -> bool:
    """Whether a file is there, also under a name that can't be one."""
    try:
        return path.is_file()
    except OSError:
        return False


def leads_nowhere(path: Path) -> bool:
    """Whether it is a link to what isn't there."""
    try:
        return path.is_symlink() and not path.exists()
    except OSError:
        return False


@contextlib.contextmanager
def new_folders(paths: Iterable[Path], shared: bool = False) -> Iterator[None]:
    """Make output folders; if what follows fails, those that are new and still empty go again.

    Args:
        shared: others may be about to write to them, so that they stay.

    Raises:
        RetryError, ShadowtoolError: as `write_bytes`.
    """
    new: list[Path] = []
    try:
        for path in paths:
            new += [folder for folder in (*reversed(path.parents), path) if not folder.exists()]
            make_folder(path)
        yield
    except BaseException:
        for folder in () if shared else reversed(new):
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def make_folder(path: Path) -> None:
    """Make an output folder with its parents, and clear it of what a killed run left behind.

    Raises:
        RetryError, ShadowtoolError: as `write_bytes`.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        for leftover in path.glob(f"{_PREFIX}{_HOST}-*.tmp"):
            if not _alive(leftover.name.removeprefix(f"{_PREFIX}{_HOST}-").split("-")[0]):
                _sweep(leftover)
    except FileExistsError:
        raise ShadowtoolError(f"{path}: a file stands where the output folder should be") from None
    except OSError as error:
        raise translated(error, path, "write") from None


@contextlib.contextmanager
def _in_use(temporary: Path) -> Iterator[bool]:
    """Lock a file; False if it is locked already.

    A container's processes are seen by nobody else: the lock says that one is writing.
    """
    with temporary.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            # Some network file systems know no locks; there the process alone has to tell.
            yield error.errno not in (errno.EAGAIN, errno.EACCES)
        else:
            yield True


def _sweep(leftover: Path) -> None:
    """Remove a temporary that nobody is writing."""
    with contextlib.suppress(OSError), _in_use(leftover) as free:
        if free:
            leftover.unlink(missing_ok=True)


def _alive(pid: str) -> bool:
    try:
        os.kill(int(pid), 0)
    except (ValueError, OverflowError, ProcessLookupError):
        return False
    except OSError:
        return True
    return True


def fingerprint(data: bytes | bytearray) -> str:
    """What stands for a file's content: its size and a checksum.

    It tells whether an input changed between two runs, not whether somebody forged it. The CRC-32
    is that of the content folded to 32 kB by exclusive or, which takes a fifth of the time.
    """
    checksum = _Checksum()
    checksum.add(data)
    return checksum.result()


class _Checksum:
    """A `fingerprint` in the making."""

    def __init__(self) -> None:
        self._folded = np.zeros(_FOLD, np.uint64)
        self._rest = b""
        self._size = 0

    def add(self, data: bytes | bytearray | memoryview) -> None:
        """Take in the next bytes; a multiple of the fold's but for the last."""
        words = np.frombuffer(data, np.uint64, len(data) // (8 * _FOLD) * _FOLD)
        self._folded ^= np.bitwise_xor.reduce(words.reshape(-1, _FOLD), axis=0)
        self._rest = bytes(memoryview(data)[words.nbytes :])
        self._size += len(data)

    def result(self) -> str:
        return f"{self._size}:{zlib.crc32(self._rest, zlib.crc32(self._folded.tobytes())):08x}"


def fingerprint_file(path: Path) -> str:
    """The `fingerprint` of a file's content. Raises as `read_bytes`."""
    checksum = _Checksum()
    block = memoryview(bytearray(_BLOCK))
    with _reading(path), io.FileIO(path) as file:
        length = _BLOCK
        while length == _BLOCK:
            length = 0
            while count := file.readinto(block[length:]):
                length += count
            checksum.add(block[:length])
    return checksum.result()


def fingerprint_movie(path: Path) -> str:
    """Size and CRC-32 of samples spread over a file that may be too large to read for this.

    Raises:
        InputError, RetryError: as `read_bytes`.
    """
    try:
        size = path.stat().st_size
        check = 0
        with path.open("rb") as file:
            step = max(size // _SAMPLES, _SAMPLE)
            for start in range(0, size, step):
                file.seek(start)
                check = zlib.crc32(file.read(_SAMPLE), check)
            file.seek(max(size - _SAMPLE, 0))
            check = zlib.crc32(file.read(), check)
    except OSError as error:
        raise translated(error, path, "read") from None
    return f"{size}:{check:08x}"


def translated(error: OSError, path: Path, verb: str) -> ShadowtoolError:
    """What an OSError comes to: worth retrying, or the user's to mend."""
    reason = error.strerror or str(error)
    if error.errno in _RETRY:
        return RetryError(f"{path}: cannot {verb}: {reason}; free the resource and run again")
    if verb == "read":
        return InputError(f"{path}: cannot read: {reason}")
    return ShadowtoolError(f"{path}: cannot write: {reason}; check the output folder")
