"""``MUJOCO_GL=egl python -m tools.physics_picture`` draws docs/measurements/physics.png: robot and forces on M2.

Up in the picture is against gravity. White: weight; orange: thrust; green: what each contact gives. 10 N are 40 mm. The
lines on the mirror are 100 mm apart.
"""

from pathlib import Path

import mujoco
import numpy as np
from matplotlib.image import imsave

from ccatp.config.load import load_config
from ccatp.core import GRAVITY_M_S2, FloatArray
from ccatp.mirror.mirror import build_mirror
from ccatp.sim.hardware import MOTOR_12V
from ccatp.sim.physics import PhysicsPlant

M_PER_N = 0.004
GRID_M = 0.1
WHITE, ORANGE, GREEN = (0.95, 0.95, 1.0, 1.0), (1.0, 0.55, 0.1, 1.0), (0.2, 0.8, 0.35, 1.0)
DARK = 0.2, 0.25, 0.35, 1.0
SIZE = 480, 640  # the framebuffer of a model that does not ask for more


def arrow(scene: mujoco.MjvScene, start: FloatArray, force_n: FloatArray, colour: tuple[float, ...]) -> None:
    """A force that acts at ``start``."""
    geom = scene.geoms[scene.ngeom]
    kind = mujoco.mjtGeom.mjGEOM_ARROW
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.array(colour, dtype=np.float32))
    mujoco.mjv_connector(geom, kind, 0.004, start, start + M_PER_N * force_n)
    scene.ngeom += 1


def line(scene: mujoco.MjvScene, start: FloatArray, end: FloatArray) -> None:
    """On the mirror."""
    geom = scene.geoms[scene.ngeom]
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.array(DARK, dtype=np.float32))
    mujoco.mjv_connector(geom, kind, 0.001, start, end)
    scene.ngeom += 1


def main() -> None:
    """Draw it."""
    cfg = load_config(overrides={"run.mirror": "fyst-m2", "sim.physics.tyre": "flat"})
    mirror = build_mirror(cfg.mirror)
    plant = PhysicsPlant(cfg, mirror, mirror.base_pose, MOTOR_12V, 0.002)
    plant.thrust_n = cfg.robot.thrust_n
    for _ in range(500):
        plant.step(0.0, 0.002, 0.0, 0.0)
    model, data = plant._model, plant._data
    model.geom_rgba[:] = 0.85, 0.87, 0.9, 0.55
    model.geom_rgba[0] = 0.45, 0.55, 0.7, 1.0
    model.vis.headlight.ambient[:] = 0.45
    gravity, normal = np.array(mirror.gravity_deck), data.xmat[1].reshape(3, 3)[:, 2]
    centre = data.xipos[1].copy()
    with mujoco.Renderer(model, *SIZE) as renderer:
        renderer.update_scene(data)
        scene = renderer.scene
        arrow(scene, centre, cfg.sim.physics.mass_kg * GRAVITY_M_S2 * gravity, WHITE)
        arrow(scene, centre + M_PER_N * plant.thrust_n * normal, -plant.thrust_n * normal, ORANGE)
        for k, contact in enumerate(data.contact):
            force = np.zeros(6)
            mujoco.mj_contactForce(model, data, k, force)
            arrow(scene, contact.pos, contact.frame.reshape(3, 3).T @ force[:3], GREEN)
        ahead, left = data.xmat[1].reshape(3, 3)[:, 0], data.xmat[1].reshape(3, 3)[:, 1]
        foot = data.xpos[1].copy()
        for k in range(-6, 7):
            for along, across in ((ahead, left), (left, ahead)):
                middle = foot + k * GRID_M * across
                line(scene, middle - 6.0 * GRID_M * along, middle + 6.0 * GRID_M * along)
        side = np.cross(gravity, normal)
        eye = centre + 0.22 * normal + 0.42 * side / np.linalg.norm(side) - 0.1 * gravity
        forward = (centre + 0.06 * normal - eye) / np.linalg.norm(centre + 0.06 * normal - eye)
        up = -gravity + (gravity @ forward) * forward
        for camera in scene.camera:
            camera.pos, camera.forward, camera.up = eye, forward, up / np.linalg.norm(up)
        imsave(Path("docs") / "measurements" / "physics.png", renderer.render())


if __name__ == "__main__":
    main()
