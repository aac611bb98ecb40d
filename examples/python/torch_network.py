"""A network in plain PyTorch, which knows nothing of realo: PointPillars with AttFuse, as `models/lite-attfuse.toml` describes it.

Put your own in its place: three modules, of which the first makes a map of a sweep, the second one map of several, and the
third boxes of a map. `torch_encoder.py`, `torch_fusion.py` and `torch_head.py` run them as stages, `torch_script.py` without
realo. Rows run along y, columns along x; metres; boxes are x, y, z, length, width, height, yaw.
"""

import math
import sys
from pathlib import Path

import torch
from torch import nn
from torch.nn import functional as F

#: The grid's lower and upper corners (m), the side of a pillar (m), points in a pillar, pillars in a sweep.
LOW, HIGH, CELL, POINTS, PILLARS = (-102.4, -40.0, -3.0), (102.4, 40.0, 5.0), 0.4, 32, 40_000
#: The side of a cell of the BEV map, m.
MAP_CELL = 0.8
#: Name, length, width, height and z of the centre of each class's anchors, and the headings of each.
CLASSES = (("vehicle", 3.9, 1.6, 1.56, 0.78), ("pedestrian", 0.8, 0.6, 1.73, 0.865), ("truck", 8.0, 3.0, 3.0, 1.5))
ROTATIONS = (0.0, 1.57)
#: Boxes of a frame, at most.
MOST = 1000


def norm(channels, of=nn.BatchNorm2d):
    return of(channels, eps=1e-3)


class PillarNet(nn.Module):
    """From points `[n, 3]` to a canvas `[1, channels, rows, columns]`."""

    def __init__(self, channels=32):
        super().__init__()
        self.pfn_layers = nn.ModuleList([nn.ModuleDict({"linear": nn.Linear(10, channels, bias=False), "norm": norm(channels, nn.BatchNorm1d)})])
        self.columns, self.rows = (round((high - low) / CELL) for low, high in zip(LOW[:2], HIGH[:2]))

    def forward(self, points):
        points, pillar, cells = self.pillars(points)
        layer = self.pfn_layers[0]
        features = layer["norm"](layer["linear"](self.decorated(points, pillar, cells)))
        best = features.new_zeros(len(cells), features.shape[1])  # zeros: also the ReLU
        best = best.scatter_reduce(0, pillar[:, None].expand_as(features), features, "amax")
        canvas = best.new_zeros(best.shape[1], self.rows * self.columns)
        canvas[:, cells] = best.T
        return canvas.view(1, -1, self.rows, self.columns)

    def pillars(self, points):
        """The points that pillars take, the number of each one's pillar, and each pillar's cell."""
        low, high = points.new_tensor(LOW), points.new_tensor(HIGH)
        place = (points - low) / CELL
        inside = (points > low) & (points < high)
        points, place = points[inside.all(dim=1)], place[inside.all(dim=1)].long()
        cell = place[:, 1] * self.columns + place[:, 0]
        order = torch.argsort(cell, stable=True)
        cells, counts = torch.unique_consecutive(cell[order], return_counts=True)
        first = counts.cumsum(0) - counts
        # Pillars are numbered in the order in which points first touch them.
        number = torch.empty_like(first)
        by_touch = torch.argsort(order[first])[:PILLARS]
        number.fill_(-1)
        number[by_touch] = torch.arange(len(by_touch), device=points.device)
        rank = torch.arange(len(order), device=points.device) - first.repeat_interleave(counts)
        pillar = number.repeat_interleave(counts)
        taken = (rank < POINTS) & (pillar >= 0)
        return points[order[taken]], pillar[taken], cells[by_touch]

    def decorated(self, points, pillar, cells):
        """Ten numbers of each point: x, y, z, no intensity, the offsets from its pillar's mean and from its centre."""
        count = torch.bincount(pillar, minlength=len(cells))[:, None]
        mean = points.new_zeros(len(cells), 3).index_add(0, pillar, points) / count
        low = points.new_tensor(LOW)
        column, row = cells % self.columns, cells // self.columns
        x, y = ((index + 0.5) * CELL + low[axis] for axis, index in enumerate((column, row)))
        center = torch.stack([x, y, torch.full_like(x, (LOW[2] + HIGH[2]) / 2)], dim=1)
        return torch.cat([points, points.new_zeros(len(points), 1), points - mean[pillar], points - center[pillar]], dim=1)


