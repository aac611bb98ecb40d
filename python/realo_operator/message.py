"""Messages as Arrow rows: the header's fields, then the payload's columns as lists."""

import dataclasses
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import realo_geometry as geometry

_HEADER = "run agent kind frame to: string; seq hop: uint64; stamp ready: int64; clock_rate pose pose_covariance position: [double]"
_HEADER += "; trace_node: [string]; clock_origins trace_input trace_start trace_done trace_ready: [int64]"
_BOXES = "x y z length width height yaw: [double]; class: [string]; score: [float]; track: [uint64]"
_BOXES += "; velocity: [vector3]; covariance: [vector9]"
#: The columns of each payload and their types, `[…]`: of a list; `Selection` has `entries` besides, whole messages.
PAYLOADS = {
    "PointCloud": "x y z: [float]; intensity: [uint8]; time: [int32]; ring: [uint16]",
    "AgentState": "map_from_body covariance velocity angular_rate: [double]; status: string",
    "FeatureMap": "rows columns channels: uint32; cell: double; origin: [double]; dtype model: string; data: binary; confidence: [float]",
    "Packet": "codec: [string]; bytes: binary",
    "Selection": "query: uint64",
    "Report": "topic json: string",
    "Boxes": _BOXES,
    "GroundTruth": _BOXES + "; agents: [string]; points: [uint32]; ego_footprint: [double]; key: bool",
}
_ELEMENTS = {"f32": "<f4", "f16": "<f2", "bf16": "<u2", "u8": "u1"}


def _types(columns):
    vectors = {f"vector{n}": pa.list_(pa.float64(), n) for n in (3, 9)}
    for names, name in (group.split(": ") for group in columns.split("; ")):
        item = vectors.get(name.strip("[]")) or pa.type_for_alias(name.strip("[]"))
        yield from ((column, pa.list_(item) if name[0] == "[" else item) for column in names.split())


_HEADER, PAYLOADS = dict(_types(_HEADER)), {name: dict(_types(columns)) for name, columns in PAYLOADS.items()}


@dataclass
class Header:
    """What a message says of itself; times in ns.

    pose: `x y z qx qy qz qw` of `frame` in `map` at `stamp`, empty if unknown; to: the agent that a link delivered it to,
    else empty; host: what belongs to the host.
    """

    run: str = ""
    agent: str = ""
    kind: str = "report"
    seq: int = 0
    stamp: int = 0
    ready: int = 0
    frame: str = "/body"
    pose: list = field(default_factory=list)
    pose_covariance: list = field(default_factory=list)
    to: str = ""
    host: dict = field(default_factory=dict)

    @property
    def map_from_frame(self):
        """The pose as a 4×4 matrix, `None` if unknown."""
        return geometry.matrix(self.pose) if len(self.pose) else None

    def copy(self, **changes):
        """The header with some fields changed."""
        return dataclasses.replace(self, **changes)

    def __str__(self):
        return f"{self.kind} of {self.agent}, seq {self.seq}, stamp {self.stamp} ns"


@dataclass
class Message:
    """A header, the name of the payload's type, and its columns by name.

    A column of numbers is a numpy array, read-only and in the message's memory; texts, and `track` of boxes, are arrays
    of objects (`None`: unknown), an unknown `velocity` or `covariance` is a row of NaN. A FeatureMap's `data` is
    `[rows, columns, channels]` (bf16 as uint16). What is one value is plain. A Selection has `entries`, messages.
    """

    header: Header
    type: str
    payload: dict

    @staticmethod
    def boxes(header, columns):
        """A message of boxes (see `boxes`) with this header, e.g. that of the sweep in which they were found."""
        return Message(header.copy(kind="boxes"), "Boxes", columns)

    @staticmethod
    def read(row: pa.StructArray):
        """The message of a struct array of one row."""
        columns = dict(zip([row.type.field(i).name for i in range(row.type.num_fields)], row.flatten()))
        type_ = columns["payload"][0].as_py()
        fields = {name: columns[name][0].as_py() for name in _HEADER}
        own = {name: fields.pop(name) for name in list(fields) if name in Header.__dataclass_fields__}
        payload = {name: _read(name, columns[name]) for name in PAYLOADS[type_]}
        if type_ == "Selection":
            entries = (columns.get(f"entry_{i}") for i in range(len(columns)))
            payload["entries"] = [Message.read(entry) for entry in entries if entry is not None]
        if type_ == "FeatureMap":
            shape = [payload[name] for name in ("rows", "columns", "channels")]
            payload["data"] = payload["data"].view(_ELEMENTS[payload["dtype"]]).reshape(shape)
        return Message(Header(**own, host=fields), type_, payload)

    def write(self) -> pa.StructArray:
        """The message as a struct array of one row. Raises `ValueError` for columns that are missing or of another type."""
        empty = {name: [] if pa.types.is_list(as_) else 0 for name, as_ in _HEADER.items()}
        cells = {"payload": pa.array([self.type])}
        for types, values in ((_HEADER, empty | self.header.host | vars(self.header)), (PAYLOADS[self.type], self.payload)):
            cells |= {name: _cell(self.type, name, as_, values) for name, as_ in types.items()}
        cells |= {f"entry_{i}": entry.write() for i, entry in enumerate(self.payload.get("entries", []))}
        return pa.StructArray.from_arrays(list(cells.values()), list(cells))


