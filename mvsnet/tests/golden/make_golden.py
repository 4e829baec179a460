"""Makes the golden values beside this file: `python3 make_golden.py`, with torch 2.13.0 and numpy.

MVSNet written down once more, in f64 and in plain PyTorch, for what has no public reference: other numbers
of views than three, inverse depth sampling, the mean metric, and both refinement networks. It shares no code with
the crate and takes no short cut: batch normalisation is not folded, feature volumes of all views exist at
once, and the homography is the paper's equation 1 (with an inverse, camera centres and the right sign), not
a product of projections.

Weights and images come from splitmix64, exactly as `Weights::seeded` makes them, so only results are stored.
"""

import json
import pathlib
import struct

import numpy as np
import torch
import torch.nn.functional as F

torch.set_default_dtype(torch.float64)

CASES = {
    "views2_uniform": dict(views=2, inverse=False, mean=False, refinement="none", seed=11),
    "views5_inverse": dict(views=5, inverse=True, mean=False, refinement="none", seed=12),
    "views3_mean": dict(views=3, inverse=False, mean=True, refinement="none", seed=13),
    "views3_refined_paper": dict(views=3, inverse=False, mean=False, refinement="paper", seed=14),
    "views2_refined_bn_relu_inverse": dict(views=2, inverse=True, mean=False, refinement="bn-relu", seed=15),
}
DEPTHS, NEAR, FAR = 16, 2.0, 6.0
SIZES = [(96, 64), (96, 64), (64, 96), (128, 64), (64, 64)]


def uniform(seed, count, skip=0):
    """`count` numbers of [0, 1) from splitmix64, after the first `skip`."""
    index = np.arange(skip + 1, skip + count + 1, dtype=np.uint64)
    z = np.uint64(seed) + index * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return (z >> np.uint64(40)).astype(np.float64) / 2.0**24


def layout(refinement):
    shapes = {}

    def norm(prefix, channels):
        for part in ["weight", "bias", "running_mean", "running_var"]:
            shapes[f"{prefix}.{part}"] = (channels,)

    for i, (o, c, k) in enumerate(
        [(8, 3, 3), (8, 8, 3), (16, 8, 5), (16, 16, 3), (16, 16, 3), (32, 16, 5), (32, 32, 3)]
    ):
        shapes[f"feature.conv{i}.conv.weight"] = (o, c, k, k)
        norm(f"feature.conv{i}.bn", o)
    shapes["feature.feature.weight"], shapes["feature.feature.bias"] = (32, 32, 3, 3), (32,)
    for i, (o, c) in enumerate([(8, 32), (16, 8), (16, 16), (32, 16), (32, 32), (64, 32), (64, 64)]):
        shapes[f"cost_regularization.conv{i}.conv.weight"] = (o, c, 3, 3, 3)
        norm(f"cost_regularization.conv{i}.bn", o)
    for i, c, o in [(7, 64, 32), (9, 32, 16), (11, 16, 8)]:
        shapes[f"cost_regularization.conv{i}.0.weight"] = (c, o, 3, 3, 3)
        norm(f"cost_regularization.conv{i}.1", o)
    shapes["cost_regularization.prob.weight"], shapes["cost_regularization.prob.bias"] = (1, 8, 3, 3, 3), (1,)
    if refinement != "none":
        for i, c in [(1, 4), (2, 32), (3, 32)]:
            shapes[f"refine_network.conv{i}.conv.weight"] = (32, c, 3, 3)
            norm(f"refine_network.conv{i}.bn", 32)
    if refinement == "paper":
        shapes["refine_network.res.weight"], shapes["refine_network.res.bias"] = (1, 32, 3, 3), (1,)
    if refinement == "bn-relu":
        shapes["refine_network.res.conv.weight"] = (1, 32, 3, 3)
        norm("refine_network.res.bn", 1)
    return shapes


