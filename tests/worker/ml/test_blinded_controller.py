"""A method as one file that acts as the method does and does not say which one it is."""

import hashlib
import io
import json
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from tests.waiting import PATIENCE_S
from tests.worker import invented
from worker.domain.type_aliases import Act
from worker.ml.export import blinded_controller
from worker.ml.export.blinded_controller import Blinded
from worker.ml.export.run_controller import Controller
from worker.ml.filters.encoders.action_encoder import ResidualAdapter
from worker.ml.filters.encoders.pbarl_printed import PrintedEncoder
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights, build, state_of
from worker.ml.methods.best_of_n import BestOfN
from worker.ml.policies.torch_module import FrozenPolicy
from worker.ml.reinforcement.preference_rl import PolicyAct

POLICY = invented.small_policy()
FROZEN = FrozenPolicy(POLICY.weights)
SEEN = invented.observations(64, np.random.default_rng(0))
TELLTALE = ("filter", "policy", "mode", "adapter", "encoder", "residual", "pbarl", "prefft", "reference", "torch")


def studio_weights() -> FilterWeights:
    adapter = ResidualAdapter(FROZEN.offset, FROZEN.scale)
    torch.nn.init.normal_(
        adapter.decoder[-1].get_parameter("weight"), std=0.3, generator=torch.Generator().manual_seed(0)
    )
    mode = invented.TASK.modes.named([-0.5, 0.2, 0.6, -0.4, 0.8])
    return FilterWeights(mode=mode, gate=0.7, encoder=state_of(adapter), residual_share=0.5)


def printed_weights() -> FilterWeights:
    with torch.random.fork_rng():
        torch.manual_seed(3)
        return FilterWeights(method="printed", encoder=state_of(PrintedEncoder(FROZEN.offset, FROZEN.scale)))


@pytest.fixture(scope="module")
def acts() -> dict[str, Act]:
    return {
        "reference": PolicyAct(POLICY),
        "fine-tuned": PolicyAct(invented.small_policy(seed=5)),
        "studio": act_of(invented.TASK.modes, POLICY, studio_weights()),
        "printed": act_of(invented.TASK.modes, POLICY, printed_weights()),
    }


@pytest.fixture(scope="module")
def models(acts: dict[str, Act]) -> dict[str, bytes]:
    return {name: blinded_controller.of_act(act, SEEN) for name, act in acts.items()}


def zipped(model: bytes, letter: str = "B") -> bytes:
    return blinded_controller.write(Blinded(invented.TASK, "feeding-at-home", "P07", letter, model, SEEN))


@pytest.mark.parametrize("weights", [studio_weights(), printed_weights()], ids=["studio", "printed"])
def test_a_filter_and_its_policy_in_one_file_act_as_torch_does(weights: FilterWeights) -> None:
    stored = blinded_controller.of_act(act_of(invented.TASK.modes, POLICY, weights), SEEN)
    with torch.no_grad():
        seen = torch.from_numpy(SEEN)
        expected = build(invented.TASK.modes, POLICY, weights)(seen, FROZEN(seen)[0]).numpy()
    np.testing.assert_allclose(Controller(stored).batch(SEEN), expected, atol=1e-5)


def test_a_policy_in_one_file_acts_as_torch_does(models: dict[str, bytes]) -> None:
    with torch.no_grad():
        expected = FROZEN(torch.from_numpy(SEEN))[0].numpy()
    np.testing.assert_allclose(Controller(models["reference"]).batch(SEEN), expected, atol=1e-5)


def test_different_methods_act_differently(models: dict[str, bytes]) -> None:
    actions = [Controller(stored).batch(SEEN) for stored in models.values()]
    assert all(np.abs(one - other).max() > 0.01 for one in actions for other in actions if one is not other)


def test_a_controller_can_be_sent_to_another_process(models: dict[str, bytes]) -> None:
    travelled = pickle.loads(pickle.dumps(Controller(models["studio"])))  # noqa: S301
    np.testing.assert_array_equal(travelled(SEEN[0]), Controller(models["studio"])(SEEN[0]))


