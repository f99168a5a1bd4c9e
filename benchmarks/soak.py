# SPDX-License-Identifier: GPL-3.0-or-later
"""Damage files, kill processes and fill disks at random, and count the cases that fail:

    python benchmarks/soak.py out/soak [--seed 1] [--part NAME ...] [--scale 1.0]

A case is refused in one sentence, or gives a right result. Cases run in separate processes: one that dies or is silent
for too long fails its case, and another one continues. The seed alone determines the cases, which are lines of
cases.jsonl. The exit status is 1 if a case failed. Full disks need root.
"""

import argparse
import contextlib
import copy
import ctypes
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from fdda_addon.core.errors import FDDAError  # noqa: E402

Random = np.random.Generator
PASSED, REFUSED, FAILED = "passed", "refused", "failed"
MAX_MB, MAX_SECONDS, MAX_SILENT_SECONDS = 1024, 30, 600
"""Limits of a case: memory, time of the processor, and time until it ends, which is longer on a busy machine."""
POSES, LONG_POSES, TRAINING_OPTIONS = 40, 2000, ("--passes", "3", "--hidden", "4", "4")
DISK_FULL_STATUS = 75
DISK_BYTES = {"record": 400e3, "train": 600e3, "bind": 2e6, "evaluate": 12e3}
ODD_VALUES = (
    None, True, 0, 1, -1, 2**31, -(2**63), 10**30, -1e-308, float("inf"), float("nan"), "", "7", "ß\x1b[2J\n",
    "../../etc/passwd", "/dev/zero", "x" * 100_000, [], [[]], [0] * 1000, {}, {"a": {"b": []}}, [None], "\ud800",
)  # fmt: skip
ODD_NUMBERS = np.float32([0, -1, 1e3, 1e-30, 1e30, 3e38, np.inf, -np.inf, np.nan])
OPERATORS = ("Loop", "If", "ConstantOfShape", "Expand", "Tile", "Identity", "Concat", "MatMul", "Einsum", "Pad", "Exp")
ODD_SIZES = (-1, 0, 1, 7, 2**20, 2**40)


class CaseFailedError(Exception):
    """The result of a case is wrong; the message says how."""


def pick(random: Random, values):
    """Choose one of some values."""
    return values[random.integers(len(values))]


def mutate_bytes(random: Random, data: bytes) -> bytes:
    """Return a copy of bytes with some flipped, removed, repeated or replaced."""
    data = bytearray(data or b"x")
    start, length = int(random.integers(len(data))), int(2 ** random.uniform(0, np.log2(len(data) + 2)))
    kind = random.integers(5)
    if kind == 0:
        del data[start : start + pick(random, (length, len(data)))]
    elif kind == 1:
        data[start:start] = data[start : start + length]
    elif kind == 2:
        data[start : start + length] = random.bytes(min(length, 4096))
    else:
        for _ in range(random.integers(1, 33)):
            # The structure of a file is mostly at its beginning.
            data[random.integers(min(pick(random, (4096, len(data))), len(data)))] ^= 1 << int(random.integers(8))
    return bytes(data)


def mutate_json(random: Random, value: object) -> str:
    """Return JSON of a value with an entry that is replaced, removed or repeated, at a random depth."""
    root = [copy.deepcopy(value)]
    holder, key = root, 0
    while isinstance(holder[key], (dict, list)) and holder[key] and random.random() < 0.8:
        holder = holder[key]
        key = int(random.integers(len(holder))) if isinstance(holder, list) else pick(random, list(holder))
    kind = random.integers(4)
    if kind == 0 and holder is not root:
        del holder[key]
    elif kind == 1 and isinstance(holder, list):
        holder.insert(int(random.integers(len(holder) + 1)), copy.deepcopy(holder[key]))
    else:
        holder[key] = pick(random, ODD_VALUES)
    return json.dumps(root[0])


