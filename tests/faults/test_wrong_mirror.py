"""A daemon that was told of another mirror than the one below its robot does not begin."""

import pytest

from ccatp.errors import ExitStatus
from tests.faults.daemon_rig import configuration, running_daemon, tell
from tests.faults.linking import Measured


@pytest.mark.fault("P21")
async def test_a_robot_on_another_mirror_is_refused(measured: Measured) -> None:
    told, real = configuration(**{"run.mirror": "fyst-m1"}), configuration(**{"run.mirror": "fyst-m2"})
    async with running_daemon(told, real) as daemon:
        duty = daemon.robot.robot.fans.duty
        await daemon.until(daemon.main.over.is_set)
        assert daemon.main.exit_status == ExitStatus.USAGE, tell(daemon)
        (line,) = (entry["text"] for entry in daemon.log if "right mirror" in entry.get("text", ""))
        assert "fyst-m1 has one of 24.7 deg there" in line
        measured("P21", len(daemon.executed))
        assert daemon.main.status().exit_status == 2
        assert duty <= daemon.robot.robot.fans.duty
