from ccatp.analysis.run import open_run as open_run
from ccatp.analysis.simulation import simulate as simulate

__version__: str
__all__ = ["__version__", "open_run", "simulate"]
