"""What COLMAP itself says of models and images in a folder, as JSON on stdout.

    python check.py FOLDER MODEL...

Each MODEL below FOLDER is a folder that COLMAP reads as a reconstruction. The photographs of the
first one, in FOLDER/images, are undistorted into FOLDER/undistorted.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pycolmap

GRID = 13


def camera_json(camera):
    return {
        "model": camera.model.name,
        "width": camera.width,
        "height": camera.height,
        "params": list(camera.params),
    }


def model_json(path):
    model = pycolmap.Reconstruction(path)
    images = {}
    for image in model.images.values():
        pose = image.cam_from_world()
        images[image.name] = {
            "camera": camera_json(image.camera),
            "rotation": pose.rotation.matrix().tolist(),
            "translation": pose.translation.tolist(),
            "observations": sum(p.has_point3D() for p in image.points2D),
        }
    points = [
        {
            "xyz": point.xyz.tolist(),
            "track": sorted(model.images[e.image_id].name for e in point.track.elements),
        }
        for _, point in sorted(model.points3D.items())
    ]
    return {"images": images, "points": points, "error": model.compute_mean_reprojection_error()}


def undistort(folder, path):
    """Each camera's undistorted twin, where the lens puts a grid of the undistorted image's pixels,
    and the undistorted image itself."""
    model = pycolmap.Reconstruction(path)
    options = pycolmap.UndistortCameraOptions()
    found = {}
    for image in model.images.values():
        camera = image.camera
        twin = pycolmap.undistort_camera(options, camera)
        xs = np.linspace(0.5, twin.width - 0.5, GRID)
        ys = np.linspace(0.5, twin.height - 0.5, GRID)
        grid = np.array([[x, y] for y in ys for x in xs])
        stored = camera.img_from_cam(np.c_[twin.cam_from_img(grid), np.ones(len(grid))])
        bitmap = pycolmap.Bitmap.read(folder / "images" / image.name, True)
        undistorted, _ = pycolmap.undistort_image(options, bitmap, camera)
        out = folder / "undistorted" / image.name
        out.parent.mkdir(parents=True, exist_ok=True)
        undistorted.write(out, delinearize_colorspace=False)
        found[image.name] = {
            "camera": camera_json(twin),
            "undistorted": grid.tolist(),
            "stored": stored.tolist(),
        }
    return found


def main():
    folder = Path(sys.argv[1])
    models = {name: model_json(folder / name) for name in sys.argv[2:]}
    print(json.dumps({"models": models, "undistorted": undistort(folder, folder / sys.argv[2])}))


if __name__ == "__main__":
    main()
