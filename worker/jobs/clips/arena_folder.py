"""Paired evaluations in RoboArena's layout as recordings: what policies did in one session may be compared.

evaluation_sessions/<session>/metadata.yaml, and for each policy a folder A_<name>, B_<name>, ... with a video per
camera and proprio_and_actions.npz (RoboArena, arXiv:2506.18123, and the card of its data dumps).
"""

import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from app.domain.studies import NAME_LENGTH
from app.services.archives import unpacking
from worker.domain.trajectory import Recording
from worker.domain.type_aliases import Float32Array, FloatArray
from worker.jobs.clips import derived_signals, plain_pickle
from worker.jobs.clips.own_clips import (
    FEWEST_STEPS,
    MOST_STEPS,
    Choices,
    ClipsInvalid,
    Material,
    OwnClip,
    Recordings,
    naming,
)
from worker.sim.render.video_cutting import cut_by_number

SESSIONS, METADATA = "evaluation_sessions", "metadata.yaml"
LARGEST_METADATA_BYTES, LARGEST_ARRAYS_BYTES = 1 << 20, 64 << 20
MOST_SESSIONS, MOST_POLICIES = 2000, 8
STATE, GRIPPER, ACTION = "cartesian_position", "gripper_position", "action"
"""Names in the arrays; the first is x, y, z in m and three angles in rad."""


class ArenaFolder(Recordings):
    """The sessions of one dump."""

    def __init__(self, root: Path, choices: Choices) -> None:
        """Raises ClipsInvalid."""
        self._root, self._choices = root.resolve(), choices
        if not 1 <= choices.rate_hz <= 240:
            raise ClipsInvalid("--rate: 1 to 240 steps per second are possible.")
        name = choices.name or self._root.name
        signals = derived_signals.signals(has_states=True, has_actions=True)
        self.material = Material(name[:NAME_LENGTH], choices.rate_hz, signals)

    @staticmethod
    def is_one(root: Path) -> bool:
        """Whether a folder has this layout."""
        return (root / SESSIONS).is_dir()

    def clips(self) -> Iterator[OwnClip]:
        """See Recordings."""
        sessions = [each for each in sorted((self._root / SESSIONS).iterdir()) if self._is_ours(each)]
        if not 1 <= len(sessions) <= MOST_SESSIONS:
            raise ClipsInvalid(f"{SESSIONS} has {len(sessions)} folders; 1 to {MOST_SESSIONS} make a study.")
        for scenario, session in enumerate(sessions):
            said = self._metadata(session)
            folders = [each for each in sorted(session.iterdir()) if self._is_ours(each)]
            if not 2 <= len(folders) <= MOST_POLICIES:
                raise ClipsInvalid(
                    f"{self._named(session)} has {len(folders)} folders of policies; 2 to {MOST_POLICIES} are "
                    "compared. Move the session elsewhere to leave it out."
                )
            for folder in folders:
                yield self._clip(folder, said, scenario)

    def _is_ours(self, path: Path) -> bool:
        """A folder that is no way out of this one."""
        return path.is_dir() and not path.is_symlink() and not path.name.startswith(".")

    def _named(self, path: Path) -> str:
        return str(path.relative_to(self._root))

    def _read(self, path: Path, most_bytes: int) -> bytes:
        if path.is_symlink() or not path.is_file():
            raise ClipsInvalid(f"There is no file {self._named(path)}.")
        if path.stat().st_size > most_bytes:
            raise ClipsInvalid(f"{self._named(path)} is larger than {most_bytes / 1e6:.0f} MB.")
        return path.read_bytes()

    def _metadata(self, session: Path) -> Mapping[str, Any]:
        path = session / METADATA
        content = self._read(path, LARGEST_METADATA_BYTES)
        with naming(self._named(path), yaml.YAMLError, ValueError, RecursionError):
            said = yaml.safe_load(content)
            if not isinstance(said, dict) or not isinstance(said.get("policies"), dict):
                raise ValueError("it has no policies")
            return said

    def _clip(self, folder: Path, said: Mapping[str, Any], scenario: int) -> OwnClip:
        letter = folder.name.partition("_")[0]
        policy = said["policies"].get(letter)
        if not isinstance(policy, dict):
            raise ClipsInvalid(f"{self._named(folder.parent / METADATA)}: says nothing about policy {letter[:20]!r}.")
        arrays = self._one(folder, "*.npz", "")
        content = self._read(arrays, LARGEST_ARRAYS_BYTES)
        with naming(self._named(arrays), ValueError, MemoryError, *unpacking.UNREADABLE):
            recording = _recording(content, policy, self._choices.rate_hz)
        video = self._one(folder, "*.mp4", self._choices.camera or "")
        with naming(self._named(video), ValueError):
            shown = cut_by_number(video, len(recording), self._choices.rate_hz)
        return OwnClip(scenario, recording, shown, _origin(said, policy, folder, video))

    def _one(self, folder: Path, pattern: str, camera: str) -> Path:
        found = sorted(folder.glob(pattern))
        chosen = [each for each in found if camera in each.stem.removeprefix(folder.name)]
        exact = [each for each in chosen if each.stem == camera or each.stem.endswith(f"_{camera}")]
        fitting = exact if len(exact) == 1 else chosen
        if len(fitting) == 1 and not fitting[0].is_symlink():
            return fitting[0]
        names = ", ".join(each.stem for each in found[:20]) or "none"
        advice = " Say which camera is shown, with --camera." if pattern == "*.mp4" else ""
        raise ClipsInvalid(f"{self._named(folder)} has not one {pattern} that fits, but: {names}.{advice}")