def mutate_model(random: Random, data: bytes) -> bytes:
    """Return a model with changed bytes, metadata, nodes, constants or weights, mostly with a valid checksum."""
    import onnx
    from onnx import helper, numpy_helper

    from fdda_addon.core.formats.model import CHECKSUM_KEY, METADATA_KEY

    kind = random.integers(6)
    if kind == 0:
        return mutate_bytes(random, data)
    model = onnx.load_from_string(data)
    graph, properties = model.graph, {entry.key: entry for entry in model.metadata_props}
    node, tensor = pick(random, graph.node), pick(random, graph.initializer)
    name = pick(random, [name for each in graph.node for name in (*each.input, *each.output)])
    if kind == 1:
        properties[METADATA_KEY].value = mutate_json(random, json.loads(properties[METADATA_KEY].value))
    elif kind == 2:
        operator, shape = pick(random, OPERATORS), pick(random, (*graph.input, *graph.output)).type.tensor_type.shape
        (
            lambda: setattr(node, "op_type", operator),
            lambda: node.input.__setitem__(0, name),
            lambda: node.output.__setitem__(0, name),
            lambda: graph.node.remove(node),
            lambda: graph.node.append(helper.make_node(operator, [name, name], ["new", name][: random.integers(1, 3)])),
            lambda: node.attribute.append(helper.make_attribute("axis", int(random.integers(-5, 2**40)))),
            lambda: setattr(shape.dim[0], "dim_value", pick(random, ODD_SIZES)),
            lambda: graph.initializer.append(helper.make_tensor(name, onnx.TensorProto.INT64, [2], [2**20, 2**20])),
        )[random.integers(8)]()
    elif kind == 3:
        (
            lambda: tensor.dims.append(pick(random, ODD_SIZES)),
            lambda: setattr(tensor, "data_type", int(random.integers(0, 30))),
            lambda: setattr(tensor, "raw_data", mutate_bytes(random, tensor.raw_data)),
            lambda: graph.initializer.remove(tensor),
            lambda: (
                setattr(tensor, "data_location", 1),
                tensor.external_data.add(key="location", value="/etc/passwd"),
            ),
        )[random.integers(5)]()
    elif (array := numpy_helper.to_array(tensor).copy()).size:
        odd = ODD_NUMBERS if array.dtype.kind == "f" else np.array([-2, -1, 0, 1, 2, 100, 2**31, 2**62])
        array.reshape(-1)[random.integers(array.size, size=min(array.size, 20))] = pick(random, odd)
        tensor.CopyFrom(numpy_helper.from_array(array, tensor.name))
    if random.random() < 0.7:  # else the reader refuses the file before its other checks
        properties[CHECKSUM_KEY].value = hashlib.sha256(graph.SerializeToString()).hexdigest()
    return model.SerializeToString()


def play_model(folder: Path, random: Random) -> None:
    """Bind and play a damaged model: the mesh shows its exact output, or the rig."""
    import bpy

    from fdda_addon.rig.reading import PoseEvaluator, read_model_rig
    from fdda_addon.runtime.binding import bind, unbind
    from fdda_addon.runtime.model_files import network_of
    from fdda_addon.scene.scene_rig import find_rig

    path = folder / "damaged.onnx"
    path.write_bytes(mutate_model(random, (folder / "character.onnx").read_bytes()))
    rig = find_rig()
    mesh_object = rig.mesh_object
    try:
        bind(rig, path)
        for frame in (1, 9, 22):
            bpy.context.scene.frame_set(frame)
            if mesh_object.fdda.mode == "RIG":
                if not mesh_object.fdda.status:
                    raise CaseFailedError("the model was disabled without a message")
                return
            network = network_of(mesh_object)
            pose, shown, controls = PoseEvaluator(rig, read_model_rig(rig, network.info)).evaluate()
            expected = network.positions(pose[None], controls[None])[0]
            # Damaged weights may give infinity or NaN in some poses.
            if np.isfinite(expected).all() and np.abs(shown - expected).max() > 1e-6 * max(1, np.abs(expected).max()):
                raise CaseFailedError("the mesh differs from the output of the model")
    finally:
        unbind(mesh_object)
        mesh_object.fdda.property_unset("status")
    if mesh_object.fdda.is_playing or not all(modifier.show_viewport for modifier in mesh_object.modifiers):
        raise CaseFailedError("the rig was not restored")


