"""Figures of the cell under load: latency, throughput, memory. Not a test; it prints tables.

    tests/setup_venv.sh                                        once
    cargo build --release
    target/rclpy-venv/bin/python tests/rclpy/load.py latency   24 pieces at 30 Hz and as fast as possible
    target/rclpy-venv/bin/python tests/rclpy/load.py soak      10 000 frames at the highest rate without loss

A camera (this process, rclpy) shows raw frames to the three nodes (release binaries, a process each) over DDS on
loopback and hears what comes of them. Latency runs from the publication of a frame to the arrival of the message here:
the features of its piece; the first assembly that knows the piece; the complete assembly, from the last frame. Beside
it, in the same run and on the same frames, a plain rclpy node that does nothing but publish each frame again.
"""

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy
import rclpy
from builtin_interfaces.msg import Time
from jigsaw_msgs.msg import Assembly, PieceFeatures
from PIL import Image as Picture
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

import conftest  # noqa: F401  (sets the middleware's environment before rclpy is imported)
from bench import BEST_EFFORT, LATCHED_PIECES, image_message
from conftest import LATCHED, ROOT, end_all

NODES = ("capture_node", "feature_node", "solver_node")
RATE = 30.0  # frames a second, where they do not come as fast as possible
UNDER_WAY = 4  # frames that may be without features, as fast as possible: one a stage, and one on the way
PATIENCE = 30.0  # seconds until something awaited counts as lost
END_PATIENCE = 5.0  # seconds until a process that was told to end is killed
LAST_WORDS = 10  # lines of a node's log that are shown where the run fails
RELAY = "relayed"


def relay(domain):
    """The plain node to compare with."""
    rclpy.init(domain_id=domain)
    node = rclpy.create_node("relay")
    publisher = node.create_publisher(Image, RELAY, BEST_EFFORT)
    node.create_subscription(Image, "image", publisher.publish, BEST_EFFORT)
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


class Camera:
    """Shows frames; notes when each went out and when what came of it came in."""

    def __init__(self, domain):
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("camera", context=self.context)
        self.publisher = self.node.create_publisher(Image, "image", BEST_EFFORT)
        self.node.create_subscription(PieceFeatures, "pieces/features", self.take_features, LATCHED_PIECES)
        self.node.create_subscription(Assembly, "assembly", self.take_assembly, LATCHED)
        self.node.create_subscription(Image, RELAY, self.take_relayed, BEST_EFFORT)
        self.reset_client = self.node.create_client(Trigger, "reset")
        self.changed = threading.Condition()
        self.forget()
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(self.node)
        threading.Thread(target=executor.spin, daemon=True).start()

    def forget(self):
        """Begins anew."""
        self.sent, self.features, self.assembled, self.relayed = {}, {}, {}, {}
        self.complete = None
        self.counts = {}

    @staticmethod
    def stamp(message):
        return message.header.stamp.sec, message.header.stamp.nanosec

    def note(self, action):
        now = time.perf_counter()
        with self.changed:
            action(now)
            self.changed.notify_all()

    def take_features(self, message):
        def note(now):
            self.features.setdefault(self.stamp(message), now)
            self.counts[message.id] = self.counts.get(message.id, 0) + 1

        self.note(note)

    def take_relayed(self, message):
        self.note(lambda now: self.relayed.setdefault(self.stamp(message), now))

    def take_assembly(self, message):
        def note(now):
            for name in [piece.id for piece in message.pieces] + list(message.unplaced):
                second, nanosecond = map(int, name.split("_")[:2])
                self.assembled.setdefault((second, nanosecond), now)
            if message.state == Assembly.COMPLETE:
                self.complete = (now, len(message.pieces))

        self.note(note)

    def has_all_features(self):
        """Whether the shape of every frame's piece has come."""
        return len(self.features) == len(self.sent)

    def is_complete(self, pieces):
        """Whether the latest complete assembly has this many pieces, as a condition to wait for."""
        return lambda: self.complete is not None and self.complete[1] == pieces

    def show(self, message):
        self.sent.setdefault(self.stamp(message), time.perf_counter())
        self.publisher.publish(message)

    def until(self, condition, what):
        with self.changed:
            if not self.changed.wait_for(condition, PATIENCE):
                raise SystemExit(f"load: no {what} within {PATIENCE} s: {self.sent.keys() - self.features.keys()}")

    def reset(self):
        """The solver forgets all pieces."""
        answer = self.reset_client.call_async(Trigger.Request())
        answer.add_done_callback(lambda _: self.note(lambda now: None))
        self.until(answer.done, "answer of reset")
        with self.changed:
            self.forget()


