"""What the tests share: the real binaries as processes, rclpy nodes that are spun until something happens, and puzzles
with truth.

Nothing here sleeps: a test waits for an event, and a time limit turns a missing event into a failure.
"""

import contextlib
import json
import math
import os
import random
import shutil
import socket
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent.parent

# Read by the middleware when a participant is made, so before anything imports rclpy.
os.environ["FASTDDS_DEFAULT_PROFILES_FILE"] = str(HERE / "fastdds_loopback.xml")
os.environ["AMENT_PREFIX_PATH"] = sys.prefix
os.environ["RMW_IMPLEMENTATION"] = "rmw_fastrtps_cpp"
os.environ.pop("ROS_LOCALHOST_ONLY", None)

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy

EVENT_TIMEOUT = 60.0  # seconds until an awaited event counts as missing; on an idle machine all come within 2
EXIT_TIMEOUT = 30.0  # seconds that a process may take to end after SIGTERM; it takes at most 1 on an idle machine
REPEAT = 1.0  # seconds until something is done again whose effect has not shown

LATCHED = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)

# RTPS: the discovery port of the first participant of a domain, and what lies between those of two domains.
FIRST_PORT, PORTS_PER_DOMAIN = 7410, 250
LAST_DOMAIN = 99  # above about 100 the ports reach into those that Linux gives out


@pytest.fixture(scope="session")
def binaries():
    """The folder of the binaries, built if need be."""
    if given := os.environ.get("JIGSAW_BIN_DIR"):
        return Path(given)
    command = ["cargo", "build", "--quiet", "--workspace", "--bins", "--examples", "--message-format=json"]
    built = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, check=True, text=True)
    artifacts = (json.loads(line) for line in built.stdout.splitlines() if line.startswith("{"))
    executables = [Path(a["executable"]) for a in artifacts if a.get("executable")]
    return next(path.parent for path in executables if path.parent.name != "examples")


@pytest.fixture(scope="session")
def transcode(binaries):
    """The Rust side of the message types; see test_messages.py."""

    class Transcode:
        command = str(binaries / "examples" / "transcode")

        def __init__(self):
            self.process = subprocess.Popen(
                [self.command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
            )

        def types(self):
            return subprocess.run([self.command, "--types"], capture_output=True, text=True, check=True).stdout.split()

        def ask(self, full_name, data=None):
            """Decodes the bytes; without any, tells of the type's default."""
            line = full_name if data is None else f"{full_name} {bytes(data).hex()}"
            self.process.stdin.write(line + "\n")
            return json.loads(self.process.stdout.readline())

    transcode = Transcode()
    yield transcode
    transcode.process.stdin.close()
    try:
        assert transcode.process.wait(EXIT_TIMEOUT) == 0
    finally:
        transcode.process.kill()


@pytest.fixture
def domain():
    """A DDS domain that nobody uses, so that tests neither hear each other nor anything else on this machine."""
    first = 1 + random.SystemRandom().randrange(LAST_DOMAIN)
    for candidate in [1 + (first + k) % LAST_DOMAIN for k in range(LAST_DOMAIN)]:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("0.0.0.0", FIRST_PORT + PORTS_PER_DOMAIN * candidate))
            except OSError:
                continue
            return candidate
    pytest.fail("every DDS domain is in use")


def end_all(children, patience):
    """Ends processes as an operator would, and kills those that have not ended in time, or when waiting is cut short:
    an rclpy node may miss the signal, or spin in its middleware's own end for ever. Gives their exit codes."""
    due = time.monotonic() + patience
    try:
        for child in children:
            child.terminate()
        for child in children:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(max(0.0, due - time.monotonic()))
    finally:
        for child in children:
            child.kill()
    return [child.wait() for child in children]


@dataclass
class Process:
    """One of the binaries, running."""

    name: str
    child: subprocess.Popen
    log: Path

    def text(self):
        return self.log.read_text(errors="replace")

    def stop(self):
        """Ends it as an operator would; gives its exit code, that of a kill if it did not end in time."""
        (code,) = end_all([self.child], EXIT_TIMEOUT)
        return code

    def wait(self, timeout=EVENT_TIMEOUT):
        """Waits for it to end by itself; gives its exit code."""
        return self.child.wait(timeout)


