"""A detection head in PyTorch: from a map to boxes. It takes the place of `head`; `nms` after it removes duplicates."""

from realo_operator import Message, Operator, Port, boxes, run

import torch_network as network
from torch_fusion import map_of


def columns_of_boxes(score, label, found):
    """Detections as columns of the payload `Boxes`."""
    x, y, z, length, width, height, yaw = found.double().cpu().numpy().T
    names = [network.CLASSES[index][0] for index in label.tolist()]
    size = {"length": length, "width": width, "height": height}
    return boxes(x, y, z, **size, yaw=yaw, score=score.cpu().numpy(), class_=names)


class TorchHead(Operator):
    NAME = "torch-head"
    #: weights and device: as of the encoder; score_threshold: min score of a box.
    DEFAULTS = {"weights": "", "device": "auto", "score_threshold": 0.1}
    INPUTS = [Port("features", "FeatureMap", "maps in the ego's frame", queue="latest")]
    OUTPUTS = [Port("proposals", "Boxes", "detections, best first")]

    def __init__(self, config):
        super().__init__(config)
        self.head = network.loaded(network.Head(), config.weights, config.device)
        self.device = next(self.head.parameters()).device

    def on_input(self, port, message, out):
        scores, found = self.head(map_of(message.payload, self.device)[None])
        best = network.detections(scores, found, self.config.score_threshold)
        out.send("proposals", Message.boxes(message.header, columns_of_boxes(*best)))


if __name__ == "__main__":
    run(TorchHead)
