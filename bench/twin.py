"""The public port's algorithm in PyTorch, alternating with `planesweep` in one run, on the same images and weights.

    bench/twin.sh --size medium --runs 3

In every round PyTorch, the plain libtorch path of `planesweep bench` and ours infer one depth map each, one after the
other. Afterwards the depth maps are compared, and PyTorch's stages are set beside those measured for the public port.
"""

import argparse
import json
import pathlib
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time

import numpy
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from network import MVSNet

SIZES = {
    "small": "640x512x192x3",
    "medium": "1152x864x192x5",
    "dtu": "1600x1184x256x5",
    "tnt": "1920x1056x256x5",
}
# Seconds of the public port's stages, measured on another machine with 2 cores: features, warp, 3D network, softmax.
PORT = {
    "small": (0.11, 1.8, 1.5, 0.09),
    "medium": (0.9, 10.0, 5.9, 0.3),
    "dtu": (2.4, 52, 19, 1.0),
    "tnt": (2.1, 68, 19, 1.2),
}


class Side:
    """A `planesweep bench-side` process."""

    def __init__(self, arguments, scene, name):
        command = [arguments.program, "bench-side", scene, "--size", arguments.size, "--side", name]
        command += ["--threads", str(arguments.threads)]
        if arguments.weights:
            command += ["--weights", arguments.weights]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def ask(self, request):
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        if not answer:
            sys.exit("planesweep ended before it answered")
        return json.loads(answer)

    def depth(self, folder):
        path = pathlib.Path(folder) / "depth.pfm"
        self.ask({"save_depth": str(path)})
        return read_pfm(path)

    def end(self):
        self.process.stdin.close()
        self.process.wait()


def read_pfm(path):
    header, width, height, scale, values = re.match(rb"(Pf)\s+(\d+)\s+(\d+)\s+(\S+)\s(.*)", path.read_bytes(), re.S).groups()
    order = "<f4" if float(scale) < 0 else ">f4"
    return numpy.frombuffer(values, order).reshape(int(height), int(width))[::-1]


def make_scene(arguments, folder):
    width, height, _, views = map(int, SIZES.get(arguments.size, arguments.size).split("x"))
    scene = f"{folder}/scene"
    command = [arguments.program, "synth", scene, "--views", str(views), "--width", str(width), "--height", str(height)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return scene


def load(folder):
    """What `bench-side` infers from, and the network with its weights."""
    tensors = load_file(f"{folder}/input.safetensors")
    with safe_open(f"{folder}/weights.safetensors", "pt") as weights:
        metadata = json.loads(weights.metadata()["planesweep-mvsnet"])
        state = {name: weights.get_tensor(name) for name in weights.keys() if not name.startswith("refine_network.")}
    network = MVSNet().eval()
    # Counts of training batches are not weights.
    missing = network.load_state_dict(state, strict=False).missing_keys
    assert all(name.endswith("num_batches_tracked") for name in missing), missing
    images = tensors["images"].permute(0, 3, 1, 2).float()
    if metadata["normalization"] == "unit-range":
        images = images / 255
    else:
        mean = images.mean((2, 3), keepdim=True)
        images = (images - mean) / images.var((2, 3), keepdim=True, correction=0).sqrt()
    height, width = images.shape[2:]
    images = torch.nn.functional.pad(images, (0, -width % 32, 0, -height % 32)).contiguous()
    last_row = torch.tensor([0, 0, 0, 1.0], dtype=torch.float64).expand(len(images), 1, 4)
    return network, images, torch.cat((tensors["projections"], last_row), 1), tensors["depths"]


def spread(values):
    return f"{statistics.median(values):8.3f} {min(values):8.3f} {max(values):8.3f}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", help="a scene that planesweep reads; without it one is made")
    parser.add_argument("--program", default="target/release/planesweep")
    parser.add_argument("--size", default="medium", help="small, medium, dtu, tnt or WIDTHxHEIGHTxDEPTHSxVIEWS")
    parser.add_argument("--runs", type=int, default=3, help="rounds that count; one before them does not")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--weights", help="as `planesweep weights import` writes them; without it untrained ones")
    arguments = parser.parse_args()

    torch.set_num_threads(arguments.threads)
    folder = tempfile.TemporaryDirectory()
    scene = arguments.scene or make_scene(arguments, folder.name)
    sides = {name: Side(arguments, scene, name) for name in ("plain", "ours")}
    sides["ours"].ask({"export": folder.name})
    network, images, projections, depths = load(folder.name)

    seconds = {"PyTorch": [], "plain": [], "ours": []}
    stages = []
    peaks = {}
    for counted in [False] + [True] * arguments.runs:
        begun = time.perf_counter()
        depth, _, measured = network(images, projections, depths)
        taken = {"PyTorch": time.perf_counter() - begun}
        for name, side in sides.items():
            run = side.ask("run")
            taken[name] = run["seconds"]
            peaks[name] = max(peaks.get(name, 0), run["peak_bytes"])
        print("  ".join(f"{name} {value:.2f} s" for name, value in taken.items()), file=sys.stderr)
        if counted:
            stages.append(measured)
            for name, value in taken.items():
                seconds[name].append(value)
    peaks["PyTorch"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10

    print(f"{arguments.size}, {arguments.threads} threads, {arguments.runs} rounds, PyTorch {torch.__version__}")
    print(f"{'':32}   median    least greatest  peak MiB")
    for name, values in seconds.items():
        print(f"{name:32} {spread(values)} {peaks[name] >> 20:9}")
    for name in ("PyTorch", "plain"):
        pairs = [slow / fast for slow, fast in zip(seconds[name], seconds["ours"])]
        ratio = statistics.median(seconds[name]) / statistics.median(seconds["ours"])
        memory = peaks[name] / peaks["ours"]
        print(f"ours is {ratio:.1f} times as fast as {name} (pairs {min(pairs):.1f} to {max(pairs):.1f}) in 1/{memory:.1f} of its memory")

    print("\nPyTorch's stages                   median    least greatest   share  the port's share elsewhere")
    port = PORT.get(arguments.size)
    whole = statistics.median(seconds["PyTorch"])
    for i, name in enumerate(stages[0]):
        values = [run[name] for run in stages]
        share = f"{100 * port[i] / sum(port):4.0f} %" if port else "   -"
        print(f"{name:32} {spread(values)} {100 * statistics.median(values) / whole:5.0f} %  {share}")

    height, width = -(-images.shape[2] // 4), -(-images.shape[3] // 4)
    depth = depth.numpy()[:height, :width]
    print("\nrelative difference to PyTorch's depth   median     99 %  greatest")
    for name, side in sides.items():
        other = side.depth(folder.name)
        difference = numpy.abs(other - depth[: other.shape[0], : other.shape[1]]) / other
        print(f"{name:38} {numpy.median(difference):8.1e} {numpy.quantile(difference, 0.99):8.1e} {difference.max():9.1e}")
        side.end()


if __name__ == "__main__":
    main()
