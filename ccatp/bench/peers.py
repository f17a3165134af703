"""filterpy and Stone Soup as contenders of a race, each in the way its own manual uses it.

Both belong to the extra ``peers`` and are imported only when a race is set up; the models are built before the clock
starts. What the peers compute has to be what this project computes: the race checks it.
"""

from typing import Any

import numpy as np

from ccatp.bench.contenders import Contender, Result
from ccatp.bench.problems import DT_S, FilterProblem, models
from ccatp.core import FloatArray


def filterpy_linear(problem: FilterProblem) -> Contender:
    """``filterpy.kalman.KalmanFilter``.

    Raises:
        ImportError: filterpy is not installed.
    """
    from filterpy.kalman import KalmanFilter  # noqa: PLC0415 - belongs to an extra

    peer = KalmanFilter(dim_x=problem.mean.size, dim_z=problem.variances.size)
    peer.F, peer.H, peer.Q, peer.R = problem.F, problem.H, problem.Q, np.diag(problem.variances)
    columns = [reading[:, None] for reading in problem.readings]

    def step(i: int) -> None:
        peer.predict()
        peer.update(columns[i])

    return Contender(lambda: _reset(peer, problem, column=True), step, lambda: (peer.x[:, 0], peer.P))


def filterpy_extended(problem: FilterProblem) -> Contender:
    """``filterpy.kalman.ExtendedKalmanFilter`` with its prediction overridden, as its manual tells for a nonlinear f.

    Raises:
        ImportError: filterpy is not installed.
    """
    from filterpy.kalman import ExtendedKalmanFilter  # noqa: PLC0415 - belongs to an extra

    motion, sight = models(problem)

    class Extended(ExtendedKalmanFilter):  # type: ignore[misc] # filterpy has no types
        x: FloatArray

        def predict_x(self, u: object = 0) -> None:
            x, self.F = motion.at(self.x)
            self.x = x.copy()

    peer = Extended(dim_x=problem.mean.size, dim_z=problem.variances.size)
    peer.Q, peer.R = problem.Q, np.diag(problem.variances)
    expected = problem.readings[0]

    def jacobian(x: FloatArray) -> FloatArray:
        """Asked for before the value of the same state, which is kept: the model is evaluated once, as ours is."""
        nonlocal expected
        expected, H = sight.at(x)
        return H

    def step(i: int) -> None:
        peer.predict()
        peer.update(problem.readings[i], jacobian, lambda _: expected)

    return Contender(lambda: _reset(peer, problem), step, lambda: (peer.x, peer.P))


def filterpy_unscented(problem: FilterProblem, alpha: float, beta: float, kappa: float) -> Contender:
    """``filterpy.kalman.UnscentedKalmanFilter`` with the scaled points of Merwe.

    Raises:
        ImportError: filterpy is not installed.
    """
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter  # noqa: PLC0415 - belongs to an extra

    n, (motion, sight) = problem.mean.size, models(problem)
    points = MerweScaledSigmaPoints(n, alpha, beta, kappa)
    peer = UnscentedKalmanFilter(
        n,
        problem.variances.size,
        DT_S,
        points=points,
        hx=lambda x: sight.through(x[None])[0],
        fx=lambda x, _dt: motion.through(x[None])[0],
    )
    peer.Q, peer.R = problem.Q, np.diag(problem.variances)

    def step(i: int) -> None:
        peer.predict()
        peer.update(problem.readings[i])

    return Contender(lambda: _reset(peer, problem), step, lambda: (peer.x, peer.P))


