"""What `realo-lab bench` times its own steps against. Prints its name, then the seconds of one run for each line of input."""

import json
import sys
import time


def voxels(reported):
    """spconv's CPU voxeliser on a file of x, y, z, intensity as 32-bit floats."""
    import importlib.metadata

    import cumm.tensorview as tv
    import numpy
    from spconv.utils import Point2VoxelCPU3d

    points = numpy.fromfile(reported["points"], dtype=numpy.float32).reshape(-1, 4)
    voxeliser = Point2VoxelCPU3d(
        vsize_xyz=reported["size"],
        coors_range_xyz=reported["range"],
        num_point_features=4,
        max_num_points_per_voxel=reported["max_points"],
        max_num_voxels=reported["max_pillars"],
    )
    # The tensor does not keep the array alive.
    kept = [points, tv.from_numpy(points)]
    return f"spconv {importlib.metadata.version('spconv')}", lambda: voxeliser.point_to_voxel(kept[1])


def registration(reported):
    """small_gicp from the points of a sweep to its pose: voxel grid, then point to plane, on a target whose normals and tree are there."""
    import importlib.metadata
    import itertools

    import numpy
    import small_gicp

    read = lambda file: numpy.fromfile(file, dtype=numpy.float32).reshape(-1, 3).astype(numpy.float64)
    target, tree = small_gicp.preprocess_points(read(reported["target"]), reported["target_m"], num_threads=1)
    sources = [(read(source["points"]), numpy.array(source["guess"])) for source in reported["sources"]]

    def align(points, guess):
        sample = small_gicp.voxelgrid_sampling(points, reported["sample_m"], num_threads=1)
        settings = {"registration_type": "PLANE_ICP", "max_correspondence_distance": 1.0, "num_threads": 1}
        return small_gicp.align(target, sample, tree, guess, **settings).T_target_source

    truths = [numpy.array(source["truth"]) for source in reported["sources"]]
    off = max(numpy.linalg.norm((align(*source) - truth)[:3, 3]) for source, truth in zip(sources, truths))
    turns = itertools.cycle(sources)
    name = f"small_gicp {importlib.metadata.version('small_gicp')}, voxel grid and PLANE_ICP, at most {1e3 * off:.1f} mm off"
    return name, lambda: align(*next(turns))


def point_pillars(reported):
    """The network from the canvas to its last map: backbone, shrink layers, and heads if there are any."""
    import torch
    from torch import nn

    def convolution(inputs, outputs, kernel, stride=1):
        layers = [nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False), nn.BatchNorm2d(outputs), nn.ReLU()]
        return nn.Sequential(*layers)

    def plain(inputs, settings):
        layers = []
        for layer in settings:
            kernel, outputs = layer["kernel"], layer["channels"]
            layers += [nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2), nn.ReLU()]
            inputs = outputs
        return layers, inputs

    def upsampling(inputs, outputs, stride):
        up = nn.ConvTranspose2d(inputs, outputs, stride, stride, bias=False)
        return nn.Sequential(up, nn.BatchNorm2d(outputs), nn.ReLU())

    class PointPillars(nn.Module):
        def __init__(self):
            super().__init__()
            backbone, inputs = reported["backbone"], reported["channels"]
            blocks, ups = [], []
            each = zip(*(backbone[key] for key in ("layers", "strides", "channels", "up_strides", "up_channels")))
            for layers, stride, channels, up_stride, up_channels in each:
                more = [convolution(channels, channels, 3) for _ in range(layers)]
                blocks.append(nn.Sequential(convolution(inputs, channels, 3, stride), *more))
                ups.append(upsampling(channels, up_channels, up_stride))
                inputs = channels
            self.blocks, self.ups = nn.ModuleList(blocks), nn.ModuleList(ups)
            shrink, channels = plain(sum(backbone["up_channels"]), reported["shrink"])
            self.shrink = nn.Sequential(*shrink)
            refine, channels = plain(channels, reported["refine"])
            heads = nn.Conv2d(channels, reported["outputs"], 1) if reported["outputs"] else nn.Identity()
            self.heads = nn.Sequential(*refine, heads)

        def features(self, canvas):
            maps = []
            for block, up in zip(self.blocks, self.ups):
                canvas = block(canvas)
                maps.append(up(canvas))
            return self.shrink(torch.cat(maps, 1))

        def forward(self, canvas):
            return self.heads(self.features(canvas))

    return PointPillars().to(memory_format=torch.channels_last)


def canvas_of(reported):
    """A canvas as full as a sweep's: features above 0 in a few of its cells."""
    import torch

    shape = reported["batch"], reported["channels"], reported["rows"], reported["columns"]
    full = torch.rand(shape[0], 1, *shape[2:]) < 0.1
    return (torch.relu(torch.randn(shape)) * full).to(memory_format=torch.channels_last)


