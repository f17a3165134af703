"""The processes that serve a robot or a laser system: main loop, danger loop, and the simulated servers."""