def weights(refinement, seed):
    tensors, used = {}, 0
    for name, shape in sorted(layout(refinement).items()):
        low, high = -0.2, 0.2
        if len(shape) > 1:
            transposed = name.endswith(".0.weight")
            fan_in = shape[0 if transposed else 1] * int(np.prod(shape[2:]))
            bound = np.sqrt(6.0 / (fan_in / 8.0 if transposed else fan_in))
            bound = 0.1 * bound if name.startswith("refine_network.res") else bound
            low, high = -bound, bound
        elif name.endswith(("running_var", "bn.weight", ".1.weight")):
            low, high = 0.5, 1.5
        count = int(np.prod(shape))
        values = (low + (high - low) * uniform(seed, count, used)).astype(np.float32)
        tensors[name] = torch.from_numpy(values.astype(np.float64)).reshape(shape)
        used += count
    return tensors


def batch_norm(w, prefix, x):
    part = lambda name: w[f"{prefix}.{name}"]
    return F.batch_norm(
        x, part("running_mean"), part("running_var"), part("weight"), part("bias"), training=False, eps=1e-5
    )


def features(w, x):
    for i, stride in enumerate([1, 1, 2, 1, 1, 2, 1]):
        kernel = w[f"feature.conv{i}.conv.weight"]
        x = F.conv2d(x, kernel, stride=stride, padding=kernel.shape[-1] // 2)
        x = F.relu(batch_norm(w, f"feature.conv{i}.bn", x))
    return F.conv2d(x, w["feature.feature.weight"], w["feature.feature.bias"], padding=1)


def warp(source_features, reference, source, depth, size):
    """Source features on the plane of the reference camera at `depth`; cameras are (K, R, t)."""
    (k1, r1, t1), (ki, ri, ti) = reference, source
    c1, ci = -r1.T @ t1, -ri.T @ ti
    n1 = r1[2]
    plane = torch.eye(3) - torch.outer(ci - c1, n1) / depth
    homography = ki @ ri @ plane @ r1.T @ torch.linalg.inv(k1)
    height, width = size
    v, u = torch.meshgrid(torch.arange(height) * 1.0, torch.arange(width) * 1.0, indexing="ij")
    x = torch.einsum("ij,jhw->ihw", homography, torch.stack([u, v, torch.ones_like(u)]))
    h, w = source_features.shape[-2:]
    grid = torch.stack([x[0] / x[2] * 2 / (w - 1) - 1, x[1] / x[2] * 2 / (h - 1) - 1], dim=-1)
    sampled = F.grid_sample(
        source_features, grid[None], mode="bilinear", padding_mode="zeros", align_corners=True
    )
    return sampled * (x[2] > 0)


def regularize(w, x):
    def down(i, x):
        name = f"cost_regularization.conv{i}"
        x = F.conv3d(x, w[f"{name}.conv.weight"], stride=1 + i % 2, padding=1)
        return F.relu(batch_norm(w, f"{name}.bn", x))

    def up(i, x):
        name = f"cost_regularization.conv{i}"
        x = F.conv_transpose3d(x, w[f"{name}.0.weight"], stride=2, padding=1, output_padding=1)
        return F.relu(batch_norm(w, f"{name}.1", x))

    conv0 = down(0, x)
    conv2 = down(2, down(1, conv0))
    conv4 = down(4, down(3, conv2))
    x = down(6, down(5, conv4))
    x = conv4 + up(7, x)
    x = conv2 + up(9, x)
    x = conv0 + up(11, x)
    prob = "cost_regularization.prob"
    return F.conv3d(x, w[f"{prob}.weight"], w[f"{prob}.bias"], padding=1)[0, 0]


def refine(w, refinement, scaled, image):
    x = torch.cat([image[:, :, ::4, ::4], scaled[None, None]], dim=1)
    for i in [1, 2, 3]:
        x = F.conv2d(x, w[f"refine_network.conv{i}.conv.weight"], padding=1)
        x = F.relu(batch_norm(w, f"refine_network.conv{i}.bn", x))
    if refinement == "paper":
        x = F.conv2d(x, w["refine_network.res.weight"], w["refine_network.res.bias"], padding=1)
    else:
        x = F.conv2d(x, w["refine_network.res.conv.weight"], padding=1)
        x = F.relu(batch_norm(w, "refine_network.res.bn", x))
    return scaled + x[0, 0]


def cameras(count):
    """Feature cameras (K, R, t); the first looks along z, the others are moved and turned towards it."""
    result = []
    for i, (width, height) in enumerate(SIZES[:count]):
        k = torch.tensor([[20.0 + i, 0, width / 8.0 - 0.3], [0, 21.0, height / 8.0 + 0.2], [0, 0, 1.0]])
        a, b = 0.06 * i * (-1) ** i, 0.03 * i
        turn = torch.tensor([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        tilt = torch.tensor([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
        r = turn @ tilt
        centre = torch.tensor([0.3 * i * (-1) ** i, 0.1 * i, 0.05 * i])
        result.append((k, r, -r @ centre))
    return result


def run(views, inverse, mean, refinement, seed):
    w = weights(refinement, seed)
    images = []
    for i, (width, height) in enumerate(SIZES[:views]):
        bytes_ = np.floor(uniform(seed + 100 + i, 3 * height * width) * 256.0)
        images.append(torch.from_numpy((bytes_ / 255.0).astype(np.float32).astype(np.float64)))
        images[-1] = images[-1].reshape(1, 3, height, width)
    poses = cameras(views)
    step = torch.arange(DEPTHS) / (DEPTHS - 1)
    depths = 1 / (1 / NEAR + step * (1 / FAR - 1 / NEAR)) if inverse else NEAR + step * (FAR - NEAR)

    maps = [features(w, image) for image in images]
    size = maps[0].shape[-2:]
    volumes = [maps[0][:, :, None].expand(-1, -1, DEPTHS, -1, -1)]
    for i in range(1, views):
        planes = [warp(maps[i], poses[0], poses[i], depth, size) for depth in depths]
        volumes.append(torch.stack(planes, dim=2))
    volumes = torch.stack(volumes)
    cost = volumes.mean(0) if mean else ((volumes - volumes.mean(0)) ** 2).mean(0)

    logits = regularize(w, cost)
    probability = torch.softmax(logits, 0)
    scale = 1 / depths if inverse else depths
    expected = (probability * scale[:, None, None]).sum(0)
    depth = 1 / expected if inverse else expected
    index = (probability * torch.arange(DEPTHS)[:, None, None]).sum(0)
    confidence = torch.zeros_like(depth)
    for offset in [-1, 0, 1, 2]:
        k = index.floor().long() + offset
        inside = (k >= 0) & (k < DEPTHS)
        confidence += probability.gather(0, k.clamp(0, DEPTHS - 1)[None])[0] * inside
    if refinement != "none":
        scaled = (scale[0] - (1 / depth if inverse else depth)) / (scale[0] - scale[-1])
        refined = scale[0] + refine(w, refinement, scaled, images[0]) * (scale[-1] - scale[0])
        depth = 1 / refined if inverse else refined
    projections = torch.stack([k @ torch.cat([r, t[:, None]], dim=1) for k, r, t in poses])
    integer_gap = (index - index.round()).abs().min().item()
    print(f"  index {index.min():.2f} to {index.max():.2f}, {integer_gap:.1e} from an integer,", end=" ")
    print(f"confidence {confidence.min():.2f} to {confidence.max():.2f}, depth {depth.min():.3f} to {depth.max():.3f}")
    return dict(projections=projections, logits=logits, depth=depth, confidence=confidence)


def write_safetensors(path, tensors):
    header, data = {}, b""
    for name, tensor in sorted(tensors.items()):
        raw = tensor.contiguous().numpy().astype("<f8").tobytes()
        header[name] = dict(dtype="F64", shape=list(tensor.shape), data_offsets=[len(data), len(data) + len(raw)])
        data += raw
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(struct.pack("<Q", len(text)) + text + data)


if __name__ == "__main__":
    tensors = {}
    for case, parameters in CASES.items():
        print(case)
        for name, tensor in run(**parameters).items():
            tensors[f"{case}.{name}"] = tensor
    write_safetensors(pathlib.Path(__file__).with_name("golden.safetensors"), tensors)
