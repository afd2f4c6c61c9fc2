"""The published bundle: complete, deterministic, verifiable, and able to run itself."""

import io
import json
import re
import shutil
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import onnxruntime
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.signing import SigningKey
from tests.waiting import PATIENCE_S
from tests.worker import invented
from worker.analysis.filters.evaluation import evaluate
from worker.domain.trajectory import SIGNALS
from worker.ml.export import bundle
from worker.ml.export.bundle import BundleContents, BundleDamaged, Provenance, RecordedSteps
from worker.ml.export.forward_model import ForwardModel
from worker.ml.export.model_card import model_card
from worker.ml.filters.exported import shield
from worker.ml.filters.exported.filter_module import FilterWeights, build
from worker.ml.filters.exported.filter_onnx import to_onnx
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.policies.policy_onnx import policy_to_onnx
from worker.ml.rewards import reward_training
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.reward_models import StructuredReward

POLICY = invented.small_policy()


@pytest.fixture(scope="module")
def contents() -> BundleContents:
    """A small filter with everything that belongs to it."""
    rng = np.random.default_rng(0)
    weights = FilterWeights(mode=invented.TASK.modes.named([-0.5, 0.2, 0.6, -0.4, 0.8]), gate=0.7)
    episodes = [invented.trajectory(np.random.default_rng(each), scenario=each) for each in range(4)]
    episodes = [replace(each, reference_actions=POLICY.mean(each.observations[:-1])) for each in episodes]
    recording = RecordedSteps.of(episodes[:2])
    return BundleContents(
        task=invented.TASK,
        filter_onnx=to_onnx(
            build(invented.TASK.modes, POLICY, weights), recording.observations, recording.policy_means
        ),
        weights=weights,
        reward=StructuredReward(rng.standard_normal((8, len(SIGNALS)))),
        policy=POLICY,
        recording=recording,
        metrics={
            "evaluation": evaluate(episodes, episodes, np.arange(4), np.arange(4) + 1.0, invented.TASK),
            "notes": ["A note."],
            "weights": {
                "speed_m_s": {"mean": -1.5, "low": -2.1, "high": -0.9},
                "tilt_rad": {"mean": 0.1, "low": -0.4, "high": 0.6},
            },
            "costs": {"weights": {"C_d": {"mean": -0.7, "low": -0.8, "high": -0.6}}, "explained": 0.9},
        },
        provenance=Provenance("demo", "P07", 3, 200, "ab" * 32, 11, "2026-01-02T03:04:05Z", "cd" * 32, "none"),
        forward_model=ForwardModel(np.zeros((invented.D + 8, invented.D)), np.ones(invented.D), 1.0, 0.01),
    )


@pytest.fixture(scope="module")
def written(contents: BundleContents) -> bytes:
    return bundle.write(contents)


@pytest.fixture
def unzipped(written: bytes, tmp_path: Path) -> Path:
    """A clean directory with nothing but the bundle in it."""
    with zipfile.ZipFile(io.BytesIO(written)) as archive:
        archive.extractall(tmp_path)
    return tmp_path


