"""Files appear whole or not at all."""

import contextlib
import errno
import fcntl
import io
import os
import socket
import stat
import subprocess
import sys
import threading
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from shadowtool.errors import InputError, RetryError, ShadowtoolError
from shadowtool.io import files as files_module
from shadowtool.io.files import (
    fingerprint,
    fingerprint_file,
    fingerprinted,
    make_folder,
    new_folders,
    read_bytes,
    read_content,
    unchanging,
    write_bytes,
)

RETRY = ["ENOSPC", "EDQUOT", "ESTALE", "EIO", "ETIMEDOUT", "EMFILE"]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def leftover(folder: Path, pid: object) -> Path:
    host = f"{zlib.crc32(socket.gethostname().encode()):08x}"
    path = folder / f".shadowtool-{host}-{pid}-7f-0.tmp"
    path.write_bytes(b"half a frame")
    return path


def dead_process() -> int:
    return int(subprocess.check_output([sys.executable, "-c", "import os; print(os.getpid())"]))


@pytest.fixture
def failing_write(monkeypatch):
    """Make the next write to disk stop half-way with an error of the given name."""

    def arrange(name: str) -> None:
        opened = Path.open

        def broken_open(self, *args, **kwargs):
            file = opened(self, *args, **kwargs)
            if "x" in (args[0] if args else kwargs.get("mode", "")):
                whole = file.write

                class Broken:
                    def __enter__(self):
                        return self

                    def __exit__(self, *exc):
                        file.close()

                    def write(self, data):
                        whole(bytes(data)[:3])
                        raise OSError(getattr(errno, name), os.strerror(getattr(errno, name)))

                return Broken()
            return file

        monkeypatch.setattr(Path, "open", broken_open)

    return arrange


def test_a_file_is_written_and_read_whole(tmp_path):
    write_bytes(tmp_path / "a", memoryview(b"content"))
    assert read_bytes(tmp_path / "a") == b"content"
    assert names(tmp_path) == ["a"]


def test_writing_replaces_what_was_there(tmp_path):
    write_bytes(tmp_path / "a", b"long content")
    write_bytes(tmp_path / "a", b"short")
    assert read_bytes(tmp_path / "a") == b"short"


@pytest.mark.parametrize("name", RETRY)
def test_a_fault_of_the_machine_is_worth_a_retry_and_leaves_nothing(name, tmp_path, failing_write):
    failing_write(name)
    with pytest.raises(RetryError, match=r"frame\.exr") as caught:
        write_bytes(tmp_path / "frame.exr", b"content")
    assert caught.value.exit_code == 75
    assert "\n" not in str(caught.value)
    assert names(tmp_path) == []


def test_a_failed_write_leaves_the_old_content(tmp_path, failing_write):
    write_bytes(tmp_path / "a", b"old")
    failing_write("ENOSPC")
    with pytest.raises(RetryError):
        write_bytes(tmp_path / "a", b"new content")
    assert names(tmp_path) == ["a"]
    assert (tmp_path / "a").read_bytes() == b"old"


def test_a_failed_rename_leaves_no_temporary(tmp_path):
    (tmp_path / "a").mkdir()
    with pytest.raises(ShadowtoolError, match="cannot write"):
        write_bytes(tmp_path / "a", b"content")
    assert names(tmp_path) == ["a"]


def test_an_interrupted_write_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(self, target):
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_bytes(tmp_path / "a", b"content")
    assert names(tmp_path) == []


def test_a_really_full_disk_is_worth_a_retry(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no tmpfs may be mounted here")
    try:
        with pytest.raises(RetryError, match="No space left"):
            write_bytes(disk / "a", bytes(1 << 20))
        assert names(disk) == []
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o644), (0o002, 0o664), (0o077, 0o600)])
def test_permissions_follow_the_umask(mask, mode, tmp_path):
    before = os.umask(mask)
    try:
        write_bytes(tmp_path / "a", b"")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == mode


def test_a_folder_that_is_gone_is_named(tmp_path):
    with pytest.raises(ShadowtoolError, match="gone/a") as caught:
        write_bytes(tmp_path / "gone" / "a", b"")
    assert caught.value.exit_code == 1


