"""Estimation of the robot's pose on the mirror: the thesis's localizer and the full-state estimator.

``ccatp.localizer`` chooses between them. Imports nothing of ``ccatp.safety``: the two processes must not share a fault.
"""