def mutate_recording(random: Random, recording: Path) -> None:
    """Damage a file of a recording."""
    path = pick(random, sorted(path for path in recording.iterdir()))
    kind, index = random.integers(8), recording / "recording.json"
    if kind < 3:
        index.write_text(mutate_json(random, json.loads(index.read_text())))
    elif kind == 3 or path.suffix != ".npy":
        path.write_bytes(mutate_bytes(random, path.read_bytes()))
    elif kind == 4:
        path.unlink()
        (
            lambda: os.mkfifo(path),
            path.mkdir,
            lambda: path.symlink_to(pick(random, ("/dev/zero", "/etc/passwd", path.name))),
            lambda: path.touch() or os.truncate(path, 1 << 40),
            path.touch,
            lambda: None,
        )[random.integers(6)]()
    else:
        array = np.load(path)
        if kind == 5:
            array = np.resize(array, (pick(random, (0, 1, 7, 100)), *array.shape[1:]))
        elif kind == 6:
            array = array.astype(pick(random, ("f8", "f2", "i4", "i8", "u1", ">f4", "c8", "bool")))
        elif array.size:
            odd = ODD_NUMBERS if array.dtype.kind == "f" else np.array([-1, 0, 1, 2, 1000, 2**31 - 1])
            indices = random.integers(array.size, size=random.integers(1, 1 + min(array.size, 500)))
            array.reshape(-1)[indices] = random.choice(odd, len(indices))
        np.save(path, array)


def train_recording(folder: Path, random: Random) -> None:
    """Train on a damaged recording: it is refused before the training, or the model is finite."""
    from fdda_addon.core.recording.reader import read_recording
    from fdda_addon.runtime.network import Network
    from trainer.config import TrainingConfig
    from trainer.train import train_model

    recording, model, sent = folder / "damaged", folder / "of damaged" / "m.onnx", []

    class Sink:
        def send(self, message_type, **_) -> None:
            sent.append(message_type.name)

    for old in (recording, model.parent):
        shutil.rmtree(old, ignore_errors=True)
    model.parent.mkdir()
    shutil.copytree(folder / "short recording", recording)
    mutate_recording(random, recording)
    try:
        train_model(recording, model, TrainingConfig(passes=1, hidden=(4,), detail_mm=0.1), Sink())
    except FDDAError:
        if {"PROGRESS", "PREPARING"} & set(sent) or list(model.parent.iterdir()):
            raise CaseFailedError("the recording was refused after the training had begun") from None
        raise
    network, poses = Network(model), np.array(read_recording(recording).pose_matrices[:4])
    if not np.isfinite(network.positions(poses, np.zeros((4, len(network.info.controls)), np.float32))).all():
        raise CaseFailedError("the model outputs infinite or NaN positions")