def boxes(x, y, z=0.0, *, length, width, height, yaw=0.0, score=1.0, class_="Car", track=None, velocity=None, covariance=None):
    """Columns of the payload `Boxes`: one value for all boxes, or one for each. What is `None` is unknown.

    x, y, z: centres, m; yaw: rad; velocity: `[boxes, 3]`, m/s; covariance: `[boxes, 9]` or `[boxes, 3, 3]` of the centre.
    """
    n = np.size(x)
    numbers = {"x": x, "y": y, "z": z, "length": length, "width": width, "height": height, "yaw": yaw}
    columns = {name: _each(name, value, n, float) for name, value in numbers.items()}
    columns |= {"score": _each("score", score, n, np.float32), "class": _each("class_", class_, n, object)}
    columns |= {"track": _each("track", track, n, object)}
    for name, value, size in (("velocity", velocity, 3), ("covariance", covariance, 9)):
        known = np.full((n, size), np.nan) if value is None else np.asarray(value, float).reshape(-1, size)
        columns[name] = known if len(known) == n else _each(name, known[:, 0], n, float)
    return columns


def _each(name, value, n, kind):
    """A value for each of n boxes."""
    values = np.asarray(value, kind).ravel()
    if values.size not in (1, n):
        raise ValueError(f"`{name}`: expected one value, or one for each of {n} boxes, found {values.size}")
    return np.array(np.broadcast_to(values, n) if values.size == 1 else values)


def _read(name, column):
    cell = column[0]
    if pa.types.is_binary(column.type):
        return np.frombuffer(cell.as_buffer(), np.uint8)
    if not pa.types.is_list(column.type):
        return cell.as_py()
    values = cell.values
    if pa.types.is_fixed_size_list(values.type):
        known, size = values.is_valid().to_numpy(zero_copy_only=False), values.type.list_size
        out = np.full((len(values), size), np.nan)
        out[known] = values.flatten().to_numpy().reshape(-1, size)
        return out
    if pa.types.is_string(values.type) or name == "track":
        return np.array(values.to_pylist(), object)
    return values.to_numpy()


def _cell(payload, name, as_, values):
    """A column of one row."""
    if name not in values:
        raise ValueError(f"a {payload} needs the column `{name}`")
    value = values[name]
    try:
        if pa.types.is_binary(as_):
            held = pa.py_buffer(np.ascontiguousarray(value))
            return pa.Array.from_buffers(as_, 1, [None, pa.py_buffer(np.array([0, held.size], np.int32)), held])
        if not pa.types.is_list(as_):
            return pa.array([value], as_)
        if pa.types.is_fixed_size_list(as_.value_type):
            rows = np.asarray(value, np.float64).reshape(-1, as_.value_type.list_size)
            unknown = pa.array(np.isnan(rows).all(axis=1))
            items = pa.FixedSizeListArray.from_arrays(pa.array(rows.ravel()), type=as_.value_type, mask=unknown)
        else:
            items = pa.array(value, as_.value_type)
        return pa.ListArray.from_arrays(pa.array([0, len(items)], pa.int32()), items)
    except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"field `{name}`: expected {as_}: {error}") from error