def _origin(said: Mapping[str, Any], policy: Mapping[str, Any], folder: Path, video: Path) -> dict[str, str]:
    """Whose it was stays with the experimenters; participants see clips without names."""
    task = str(said.get("language_instruction") or "")[:100]
    name = str(policy.get("policy_name") or folder.name)[:60]
    progress = policy.get("partial_success")
    reached = f", progress {progress:g}" if isinstance(progress, int | float) else ""
    origin = {"session": folder.parent.name, "policy": name, "camera": video.stem}
    return {**origin, "label": f"{name}: {task}{reached}"}


def _recording(content: bytes, policy: Mapping[str, Any], rate_hz: int) -> Recording:
    columns = _columns(content)
    steps = len(columns[ACTION])
    if not FEWEST_STEPS <= steps <= MOST_STEPS:
        raise ValueError(f"{steps} steps, expected {FEWEST_STEPS} to {MOST_STEPS}")
    tip, actions = columns[STATE], columns[ACTION]
    states = np.concatenate([tip, columns[GRIPPER]], axis=1) if GRIPPER in columns else tip
    succeeded = policy.get("binary_success", policy.get("partial_success") == 1)
    # Speeds are those of the tip: angles are not of one kind with metres.
    signals = derived_signals.of_steps(tip[:, :3], actions, rate_hz)
    return Recording(signals, np.concatenate([states, states[-1:]]), actions, bool(succeeded))


def _columns(content: bytes) -> dict[str, Float32Array]:
    """(T, N) by name, from arrays or from an array of dictionaries."""
    with unpacking.opened(io.BytesIO(content), LARGEST_ARRAYS_BYTES) as archive:
        if "data.npy" in archive.namelist():
            rows = plain_pickle.rows(unpacking.content(archive, "data.npy", LARGEST_ARRAYS_BYTES))
            return {name: found for name in (STATE, GRIPPER, ACTION) if (found := _stacked(rows, name)) is not None}
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        names = [each for each in (STATE, GRIPPER, ACTION) if each in stored or each != GRIPPER]
        arrays = {each: np.asarray(stored[each], np.float32) for each in names}
    lengths = {len(each) for each in arrays.values()}
    if len(lengths) != 1:
        raise ValueError(f"arrays of different lengths: {sorted(lengths)}")
    return {name: each.reshape(len(each), -1) for name, each in arrays.items()}


def _stacked(rows: Sequence[Mapping[str, FloatArray]], name: str) -> Float32Array | None:
    if name == GRIPPER and not all(name in row for row in rows):
        return None
    missing = next((step for step, row in enumerate(rows) if name not in row), None)
    if missing is not None:
        raise ValueError(f"{name} is missing or no number at step {missing}")
    if len({row[name].shape for row in rows}) > 1:
        raise ValueError(f"{name} has not as many numbers at every step")
    return np.array([row[name] for row in rows], np.float32).reshape(len(rows), -1)
