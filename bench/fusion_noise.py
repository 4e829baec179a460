"""Noisy depth maps of a scene of `planesweep synth`, for `planesweep fuse` and fusion_fscore.py to judge by.

    python3 bench/fusion_noise.py SCENE MVSNET_FOLDER    (numpy)

SCENE has depth_gt/NAME.pfm; MVSNET_FOLDER is what `planesweep convert SCENE MVSNET_FOLDER --to mvsnet` made of it.
Every fourth pixel of the truth becomes a pixel of depth_est/ID.pfm: with 0.4 % of noise, smooth over some pixels as a
network's errors are, and every eighth pixel grossly wrong, in patches. confidence/ID.pfm is low for two thirds of the
wrong pixels and for a tenth of the right ones. MVSNET_FOLDER/truth takes the place of OUT for fusion_fscore.py. The seed is fixed.
"""

import json
import sys
from pathlib import Path

import numpy as np

NOISE = 0.004
WRONG = 1 / 8


def read_pfm(path):
    with open(path, "rb") as file:
        assert file.readline().strip() == b"Pf"
        width, height = (int(n) for n in file.readline().split())
        scale = float(file.readline())
        values = np.frombuffer(file.read(), dtype="<f4" if scale < 0 else ">f4")
    return values.reshape(height, width)[::-1]


def write_pfm(path, values):
    path.parent.mkdir(exist_ok=True)
    head = f"Pf\n{values.shape[1]} {values.shape[0]}\n-1\n".encode()
    path.write_bytes(head + values[::-1].astype("<f4").tobytes())


def smooth(shape, rng):
    """Noise of deviation 1, alike over three pixels."""
    coarse = rng.normal(size=(shape[0] // 3 + 2, shape[1] // 3 + 2))
    return np.kron(coarse, np.ones((3, 3)))[: shape[0], : shape[1]]


def camera(path, size):
    numbers = path.read_text().split()
    extrinsic = np.array(numbers[1:17], dtype=float).reshape(4, 4)
    k = np.array(numbers[18:27], dtype=float).reshape(3, 3)
    intrinsics = {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2], "width": size[1], "height": size[0]}
    pose = {"rotation": extrinsic[:3, :3].T.reshape(-1).tolist(), "translation": extrinsic[:3, 3].tolist()}
    return {"intrinsics": intrinsics, "pose": pose}


def main():
    scene, folder = Path(sys.argv[1]), Path(sys.argv[2])
    rng = np.random.default_rng(1)
    views = []
    cams = sorted(folder.glob("cams/*_cam.txt"))
    for cam, truth_path in zip(cams, sorted(scene.glob("depth_gt/*.pfm"))):
        name = cam.name[:8]
        full = read_pfm(truth_path)
        truth = full[::4, ::4].astype(np.float64)
        wrong = smooth(truth.shape, rng) > 1.15  # an eighth
        gross = rng.uniform(0.7, 1.4, size=truth.shape)
        depth = truth * np.where(wrong, gross, 1 + NOISE * smooth(truth.shape, rng))
        unsure = np.where(wrong, rng.random(truth.shape) < 2 / 3, rng.random(truth.shape) < 0.1)
        write_pfm(folder / "depth_est" / f"{name}.pfm", depth)
        write_pfm(folder / "confidence" / f"{name}.pfm", np.where(unsure, 0.4, 0.95))
        views.append({"file": truth_path.stem, "image_camera": camera(cam, full.shape)})
    (folder / "truth").mkdir(exist_ok=True)
    (folder / "truth" / "run.json").write_text(json.dumps({"views": views}))


if __name__ == "__main__":
    main()
