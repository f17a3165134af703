"""Geometry of a telescope mirror, the puck from lengths, the laser network, and the alignment of the panels. Pure.

Frames:

* *world*: inertial, origin at the intersection of the M1 boresight axis and the M2 elevation axis; z is the direction
  in which light enters: down when the telescope points to the zenith.
* *mirror*: the frame in which thesis eq. 1.1 is written; p_mirror = R (p_world - origin).
* *deck*: the mirror frame, turned by pi about y if the robot drives on the -z side (M1). +z is the drive side, +x
  the direction of increasing column, +y of increasing row. Maps, plans and the truth use its (x, y) projection.
* *panel*: origin on the surface at the panel's centre, axes (e1, n x e1, n) of the tangent frame there.
* *robot*: origin between the wheels on the surface, x along the heading, y to the left, z along the normal.
"""