def run(directory: Path, *arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    """As somebody without this project would."""
    command = [sys.executable, "-I", "run_filter.py", *map(str, arguments)]
    return subprocess.run(command, cwd=directory, capture_output=True, text=True, check=False, timeout=PATIENCE_S)


def test_the_same_contents_give_the_same_bytes(contents: BundleContents, written: bytes) -> None:
    assert bundle.write(contents) == written


def test_everything_promised_is_inside_and_nothing_else(written: bytes) -> None:
    with zipfile.ZipFile(io.BytesIO(written)) as archive:
        assert archive.namelist() == sorted(
            [
                "MODEL_CARD.md",
                "action_encoder.safetensors",
                "filter.onnx",
                "filter_loop.py",
                "forward_model.npz",
                "forward_model.py",
                "manifest.json",
                "policy.onnx",
                "policy_client.py",
                "recorded/actions.npy",
                "recorded/observations.npy",
                "recorded/policy_means.npy",
                "reward_model.safetensors",
                "run_filter.py",
                "serve_filter.py",
            ]
        )


def test_an_undamaged_bundle_gives_its_manifest(written: bytes) -> None:
    manifest = bundle.verify(written)
    assert (manifest["lock_hash"], manifest["deviations"]) == ("cd" * 32, "none")
    assert manifest["labels"] == {"count": 200, "sha256": "ab" * 32}
    assert [field["name"] for field in manifest["observation"]["fields"]] == [
        field.name for field in invented.TASK.observation.fields
    ]
    assert manifest["onnx"]["inputs"][0] == {"name": "observation", "type": "float32", "shape": ["batch", 28]}
    assert manifest["control_rate_hz"] == 10
    assert {"python", "torch", "onnx", "pbarl-studio"} <= set(manifest["versions"])
    assert set(manifest["files"]) | {"manifest.json"} == set(_names(written))


def test_the_stored_parts_can_be_read_again(contents: BundleContents, unzipped: Path) -> None:
    reward = load_reward_model((unzipped / "reward_model.safetensors").read_bytes())
    assert reward.normalisation == contents.reward.normalisation
    assert FilterWeights.from_bytes((unzipped / "action_encoder.safetensors").read_bytes()).gate == 0.7


def test_nothing_in_the_bundle_is_pickled(unzipped: Path) -> None:
    for path in (unzipped / "recorded").iterdir():
        assert np.load(path, allow_pickle=False).dtype == np.float32


@pytest.mark.parametrize("name", ["filter.onnx", "MODEL_CARD.md", "recorded/actions.npy"])
def test_a_changed_file_is_found(written: bytes, name: str) -> None:
    with pytest.raises(BundleDamaged, match=name):
        bundle.verify(_rewritten(written, {name: b"something else"}))


def test_a_missing_or_added_file_is_found(written: bytes) -> None:
    with pytest.raises(BundleDamaged, match=r"run_filter\.py"):
        bundle.verify(_rewritten(written, {"run_filter.py": None}))
    with pytest.raises(BundleDamaged, match="surprise"):
        bundle.verify(_rewritten(written, {"surprise.txt": b"hello"}))
    with pytest.raises(BundleDamaged):
        bundle.verify(written[:-100])


def test_the_card_states_numbers_with_intervals_limits_and_use(unzipped: Path) -> None:
    card = (unzipped / "MODEL_CARD.md").read_text()
    for expected in (
        "P07, version 3",
        "200 comparisons",
        "On 4 unseen scenarios",
        "Success: 100.0%",
        "C_fdv",
        "A note.",
    ):
        assert expected in card
    for expected in ("python run_filter.py", "## Limits", "largest force on the person", "speed_near", "Gate 70%"):
        assert expected in card


def test_the_card_names_what_the_labels_are_sure_about_and_nothing_else(unzipped: Path) -> None:
    card = (unzipped / "MODEL_CARD.md").read_text()
    assert "| speed_m_s | -1.50 [-2.10, -0.90] |" in card
    assert "| C_d: distance of the tool from its target, m | -0.70 [-0.80, -0.60] |" in card
    assert "account for 90% of what was learned" in card
    assert "tilt_rad" not in card


@pytest.mark.parametrize("kind", get_args(reward_training.RewardKind))
def test_the_card_says_in_words_what_was_learned_from_the_labels(kind: str, unzipped: Path) -> None:
    manifest = json.loads((unzipped / "manifest.json").read_text())
    card = model_card(manifest | {"reward_kind": kind})
    assert re.search(r"Reward model: (linear|an ensemble) ", card)


@pytest.mark.parametrize("in_mode", [{}, {"speed_far": -0.41}])
def test_the_card_of_a_refined_filter_tells_the_mode_it_is_executed_in_and_no_other(
    unzipped: Path, in_mode: dict[str, float]
) -> None:
    manifest = json.loads((unzipped / "manifest.json").read_text())
    assert manifest["mode"], "the one that was searched first"
    card = model_card(manifest | {"refined": True, "refined_mode": in_mode})
    _, _, way = card.partition("## This person's way")
    assert "residual action encoder" not in card
    assert ("| speed_far | -0.41 |" in way) == bool(in_mode)
    assert ("| axis |" in way.partition("\n## ")[0]) == bool(in_mode)
    assert "a refined policy" in way


def test_the_card_of_a_laboratorys_filter_says_nothing_of_our_robot_and_person(unzipped: Path) -> None:
    manifest = json.loads((unzipped / "manifest.json").read_text())
    ours = model_card(manifest)
    theirs = model_card(manifest | {"interface": manifest["interface"] | {"adds_previous_action_and_share": True}})
    for words in ("one seated person", "SI units in the robot's base frame"):
        assert words in ours
        assert words not in theirs


def test_the_bundle_runs_on_its_own_and_confirms_itself(unzipped: Path) -> None:
    finished = run(unzipped)
    assert finished.returncode == 0, finished.stderr
    assert "14 files match" in finished.stdout
    assert "OK: policy and filter reproduce their recorded actions" in finished.stdout


def test_the_script_needs_only_numpy_and_onnxruntime() -> None:
    code = (
        "import sys, runpy; sys.argv=['run_filter.py', '--help']\n"
        "try: runpy.run_path('worker/ml/export/run_filter.py', run_name='__main__')\n"
        "except SystemExit: pass\n"
        "print([name for name in ('torch', 'safetensors', 'onnx', 'worker', 'app') if name in sys.modules])"
    )
    root = Path(bundle.__file__).parents[3]
    finished = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert finished.stdout.strip().endswith("[]")


def test_a_damaged_file_is_noticed_before_anything_runs(unzipped: Path) -> None:
    (unzipped / "filter.onnx").write_bytes(b"not an onnx file")
    finished = run(unzipped)
    assert finished.returncode == 1
    assert "filter.onnx is not the file that was exported" in finished.stderr


def test_other_actions_than_recorded_are_a_failure(written: bytes, tmp_path: Path) -> None:
    target = io.BytesIO()
    np.save(target, np.zeros((40, 7), np.float32), allow_pickle=False)
    with zipfile.ZipFile(
        io.BytesIO(_rewritten(written, {"recorded/actions.npy": target.getvalue()}, relist=True))
    ) as new:
        new.extractall(tmp_path)
    finished = run(tmp_path)
    assert finished.returncode == 1
    assert "differ from the recorded ones" in finished.stderr


def test_somebody_s_own_recording_is_filtered(unzipped: Path, contents: BundleContents) -> None:
    np.save(unzipped / "o.npy", contents.recording.observations[:5].astype(np.float64))
    np.save(unzipped / "m.npy", contents.recording.policy_means[:5])
    finished = run(unzipped, "--observations", "o.npy", "--policy-means", "m.npy", "--output", "a.npy")
    assert finished.returncode == 0, finished.stderr
    recorded = np.load(unzipped / "recorded/actions.npy")[:5]
    np.testing.assert_allclose(np.load(unzipped / "a.npy"), recorded, atol=1e-5)


def test_without_policy_means_the_bundle_asks_its_own_policy(unzipped: Path, contents: BundleContents) -> None:
    np.save(unzipped / "o.npy", contents.recording.observations[:5])
    finished = run(unzipped, "--observations", "o.npy", "--output", "a.npy")
    assert finished.returncode == 0, finished.stderr
    recorded = np.load(unzipped / "recorded/actions.npy")[:5]
    np.testing.assert_allclose(np.load(unzipped / "a.npy"), recorded, atol=1e-5)


def test_a_shield_is_told_in_manifest_card_and_script(contents: BundleContents, tmp_path: Path) -> None:
    recording, family = contents.recording, invented.TASK.modes
    limits = shield.widest(invented.TASK.observation, 7)
    limits["observation_high"][0] = np.quantile(recording.observations[:, 0], 0.2)
    limits["observation_ramp"][0] = 1e-3
    limits["touch_depth"][0] = 0.002
    weights = contents.weights.changed(shield=limits)
    stored = to_onnx(build(family, POLICY, weights), recording.observations, recording.policy_means)
    sentence = "With 95 % confidence, in at most 5 % of scenarios it does nothing of the kind."
    metrics = {
        **contents.metrics,
        "shield_active": 0.5,
        "shield_strong_at_most": 0.5,
        "promise": {"share": 0.05, "sentence": sentence},
    }
    written = bundle.write(replace(contents, weights=weights, filter_onnx=stored, metrics=metrics))
    with zipfile.ZipFile(io.BytesIO(written)) as archive:
        archive.extractall(tmp_path)
        card = archive.read("MODEL_CARD.md").decode()
    manifest = bundle.verify(written)
    assert [output["name"] for output in manifest["onnx"]["outputs"]] == ["action", "shield"]
    (high, *_) = manifest["shield"]["limits"]["observation"][0]["high"]
    assert high == limits["observation_high"][0]
    step = manifest["shield"]["limits"]["step_near_person"]
    assert step["deepest_m"] == pytest.approx(float(limits["touch_depth"][0]))
    assert step["beside_target"]["from_m"] == pytest.approx(float(limits["touch_place"][1]))
    assert np.shape(step["tool_motion_m"]) == (8, 8, 3)
    assert len(step["axes_of_tool_motion"]) == 3
    assert "active in 50.0% of the control steps" in card
    assert "foreseen to strike the skin harder than the reference policy usually touches it or come much nearer" in card
    assert "not every blow is foreseen" in card
    assert sentence in card
    assert run(tmp_path).returncode == 0
    np.save(tmp_path / "o.npy", recording.observations)
    finished = run(tmp_path, "--observations", "o.npy", "--output", "a.npy")
    assert f"the shield was active in 32 of {len(recording.observations)} rows" in finished.stdout
    assert "in 80% of the steps the shield takes back a quarter or more" in finished.stdout
    assert "in 99 of 100 episodes of its tests in 50% at most" in finished.stdout
    first = recording.observations[:, 0]
    np.save(tmp_path / "o.npy", recording.observations[first < np.quantile(first, 0.3)])
    assert "takes back" not in run(tmp_path, "--observations", "o.npy", "--output", "a.npy").stdout


def test_a_filter_without_promise_and_shield_says_so(contents: BundleContents) -> None:
    manifest = bundle.verify(bundle.write(contents))
    assert (manifest["promise"], manifest["shield"]) == (None, None)
    card = model_card(manifest)
    assert "Nothing is promised of this filter" in card
    assert "## Shield" not in card


def test_the_exported_policy_is_the_shipped_one() -> None:
    policy = GaussianPolicy.load(Path("worker/tasks/feeding/checkpoint/policy.safetensors"))
    observations = np.random.default_rng(0).standard_normal((50, len(policy.offset))).astype(np.float32)
    session = onnxruntime.InferenceSession(policy_to_onnx(policy))
    (means,) = session.run(["policy_mean"], {"observation": observations})
    np.testing.assert_allclose(means, policy.mean(observations), atol=1e-5)  # processors round differently


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda o: o[:, :20], "expected (N, 28)"),
        (lambda o: o[0], "expected (N, 28)"),
        (lambda o: np.where(np.arange(len(o))[:, None] == 2, np.nan, o), "NaN or an infinity, first in row 2"),
        (lambda o: o[:3], "rows"),
        (lambda o: o.astype(str), "numbers"),
        (lambda o: None, "There is no file"),
    ],
)
def test_input_that_cannot_be_filtered_is_explained(
    change: "object", complaint: str, unzipped: Path, contents: BundleContents
) -> None:
    changed = change(contents.recording.observations[:5])  # type: ignore[operator]
    if changed is not None:
        np.save(unzipped / "o.npy", changed)
    np.save(unzipped / "m.npy", contents.recording.policy_means[:5])
    finished = run(unzipped, "--observations", "o.npy", "--policy-means", "m.npy", "--output", "a.npy")
    assert finished.returncode == 1
    assert complaint in finished.stderr
    assert "Traceback" not in finished.stderr


