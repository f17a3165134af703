"""Pure. The batch smoother: sparse nonlinear least squares over poses, beacons and calibration of a whole run."""

from ccatp.radio.batch.settings import BatchPriors, BatchSettings, RadioNoise
from ccatp.radio.batch.smoother import smooth

__all__ = ["BatchPriors", "BatchSettings", "RadioNoise", "smooth"]