def test_threads_may_write_the_same_name_at_once(tmp_path):
    contents = [bytes([number]) * 100_000 for number in range(8)]
    threads = [
        threading.Thread(target=write_bytes, args=(tmp_path / "a", content)) for content in contents
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (tmp_path / "a").read_bytes() in contents
    assert names(tmp_path) == ["a"]


def test_names_of_the_longest_length_can_be_written(tmp_path):
    write_bytes(tmp_path / ("n" * 251 + ".exr"), b"x")
    assert len(names(tmp_path)) == 1


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda path: None, "no such file"),
        (Path.mkdir, "cannot read"),
        (lambda path: path.symlink_to(path), "cannot read"),
    ],
)
def test_what_cannot_be_read_is_named(make, reason, tmp_path):
    make(tmp_path / "a.exr")
    with pytest.raises(InputError, match=rf"a\.exr: {reason}"):
        read_bytes(tmp_path / "a.exr")


def test_a_stale_file_handle_is_worth_a_retry(tmp_path, monkeypatch):
    def stale(self):
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))

    monkeypatch.setattr(Path, "read_bytes", stale)
    with pytest.raises(RetryError, match="cannot read"):
        read_bytes(tmp_path / "a")


def test_names_that_are_too_long_are_refused(tmp_path):
    with pytest.raises(InputError, match="File name too long"):
        read_bytes(tmp_path / ("n" * 10_000))


def test_a_folder_is_made_with_its_parents(tmp_path):
    make_folder(tmp_path / "a/b/c")
    make_folder(tmp_path / "a/b/c")
    assert (tmp_path / "a/b/c").is_dir()


def test_leftovers_of_dead_processes_are_swept(tmp_path):
    gone = leftover(tmp_path, dead_process())
    make_folder(tmp_path)
    assert not gone.exists()


def test_leftovers_of_living_processes_stay(tmp_path):
    mine, other = leftover(tmp_path, os.getpid()), leftover(tmp_path, os.getppid())
    make_folder(tmp_path)
    assert mine.exists()
    assert other.exists()


def test_what_a_process_that_is_not_seen_is_writing_stays(tmp_path):
    hidden = leftover(tmp_path, dead_process())
    with hidden.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        make_folder(tmp_path)
        assert hidden.exists()
    make_folder(tmp_path)
    assert not hidden.exists()


def test_leftovers_of_other_machines_stay(tmp_path):
    foreign = tmp_path / f".shadowtool-00000000-{dead_process()}-7f-0.tmp"
    foreign.write_bytes(b"")
    make_folder(tmp_path)
    assert foreign.exists()


@pytest.mark.parametrize("pid", ["x", "", "99999999999999999999"])
def test_leftovers_that_name_no_process_are_swept(pid, tmp_path):
    gone = leftover(tmp_path, pid)
    make_folder(tmp_path)
    assert not gone.exists()


def test_nothing_else_is_swept(tmp_path):
    kept = ["a.1001.exr", ".hidden", "shadowtool.json", ".shadowtool-notes"]
    for name in kept:
        (tmp_path / name).write_bytes(b"")
    make_folder(tmp_path)
    assert names(tmp_path) == sorted(kept)


@pytest.mark.parametrize("shared", [False, True])
def test_new_folders_go_again_unless_others_may_write_there(shared, tmp_path):
    with pytest.raises(ValueError, match="x"), new_folders([tmp_path / "a/b"], shared):
        raise ValueError("x")
    assert (tmp_path / "a/b").exists() == shared


