"""Late fusion in Python: brings the boxes of selected collaborators to the ego's body frame and lists them after the
ego's own, as the shipped operator `fusion-boxes` does."""

import json

import numpy as np
import pyarrow as pa

from realo_operator import Message, Operator, Port, run


class FusionBoxes(Operator):
    NAME = "fusion-boxes-python"
    #: min_score: boxes of a lower score are dropped, the ego's own included.
    DEFAULTS = {"min_score": 0.0}
    INPUTS = [
        Port("ego", "Boxes", "the ego's detections", queue="latest", join="frame"),
        Port("selections", "Selection", "what the bank chose for that message", queue="latest", join="frame"),
    ]
    OUTPUTS = [
        Port("boxes", "Boxes", "the ego's boxes, then the collaborators', in the ego's frame"),
        Port("report", "Report", "topic `fusion`: one for each fusion that took place"),
    ]

    def __init__(self, config):
        super().__init__(config)
        self.ego = None

    def on_input(self, port, message, out):
        if port == "ego":
            self.ego = message
            return
        ego, self.ego = self.ego, None
        query = message.payload["query"]
        if ego is None or (ego.header.agent, ego.header.seq) != (message.header.agent, query):
            raise ValueError(f"a selection for query {query} without the ego's boxes of that seq ({message.header})")
        parts, rejected = [ego.payload], []
        for entry in sorted(message.payload["entries"], key=lambda entry: entry.header.agent):
            if entry.type != "Boxes" or not entry.header.pose or not ego.header.pose:
                header = entry.header
                rejected.append({"agent": header.agent, "kind": header.kind, "seq": header.seq})
                continue
            parts.append(brought(entry.payload, relative(ego.header.pose, entry.header.pose)))
        fused = {name: pa.concat_arrays([part[name] for part in parts]) for name in ego.payload}
        kept = ~(fused["score"].to_numpy() < self.config.min_score)
        out.count("low_score_boxes", int((~kept).sum()))
        fused = {name: column.filter(pa.array(kept)) for name, column in fused.items()}
        report = {"query": query, "agent": ego.header.agent, "over_limit": [], "rejected": rejected}
        out.send("boxes", Message(ego.header.copy(), "Boxes", fused))
        document = {"topic": "fusion", "json": json.dumps(report)}
        out.send("report", Message(ego.header.copy(kind="report"), "Report", document))


def rotation(pose):
    """The 3×3 rotation of a pose `x y z qx qy qz qw`."""
    x, y, z, w = np.array(pose[3:]) / np.linalg.norm(pose[3:])
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def relative(map_from_ego, map_from_sender):
    """`ego_from_sender` as rotation and translation, m."""
    ego_from_map = rotation(map_from_ego).T
    translation = ego_from_map @ (np.array(map_from_sender[:3]) - np.array(map_from_ego[:3]))
    return ego_from_map @ rotation(map_from_sender), translation


def brought(boxes, ego_from_sender):
    """Boxes of a sender's frame in the ego's: tilt moves the centre and turns the heading only."""
    turn, shift = ego_from_sender
    center = np.stack([boxes[axis].to_numpy() for axis in "xyz"], axis=-1) @ turn.T + shift
    yaw = boxes["yaw"].to_numpy()
    heading = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=-1) @ turn.T
    out = dict(boxes)
    out.update({axis: pa.array(center[:, i]) for i, axis in enumerate("xyz")})
    out["yaw"] = pa.array(np.arctan2(heading[:, 1], heading[:, 0]))
    out["velocity"] = mapped(boxes["velocity"], lambda v: v @ turn.T)
    angle = np.arctan2(turn[1, 0], turn[0, 0])
    flat = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    turned = lambda c: (flat @ c.reshape(-1, 3, 3) @ flat.T).reshape(-1, 9)  # noqa: E731
    out["covariance"] = mapped(boxes["covariance"], turned)
    return out


def mapped(vectors, function):
    """Vectors of fixed size (null: unknown) with a function over the known ones' rows."""
    known = vectors.is_valid().to_numpy(zero_copy_only=False)
    values = np.zeros((len(vectors), vectors.type.list_size))
    if known.any():
        values[known] = function(vectors.flatten().to_numpy().reshape(-1, values.shape[1]))
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), type=vectors.type, mask=pa.array(~known))


if __name__ == "__main__":
    run(FusionBoxes)
