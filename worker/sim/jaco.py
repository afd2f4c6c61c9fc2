"""The Jaco arm (j2s7s300: seven joints, spherical wrist): frames and joint limits follow the published description.

Link shapes are our own capsules. The arm is mounted beside the person's right knee.
"""

import math

from worker.sim.arm import Joint, RobotArm

PI = math.pi
TAU = 2 * math.pi

JACO = RobotArm(
    name="jaco",
    joints=(
        Joint("link_1", (0, 0, 0.15675), (0, PI, 0), -TAU, TAU, 0.7477, (0, 0.0016, -0.11875), 0.043),
        Joint("link_2", (0, 0.0016, -0.11875), (-PI / 2, 0, PI), 0.8203, 5.4629, 0.8447, (0, -0.205, 0), 0.042),
        Joint("link_3", (0, -0.205, 0), (-PI / 2, 0, 0), -TAU, TAU, 0.8447, (0, 0, -0.205), 0.042),
        Joint("link_4", (0, 0, -0.205), (PI / 2, 0, PI), 0.5236, 5.7596, 0.6763, (0, 0.2073, -0.0114), 0.036),
        Joint("link_5", (0, 0.2073, -0.0114), (-PI / 2, 0, PI), -TAU, TAU, 0.463, (0, 0, -0.10375), 0.033),
        Joint("link_6", (0, 0, -0.10375), (PI / 2, 0, PI), 1.1345, 5.1487, 0.463, (0, 0.10375, 0), 0.033),
        Joint("link_7", (0, 0.10375, 0), (-PI / 2, 0, PI), -TAU, TAU, 0.99, (0, 0, -0.10), 0.036),
    ),
    base_height_m=0.15,
    base_radius_m=0.055,
    hand_origin_m=(0, 0, -0.16),
    hand_rpy=(PI, 0, 0),
    mount_m=(-0.45, -0.55, 0.45),
    mount_rpy=(0.0, 0.0, -PI / 2),
)