@pytest.mark.parametrize("place", ["file", "file/below", "n" * 10_000])
def test_a_folder_that_cannot_be_made_is_refused(place, tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(ShadowtoolError) as caught:
        make_folder(tmp_path / place)
    assert caught.value.exit_code == 1
    assert str(caught.value).startswith(str(tmp_path))


def test_fingerprints_tell_contents_apart(tmp_path):
    contents = [b"", b"\0", b"\0\0", b"a", b"b", b"ab", b"ba"]
    assert len({fingerprint(content) for content in contents}) == len(contents)


@pytest.mark.parametrize("size", [1, 32_791, 32_792, 32_793, 100_000, 1_000_003])
def test_a_fingerprint_tells_of_any_byte(size):
    content = np.random.default_rng(size).integers(0, 256, size, np.uint8)
    marks = {fingerprint(content.tobytes())}
    places = {0, size // 3, size // 2, size - 1}
    for place in places:
        content[place] ^= 0x10
        marks.add(fingerprint(content.tobytes()))
    assert len(marks) == 1 + len(places)


@pytest.mark.parametrize("row", [8, 4096, 1920 * 2, 1920 * 6, 4096 * 12 + 8, 65536])
def test_a_fingerprint_tells_of_rows_that_changed_places(row):
    rows = np.random.default_rng(0).integers(0, 256, (1_000_000 // row, row), np.uint8)
    for other in (1, 2, len(rows) // 2, len(rows) - 1):
        swapped = rows.copy()
        swapped[[0, other]] = swapped[[other, 0]]
        assert fingerprint(swapped.tobytes()) != fingerprint(rows.tobytes())


def test_a_files_fingerprint_is_its_contents(tmp_path):
    (tmp_path / "a").write_bytes(b"content")
    (tmp_path / "b").write_bytes(b"content")
    os.utime(tmp_path / "b", (0, 0))
    assert fingerprint_file(tmp_path / "a") == fingerprint_file(tmp_path / "b")
    assert fingerprint_file(tmp_path / "a") == fingerprint(b"content")


BLOCK = 262_336


@pytest.mark.parametrize("size", [0, 1, 5_000, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK, 700_001])
def test_a_large_files_fingerprint_is_its_contents_too(size, tmp_path):
    rng = np.random.default_rng(size)
    content = rng.integers(0, 256, size, np.uint8).tobytes()
    (tmp_path / "a").write_bytes(content)
    assert fingerprint_file(tmp_path / "a") == fingerprint(content)


def test_a_file_is_read_once_or_decoded_by_its_name(tmp_path):
    path = tmp_path / "a file"
    path.write_bytes(b"first")
    with unchanging(path) as file:
        assert (file.source, file.fingerprint()) == (str(path), fingerprint(b"first"))
        assert (file.content, file.fingerprint()) == (b"first", fingerprint(b"first"))


def in_thread(work):
    """What work gives in a thread of a pool, which keeps what it has read into."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(work).result()


def files(folder, *sizes):
    paths = [folder / str(number) for number in range(len(sizes))]
    for number, (path, size) in enumerate(zip(paths, sizes, strict=True)):
        path.write_bytes(bytes([number + 1]) * size)
    return paths


def test_each_file_that_is_being_read_has_a_content_of_its_own(tmp_path):
    paths = files(tmp_path, 5000, 2, 9000)

    def read():
        for _ in range(2):
            with unchanging(paths[0]) as one, unchanging(paths[1]) as other:
                assert (bytes(one.content), bytes(other.content)) == (b"\1" * 5000, b"\2\2")
                with unchanging(paths[2]) as third:
                    assert bytes(third.content) == b"\3" * 9000
                assert (bytes(one.content), bytes(other.content)) == (b"\1" * 5000, b"\2\2")

    in_thread(read)


@pytest.mark.parametrize("failing", [False, True])
def test_what_is_read_goes_where_the_last_file_was_that_was_about_as_large(failing, tmp_path):
    paths = files(tmp_path, 10_000, 20, 11_000, 6_000, 30)

    def read(path):
        with contextlib.suppress(InputError), unchanging(path) as file:
            read = file.content
            assert len(read) == path.stat().st_size
            if failing:
                raise InputError("damaged")
        return read

    large, small, *others, last = in_thread(lambda: [read(path) for path in paths])
    assert all(other is large for other in others)
    assert small is last and small is not large


def test_the_main_thread_keeps_nothing_that_it_has_read(tmp_path):
    (path,) = files(tmp_path, 1000)

    def kept():
        with unchanging(path) as file:
            assert file.content
        return len(files_module._spare._buffers)

    assert kept() == 0
    assert in_thread(kept) == 1


def test_what_is_still_looked_at_is_not_overwritten(tmp_path):
    one, other = files(tmp_path, 100, 100)

    def read():
        with unchanging(one) as file:
            view = memoryview(file.content)
        with unchanging(other) as file:
            assert bytes(file.content) == b"\2" * 100
        return bytes(view)

    assert in_thread(read) == b"\1" * 100


def test_a_file_is_read_in_as_many_pieces_as_it_comes_in(tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.write_bytes(bytes(range(256)))

    class Slow(io.FileIO):
        def readinto(self, buffer):
            return super().readinto(memoryview(buffer)[:100])

    monkeypatch.setattr(files_module.io, "FileIO", Slow)
    with unchanging(path) as file:
        assert bytes(file.content) == bytes(range(256))


@pytest.mark.parametrize("told", [0, 100, 255, 257, 1000])
def test_a_file_whose_size_is_told_wrong_is_read_whole(told, tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.write_bytes(bytes(range(256)))
    taken = files_module._Spare.take
    monkeypatch.setattr(files_module._Spare, "take", lambda self, size: taken(self, told))
    with unchanging(path) as file:
        assert bytes(file.content) == bytes(range(256))


@pytest.mark.parametrize("replaced", [True, False])
def test_a_file_that_changes_while_it_is_decoded_is_worth_a_retry(replaced, tmp_path):
    path, other = tmp_path / "a", tmp_path / "b"
    path.write_bytes(b"first")
    other.write_bytes(b"other")
    times = path.stat().st_atime_ns, path.stat().st_mtime_ns
    with pytest.raises(RetryError, match="a: changed while it was read"), unchanging(path):
        if replaced:
            os.utime(other, ns=times)
            other.replace(path)
        else:
            path.write_bytes(b"more than that")


def test_what_is_wrong_with_a_file_that_changed_is_that(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"first")
    with pytest.raises(RetryError, match="a: changed while it was read"), unchanging(path):
        path.write_bytes(b"more than that")
        raise InputError("of another size")


def test_a_file_that_goes_while_it_is_decoded_is_named(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"first")
    with pytest.raises(InputError, match="a: no such file"), unchanging(path):
        path.unlink()


def test_a_file_that_changed_since_its_fingerprint_was_given_is_an_error(tmp_path):
    path, other = tmp_path / "a", tmp_path / "b"
    path.write_bytes(b"first")
    other.write_bytes(b"other")
    with fingerprinted([path, other, path]) as marks:
        assert marks == [fingerprint(b"first"), fingerprint(b"other"), fingerprint(b"first")]
        with unchanging(other) as file:
            assert (file.source, file.fingerprint()) == (str(other), marks[1])
        path.write_bytes(b"second")
        with pytest.raises(RetryError, match="a: changed while it was read"), unchanging(path):
            pass
        with pytest.raises(RetryError, match="a: changed while it was read"):
            read_content(path)
        assert read_content(other) == (b"other", marks[1])
    assert read_content(path) == (b"second", fingerprint(b"second"))


def test_a_name_in_no_encoding_is_decoded_from_memory(tmp_path):
    path = tmp_path / os.fsdecode(b"\xff.exr")
    path.write_bytes(b"first")
    with unchanging(path) as file:
        assert (file.source.read(9), file.fingerprint()) == (b"first", fingerprint(b"first"))


def test_a_fault_of_the_machine_while_reading_is_worth_a_retry(tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.write_bytes(bytes(10))

    class Failing(io.FileIO):
        def readinto(self, buffer):
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    def failing(path):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr("io.FileIO", Failing)
    monkeypatch.setattr(Path, "read_bytes", failing)
    with pytest.raises(RetryError, match="a: cannot read"):
        fingerprint_file(path)
    with pytest.raises(RetryError, match="a: cannot read"), unchanging(path) as file:
        file.fingerprint()
    with pytest.raises(RetryError, match="a: cannot read"), unchanging(path) as file:
        assert file.content


def test_the_fingerprint_of_a_missing_file_is_an_error(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        fingerprint_file(tmp_path / "a")


def test_a_fingerprint_is_known_to_its_own_thread_alone(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"first")
    seen = []
    with fingerprinted([path]):
        path.write_bytes(b"second")
        thread = threading.Thread(target=lambda: seen.append(read_content(path).data))
        thread.start()
        thread.join()
    assert seen == [b"second"]


def test_nothing_is_known_after_a_failure(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"first")
    with pytest.raises(InputError, match="nowhere"), fingerprinted([path, tmp_path / "nowhere"]):
        pass
    path.write_bytes(b"second")
    assert read_content(path).data == b"second"