def run_and_stop(random: Random, command: list, seconds: float) -> bool:
    """Run a command and kill, interrupt or end it after a time; return whether it was still running."""
    process = subprocess.Popen(list(map(str, command)), cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    try:
        output, _ = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        pick(random, (process.kill, process.terminate, lambda: process.send_signal(signal.SIGINT)))()
        process.communicate()
        return True
    if process.returncode:
        raise CaseFailedError(f"exit status {process.returncode}: {output.decode()[-300:]}")
    return False


def kill_process(folder: Path, random: Random) -> None:
    """Stop a recording, which then resumes to the same bytes, or a training, which leaves the old or a new model."""
    from fdda_addon.core.formats.model import read_model

    verb = [sys.executable, "-m", "fdda_addon"]
    if random.random() < 0.6:
        recording = folder / "killed recording"
        shutil.rmtree(recording, ignore_errors=True)
        record = [*verb, "record", folder / "elbow.blend", recording, "--poses", LONG_POSES]
        for seconds in (*random.uniform(0.5, 4, 3), MAX_SILENT_SECONDS / 2):
            if not run_and_stop(random, [*record, *(["--resume"] if recording.exists() else [])], float(seconds)):
                break
        for path in (folder / "long recording").glob("*.npy"):
            if path.read_bytes() != (recording / path.name).read_bytes():
                raise CaseFailedError(f"{path.name} differs from that of an uninterrupted recording")
        return
    model = folder / "killed training" / "m.onnx"
    model.parent.mkdir(exist_ok=True)
    shutil.copy(folder / "character.onnx", model)
    old = model.read_bytes()
    command = [sys.executable, "-m", "trainer", folder / "short recording", model, *TRAINING_OPTIONS]
    has_finished = not run_and_stop(random, command, float(random.uniform(0.2, 6)))
    if has_finished == (read_model(model)[1] == old):
        raise CaseFailedError("there is an old model after, or a new one before the end")


@contextlib.contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Path]:
    """Mount an empty disk with a size in bytes."""
    folder.mkdir(exist_ok=True)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mount(b"tmpfs", os.fsencode(folder), b"tmpfs", 0, f"size={size}".encode()):
        raise CaseFailedError("only root can mount a disk")
    try:
        yield folder
    finally:
        libc.umount2(os.fsencode(folder), 2)


def fill_disk(folder: Path, random: Random) -> None:
    """Run a verb on a disk of random size: it leaves nothing, but for the complete poses of a recording."""
    verb = pick(random, list(DISK_BYTES))
    with small_disk(folder / "small disk", int(random.uniform(4096, DISK_BYTES[verb]))) as disk:
        rig, model = folder / "elbow.blend", folder / "character.onnx"
        arguments = {
            "record": (rig, disk / "r", "--poses", POSES),
            "train": (folder / "short recording", disk / "m.onnx", *TRAINING_OPTIONS),
            "bind": (rig, model, disk / "b.blend"),
            "evaluate": (rig, model, "--json", disk / "e.json", "--poses", 2),
        }[verb]
        command = [sys.executable, "-m", "fdda_addon", verb, *map(str, arguments)]
        result = subprocess.run(
            command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=MAX_SILENT_SECONDS / 2
        )
        if result.returncode not in (0, DISK_FULL_STATUS) or "Traceback" in result.stderr:
            raise CaseFailedError(f"exit status {result.returncode}: {result.stderr[-300:]}")
        if result.returncode == DISK_FULL_STATUS:
            if verb != "record" and list(disk.iterdir()):
                raise CaseFailedError(f"{verb} left {[path.name for path in disk.iterdir()]}")
            raise FDDAError(result.stderr.strip().splitlines()[-1])


Part = Callable[[Path, Random], None]
PARTS: dict[str, tuple[Part, int]] = {
    "models": (play_model, 3000),
    "recordings": (train_recording, 2000),
    "kills": (kill_process, 45),
    "disks": (fill_disk, 40),
}
"""By name: what a case does in the folder of the files, and the number of cases."""


