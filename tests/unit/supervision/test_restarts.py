"""Whether a process that died, or hangs, is restarted."""

import pytest

from ccatp.daemon.child_processes import ProcessEnd, RestartPolicy, SilenceWatch


@pytest.mark.fault("P18")
def test_a_crash_loop_ends_and_rare_deaths_do_not() -> None:
    policy = RestartPolicy(3, 60.0)
    assert [policy.died("main", -9, t).end for t in (0.0, 1.0, 2.0)] == [ProcessEnd.RESTART] * 3
    decision = policy.died("main", -9, 59.0)
    assert decision == (
        ProcessEnd.HELD,
        "process main was killed by SIGKILL, more than 3 times within 60 s: run ended, wheels held",
    )
    assert policy.died("danger", 1, 59.0).end is ProcessEnd.RESTART  # each counts for itself
    seldom = RestartPolicy(3, 60.0)
    assert {seldom.died("main", -9, 21.0 * k).end for k in range(50)} == {ProcessEnd.RESTART}


@pytest.mark.parametrize("code", [2, 5])
def test_what_would_be_said_again_is_not_tried_again(code: int) -> None:
    assert RestartPolicy(3, 60.0).died("main", code, 0.0).end is ProcessEnd.END


def test_the_robot_itself_has_no_substitute() -> None:
    decision = RestartPolicy(3, 60.0).died("dataloop", -11, 0.0, is_replaceable=False)
    assert decision == (ProcessEnd.HELD, "process dataloop was killed by SIGSEGV: run ended, wheels held")


def test_how_it_died_is_told() -> None:
    policy = RestartPolicy(9, 60.0)
    assert "ended with status 1:" in policy.died("main", 1, 0.0).text
    assert "was killed by signal 40:" in policy.died("main", -40, 0.0).text
    assert "hung:" in policy.died("main", -9, 0.0, why="hung").text


@pytest.mark.fault("P7")
def test_silence_counts_while_somebody_listens() -> None:
    watch = SilenceWatch(30.0, 2.0)
    watch.reset()
    now_s = 0.0
    for _ in range(18):
        now_s += 0.1
        assert not watch.is_hung(now_s)
    now_s += 3600.0  # the supervisor itself was stopped
    assert not watch.is_hung(now_s)
    assert watch.is_hung(now_s + 0.2)
    watch.reset()
    assert not watch.is_hung(now_s + 0.3)


def test_a_start_may_take_longer() -> None:
    watch = SilenceWatch(1.0, 0.3)
    assert not any(watch.is_hung(0.1 * k) for k in range(10))
    assert watch.is_hung(1.1)
    assert watch.text == "sent no heartbeat for 1 s and was killed"


def test_a_run_goes_on_without_what_it_does_not_need() -> None:
    policy = RestartPolicy(1, 60.0)
    again = policy.died("dashboard", -9, 0.0, is_needed=False)
    assert again == (
        ProcessEnd.RESTART,
        "process dashboard was killed by SIGKILL: restarting it, the survey goes on",
    )
    assert policy.died("dashboard", -9, 1.0, is_needed=False).end is ProcessEnd.WITHOUT
    assert policy.died("dashboard", 2, 99.0, is_needed=False).end is ProcessEnd.WITHOUT
