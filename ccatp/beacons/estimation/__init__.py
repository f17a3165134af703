"""Radio SLAM: range, bearing and signal-strength measurements to beacons whose positions are estimated too.

``range_slam`` and ``signal_slam`` are causal, ``batch_smoother`` uses a whole recording.
"""