def test_values_outside_the_trained_range_are_mentioned(unzipped: Path, contents: BundleContents) -> None:
    seen = np.abs(contents.recording.observations[:5])
    seen[1, invented.TASK.observation.slice_of("force_on_person_n")] = 90.0
    np.save(unzipped / "o.npy", seen)
    np.save(unzipped / "m.npy", contents.recording.policy_means[:5])
    finished = run(unzipped, "--observations", "o.npy", "--policy-means", "m.npy", "--output", "a.npy")
    assert "force_on_person_n is outside [0, 50] N in 1 of 5 rows" in finished.stdout


def test_half_a_command_and_half_a_bundle_are_explained(unzipped: Path) -> None:
    assert "belong together" in run(unzipped, "--observations", "o.npy").stderr
    shutil.rmtree(unzipped / "recorded")
    assert "recorded/actions.npy is missing" in run(unzipped).stderr
    (unzipped / "manifest.json").unlink()
    assert "no manifest.json" in run(unzipped).stderr


def _names(written: bytes) -> list[str]:
    with zipfile.ZipFile(io.BytesIO(written)) as archive:
        return archive.namelist()


def _rewritten(written: bytes, changes: dict[str, bytes | None], *, relist: bool = False) -> bytes:
    """The bundle with files replaced, added or (None) removed; ``relist`` also changes the manifest to match."""
    with zipfile.ZipFile(io.BytesIO(written)) as archive:
        files: dict[str, bytes | None] = {name: archive.read(name) for name in archive.namelist()}
    files.update(changes)
    if relist:
        manifest = json.loads(files["manifest.json"] or b"")
        for name, stored in changes.items():
            manifest["files"][name] = {"bytes": len(stored or b""), "sha256": bundle._sha256(stored or b"")}
        files["manifest.json"] = json.dumps(manifest).encode()
    return bundle._zipped({name: stored for name, stored in files.items() if stored is not None})


