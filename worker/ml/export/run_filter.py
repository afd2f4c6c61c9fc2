"""Run a personal action filter without the project it was made with. Needs only numpy and onnxruntime.

    python run_filter.py
        Check every file of this directory against the manifest, run the filter over the recording in recorded/, and
        compare its actions with the recorded ones. With the package cryptography, the signature is checked as well.

    python run_filter.py --key FINGERPRINT
        The same, and nothing but a bundle signed with this key will do. The studio shows the fingerprint of its key.

    python run_filter.py --observations observations.npy --output actions.npy
        Filter your own recording of (N, D) observations. The reference policy's mean actions in them come from
        policy.onnx, or from an (N, A) file of your own with --policy-means policy_means.npy.

    python run_filter.py --serve 8001 --upstream ws://localhost:8000
        Stand between a policy server and a client, both in the websocket protocol of openpi. With --upstream
        module:function the policy is called in this process, and without --upstream it is the bundle's own.
        filter_loop.py says how. Needs also: python -m pip install websockets msgpack

In a control loop, load the filter once and call it at every step:

    import numpy, onnxruntime
    policy, session = (onnxruntime.InferenceSession(name) for name in ("policy.onnx", "filter.onnx"))
    (policy_mean,) = policy.run(["policy_mean"], {"observation": observation[None]})
    action = session.run(["action"], {"observation": observation[None], "policy_mean": policy_mean})[0][0]

Units, ranges and order of the numbers are in manifest.json.
"""

import argparse
import hashlib
import importlib
import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

try:
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    CAN_CHECK_SIGNATURES = True
except ImportError:
    CAN_CHECK_SIGNATURES = False

try:
    import numpy as np
    import onnxruntime
except ImportError as missing:
    sys.stderr.write(f"{missing}. Install what this script needs with: python -m pip install numpy onnxruntime\n")
    sys.exit(1)

TOLERANCE = 1e-4
"""Largest accepted difference from the recorded actions: other processors round differently."""
TIMED_STEPS = 300
STRONG = 0.25
"""Activity of the shield from which it counts when somebody's world is compared with the tests'. Below, it is often
there throughout an episode, for a posture that was rare in them (docs/results/changed_physics.md)."""
SIGNATURE_FORMAT = "pbarl-studio-bundle-signature"


class Problem(Exception):
    """Something about the files or the input; the message says what and what to do."""


def main(arguments: list[str] | None = None) -> int:
    """Return the exit code: 0 when everything is as it should be, else 1."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--observations", type=Path, help="(N, D) .npy file of observations to filter")
    parser.add_argument("--policy-means", type=Path, help="(N, A) .npy file of another policy's mean actions")
    parser.add_argument("--key", metavar="FINGERPRINT", help="refuse what this key has not signed")
    parser.add_argument("--output", type=Path, help="where to write the (N, A) filtered actions, as .npy")
    parser.add_argument("--serve", type=int, metavar="PORT", help="filter in a loop over websockets (0: any free port)")
    parser.add_argument(
        "--upstream", metavar="WHERE", help="with --serve: the policy, ws://host:port or module:function"
    )
    parser.add_argument(
        "--host", default="127.0.0.1", help="with --serve: where to listen; nobody is asked who they are"
    )
    parser.add_argument("--deadline-ms", type=float, help="with --serve: of the policy's answers; default: one step")
    parser.add_argument("--upstream-s", type=float, default=10.0, help="with --serve: after this the policy hangs")
    parser.add_argument("--pause-s", type=float, default=1.0, help="with --serve: silence after which it stood still")
    options = parser.parse_args(arguments)
    directory = Path(__file__).resolve().parent
    try:
        if bool(options.observations) != bool(options.output) or (options.policy_means and not options.output):
            raise Problem("--observations and --output belong together; give both, or neither and no --policy-means.")
        manifest = verified_manifest(directory)
        check_signature(directory, options.key)
        session, policy = load(directory / "filter.onnx"), policy_of(manifest, directory)
        if options.serve is not None:
            return serve(manifest, session, policy, options)
        if options.output:
            means = options.policy_means or policy
            if means is None:
                raise Problem("this bundle holds no policy; give what it said with --policy-means.")
            filter_files(manifest, session, options.observations, means, options.output)
        else:
            compare_with_recording(manifest, session, policy, directory / "recorded")
    except Problem as problem:
        sys.stderr.write(f"FAILED: {problem}\n")
        return 1
    return 0


def verified_manifest(directory: Path) -> dict[str, Any]:
    """The manifest, after checking size and sha256 of every file it lists."""
    try:
        manifest: dict[str, Any] = json.loads((directory / "manifest.json").read_text(encoding="utf-8"))
        listed = manifest["files"]
    except FileNotFoundError:
        raise Problem(f"There is no manifest.json in {directory}; unzip the whole bundle into one directory.") from None
    except (ValueError, KeyError):
        raise Problem("manifest.json cannot be read; unzip the bundle again.") from None
    for name, expected in listed.items():
        path = directory / name
        if not path.is_file():
            raise Problem(f"{name} is missing; unzip the bundle again.")
        stored = path.read_bytes()
        if len(stored) != expected["bytes"] or hashlib.sha256(stored).hexdigest() != expected["sha256"]:
            raise Problem(f"{name} is not the file that was exported (its sha256 differs); unzip the bundle again.")
    sys.stdout.write(f"{len(listed)} files match the manifest.\n")
    return manifest


def check_signature(directory: Path, wanted: str | None) -> None:
    """Say whether the manifest is signed and by which key. Raises Problem when it is not as it should be.

    ``wanted``: the fingerprint that it must be; None: any key, or none at all.
    """
    path = directory / "signature.json"
    if not path.is_file():
        report_signature("not signed: nothing proves which studio these files come from.", wanted)
    elif not CAN_CHECK_SIGNATURES:
        report_signature("not checked. To check it: python -m pip install cryptography", wanted)
    else:
        signer = signer_of(path, directory / "manifest.json")
        if wanted is not None and "".join(wanted.lower().replace(":", "").split()) != signer:
            raise Problem(f"the bundle was signed with another key, whose fingerprint is {signer}.")
        known = "the key that was asked for" if wanted is not None else "compare it with the one that the studio shows"
        sys.stdout.write(f"Signature: good, made with the key {signer} ({known}).\n")


def report_signature(words: str, wanted: str | None) -> None:
    """Without a good signature a bundle is accepted unless one was asked for."""
    if wanted is not None:
        raise Problem(f"the signature is {words}")
    sys.stdout.write(f"Signature: {words}\n")


def signer_of(path: Path, manifest: Path) -> str:
    """The fingerprint of the key that has signed the manifest: SHA-256 of the public key."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        signature = document.pop("signature")
        public = bytes.fromhex(signature["public_key"])
        written = json.dumps(document, sort_keys=True, separators=(",", ":")).encode()
        Ed25519PublicKey.from_public_bytes(public).verify(bytes.fromhex(signature["value"]), written)
        if document["format"] != SIGNATURE_FORMAT:
            raise KeyError("format")
        named = document["manifest_sha256"]
    except (InvalidSignature, AttributeError, KeyError, TypeError, ValueError):
        raise Problem("signature.json holds no good signature; unzip the bundle again, or do not use it.") from None
    if hashlib.sha256(manifest.read_bytes()).hexdigest() != named:
        raise Problem("manifest.json is not the one that was signed; do not use this bundle.")
    return hashlib.sha256(public).hexdigest()


