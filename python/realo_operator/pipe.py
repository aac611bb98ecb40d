"""The program: answers its host in frames of Arrow IPC over the standard streams (see the crate `realo-operator`)."""

import contextlib
import difflib
import fcntl
import io
import json
import mmap
import os
import struct
import sys
import traceback
from types import SimpleNamespace

import pyarrow as pa

from .message import Message
from .operator import Outputs

VERSION = 2
FRAME_LIMIT = 256 << 20
#: Frames of more bytes go through shared memory.
SHARED_FROM = 64 << 10
#: Stands for the length of such a frame.
SHARED = 0xFFFFFFFF
#: No writing, growing, shrinking, nor other seals.
SEALS = 0xF


def run(operator):
    """Serves an operator class with the arguments of the command line (`key=value`, as in the graph) to the host that
    started the program. Ends the process: 0, or 1 with the error."""
    try:
        if os.environ.get("REALO_DRIVER") != "pipe":
            mend = f"give a node `path: bin/realo` and `args: program {sys.argv[0]}`"
            raise ValueError(f"a plug-in, which a graph starts: {mend}")
        stage = operator(configuration(operator, sys.argv[1:]))
        calls, replies = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
        # What the operator prints must not get between the frames.
        os.dup2(2, 1)
        serve(stage, calls, replies, reaches(os.environ.get("REALO_MEMORY", "")))
    except Exception as error:  # noqa: BLE001: whatever it is, the run must hear of it
        if not isinstance(error, (ValueError, RuntimeError)):
            traceback.print_exc()
        sys.exit(f"{operator.NAME}: {error}")


def serve(stage, calls, replies, shares):
    """Answers calls until the host has called the end or closes the pipe."""
    ports = {side: [port.document() for port in getattr(stage, side.upper())] for side in ("inputs", "outputs")}
    hello = {"name": [stage.NAME], "memory": ["memfd" if shares else "pipe"], "ports": [json.dumps(ports)]}
    write(replies, {"version": pa.array([VERSION], pa.uint32()), **hello}, None)
    while (call := read(calls)) is not None:
        with contextlib.ExitStack() as lent:
            write(replies, _answer(stage, call), lent if shares else None)
            # What is lent is there until the host says more, or nothing after the end.
            calls.peek(1)


def _answer(stage, call):
    kind, out, error = call.column("call")[0].as_py(), Outputs(call.column("now")[0].as_py()), ""
    try:
        if kind == "input":
            stage.on_input(call.column("port")[0].as_py(), Message.read(call.column("message")), out)
        elif kind == "wake":
            stage.on_wake(out.now, out)
        else:
            stage.on_end(out)
    except Exception as failure:  # noqa: BLE001: an error belongs to one message, the run goes on
        error = str(failure) or type(failure).__name__
        if not isinstance(failure, ValueError):
            traceback.print_exc()
    return {
        "error": [error],
        "ports": pa.array([[port for port, _ in out.sent]], pa.list_(pa.string())),
        "wakes": pa.array([sorted(out.wakes)], pa.list_(pa.int64())),
        "counters": pa.array([list(out.counts)], pa.list_(pa.string())),
        "counts": pa.array([list(out.counts.values())], pa.list_(pa.uint64())),
        "told": [json.dumps({"fates": out.fates})],
        **{f"message_{i}": row for i, row in enumerate(out.rows)},
    }


def write(stream, columns, lent):
    """Writes a frame; `lent` closes the memory that holds a big one, without it none is shared."""
    batch = pa.RecordBatch.from_pydict(columns)
    shared, file = lent is not None and batch.nbytes > SHARED_FROM, io.BytesIO()
    if shared:
        memory = os.memfd_create("realo", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        file = lent.enter_context(os.fdopen(memory, "wb", 0))
    with pa.ipc.new_stream(pa.PythonFile(file, "w"), batch.schema) as writer:
        writer.write_batch(batch)
    length = file.tell()
    if length > FRAME_LIMIT:
        raise ValueError(f"expected a frame of at most {FRAME_LIMIT} bytes, made one of {length}")
    if shared:
        fcntl.fcntl(memory, fcntl.F_ADD_SEALS, SEALS)
        stream.write(struct.pack("<4I", SHARED, os.getpid(), memory, length))
    else:
        stream.write(struct.pack("<I", length) + file.getbuffer())
    stream.flush()


def read(stream):
    """The row of the next frame, `None` where the stream ends."""
    prefix = stream.read(4)
    if not prefix:
        return None
    (length,) = struct.unpack("<I", prefix)
    frame = opened(*struct.unpack("<3I", stream.read(12))) if length == SHARED else stream.read(length)
    if length != SHARED and len(frame) < length:
        raise ValueError(f"expected a frame of {length} bytes, found {len(frame)}")
    return pa.ipc.open_stream(pa.py_buffer(frame)).read_next_batch()


def opened(pid, number, length):
    """A mapping of the memory that a process lends; what is made of it keeps it."""
    file = os.open(f"/proc/{pid}/fd/{number}", os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        if fcntl.fcntl(file, fcntl.F_GET_SEALS) & SEALS != SEALS or os.fstat(file).st_size != length:
            raise ValueError(f"expected sealed memory of {length} bytes")
        return mmap.mmap(file, length, mmap.MAP_SHARED | mmap.MAP_POPULATE, mmap.PROT_READ)
    finally:
        os.close(file)


def reaches(probe):
    """Whether this process reads what its host lent it to try."""
    try:
        return hasattr(os, "memfd_create") and opened(*map(int, probe.split(" "))) is not None
    except (AttributeError, OSError, TypeError, ValueError):
        return False


def configuration(operator, args):
    """The defaults of an operator with `key=value` arguments over them; a value is JSON, or of the default's type."""
    values, seen = dict(operator.DEFAULTS), set()
    for key, equals, text in (arg.partition("=") for arg in args):
        if not equals or key in seen:
            raise ValueError(f"argument `{key}` is {'given twice' if equals else 'not of the form key=value'}")
        if key not in values:
            near = difflib.get_close_matches(key, values, 1)
            hint = f" (did you mean `{near[0]}`?)" if near else ""
            raise ValueError(f"unknown argument `{key}`{hint}; it takes: {', '.join(values)}")
        seen.add(key)
        values[key] = _value(key, text, values[key])
    return SimpleNamespace(**values)


def _value(key, text, default):
    if isinstance(default, str):
        return text
    if isinstance(default, list) and not text.lstrip().startswith("["):
        return [part.strip() for part in text.split(",") if part.strip()]
    try:
        value = json.loads(text)
    except ValueError as error:
        raise ValueError(f"argument `{key}`: `{text}` is no value: {error}") from error
    value = float(value) if isinstance(default, float) and type(value) is int else value
    if default is not None and type(value) is not type(default):
        raise ValueError(f"argument `{key}`: expected a value like `{json.dumps(default)}`, found `{text}`")
    return value