class Backbone(nn.Module):
    """From the canvas to one map at half its resolution."""

    def __init__(self, layers=(2, 3, 4), channels=(32, 64, 128), up_strides=(1, 2, 4), up_channels=(64, 64, 64)):
        super().__init__()
        self.blocks, self.deblocks, inputs = nn.ModuleList(), nn.ModuleList(), channels[0]
        for count, outputs, up, up_outputs in zip(layers, channels, up_strides, up_channels):
            block = [nn.ZeroPad2d(1), nn.Conv2d(inputs, outputs, 3, stride=2, bias=False), norm(outputs), nn.ReLU()]
            for _ in range(count):
                block += [nn.Conv2d(outputs, outputs, 3, padding=1, bias=False), norm(outputs), nn.ReLU()]
            self.blocks.append(nn.Sequential(*block))
            widened = nn.ConvTranspose2d(outputs, up_outputs, up, stride=up, bias=False)
            self.deblocks.append(nn.Sequential(widened, norm(up_outputs), nn.ReLU()))
            inputs = outputs

    def forward(self, x):
        ups = []
        for block, deblock in zip(self.blocks, self.deblocks):
            x = block(x)
            ups.append(deblock(x))
        return torch.cat(ups, dim=1)


class Shrink(nn.Module):
    """A convolution to fewer channels, named as OpenCOOD names it."""

    def __init__(self, inputs, outputs, kernel=1):
        super().__init__()
        layers = nn.Sequential(nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2), nn.ReLU())
        self.layers = nn.ModuleList([nn.ModuleDict({"double_conv": layers})])

    def forward(self, x):
        return self.layers[0]["double_conv"](x)


class Encoder(nn.Module):
    """From points `[n, 3]` in an agent's body frame to its BEV map `[1, channels, rows, columns]`."""

    def __init__(self):
        super().__init__()
        self.pillar_vfe, self.backbone, self.shrink_conv = PillarNet(), Backbone(), Shrink(192, 64)

    def forward(self, points):
        return self.shrink_conv(self.backbone(self.pillar_vfe(points)))


class Fusion(nn.Module):
    """AttFuse (Xu et al. 2022): attention of the ego to the agents in each cell. Products are scaled for the backbone's last channels."""

    def __init__(self, width=128):
        super().__init__()
        self.width = width

    def forward(self, maps, covered):
        """Maps of all agents in the ego's frame `[agents, channels, rows, columns]`, the ego's first, and where they are there
        `[agents, rows, columns]`; gives one map `[1, channels, rows, columns]`."""
        scores = (maps[:1] * maps).sum(dim=1) / math.sqrt(self.width)
        shares = torch.softmax(scores.masked_fill(~covered, -math.inf), dim=0)
        return (maps * shares[:, None]).sum(dim=0, keepdim=True)


class Head(nn.Module):
    """From a map to the score of each class and the box of each anchor, `[anchors, classes]` and `[anchors, 7]`."""

    def __init__(self, channels=64, rows=100, columns=256):
        super().__init__()
        anchors = len(CLASSES) * len(ROTATIONS)
        self.refine_conv = nn.Sequential(nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU())
        self.cls_head = nn.Conv2d(channels, anchors * len(CLASSES), 1)
        self.reg_head = nn.Conv2d(channels, anchors * 7, 1)
        self.register_buffer("anchors", self.all_anchors(rows, columns), persistent=False)

    @staticmethod
    def all_anchors(rows, columns):
        """By row, column, class and heading."""
        x = LOW[0] + (torch.arange(columns, dtype=torch.float64) + 0.5) * (HIGH[0] - LOW[0]) / columns
        y = LOW[1] + (torch.arange(rows, dtype=torch.float64) + 0.5) * (HIGH[1] - LOW[1]) / rows
        y, x = torch.meshgrid(y, x, indexing="ij")
        one = [[z, length, width, height, yaw] for _, length, width, height, z in CLASSES for yaw in ROTATIONS]
        one = torch.tensor(one, dtype=torch.float64).expand(rows, columns, -1, -1)
        centers = torch.stack([x, y], dim=-1)[:, :, None].expand(-1, -1, one.shape[2], -1)
        return torch.cat([centers, one], dim=-1).view(-1, 7).float()

    def forward(self, features):
        features = self.refine_conv(features)
        scores = self.cls_head(features).permute(0, 2, 3, 1).reshape(-1, len(CLASSES)).sigmoid()
        deltas = self.reg_head(features).permute(0, 2, 3, 1).reshape(-1, 7)
        return scores, self.boxes(deltas)

    def boxes(self, deltas):
        """Boxes of deltas to the anchors, which come as x, y, z, height, width, length, yaw."""
        dx, dy, dz, dh, dw, dl, turn = deltas.unbind(dim=1)
        x, y, z, length, width, height, yaw = self.anchors.unbind(dim=1)
        diagonal = (width * width + length * length).sqrt()
        center = dx * diagonal + x, dy * diagonal + y, dz * height + z
        return torch.stack([*center, dl.exp() * length, dw.exp() * width, dh.exp() * height, turn + yaw], dim=1)


