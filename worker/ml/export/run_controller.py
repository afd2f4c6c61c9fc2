"""Run one robot of a blinded comparison without the project it was made with. Needs only numpy and onnxruntime.

    python run_controller.py
        Check every file of this directory against the manifest, and that the recorded actions come out again.

    python run_controller.py --observations observations.npy --output actions.npy
        The actions for your own recording of (N, D) observations.

In a control loop, load the controller once and ask it at every step:

    from run_controller import Controller
    controller = Controller.load("controller.onnx")
    action = controller(observation)        # (D,) -> (A,)

Units, ranges and order of the numbers, and how often to ask, are in manifest.json. Please do not look into
controller.onnx: which method it is must stay unknown to whoever meets the participant.
"""

import argparse
import hashlib
import json
import sys
import time
from pathlib import Path
from typing import Any

try:
    import numpy as np
    import onnxruntime
except ImportError as missing:
    sys.stderr.write(f"{missing}. Install what this script needs with: python -m pip install numpy onnxruntime\n")
    sys.exit(1)

INPUT, OUTPUT = "observation", "action"
TOLERANCE = 1e-4
"""Largest accepted difference from the recorded actions: other processors round differently."""
TIMED_STEPS = 100


class Problem(Exception):
    """Something about the files or the input; the message says what and what to do."""


class Controller:
    """One robot's brain: what it is asked at every control step. Can be sent to another process."""

    def __init__(self, stored: bytes) -> None:
        settings = onnxruntime.SessionOptions()
        settings.intra_op_num_threads = settings.inter_op_num_threads = 1  # a control loop has no use for more
        settings.log_severity_level = 3
        self.stored = stored
        self._session = onnxruntime.InferenceSession(stored, settings, providers=["CPUExecutionProvider"])

    @classmethod
    def load(cls, path: "Path | str") -> "Controller":
        """Read a controller.onnx."""
        return cls(Path(path).read_bytes())

    def __call__(self, observation: Any) -> Any:
        """(D,) -> (A,)"""
        return self.batch(np.asarray(observation)[None])[0]

    def batch(self, observations: Any) -> Any:
        """(N, D) -> (N, A)"""
        return self._session.run([OUTPUT], {INPUT: np.ascontiguousarray(observations, np.float32)})[0]

    def __reduce__(self) -> Any:
        return Controller, (self.stored,)


def main(arguments: "list[str] | None" = None) -> int:
    """Return the exit code: 0 when everything is as it should be, else 1."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--observations", type=Path, help="(N, D) .npy file of observations")
    parser.add_argument("--output", type=Path, help="where to write the (N, A) actions, as .npy")
    options = parser.parse_args(arguments)
    directory = Path(__file__).resolve().parent
    try:
        if bool(options.observations) != bool(options.output):
            raise Problem("--observations and --output belong together; give both, or neither.")
        manifest = verified_manifest(directory)
        controller = load(directory / manifest["onnx"]["file"])
        if options.output:
            write_actions(manifest, controller, options.observations, options.output)
        else:
            compare_with_recording(manifest, controller, directory / "recorded")
    except Problem as problem:
        sys.stderr.write(f"FAILED: {problem}\n")
        return 1
    return 0


def verified_manifest(directory: Path) -> "dict[str, Any]":
    """The manifest, after checking size and sha256 of every file it lists."""
    try:
        manifest: dict[str, Any] = json.loads((directory / "manifest.json").read_text(encoding="utf-8"))
        listed = manifest["files"]
    except FileNotFoundError:
        raise Problem(f"There is no manifest.json in {directory}; unzip the whole file into one directory.") from None
    except (ValueError, KeyError):
        raise Problem("manifest.json cannot be read; unzip the file again.") from None
    for name, expected in listed.items():
        path = directory / name
        if not path.is_file():
            raise Problem(f"{name} is missing; unzip the file again.")
        if hashlib.sha256(path.read_bytes()).hexdigest() != expected["sha256"]:
            raise Problem(f"{name} is not the file that was exported (its sha256 differs); unzip the file again.")
    sys.stdout.write(f"Robot {manifest['letter']} of {manifest['participant']}: {len(listed)} files are complete.\n")
    return manifest


def load(path: Path) -> Controller:
    """The controller, or a Problem in words."""
    try:
        return Controller.load(path)
    except Exception as error:  # onnxruntime raises many types, none of them documented
        raise Problem(f"onnxruntime {onnxruntime.__version__} cannot load {path.name}: {error}") from None


def compare_with_recording(manifest: "dict[str, Any]", controller: Controller, directory: Path) -> None:
    """Run the controller over the recording that came with it."""
    observations = read_array(directory / "observations.npy", manifest["observation"]["size"])
    recorded = read_array(directory / "actions.npy", manifest["action"]["size"])
    difference = float(np.abs(controller.batch(observations) - recorded).max())
    if not difference <= TOLERANCE:
        raise Problem(f"The actions differ from the recorded ones by up to {difference:.2e}.")
    started = time.perf_counter()
    for row in range(TIMED_STEPS):
        controller(observations[row % len(observations)])
    single_ms = 1000 * (time.perf_counter() - started) / TIMED_STEPS
    rate = manifest["control_rate_hz"]
    sys.stdout.write(
        f"OK: the recorded actions come out again; {single_ms:.2f} ms a step, to be asked at {rate:g} Hz.\n"
    )


def write_actions(manifest: "dict[str, Any]", controller: Controller, observed: Path, output: Path) -> None:
    """Run the controller over somebody's own recording."""
    actions = controller.batch(read_array(observed, manifest["observation"]["size"]))
    try:
        with output.open("wb") as target:
            np.save(target, actions, allow_pickle=False)
    except OSError as error:
        raise Problem(f"Cannot write {output}: {error.strerror}.") from None
    sys.stdout.write(f"OK: {len(actions)} actions written to {output}.\n")


def read_array(path: Path, width: int) -> Any:
    """(N, width) finite float32."""
    try:
        array = np.load(path, allow_pickle=False)
    except FileNotFoundError:
        raise Problem(f"There is no file {path}.") from None
    except (ValueError, EOFError, OSError):
        raise Problem(f"{path} is not a plain .npy array (save it with numpy.save, without pickled objects).") from None
    if array.ndim != 2 or array.shape[1] != width or not len(array) or array.dtype.kind not in "fiu":
        raise Problem(f"{path} must hold numbers in the shape (N, {width}), with at least one row.")
    if not np.isfinite(array).all():
        raise Problem(f"{path} holds a NaN or an infinity. The controller needs numbers everywhere.")
    return np.ascontiguousarray(array, np.float32)


if __name__ == "__main__":
    sys.exit(main())
