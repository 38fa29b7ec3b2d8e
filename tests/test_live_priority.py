"""The station before other programs, where the system allows it."""

import os
import sys
import threading
from typing import Any

import pytest

from rasnik.live import priority
from rasnik.live.priority import NICE, before_others, give_way

if sys.platform != "linux":
    pytest.skip("priorities of threads are those of Linux", allow_module_level=True)


def now() -> tuple[int, int]:
    return os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)


class System:
    """Keeps a policy and a niceness as the kernel would, and refuses what it is told to."""

    def __init__(self, cores: int, real_time: bool, least_nice: int) -> None:
        self.cores, self.real_time, self.least_nice = cores, real_time, least_nice
        self.policy, self.nice = os.SCHED_OTHER, 0

    def sched_setscheduler(self, pid: int, policy: int, parameter: Any) -> None:
        if policy != os.SCHED_OTHER and not self.real_time:
            raise PermissionError
        assert parameter.sched_priority == (policy != os.SCHED_OTHER)
        self.policy = policy

    def setpriority(self, which: int, pid: int, nice: int) -> None:
        if nice < min(self.least_nice, self.nice):
            raise PermissionError
        self.nice = nice

    def take_the_place_of_os(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for name in ("sched_setscheduler", "setpriority"):
            monkeypatch.setattr(os, name, getattr(self, name))
        monkeypatch.setattr(os, "sched_getscheduler", lambda pid: self.policy)
        monkeypatch.setattr(os, "sched_getparam", lambda pid: os.sched_param(0))
        monkeypatch.setattr(os, "getpriority", lambda which, pid: self.nice)
        monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(self.cores)))


@pytest.mark.parametrize(
    ("cores", "real_time", "least_nice", "had"),
    [
        (2, True, -20, "real time"),
        (1, True, -20, "nice -10"),  # one that cannot keep up would leave nothing for others
        (2, False, -20, "nice -10"),
        (2, False, -4, "nice -4"),
        (2, False, 0, ""),
    ],
)
def test_as_far_as_it_is_allowed(
    monkeypatch: pytest.MonkeyPatch, cores: int, real_time: bool, least_nice: int, had: str
) -> None:
    system = System(cores, real_time, least_nice)
    system.take_the_place_of_os(monkeypatch)
    with before_others(channels=1) as told:
        assert told == had
        assert (system.policy == os.SCHED_RR) == (had == "real time")
        assert system.nice == (int(had.split()[1]) if had.startswith("nice") else 0)
    assert (system.policy, system.nice) == (os.SCHED_OTHER, 0)


def test_what_a_service_was_given_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    system = System(1, False, 0)
    system.nice = -15
    system.take_the_place_of_os(monkeypatch)
    with before_others(channels=1) as told:
        assert (told, system.nice) == ("nice -15", -15)
    assert system.nice == -15


def test_threads_inherit_it_and_it_ends() -> None:
    before, found = now(), []
    with before_others(channels=0) as told:
        thread = threading.Thread(target=lambda: found.append(now()))
        thread.start()
        thread.join()
        assert found == [now()]
        assert (now() != before) == bool(told and told != f"nice {before[1]}")
    assert now() == before or not told


def test_threads_that_were_there_before_are_raised_too() -> None:
    """Such as those of linear algebra, which begin when numpy is loaded."""
    going_on = threading.Event()
    thread = threading.Thread(target=going_on.wait)
    thread.start()
    number = thread.native_id
    assert number is not None
    before = os.sched_getscheduler(number), os.getpriority(os.PRIO_PROCESS, number)
    with before_others(channels=0):
        assert (os.sched_getscheduler(number), os.getpriority(os.PRIO_PROCESS, number)) == now()
    assert (os.sched_getscheduler(number), os.getpriority(os.PRIO_PROCESS, number)) == before
    going_on.set()
    thread.join()


def test_a_process_that_gives_way() -> None:
    """Even if it was started by one in real time."""
    found = []

    def change() -> None:  # in a thread: this one could not go back without a privilege
        with before_others(channels=0):
            give_way()
            found.append(now())

    thread = threading.Thread(target=change)
    thread.start()
    thread.join()
    assert found[0][0] == os.SCHED_OTHER and found[0][1] >= 5


def test_elsewhere_nothing_is_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    before = now()
    monkeypatch.setattr(priority.sys, "platform", "darwin")
    with before_others(channels=0) as told:
        assert told == "" and now() == before
        give_way()
    assert now() == before
    assert NICE < 0