def training(reported):
    """A step of the same network in PyTorch: forward, backward and AdamW, from canvases that are there already: one of each agent of
    each sample. Of several agents attention makes one map."""
    import torch

    torch.set_num_threads(reported["threads"])
    network, agents = point_pillars(reported).train(), reported["agents"]
    optimizer = torch.optim.AdamW(network.parameters(), 2e-3)
    canvas = canvas_of(reported)

    def fused(features):
        if agents == 1:
            return features
        maps = features.permute(0, 2, 3, 1)
        return attention(maps.reshape(-1, agents, *maps.shape[1:])).permute(0, 3, 1, 2)

    def step():
        optimizer.zero_grad()
        network.heads(fused(network.features(canvas))).square().mean().backward()
        optimizer.step()

    return f"PyTorch {torch.__version__}, f32, channels_last", step


def fusing(reported, fuse):
    """A whole frame in PyTorch, from canvases that are there already: all encoders, a fusion of [agents, rows, columns,
    channels] that gives the ego's map, heads."""
    import torch

    torch.set_num_threads(reported["threads"])
    network, canvas = point_pillars(reported).eval(), canvas_of(reported)

    @torch.inference_mode()
    def run():
        fused = fuse(network.features(canvas).permute(0, 2, 3, 1))
        return network.heads(fused.permute(2, 0, 1).unsqueeze(0))

    return f"PyTorch {torch.__version__}, f32, channels_last", run


def attention(maps):
    """AttFuse: of maps […, agents, rows, columns, channels] the first agent's, by attention in each cell."""
    cells = maps.movedim(-4, -2)
    weights = (cells[..., :1, :] @ cells.transpose(-2, -1) / cells.shape[-1] ** 0.5).softmax(-1)
    return (weights @ cells).squeeze(-2)


def fcooper(reported):
    """F-Cooper: the max of each feature."""
    return fusing(reported, lambda maps: maps.amax(0))


def attfuse(reported):
    """AttFuse: attention in each cell."""
    return fusing(reported, attention)


def v2xvit(reported):
    """V2X-ViT: its transformer for all agents, of which the ego's map is taken; no agents are added to fill a batch."""
    import torch
    from torch import nn

    settings, channels = reported["arch"], reported["shrink"][-1]["channels"]

    class OverAgents(nn.Module):
        """In each cell, with layers for each kind of agent and matrices for each pair of kinds."""

        def __init__(self):
            super().__init__()
            self.heads, width = settings["heads"], settings["head_width"]
            self.norm, self.scale = nn.LayerNorm(channels), width**-0.5
            of_kinds = lambda: nn.ModuleList(nn.Linear(channels, channels) for _ in range(2))
            self.queries, self.keys, self.values, self.outputs = (of_kinds() for _ in range(4))
            relations = lambda: nn.Parameter(torch.randn(2, 2, self.heads, width, width) * self.scale)
            self.attention, self.message = relations(), relations()

        def forward(self, maps, kinds, covered):
            normed = self.norm(maps)
            each = lambda layers, maps: torch.stack([layers[kind](map) for kind, map in zip(kinds.tolist(), maps)])
            of = lambda layers: each(layers, normed).unflatten(3, (self.heads, -1))
            queries, keys, values = of(self.queries), of(self.keys), of(self.values)
            pairs = kinds[:, None], kinds[None]
            queries = torch.einsum("irchp,ijhpq->ijrchq", queries, self.attention[pairs])
            scores = (queries * keys).sum(5) * self.scale
            weights = scores.masked_fill(~covered[None, :, :, :, None], -torch.inf).softmax(1)
            values = torch.einsum("jrchp,ijhpq->ijrchq", values, self.message[pairs])
            return each(self.outputs, (weights[..., None] * values).sum(1).flatten(3))

    class WithinWindows(nn.Module):
        def __init__(self, side, heads, head_width):
            super().__init__()
            self.side, self.heads, width = side, heads, heads * head_width
            self.qkv, self.output = nn.Linear(channels, 3 * width, bias=False), nn.Linear(width, channels)
            self.positions = nn.Parameter(torch.randn(2 * side - 1, 2 * side - 1))
            at = torch.cartesian_prod(torch.arange(side), torch.arange(side))
            self.offsets = (at[None] - at[:, None] + side - 1).unbind(2)

        def forward(self, maps):
            agents, rows, columns, _ = maps.shape
            cut = agents, rows // self.side, self.side, columns // self.side, self.side, 3, self.heads, -1
            qkv = self.qkv(maps).reshape(cut).permute(5, 0, 1, 3, 6, 2, 4, 7)
            queries, keys, values = qkv.flatten(5, 6).flatten(1, 3)
            attend = nn.functional.scaled_dot_product_attention
            made = attend(queries, keys, values, attn_mask=self.positions[self.offsets])
            made = made.reshape(*cut[:2], cut[3], self.heads, self.side, self.side, -1).permute(0, 1, 4, 2, 5, 3, 6)
            return self.output(made.reshape(agents, rows, columns, -1))

    class OverWindows(nn.Module):
        """Windows of all sizes, each taken by how much it counts in a channel."""

        def __init__(self):
            super().__init__()
            self.norm, self.windows = nn.LayerNorm(channels), nn.ModuleList(WithinWindows(**w) for w in settings["windows"])
            first, second = (nn.Linear(channels, n * channels, bias=False) for n in (1, len(self.windows)))
            self.counts = nn.Sequential(first, nn.LayerNorm(channels), nn.ReLU(), second)

        def forward(self, maps):
            normed = self.norm(maps)
            made = torch.stack([window(normed) for window in self.windows])
            counts = self.counts(made.sum(0).mean((1, 2))).unflatten(1, (len(made), channels)).softmax(1)
            return torch.einsum("narci,ani->arci", made, counts)

    class Transformer(nn.Module):
        def __init__(self):
            super().__init__()
            self.delays, self.delayed = nn.Embedding(settings["delays"], channels), nn.Linear(channels, channels)
            wide = settings["feed_forward"]
            forward = lambda: [nn.LayerNorm(channels), nn.Linear(channels, wide), nn.GELU(), nn.Linear(wide, channels)]
            block = lambda: nn.ModuleList([OverAgents(), OverWindows()])
            blocks = lambda: nn.ModuleList(block() for _ in range(settings["blocks"]))
            rounds = (nn.ModuleList([blocks(), nn.Sequential(*forward())]) for _ in range(settings["depth"]))
            self.rounds = nn.ModuleList(rounds)

        def forward(self, maps, kinds, delays, covered):
            maps = maps + self.delayed(self.delays(delays * settings["delay_ratio"]))[:, None, None]
            for blocks, feed_forward in self.rounds:
                for over_agents, over_windows in blocks:
                    maps = maps + over_agents(maps, kinds, covered)
                    maps = maps + over_windows(maps)
                maps = maps + feed_forward(maps)
            return maps[0]

    transformer = Transformer().eval()
    vehicles = torch.zeros(reported["batch"], dtype=torch.long)
    everywhere = lambda maps: torch.ones(maps.shape[:3], dtype=torch.bool)
    return fusing(reported, lambda maps: transformer(maps, vehicles, vehicles, everywhere(maps)))


