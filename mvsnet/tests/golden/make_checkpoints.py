"""Makes the checkpoints beside this file: `python3 make_checkpoints.py`, with torch 2.13.0.

Small ones, of both formats that PyTorch has had, with everything a training script leaves in them, and one that
runs code when PyTorch reads it.
"""

import collections
import os
import pathlib

import torch

folder = pathlib.Path(__file__).parent

linear = torch.nn.Linear(2, 1)
optimizer = torch.optim.Adam(linear.parameters())
linear(torch.ones(1, 2)).sum().backward()
optimizer.step()

block = torch.arange(6, dtype=torch.float32)
tensors = collections.OrderedDict(
    {
        "module.plain": block.reshape(2, 3),
        "module.transposed": block.reshape(2, 3).t(),
        "module.part": block[2:4],
        "module.half": torch.tensor([0.5, -2.0], dtype=torch.float16),
        "module.double": torch.nn.Parameter(torch.tensor([0.25], dtype=torch.float64)),
        "module.bn.num_batches_tracked": torch.tensor(7),
    }
)
tensors._metadata = collections.OrderedDict({"": dict(version=1)})
checkpoint = dict(epoch=14, lr=1e-3, model=tensors, optimizer=optimizer.state_dict())
torch.save(checkpoint, folder / "legacy.ckpt", _use_new_zipfile_serialization=False)
torch.save(checkpoint, folder / "zip.ckpt")


class Code:
    def __reduce__(self):
        return os.system, ("touch code-was-executed",)


torch.save(dict(model=tensors, extra=Code()), folder / "code.ckpt")
