"""Run one episode with any policy and keep everything about it."""

import numpy as np

from worker.domain.trajectory import COSTS, SIGNALS, Trajectory
from worker.domain.type_aliases import Act
from worker.sim.assistive import AssistiveEnv


def rollout(env: AssistiveEnv, act: Act, scenario: int, reference: Act | None = None) -> Trajectory:
    """One whole episode. Whoever draws actions at random brings its own generator inside ``act``.

    ``reference`` gives the frozen policy's means in the same states, (T, D) -> (T, 7); without it the executed actions
    stand in.
    """
    observation, _ = env.reset(seed=scenario)
    observations, joints, particles = [observation], [env.joint_positions], [env.particles]
    heads, arms, targets = [env.head_quaternion], [env.arm_positions_rad], [env.target_m]
    actions, signals, costs, rewards, forces = [], [], [], [], []
    over = False
    while not over:
        action = np.clip(np.asarray(act(observation), np.float32), -1.0, 1.0)
        observation, reward, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        actions.append(action)
        observations.append(observation)
        joints.append(env.joint_positions)
        particles.append(env.particles)
        heads.append(env.head_quaternion)
        arms.append(env.arm_positions_rad)
        targets.append(env.target_m)
        signals.append([info["signals"][name] for name in SIGNALS])
        costs.append([info["costs"][name] for name in COSTS])
        rewards.append(reward)
        forces.append(info["contact_force_n"])
    seen, executed = np.array(observations, np.float32), np.array(actions, np.float32)
    return Trajectory(
        observations=seen,
        actions=executed,
        reference_actions=executed if reference is None else reference(seen[:-1]),
        signals=np.array(signals, np.float32),
        costs=np.array(costs, np.float32),
        task_rewards=np.array(rewards, np.float32),
        joint_positions=np.array(joints, np.float32),
        particles=np.array(particles, np.float32),
        head_quaternions=np.array(heads, np.float32),
        arm_positions_rad=np.array(arms, np.float32),
        target_m=np.array(targets, np.float32),
        contact_force_n=np.array(forces, np.float32),
        success=env.success,
        scenario=scenario,
        task=env.task.name,
        body=env.person.body.name,
        skin_tone=env.person.skin_tone,
    )
