"""Indoor robots among beacons: radio SLAM, ultrasonic self-mapping, missions and driving.

``mission`` runs a mission, ``slam`` and ``cricket`` estimate, ``datasets`` reads recordings.
"""
