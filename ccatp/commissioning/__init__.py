"""Preflight checks, calibration of the vehicle, and conformance checks of a robot-link server.

Used by ``ccatp check``, ``ccatp calibrate`` and ``ccatp conformance``.
"""