def puzzles(binaries, folder, rows, columns, count, seed):
    """Generated puzzles as lists of messages, every frame with a stamp of its own."""
    for k in range(count):
        out = folder / f"puzzle{seed + k}"
        options = f"generate --rows {rows} --cols {columns} --seed {seed + k} --frame 400x400 --noise 0.5 --blur 0.8"
        subprocess.run([binaries / "jigsaw", *options.split(), "--out", out], check=True, capture_output=True)
        pieces = json.loads((out / "truth.json").read_text())["pieces"]
        yield [
            image_message(numpy.asarray(Picture.open(out / piece["source"]).convert("L")), Time(sec=1000 * (k + 1) + i))
            for i, piece in enumerate(pieces)
        ]


def resident_mb(process):
    pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def row(name, seconds):
    if not seconds:
        return
    milliseconds = numpy.array(seconds) * 1e3
    p50, p99 = numpy.percentile(milliseconds, [50, 99])
    print(f"| {name} | {len(milliseconds)} | {p50:.1f} | {p99:.1f} | {milliseconds.max():.1f} |", flush=True)


def show_all(camera, frames, pace):
    begun = time.perf_counter()
    for k, message in enumerate(frames):
        if pace:
            time.sleep(max(0.0, begun + k / pace - time.perf_counter()))
        else:
            camera.until(lambda: len(camera.sent) - len(camera.features) < UNDER_WAY, "features")
        camera.show(message)


def latency(camera, sets, rounds):
    for name, pace in (("30 Hz", RATE), ("as fast as possible", None)):
        features, assembled, complete, relayed, rates = [], [], [], [], []
        try:
            # The first round warms everything up and is not counted.
            for round_number in range(rounds + 1):
                for frames in sets:
                    camera.reset()
                    show_all(camera, frames, pace)
                    camera.until(camera.is_complete(len(frames)), "complete assembly")
                    camera.until(camera.has_all_features, "features of every frame")
                    if round_number == 0:
                        continue
                    with camera.changed:
                        features += [camera.features[s] - t for s, t in camera.sent.items()]
                        assembled += [camera.assembled[s] - t for s, t in camera.sent.items()]
                        relayed += [camera.relayed[s] - t for s, t in camera.sent.items() if s in camera.relayed]
                        complete.append(camera.complete[0] - max(camera.sent.values()))
                        rates.append(len(frames) / (max(camera.sent.values()) - min(camera.sent.values())))
        finally:  # a run that is cut short tells what it has measured
            rate = f"{numpy.median(rates):.0f} frames/s" if rates else "no figures"
            print(f"\n{name} ({rate}), {len(sets[0])} pieces a puzzle, {len(complete)} puzzles")
            print("| from frame to | samples | p50 [ms] | p99 [ms] | max [ms] |\n| --- | --- | --- | --- | --- |")
            row("the same frame through a plain rclpy relay", relayed)
            row("features", features)
            row("first assembly with the piece", assembled)
            row("complete assembly (from the last frame)", complete)