@pytest.fixture(scope="module")
def key() -> SigningKey:
    return SigningKey(Ed25519PrivateKey.from_private_bytes(bytes(32)))


@pytest.fixture(scope="module")
def signed(written: bytes, key: SigningKey) -> bytes:
    return bundle.signed(written, key.signed)


class TestSignature:
    """Signed bundles say which studio they come from; the script checks it where it can, and says when it cannot."""

    def unpacked(self, stored: bytes, folder: Path) -> Path:
        with zipfile.ZipFile(io.BytesIO(stored)) as archive:
            archive.extractall(folder)
        return folder

    def test_it_adds_one_file_and_changes_nothing_else(self, written: bytes, signed: bytes, key: SigningKey) -> None:
        assert bundle.signed(written, key.signed) == signed
        assert set(_names(signed)) - set(_names(written)) == {"signature.json"}
        with zipfile.ZipFile(io.BytesIO(written)) as before, zipfile.ZipFile(io.BytesIO(signed)) as after:
            assert all(before.read(name) == after.read(name) for name in before.namelist())
        assert bundle.verify(signed) == bundle.verify(written)

    def test_the_script_names_the_key_and_can_insist_on_it(
        self, signed: bytes, key: SigningKey, tmp_path: Path
    ) -> None:
        directory = self.unpacked(signed, tmp_path)
        finished = run(directory)
        assert finished.returncode == 0, finished.stderr
        assert f"Signature: good, made with the key {key.fingerprint}" in finished.stdout
        assert run(directory, "--key", key.fingerprint.upper()).returncode == 0
        other = run(directory, "--key", "ab" * 32)
        assert other.returncode == 1
        assert f"signed with another key, whose fingerprint is {key.fingerprint}" in other.stderr

    def test_a_manifest_that_was_not_signed_is_refused(self, signed: bytes, tmp_path: Path) -> None:
        """Whoever changes a file lists its new hash, too."""
        directory = self.unpacked(_rewritten(signed, {"MODEL_CARD.md": b"Safe."}, relist=True), tmp_path)
        finished = run(directory)
        assert finished.returncode == 1
        assert "manifest.json is not the one that was signed" in finished.stderr

    @pytest.mark.parametrize("stored", [b"", b"[]", b"{}", b'{"signature": {"public_key": "00", "value": ""}}'])
    def test_a_broken_signature_is_refused(self, signed: bytes, stored: bytes, tmp_path: Path) -> None:
        finished = run(self.unpacked(_rewritten(signed, {"signature.json": stored}), tmp_path))
        assert finished.returncode == 1
        assert "no good signature" in finished.stderr
        assert "Traceback" not in finished.stderr

    def test_older_bundles_run_and_are_said_to_be_unsigned(self, unzipped: Path) -> None:
        finished = run(unzipped)
        assert finished.returncode == 0
        assert "Signature: not signed" in finished.stdout
        assert run(unzipped, "--key", "ab" * 32).returncode == 1

    def test_without_cryptography_hashes_are_checked_and_the_signature_is_said_not_to_be(
        self, signed: bytes, key: SigningKey, tmp_path: Path
    ) -> None:
        directory = self.unpacked(signed, tmp_path)
        code = (
            "import sys, runpy; sys.modules['cryptography'] = None\n"
            "runpy.run_path('run_filter.py', run_name='__main__')"
        )
        without = [sys.executable, "-I", "-c", code]
        finished = subprocess.run(without, cwd=directory, capture_output=True, text=True, check=False)
        assert finished.returncode == 0, finished.stderr
        assert "14 files match" in finished.stdout
        assert "Signature: not checked" in finished.stdout
        insisting = [*without, "--key", key.fingerprint]
        assert subprocess.run(insisting, cwd=directory, capture_output=True, check=False).returncode == 1
