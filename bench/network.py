"""MVSNet (Yao et al., ECCV 2018) in PyTorch, the way its public port runs it.

Every view's features are computed for every depth map, each source's features are warped onto all planes at once with
grid_sample, the variance comes from a running sum and a running sum of squares, and the 3D network sees the whole
contiguous volume. Modules are named as in the public checkpoints.
"""

import time

import torch
import torch.nn.functional as F
from torch import nn


class Normalised(nn.Module):
    """Convolution, batch normalisation, ReLU."""

    def __init__(self, dims, inputs, outputs, kernel, stride):
        super().__init__()
        convolution, norm = (nn.Conv2d, nn.BatchNorm2d) if dims == 2 else (nn.Conv3d, nn.BatchNorm3d)
        self.conv = convolution(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False)
        self.bn = norm(outputs)

    def forward(self, x):
        return F.relu(self.bn(self.conv(x)), inplace=True)


def transposed(inputs, outputs):
    return nn.Sequential(
        nn.ConvTranspose3d(inputs, outputs, 3, stride=2, padding=1, output_padding=1, bias=False),
        nn.BatchNorm3d(outputs),
        nn.ReLU(inplace=True),
    )


class Features(nn.Module):
    """Paper section 3.1: [1, 3, H, W] to [1, 32, H/4, W/4]."""

    def __init__(self):
        super().__init__()
        layers = [(3, 8, 3, 1), (8, 8, 3, 1), (8, 16, 5, 2), (16, 16, 3, 1), (16, 16, 3, 1), (16, 32, 5, 2), (32, 32, 3, 1)]
        for i, (inputs, outputs, kernel, stride) in enumerate(layers):
            self.add_module(f"conv{i}", Normalised(2, inputs, outputs, kernel, stride))
        self.feature = nn.Conv2d(32, 32, 3, padding=1)

    def forward(self, image):
        for i in range(7):
            image = getattr(self, f"conv{i}")(image)
        return self.feature(image)


class CostRegularization(nn.Module):
    """Section 3.2: the cost volume [1, 32, D, H, W] to logits [1, D, H, W]."""

    def __init__(self):
        super().__init__()
        layers = [(32, 8, 1), (8, 16, 2), (16, 16, 1), (16, 32, 2), (32, 32, 1), (32, 64, 2), (64, 64, 1)]
        for i, (inputs, outputs, stride) in enumerate(layers):
            self.add_module(f"conv{i}", Normalised(3, inputs, outputs, 3, stride))
        self.conv7 = transposed(64, 32)
        self.conv9 = transposed(32, 16)
        self.conv11 = transposed(16, 8)
        self.prob = nn.Conv3d(8, 1, 3, padding=1)

    def forward(self, cost):
        skip0 = self.conv0(cost)
        skip2 = self.conv2(self.conv1(skip0))
        skip4 = self.conv4(self.conv3(skip2))
        x = self.conv6(self.conv5(skip4))
        x = skip4 + self.conv7(x)
        x = skip2 + self.conv9(x)
        x = skip0 + self.conv11(x)
        return self.prob(x).squeeze(1)


def warp(features, source, reference, depths):
    """Source features at every reference pixel on every plane: [1, C, D, H, W].

    `source` and `reference` are 4x4 projections to pixels of the features.
    """
    _, channels, height, width = features.shape
    to_source = (source @ torch.inverse(reference)).float()
    y, x = torch.meshgrid(torch.arange(height).float(), torch.arange(width).float(), indexing="ij")
    rays = to_source[:3, :3] @ torch.stack((x, y, torch.ones_like(x))).view(3, -1)
    points = rays.unsqueeze(1) * depths.float().view(1, -1, 1) + to_source[:3, 3].view(3, 1, 1)
    pixels = points[:2] / points[2:3]
    grid = torch.stack((pixels[0] / ((width - 1) / 2) - 1, pixels[1] / ((height - 1) / 2) - 1), dim=-1)
    grid = grid.view(1, len(depths) * height, width, 2)
    warped = F.grid_sample(features, grid, mode="bilinear", padding_mode="zeros", align_corners=True)
    return warped.view(1, channels, len(depths), height, width)


def variance(features, projections, depths):
    """The variance of all views' features on all planes."""
    total = features[0].unsqueeze(2).repeat(1, 1, len(depths), 1, 1)
    squares = total**2
    for source, projection in zip(features[1:], projections[1:]):
        warped = warp(source, projection, projections[0], depths)
        total += warped
        squares += warped.pow_(2)
        del warped
    return squares.div_(len(features)).sub_(total.div_(len(features)).pow_(2))


def regress(logits, depths):
    """Expected depth, and the probability of the four planes around the expected one."""
    probability = torch.softmax(logits, dim=1)
    depth = (probability * depths.float().view(1, -1, 1, 1)).sum(1)
    padded = F.pad(probability.unsqueeze(1), (0, 0, 0, 0, 1, 2))
    near = 4 * F.avg_pool3d(padded, (4, 1, 1), stride=1).squeeze(1)
    planes = torch.arange(len(depths)).float().view(1, -1, 1, 1)
    index = (probability * planes).sum(1).long().clamp(0, len(depths) - 1)
    return depth[0], near.gather(1, index.unsqueeze(1))[0, 0]


class MVSNet(nn.Module):
    def __init__(self):
        super().__init__()
        self.feature = Features()
        self.cost_regularization = CostRegularization()

    @torch.no_grad()
    def forward(self, images, projections, depths):
        """Depth and confidence of the first of `images`, and the seconds of each stage."""
        seconds = {}
        clock = time.perf_counter()

        def lap(name):
            nonlocal clock
            now = time.perf_counter()
            seconds[name] = now - clock
            clock = now

        features = [self.feature(image.unsqueeze(0)) for image in images]
        lap("features")
        cost = variance(features, projections, depths)
        lap("warp, variance")
        logits = self.cost_regularization(cost)
        lap("3D network")
        depth, confidence = regress(logits, depths)
        lap("softmax, regression")
        return depth, confidence, seconds
