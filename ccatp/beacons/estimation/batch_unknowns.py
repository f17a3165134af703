"""The unknowns of the least-squares problem of a run, and what is known of them before its readings."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ccatp.beacons.config.models import PriorsConfig
from ccatp.beacons.estimation.measurement_models import ANTENNA
from ccatp.beacons.estimation.motion import POSE
from ccatp.beacons.estimation.reckoning import CALIBRATION
from ccatp.beacons.estimation.recording import BeaconId, BoolArray, RecordedRun
from ccatp.core import FloatArray

OF_READINGS = (
    "range_scale", "range_offset_m", "bearing_offset_rad", "rssi_reference_db", "rssi_exponent", *ANTENNA,
)  # fmt: skip
# Unknowns that are neither pose nor beacon, in the order of the state; all are zero for perfectly calibrated sensors.
SHARED = (*CALIBRATION, *OF_READINGS)
RANGE_SCALE, RANGE_OFFSET, BEARING_OFFSET, RSSI_REFERENCE, RSSI_EXPONENT, *ARM = (
    SHARED.index(name) for name in OF_READINGS
)
# States of a beacon: x_m, y_m, offset of its ranges, m, and of its P_ref, dB, its height over the antenna squared, m^2.
BEACON, HEIGHT = 5, 4


@dataclass(slots=True)
class BatchState:
    """Values of all unknowns."""

    poses: FloatArray  # x_m, y_m, heading_rad at each instant, shape (n, 3)
    shared: FloatArray  # by ``SHARED``, shape (13,)
    beacons: FloatArray  # x_m, y_m, range_offset_m, reference_db, height_m2 by beacon, shape (b, 5)

    def moved(self, poses: FloatArray, shared: FloatArray) -> "BatchState":
        """The state after a step: ``poses`` (n, 3); ``shared`` with the beacons behind, shape (13 + 5 b,)."""
        split = len(SHARED)
        beacons = self.beacons + shared[split:].reshape(-1, BEACON)
        return BatchState(self.poses + poses, self.shared + shared[:split], beacons)


QUARTER_TURN = np.array(((0.0, -1.0), (1.0, 0.0)))


@dataclass(frozen=True, slots=True)
class MarginalPrior:
    """What readings before a window tell of its first pose, of the shared unknowns and of the beacons, without priors.

    A quadratic form z^T L z / 2 - g^T z of the deviation z from the values at which it was made. In z all places are
    turned back with the heading, z_p = R(heading_0 - heading) p - p_0, so a rotation of the whole map changes the
    heading's part alone, wherever it is linearised: the form never gains information about the rotation that no
    reading gave (as the errors of the invariant EKF: Barrau and Bonnabel 2015).
    """

    pose: FloatArray  # shape (3,)
    shared: FloatArray  # by ``SHARED``, shape (13,)
    beacons: FloatArray  # shape (b, 5)
    known: BoolArray  # beacons that it contains, shape (b,); the rows of others are zero
    information: FloatArray  # L, of z: pose, shared, beacons, shape (16 + 5 b, 16 + 5 b)
    side: FloatArray  # g, shape (16 + 5 b,)

    @classmethod
    def made(
        cls, state: BatchState, last: int, known: BoolArray, information: FloatArray, side: FloatArray
    ) -> "MarginalPrior":
        """From information and right-hand side of the deviations of pose ``last``, shared unknowns and beacons."""
        pose, shared, beacons = state.poses[last].copy(), state.shared.copy(), state.beacons.copy()
        nothing = cls(pose, shared, beacons, known, information, side)
        back = np.linalg.inv(nothing._deviation(pose, shared, beacons)[1])
        return cls(pose, shared, beacons, known, back.T @ information @ back, back.T @ side)

    def cost(self, state: BatchState) -> float:
        """The form at a state whose first pose is the prior's."""
        z = self._deviation(state.poses[0], state.shared, state.beacons)[0]
        return float(z @ (0.5 * (self.information @ z) - self.side))

    def normal_equations(self, state: BatchState) -> tuple[FloatArray, FloatArray]:
        """J^T L J and J^T (g - L z)."""
        z, J = self._deviation(state.poses[0], state.shared, state.beacons)
        return J.T @ self.information @ J, J.T @ (self.side - self.information @ z)

    def _deviation(self, pose: FloatArray, shared: FloatArray, beacons: FloatArray) -> tuple[FloatArray, FloatArray]:
        """z, and its derivatives by pose, shared unknowns and beacons."""
        turned = float(pose[2] - self.pose[2])
        c, s = np.cos(turned), np.sin(turned)
        back = np.array(((c, s), (-s, c)))
        size = POSE + shared.size + beacons.size
        z, J = np.empty(size), np.eye(size)
        z[2], z[POSE : POSE + shared.size] = turned, shared - self.shared
        z[POSE + shared.size :] = (beacons - self.beacons).ravel()
        starts = POSE + shared.size + BEACON * np.arange(len(beacons))
        for start, place, origin in (
            (0, pose[:2], self.pose[:2]), *zip(starts.tolist(), beacons[:, :2], self.beacons[:, :2], strict=True),
        ):  # fmt: skip
            rows = slice(start, start + 2)
            z[rows], J[rows, rows] = back @ place - origin, back
            J[rows, 2] = -QUARTER_TURN @ (back @ place)
        return z, J


class PlacePrior(NamedTuple):
    """What is known of the places of beacons before the run: a Gaussian of the unknowns that are no poses."""

    mean: FloatArray  # by ``SHARED`` and beacons, shape (13 + 5 b,)
    information: FloatArray  # zero but for the places of known beacons, shape (13 + 5 b, 13 + 5 b)

    @classmethod
    def of_run(cls, run: RecordedRun, names: Collection[BeaconId]) -> "PlacePrior":
        """The prior by the known map of a run, of those of its beacons that have ``names``."""
        size = len(SHARED) + BEACON * len(run.beacon_ids)
        mean, information = np.zeros(size), np.zeros((size, size))
        if run.known_map is not None and (known := run.known_map.of([str(name) for name in names])).names:
            starts = [len(SHARED) + BEACON * run.beacon_ids.index(name) for name in known.names]
            rows = np.array([(start, start + 1) for start in starts]).ravel()
            mean[rows], information[np.ix_(rows, rows)] = known.places_m.ravel(), np.linalg.inv(known.covariance_m2)
        return cls(mean, information)


def of_priors(priors: PriorsConfig, used: BoolArray, raised: BoolArray | None) -> tuple[BoolArray, FloatArray]:
    """Which shared unknowns and states of the beacons are estimated, and the information of their priors, (13 + 5 b,).

    A standard deviation of 0 fixes an unknown; places have no prior. ``raised``: as for ``BatchProblem``.
    """
    beacons = np.zeros((len(used), BEACON))
    beacons[used, :HEIGHT] = np.inf, np.inf, priors.beacon_offset_m, priors.beacon_reference_db
    if raised is not None:
        beacons[used & raised, HEIGHT] = priors.beacon_height_m2
    sigmas = np.concatenate([[getattr(priors, name) for name in SHARED], beacons.ravel()])
    free = sigmas > 0.0
    return free, np.where(free, 1.0 / np.where(free, sigmas, 1.0) ** 2, 0.0)
