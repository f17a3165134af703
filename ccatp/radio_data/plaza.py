"""Edge. The Plaza data sets of CMU: odometry (DR), ranges (TD), beacons (TL) and truth (GT), as .mat or as text."""

from pathlib import Path

import numpy as np
import scipy.io

from ccatp.radio.recording import Odometry, Readings, RecordedRun, Truth


def read_plaza(path: Path) -> RecordedRun:
    m = scipy.io.loadmat(path)
    gt, dr, td, tl = m["GT"], m["DR"], m["TD"], m["TL"]
    ids = tuple(str(int(i)) for i in tl[:, 0])
    nan = np.full(len(td), np.nan)
    times = np.concatenate([[gt[0, 0]], dr[:, 0]])
    return RecordedRun(
        path.stem,
        "plaza",
        Odometry(times, dr[:, 1], dr[:, 2]),
        Readings(td[:, 0], np.array([ids.index(str(int(i))) for i in td[:, 2]]), td[:, 3], nan, nan),
        ids,
        {i: (float(x), float(y)) for i, (_, x, y) in zip(ids, tl)},
        Truth(gt[:, 0], gt[:, 1], gt[:, 2], gt[:, 3] + np.pi),
        (float(gt[0, 1]), float(gt[0, 2]), float(gt[0, 3] + np.pi)),
        (),
    )
