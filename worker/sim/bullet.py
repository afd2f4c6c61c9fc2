"""The physics engine: a private client that is stepped, bodies by name, SI units, xyzw quaternions.

One `Bullet` is one DIRECT client. Renderers open clients of their own (drawing).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim.engine import pybullet
from worker.sim.geometry import IDENTITY, Shape, Vector

GRAVITY_M_S2 = 9.81
CONTACT_MARGIN_M = 0.001
"""Boxes of bodies that are further apart are not compared. The engine's own 2 cm would pair every pellet in a cup with
every other; and because it is one number for the whole process, all worlds must agree on it."""
CARRIER_MASS_KG = 1000.0
MOST_REMOVED = 100
"""Of a removed person, some 20 kB stay behind."""

_SHAPES = {"sphere": pybullet.GEOM_SPHERE, "capsule": pybullet.GEOM_CAPSULE, "box": pybullet.GEOM_BOX}
_JOINTS = {"revolute": pybullet.JOINT_REVOLUTE, "fixed": pybullet.JOINT_FIXED}


class Contact(NamedTuple):
    """One contact point between a queried body and another one."""

    other: str
    position_m: tuple[float, float, float]
    normal_force_n: float


@dataclass(frozen=True)
class Link:
    """One link of a chain; its frame is its joint's frame."""

    name: str
    origin_m: tuple[float, float, float]
    """in the previous link's frame"""
    quaternion: tuple[float, float, float, float]
    mass_kg: float
    shapes: tuple[Shape, ...]
    joint: Literal["revolute", "fixed"] = "revolute"
    """how it hangs on the previous link: turning about its axis, or not at all"""
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """of the joint, in its own frame"""
    centre_of_mass_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


