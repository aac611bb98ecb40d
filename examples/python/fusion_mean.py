"""Intermediate fusion: in each cell the mean of the agents' features, weighted by how strong they are."""

import numpy as np
from realo_operator import Counter, Message, Operator, Port, geometry, run

#: A Counter with a note makes a sentence in the results.
REJECTED = Counter(
    "rejected_messages",
    "messages could not be fused, because they have no pose or another grid",
    "all agents need one model and poses",
)


class FusionMean(Operator):
    NAME = "fusion-mean-python"
    #: power: an agent's weight in a cell is the length of its feature vector there to this power; 0: all count alike.
    DEFAULTS = {"power": 4.0}
    INPUTS = [
        Port("ego", "FeatureMap", "the ego's map", queue="latest", join="frame"),
        Port("selections", "Selection", "what the bank chose for that map", queue="latest", join="frame"),
    ]
    OUTPUTS = [Port("features", "FeatureMap", "one map for the head, in the ego's frame")]

    def on_input(self, port, message, out):
        if port == "ego":
            self.ego = message
            return
        ego, query = self.ego, message.payload["query"]
        if (ego.header.agent, ego.header.seq) != (message.header.agent, query):
            raise ValueError(f"a selection for query {query}, but the ego's message is {ego.header}")
        fused = ego.payload["data"].copy()
        total = self.weight(fused)
        # One order whatever the bank's: the result must not depend on who answers first.
        for entry in sorted(message.payload["entries"], key=lambda entry: entry.header.agent):
            poses = ego.header.map_from_frame, entry.header.map_from_frame
            is_rejected = any(pose is None for pose in poses) or not geometry.same_grid(ego.payload, entry.payload)
            out.count(REJECTED, is_rejected, entry.header.agent, of=1)
            if is_rejected:
                out.report(entry.header, "rejected")
                continue
            features, covered = geometry.warp_map(geometry.relative(*poses), entry.payload)
            weight = np.where(covered, self.weight(features), 0)
            total += weight
            share = np.divide(weight, total, out=np.zeros_like(total), where=total > 0)
            fused += (features - fused) * share[..., None].astype(np.float32)
            out.used(entry.header, ego.header)
        out.send("features", Message(ego.header, "FeatureMap", {**ego.payload, "data": fused}))

    def weight(self, features):
        return np.einsum("yxc,yxc->yx", features, features, dtype=np.float64) ** (self.config.power / 2)


if __name__ == "__main__":
    run(FusionMean)
