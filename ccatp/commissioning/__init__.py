"""Before a mission: preflight checks, calibration of the vehicle, and conformance of a robot-link server.

Used by ``ccatp check``, ``ccatp calibrate`` and ``ccatp conformance``.
"""
