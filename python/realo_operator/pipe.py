"""Answers a run in virtual time: frames of Arrow IPC over the standard streams (see `realo_runtime::pipe`)."""

import json
import os
import struct
import traceback

import pyarrow as pa

from .message import Message
from .operator import Outputs

VERSION = 1
FRAME_LIMIT = 256 << 20


def serve(stage):
    """Answers calls until the driver has called the end or closes the pipe."""
    calls = os.fdopen(os.dup(0), "rb")
    replies = os.fdopen(os.dup(1), "wb")
    # What the operator prints must not get between the frames.
    os.dup2(2, 1)
    ports = {
        "inputs": [port.document() for port in stage.INPUTS],
        "outputs": [port.document() for port in stage.OUTPUTS],
    }
    hello = {"version": pa.array([VERSION], pa.uint32()), "name": [stage.NAME], "ports": [json.dumps(ports)]}
    _write(replies, hello)
    while (call := _read(calls)) is not None:
        kind = call.column("call")[0].as_py()
        _write(replies, _answer(stage, kind, call))
        if kind == "end":
            return


def _answer(stage, kind, call):
    out = Outputs(stage, call.column("now")[0].as_py())
    error = ""
    try:
        if kind == "input":
            message = Message.read(call.column("message"))
            stage.on_input(call.column("port")[0].as_py(), message, out)
        elif kind == "wake":
            stage.on_wake(out.now, out)
        else:
            stage.on_end(out)
    except Exception as failure:  # noqa: BLE001: an error belongs to one message, the run goes on
        error = str(failure) or type(failure).__name__
        if not isinstance(failure, ValueError):
            traceback.print_exc()
    wakes, counts = sorted(out.wakes), out.counts
    reply = {
        "error": [error],
        "ports": pa.array([[port for port, _ in out.sent]], pa.list_(pa.string())),
        "wakes": pa.array([wakes], pa.list_(pa.int64())),
        "counters": pa.array([list(counts)], pa.list_(pa.string())),
        "counts": pa.array([list(counts.values())], pa.list_(pa.uint64())),
    }
    reply.update({f"message_{i}": message.write() for i, (_, message) in enumerate(out.sent)})
    return reply


def _write(stream, columns):
    batch = pa.RecordBatch.from_pydict(columns)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, batch.schema) as writer:
        writer.write_batch(batch)
    frame = sink.getvalue()
    if frame.size > FRAME_LIMIT:
        raise ValueError(f"expected a frame of at most {FRAME_LIMIT} bytes, found {frame.size}")
    stream.write(struct.pack("<I", frame.size))
    stream.write(frame)
    stream.flush()


def _read(stream):
    prefix = stream.read(4)
    if not prefix:
        return None
    (length,) = struct.unpack("<I", prefix)
    frame = stream.read(length)
    if len(frame) < length:
        raise ValueError(f"expected a frame of {length} bytes, found {len(frame)}")
    return pa.ipc.open_stream(pa.py_buffer(frame)).read_next_batch()