def soak(camera, frames, total, pace, processes):
    print("| frames | " + " | ".join(f"{name} [MB]" for name in NODES) + " | frames/s |")
    print("| --- " * (len(NODES) + 2) + "|")
    camera.reset()
    shown, sizes, begun = 0, [], time.perf_counter()
    counts = {}
    while shown < total:
        show_all(camera, frames, pace)
        camera.until(camera.has_all_features, "features of every frame")
        with camera.changed:
            for name, count in camera.counts.items():
                counts[name] = counts.get(name, 0) + count
            complete = camera.complete
            camera.forget()
            camera.complete = complete
        shown += len(frames)
        if shown // 1000 != (shown - len(frames)) // 1000:
            memory = [resident_mb(processes[name]) for name in NODES]
            sizes.append(memory)
            rate = shown / (time.perf_counter() - begun)
            print(f"| {shown} | " + " | ".join(f"{m:.1f}" for m in memory) + f" | {rate:.0f} |", flush=True)
    camera.until(camera.is_complete(len(frames)), "complete assembly")
    half = len(sizes) // 2
    growth = [numpy.array(sizes[k:]).max(axis=0) / numpy.array(sizes[k]) for k in (0, half)]
    grown = [", ".join(f"{name} {100 * (g - 1):+.1f} %" for name, g in zip(NODES, gs, strict=True)) for gs in growth]
    times = ", ".join(map(str, sorted(set(counts.values()))))
    print(f"\n{shown} frames of {len(frames)} pieces, {shown // len(frames)} times each; features came {times} times.")
    print(f"Complete: {complete[1]} pieces. Most memory later, against that after 1000 frames: {grown[0]};")
    print(f"against that after half of the frames: {grown[1]}.")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["latency", "soak", "relay"])
    parser.add_argument("--domain", type=int, default=int(os.environ.get("ROS_DOMAIN_ID", 89)))
    parser.add_argument("--binaries", type=Path, default=ROOT / "target/release")
    parser.add_argument("--rounds", type=int, default=20, help="times that each of 5 puzzles is shown")
    parser.add_argument("--frames", type=int, default=10_000, help="frames of the soak")
    parser.add_argument("--rate", type=float, help="frames a second of the soak (as fast as possible)")
    arguments = parser.parse_args()
    if arguments.what == "relay":
        return relay(arguments.domain)
    # Whoever ends this ends what it has started, too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("load: ended by a signal"))
    # One arena, as launch-scripts/cell.sh has it.
    environment = os.environ | {
        "ROS_DOMAIN_ID": str(arguments.domain),
        "ROS_LOCALHOST_ONLY": "1",
        "MALLOC_ARENA_MAX": "1",
    }
    size = {"latency": (4, 6, 5), "soak": (8, 12, 1)}[arguments.what]
    expected = ["--ros-args", "-p", f"solver_node:expected_pieces:={size[0] * size[1]}"]
    commands = {name: [arguments.binaries / name, *expected] for name in NODES}
    if arguments.what == "latency":
        commands["relay"] = [sys.executable, __file__, "relay", "--domain", str(arguments.domain)]
    with tempfile.TemporaryDirectory() as folder, running(commands, environment, Path(folder)) as processes:
        sets = list(puzzles(arguments.binaries, Path(folder), *size, seed=500))
        camera = Camera(arguments.domain)
        warm_up(camera, sets[0][0], "relay" in processes)
        if arguments.what == "latency":
            latency(camera, sets, arguments.rounds)
        else:
            soak(camera, sets[0], arguments.frames, arguments.rate, processes)


@contextlib.contextmanager
def running(commands, environment, folder):
    """The processes of these commands by their names; none of them is left in the end, whatever happens."""
    processes = {}
    try:
        for name, command in commands.items():
            with open(folder / f"{name}.log", "wb") as log:
                processes[name] = subprocess.Popen(command, env=environment, stderr=log)
        yield processes
    except BaseException:
        for name in processes:
            lines = (folder / f"{name}.log").read_text(errors="replace").splitlines()[-LAST_WORDS:]
            print(f"--- {name} ---", *lines, sep="\n", file=sys.stderr)
        raise
    finally:
        end_all(processes.values(), END_PATIENCE)


def warm_up(camera, frame, relayed):
    """Shows a frame until all have met all: an assembly tells of it, and the relay, if there is one, has it."""
    for _ in range(100):
        camera.show(frame)
        with camera.changed:
            if camera.changed.wait_for(lambda: camera.assembled and (camera.relayed or not relayed), 0.5):
                return
    raise SystemExit("load: the nodes do not answer")


if __name__ == "__main__":
    main()
