"""``python -m tests.support.beacon_pairs SYSTEM SEEDS``: simulated robot against drivers and fake devices, by pairs.

Each seed is a mission of either robot in virtual time; printed is the root mean square of the error of the position,
of cricket from when the motes have their map, and the mean difference of the pairs with its standard error.
"""

import sys

import numpy as np

from ccatp.beacons.links.messages import pose_errors, truth_in
from ccatp.beacons.sim.robot import SimulatedBeaconRobot, build_beacon_robot
from ccatp.beacons.studies.mote_navigation import BeaconSilWorld
from tests.support.beacon_rig import SLOWER, BeaconRig, DrivenRobot, pioneer_config


def error_m(system: str, seed: int, *, is_driven: bool) -> float:
    """Of one mission."""
    changes = SLOWER if system == "follow" and is_driven else {}
    cfg = pioneer_config(system, run__seed=seed, **changes)
    robot: SimulatedBeaconRobot = DrivenRobot(BeaconRig(cfg)) if is_driven else build_beacon_robot(cfg)
    world = BeaconSilWorld(cfg, robot)
    while not world.is_over:
        world.frame()
    result = world.result()
    assert result.outcome == "complete"
    track, truth = result.poses
    errors_m = np.hypot(*pose_errors(track, truth_in(truth, track.seq))[:, :2].T)
    mapped_s = (result.summary["map"] or {}).get("map_time_s", 0.0)
    is_used = np.isfinite(errors_m) & (track.t_s > mapped_s)
    return float(np.sqrt(np.mean(errors_m[is_used] ** 2)))


def main(system: str, seeds: int) -> None:
    """Print the comparison."""
    rows = [[error_m(system, seed, is_driven=kind) for kind in (False, True)] for seed in range(1, seeds + 1)]
    pairs = np.array(rows)
    simulated, drivers = pairs.mean(axis=0)
    change = pairs[:, 1] - pairs[:, 0]
    print(f"{system}, {seeds} seeds: simulated {simulated:.4f} m, standard deviation {pairs[:, 0].std(ddof=1):.4f} m")
    error = change.std(ddof=1) / np.sqrt(seeds)
    print(f"drivers {drivers:.4f} m, difference {change.mean():+.4f} m, standard error {error:.4f} m")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
