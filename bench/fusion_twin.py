"""The well-known filter of depth maps, with numpy and OpenCV: what `bench_fusion` compares itself with.

Per reference view: every neighbour's depth is sampled at the projection of the reference's pixels and
projected back; a neighbour agrees within 1 pixel and 1 % of the depth; pixels with a confidence of 0.8
that 3 views agree on (the reference included) are kept, with the mean of the agreeing depths.

Speaks lines: for each line on stdin the filter runs once, and a line with its seconds, by the clock and of CPU time, is printed. The
last result is written to FOLDER/twin_depth.f32 and FOLDER/twin_views.u8 when stdin ends.

    python3 bench/fusion_twin.py FOLDER    (numpy, opencv-python-headless)

FOLDER holds meta.txt (width, height, number of maps, then per map K and [R t], row by row), and per map
depth_I.f32 and confidence_I.f32; map 0 is the reference.
"""

import sys
import time
from pathlib import Path

import cv2
import numpy as np

MIN_CONFIDENCE = 0.8
MIN_VIEWS = 3
MAX_PIXELS = 1.0
MAX_RELATIVE = 0.01


def read(folder: Path):
    numbers = np.array((folder / "meta.txt").read_text().split(), dtype=np.float64)
    width, height, count = (int(n) for n in numbers[:3])
    cameras = numbers[3:].reshape(count, 21)
    maps = []
    for index, camera in enumerate(cameras):
        intrinsic = camera[:9].reshape(3, 3)
        extrinsic = np.vstack([camera[9:].reshape(3, 4), [0, 0, 0, 1]])
        depth = np.fromfile(folder / f"depth_{index}.f32", dtype=np.float32).reshape(height, width)
        maps.append((intrinsic, extrinsic, depth))
    confidence = np.fromfile(folder / "confidence_0.f32", dtype=np.float32).reshape(height, width)
    return maps, confidence


def transfer(pixels, depth, intrinsic_from, extrinsic_from, intrinsic_to, extrinsic_to):
    """Homogeneous pixels (3 x n) with depths (n) to pixels (2 x n) and depths (n) of another camera."""
    points = np.linalg.inv(intrinsic_from) @ (pixels * depth)
    points = (extrinsic_to @ np.linalg.inv(extrinsic_from) @ np.vstack([points, np.ones_like(depth)]))[:3]
    projected = intrinsic_to @ points
    return projected[:2] / projected[2], points[2]


def agreement(reference, neighbour, grid, pixels):
    """Which pixels of the reference the neighbour agrees with, and the depths it gives them."""
    (k_ref, e_ref, depth_ref), (k_src, e_src, depth_src) = reference, neighbour
    shape = depth_ref.shape
    there, _ = transfer(pixels, depth_ref.reshape(-1), k_ref, e_ref, k_src, e_src)
    u, v = (there[axis].reshape(shape).astype(np.float32) for axis in (0, 1))
    sampled = cv2.remap(depth_src, u, v, interpolation=cv2.INTER_LINEAR)
    at_source = np.vstack([there, np.ones(there.shape[1])])
    back, depth = transfer(at_source, sampled.reshape(-1), k_src, e_src, k_ref, e_ref)
    depth = depth.reshape(shape).astype(np.float32)
    x, y = (back[axis].reshape(shape).astype(np.float32) for axis in (0, 1))
    distance = np.sqrt((x - grid[0]) ** 2 + (y - grid[1]) ** 2)
    difference = np.abs(depth - depth_ref) / depth_ref
    mask = np.logical_and(distance < MAX_PIXELS, difference < MAX_RELATIVE)
    depth[~mask] = 0
    return mask, depth


def fuse(maps, confidence):
    reference = maps[0]
    depth_ref = reference[2]
    height, width = depth_ref.shape
    grid = np.meshgrid(np.arange(0, width), np.arange(0, height))
    pixels = np.vstack([grid[0].reshape(-1), grid[1].reshape(-1), np.ones(height * width)])
    total = depth_ref.copy()
    views = np.ones(depth_ref.shape, dtype=np.int32)
    for neighbour in maps[1:]:
        mask, depth = agreement(reference, neighbour, grid, pixels)
        views += mask
        total += depth
    keep = np.logical_and(confidence >= MIN_CONFIDENCE, views >= MIN_VIEWS)
    return np.where(keep, total / views, 0).astype(np.float32), np.where(keep, views, 0)


def main():
    folder = Path(sys.argv[1])
    maps, confidence = read(folder)
    fused = None
    print("ready", flush=True)
    for _ in sys.stdin:
        begun, cpu = time.perf_counter(), time.process_time()
        with np.errstate(all="ignore"):
            fused = fuse(maps, confidence)
        print(time.perf_counter() - begun, time.process_time() - cpu, flush=True)
    if fused is not None:
        fused[0].tofile(folder / "twin_depth.f32")
        fused[1].astype(np.uint8).tofile(folder / "twin_views.u8")


if __name__ == "__main__":
    main()