def stonesoup(kind: str, problem: FilterProblem, **sigma_points: float) -> Contender:
    """Predictor and updater of Stone Soup.

    Args:
        kind: ``Kalman``, ``ExtendedKalman`` or ``UnscentedKalman``.
        problem: what to solve.
        sigma_points: alpha, beta, kappa of the unscented one.

    Raises:
        ImportError: Stone Soup is not installed.
    """
    import stonesoup.predictor.kalman as predictors  # noqa: PLC0415 - belongs to an extra
    import stonesoup.updater.kalman as updaters  # noqa: PLC0415
    from stonesoup.types.detection import Detection  # noqa: PLC0415
    from stonesoup.types.hypothesis import SingleHypothesis  # noqa: PLC0415
    from stonesoup.types.state import GaussianState  # noqa: PLC0415

    transition, measurement = _stonesoup_models(problem)
    predictor = getattr(predictors, kind + "Predictor")(transition, **sigma_points)
    updater = getattr(updaters, kind + "Updater")(measurement, **sigma_points)
    detections = [Detection(reading[:, None]) for reading in problem.readings]
    state: Any = None

    def reset() -> None:
        nonlocal state
        state = GaussianState(problem.mean[:, None].copy(), problem.covariance.copy())

    def step(i: int) -> None:
        nonlocal state
        state = updater.update(SingleHypothesis(predictor.predict(state), detections[i]))

    def result() -> Result:
        return np.array(state.state_vector, dtype=np.float64)[:, 0], np.array(state.covar, dtype=np.float64)

    return Contender(reset, step, result)


def _stonesoup_models(problem: FilterProblem) -> tuple[Any, Any]:
    from stonesoup.models.measurement.linear import LinearGaussian  # noqa: PLC0415 - belongs to an extra
    from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel  # noqa: PLC0415

    n, noise = problem.mean.size, np.diag(problem.variances)
    if problem.F is None:
        return _stonesoup_nonlinear(problem, noise)

    class Rows(LinearGaussian):  # type: ignore[misc] # Stone Soup has no types
        @property
        def ndim_meas(self) -> int:
            return problem.variances.size

        def matrix(self, **_: object) -> FloatArray | None:
            return problem.H

    transition = LinearGaussianTimeInvariantTransitionModel(transition_matrix=problem.F, covariance_matrix=problem.Q)
    return transition, Rows(ndim_state=n, mapping=tuple(range(n)), noise_covar=noise)


def _stonesoup_nonlinear(problem: FilterProblem, noise: FloatArray) -> tuple[Any, Any]:
    from stonesoup.models.base import TimeInvariantModel  # noqa: PLC0415 - belongs to an extra
    from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement  # noqa: PLC0415
    from stonesoup.models.transition.nonlinear import GaussianTransitionModel  # noqa: PLC0415
    from stonesoup.types.array import StateVector, StateVectors  # noqa: PLC0415

    n, (motion, sight) = problem.mean.size, models(problem)

    def mapped(model: Any, state: Any) -> Any:
        vector = np.asarray(state.state_vector, dtype=np.float64)
        if vector.shape[1] == 1:
            return StateVector(model.at(vector[:, 0])[0].copy())
        return StateVectors(model.through(vector.T).T)

    class Motion(GaussianTransitionModel, TimeInvariantModel):  # type: ignore[misc] # Stone Soup has no types
        ndim_state = n

        def covar(self, **_: object) -> FloatArray:
            return problem.Q

        def function(self, state: Any, noise: object = False, **_: object) -> Any:
            return mapped(motion, state)

        def jacobian(self, state: Any, **_: object) -> FloatArray:
            return motion.at(np.asarray(state.state_vector, dtype=np.float64)[:, 0])[1]

    class Sight(NonLinearGaussianMeasurement):  # type: ignore[misc] # Stone Soup has no types
        @property
        def ndim_meas(self) -> int:
            return problem.variances.size

        def function(self, state: Any, noise: object = False, **_: object) -> Any:
            return mapped(sight, state)

        def jacobian(self, state: Any, **_: object) -> FloatArray:
            return sight.at(np.asarray(state.state_vector, dtype=np.float64)[:, 0])[1]

    return Motion(), Sight(ndim_state=n, mapping=tuple(range(n)), noise_covar=noise)


def _reset(peer: Any, problem: FilterProblem, *, column: bool = False) -> None:
    peer.x = problem.mean[:, None].copy() if column else problem.mean.copy()
    peer.P = problem.covariance.copy()
