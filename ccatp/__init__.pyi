from ccatp.analysis.run import open_run as open_run

__version__: str
__all__ = ["__version__", "open_run"]
