"""The on-board program in a process of its own, over devices at register and byte level."""

import signal

from tests.processes.onboard_reactions import TRIALS, Program, driving, measure


def test_whatever_must_stop_the_wheels_does() -> None:
    # How fast it is depends on the load of the machine: the page of the program has the figures of an idle one.
    assert measure(list(TRIALS), 1).keys() == TRIALS.keys()


def test_the_line_of_the_external_timer_stands_still_once_the_program_is_stopped() -> None:
    program = Program()
    try:
        with driving(program):
            program.process.send_signal(signal.SIGSTOP)
            program.stopped()
            before_s = program.changed_s
            assert not program.changes_within(0.3)
            assert program.changed_s == before_s
            program.process.send_signal(signal.SIGCONT)
            assert program.changes_within(5.0)
    finally:
        program.close()
    assert program.process.returncode == 0
