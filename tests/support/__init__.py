"""Shared by all tests; look here before writing a rig, a story or a helper of your own.

* Fixtures of `tests/conftest.py`: `config` and `mirror` (the defaults, one object per session), `free_port`.
* `scenario`: `config_of("fyst-m2", run__panels=1)`, `mirror_of`, `one_panel`, `fault_plan` (rows of a plan); the
  simulated robot: `boot`, `sensors_of`, `drive`, `ServedRobot` (behind its server, with scripted clients and clock).
* `mission_story`: the mission with an ideal robot on one panel and scripted verdicts (`FREE`, `FRONT_OFF`, `ABORT`).
* `virtual_time`: `run_virtual(coroutine)` runs asyncio code, sockets included, on a clock on which nothing waits.
* `command`: the command line in process: `answered` (its JSON), `printed` (its text), `refused` (its one line).
* `runs`: real processes (`Run`), `until` (something is seen of them), and `recorded_run()`: one two-panel run, recorded
  once per test session, to read from.
* `sim_survey`: surveys in process: watched frame by frame with faults, measured by the daemon's own fix service with a
  scripted laser (`MeasuredSurvey`, `fix_service`), restarted after a kill.
* `sockets`: `scripted` (a server that follows a script), `peer_of` (a client that talks lines).
* `http_server`: `answering` (a server on loopback), `taking_posts` (what is posted to it).
* `daemon`: both loops of the daemon and their peers in one event loop; or the robot link alone, behind a proxy.
"""