def detections(scores, boxes, threshold):
    """The best boxes above a score: their score, class and numbers, best first; of equal ones in the anchors' order."""
    score, label = scores.max(dim=1)
    above = (score > threshold).nonzero()[:, 0]
    best = above[torch.argsort(score[above], descending=True, stable=True)][:MOST]
    return score[best], label[best], boxes[best]


def warped(feature_map, column, row):
    """A map `[channels, rows, columns]` at places that are given as columns and rows of it, with zeros around; and which places it
    has a cell for."""
    rows, columns = feature_map.shape[1:]
    to = torch.stack([(column + 0.5) * 2 / columns - 1, (row + 0.5) * 2 / rows - 1], dim=-1)
    moved = F.grid_sample(feature_map[None], to[None].to(feature_map.dtype), align_corners=False)[0]
    nearest_column, nearest_row = column.round(), row.round()
    inside = (nearest_column >= 0) & (nearest_column < columns) & (nearest_row >= 0) & (nearest_row < rows)
    return moved, inside.to(moved.device)


def in_frame_of(ego_from_sender, feature_map):
    """A collaborator's map `[channels, rows, columns]` at the cells of the ego's map, by a 4 × 4 matrix: as the ground moves."""
    rows, columns = feature_map.shape[1:]
    sender_from_ego = torch.linalg.inv(torch.as_tensor(ego_from_sender, dtype=torch.float64))
    y, x = torch.meshgrid(*((torch.arange(n, dtype=torch.float64) + 0.5) * MAP_CELL for n in (rows, columns)), indexing="ij")
    x, y = x + LOW[0], y + LOW[1]
    place = [a * x + b * y + d for a, b, _, d in sender_from_ego[:2]]
    column, row = ((at - low) / MAP_CELL - 0.5 for at, low in zip(place, LOW))
    return warped(feature_map, column.to(feature_map.device), row.to(feature_map.device))


def loaded(module, weights, device="auto"):
    """A module with its part of the weights of a `.safetensors` file or of a checkpoint (`.pth`), on a device."""
    state = state_of(Path(weights))
    prefixes = tuple(f"{name}." for name, _ in module.named_children())
    own = {key: value for key, value in state.items() if key.startswith(prefixes)}
    try:
        module.load_state_dict(own, strict=True)
    except RuntimeError as error:
        raise ValueError(f"{weights}: its tensors are not those of the network: {error}") from None
    return module.eval().requires_grad_(False).to(device_named(device))


def state_of(path):
    """The tensors of a file by name."""
    if not path.is_file():
        raise ValueError(f"setting `weights`: expected a file, found `{path}`; the path is relative to the graph's folder")
    with path.open("rb") as file:
        if file.read(23) == b"version https://git-lfs":
            raise ValueError(f"{path}: expected weights, found a pointer of Git LFS: `git lfs pull` fetches them")
    if path.suffix == ".safetensors":
        from safetensors.torch import load_file

        return load_file(path)
    try:
        # `weights_only`: what is in the file is read, never run.
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # noqa: BLE001: a file that is no checkpoint fails in any way
        expected = "expected the state dict of a network, as torch.save(model.state_dict(), FILE) writes it"
        said = str(error).splitlines() or [type(error).__name__]
        raise ValueError(f"{path}: {expected}: {said[0]}") from None
    return state.get("state_dict", state)


def device_named(name):
    """`cpu`, `cuda`, or `auto`: the GPU if PyTorch finds one."""
    known = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    if name != "auto" and name not in known:
        raise ValueError(f"setting `device`: expected auto or {' or '.join(known)}, found `{name}`")
    name = known[-1] if name == "auto" else name
    print(f"torch {torch.__version__} on {name}", file=sys.stderr)
    return torch.device(name)
