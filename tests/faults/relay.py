"""An Ethernet switch between network namespaces that loses, delays, reorders and cuts, as it is told on standard input.

    relay.py NAME…        makes a tap device of each name and says "ready"; they may be moved to other namespaces then

| command | what it does |
| --- | --- |
| `loss SHARE` | each frame is lost with this probability |
| `delay SECONDS JITTER` | each frame comes this much later, and up to JITTER more: frames overtake one another |
| `cut NAME`, `mend NAME` | nothing goes through this port, or does again |
| `multicast on`, `multicast off` | whether frames to IPv4 multicast addresses pass |
| `clean NAME` | no loss and no delay from and to this port |

At the end of standard input it ends, and its devices with it. The order of losses is seeded.
"""

import fcntl
import heapq
import os
import random
import selectors
import struct
import sys
import time

TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
IPV4_MULTICAST = bytes.fromhex("01005e")


class Relay:
    def __init__(self, names):
        self.random = random.Random(1)
        self.ports = {name: self.open(name) for name in names}
        self.port_of = {}  # by MAC address
        self.cut, self.clean = set(), set()
        self.loss, self.delay, self.jitter, self.multicast = 0.0, 0.0, 0.0, True
        self.later = []  # (when, number, port, frame)
        self.frames = 0

    @staticmethod
    def open(name):
        device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH22x", name.encode(), IFF_TAP | IFF_NO_PI))
        return device

    def obey(self, line):
        command, *values = line.split()
        if command == "loss":
            self.loss = float(values[0])
        elif command == "delay":
            self.delay, self.jitter = map(float, values)
        elif command == "cut":
            self.cut.add(values[0])
        elif command == "mend":
            self.cut.discard(values[0])
        elif command == "clean":
            self.clean.add(values[0])
        elif command == "multicast":
            self.multicast = values[0] == "on"
        else:
            raise ValueError(line)

    def take(self, source):
        try:
            frame = os.read(self.ports[source], 65536)
        except OSError:  # the device is not up yet, or has no frame
            return
        self.port_of[frame[6:12]] = source
        if not self.multicast and frame[:3] == IPV4_MULTICAST:
            return
        target = self.port_of.get(frame[:6])
        for port in [target] if target else self.ports:
            if port != source:
                self.forward(frame, source, port)

    def forward(self, frame, source, port):
        if source in self.cut or port in self.cut:
            return
        if source in self.clean or port in self.clean:
            self.send(frame, port)
        elif self.random.random() >= self.loss:
            wait = self.delay + self.jitter * self.random.random()
            if wait > 0:
                self.frames += 1
                heapq.heappush(self.later, (time.monotonic() + wait, self.frames, port, frame))
            else:
                self.send(frame, port)

    def send(self, frame, port):
        try:
            os.write(self.ports[port], frame)
        except OSError:  # not up yet, or full: a switch drops then
            pass

    def run(self):
        selector = selectors.DefaultSelector()
        selector.register(sys.stdin, selectors.EVENT_READ)
        for name, device in self.ports.items():
            selector.register(device, selectors.EVENT_READ, name)
        print("ready", flush=True)
        while True:
            wait = max(0.0, self.later[0][0] - time.monotonic()) if self.later else None
            for key, _ in selector.select(wait):
                if key.data is not None:
                    self.take(key.data)
                elif line := sys.stdin.readline():
                    self.obey(line)
                    print("done", flush=True)
                else:
                    return
            while self.later and self.later[0][0] <= time.monotonic():
                _, _, port, frame = heapq.heappop(self.later)
                self.send(frame, port)


if __name__ == "__main__":
    Relay(sys.argv[1:]).run()
