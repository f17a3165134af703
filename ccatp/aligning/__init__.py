"""Pure. How the panels lie, from the fixes of a survey: fits, outliers, adjuster moves, half-wavefront error.

Imports ``mirror`` and ``config``; knows neither the run directory (``ccatp.run_files``) nor the simulated truth,
which may be handed to it for a comparison.
"""
