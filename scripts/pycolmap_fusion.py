"""Has COLMAP fuse the depth maps of a dense workspace and mesh the cloud; what came out, as JSON on stdout.

    python pycolmap_fusion.py WORKSPACE
"""

import json
import sys
from pathlib import Path

import numpy as np
import pycolmap


def main():
    workspace = Path(sys.argv[1])
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = 3
    fused = workspace / "colmap_fused.ply"
    cloud = pycolmap.stereo_fusion(fused, workspace, options=options, output_type="ply")
    points = np.array([point.xyz for point in cloud.points3D.values()])
    mesh = workspace / "meshed-poisson.ply"
    # Without cutting off where points are few: this cloud is small.
    meshing = pycolmap.PoissonMeshingOptions()
    meshing.trim = 0
    pycolmap.poisson_meshing(fused, mesh, options=meshing)
    result = {
        "points": len(points),
        "z": np.percentile(points[:, 2], [1, 50, 99]).tolist() if len(points) else [],
        "mesh_bytes": mesh.stat().st_size if mesh.exists() else 0,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
