"""Self-mapping of ultrasonic motes from the ranges between them.

``self_mapping`` is the extended Kalman filter of Patil et al., ``mote_map`` computes a batch map.
"""