@dataclass
class Launcher:
    """Starts binaries in one domain, and ends them with the test."""

    binaries: Path
    domain: int
    folder: Path
    processes: list = field(default_factory=list)

    def start(self, name, *arguments):
        log = self.folder / f"{len(self.processes)}_{name}.log"
        environment = os.environ | {"ROS_DOMAIN_ID": str(self.domain), "ROS_LOCALHOST_ONLY": "1"}
        with log.open("wb") as out:
            child = subprocess.Popen(
                [self.binaries / name, *map(str, arguments)],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
            )
        process = Process(name, child, log)
        self.processes.append(process)
        return process

    def run(self, name, *arguments, timeout=60):
        """Runs a binary to its end; gives its exit code and what it printed."""
        process = self.start(name, *arguments)
        code = process.wait(timeout)
        self.processes.remove(process)
        return code, process.text()

    def cell(self, *ros_arguments):
        """The three nodes, a process each."""
        arguments = ["--ros-args", *ros_arguments] if ros_arguments else []
        return [self.start(name, *arguments) for name in ("capture_node", "feature_node", "solver_node")]

    def kill_and_start_again(self, process):
        """As a fault and a supervisor do; gives the process that stands in its place."""
        process.child.kill()
        process.wait()
        self.processes.remove(process)
        return self.start(process.name, *process.child.args[1:])

    def stop_all(self):
        """Ends all that were started; gives names and exit codes of those that did not end cleanly."""
        codes = end_all([process.child for process in self.processes], EXIT_TIMEOUT)
        return [(process.name, code) for process, code in zip(self.processes, codes, strict=True) if code]


@pytest.fixture
def launcher(binaries, domain, tmp_path, request):
    launcher = Launcher(binaries, domain, tmp_path)
    yield launcher
    unclean = launcher.stop_all()
    for process in launcher.processes:  # shown by pytest where the test failed
        print(f"--- {process.name} ---\n{process.text()}")
    assert not unclean, f"nodes did not end cleanly: {unclean}"


class Harness:
    """A rclpy context in the test's domain, with nodes that are spun together."""

    def __init__(self, domain):
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.nodes = []

    def node(self, name, **options):
        node = rclpy.create_node(name, context=self.context, **options)
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def until(self, condition, what, timeout=EVENT_TIMEOUT, required=True):
        """Spins until the condition gives something true, and gives that back."""
        deadline = time.monotonic() + timeout
        while not (result := condition()):
            if time.monotonic() > deadline:
                if not required:
                    return None
                pytest.fail(f"after {timeout} s still no {what}")
            self.executor.spin_once(timeout_sec=0.05)
        return result

    def until_repeated(self, action, condition, what, period=REPEAT):
        """As `until`, doing something first and then again from time to time: a best-effort message may be lost, and
        what is not latched does not reach those who have not met yet."""
        due = -math.inf

        def shown():
            nonlocal due
            if result := condition():
                return result
            if (now := time.monotonic()) >= due:
                action()
                due = now + period
            return None

        return self.until(shown, what)

    def adopt(self, node):
        """Spins a node that was made elsewhere, in this context."""
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def call(self, client, request, timeout=EVENT_TIMEOUT):
        """Calls a service as soon as it is there, once, and gives its answer."""
        self.until(client.service_is_ready, f"service {client.srv_name}", timeout)
        return self.result(client.call_async(request), f"answer of {client.srv_name}", timeout)

    def result(self, future, what, timeout=EVENT_TIMEOUT):
        """Waits for a future and gives what came of it."""
        self.until(future.done, what, timeout)
        return future.result()

    def latest(self, node, message_type, topic, qos=LATCHED):
        """Subscribes; the returned list always holds what came."""
        received = []
        node.create_subscription(message_type, topic, received.append, qos)
        return received

    def first(self, message_type, topic, qos=LATCHED):
        """Waits for the first message on a topic, latched ones by default."""
        node = self.node(f"waits_for_{topic.strip('/').replace('/', '_')}")
        received = self.latest(node, message_type, topic, qos)
        return self.until(lambda: received, f"message on {topic}")[0]

    def close(self):
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def ros(domain):
    harness = Harness(domain)
    yield harness
    harness.close()


@dataclass
class Puzzle:
    """A generated puzzle: a folder of frames with one piece each, and what is true of it."""

    folder: Path
    truth: dict

    @property
    def frames(self):
        return [self.folder / piece["source"] for piece in self.truth["pieces"]]


@pytest.fixture(scope="session")
def generate(binaries, tmp_path_factory):
    """Generates puzzles by the command line, each once a session."""
    made = {}

    def generate(rows, columns, seed, *options):
        key = (rows, columns, seed, *options)
        if key not in made:
            folder = tmp_path_factory.mktemp("puzzle") / "frames"
            command = [binaries / "jigsaw", "generate", "--rows", rows, "--cols", columns, "--seed", seed]
            subprocess.run([*map(str, [*command, *options]), "--out", str(folder)], check=True, capture_output=True)
            made[key] = Puzzle(folder, json.loads((folder / "truth.json").read_text()))
        return made[key]

    yield generate
    for puzzle in made.values():
        shutil.rmtree(puzzle.folder)