def test_every_method_gives_a_file_of_the_same_length(models: dict[str, bytes]) -> None:
    assert len({len(stored) for stored in models.values()}) == 1
    assert len({len(zipped(stored)) for stored in models.values()}) == 1


def test_no_word_in_the_file_tells_the_method(models: dict[str, bytes]) -> None:
    for stored in models.values():
        model = onnx.load_from_string(stored)
        words = str(helper_words(model)).lower()
        assert [word for word in TELLTALE if word in words] == []
        with zipfile.ZipFile(io.BytesIO(zipped(stored))) as archive:
            manifest = archive.read("manifest.json").decode().lower()
        assert [word for word in TELLTALE if word in manifest] == []


def helper_words(model: onnx.ModelProto) -> list[str]:
    """Everything in a model that somebody could read, operators excepted."""
    graph = model.graph
    names = [name for node in graph.node for name in (node.name, node.doc_string, *node.input, *node.output)]
    names += [prop.value for node in graph.node for prop in node.metadata_props]
    names += [each.name + each.doc_string for each in (*graph.initializer, *graph.value_info, *graph.input)]
    notes = [prop.key + prop.value for prop in model.metadata_props]
    return [*names, *notes, graph.name, graph.doc_string, model.producer_name, model.producer_version, model.doc_string]


def test_the_manifests_of_two_letters_differ_in_the_letter_and_the_files_alone(models: dict[str, bytes]) -> None:
    manifests = []
    for letter, stored in (("A", models["studio"]), ("B", models["reference"])):
        with zipfile.ZipFile(io.BytesIO(zipped(stored, letter))) as archive:
            manifests.append(json.loads(archive.read("manifest.json")))
    different = {key for key in manifests[0] if manifests[0][key] != manifests[1][key]}
    assert different == {"letter", "files"}
    assert manifests[0]["files"]["recorded/observations.npy"] == manifests[1]["files"]["recorded/observations.npy"]


def test_a_controller_runs_where_this_project_is_not_installed(models: dict[str, bytes], tmp_path: Path) -> None:
    with zipfile.ZipFile(io.BytesIO(zipped(models["studio"]))) as archive:
        archive.extractall(tmp_path)
    np.save(tmp_path / "mine.npy", SEEN[:5])
    for arguments in ([], ["--observations", "mine.npy", "--output", "out.npy"]):
        command = [sys.executable, "-I", "run_controller.py", *arguments]
        ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
        assert ran.returncode == 0, ran.stdout + ran.stderr
        assert "Robot B of P07" in ran.stdout
    np.testing.assert_allclose(np.load(tmp_path / "out.npy"), Controller(models["studio"]).batch(SEEN[:5]), atol=1e-6)


def test_a_damaged_controller_says_so(models: dict[str, bytes], tmp_path: Path) -> None:
    with zipfile.ZipFile(io.BytesIO(zipped(models["studio"]))) as archive:
        archive.extractall(tmp_path)
    path = tmp_path / "controller.onnx"
    path.write_bytes(path.read_bytes()[:-1] + b"1")
    command = [sys.executable, "-I", "run_controller.py"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert ran.returncode == 1
    assert "controller.onnx is not the file that was exported" in ran.stderr


def test_the_same_contents_give_the_same_bytes(acts: dict[str, Act], models: dict[str, bytes]) -> None:
    assert blinded_controller.of_act(acts["printed"], SEEN) == models["printed"]
    digests = {hashlib.sha256(zipped(models["printed"])).hexdigest() for _ in range(2)}
    assert len(digests) == 1


def test_what_is_neither_policy_nor_filter_is_refused() -> None:
    with pytest.raises(blinded_controller.NotExportable, match="BestOfN"):
        blinded_controller.of_act(BestOfN.__new__(BestOfN), SEEN)