def work(folder: Path, part: str, seed: int, first: int, count: int) -> None:
    """Run cases in this process, and print each as a line of JSON."""
    if part == "models":
        import bpy

        import fdda_addon

        bpy.ops.wm.open_mainfile(filepath=str(folder / "elbow.blend"))
        fdda_addon.register()
    for index in range(first, count):
        # Linux resets the peak of the memory.
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
        start, memory = time.process_time(), read_memory("VmRSS")
        outcome, text = PASSED, ""
        try:
            PARTS[part][0](folder, np.random.default_rng((seed, index)))
        except FDDAError as error:
            text = str(error)
            outcome = REFUSED if re.fullmatch(r"[^\x00-\x1f\x7f]{1,1500}[.)]", text) else FAILED
        except Exception as error:
            outcome, text = FAILED, repr(error)
        seconds, peak = time.process_time() - start, read_memory("VmHWM") - memory
        if peak > MAX_MB or (seconds > MAX_SECONDS and part in ("models", "recordings")):
            outcome, text = FAILED, f"it took {peak:.0f} MB and {seconds:.0f} s; {text}"
        print(json.dumps({"case": f"{part} {index}", "outcome": outcome, "text": text}), flush=True)
    # Blender's own shutdown is not part of the test.
    os._exit(0)


def read_memory(name: str) -> float:
    """Read a memory value of this process, MB; 0 where the system is not Linux."""
    status = Path("/proc/self/status")
    return int(re.search(rf"{name}:\s*(\d+)", status.read_text())[1]) / 1024 if status.exists() else 0.0


def run_part(folder: Path, part: str, seed: int, count: int) -> Iterator[dict]:
    """Yield the cases of a part; a process that dies or hangs fails its case."""
    index = 0
    while index < count:
        command = [sys.executable, __file__, str(folder), "--seed", str(seed), "--work", part, str(index), str(count)]
        with open(folder / f"{part}.log", "a") as log:
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, errors="replace")
        timer = threading.Timer(MAX_SILENT_SECONDS, process.kill)
        timer.start()
        for line in process.stdout:
            if line.startswith('{"case"'):
                timer.cancel()
                timer = threading.Timer(MAX_SILENT_SECONDS, process.kill)
                timer.start()
                yield json.loads(line)
                index += 1
        timer.cancel()
        if process.wait() or index < count:
            text = f"its process ended with status {process.returncode} or was silent for {MAX_SILENT_SECONDS} s"
            yield {"case": f"{part} {index}", "outcome": FAILED, "text": text}
            index += 1


def main() -> int:
    """Run the cases; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--part", action="append", choices=PARTS, help="run only this part; may be repeated")
    parser.add_argument("--scale", type=float, default=1.0, help="factor for the numbers of cases")
    parser.add_argument("--work", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    folder = options.folder.absolute()
    if options.work:
        part, first, count = options.work
        work(folder, part, options.seed, int(first), int(count))
    folder.mkdir(parents=True, exist_ok=True)
    make_files(folder)
    failed = 0
    with open(folder / "cases.jsonl", "w", encoding="utf-8") as file:
        for part in options.part or PARTS:
            counts: Counter[str] = Counter()
            for case in run_part(folder, part, options.seed, max(1, round(PARTS[part][1] * options.scale))):
                counts[case["outcome"]] += 1
                file.write(json.dumps(case) + "\n")
                if case["outcome"] == FAILED:
                    print(f"{case['case']}: {case['text']}", flush=True)
            failed += counts[FAILED]
            print(f"{part}: {', '.join(f'{counts[outcome]:,} {outcome}' for outcome in sorted(counts))}", flush=True)
    return int(failed > 0)


def make_files(folder: Path) -> None:
    """Make the files of the elbow that do not exist yet: rig, recordings, model and bound file."""
    import bpy

    import fdda_addon
    from benchmarks.stress_playback import bind_elbow
    from fdda_addon.cli.main import main as run_verb

    fdda_addon.register()
    bind_elbow(folder, 1)
    for name, poses in (("short recording", POSES), ("long recording", LONG_POSES)):
        command = ["record", str(folder / "elbow.blend"), str(folder / name), "--poses", str(poses)]
        if not (folder / name).exists() and run_verb(command, "fdda"):
            sys.exit(1)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    fdda_addon.unregister()


if __name__ == "__main__":
    sys.exit(main())
