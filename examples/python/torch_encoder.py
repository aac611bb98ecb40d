"""An encoder in PyTorch: from an agent's points to the BEV map that it shares. It takes the place of `encoder` in a lane."""

import hashlib
from pathlib import Path

import numpy as np
import torch
from realo_operator import Message, Operator, Port, run

import torch_network as network


def points_of(cloud, device):
    """The columns of a cloud as `[n, 3]`."""
    return torch.from_numpy(np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=1)).to(device)


def columns_of(features, model):
    """A map `[1, channels, rows, columns]` as columns of the payload `FeatureMap`, whose cells are channel by channel."""
    data = features[0].permute(1, 2, 0).contiguous().cpu().numpy()
    size = dict(zip(("rows", "columns", "channels"), data.shape))
    place = {"cell": network.MAP_CELL, "origin": list(network.LOW[:2])}
    return {**size, **place, "dtype": "f32", "data": data, "model": model, "confidence": []}


class TorchEncoder(Operator):
    NAME = "torch-encoder"
    #: weights: `.safetensors` or `.pth`, relative to the graph's folder; device: `auto`, `cpu` or `cuda`; send: `features`,
    #: `own` or `both`, for a lane whose map crosses the link, stays with the ego, or does both.
    DEFAULTS = {"weights": "", "device": "auto", "send": "both"}
    INPUTS = [Port("clouds", "PointCloud", "sweeps in the agent's body frame", queue="latest")]
    OUTPUTS = [
        Port("features", "FeatureMap", "BEV maps as agents share them"),
        Port("own", "FeatureMap", "BEV maps for the agent's own fusion"),
    ]

    def __init__(self, config):
        super().__init__(config)
        self.ports = {"both": ("own", "features"), "own": ("own",), "features": ("features",)}.get(config.send)
        if self.ports is None:
            raise ValueError(f"setting `send`: expected `both`, `own` or `features`, found `{config.send}`")
        self.encoder = network.loaded(network.Encoder(), config.weights, config.device)
        self.device = next(self.encoder.parameters()).device
        # Maps of other weights are not fused with these.
        self.model = "torch-" + hashlib.sha256(Path(config.weights).read_bytes()).hexdigest()[:12]

    def on_input(self, port, message, out):
        features = self.encoder(points_of(message.payload, self.device))
        columns = columns_of(features, self.model)
        for name in self.ports:
            out.send(name, Message(message.header.copy(kind="features"), "FeatureMap", columns))


if __name__ == "__main__":
    run(TorchEncoder)
