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


def point_pillars(told):
    """The network from the canvas to its last map: backbone, shrink layers, and heads if there are any."""
    import torch
    from torch import nn

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
            self.heads = nn.Conv2d(channels, told["outputs"], 1) if told["outputs"] else nn.Identity()

        def features(self, canvas):
            maps = []
            for block, up in zip(self.blocks, self.ups):
                canvas = block(canvas)
                maps.append(up(canvas))
            return self.shrink(torch.cat(maps, 1))

        def forward(self, canvas):
            return self.heads(self.features(canvas))

    return PointPillars().to(memory_format=torch.channels_last)


def canvas_of(told):
    """A canvas as full as a sweep's: features above 0 in a few of its cells."""
    import torch

    shape = told["batch"], told["channels"], told["rows"], told["columns"]
    full = torch.rand(shape[0], 1, *shape[2:]) < 0.1
    return (torch.relu(torch.randn(shape)) * full).to(memory_format=torch.channels_last)


def training(told):
    """A step of the same network in PyTorch: forward, backward and AdamW, from a canvas that is there already."""
    import torch

    torch.set_num_threads(told["threads"])
    network = point_pillars(told).train()
    optimizer = torch.optim.AdamW(network.parameters(), 2e-3)
    canvas = canvas_of(told)

    def step():
        optimizer.zero_grad()
        network(canvas).square().mean().backward()
        optimizer.step()

    return f"PyTorch {torch.__version__}, f32, channels_last", step


def attfuse(told):
    """AttFuse of two agents in PyTorch, from canvases that are there already: both encoders, attention, heads."""
    import torch

    torch.set_num_threads(told["threads"])
    network, canvas = point_pillars(told).eval(), canvas_of(told)

    @torch.inference_mode()
    def run():
        maps = network.features(canvas).flatten(2).permute(2, 0, 1)
        weights = torch.softmax(maps @ maps.transpose(1, 2) / maps.shape[2] ** 0.5, 2)
        fused = (weights @ maps)[:, 0].T.reshape(1, -1, told["rows"] // 2, told["columns"] // 2)
        return network.heads(fused)

    return f"PyTorch {torch.__version__}, f32, channels_last", run


def pytorch(told):
    """The encoder in PyTorch."""
    import torch

    torch.set_num_threads(told["threads"])
    network, canvas = point_pillars(told).eval(), canvas_of(told)

    @torch.inference_mode()
    def run():
        return network(canvas)

    return f"PyTorch {torch.__version__}, f32, channels_last", run


def openvino(told):
    """The encoder in OpenVINO, in f32, bf16 or int8."""
    import openvino
    import torch

    network, canvas = point_pillars(told).eval(), canvas_of(told).contiguous()
    model = openvino.convert_model(network, example_input=canvas, input=[tuple(canvas.shape)])
    if told["precision"] == "int8":
        import nncf

        model = nncf.quantize(model, nncf.Dataset([canvas.numpy()]), subset_size=1)
    hint = {"int8": "f32", "bf16": "bf16", "f32": "f32"}[told["precision"]]
    settings = {"INFERENCE_PRECISION_HINT": hint, "INFERENCE_NUM_THREADS": told["threads"], "PERFORMANCE_HINT": "LATENCY"}
    compiled = openvino.Core().compile_model(model, "CPU", settings)
    request, numbers = compiled.create_infer_request(), canvas.numpy()
    return f"OpenVINO {openvino.__version__.split('-')[0]}, {told['precision']}", lambda: request.infer([numbers])


def onnxruntime(told):
    """The encoder in ONNX Runtime, in f32."""
    import io

    import onnxruntime
    import torch

    network, canvas = point_pillars(told).eval(), canvas_of(told).contiguous()
    file = io.BytesIO()
    torch.onnx.export(network, (canvas,), file, input_names=["canvas"], dynamo=False)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = told["threads"]
    session = onnxruntime.InferenceSession(file.getvalue(), options, providers=["CPUExecutionProvider"])
    numbers = {"canvas": canvas.numpy()}
    return f"ONNX Runtime {onnxruntime.__version__}, f32", lambda: session.run(None, numbers)


PEERS = {
    "attfuse": attfuse,
    "onnxruntime": onnxruntime,
    "openvino": openvino,
    "pytorch": pytorch,
    "training": training,
    "voxels": voxels,
}


def main():
    # Converters write to the standard output, which is for times.
    out, sys.stdout = sys.stdout, sys.stderr
    name, run = PEERS[sys.argv[1]](json.loads(sys.argv[2]))
    run()
    print(name, file=out, flush=True)
    for _ in sys.stdin:
        start = time.perf_counter()
        run()
        print(time.perf_counter() - start, file=out, flush=True)


main()
