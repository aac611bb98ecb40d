"""What the fusion owes its graph, by messages that are made up."""

import unittest
from types import SimpleNamespace

import numpy as np
from realo_operator import Header, Message, Outputs, boxes

from fusion_boxes import FusionBoxes


def message(agent, x_in_map, *places, seq=0, to=""):
    """Boxes at these x of an agent that stands at `x_in_map`."""
    header = Header(agent=agent, kind="boxes", seq=seq, to=to, pose=[x_in_map, 0, 0, 0, 0, 0, 1])
    columns = boxes(x=places, y=np.zeros(len(places)), length=4.5, width=1.9, height=1.6)
    return Message.boxes(header, columns)


def fused(ego, entries, query=None):
    """What comes out for a query, and the fates that were reported."""
    stage, out = FusionBoxes(SimpleNamespace(**FusionBoxes.DEFAULTS)), Outputs()
    stage.on_input("ego", ego, out)
    selection = {"query": ego.header.seq if query is None else query, "entries": entries}
    stage.on_input("selections", Message(ego.header, "Selection", selection), out)
    ((port, answer),) = out.sent
    assert port == "proposals" and answer.header.seq == ego.header.seq
    return answer.payload["x"].tolist(), [fate["fate"] for fate in out.fates]


class TestFusion(unittest.TestCase):
    def test_nobody_to_fuse_with_leaves_the_ego(self):
        found, fates = fused(message("cav1", 0, 10, 30), [])
        self.assertEqual((found[:2], fates), ([10, 30], []))

    def test_boxes_come_into_the_egos_frame_in_one_order(self):
        entries = [message("rsu1", 40, 10, to="cav1"), message("cav2", 20, 40, to="cav1")]
        found, fates = fused(message("cav1", 0, 10), entries)
        self.assertEqual((found, fates), ([10, 60, 50], ["used", "used"]))
        self.assertEqual(fused(message("cav1", 0, 10), entries[::-1])[0], found)

    def test_a_selection_for_another_query_is_an_error(self):
        with self.assertRaises(ValueError):
            fused(message("cav1", 0, 10, seq=3), [], query=2)


if __name__ == "__main__":
    unittest.main()
