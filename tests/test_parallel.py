"""Work on a pool of threads, in order and without piling up."""

import threading
import time

import cv2
import pytest

from shadowtool.parallel import available_cpus, meanwhile, ordered_map


def shadowtool_threads() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name.startswith("shadowtool")]


@pytest.mark.parametrize("jobs", [1, 2, 7])
def test_results_come_in_the_order_of_the_items(jobs):
    def slow_first(item: int) -> int:
        time.sleep(0.02 if item == 0 else 0)
        return item * item

    assert list(ordered_map(slow_first, range(20), jobs)) == [i * i for i in range(20)]


def test_nothing_to_do_gives_nothing():
    assert list(ordered_map(str, [], 2)) == []


@pytest.mark.parametrize("jobs", [1, 2, 4])
def test_so_many_jobs_run_at_once_and_no_more(jobs):
    meeting = threading.Barrier(jobs)
    running, most = [], []

    def work(item: int) -> None:
        running.append(item)
        most.append(len(running))
        meeting.wait(timeout=5)
        running.remove(item)

    list(ordered_map(work, range(jobs * 3), jobs))
    assert max(most) == jobs


@pytest.mark.parametrize("jobs", [1, 3])
def test_items_are_taken_only_as_results_are(jobs):
    taken = []

    def items():
        for item in range(100):
            taken.append(item)
            yield item

    results = ordered_map(lambda item: item, items(), jobs)
    for expected in range(10):
        assert next(results) == expected
        assert len(taken) <= expected + jobs + 2
    results.close()
    assert len(taken) < 20


def test_items_are_drawn_in_the_calling_thread():
    threads = set()

    def items():
        for item in range(5):
            threads.add(threading.current_thread())
            yield item

    list(ordered_map(str, items(), 2))
    assert threads == {threading.current_thread()}


def test_an_exception_is_raised_in_its_turn():
    def work(item: int) -> int:
        if item == 3:
            raise ValueError("three")
        return item

    results = ordered_map(work, range(10), 2)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="three"):
        next(results)
    assert shadowtool_threads() == []


def test_after_an_exception_nothing_new_is_begun():
    begun = []

    def work(item: int) -> None:
        begun.append(item)
        if item == 0:
            raise ValueError
        time.sleep(0.01)

    with pytest.raises(ValueError):
        list(ordered_map(work, range(100), 2))
    at_end = len(begun)
    time.sleep(0.05)
    assert len(begun) == at_end <= 4


def test_an_exception_of_the_items_reaches_the_caller_and_ends_the_pool():
    def items():
        yield 1
        raise OSError("gone")

    with pytest.raises(OSError, match="gone"):
        list(ordered_map(str, items(), 2))
    assert shadowtool_threads() == []


def test_an_interrupt_while_waiting_waits_for_what_is_under_way():
    finished = []

    def work(item: int) -> int:
        time.sleep(0.02)
        finished.append(item)
        return item

    with pytest.raises(KeyboardInterrupt):
        for item in ordered_map(work, range(50), 2):
            if item == 3:
                raise KeyboardInterrupt
    assert shadowtool_threads() == []
    assert len(finished) < 20


def test_a_generator_closed_early_ends_its_threads():
    results = ordered_map(lambda item: item, range(100), 2)
    next(results)
    assert shadowtool_threads()
    results.close()
    assert shadowtool_threads() == []


def test_an_unused_generator_starts_no_thread():
    ordered_map(str, range(5), 2)
    assert shadowtool_threads() == []


def test_opencv_is_left_one_thread():
    cv2.setNumThreads(4)
    list(ordered_map(str, range(3), 2))
    assert cv2.getNumThreads() == 1


@pytest.mark.parametrize(("granted", "cpus"), [("3", 3), ("1", 1), ("64", 64)])
def test_what_slurm_granted_counts(granted, cpus, monkeypatch):
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", granted)
    assert available_cpus() == cpus


@pytest.mark.parametrize("granted", ["", "0", "-2", "x", "2(x3)", "1.5", "²"])
def test_nonsense_from_slurm_is_passed_over(granted, monkeypatch):
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", granted)
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {0, 2, 5, 7, 9})
    assert available_cpus() == 5


def test_without_slurm_the_affinity_mask_counts(monkeypatch):
    monkeypatch.delenv("SLURM_CPUS_PER_TASK", raising=False)
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {1, 4, 5})
    assert available_cpus() == 3


@pytest.mark.parametrize(
    ("quota", "cpus"),
    [("150000 100000", 2), ("20000 100000", 1), ("900000 100000", 3), ("max 100000", 3), ("", 3)],
)
def test_a_containers_share_counts(quota, cpus, monkeypatch, tmp_path):
    monkeypatch.delenv("SLURM_CPUS_PER_TASK", raising=False)
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {1, 4, 5})
    monkeypatch.setattr("shadowtool.parallel._QUOTA", tmp_path / "cpu.max")
    (tmp_path / "cpu.max").write_text(quota)
    assert available_cpus() == cpus


def test_where_there_are_no_affinity_masks_all_cpus_count(monkeypatch, tmp_path):
    monkeypatch.delenv("SLURM_CPUS_PER_TASK", raising=False)
    monkeypatch.delattr("os.sched_getaffinity")
    monkeypatch.setattr("shadowtool.parallel._QUOTA", tmp_path / "none")
    monkeypatch.setattr("os.cpu_count", lambda: 6)
    assert available_cpus() == 6


def test_by_default_as_many_threads_as_cpus_are_used(monkeypatch):
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "3")
    meeting = threading.Barrier(3)
    assert len(list(ordered_map(lambda _: meeting.wait(timeout=5), range(3)))) == 3


def test_work_goes_on_meanwhile_and_its_result_is_waited_for():
    begun, asked = threading.Event(), threading.Event()

    def work() -> int:
        begun.set()
        assert asked.wait(timeout=5)
        return 7

    with meanwhile(work) as result:
        assert begun.wait(timeout=5)
        asked.set()
        assert result() == 7
    assert not shadowtool_threads()


def test_what_goes_wrong_meanwhile_is_raised_where_the_result_is_asked_for():
    def work() -> int:
        raise ValueError("in the work")

    with meanwhile(work) as result, pytest.raises(ValueError, match="in the work"):
        result()


def test_work_is_over_when_the_block_fails():
    over = []

    def work() -> None:
        time.sleep(0.05)
        over.append(True)

    with pytest.raises(ValueError, match="in the block"), meanwhile(work):
        raise ValueError("in the block")
    assert over