class Bullet:
    """A physics client. Bodies are known by the name they were added with."""

    def __init__(
        self,
        time_step_s: float = 0.02,
        solver_iterations: int = 10,
        gravity_m_s2: float = GRAVITY_M_S2,
        forgetful: bool = False,
    ) -> None:
        """A forgetful world finds touching bodies without the engine's search tree, whose shape depends on the past.

        Once its bodies have been apart for one step, it goes on as if it were new. It takes 8 ms to clear.
        """
        self._client: int | None = pybullet.connect(pybullet.DIRECT)
        self._time_step_s, self._solver_iterations = time_step_s, solver_iterations
        self._gravity_m_s2 = gravity_m_s2
        self._reset_flags: int = pybullet.RESET_USE_SIMPLE_BROADPHASE if forgetful else 0
        self.clear()

    @property
    def client(self) -> int:
        """The engine's client number, for calls this class does not wrap. Raises RuntimeError after close()."""
        if self._client is None:
            raise RuntimeError("This simulation is closed; make a new one.")
        return self._client

    def close(self) -> None:
        """Disconnect. Closing twice is fine."""
        if self._client is not None and pybullet.isConnected(self._client):
            pybullet.disconnect(self._client)
        self._client = None

    # Building the world

    def clear(self) -> None:
        """Remove everything and forget all history: what is built next behaves as in a fresh process."""
        pybullet.resetSimulation(self._reset_flags, physicsClientId=self.client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self._time_step_s,
            numSolverIterations=self._solver_iterations,
            deterministicOverlappingPairs=1,
            contactBreakingThreshold=CONTACT_MARGIN_M,
            physicsClientId=self.client,
        )
        pybullet.setGravity(0.0, 0.0, -self._gravity_m_s2, physicsClientId=self.client)
        self._removed = 0
        self._bodies: dict[str, int] = {}
        self._names: dict[int, str] = {}
        self._links: dict[str, dict[str, int]] = {}
        # Without a visual the engine tessellates each collision shape, which takes longer than the rest of adding it. A
        # triangle would be a little quicker than a box, but the engine never frees a mesh that was given as numbers.
        self._unseen: int = pybullet.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=[0.001, 0.001, 0.001], physicsClientId=self.client
        )

    @property
    def littered(self) -> bool:
        """Whether to clear this world now and then: what the engine keeps of removed bodies, it keeps until clear()."""
        return self._removed >= MOST_REMOVED

    def add_body(
        self,
        name: str,
        shapes: tuple[Shape, ...],
        position_m: Vector = (0, 0, 0),
        quaternion: Vector = IDENTITY,
    ) -> None:
        """Add an immovable body made of primitives."""
        body = pybullet.createMultiBody(
            0.0,
            self._collision(shapes),
            self._unseen,
            list(position_m),
            list(quaternion),
            physicsClientId=self.client,
        )
        self._register(name, body, ())

    def add_balls(
        self, names: Sequence[str], radius_m: float, mass_kg: float, positions_m: FloatArray, plain: bool = False
    ) -> None:
        """Add equal free balls, one per row of positions (N, 3).

        Contacts of plain bodies with each other cost a third of those with chains, where each contact solves for the
        whole chain. Put what they lie in on a carrier.
        """
        bodies = pybullet.createMultiBody(
            mass_kg,
            self._collision((Shape("sphere", radius_m),)),
            self._unseen,
            batchPositions=np.asarray(positions_m, float).tolist(),
            useMaximalCoordinates=plain,
            physicsClientId=self.client,
        )
        for name, body in zip(names, bodies, strict=True):
            self._register(name, body, ())

    def add_carrier(self, name: str, shapes: tuple[Shape, ...], position_m: Vector, quaternion: Vector) -> None:
        """Add a plain body so heavy that nothing it carries moves it; lead it along with carry()."""
        body = pybullet.createMultiBody(
            CARRIER_MASS_KG,
            self._collision(shapes),
            self._unseen,
            list(position_m),
            list(quaternion),
            useMaximalCoordinates=True,
            physicsClientId=self.client,
        )
        self._register(name, body, ())

    def remove(self, name: str) -> None:
        """Take a body out of the world; whoever asks where it is gets a KeyError."""
        body = self._bodies.pop(name)
        pybullet.removeBody(body, physicsClientId=self.client)
        del self._names[body], self._links[name]
        self._removed += 1

    def add_chain(
        self,
        name: str,
        base: tuple[Shape, ...],
        links: Sequence[Link],
        position_m: Vector = (0, 0, 0),
        quaternion: Vector = IDENTITY,
    ) -> None:
        """Add a chain on a fixed base: each link hangs on the one before it."""
        count = len(links)
        body = pybullet.createMultiBody(
            0.0,
            self._collision(base),
            self._unseen,
            list(position_m),
            list(quaternion),
            linkMasses=[link.mass_kg for link in links],
            linkCollisionShapeIndices=[self._collision(link.shapes) for link in links],
            linkVisualShapeIndices=[self._unseen] * count,
            linkPositions=[list(link.origin_m) for link in links],
            linkOrientations=[list(link.quaternion) for link in links],
            linkInertialFramePositions=[list(link.centre_of_mass_m) for link in links],
            linkInertialFrameOrientations=[list(IDENTITY)] * count,
            linkParentIndices=list(range(count)),
            linkJointTypes=[_JOINTS[link.joint] for link in links],
            linkJointAxis=[list(link.axis) for link in links],
            physicsClientId=self.client,
        )
        self._register(name, body, [link.name for link in links])

    def set_material(self, name: str, link: str | None = None, friction: float = 0.6, restitution: float = 0.0) -> None:
        """Friction and bounciness of a body's base or of one link."""
        pybullet.changeDynamics(
            self._bodies[name],
            self._link(name, link),
            lateralFriction=friction,
            restitution=restitution,
            physicsClientId=self.client,
        )

    def set_layer(self, name: str, link: str | None, own: int, meets: int) -> None:
        """Let a body's base or one link collide only where the one's ``meets`` has a bit of the other's ``own``.

        Either of two suffices. Without this call the immovable are 2 and meet all but 2, the others are 1 and meet all.
        """
        pybullet.setCollisionFilterGroupMask(
            self._bodies[name], self._link(name, link), own, meets, physicsClientId=self.client
        )

    def soften(self, name: str, link: str | None, stiffness_n_m: float, damping_n_s_m: float) -> None:
        """Let others sink into a body's base or one link, as into skin."""
        pybullet.changeDynamics(
            self._bodies[name],
            self._link(name, link),
            contactStiffness=stiffness_n_m,
            contactDamping=damping_n_s_m,
            physicsClientId=self.client,
        )

    def set_pose(self, name: str, position_m: Vector, quaternion: Vector = IDENTITY) -> None:
        """Teleport a body and stop it."""
        body = self._bodies[name]
        pybullet.resetBasePositionAndOrientation(body, position_m, quaternion, physicsClientId=self.client)
        pybullet.resetBaseVelocity(body, (0, 0, 0), (0, 0, 0), physicsClientId=self.client)

    def has(self, name: str) -> bool:
        """Whether there is a body of this name."""
        return name in self._bodies

    def carry(self, carrier: str, name: str, link: str) -> tuple[FloatArray, FloatArray]:
        """Put a carrier where a link is and let it move on as the link does, against its own weight.

        Answers like link_pose().
        """
        state = pybullet.getLinkState(
            self._bodies[name],
            self._link(name, link),
            computeLinkVelocity=1,
            computeForwardKinematics=1,
            physicsClientId=self.client,
        )
        body, (x, y, z) = self._bodies[carrier], state[6]
        pybullet.resetBasePositionAndOrientation(body, state[4], state[5], physicsClientId=self.client)
        upwards = z + self._gravity_m_s2 * self._time_step_s
        pybullet.resetBaseVelocity(body, (x, y, upwards), state[7], physicsClientId=self.client)
        return np.array(state[4]), np.array(state[5])

    def near(self, point_m: Vector, within_m: float) -> set[str]:
        """Bodies whose bounding boxes reach into the cube of this half edge about a point."""
        x, y, z = point_m
        low, high = (x - within_m, y - within_m, z - within_m), (x + within_m, y + within_m, z + within_m)
        found = pybullet.getOverlappingObjects(low, high, physicsClientId=self.client)
        return {self._names[body] for body, _ in found or ()}

    def position(self, name: str) -> tuple[float, float, float]:
        """Where a body's base is."""
        place: tuple[float, float, float] = pybullet.getBasePositionAndOrientation(
            self._bodies[name], physicsClientId=self.client
        )[0]
        return place

    def positions(self, names: Sequence[str]) -> FloatArray:
        """Where several bodies' bases are, (N, 3)."""
        client, bodies, where = self.client, self._bodies, pybullet.getBasePositionAndOrientation
        return np.array([where(bodies[name], physicsClientId=client)[0] for name in names])

    def velocity(self, name: str) -> tuple[float, float, float]:
        """Linear velocity of a body's base."""
        speed: tuple[float, float, float] = pybullet.getBaseVelocity(self._bodies[name], physicsClientId=self.client)[0]
        return speed

    def set_joints(self, name: str, angles_rad: Vector) -> None:
        """Put the first joints of a robot at these angles, at rest."""
        pybullet.resetJointStatesMultiDof(
            self._bodies[name],
            range(len(angles_rad)),
            [[angle] for angle in angles_rad],
            [[0.0]] * len(angles_rad),
            physicsClientId=self.client,
        )

    def joints(self, name: str, count: int) -> FloatArray:
        """Angles of the first ``count`` joints in rad."""
        states = pybullet.getJointStates(self._bodies[name], range(count), physicsClientId=self.client)
        return np.array([state[0] for state in states])

    def drive_joints(self, name: str, angles_rad: Vector, gain: float, force_nm: float) -> None:
        """Set the position target of the first joints."""
        count = len(angles_rad)
        pybullet.setJointMotorControlArray(
            self._bodies[name],
            range(count),
            pybullet.POSITION_CONTROL,
            targetPositions=np.asarray(angles_rad).tolist(),
            positionGains=[gain] * count,
            velocityGains=[1.0] * count,
            forces=[force_nm] * count,
            physicsClientId=self.client,
        )

    def release_joints(self, name: str, count: int) -> None:
        """Switch off the brakes that the engine puts on the first joints of a chain."""
        pybullet.setJointMotorControlArray(
            self._bodies[name],
            range(count),
            pybullet.VELOCITY_CONTROL,
            forces=[0.0] * count,
            physicsClientId=self.client,
        )

    def spring_joints(
        self, name: str, angles_rad: Vector, stiffness_nm_rad: float, damping_nm_s_rad: float, torque_nm: float
    ) -> None:
        """Hold the first joints of a chain, once released, by damped springs; call again to move where they rest."""
        count = len(angles_rad)
        pybullet.setJointMotorControlArray(
            self._bodies[name],
            range(count),
            pybullet.PD_CONTROL,
            targetPositions=angles_rad,
            targetVelocities=[0.0] * count,
            positionGains=[stiffness_nm_rad] * count,
            velocityGains=[damping_nm_s_rad] * count,
            forces=[torque_nm] * count,
            physicsClientId=self.client,
        )

    def link_pose(self, name: str, link: str) -> tuple[FloatArray, FloatArray]:
        """Origin (3,) and xyzw orientation (4,) of a link's frame in the world."""
        state = pybullet.getLinkState(
            self._bodies[name], self._link(name, link), computeForwardKinematics=1, physicsClientId=self.client
        )
        return np.array(state[4]), np.array(state[5])

    def link_velocity(self, name: str, link: str) -> tuple[float, float, float]:
        """Linear velocity of a link's centre of mass in the world."""
        velocity: tuple[float, float, float] = pybullet.getLinkState(
            self._bodies[name], self._link(name, link), computeLinkVelocity=1, physicsClientId=self.client
        )[6]
        return velocity

    # Stepping

    def step(self) -> None:
        """Advance by one physics step."""
        pybullet.stepSimulation(physicsClientId=self.client)

    def contacts(self, name: str) -> list[Contact]:
        """Everything that presses on a body since the last step, with the contact points on that body."""
        points = pybullet.getContactPoints(self._bodies[name], physicsClientId=self.client)
        return [Contact(self._names[point[2]], point[5], point[9]) for point in points or () if point[9] > 0.0]

    def clearance_m(self, name: str, other: str, within_m: float, skip_links: Sequence[str] = ()) -> float:
        """Smallest gap between two bodies, at most ``within_m``; negative when they overlap."""
        pybullet.performCollisionDetection(physicsClientId=self.client)
        skipped = {self._link(name, link) for link in skip_links}
        points = pybullet.getClosestPoints(
            self._bodies[name], self._bodies[other], within_m, physicsClientId=self.client
        )
        return min((point[8] for point in points if point[3] not in skipped), default=within_m)

    # Private

    def _register(self, name: str, body: int, links: Sequence[str]) -> None:
        if name in self._bodies:
            raise ValueError(f"There already is a body named {name!r}.")
        self._bodies[name], self._names[body] = body, name
        self._links[name] = {link: index for index, link in enumerate(links)}

    def _link(self, name: str, link: str | None) -> int:
        return -1 if link is None else self._links[name][link]

    def _collision(self, shapes: tuple[Shape, ...]) -> int:
        if not shapes:
            return -1
        collision: int = pybullet.createCollisionShapeArray(**_as_arrays(shapes), physicsClientId=self.client)
        return collision


@lru_cache(maxsize=256)
def _as_arrays(shapes: tuple[Shape, ...]) -> dict[str, Any]:
    """Shapes as the engine wants them, remembered because every reset builds the same links again."""
    return {
        "shapeTypes": [_SHAPES[shape.kind] for shape in shapes],
        "radii": [shape.radius_m for shape in shapes],
        "lengths": [shape.length_m for shape in shapes],
        "halfExtents": [list(shape.half_extents_m) for shape in shapes],
        "collisionFramePositions": [list(shape.position_m) for shape in shapes],
        "collisionFrameOrientations": [list(shape.quaternion) for shape in shapes],
    }
