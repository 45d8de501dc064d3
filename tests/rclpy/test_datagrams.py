"""Malformed network packets: what RustDDS makes of them, and what is left of the cell afterwards.

Datagrams that a working cell exchanges are recorded on the loopback interface (which takes the right to do so), changed
at random, and thrown at every port that a node listens on. A node that ends is started again, as `cell.sh` does.
"""

import random
import re
import socket
import struct
import threading
import time
from pathlib import Path

import pytest

from bench import SCALE, Arm, Camera, check_assembly
from conftest import Harness

MEMORY = 1024  # MiB of address space that a node may take
RECOVERY = 60.0  # seconds until nodes that were started again know each other
SEEDS = (1, 2)
BURST, BURSTS = 50, 60  # datagrams at each node for each seed: without a pause as many as fit into a buffer
PACE = 0.005  # seconds between two bursts
ETH_P_IP, UDP, ETHERNET_LENGTH, UDP_LENGTH = 0x0800, 17, 14, 8
RTPS_HEADER = 20
EXTREMES = (b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\x00\x00\x00\x00")
# Submessages by their numbers (RTPS 9.4.5.1.1), of which each has to be among what is changed.
KINDS = {"ACKNACK": 0x06, "HEARTBEAT": 0x07, "INFO_TS": 0x09, "INFO_DST": 0x0E, "DATA": 0x15}


class Recorder:
    """What passes over the loopback interface, from now on."""

    def __init__(self):
        self.socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_IP))
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 24)
        self.socket.bind(("lo", 0))
        self.socket.setblocking(False)

    def datagrams_to(self, ports):
        """The RTPS messages to these ports so far, each once."""
        found = {}
        while True:
            try:
                frame = self.socket.recv(1 << 16)
            except BlockingIOError:
                return list(found)
            header = ETHERNET_LENGTH + (frame[ETHERNET_LENGTH] & 15) * 4
            fragment = struct.unpack_from(">H", frame, ETHERNET_LENGTH + 6)[0] & 0x1FFF
            if frame[ETHERNET_LENGTH + 9] != UDP or fragment:
                continue
            payload = frame[header + UDP_LENGTH :]
            if struct.unpack_from(">H", frame, header + 2)[0] in ports and payload[:4] == b"RTPS":
                found[payload] = True


def kinds(message):
    """The numbers of the submessages of a message."""
    at, numbers = RTPS_HEADER, []
    while at + 4 <= len(message):
        number, flags = message[at], message[at + 1]
        (length,) = struct.unpack_from("<H" if flags & 1 else ">H", message, at + 2)
        numbers.append(number)
        if not length:
            break
        at += 4 + length
    return numbers


def ports_of(process):
    """The UDP ports that a process listens on."""
    inodes = set()
    for link in Path(f"/proc/{process.child.pid}/fd").iterdir():
        try:
            inodes |= set(re.findall(r"socket:\[(\d+)\]", str(link.readlink())))
        except OSError:  # closed meanwhile
            continue
    lines = Path("/proc/net/udp").read_text().splitlines()[1:]
    rows = [line.split() for line in lines]
    return sorted({int(row[1].split(":")[1], 16) for row in rows if row[9] in inodes})


def changed(message, generator):
    """The message with something wrong in it."""
    data = bytearray(message)
    for _ in range(generator.choice((1, 1, 2, 4))):
        way = generator.randrange(5)
        if len(data) <= RTPS_HEADER:
            break
        at = generator.randrange(RTPS_HEADER, len(data))
        if way == 0:
            data[at] ^= 1 << generator.randrange(8)
        elif way == 1:
            at -= at % 4
            data[at : at + 4] = generator.choice(EXTREMES)
        elif way == 2:
            data[at] = generator.randrange(256)
        elif way == 3:
            del data[at : at + generator.choice((1, 4, 64, 1 << 16))]
        else:
            data[at:at] = data[at : at + generator.choice((4, 64))]
    return bytes(data)


class Supervisor(threading.Thread):
    """Starts again what ends, as `cell.sh` does."""

    def __init__(self, launcher, arguments):
        super().__init__(daemon=True)
        self.launcher, self.arguments = launcher, arguments
        self.ended = []  # names, exit codes and last lines
        self.started = threading.Condition()
        self.done = threading.Event()

    def run(self):
        while not self.done.wait(0.1):
            for at, node in enumerate(self.launcher.processes):
                if node.child.poll() is not None:
                    lines = [line for line in node.text().splitlines() if "memory" in line or "deaf" in line]
                    self.ended.append((node.name, node.child.returncode, lines[-1:]))
                    self.launcher.start(node.name, *self.arguments)
                    with self.started:
                        self.launcher.processes[at] = self.launcher.processes.pop()
                        self.started.notify_all()

    def replace_all(self):
        """Kills every node and waits until another stands in its place."""
        for at in range(len(self.launcher.processes)):
            with self.started:
                node = self.launcher.processes[at]
                node.child.kill()
                replaced = self.started.wait_for(lambda: self.launcher.processes[at] is not node, RECOVERY)  # noqa: B023
                assert replaced, f"{node.name} was not started again"

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        self.done.set()
        self.join()


def solve(domain, puzzle):
    """Shows the puzzle and checks what comes of it."""
    harness = Harness(domain)
    try:
        camera, arm = Camera(harness), Arm(harness)
        harness.until(lambda: camera.publisher.get_subscription_count() > 0, "capture node", RECOVERY)
        truth = camera.show_puzzle(puzzle)
        check_assembly(arm, truth, arm.complete(len(truth)))
    finally:
        harness.close()


def test_malformed_datagrams(launcher, domain, generate):
    try:
        recorder = Recorder()
    except PermissionError:
        pytest.skip("recording packets takes a right that this user has not")
    arguments = ("--ros-args", *SCALE, "-p", f"maximum_memory:={MEMORY}")
    names = [launcher.start(name, *arguments).name for name in ("capture_node", "feature_node", "solver_node")]
    puzzle = generate(2, 3, 5)
    solve(domain, puzzle)
    recorded = recorder.datagrams_to({port for node in launcher.processes for port in ports_of(node)})
    assert {number for message in recorded for number in kinds(message)} >= set(KINDS.values())

    most = 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as thrower, Supervisor(launcher, arguments) as supervisor:
        for seed in SEEDS:
            generator = random.Random(seed)
            for at in [at for _ in range(BURSTS) for at in range(len(names))]:
                node = launcher.processes[at]
                try:
                    ports = ports_of(node)
                    status = Path(f"/proc/{node.child.pid}/status").read_text()
                except OSError:  # it has ended
                    continue
                most = max([most, *map(int, re.findall(r"VmHWM:\s+(\d+)", status))])
                for _ in range(BURST if ports else 0):
                    message = changed(generator.choice(recorded), generator)[:65000]
                    thrower.sendto(message, ("127.0.0.1", generator.choice(ports)))
                time.sleep(PACE)
        # What was forged in a node's name stands for its own samples until the node is another one.
        supervisor.replace_all()
        solve(domain, puzzle)
    thrown = len(SEEDS) * BURST * BURSTS
    print(f"{thrown} datagrams made of {len(recorded)} at each node; most memory {most} kB; ended: {supervisor.ended}")
    assert most < MEMORY * 1024
    # No node ends as one that was told to, nor for a reason after which it is not started again.
    assert all(code not in (0, 2) for _, code, _ in supervisor.ended)