def pytorch(reported):
    """The encoder in PyTorch."""
    import torch

    torch.set_num_threads(reported["threads"])
    network, canvas = point_pillars(reported).eval(), canvas_of(reported)

    @torch.inference_mode()
    def run():
        return network(canvas)

    return f"PyTorch {torch.__version__}, f32, channels_last", run


def openvino(reported):
    """The encoder in OpenVINO, in f32, bf16 or int8."""
    import openvino
    import torch

    network, canvas = point_pillars(reported).eval(), canvas_of(reported).contiguous()
    model = openvino.convert_model(network, example_input=canvas, input=[tuple(canvas.shape)])
    if reported["precision"] == "int8":
        import nncf

        model = nncf.quantize(model, nncf.Dataset([canvas.numpy()]), subset_size=1)
    hint = {"int8": "f32", "bf16": "bf16", "f32": "f32"}[reported["precision"]]
    settings = {"INFERENCE_PRECISION_HINT": hint, "INFERENCE_NUM_THREADS": reported["threads"], "PERFORMANCE_HINT": "LATENCY"}
    compiled = openvino.Core().compile_model(model, "CPU", settings)
    request, numbers = compiled.create_infer_request(), canvas.numpy()
    return f"OpenVINO {openvino.__version__.split('-')[0]}, {reported['precision']}", lambda: request.infer([numbers])


def onnxruntime(reported):
    """The encoder in ONNX Runtime, in f32."""
    import io

    import onnxruntime
    import torch

    network, canvas = point_pillars(reported).eval(), canvas_of(reported).contiguous()
    file = io.BytesIO()
    torch.onnx.export(network, (canvas,), file, input_names=["canvas"], dynamo=False)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = reported["threads"]
    session = onnxruntime.InferenceSession(file.getvalue(), options, providers=["CPUExecutionProvider"])
    numbers = {"canvas": canvas.numpy()}
    return f"ONNX Runtime {onnxruntime.__version__}, f32", lambda: session.run(None, numbers)


PEERS = {
    "attfuse": attfuse,
    "fcooper": fcooper,
    "onnxruntime": onnxruntime,
    "openvino": openvino,
    "pytorch": pytorch,
    "registration": registration,
    "training": training,
    "v2xvit": v2xvit,
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
