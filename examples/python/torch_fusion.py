"""An intermediate fusion in PyTorch: one map of the ego's and its collaborators'. It takes the place of `fusion`."""

import torch
from realo_operator import Counter, Message, Operator, Port, geometry, run

import torch_network as network
from torch_encoder import columns_of

REJECTED = Counter(
    "rejected_messages",
    "messages could not be fused, because they have no pose or another grid",
    "all agents need one model and poses",
)


def map_of(payload, device):
    """A `FeatureMap` as `[channels, rows, columns]`, laid out in memory as PyTorch's convolutions leave it."""
    return torch.tensor(payload["data"], device=device).permute(2, 0, 1).contiguous()


class TorchFusion(Operator):
    NAME = "torch-fusion"
    #: device: `auto`, `cpu` or `cuda`; a fusion with weights has a setting for their file.
    DEFAULTS = {"device": "auto"}
    INPUTS = [
        Port("ego", "FeatureMap", "the ego's map", queue="latest", join="frame"),
        Port("selections", "Selection", "what the bank chose for that map", queue="latest", join="frame"),
    ]
    OUTPUTS = [Port("features", "FeatureMap", "one map for the head, in the ego's frame")]

    def __init__(self, config):
        super().__init__(config)
        self.device = network.device_named(config.device)
        self.fusion = network.Fusion().eval()

    def on_input(self, port, message, out):
        if port == "ego":
            self.ego = message
            return
        ego, query = self.ego, message.payload["query"]
        if (ego.header.agent, ego.header.seq) != (message.header.agent, query):
            raise ValueError(f"a selection for query {query}, but the ego's message is {ego.header}")
        maps = [map_of(ego.payload, self.device)]
        covered = [torch.ones(maps[0].shape[1:], dtype=torch.bool, device=self.device)]
        # One order whatever the bank's: the result must not depend on who answers first.
        for entry in sorted(message.payload["entries"], key=lambda entry: entry.header.agent):
            poses = ego.header.map_from_frame, entry.header.map_from_frame
            is_rejected = any(pose is None for pose in poses) or not geometry.same_grid(ego.payload, entry.payload)
            out.count(REJECTED, is_rejected, entry.header.agent, of=1)
            if is_rejected:
                out.report(entry.header, "rejected")
                continue
            moved, inside = network.in_frame_of(geometry.relative(*poses), map_of(entry.payload, self.device))
            maps.append(moved)
            covered.append(inside)
            out.used(entry.header, ego.header)
        fused = self.fusion(torch.stack(maps), torch.stack(covered))
        out.send("features", Message(ego.header, "FeatureMap", columns_of(fused, ego.payload["model"])))


if __name__ == "__main__":
    run(TorchFusion)
