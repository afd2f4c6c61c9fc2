"""Poses between control steps, the cameras, and which rectangles are drawn."""

import numpy as np
import pytest

from app.installed_tasks import catalogue
from tests.worker.waving import MOUNT, itching_trajectory, waving_trajectory
from worker.domain.trajectory import Trajectory
from worker.sim.human import BROAD, LEFT, RIGHT
from worker.sim.jaco import JACO
from worker.sim.render.camera import lamp, scene_camera
from worker.sim.render.interpolation import STILL_M, ClipMotion, clip_motion, quaternions, smoothly
from worker.sim.render.rectangles import GRID_PX, cover, on_grid
from worker.sim.render.task_look import TaskLook
from worker.tasks.feeding.environment import SPOON
from worker.tasks.registry import look

MOUTH_M = np.array(BROAD.neck_pivot_m) + BROAD.mouth_from_neck_m


def motion_of(trajectory: Trajectory, first: int, count: int, fps: int = 15) -> ClipMotion:
    return clip_motion(trajectory, JACO, SPOON, first, count, fps)


def test_a_clip_has_one_and_a_half_frames_per_control_step_at_fifteen_frames_per_second() -> None:
    assert len(motion_of(waving_trajectory(20), 4, 10)) == 15


def test_frames_at_control_steps_show_exactly_the_recorded_joints() -> None:
    trajectory = waving_trajectory(20)
    motion = motion_of(trajectory, 2, 10, 20)
    recorded = JACO.link_frames(trajectory.joint_positions[2:12].astype(float), SPOON)
    assert motion.frames[::2] == pytest.approx(MOUNT @ recorded)


def test_velocity_has_no_kinks_at_control_steps() -> None:
    values = np.sin(np.arange(12) * 0.7)[:, None]
    place = 5.0 + np.array([-2e-4, -1e-4, 1e-4, 2e-4])
    before, _, after = np.diff(smoothly(values, place)[:, 0])
    assert before == pytest.approx(after, rel=1e-2)


def test_steady_motion_stays_steady() -> None:
    values = np.arange(10.0)[:, None]
    place = np.linspace(1, 8, 57)
    assert smoothly(values, place)[:, 0] == pytest.approx(place)


def test_food_that_was_eaten_goes_on_into_the_mouth_and_is_gone() -> None:
    trajectory = waving_trajectory(20)
    trajectory.particles[:10, 3] = MOUTH_M + np.array([0.0, -0.03, 0.0])
    trajectory.particles[10:, 3] = np.nan
    food = motion_of(trajectory, 0, 20).particles_m[:, 3]
    depth = food[:, 1] - MOUTH_M[1]
    assert depth[:14] == pytest.approx(-0.03)
    assert depth[14:16].tolist() == sorted(depth[14:16])
    assert depth[16] > 0.01
    assert np.isnan(depth[18:]).all()


def test_food_lost_far_from_the_mouth_just_disappears() -> None:
    trajectory = waving_trajectory(20)
    trajectory.particles[10:, 3] = np.nan
    gone = np.isnan(motion_of(trajectory, 0, 20).particles_m[:, 3, 0])
    assert not gone[:14].any()
    assert gone[14:].all()


def test_what_stands_still_is_drawn_once_and_what_creeps_again_when_it_has_moved_visibly() -> None:
    standing, creeping = waving_trajectory(20), waving_trajectory(20)
    for trajectory in (standing, creeping):
        trajectory.joint_positions[6:] = trajectory.joint_positions[6]
        trajectory.contact_force_n[:] = 0.0
        trajectory.particles[:] = np.nan
    creeping.target_m[10:] += np.linspace(0.0, 2.2 * STILL_M, 11)[:, None]
    motion = motion_of(standing, 8, 12)
    assert motion.stretches() == [range(len(motion))]
    crept = motion_of(creeping, 8, 12)
    assert len(crept.stretches()) == 3
    for stretch in crept.stretches():
        assert np.abs(crept.target_m[stretch] - crept.target_m[stretch.start]).max() <= STILL_M


def test_every_frame_of_a_moving_arm_is_drawn() -> None:
    motion = motion_of(waving_trajectory(20), 4, 10)
    assert [len(each) for each in motion.stretches()] == [1] * len(motion)


def test_food_that_is_gone_is_seen_to_go_from_a_robot_that_stands_still() -> None:
    trajectory = waving_trajectory(20)
    trajectory.joint_positions[:] = trajectory.joint_positions[0]
    trajectory.particles[:] = trajectory.particles[0]
    trajectory.particles[10:, 3] = np.nan
    assert len(motion_of(trajectory, 0, 20).stretches()) == 2


