"""Pure. One run of a robot among beacons against the simulated world, with the truth beside the estimates."""

from dataclasses import dataclass, field

import numpy as np

from ccatp.angles import wrap_pi
from ccatp.config.radio_models import RadioConfig
from ccatp.radio.beacon_loop import BeaconLoop
from ccatp.radio.motion import Pose
from ccatp.radio.signal_settings import odometry_of, vehicle_of
from ccatp.samples import FloatArray
from ccatp.sim.radio.frame import DriveCommand
from ccatp.sim.radio.world import RadioWorld


@dataclass(slots=True)
class RadioRun:
    """What a run leaves, one entry a step where nothing else is said.

    Attributes:
        pose_errors: x_m, y_m and heading_rad, estimate minus truth.
        pose_nees: with 3 degrees of freedom.
        reckoned_errors: x_m and y_m of dead reckoning by the same odometry.
        beacon_errors_m: by name, from the first estimate on: distance of estimate and truth.
        beacon_nees: the same, with 2 degrees of freedom.
        nis: of each reading, and its size.
        distances_m: true distance to the target.
        clearances_m: between body and nearest obstacle.
        truth, estimates, targets, believed: paths of the vehicle and of the target, x_m and y_m.
        places: at the end, by name: estimate, covariance, truth.
        joint_nees: at the end, of the pose and all static radios on the map, and its degrees of freedom.
    """

    pose_errors: list[tuple[float, float, float]] = field(default_factory=list)
    pose_nees: list[float] = field(default_factory=list)
    reckoned_errors: list[tuple[float, float]] = field(default_factory=list)
    beacon_errors_m: dict[str, list[float]] = field(default_factory=dict)
    beacon_nees: dict[str, list[float]] = field(default_factory=dict)
    nis: list[tuple[float, int]] = field(default_factory=list)
    distances_m: list[float] = field(default_factory=list)
    clearances_m: list[float] = field(default_factory=list)
    truth: list[tuple[float, float]] = field(default_factory=list)
    estimates: list[tuple[float, float]] = field(default_factory=list)
    targets: list[tuple[float, float]] = field(default_factory=list)
    believed: list[tuple[float, float]] = field(default_factory=list)
    places: dict[str, tuple[FloatArray, FloatArray, FloatArray]] = field(default_factory=dict)
    joint_nees: tuple[float, int] = (0.0, 0)


def run_radio(cfg: RadioConfig) -> RadioRun:
    """A whole run; a function of the configuration and its seed."""
    world, loop, run = RadioWorld(cfg), BeaconLoop(cfg), RadioRun()
    reckoned, motion = Pose(cfg.start.x_m, cfg.start.y_m, cfg.start.heading_rad), vehicle_of(cfg)
    drive = loop.first()
    for step in range(1, cfg.run.steps + 1):
        static, target = loop.listens(step)
        frame = world.step(DriveCommand(*drive), cfg.run.step_s, static=static, target=target)
        drive = loop.step(frame.time_s, frame.wheels, frame.packets, frame.sightings, frame.distances_m)
        states = np.zeros(motion.size)
        states[:3] = reckoned
        reckoned = Pose(*motion.step(states, odometry_of(cfg, frame.time_s, frame.wheels)).mean[:3].tolist())
        _note(run, world, loop, reckoned, cfg.follow.target)
    truths = _true_places(world, cfg.follow.target)
    for name, estimate in loop.slam.beacons.items():
        run.places[str(name)] = (estimate.mean, estimate.covariance, np.array(truths[str(name)]))
    run.joint_nees = _joint_nees(world, loop)
    return run


def _joint_nees(world: RadioWorld, loop: BeaconLoop) -> tuple[float, int]:
    """Of what is on the map: radios whose readings still wait are left out."""
    placed = [name for name in world.beacons_m if name in loop.slam.engine]
    mean, covariance = loop.slam.joint(placed)
    truth = np.concatenate([world.pose, *(world.beacons_m[name] for name in placed)])
    return _nees(mean - truth, covariance), truth.size


def _note(run: RadioRun, world: RadioWorld, loop: BeaconLoop, reckoned: Pose, target: str) -> None:
    true, pose = world.pose, loop.slam.pose
    error = (pose.x_m - true.x_m, pose.y_m - true.y_m, wrap_pi(pose.heading_rad - true.heading_rad))
    run.pose_errors.append(error)
    run.pose_nees.append(_nees(np.array(error), loop.slam.pose_covariance))
    run.reckoned_errors.append((reckoned.x_m - true.x_m, reckoned.y_m - true.y_m))
    run.nis += [(learned.nis, learned.size) for learned in loop.learned]
    run.clearances_m.append(world.clearance_m)
    run.truth.append(true[:2])
    run.estimates.append(pose[:2])
    truths = _true_places(world, target)
    for name, estimate in loop.slam.beacons.items():
        off = estimate.mean - truths[str(name)]
        run.beacon_errors_m.setdefault(str(name), []).append(float(np.hypot(*off)))
        run.beacon_nees.setdefault(str(name), []).append(_nees(off, estimate.covariance))
    if world.target_m is not None:
        run.targets.append(world.target_m)
        run.distances_m.append(float(np.hypot(world.target_m[0] - true.x_m, world.target_m[1] - true.y_m)))
        believed = loop.slam.beacons.get(target)
        run.believed.append((np.nan, np.nan) if believed is None else (believed.mean[0], believed.mean[1]))


def _true_places(world: RadioWorld, target: str) -> dict[str, tuple[float, float]]:
    moving = world.target_m
    return world.beacons_m if moving is None else {**world.beacons_m, target: moving}


def _nees(error: FloatArray, covariance: FloatArray) -> float:
    return float(error @ np.linalg.solve(covariance, error))
