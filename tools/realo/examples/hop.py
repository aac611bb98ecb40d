"""Passes clouds on: `cargo run --release -p realo --example hop tools/realo/examples/hop.py`."""

from realo_operator import Operator, Port, run


class Pass(Operator):
    NAME = "pass"
    INPUTS = [Port("clouds", "PointCloud")]
    OUTPUTS = [Port("clouds", "PointCloud")]

    def on_input(self, port, message, out):
        out.send("clouds", message)


if __name__ == "__main__":
    run(Pass)
