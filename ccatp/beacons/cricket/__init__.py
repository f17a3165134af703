"""Self-mapping of ultrasonic motes from the ranges between them.

``self_mapping`` is the extended Kalman filter of the source, ``mote_map`` the batch map.
"""
