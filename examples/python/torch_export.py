"""Writes the three modules of `torch_network.py` as ONNX files, for `realo-onnx`: encoder.onnx, fusion.onnx, head.onnx.

    python3 torch_export.py WEIGHTS FOLDER

It needs `pip install torch onnx onnxscript`. Sorting points into pillars is left to realo: what is exported begins behind it, as
the networks of OpenCOOD and OpenPCDet do.
"""

import sys
from pathlib import Path

import torch
from torch import nn
from torch.export import Dim

import torch_network as network


class PillarEncoder(nn.Module):
    """The encoder from pillars on: `voxels` `[pillars, points, 4]`, padded with zeros, `voxel_coords` `[pillars, 4]` (0, 0, row,
    column) and `voxel_num_points` `[pillars]`."""

    def __init__(self, encoder):
        super().__init__()
        self.pillars, self.backbone, self.shrink = encoder.pillar_vfe, encoder.backbone, encoder.shrink_conv
        self.register_buffer("low", torch.tensor(network.LOW))

    def forward(self, voxels, voxel_coords, voxel_num_points):
        layer, points = self.pillars.pfn_layers[0], voxels[..., :3]
        mean = points.sum(dim=1, keepdim=True) / voxel_num_points.view(-1, 1, 1)
        row, column = voxel_coords[:, 2], voxel_coords[:, 3]
        x, y = ((index + 0.5) * network.CELL + self.low[axis] for axis, index in enumerate((column, row)))
        center = torch.stack([x, y, torch.full_like(x, (network.LOW[2] + network.HIGH[2]) / 2)], dim=1)[:, None]
        decorated = torch.cat([points, torch.zeros_like(points[..., :1]), points - mean, points - center], dim=2)
        features = layer["norm"](layer["linear"](decorated.flatten(0, 1))).view(-1, voxels.shape[1], layer["linear"].out_features)
        is_there = torch.arange(voxels.shape[1], device=voxels.device)[None] < voxel_num_points[:, None]
        best = (features.relu() * is_there[..., None]).amax(dim=1)
        rows, columns = self.pillars.rows, self.pillars.columns
        canvas = best.new_zeros(rows * columns, best.shape[1]).index_put((row * columns + column,), best)
        return self.shrink(self.backbone(canvas.T.reshape(1, -1, rows, columns)))


class BoxesFirst(nn.Module):
    """The head with its outputs in the order of their names."""

    def __init__(self, head):
        super().__init__()
        self.head = head

    def forward(self, features):
        scores, boxes = self.head(features)
        return boxes, scores


def write(module, example, path, inputs, outputs, dynamic):
    """Writes a file; `dynamic`: for each input which of its dimensions are of any size."""
    names = {"input_names": inputs, "output_names": outputs}
    program = torch.onnx.export(module.eval(), example, dynamic_shapes=dynamic, dynamo=True, verbose=False, **names)
    program.save(path, external_data=False)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB", file=sys.stderr)


def main(weights, folder):
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    encoder, head = (network.loaded(module, weights, "cpu") for module in (network.Encoder(), network.Head()))
    pillars, agents = Dim("pillars"), Dim("agents")
    shared = torch.zeros(3, 64, 100, 256)

    voxels = torch.zeros(5, network.POINTS, 4), torch.tensor([[0, 0, row, 7] for row in range(5)]), torch.ones(5, dtype=torch.int64)
    names = ["voxels", "voxel_coords", "voxel_num_points"]
    write(PillarEncoder(encoder), voxels, folder / "encoder.onnx", names, ["features"], [{0: pillars}] * 3)
    maps = shared, torch.ones(3, 100, 256, dtype=torch.bool)
    write(network.Fusion(), maps, folder / "fusion.onnx", ["maps", "mask"], ["features"], [{0: agents}] * 2)
    write(BoxesFirst(head), (shared[:1],), folder / "head.onnx", ["features"], ["boxes", "scores"], [{}])


if __name__ == "__main__":
    main(*sys.argv[1:])
