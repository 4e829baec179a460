"""The DTU distances in blocks of 60 mm, as the data set's own program computes them, for comparison.

    python dtu_blocks.py FOLDER

FOLDER holds cloud.f64, thinned.f64 and truth.f64 (little-endian, three numbers a point, in mm). Written
there: ObsMask.mat and Plane.mat, and result.json with the figures of the thinned cloud, and of the cloud
thinned here in another random order.
"""

import json
import pathlib
import sys

import numpy as np
import scipy.io
import scipy.spatial

folder = pathlib.Path(sys.argv[1])
BLOCK = 60.0

low, high, res = np.array([-41.0, -31.0, 499.0]), np.array([62.0, 83.0, 610.0]), 2.0
size = np.floor((high - low) / res).astype(int) + 1
# Solid with holes of about 16 mm, so that neighbouring cells differ.
x, y, z = np.indices(size)
mask = (np.sin(x * 0.4) + np.cos(y * 0.3) + np.sin(z * 0.35)) > -0.8
plane = np.array([[0.02], [-0.01], [-1.0], [585.0]])
scipy.io.savemat(
    folder / "ObsMask.mat",
    {"ObsMask": mask, "BB": np.array([low, high]), "Res": res, "Margin": 10},
    do_compression=True,
)
scipy.io.savemat(folder / "Plane.mat", {"P": plane})


def read(name):
    return np.fromfile(folder / name, dtype="<f8").reshape(-1, 3)


def distances(source, target):
    """BLOCK where nothing is near, NaN outside all blocks."""
    result = np.full(len(source), np.nan)
    count = np.floor((high - low) / BLOCK).astype(int) + 1
    for block in np.ndindex(*count):
        start = low + np.array(block) * BLOCK
        inside = np.all((source >= start) & (source < start + BLOCK), axis=1)
        near = target[np.all((target >= start - BLOCK) & (target < start + 2 * BLOCK), axis=1)]
        result[inside] = BLOCK
        if inside.any() and len(near):
            result[inside] = np.minimum(scipy.spatial.cKDTree(near).query(source[inside])[0], BLOCK)
    return result


def thin(points, radius):
    tree = scipy.spatial.cKDTree(points)
    alive = np.ones(len(points), bool)
    for i in np.random.default_rng(5).permutation(len(points)):
        if alive[i]:
            alive[tree.query_ball_point(points[i], radius)] = False
            alive[i] = True
    return points[alive]


def figures(cloud, truth):
    index = np.round((cloud - low) / res).astype(int)
    inside = np.all((index >= 0) & (index < size), axis=1)
    observable = np.zeros(len(cloud), bool)
    observable[inside] = mask[tuple(index[inside].T)]
    above = np.hstack([truth, np.ones((len(truth), 1))]) @ plane[:, 0] > 0
    accuracy = distances(cloud, truth)[observable]
    completeness = distances(truth, cloud)[above]

    def statistics(values):
        kept = values[values < 20.0]
        return {
            "kept": len(kept),
            "mean": kept.mean(),
            "median": np.median(kept),
            "variance": kept.var(),
        }

    result = {"accuracy": statistics(accuracy), "completeness": statistics(completeness)}
    result["overall"] = (result["accuracy"]["mean"] + result["completeness"]["mean"]) / 2
    result["within_1_mm"] = [np.mean(v[~np.isnan(v)] < 1.0) for v in (accuracy, completeness)]
    return result


truth = read("truth.f64")
result = {
    "same": figures(read("thinned.f64"), truth),
    "own_thinning": figures(thin(read("cloud.f64"), 0.2), truth),
    "observable": int(mask.sum()),
    "cells": int(mask.size),
}
(folder / "result.json").write_text(json.dumps(result))
