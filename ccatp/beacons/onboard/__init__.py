"""The program on the computer of a robot among beacons: drivers of its devices, and the robot behind the link."""
