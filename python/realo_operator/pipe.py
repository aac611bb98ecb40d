"""The program: answers its host in frames of Arrow IPC over the standard streams (see the crate `realo-operator`)."""

import difflib
import fcntl
import io
import json
import mmap
import os
import struct
import sys
import traceback
import weakref
from types import SimpleNamespace

import pyarrow as pa

from .message import Message
from .operator import Outputs

VERSION = 4
FRAME_LIMIT = 256 << 20
#: Frames of more bytes go through shared memory.
SHARED_FROM = 64 << 10
#: Stands for the length of such a frame.
SHARED = 0xFFFFFFFF
#: Files that one side lends at most; a frame for which there is none goes through the pipe.
LENT_AT_MOST = 64


def run(operator):
    """Serves an operator class with the settings of the command line (`key=value`, as in the graph) to the host that
    started the program. Ends the process: 0, or 1 with the error. The host says why the operator refuses its settings."""
    has_host, stage = os.environ.get("REALO_DRIVER") == "pipe", None
    try:
        if not has_host:
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
        reason = _told(error)
        refused = has_host and stage is None and _refuse(operator, reason)
        sys.exit(1 if refused else f"{operator.NAME}: {reason}")


def _refuse(operator, reason):
    """Whether the host could be told why there is no stage."""
    try:
        row = {"version": pa.array([VERSION], pa.uint32()), "name": [operator.NAME], "refused": [reason]}
        write(os.fdopen(os.dup(1), "wb"), row, None, False)
    except OSError:
        return False
    return True


def _told(error):
    """An error in a line: what it says, and unless it says so by itself, what it is and where it was raised."""
    if isinstance(error, (ValueError, RuntimeError)) and str(error):
        return str(error)
    said = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    frames = traceback.extract_tb(error.__traceback__)
    return f"{said} ({os.path.basename(frames[-1].filename)}, line {frames[-1].lineno})" if frames else said


def serve(stage, calls, replies, shares):
    """Answers calls until the host has called the end or closes the pipe."""
    ports = {side: [port.document() for port in getattr(stage, side.upper())] for side in ("inputs", "outputs")}
    hello = {"name": [stage.NAME], "memory": ["memfd" if shares else "pipe"], "ports": [json.dumps(ports)]}
    memory = Memory()
    write(replies, {"version": pa.array([VERSION], pa.uint32()), **hello}, None, False)
    while (call := read(calls, memory)) is not None:
        write(replies, _answer(stage, call), memory, shares)


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
        error = _told(failure)
        if not isinstance(failure, ValueError):
            traceback.print_exc()
    return {
        "error": [error],
        "ports": pa.array([[port for port, _ in out.sent]], pa.list_(pa.string())),
        "wakes": pa.array([sorted(out.wakes)], pa.list_(pa.int64())),
        "counters": pa.array([list(out.counts)], pa.list_(pa.string())),
        "counts": pa.array([list(out.counts.values())], pa.list_(pa.uint64())),
        "reported": [json.dumps({"fates": out.fates, "losses": out.losses})],
        **{f"message_{i}": row for i, row in enumerate(out.rows)},
    }


