"""``python -m tests.support.beacon_pairs SYSTEM SEEDS [BAUD S]``: simulated robot against drivers and fake devices.

Each seed is a mission of either robot in virtual time; printed is the root mean square of the error of the position,
of cricket from when the motes have their map, and the mean difference of the pairs with its standard error. With BAUD
and S bytes take time: those of base and radio at this rate; adapters hand them on each S seconds.
"""

import sys

import numpy as np

from ccatp.beacons.links.messages import pose_errors, truth_in
from ccatp.beacons.sim.robot import SimulatedBeaconRobot, build_beacon_robot
from ccatp.beacons.studies.mote_navigation import BeaconSilWorld
from tests.support.beacon_rig import SLOWER, BeaconRig, DrivenRobot, pioneer_config


def slowed(rig: BeaconRig, baud: int, latency_s: float) -> BeaconRig:
    """With lines on which bytes take time."""
    for port in rig.ports.values():
        port.baud = baud if port in (rig.base, rig.radio) else rig.onboard.devices.listeners.baud
        port.latency_s = latency_s
    return rig


def error_m(system: str, seed: int, line: tuple[int, float] | None, *, is_driven: bool) -> float:
    """Of one mission."""
    changes = SLOWER if system == "follow" and is_driven else {}
    cfg = pioneer_config(system, run__seed=seed, **changes)
    robot: SimulatedBeaconRobot = build_beacon_robot(cfg)
    if is_driven:
        robot = DrivenRobot(slowed(BeaconRig(cfg), *line) if line else BeaconRig(cfg))
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


def main(system: str, seeds: int, line: tuple[int, float] | None) -> None:
    """Print the comparison."""
    rows = [[error_m(system, seed, line, is_driven=kind) for kind in (False, True)] for seed in range(1, seeds + 1)]
    pairs = np.array(rows)
    simulated, drivers = pairs.mean(axis=0)
    change = pairs[:, 1] - pairs[:, 0]
    spread_m, error_of_mean_m = (values.std(ddof=1) if seeds > 1 else np.nan for values in (pairs[:, 0], change))
    print(f"{system}, {seeds} seeds: simulated {simulated:.4f} m, standard deviation {spread_m:.4f} m")
    error_of_mean_m /= np.sqrt(seeds)
    print(f"drivers {drivers:.4f} m, difference {change.mean():+.4f} m, standard error {error_of_mean_m:.4f} m")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), (int(sys.argv[3]), float(sys.argv[4])) if len(sys.argv) > 3 else None)
