"""The devices of a robot whose computer runs Linux: inertial unit, data acquisition device, motors, fans, timer."""
