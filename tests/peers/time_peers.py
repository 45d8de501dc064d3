"""Times OpenCV and scikit-image on frames beside the isthmus crate, and prints the ratios.

Each peer does what it offers of the same work: a threshold, the border as a list of points, a skeleton with its distances. None
finds isthmuses. All run on one thread, on the same pixels; the least time of several runs counts.
"""

import argparse
import pathlib
import subprocess
import sys
import time

import cv2
import numpy as np
from skimage import filters, measure, morphology

LEAST_RUNS = 3
BUDGET_S = 2.0


def least_ms(work):
    """Least time of several runs, in milliseconds."""
    times = []
    start = time.perf_counter()
    while len(times) < LEAST_RUNS or time.perf_counter() - start < BUDGET_S:
        before = time.perf_counter()
        work()
        times.append(time.perf_counter() - before)
    return 1e3 * min(times)


def peers(grey):
    """Name and work of each peer, for a grey frame with a dark shape on bright ground."""
    _, shape = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY_INV + cv2.THRESH_OTSU)
    inside = shape > 0

    def whole_opencv():
        _, mask = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY_INV + cv2.THRESH_OTSU)
        cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        cv2.distanceTransform(255 - mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)

    def whole_skimage():
        mask = grey < filters.threshold_otsu(grey)
        measure.find_contours(grey, 128.0)
        morphology.medial_axis(mask, return_distance=True)
        morphology.medial_axis(~mask, return_distance=True)

    return [
        ("OpenCV: Otsu's threshold", lambda: cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY_INV + cv2.THRESH_OTSU)),
        (
            "OpenCV: border following (whole pixels)",
            lambda: cv2.findContours(shape, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE),
        ),
        (
            "OpenCV: distance transform, exact, inside",
            lambda: cv2.distanceTransform(shape, cv2.DIST_L2, cv2.DIST_MASK_PRECISE),
        ),
        ("OpenCV: threshold, border, distances on both sides", whole_opencv),
        ("scikit-image: marching squares (sub-pixel)", lambda: measure.find_contours(grey, 128.0)),
        ("scikit-image: medial axis, inside", lambda: morphology.medial_axis(inside, return_distance=True)),
        ("scikit-image: thinning, inside", lambda: morphology.skeletonize(inside)),
        ("scikit-image: threshold, border, medial axes on both sides", whole_skimage),
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("frames", nargs="+", type=pathlib.Path, help="grey pictures with dark shapes on bright ground")
    parser.add_argument("--extractor", required=True, type=pathlib.Path, help="the built example `time_frames` of the isthmus crate")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    for path in arguments.frames:
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if grey is None:
            sys.exit(f"{path} is no picture")
        done = subprocess.run([arguments.extractor, path], capture_output=True, text=True, check=True)
        ours = float(done.stdout)
        print(f"\n{path.name}, {grey.shape[1]} x {grey.shape[0]}\n")
        print("| work | ms | times isthmus |\n| --- | ---: | ---: |")
        print(f"| isthmus: grey frame to border, isthmuses and both skeletons | {ours:.2f} | 1 |")
        for name, work in peers(np.ascontiguousarray(grey)):
            ms = least_ms(work)
            print(f"| {name} | {ms:.2f} | {ms / ours:.1f} |")


if __name__ == "__main__":
    main()
