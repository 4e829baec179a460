"""The Tanks and Temples metric done with Open3D, for comparison.

    python open3d_tnt.py FOLDER THRESHOLD

FOLDER holds cloud.f64 and scan.f64 (little-endian, three numbers a point), crop.json, and the camera
centres of both trajectories, source.f64 and target.f64. Written there: cropped.f64 and thinned.f64 (the
scan after either step, sorted), and result.json.
"""

import json
import pathlib
import sys
import types

import numpy as np

# Open3D's drawing and learning parts want packages that nothing here needs.
for name in ["open3d.visualization", "open3d.ml"]:
    sys.modules[name] = types.ModuleType(name)
import open3d

folder = pathlib.Path(sys.argv[1])
tau = float(sys.argv[2])
registration = open3d.pipelines.registration
volume = open3d.cpu.pybind.visualization.read_selection_polygon_volume(str(folder / "crop.json"))


def read(name):
    points = np.fromfile(folder / name, dtype="<f8").reshape(-1, 3)
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))


def write_sorted(name, cloud):
    points = np.asarray(cloud.points)
    points[np.lexsort(points.T[::-1])].astype("<f8").tofile(folder / name)


def copied(cloud):
    return open3d.geometry.PointCloud(cloud)


def refined(cloud, scan, transform, thinned, reach):
    source = thinned(volume.crop_point_cloud(copied(cloud).transform(transform)))
    target = thinned(volume.crop_point_cloud(copied(scan)))
    result = registration.registration_icp(
        source,
        target,
        reach,
        np.identity(4),
        registration.TransformationEstimationPointToPoint(True),
        registration.ICPConvergenceCriteria(1e-6, 1e-6, 20),
    )
    return result.transformation @ transform


def aligned(cloud, scan):
    source, target = read("source.f64"), read("target.f64")
    pairs = np.repeat(np.arange(len(source.points))[:, None], 2, axis=1)
    transform = registration.registration_ransac_based_on_correspondence(
        source,
        target,
        open3d.utility.Vector2iVector(pairs),
        0.2,
        registration.TransformationEstimationPointToPoint(True),
        6,
        [],
        registration.RANSACConvergenceCriteria(100000, 1.0),
    ).transformation
    transform = refined(cloud, scan, transform, lambda c: c.voxel_down_sample(tau), 80 * tau)
    transform = refined(cloud, scan, transform, lambda c: c.voxel_down_sample(tau / 2), 20 * tau)
    return refined(cloud, scan, transform, lambda c: c, 2 * tau)


def scores(cloud, scan, transform):
    s = volume.crop_point_cloud(copied(cloud).transform(transform)).voxel_down_sample(tau / 2)
    t = volume.crop_point_cloud(copied(scan)).voxel_down_sample(tau / 2)
    precision = float(np.mean(np.asarray(s.compute_point_cloud_distance(t)) < tau))
    recall = float(np.mean(np.asarray(t.compute_point_cloud_distance(s)) < tau))
    f_score = 2 * precision * recall / (precision + recall)
    return {"precision": precision, "recall": recall, "f_score": f_score, "points": len(s.points)}


cloud, scan = read("cloud.f64"), read("scan.f64")
cropped = volume.crop_point_cloud(copied(scan))
write_sorted("cropped.f64", cropped)
write_sorted("thinned.f64", cropped.voxel_down_sample(tau / 2))
transform = aligned(cloud, scan)
result = {
    "open3d": open3d.__version__,
    "transform": transform.tolist(),
    "refined": scores(cloud, scan, transform),
    "as_it_is": scores(scan, scan, np.identity(4)),
    "known": scores(cloud, scan, np.loadtxt(folder / "known.txt")),
}
(folder / "result.json").write_text(json.dumps(result))
