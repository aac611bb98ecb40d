"""What `realo bench` times its own steps against. Prints its name, then the seconds of one run for each line of input."""

import json
import sys
import time


def voxels(told):
    """spconv's CPU voxeliser on a file of x, y, z, intensity as 32-bit floats."""
    import importlib.metadata

    import cumm.tensorview as tv
    import numpy
    from spconv.utils import Point2VoxelCPU3d

    points = numpy.fromfile(told["points"], dtype=numpy.float32).reshape(-1, 4)
    voxeliser = Point2VoxelCPU3d(
        vsize_xyz=told["size"],
        coors_range_xyz=told["range"],
        num_point_features=4,
        max_num_points_per_voxel=told["max_points"],
        max_num_voxels=told["max_pillars"],
    )
    # The tensor does not keep the array alive.
    kept = [points, tv.from_numpy(points)]
    return f"spconv {importlib.metadata.version('spconv')}", lambda: voxeliser.point_to_voxel(kept[1])


def training(told):
    """A step of the same network in PyTorch: forward, backward and AdamW, from a canvas that is there already."""
    import torch
    from torch import nn

    torch.set_num_threads(told["threads"])

    def convolution(inputs, outputs, kernel, stride=1):
        layers = [nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False), nn.BatchNorm2d(outputs), nn.ReLU()]
        return nn.Sequential(*layers)

    def upsampling(inputs, outputs, stride):
        up = nn.ConvTranspose2d(inputs, outputs, stride, stride, bias=False)
        return nn.Sequential(up, nn.BatchNorm2d(outputs), nn.ReLU())

    class PointPillars(nn.Module):
        def __init__(self):
            super().__init__()
            backbone, inputs = told["backbone"], told["channels"]
            blocks, ups = [], []
            each = zip(*(backbone[key] for key in ("layers", "strides", "channels", "up_strides", "up_channels")))
            for layers, stride, channels, up_stride, up_channels in each:
                more = [convolution(channels, channels, 3) for _ in range(layers)]
                blocks.append(nn.Sequential(convolution(inputs, channels, 3, stride), *more))
                ups.append(upsampling(channels, up_channels, up_stride))
                inputs = channels
            self.blocks, self.ups = nn.ModuleList(blocks), nn.ModuleList(ups)
            channels, shrink = sum(backbone["up_channels"]), []
            for layer in told["shrink"]:
                kernel = layer["kernel"]
                shrink += [nn.Conv2d(channels, layer["channels"], kernel, padding=kernel // 2), nn.ReLU()]
                channels = layer["channels"]
            self.shrink = nn.Sequential(*shrink)
            self.heads = nn.Conv2d(channels, told["outputs"], 1)

        def forward(self, canvas):
            maps = []
            for block, up in zip(self.blocks, self.ups):
                canvas = block(canvas)
                maps.append(up(canvas))
            return self.heads(self.shrink(torch.cat(maps, 1)))

    network = PointPillars().to(memory_format=torch.channels_last).train()
    optimizer = torch.optim.AdamW(network.parameters(), 2e-3)
    canvas = torch.relu(torch.randn(told["batch"], told["channels"], told["rows"], told["columns"]))
    canvas = canvas.to(memory_format=torch.channels_last)

    def step():
        optimizer.zero_grad()
        network(canvas).square().mean().backward()
        optimizer.step()

    return f"PyTorch {torch.__version__}, f32, channels_last", step


def main():
    peer = {"voxels": voxels, "training": training}[sys.argv[1]]
    name, run = peer(json.loads(sys.argv[2]))
    run()
    print(name, flush=True)
    for _ in sys.stdin:
        start = time.perf_counter()
        run()
        print(time.perf_counter() - start, flush=True)


main()
