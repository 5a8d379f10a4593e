from __future__ import annotations

import os
import threading
import time

import pytest

from splatseed.progress import blocks, in_threads, num_threads, silent, thread_limit


def test_blocks_cover_the_range_and_report_each_end():
    told = []
    pieces = list(blocks(10, 4, "stage", lambda stage, done: told.append((stage, done))))
    assert pieces == [(0, 4), (4, 8), (8, 10)]
    assert told == [("stage", 0.0), ("stage", 0.4), ("stage", 0.8), ("stage", 1.0)]


def test_threads_do_every_piece_once():
    done = [0] * 1000

    def work(start, stop):
        for i in range(start, stop):
            done[i] += 1

    in_threads(work, 1000, 7, "stage", silent)
    assert done == [1] * 1000


def test_an_interrupt_waits_for_the_pieces_in_hand_and_drops_the_rest():
    running, started, lock = set(), [], threading.Lock()

    def work(start, stop):
        with lock:
            running.add(start)
            started.append(start)
        time.sleep(0.02)
        with lock:
            running.discard(start)

    def interrupt(stage, done):
        if done > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        in_threads(work, 1000, 1, "stage", interrupt)
    assert not running
    assert len(started) < 1000


def test_an_error_in_a_thread_comes_out():
    def work(start, stop):
        if start == 50:
            message = "at 50"
            raise ValueError(message)

    with pytest.raises(ValueError, match="at 50"):
        in_threads(work, 100, 10, "stage", silent)


def test_threads_are_one_per_available_cpu_or_the_limit(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 3}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    assert num_threads() == 2
    limit = thread_limit.set(1)
    assert num_threads() == 1
    thread_limit.reset(limit)


def test_threads_are_limited_by_the_variables_of_openmp_and_numba_and_by_a_container(
    monkeypatch, tmp_path
):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr("splatseed.progress._CPU_MAX", tmp_path / "cpu.max")
    for omp, numba, jobs, threads in (
        ("", "", 1, 8), ("", "", 3, 2), ("", "", 99, 1), ("3", "", 1, 3), ("3,2", "", 1, 3),
        ("", "2", 1, 2), ("3", "2", 1, 2), ("64", "", 1, 8), ("3", "", 4, 2), ("many", "0", 1, 8),
    ):  # fmt: skip
        monkeypatch.setenv("OMP_NUM_THREADS", omp)
        monkeypatch.setenv("NUMBA_NUM_THREADS", numba)
        assert num_threads(jobs) == threads, (omp, numba, jobs)
    for quota, cpus in (("max 100000", 8), ("250000 100000", 2), ("50000 100000", 1)):
        (tmp_path / "cpu.max").write_text(f"{quota}\n")
        assert num_threads() == cpus
