"""A generated scan of the size of DTU's in the data set's folders, to measure how long a comparison takes.

    python dtu_full_size.py FOLDER [POINTS]

Writes FOLDER/results/scan1.ply and FOLDER/truth, each cloud of POINTS (3 million) points.
"""

import pathlib
import sys

import numpy as np
import scipy.io

folder = pathlib.Path(sys.argv[1])
count = int(sys.argv[2]) if len(sys.argv) > 2 else 3_000_000
random = np.random.default_rng(1)


def write(path, noise):
    path.parent.mkdir(parents=True, exist_ok=True)
    x, y = random.uniform(-150, 150, (2, count))
    z = 600 + 40 * np.sin(0.03 * x) * np.cos(0.04 * y) + random.normal(0, noise, count)
    # One in a hundred is far off.
    z += np.where(random.random(count) < 0.01, random.uniform(-80, 80, count), 0)
    # In tiles of 10 mm, for neighbouring points are near each other in real clouds, too.
    order = np.lexsort((x // 10, y // 10))
    points = np.column_stack([x, y, z])[order].astype("<f4")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
    header += "property float x\nproperty float y\nproperty float z\nend_header\n"
    path.write_bytes(header.encode() + points.tobytes())


write(folder / "results/scan1.ply", 0.4)
write(folder / "truth/Points/stl/stl001_total.ply", 0.02)
low, high, cell = np.array([-160.0, -160, 500]), np.array([160.0, 160, 700]), 1.0
mask = np.ones(np.floor((high - low) / cell).astype(int) + 1, bool)
(folder / "truth/ObsMask").mkdir(parents=True, exist_ok=True)
box = {"ObsMask": mask, "BB": np.array([low, high]), "Res": cell, "Margin": 10}
scipy.io.savemat(folder / "truth/ObsMask/ObsMask1_10.mat", box, do_compression=True)
plane = {"P": np.array([[0.0], [0], [-1], [680]])}
scipy.io.savemat(folder / "truth/ObsMask/Plane1.mat", plane)
