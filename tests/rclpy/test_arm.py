"""An arm that follows the cell puts a puzzle together: its motions are done to the pieces in a picture of the table,
where somebody has moved one meanwhile."""

import json
import math
import os
import subprocess
import sys

import numpy
from builtin_interfaces.msg import Time
from PIL import Image as Picture

from bench import METRES_PER_PIXEL, SCALE, Arm, Camera, image_message
from conftest import EVENT_TIMEOUT, ROOT

WIDTH, HEIGHT = 2700, 1300  # of the table as the camera sees it
PITCH = 340  # px between the pieces as they lie, in the left half
ASIDE = 1700.0, 300.0, 0.7  # where somebody lays a piece, and how it is turned
ORIGIN = 2500, 1150  # px where the puzzle's bottom left corner is to lie,
QUARTER = math.pi / 2  # turned by so much: the puzzle lies to the left of it, on its right side
BRIGHT, DARK = 225.0, 30.0  # grey levels of the light table and of the pieces on it, as the generator has them
TOLERATED = 0.002  # of the puzzle's area, that is covered twice or not at all: a seventh of a pixel along all joints


class Table:
    """Pieces on a table, seen from above: each a patch of covered pixels, laid down by the middle of the patch."""

    def __init__(self, puzzle):
        self.patches, self.poses = [], []
        for k, frame in enumerate(puzzle.frames):
            with Picture.open(frame) as picture:
                grey = numpy.asarray(picture.convert("L")).astype(numpy.float32)
            self.patches.append(Picture.fromarray((BRIGHT - grey) / (BRIGHT - DARK)))
            self.poses.append((200.0 + PITCH * (k % 4), 200.0 + PITCH * (k // 4), 0.0))

    def nearest(self, x, y):
        """The piece that lies there."""
        return min(range(len(self.poses)), key=lambda k: math.dist(self.poses[k][:2], (x, y)))

    def coverage(self, pieces=None):
        """How many pieces cover each pixel: all, or the first so many."""
        side = 2 * max(self.patches[0].size)  # a turned patch fits in, and a rim of this width takes what sticks out
        total = numpy.zeros((HEIGHT + 2 * side, WIDTH + 2 * side), numpy.float32)
        for patch, (x, y, turn) in list(zip(self.patches, self.poses, strict=True))[:pieces]:
            cos, sin = math.cos(turn), math.sin(turn)
            left, top = int(x) - side // 2, int(y) - side // 2
            # Where each pixel of the table lies in the patch; Pillow's pixel centres lie at halves.
            u, v = left - x - 0.5, top - y - 0.5
            middle = [size / 2 for size in patch.size]
            where = (cos, sin, cos * u + sin * v + middle[0], -sin, cos, cos * v - sin * u + middle[1])
            seen = patch.transform((side, side), Picture.Transform.AFFINE, where, Picture.Resampling.BICUBIC)
            total[top + side : top + 2 * side, left + side : left + 2 * side] += numpy.asarray(seen)
        return total[side:-side, side:-side]

    def picture(self, pieces=None):
        """The table in grey levels."""
        return numpy.clip(BRIGHT - (BRIGHT - DARK) * self.coverage(pieces), 0, 255).round().astype(numpy.uint8)


def pixels(pose):
    """A pose on the table (metres, y up, from the middle of the picture) in pixels, y down."""
    x, y = pose["x"] / METRES_PER_PIXEL, pose["y"] / METRES_PER_PIXEL
    return (WIDTH - 1) / 2 + x, (HEIGHT - 1) / 2 - y, -pose["yaw"]


def test_what_the_arm_is_told_puts_the_puzzle_together(launcher, ros, domain, generate):
    table = Table(generate(3, 4, 9, "--frame", "360x360", "--piece-size", 190, "--blur", 0.8))
    launcher.cell(*SCALE)
    x, y = [(ORIGIN[0] - (WIDTH - 1) / 2) * METRES_PER_PIXEL, ((HEIGHT - 1) / 2 - ORIGIN[1]) * METRES_PER_PIXEL]
    wanted = [
        word for name, value in {"x": x, "y": y, "yaw": QUARTER}.items() for word in ("-p", f"puzzle_{name}:={value}")
    ]
    arm = subprocess.Popen(
        [sys.executable, ROOT / "launch-scripts/arm.py", "--ros-args", *wanted],
        env=os.environ | {"ROS_DOMAIN_ID": str(domain)},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        camera, looker = Camera(ros), Arm(ros, name="looker")

        def show(second, picture, new):
            def ids():
                return {features.id for features in camera.features.get(second, [])}

            camera.show(image_message(picture, Time(sec=second)), seen=lambda: len(ids()) >= new)
            ros.until(lambda: all(map(looker.knows, ids())), f"assembly with what is new in picture {second}")

        # All pieces but one, of which one is moved before the last is laid down.
        show(1, table.picture(11), 11)
        table.poses[4] = ASIDE
        show(2, table.picture(11), 1)
        show(3, table.picture(), 1)
        told, _ = arm.communicate(timeout=EVENT_TIMEOUT)
    finally:
        arm.kill()
    assert arm.returncode == 0
    motions = [json.loads(line) for line in told.splitlines()]
    assert len({motion["piece"] for motion in motions}) == len(table.poses)
    for motion in motions:
        (from_x, from_y, from_turn), (to_x, to_y, to_turn) = pixels(motion["pick"]), pixels(motion["place"])
        k = table.nearest(from_x, from_y)
        x, y, turn = table.poses[k]
        by = to_turn - from_turn
        about = complex(x - from_x, y - from_y) * complex(math.cos(by), math.sin(by))
        table.poses[k] = (to_x + about.real, to_y + about.imag, turn + by)

    coverage = table.coverage()
    ys, xs = numpy.nonzero(coverage > 0.5)
    assert abs(xs.max() - ORIGIN[0]) <= 2 and abs(ys.max() - ORIGIN[1]) <= 2, "the corner lies where it was wanted"
    inside = coverage[ys.min() + 2 : ys.max() - 1, xs.min() + 2 : xs.max() - 1]
    twice, never = numpy.clip(inside - 1, 0, None).sum(), numpy.clip(1 - inside, 0, None).sum()
    assert max(twice, never) <= TOLERATED * inside.size, f"{twice:.0f} px twice, {never:.0f} px never covered"
