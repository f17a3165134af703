"""The robot's pose on the mirror: thesis localizer and full-state estimator. Imports nothing of ``ccatp.safety``."""
