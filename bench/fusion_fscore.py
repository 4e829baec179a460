"""F-score of clouds against the true depth of a result's views.

    python3 bench/fusion_fscore.py OUT DEPTH_GT TAU[,TAU...] CLOUD.ply...    (numpy, scipy)

OUT is a folder that `reconstruct` made, DEPTH_GT holds NAME.pfm; TAU are distances in scene units, or
shares of the median true depth when they end in %. The truth is every pixel of every true map; it and
the clouds are thinned to voxels of TAU/2. Precision is the share of a cloud within TAU of the truth,
recall the share of the truth within TAU of the cloud.
"""

import json
import sys
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree


def read_pfm(path):
    with open(path, "rb") as file:
        assert file.readline().strip() == b"Pf"
        width, height = (int(n) for n in file.readline().split())
        scale = float(file.readline())
        values = np.frombuffer(file.read(), dtype="<f4" if scale < 0 else ">f4")
    return values.reshape(height, width)[::-1].astype(np.float64)


def truth(out, folder):
    record = json.loads((out / "run.json").read_text())
    points, depths = [], []
    for view in record["views"]:
        path = folder / (view["file"] + ".pfm")
        if not path.exists():
            continue
        depth = read_pfm(path)
        height, width = depth.shape
        camera = view["image_camera"]
        k = camera["intrinsics"]
        sx, sy = width / k["width"], height / k["height"]
        fx, fy = k["fx"] * sx, k["fy"] * sy
        cx, cy = (k["cx"] + 0.5) * sx - 0.5, (k["cy"] + 0.5) * sy - 0.5
        rotation = np.array(camera["pose"]["rotation"], dtype=np.float64).reshape(3, 3).T  # by columns
        translation = np.array(camera["pose"]["translation"], dtype=np.float64).reshape(3)
        v, u = np.nonzero(np.isfinite(depth) & (depth > 0))
        z = depth[v, u]
        local = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=1)
        points.append((local - translation) @ rotation)
        depths.append(z)
    return np.concatenate(points), float(np.median(np.concatenate(depths)))


def read_ply(path):
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    header = data[:end].decode().splitlines()
    count = next(int(line.split()[2]) for line in header if line.startswith("element vertex"))
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    properties = [line.split() for line in header if line.startswith("property")]
    dtype = np.dtype([(name, kinds[kind]) for _, kind, name in properties])
    vertices = np.frombuffer(data, dtype=dtype, count=count, offset=end)
    return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)


def thinned(points, voxel):
    cells = np.floor(points / voxel).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return points[first]


def main():
    out, folder, taus = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3].split(",")
    true_points, depth = truth(out, folder)
    print(f"{'cloud':40} {'points':>9} {'tau':>8} {'precision':>9} {'recall':>7} {'F':>7}")
    for tau_text in taus:
        tau = depth * float(tau_text[:-1]) / 100 if tau_text.endswith("%") else float(tau_text)
        reference = thinned(true_points, tau / 2)
        reference_tree = cKDTree(reference)
        for name in sys.argv[4:]:
            points = read_ply(Path(name))
            cloud = thinned(points, tau / 2)
            precision = np.mean(reference_tree.query(cloud, distance_upper_bound=tau, workers=2)[0] < tau)
            recall = np.mean(cKDTree(cloud).query(reference, distance_upper_bound=tau, workers=2)[0] < tau)
            score = 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0
            label = "/".join(Path(name).parts[-2:])
            print(f"{label:40} {len(points):9} {tau:8.4f} {precision:9.3f} {recall:7.3f} {score:7.3f}", flush=True)


if __name__ == "__main__":
    main()