class Memory:
    """What a process lends to the other side, and what it borrows: files in memory, written again once they are given
    back, which happens when the last array of a frame is gone."""

    def __init__(self):
        self.free, self.lent, self.mapped, self.read = [], {}, {}, []

    def lend(self):
        """A file for a frame; `None` if as many as may be are lent."""
        if len(self.lent) == LENT_AT_MOST:
            return None
        if not self.free:
            file = os.memfd_create("realo", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
            fcntl.fcntl(file, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
            self.free.append(os.fdopen(file, "r+b", 0, closefd=False))
        file = self.free.pop()
        self.lent[file.fileno()] = file
        file.seek(0)
        return file

    def borrow(self, pid, number, length):
        """The frame in a file of another process."""
        if len(self.mapped.get(number, b"")) < length:
            self.mapped[number] = mapped(pid, number, length)
        frame = memoryview(self.mapped[number])[:length]
        weakref.finalize(frame, self.read.append, number)
        return frame

    def give_back(self):
        """The files that were borrowed and are needed no more."""
        numbers, self.read[:] = self.read[:], []
        return numbers


def write(stream, columns, memory, shares):
    """Writes a frame, a big one through memory if the other side shares it; the first, without `memory`, gives none back."""
    batch = pa.RecordBatch.from_pydict(columns)
    lent = memory.lend() if shares and batch.nbytes > SHARED_FROM else None
    file = lent or io.BytesIO()
    with pa.ipc.new_stream(pa.PythonFile(file, "w"), batch.schema) as writer:
        writer.write_batch(batch)
    length = file.tell()
    if length > FRAME_LIMIT:
        raise ValueError(f"expected a frame of at most {FRAME_LIMIT} bytes, made one of {length}")
    read = memory.give_back() if memory else None
    numbers = [SHARED if lent else length] + ([] if read is None else [len(read), *read])
    numbers += [os.getpid(), lent.fileno(), length] if lent else []
    stream.write(struct.pack(f"<{len(numbers)}I", *numbers))
    stream.write(b"" if lent else file.getbuffer())
    stream.flush()


def read(stream, memory):
    """The row of the next frame, `None` where the stream ends."""
    if not (prefix := stream.read(8 if memory else 4)):
        return None
    length, returned = struct.unpack("<2I", prefix) if memory else (*struct.unpack("<I", prefix), 0)
    for number in struct.unpack(f"<{returned}I", stream.read(4 * returned)):
        memory.free.append(memory.lent.pop(number))
    frame = memory.borrow(*struct.unpack("<3I", stream.read(12))) if length == SHARED else stream.read(length)
    if length != SHARED and len(frame) < length:
        raise ValueError(f"expected a frame of {length} bytes, found {len(frame)}")
    return pa.ipc.open_stream(pa.py_buffer(frame)).read_next_batch()


def mapped(pid, number, length):
    """A mapping of the memory that a process lends."""
    file = os.open(f"/proc/{pid}/fd/{number}", os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        if not fcntl.fcntl(file, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK or os.fstat(file).st_size < length:
            raise ValueError(f"expected memory of {length} bytes, sealed against shrinking")
        return mmap.mmap(file, length, mmap.MAP_SHARED | mmap.MAP_POPULATE, mmap.PROT_READ)
    finally:
        os.close(file)


def reaches(probe):
    """Whether this process reads what its host lent it to try."""
    try:
        return hasattr(os, "memfd_create") and mapped(*map(int, probe.split(" "))) is not None
    except (AttributeError, OSError, TypeError, ValueError):
        return False


def configuration(operator, args):
    """The defaults of an operator with `key=value` settings over them; a value is JSON, or of the default's type."""
    values, seen = dict(operator.DEFAULTS), {}
    for arg in args:
        key, equals, text = arg.partition("=")
        if not equals:
            raise ValueError(f"setting `{arg}` is not of the form key=value")
        if key in seen:
            raise ValueError(f"setting `{key}` is given twice, as `{seen[key]}` and as `{text}`: keep one")
        if key not in values:
            near = difflib.get_close_matches(key, values, 1)
            hint = f" (did you mean `{near[0]}`?)" if near else ""
            raise ValueError(f"unknown setting `{key}`{hint}; it takes: {', '.join(values)}")
        seen[key] = text
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
        expected = f"JSON such as `{json.dumps(default)}`"
        raise ValueError(f"setting `{key}`: expected {expected}, found `{text}`: {error}") from error
    value = float(value) if isinstance(default, float) and type(value) is int else value
    if default is not None and type(value) is not type(default):
        raise ValueError(f"setting `{key}`: expected a value like `{json.dumps(default)}`, found `{text}`")
    return value