@pytest.mark.parametrize(("first", "count"), [(-1, 5), (0, 0), (15, 6)])
def test_steps_outside_the_trajectory_are_refused(first: int, count: int) -> None:
    with pytest.raises(ValueError, match="not within a trajectory of 20 steps"):
        motion_of(waving_trajectory(20), first, count)


def test_a_head_whose_quaternion_changes_its_sign_does_not_spin() -> None:
    trajectory = waving_trajectory(10)
    trajectory.head_quaternions[5:] *= -1.0
    assert not motion_of(trajectory, 0, 10).head_moves


def test_only_the_arm_that_turns_is_said_to_move() -> None:
    motion = motion_of(itching_trajectory(10, lift_rad=0.05), 0, 10)
    assert motion.arm_moves(RIGHT)
    assert not motion.arm_moves(LEFT)


def test_quaternions_turn_vectors_like_their_matrices() -> None:
    rng = np.random.default_rng(1)
    lanes = np.linalg.qr(rng.normal(size=(200, 3, 3)))[0]
    lanes *= np.sign(np.linalg.det(lanes))[:, None, None]
    x, y, z, w = quaternions(lanes).T
    vector = rng.normal(size=3)
    pure = np.stack([x, y, z], axis=-1)
    doubled = 2 * np.cross(pure, vector)
    assert vector + w[:, None] * doubled + np.cross(pure, doubled) == pytest.approx(lanes @ vector)


def test_a_cropped_picture_shows_the_same_points_as_the_whole() -> None:
    camera = scene_camera(look("feeding"), 640, 480)
    rectangle = (100.0, 60.0, 260.0, 180.0)
    point = np.array([0.0, -0.07, 1.2, 1.0])
    device = camera.projection(rectangle) @ camera.view @ point
    inside = (device[:2] / device[3] * [1, -1] + 1) / 2 * [160, 120]
    assert np.array([100, 60]) + inside == pytest.approx(camera.pixels(point[:3]))


def test_the_person_and_the_spoons_whole_path_are_in_the_picture() -> None:
    camera = scene_camera(look("feeding"), 640, 480)
    pixels = camera.pixels(np.array([[-0.23, -0.55, 1.0], [-0.13, -0.45, 1.10], [0.0, -0.07, 1.2], [0.0, 0.05, 1.38]]))
    assert (pixels > 0).all()
    assert (pixels < [640, 480]).all()


def test_a_task_nobody_designed_a_look_for_is_filmed_like_feeding() -> None:
    cameras = {scene_camera(each, 640, 480) for each in (TaskLook(), look("feeding"))}
    assert len(cameras) == 1
    assert len({look(name) for name in catalogue.names()}) == 3


def test_the_lamp_sees_the_head_and_the_floor_below_the_arm() -> None:
    pixels = lamp(100).pixels(np.array([[0.0, 0.0, 1.35], [-0.45, -0.55, 0.0], [-0.45, -0.55, 1.2]]))
    assert (pixels > 0).all()
    assert (pixels < 100).all()


def test_rectangles_hold_every_box_and_lie_on_the_grid() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        corner, size = rng.uniform(-20, 640, (6, 2)), rng.uniform(4, 120, (6, 2))
        boxes = np.clip(np.concatenate([corner, corner + size], axis=1), 0, [640, 480, 640, 480])
        boxes = boxes[((boxes[:, 2:] - boxes[:, :2]) > 1).all(axis=1)]
        rectangles = cover(boxes, 640, 480)
        assert len(rectangles) <= 2
        assert all(value % GRID_PX == 0 for rectangle in rectangles for value in rectangle)
        canvas = np.zeros((480, 640), dtype=bool)
        for left, top, right, bottom in rectangles:
            canvas[top:bottom, left:right] = True
        for left, top, right, bottom in boxes.astype(int):
            assert canvas[top:bottom, left:right].all()


def test_far_apart_boxes_are_drawn_apart() -> None:
    boxes = np.array([[0.0, 0.0, 40.0, 40.0], [600.0, 440.0, 640.0, 480.0]])
    drawn = sum((r - left) * (b - t) for left, t, r, b in cover(boxes, 640, 480))
    assert drawn == 2 * 40 * 40


def test_nothing_moving_in_the_picture_means_nothing_to_draw() -> None:
    assert cover(np.array([[-50.0, -50.0, -10.0, -10.0]]), 640, 480) == []


def test_a_box_on_the_grid_is_the_smallest_one() -> None:
    assert on_grid(np.array([5.0, 4.0, 8.0, 9.0]), 640, 480) == (4, 4, 8, 12)
