"""The published form of a personal filter: one zip file that says what it is and proves that it is undamaged.

The same contents give the same bytes: fixed timestamps, sorted names, nothing of the machine it was written on.
"""

import hashlib
import io
import json
import platform
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

import numpy as np
from safetensors.numpy import save

from worker.domain.spaces import Space
from worker.domain.task import Task
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Float32Array
from worker.ml.export import filter_loop, forward_model, run_filter, serve_filter
from worker.ml.export.forward_model import ForwardModel
from worker.ml.export.interface import interface_of
from worker.ml.export.model_card import model_card
from worker.ml.filters.exported import shield
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.exported.filter_onnx import INPUTS, OUTPUT, SHIELD, OnnxFilter
from worker.ml.policies import policy_client
from worker.ml.policies.asked_policy import AskedPolicy
from worker.ml.policies.reference import ReferencePolicy
from worker.ml.policies.stored_policy import stored_policy
from worker.ml.rewards.reward_models import CLIP, RewardModel

SCHEMA_VERSION = 1
MANIFEST, SIGNATURE = "manifest.json", "signature.json"
LARGEST_BYTES = 256 << 20
"""Of all files of a bundle together; those written so far have a hundredth of it."""
_TIMESTAMP = (1980, 1, 1, 0, 0, 0)
_SCRIPTS = (run_filter, serve_filter, filter_loop, forward_model, policy_client)
_LIBRARIES = ("numpy", "onnx", "onnxruntime", "onnxscript", "safetensors", "torch")


class BundleDamaged(ValueError):
    """The bundle is not what was exported. Download it again."""


@dataclass(frozen=True)
class RecordedSteps:
    """Inputs of the filter during N control steps, for checking it elsewhere."""

    observations: Float32Array
    """(N, D)"""
    policy_means: Float32Array
    """(N, 7)"""

    @classmethod
    def of(cls, trajectories: Sequence[Trajectory]) -> Self:
        """Every step of these rollouts."""
        return cls(
            np.concatenate([each.observations[: len(each)] for each in trajectories]).astype(np.float32),
            np.concatenate([each.reference_actions for each in trajectories]).astype(np.float32),
        )


@dataclass(frozen=True)
class Provenance:
    """Where a filter comes from. Plain values; ``participant`` is a pseudonym such as P07."""

    study: str
    participant: str
    version: int
    label_count: int
    label_hash: str
    seed: int
    created_at: str
    """ISO 8601, UTC"""
    lock_hash: str
    deviations: str
    """fingerprint of the locked settings and plan, and what was changed afterwards, in words as in every export"""


@dataclass(frozen=True)
class BundleContents:
    """Everything that is published."""

    task: Task
    filter_onnx: bytes
    weights: FilterWeights
    reward: RewardModel
    policy: ReferencePolicy
    recording: RecordedSteps
    metrics: Mapping[str, Any]
    """Model.metrics of the filter; evaluation, notes and the reward model's weights are published"""
    provenance: Provenance
    forward_model: ForwardModel | None = None
    """of the evaluation's episodes"""


def write(contents: BundleContents) -> bytes:
    """The zip file."""
    exported = OnnxFilter(contents.filter_onnx)
    recording = contents.recording
    files = {
        "filter.onnx": contents.filter_onnx,
        **_policy_files(contents.policy),
        "reward_model.safetensors": contents.reward.to_bytes(),
        "action_encoder.safetensors": contents.weights.to_bytes(),
        **({forward_model.FILE: contents.forward_model.to_bytes()} if contents.forward_model else {}),
        **{Path(str(each.__file__)).name: Path(str(each.__file__)).read_bytes() for each in _SCRIPTS},
        "recorded/observations.npy": _npy(recording.observations),
        "recorded/policy_means.npy": _npy(recording.policy_means),
        "recorded/actions.npy": _npy(exported.batch(recording.observations, recording.policy_means)),
    }
    manifest = _manifest(contents)
    files["MODEL_CARD.md"] = model_card(manifest).encode()
    manifest["files"] = {
        name: {"bytes": len(stored), "sha256": _sha256(stored)} for name, stored in sorted(files.items())
    }
    files[MANIFEST] = (json.dumps(manifest, indent=2, sort_keys=True, allow_nan=False) + "\n").encode()
    return _zipped(files)


