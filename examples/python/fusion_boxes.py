"""Late fusion: brings collaborators' boxes to the ego's frame and lists them after its own, as `fusion-boxes` does."""

from realo_operator import Counter, Message, Operator, Port, geometry, run

#: A Counter with a note makes a sentence in the results.
REJECTED = Counter("rejected_messages", "messages could not be fused, because they have no pose", "all agents need poses")


class FusionBoxes(Operator):
    NAME = "fusion-boxes-python"
    #: min_score: boxes of a lower score are dropped, the ego's own included.
    DEFAULTS = {"min_score": 0.0}
    INPUTS = [
        Port("ego", "Boxes", "the ego's detections", queue="latest", join="frame"),
        Port("selections", "Selection", "what the bank chose for that message", queue="latest", join="frame"),
    ]
    OUTPUTS = [Port("proposals", "Boxes", "the ego's boxes, then the collaborators', in the ego's frame")]

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
        map_from_ego, parts = ego.header.map_from_frame, [ego.payload]
        # One order whatever the bank's: the result must not depend on who answers first.
        for entry in sorted(message.payload["entries"], key=lambda entry: entry.header.agent):
            map_from_sender = entry.header.map_from_frame
            is_rejected = entry.type != "Boxes" or map_from_sender is None or map_from_ego is None
            out.count(REJECTED, is_rejected, entry.header.agent, of=1)
            if is_rejected:
                out.report(entry.header, "rejected")
                continue
            out.used(entry.header, ego.header)
            ego_from_sender = geometry.relative(map_from_ego, map_from_sender)
            parts.append(geometry.transform_boxes(ego_from_sender, entry.payload))
        fused = geometry.join(parts)
        low = fused["score"] < self.config.min_score
        out.count("low_score_boxes", low.sum())
        out.send("proposals", Message(ego.header, "Boxes", geometry.select(fused, ~low)))


if __name__ == "__main__":
    run(FusionBoxes)
