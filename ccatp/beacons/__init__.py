"""Indoor robots among beacons: radio SLAM, ultrasonic self-mapping, their missions and driving.

``mission`` runs a mission, ``slam`` and ``cricket`` estimate, ``datasets`` reads recordings.
"""