def load(path: Path) -> Any:
    """A session that runs on one thread: a control loop has no use for more."""
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = settings.inter_op_num_threads = 1
    try:
        return onnxruntime.InferenceSession(str(path), settings, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises many types, none of them documented
        raise Problem(f"onnxruntime {onnxruntime.__version__} cannot load {path.name}: {error}") from None


def policy_of(manifest: dict[str, Any], directory: Path) -> Any:
    """The policy's session; None where it is a server or a function, and not in the bundle."""
    return load(directory / "policy.onnx") if "policy.onnx" in manifest["files"] else None


def serve(manifest: dict[str, Any], session: Any, policy: Any, options: argparse.Namespace) -> int:
    """Filter in a loop: serve_filter.py, which lies beside this file."""
    sys.path.insert(0, str(Path(__file__).resolve().parent))
    try:
        loop = importlib.import_module("serve_filter")
    except ImportError as missing:
        raise Problem(f"{missing}. Install what --serve needs: python -m pip install websockets msgpack") from None
    means = None if policy is None else lambda observations: means_of(policy, observations)
    code: int = loop.main(manifest, lambda seen, said: run(session, seen, said), means, options)
    return code


def run(session: Any, observations: Any, policy_means: Any) -> tuple[Any, Any]:
    """(N, D), (N, A) -> actions (N, A), activity of the shield (N, 1). Filters of earlier versions have no shield."""
    names = [output.name for output in session.get_outputs()]
    said = session.run(names, {"observation": observations, "policy_mean": policy_means})
    found = dict(zip(names, said, strict=True))
    return found["action"], found.get("shield", np.zeros((len(observations), 1), np.float32))


def usual_strong_share(manifest: Mapping[str, Any]) -> float | None:
    """What strong_share() was at most in 99 of 100 episodes of the tests; None: not known."""
    share: float | None = (manifest.get("shield") or {}).get("strong_share_at_most")
    return share


def strong_share(activity: Any) -> float:
    """(N, 1) -> in what share of the steps the shield took back a good part of what the filter did."""
    return float((activity >= STRONG).mean())


def unusual_activity(share: float, usual: float | None) -> str:
    """What it means that the shield is as active as this in as many steps as an episode has; empty: it is usual."""
    if usual is None or share <= usual:
        return ""
    return (
        f"in {share:.0%} of the steps the shield takes back a quarter or more of what the filter does, in 99 of 100 "
        f"episodes of its tests in {usual:.0%} at most: sensors or surroundings are other than there, and the task may "
        "fail"
    )


def shielded(manifest: Mapping[str, Any], activity: Any) -> list[str]:
    """In how many rows the shield was active, and whether that is unusual."""
    rows = int((activity > 0).sum())
    if not rows:
        return []
    unusual = unusual_activity(strong_share(activity), usual_strong_share(manifest))
    return [f"the shield was active in {rows} of {len(activity)} rows.", *([f"{unusual}."] if unusual else [])]


def means_of(policy: Any, observations: Any) -> Any:
    """(N, D) -> (N, A)"""
    return policy.run(["policy_mean"], {"observation": observations})[0]


def compare_with_recording(manifest: dict[str, Any], session: Any, policy: Any, directory: Path) -> None:
    """Run the filter, and the policy it belongs to, over the recording that came with it."""
    observations, policy_means = read_inputs(manifest, directory / "observations.npy", directory / "policy_means.npy")
    recorded = read_array(directory / "actions.npy", manifest["action"]["size"])
    started = time.perf_counter()
    actions, _ = run(session, observations, policy_means)
    all_at_once_ms = 1000 * (time.perf_counter() - started)
    difference = float(np.abs(actions - recorded).max())
    if policy is not None:
        difference = max(difference, float(np.abs(means_of(policy, observations) - policy_means).max()))
    single_us = one_by_one_us(session, observations, policy_means)
    sys.stdout.write(f"{len(actions)} recorded steps in {all_at_once_ms:.1f} ms; one by one {single_us} us (median).\n")
    if not difference <= TOLERANCE:
        raise Problem(
            f"The actions differ from the recorded ones by up to {difference:.2e} (accepted: {TOLERANCE:.0e})."
        )
    what = "filter reproduces its" if policy is None else "policy and filter reproduce their"
    sys.stdout.write(f"OK: {what} recorded actions (largest difference {difference:.1e}).\n")


def one_by_one_us(session: Any, observations: Any, policy_means: Any) -> int:
    """Median duration of a call with one step."""
    durations = []
    for row in range(min(TIMED_STEPS, len(observations))):
        started = time.perf_counter()
        run(session, observations[row : row + 1], policy_means[row : row + 1])
        durations.append(time.perf_counter() - started)
    return round(1e6 * sorted(durations)[len(durations) // 2])


def filter_files(manifest: dict[str, Any], session: Any, observed: Path, means: Any, output: Path) -> None:
    """Run the filter over somebody's own recording; ``means`` is a file, or the session of the policy to ask."""
    if isinstance(means, Path):
        observations, policy_means = read_inputs(manifest, observed, means)
    else:
        observations = read_array(observed, manifest["observation"]["size"])
        policy_means = means_of(means, observations)
    for line in unusual(manifest["observation"], observations):
        sys.stdout.write(f"Note: {line}\n")
    actions, activity = run(session, observations, policy_means)
    for line in shielded(manifest, activity):
        sys.stdout.write(f"Note: {line}\n")
    try:
        with output.open("wb") as target:
            np.save(target, actions, allow_pickle=False)
    except OSError as error:
        raise Problem(f"Cannot write {output}: {error.strerror}.") from None
    sys.stdout.write(f"OK: {len(actions)} actions written to {output}.\n")


def read_inputs(manifest: dict[str, Any], observed: Path, means: Path) -> tuple[Any, Any]:
    """Both arrays, checked against the manifest and each other."""
    observations = read_array(observed, manifest["observation"]["size"])
    policy_means = read_array(means, manifest["action"]["size"])
    if len(observations) != len(policy_means):
        raise Problem(f"{observed} has {len(observations)} rows but {means} has {len(policy_means)}.")
    return observations, policy_means


def read_array(path: Path, width: int) -> Any:
    """(N, width) finite float32."""
    try:
        array = np.load(path, allow_pickle=False)
    except FileNotFoundError:
        raise Problem(f"There is no file {path}.") from None
    except (ValueError, EOFError, OSError):
        raise Problem(f"{path} is not a plain .npy array (save it with numpy.save, without pickled objects).") from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise Problem(f"{path} must hold one array of numbers.")
    if array.ndim != 2 or array.shape[1] != width or not len(array):
        raise Problem(f"{path} has shape {array.shape}; expected (N, {width}) with at least one row.")
    if not np.isfinite(array).all():
        row = int(np.argwhere(~np.isfinite(array))[0][0])
        raise Problem(f"{path} holds a NaN or an infinity, first in row {row}. The filter needs numbers everywhere.")
    return np.ascontiguousarray(array, np.float32)


def unusual(space: dict[str, Any], observations: Any) -> list[str]:
    """Which fields leave the range in which the filter was trained."""
    lines = []
    for field in space["fields"]:
        values = observations[:, field["first"] : field["first"] + field["size"]]
        rows = int(((values < field["low"]) | (values > field["high"])).any(axis=1).sum())
        if rows:
            unit = "" if field["unit"] == "1" else " " + field["unit"]
            span = f"[{field['low']:g}, {field['high']:g}]{unit}"
            lines.append(f"{field['name']} is outside {span} in {rows} of {len(values)} rows.")
    return lines


if __name__ == "__main__":
    sys.exit(main())