def signed(stored: bytes, sign: Callable[[Mapping[str, Any]], dict[str, Any]]) -> bytes:
    """The bundle with one file more: a signed document that names the hash of the manifest, and so of every file."""
    with zipfile.ZipFile(io.BytesIO(stored)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    document = sign({"format": run_filter.SIGNATURE_FORMAT, "manifest_sha256": _sha256(files[MANIFEST])})
    files[SIGNATURE] = (json.dumps(document, indent=2, sort_keys=True) + "\n").encode()
    return _zipped(files)


def verify(stored: bytes) -> dict[str, Any]:
    """The manifest of an undamaged bundle. Raises BundleDamaged when a file is missing, changed or was never listed."""
    try:
        with zipfile.ZipFile(io.BytesIO(stored)) as archive:
            if sum(each.file_size for each in archive.infolist()) > LARGEST_BYTES:
                raise BundleDamaged(f"{BundleDamaged.__doc__} It would unpack to far more than a bundle holds.")
            files = {name: archive.read(name) for name in archive.namelist()}
        manifest: dict[str, Any] = json.loads(files.pop(MANIFEST))
        listed: dict[str, dict[str, Any]] = manifest["files"]
        files.pop(SIGNATURE, None)  # whose key it is made with, run_filter.py and app.services.auditing.signatures say
    except (zipfile.BadZipFile, KeyError, ValueError) as error:
        raise BundleDamaged(f"{BundleDamaged.__doc__} ({error})") from error
    changed = [
        name
        for name, expected in listed.items()
        if name not in files or len(files[name]) != expected["bytes"] or _sha256(files[name]) != expected["sha256"]
    ]
    unlisted = sorted(set(files) - set(listed))
    if changed or unlisted:
        raise BundleDamaged(f"{BundleDamaged.__doc__} Affected: {', '.join(sorted(changed) + unlisted)}.")
    return manifest


def _policy_files(policy: ReferencePolicy) -> dict[str, bytes]:
    """None of a policy that answers from a server or is a function."""
    return {} if isinstance(policy, AskedPolicy) else {"policy.onnx": stored_policy(policy)}


def _manifest(contents: BundleContents) -> dict[str, Any]:
    """Everything but the list of files."""
    provenance, weights = contents.provenance, contents.weights
    return {
        "schema_version": SCHEMA_VERSION,
        "task": contents.task.name,
        "study": provenance.study,
        "lock_hash": provenance.lock_hash,
        "deviations": provenance.deviations,
        "participant": provenance.participant,
        "version": provenance.version,
        "created_at": provenance.created_at,
        "labels": {"count": provenance.label_count, "sha256": provenance.label_hash},
        "seed": provenance.seed,
        "control_rate_hz": round(1.0 / contents.task.control_step_s, 6),
        "observation": described_space(contents.task.observation),
        "action": described_space(contents.task.action),
        "onnx": _onnx_interface(contents.filter_onnx, contents.task),
        "interface": interface_of(contents.task, contents.policy),
        "normalisation": {
            "inside_filter": True,
            "observation_offset": contents.policy.offset.tolist(),
            "observation_scale": contents.policy.scale.tolist(),
            "reward_offset": contents.reward.normalisation.offset,
            "reward_scale": contents.reward.normalisation.scale,
            "reward_clip": CLIP,
        },
        "policy": {
            "file": None if isinstance(contents.policy, AskedPolicy) else "policy.onnx",
            "weights_sha256": _sha256(save(contents.policy.weights)),
            "action_limit": contents.policy.action_limit,
        },
        "method": weights.method,
        "mode": dict(weights.mode),
        "mode_axes": [asdict(axis) for axis in contents.task.modes.axes],
        "gate": weights.gate,
        "residual_share": weights.residual_share if weights.encoder else 0.0,
        "refined": bool(weights.refined),
        "refined_mode": dict(weights.refined_mode),
        "shield": _shield(contents),
        "reward_kind": contents.reward.kind,
        "signals": list(contents.task.signals),
        "uses_reference_policy": bool(contents.metrics.get("uses_reference")),
        "learned_weights": contents.metrics.get("weights"),
        "learned_costs": contents.metrics.get("costs"),
        "evaluation": contents.metrics.get("evaluation"),
        "promise": contents.metrics.get("promise") or None,
        "choice": contents.metrics.get("choice"),
        "notes": list(contents.metrics.get("notes", ())),
        "versions": {
            "python": platform.python_version(),
            "pbarl-studio": version("pbarl-studio"),
            **{name: version(name) for name in _LIBRARIES},
        },
    }


def _shield(contents: BundleContents) -> dict[str, Any] | None:
    """The limits inside the filter, and how active it was in the evaluation; None: no shield."""
    limits, task = contents.weights.shield, contents.task
    if not limits:
        return None
    described = shield.described(task.observation, task.action, limits)
    return {
        "output": SHIELD,
        "limits": described,
        "active_share": contents.metrics.get("shield_active"),
        "strong_share_at_most": contents.metrics.get("shield_strong_at_most"),
    }


def described_space(space: Space) -> dict[str, Any]:
    """Name, place, unit, range and meaning of every number of a space."""
    fields = [
        {
            "name": field.name,
            "first": place.start,
            "size": field.size,
            "unit": field.unit,
            "low": field.low,
            "high": field.high,
            "meaning": field.meaning,
        }
        for field, place in space.slices()
    ]
    return {"size": space.size, "fields": fields}


def _onnx_interface(stored: bytes, task: Task) -> dict[str, Any]:
    sizes = {INPUTS[0]: task.observation.size, INPUTS[1]: task.action.size, OUTPUT: task.action.size, SHIELD: 1}
    exported = OnnxFilter(stored)

    def described(name: str) -> dict[str, Any]:
        return {"name": name, "type": "float32", "shape": ["batch", sizes[name]]}

    return {
        "file": "filter.onnx",
        "opset": exported.opset,
        "inputs": [described(name) for name in INPUTS],
        "outputs": [described(name) for name in (OUTPUT, *([SHIELD] if exported.is_shielded else []))],
    }


def _npy(array: Float32Array) -> bytes:
    target = io.BytesIO()
    np.save(target, np.ascontiguousarray(array, np.float32), allow_pickle=False)
    return target.getvalue()


def _sha256(stored: bytes) -> str:
    return hashlib.sha256(stored).hexdigest()


def _zipped(files: Mapping[str, bytes]) -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(files):
            entry = zipfile.ZipInfo(name, _TIMESTAMP)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3  # Unix, wherever it is written
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, files[name])
    return target.getvalue()
