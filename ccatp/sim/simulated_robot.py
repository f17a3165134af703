"""What every simulated robot is: a robot behind the real link, and a source of its true state."""

from ccatp.onboard.rules import LinkedRobot
from ccatp.sim.ground_truth import TruthSource


class SimulatedRobot(LinkedRobot, TruthSource):
    """Base of the simulated robots."""
