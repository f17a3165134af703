"""The daemon's processes: supervisor, main loop, danger loop, dashboard, and simulated servers.

``supervisor`` holds the process table; each process module has a ``main``.
"""
